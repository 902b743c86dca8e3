"""What a simulation does while it is logged, and the replay of such a log."""

import pytest
from instruments.simulated import SOON, TWO_STARS, darken, failing, until
from samples.learner_reports import SHAKEN
from samples.learner_reports import report as learner_report

from fitctl.config import default_rig_path, load_rig, rig_from_document, rig_from_log
from fitctl.drivers.interface import DeviceMismatch, DeviceTimeout
from fitctl.logging.records import StarPlace
from fitctl.messages.commands import (
    Acquire,
    Experiment,
    FrameRate,
    Look,
    Off,
    Recover,
    Release,
    Reset,
    SetBiasOffset,
    SetController,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode
from fitctl.model.drives import Drive
from fitctl.replay.files import logged_files
from fitctl.replay.log import read_steps, whole_run
from fitctl.replay.replay import replay

TIMEOUT = DeviceTimeout("device", "here", "an answer", "none", "look")
MOVED = DeviceMismatch("piezo", "here", "its limit", "another", "set it back")
SCAN = [
    Drive(channel="fsm_az", shape="triangle", amplitude=2.0, frequency_hz=1.0, duration_s=1.0),
    Drive(channel="siderostat_el", shape="sine", amplitude=2.0, frequency_hz=1.0, duration_s=1.5),
]


def replayed(*paths, change=()):
    with whole_run(paths) as info, logged_files(info) as files:
        rig = rig_from_log(info.metadata["rig"]["json"], "the log", [*files, *change])
        return replay(rig, read_steps(info, rig))


def hold_a_star(simulation):
    simulation.command(Standby())
    hold_a_star_from_standby(simulation)


def hold_a_star_from_standby(simulation):
    assert simulation.command(Acquire()).accepted
    until(simulation, Mode.VERNIER, limit_s=20.0)
    simulation.run(2.0)


def every_command(simulation):
    hold_a_star(simulation)
    simulation.command(SetTarget(az_px=22.0, el_px=18.5))
    simulation.run(1.0)
    simulation.command(SetController(name="minimum-variance"))
    simulation.run(1.0)
    for command in (Release(), Acquire(), Stop(), Recover(), Acquire(), Stop()):
        simulation.command(command)
        simulation.run(0.7)
    simulation.command(Off())
    simulation.run(0.1)
    simulation.command(Standby())
    simulation.run(0.3)


def a_rate_by_command(simulation):
    rate = {"rate_az_sky_arcsec_s": 12.0, "rate_el_sky_arcsec_s": -9.0}
    simulation.command(Standby())
    simulation.run(0.5)
    for _ in range(2):
        assert simulation.command(Acquire(**rate)).accepted
        until(simulation, Mode.VERNIER, limit_s=20.0)
        simulation.run(1.0)
        simulation.command(Release())


def another_star(simulation):
    hold_a_star(simulation)
    az_px, el_px = simulation.plants["right"].spots_px(simulation.clock.now_s())[0][1].tolist()
    assert simulation.command(Look(az_px=az_px, el_px=el_px)).accepted
    simulation.run(3.0)
    assert simulation.ticks[-1].star_flux_dn == pytest.approx(24_000, rel=0.02)


def an_experiment(simulation):
    hold_a_star(simulation)
    simulation.command(Experiment(loop="right", name="try", drives=SCAN))
    simulation.run(2.5)
    simulation.command(Experiment(loop="right", name="again", drives=SCAN))
    simulation.run(0.5)
    simulation.command(Stop())
    simulation.run(0.3)


def a_star_that_is_lost(simulation):
    hold_a_star(simulation)
    flux_dn = simulation.camera._scene._flux_dn
    darken(simulation)
    simulation.run(1.0)
    simulation.camera._scene._flux_dn = flux_dn
    simulation.run(3.0)


def a_star_that_is_away_for_long(simulation):
    """The search goes on in rounds until it is back."""
    hold_a_star(simulation)
    flux_dn = simulation.camera._scene._flux_dn
    darken(simulation)
    simulation.run(20.0)
    simulation.camera._scene._flux_dn = flux_dn
    until(simulation, Mode.VERNIER, limit_s=60.0)


def nothing_that_opens(simulation):
    amplifiers = simulation.devices.loops["right"].amplifiers
    opening, amplifiers.open = amplifiers.open, failing(TIMEOUT)
    for _ in range(2):
        simulation.command(Standby())
        simulation.run(0.1)
    amplifiers.open = opening
    hold_a_star(simulation)


def a_stall(simulation):
    """The machine stands still twice; then only the newest frame is acted on."""
    hold_a_star(simulation)
    for periods in (3, 8):
        simulation.clock.sleep_until(
            simulation.clock.now_s() + periods * simulation.rig.camera.period_s
        )
        simulation.run(1.0)
    assert simulation.ticks[-1].frames_skipped == 9


def a_mirror_that_the_watchdog_moves(simulation):
    """The machine stands still until the D/A acts by itself; the second time, it does not answer after that."""
    simulation.command(Standby())
    assert simulation.command(SetBiasOffset(az_urad=100.0, el_urad=0.0)).accepted
    simulation.run(1.0)
    dac = simulation.devices.loops["right"].dac
    simulation.clock.sleep_until(simulation.clock.now_s() + 0.45)
    dac._stack_v[:] = 5.0
    simulation.run(0.5)
    reads, dac.read_v = dac.read_v, failing(TIMEOUT)
    simulation.clock.sleep_until(simulation.clock.now_s() + 0.45)
    simulation.run(0.5)
    dac.read_v = reads
    simulation.command(Recover())
    hold_a_star_from_standby(simulation)


def a_star_of_a_killed_supervisor(**moved):
    """The search begins where a supervisor before this one had its star."""

    def course(simulation):
        place = StarPlace(
            time_s=0.0,
            loop="right",
            az_px=-20.0,
            el_px=40.0,
            siderostat_az_rad=0.0,
            siderostat_el_rad=0.0,
            **moved,
        )
        simulation.supervisor.recall([place])
        hold_a_star(simulation)

    return course


def an_off_that_waits_for_the_mirror(simulation):
    """A refused Off takes the mirror to its bias, and with it what the next search starts from."""
    simulation.command(Standby())
    assert simulation.command(SetBiasOffset(az_urad=150.0, el_urad=0.0)).accepted
    simulation.run(1.0)
    assert not simulation.command(Off()).accepted
    hold_a_star_from_standby(simulation)


def _fails(part, method, error=TIMEOUT):
    """While a star is held a device fails; it recovers, and the star is held again."""

    def course(simulation):
        hold_a_star(simulation)
        devices = simulation.devices
        device = devices.camera if part == "camera" else getattr(devices.loops["right"], part)
        well = getattr(device, method)
        setattr(device, method, failing(error))
        simulation.run(2.5)
        setattr(device, method, well)
        simulation.command(Recover())
        simulation.command(Acquire())
        simulation.run(2.0)

    return course


def off_and_on_in_one_breath(simulation):
    """Without a camera no tick is logged between the two."""
    hold_a_star(simulation)
    simulation.command(Stop())
    camera = simulation.devices.camera
    well, camera.next_frame = camera.next_frame, failing(TIMEOUT)
    simulation.run(0.5)
    camera.next_frame = well
    simulation.command(Off())
    hold_a_star(simulation)


def interlocks(simulation):
    """One flattens for a while, one holds until it is reset, one makes safe."""
    hold_a_star(simulation)
    supervisor = simulation.supervisor
    for quantity, value in (
        ("disk_free_bytes", 0.0),
        ("disk_free_bytes", 1e12),
        ("recorder_backlog_fraction", 0.9),
        ("recorder_backlog_fraction", 0.0),
    ):
        supervisor.report_quantity(quantity, value)
        simulation.run(0.5)
    assert simulation.command(Reset(name="recorder_behind")).accepted
    simulation.run(0.5)
    supervisor.report_quantity("clock_step_s", 9.0)
    simulation.run(0.5)


def a_learnt_design(simulation):
    """One that is worth it, and one that is not what it promised."""
    hold_a_star(simulation)
    simulation.run(3.0)
    simulation.command(learner_report())
    simulation.run(5.0)
    simulation.command(learner_report(lines=(), measured_px=0.015, learnt_camera_px=0.015))
    simulation.run(2.0)
    assert simulation.supervisor.loops["right"].learning.state.state == "fell back"
    simulation.command(SetController(name="learnt"))
    simulation.run(2.0)


def another_frame_rate(simulation):
    """By command, and for the learner; then an experiment, which is refused meanwhile."""
    hold_a_star(simulation)
    simulation.run(3.0)
    assert simulation.command(FrameRate(rate_hz=48.0, duration_s=2.0)).accepted
    simulation.run(6.0)
    simulation.command(learner_report(worth_it=False, classifying_rate_hz=47.0))
    simulation.run(3.0)
    assert simulation.camera._period_s == 1 / 47.0
    assert not simulation.command(Experiment(loop="right", name="try", drives=SCAN)).accepted
    simulation.run(11.0)
    assert simulation.camera._period_s == 1 / 50.0
    assert simulation.command(Experiment(loop="right", name="try", drives=SCAN)).accepted
    simulation.run(2.5)


def two_loops():
    document = load_rig(default_rig_path(), [SOON]).model_dump(mode="json")
    for loops in (document[part]["loops"] for part in ("plant", "mocks")):
        loops["left"] = dict(loops["right"])
    document["mocks"]["loops"]["left"] |= {"modbus_port": 29504, "mdt693_port": 29694}
    siderostat, fsm = (document["loops"]["right"][stage] for stage in ("siderostat", "fsm"))
    document["loops"]["left"] = document["loops"]["right"] | {
        "star_flux_dn": 84000.0,
        "target_px": {"az": 10.0, "el": 19.5},
        "siderostat": siderostat | {"device": siderostat["device"] | {"node_id": 2}},
        "fsm": fsm
        | {
            "dac": fsm["dac"] | {"port": 29504},
            "piezo": fsm["piezo"] | {"port": "socket://127.0.0.1:29694"},
        },
    }
    (spot, *_) = document["plant"]["loops"]["left"]["spots"]
    document["plant"]["loops"]["left"]["spots"] = [spot | {"flux_dn": 84000.0}]
    return rig_from_document(document, "two loops")


INTERLOCKS = [
    "interlocks.disk_space.action=flatten",
    "interlocks.recorder_behind={ quantity = 'recorder_backlog_fraction', high = 0.5, for_s = 0.0, "
    "modes = ['VERNIER'], action = 'freeze', reset = 'hand' }",
    "interlocks.clock={ quantity = 'clock_step_s', high = 1.0, for_s = 0.1, modes = ['VERNIER'], "
    "action = 'safe', reset = 'hand' }",
]
FAULT = {"STAR_FOUND", "IN_REACH", "FAULT", "RECOVER"}
# What is done, with which rig, and what must have happened for it to say anything.
MOVING = [
    "loops.right.star_rate_sky_arcsec_s={az=12.0, el=-9.0}",
    "plant.loops.right.star_rate_sky_arcsec_s={az=12.0, el=-9.0}",
]
FAINTER = [
    "plant.loops.right.spots=[{name='a', offset_px={az=0.0, el=0.0}, flux_dn=20000.0, diameter_px=3.0}]",
    "loops.right.vernier.controller=minimum-variance",
]
SEVERAL_WRITES = [
    "loops.right.fsm.dac.writes_per_frame=5",
    "loops.right.vernier.controller=minimum-variance",
]
COURSES = {
    "every command": (every_command, [], {"RELEASE", "STOP", "RECOVER", "OFF", "IN_REACH"}),
    "a star that moves": (every_command, MOVING, {"RELEASE", "STOP", "RECOVER", "IN_REACH"}),
    "the rate of a star by command": (a_rate_by_command, MOVING[1:], {"RELEASE", "IN_REACH"}),
    "experiments on a star that moves": (an_experiment, MOVING, {"EXPERIMENT", "EXPERIMENT_DONE"}),
    "another star": (another_star, [TWO_STARS], {"IN_REACH"}),
    "experiments": (an_experiment, [], {"EXPERIMENT", "EXPERIMENT_DONE", "STOP"}),
    "a star that is away for long": (
        a_star_that_is_away_for_long,
        [],
        {"STAR_LOST", "STAR_FOUND", "IN_REACH"},
    ),
    "a lost star": (a_star_that_is_lost, [], {"STAR_LOST", "STAR_FOUND", "IN_REACH"}),
    "nothing opens": (nothing_that_opens, [], {"STANDBY", "IN_REACH"}),
    "off and on": (off_and_on_in_one_breath, [], {"STOP", "OFF", "IN_REACH"}),
    "interlocks": (interlocks, INTERLOCKS, {"IN_REACH", "FAULT"}),
    "a learnt design": (a_learnt_design, [*SHAKEN, "loops.right.learn=on"], {"IN_REACH"}),
    "another frame rate": (
        another_frame_rate,
        [*SHAKEN, "loops.right.learn=on"],
        {"EXPERIMENT", "EXPERIMENT_DONE"},
    ),
    "a star of another light": (hold_a_star, FAINTER, {"IN_REACH"}),
    "several writes a frame": (every_command, SEVERAL_WRITES, {"STOP", "RECOVER", "IN_REACH"}),
    "several writes a frame, and a lost star": (
        a_star_that_is_lost,
        SEVERAL_WRITES,
        {"STAR_LOST", "STAR_FOUND", "IN_REACH"},
    ),
    "the D/A fails between frames": (_fails("dac", "confirm"), SEVERAL_WRITES, FAULT),
    "a stall": (a_stall, [], {"IN_REACH"}),
    "the D/A's own watchdog": (a_mirror_that_the_watchdog_moves, [SOON], {"FAULT", "IN_REACH"}),
    "a star of a killed supervisor": (a_star_of_a_killed_supervisor(), [], {"IN_REACH"}),
    "a moving star of a killed supervisor": (
        a_star_of_a_killed_supervisor(
            moved_az_rad=0.3, moved_el_rad=0.0, rate_is_given=True, rate_el_sky_arcsec_s=-0.2
        ),
        [],
        {"IN_REACH"},
    ),
    "a refused Off": (an_off_that_waits_for_the_mirror, [SOON], {"IN_REACH"}),
    "the D/A takes nothing": (_fails("dac", "send_v"), [], FAULT),
    "the D/A confirms nothing": (_fails("dac", "confirm"), [], FAULT),
    "the amplifiers fail": (_fails("amplifiers", "exchange"), [], FAULT),
    "the camera fails": (_fails("camera", "next_frame"), [], FAULT),
    "the piezo amplifier is silent": (_fails("piezo", "stack_volts"), [], FAULT),
    "the piezo amplifier's switch moved": (_fails("piezo", "limit_v", MOVED), [], FAULT),
}
