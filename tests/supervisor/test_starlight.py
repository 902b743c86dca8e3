"""A design follows the star's measured light: on the virtual clock with the full plant."""

from concurrent.futures import Future
from dataclasses import replace

import pytest
from instruments.simulated import darken, events_of, until

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.controllers.centroid import StarSensor, sensor_noise_px
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.files import save_design
from fitctl.logging.records import ControllerChange
from fitctl.messages.commands import Acquire, SetController, Standby
from fitctl.messages.modes import Mode
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.batch.settings import BatchRefusalError
from fitctl.simulation.simulation import Simulation
from fitctl.simulation.statistics import true_residual_rms
from fitctl.supervisor.starlight import FIRST_S, Starlight

FAINT_DN = 7000.0  # 0.04 px of noise, as the rig file's 28000 DN have 0.01


def rig_of(flux_dn, controller="minimum-variance", more=()):
    """Its star has a light that the rig file does not know."""
    spot = f"{{name='star', offset_px={{az=0.0, el=0.0}}, flux_dn={flux_dn}, diameter_px=3.0}}"
    return load_rig(
        default_rig_path(),
        [
            f"plant.loops.right.spots=[{spot}]",
            "loops.right.other_spots=[]",
            f"loops.right.vernier.controller={controller}",
            *more,
        ],
    )


def held(rig, star_flux_dn=None, seconds=3.0):
    """It holds its star."""
    records = []
    simulation = Simulation(rig, 0, record=records.append)
    simulation.records = records
    simulation.command(Standby())
    simulation.command(Acquire(star_flux_dn=star_flux_dn))
    until(simulation, Mode.VERNIER)
    simulation.run(seconds)
    return simulation


def changes_of(simulation):
    return [record for record in simulation.records if isinstance(record, ControllerChange)]


def loop_of(simulation):
    return simulation.supervisor.stellar_loops["right"]


def worst_px(simulation, begin_s):
    now_s = simulation.clock.now_s()
    target_px = loop_of(simulation).target_px
    return true_residual_rms(simulation.plants["right"], target_px, begin_s, now_s).max()


@pytest.mark.long
def test_a_faint_star_is_held_by_a_design_for_its_noise(tmp_path):
    rig, today = rig_of(FAINT_DN), tmp_path / "today.json"
    save_design(design_for(rig, "right"), today)

    left_px = []
    for one in (rig, rig_of(FAINT_DN, today)):
        simulation = Simulation(one, 0, history_s=301.0)
        simulation.command(Standby())
        simulation.command(Acquire(star_flux_dn=FAINT_DN))
        simulation.run(300.0)
        left_px.append(worst_px(simulation, 30.0))

    for_its_noise_px, for_the_rig_px = left_px
    assert for_the_rig_px == pytest.approx(0.0361, abs=0.001)
    assert for_its_noise_px < 0.0275


@pytest.mark.long
@pytest.mark.parametrize("controller", ["minimum-variance", "fslq"])
def test_after_acquire_with_another_flux_the_design_is_for_that_noise(controller):
    rig = rig_of(FAINT_DN, controller)
    simulation = held(rig, FAINT_DN)

    (change,) = changes_of(simulation)
    noise_px = sensor_noise_px(rig.camera, rig.stellar_loops["right"], FAINT_DN)
    assert loop_of(simulation).pointing.design.parameters["noise_px"] == pytest.approx(
        noise_px, rel=0.01
    )
    assert (change.source, change.target) == (controller, controller)
    assert "gives 0.0401 px of noise, not 0.0100" in change.reason
    assert loop_of(simulation).state(0.0).noise_px == pytest.approx(noise_px, rel=0.01)


def test_the_light_is_that_which_is_measured_whatever_the_rig_file_expects():
    simulation = held(rig_of(20000.0))

    design = loop_of(simulation).pointing.design
    assert design.parameters["noise_px"] == pytest.approx(0.014, rel=0.01)


