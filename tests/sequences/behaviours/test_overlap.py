"""The step that lays two fringe spots on each other: what it finds, what it leaves, and what it refuses."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.model.image.scene import Scene
from fitctl.sequences.behaviours.overlap import FringeSensor, direction_of
from fitctl.sequences.behaviours.table import problems
from fitctl.sequences.contact import Contact
from fitctl.sequences.reading import STEPS, make_step
from fitctl.sequences.runner import Runner, run_steps
from fitctl.sequences.view import SequenceError

pytestmark = pytest.mark.long

RIGS = default_rig_path().parent
RIG = load_rig(RIGS / "two-stars.toml")
QUIET = (
    "plant.loops.right.star_offset_sky_arcsec_max=5.0",
    "plant.loops.left.star_offset_sky_arcsec_max=5.0",
)
SHORT = {"dwell_s": 14.0, "steady_after_s": 6.0}


def spots_at(az_px, el_px):
    """The left loop's spots, its fringe spot so far from where the rig file has it."""
    return (
        'plant.loops.left.spots=[{name="pointing", offset_px={az=0.0, el=0.0}, flux_dn=28000.0, '
        "diameter_px=3.0}, "
        f'{{name="fringe", offset_px={{az={8 + az_px}, el={el_px}}}, flux_dn=4000.0, diameter_px=3.0}}]'
    )


def run_of(tried, seed, *overrides, **keys):
    """A run of acquisition and overlap: the runner, and why it failed."""
    run = tried(*QUIET, *overrides, seed=seed, rig="two-stars.toml")
    todo = [
        make_step(STEPS["acquire"], {"loop": "right"}),
        make_step(STEPS["acquire"], {"loop": "left"}),
        make_step(STEPS["overlap"], {"loop": "left", **SHORT, **keys}),
    ]
    runner = Runner(Contact(run.link, run.rig, "tried", len(todo)))
    try:
        run.attempts = run_steps(runner, todo)
    except SequenceError as error:
        run.error, run.attempts = str(error), runner.attempts
    return run, runner


def left_target_px(run):
    return run.link._simulation.supervisor.loops["left"].target_px


@pytest.mark.parametrize(
    ("az_px", "el_px", "seed"), [(0.8, -0.5, 1), (-1.5, 1.7, 2), (0.0, 0.0, 3)]
)
def test_the_target_moves_to_where_the_fringe_spots_lie_on_each_other(tried, az_px, el_px, seed):
    run, runner = run_of(tried, seed, spots_at(az_px, el_px))
    assert run.error == ""
    figures = run.figures()
    for axis, truth_px in (("az", -az_px), ("el", -el_px)):
        sd_px = figures[f"offset_sd_{axis}_px"]
        assert 0.005 < sd_px < 0.06
        assert abs(figures[f"offset_{axis}_px"] - truth_px) < 4 * sd_px
        before, after = (figures[f"tilt_{when}_{axis}_arcsec"] for when in ("before", "after"))
        assert before == pytest.approx(2.706 * -figures[f"offset_{axis}_px"], rel=1e-3)
        assert abs(after) < 0.4
    assert left_target_px(run) - (12.0, 20.0) == pytest.approx((-az_px, -el_px), abs=0.2)
    (calibration,) = runner.calibrations
    target = calibration.fragment["loops"]["left"]["target_px"]
    assert left_target_px(run) == pytest.approx((target["az"], target["el"]), abs=1e-3)


def test_the_visibility_is_measured_again_where_the_fringe_spots_lie_on_each_other(tried):
    run, _ = run_of(tried, 1, spots_at(0.8, -0.5))
    figures = run.figures()
    assert figures["visibility_before"] < 0.2
    assert figures["visibility_before"] < figures["visibility_measured"] <= 1.0
    assert figures["visibility_measured"] > 0.85
    assert figures["visibility_measured"] < figures["visibility_expected"] + 0.02


def test_what_is_too_uncertain_is_not_applied_and_the_target_goes_back(tried):
    run, runner = run_of(tried, 1, spots_at(0.8, -0.5), max_error_px=1e-4)
    assert run.outcomes()[-1] == "failed"
    assert "max_error_px is 0.0001" in run.error
    assert left_target_px(run) == pytest.approx((12.0, 20.0))
    assert runner.calibrations == []


def test_a_fringe_spot_that_is_not_where_the_rig_file_has_it_is_an_error(tried):
    run, _ = run_of(tried, 1, spots_at(0.0, -7.0))
    assert "compare the frame with loops.left.other_spots" in run.error


@pytest.mark.parametrize("apart_px", [5.0, 6.0])
def test_each_fringe_spot_is_measured_without_the_light_of_the_other(apart_px):
    rig = RIG.model_copy(update={})
    sensor = FringeSensor(rig.camera, (rig.loops["left"], rig.loops["right"]))
    spots = [*rig.plant.loops["left"].spots, *rig.plant.loops["right"].spots]
    stars_px = ((12.0, 20.0 + 7.0), (28.0, 20.0))
    places = np.array([stars_px[0], (20.0, 20.0 + apart_px), stars_px[1], (20.0, 20.0)])
    image = Scene(rig.camera, spots).expected(places).round().astype(np.uint16)
    found = sensor.offsets_px(image, stars_px)
    assert found == pytest.approx(np.array([(8.0, apart_px - 7.0), (-8.0, 0.0)]), abs=0.003)


def wrong_with(rig=RIG, **keys):
    return problems(make_step(STEPS["overlap"], {"loop": "left", **keys}), rig)


def test_what_is_wrong_is_one_line_before_anything_moves():
    assert wrong_with() == []
    assert wrong_with(load_rig(RIGS / "fit-testbed.toml")) == []
    (far,) = wrong_with(separation_px=11.0)
    assert "max_offset_px is 10" in far
    (crowded,) = wrong_with(separation_px=18.0, max_offset_px=20.0)
    assert crowded.startswith("no room to step aside by 18 px")
    (short,) = wrong_with(dwell_s=5.0)
    assert short == "steady_after_s must be below dwell_s, 5 s"
    (nothing,) = problems(make_step(STEPS["overlap"], {}), load_rig(default_rig_path()))
    assert nothing == "rig fit-mock has no section fringes, which names the two stars"
    bare = load_rig(RIGS / "two-stars.toml", ["loops.left.other_spots=[]"])
    assert wrong_with(bare) == ["loops.left.other_spots has no spot of the name fringe"]


def test_the_target_steps_along_the_axis_that_has_room():
    step = make_step(STEPS["overlap"], {"loop": "left"})
    assert direction_of(step, RIG, "left").tolist() == [0.0, 7.0]
    above = ["loops.left.target_px={az=12.0, el=20.0}", "loops.right.target_px={az=12.0, el=4.0}"]
    spots = [
        'loops.left.other_spots=[{name="fringe", offset_px={az=0.0, el=-8.0}, flux_dn=4000.0}]',
        'loops.right.other_spots=[{name="fringe", offset_px={az=0.0, el=8.0}, flux_dn=4000.0}]',
    ]
    upright = load_rig(RIGS / "two-stars.toml", [*above, *spots])
    assert direction_of(step, upright, "left").tolist() == [7.0, 0.0]