@pytest.mark.parametrize("electrons", [[], ["camera.electrons_per_dn=1.0"]])
def test_the_fits_noise_is_told_within_what_matters_and_without_another_fit(electrons):
    rig = rig_of(28000.0, more=["loops.right.sensor=fit", *electrons])
    camera, loop = rig.camera, rig.loops["right"]
    sensor = StarSensor(camera, loop)
    fit = sensor.fit

    for flux_dn in (17000.0, 28000.0, 44000.0):
        exact_px = sensor_noise_px(camera, loop, flux_dn)
        assert sensor.noise_px(flux_dn) == pytest.approx(exact_px, rel=0.02)
    assert sensor.fit is fit


@pytest.mark.long
def test_a_star_that_fades_later_gets_its_design_within_a_minute():
    simulation = held(rig_of(28000.0))
    assert not changes_of(simulation)

    darken(simulation, 0.7)
    simulation.run(45.0)

    design = loop_of(simulation).pointing.design
    assert design.parameters["noise_px"] == pytest.approx(0.01 / 0.7, rel=0.1)
    assert loop_of(simulation).mode is Mode.VERNIER


def test_a_design_chosen_by_hand_is_for_the_light_too():
    simulation = held(rig_of(FAINT_DN, "eq20"), FAINT_DN)
    assert not changes_of(simulation)

    simulation.command(SetController(name="minimum-variance"))
    simulation.run(3.0)

    first, second = changes_of(simulation)
    assert (first.target, first.reason) == ("minimum-variance", "operator")
    assert "0.0401 px" in second.reason


def test_after_the_way_back_from_a_learnt_design_consoles_know_its_noise():
    simulation = held(rig_of(FAINT_DN), FAINT_DN)
    loop = loop_of(simulation)
    for_the_light = loop.pointing.design

    loop.use(replace(for_the_light, learnt=True))
    assert loop.state(0.0).noise_px is None
    loop.use(for_the_light, by_itself=True)

    assert loop.state(0.0).noise_px == for_the_light.parameters["noise_px"]


def test_a_design_from_a_file_stays_as_it_is(tmp_path):
    file = tmp_path / "mine.json"
    save_design(design_for(rig_of(28000.0), "right"), file)

    assert not changes_of(held(rig_of(FAINT_DN, file), FAINT_DN))


def test_a_design_that_comes_too_late_is_not_used():
    simulation = held(rig_of(28000.0))
    loop = loop_of(simulation)
    simulation.supervisor._design_jobs._starlight.clear()
    light = Starlight(simulation.rig, loop, loop._journal)
    loop.use(design_for(simulation.rig, "right", "minimum-variance", 0.02))
    noise_px = None
    for _ in range(2 * round(FIRST_S / simulation.rig.camera.period_s)):
        simulation.run(simulation.rig.camera.period_s)
        noise_px = noise_px or light.observe()
    late = Future()
    late.set_result(design_for(simulation.rig, "right", "minimum-variance", noise_px))

    loop.use(design_for(simulation.rig, "right", "eq20"))
    light.observe()
    light.designed(noise_px, late)

    assert noise_px == pytest.approx(0.01, rel=0.1)
    assert loop.controller == "eq20"


def test_where_no_design_can_be_made_the_loop_keeps_its_own():
    simulation = held(rig_of(28000.0))
    loop = loop_of(simulation)
    before = loop.pointing.design
    failed = Future()
    failed.set_exception(ConfigError("no solution"))

    Starlight(simulation.rig, loop, loop._journal).designed(0.02, failed)

    assert loop.pointing.design is before
    assert "no design for the star's light" in events_of(simulation)[-1].message


def test_the_batch_leaves_such_a_night_to_the_simulation():
    with pytest.raises(BatchRefusalError, match="another light"):
        Batch(rig_of(20000.0))
    Batch(rig_of(20000.0, "eq20"))
    Batch(rig_of(27000.0))
