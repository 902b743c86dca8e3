"""What changes of the plant within a run: air, lines, hysteresis and the noise of the pixels."""

import numpy as np
import pytest

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.model import air_path
from fitctl.model.image.scene import Scene
from fitctl.model.plant import Plant

STILL_AIR = "plant.loops.right.air_path.gain_px=0.0"
LINE = "{frequency_hz=10.0, rms_px=0.1, direction_deg=0.0, damping=0.0, drift_hz_per_min=0.0}"


def rig_with(*overrides):
    return load_rig(default_rig_path(), overrides)


def timeline(*changes):
    return f"plant.timeline=[{', '.join(changes)}]"


def at(time_s, change):
    return f"{{at_s={time_s}, loops={{right={{{change}}}}}}}"


def star_of(rig, runs=1):
    return Plant(rig, range(runs), star_offset_px=np.zeros((runs, 2))).stellar_loops["right"]


def moved_px(star, until_s):
    star.advance(until_s)
    return star.history_px(0.0, until_s)[:, :, 0] - star.constants.spot_origin_px[:, 0]


# ---------------------------------------------------------------- air


AIR = "air_path={gain_px=1.8, b1_s2=0.1, b2_s=2.5}"


def test_the_air_is_as_it_was_until_it_changes():
    unchanged_px = moved_px(star_of(rig_with()), 2.0)
    changed_px = moved_px(star_of(rig_with(timeline(at(1.0, AIR)))), 2.0)

    assert np.array_equal(changed_px[:2000], unchanged_px[:2000])
    assert np.abs(changed_px[2000:] - unchanged_px[2000:]).max() > 0.05


@pytest.mark.long
def test_the_air_moves_by_its_new_variance_and_never_jumps():
    star = star_of(rig_with(timeline(at(1.0, AIR))), runs=64)
    moved = moved_px(star, 61.0)
    new = rig_with().plant.loops["right"].air_path.model_copy(update={"gain_px": 1.8, "b1_s2": 0.1})

    # 64 runs, two axes, ten seconds apart, settled: about 640 independent places
    places = moved[20_000::20_000].ravel()
    assert np.std(places) == pytest.approx(air_path.rms_px(new), rel=4 / np.sqrt(2 * places.size))
    fastest = np.abs(np.diff(moved, axis=0))
    assert fastest[1990:2010].max() < 2 * fastest[4000:].max()


def test_changes_of_a_run_do_not_depend_on_how_time_is_cut():
    changes = timeline(at(0.3, AIR), at(0.333, f"loop_width_fraction=0.3, lines=[{LINE}]"))
    whole, cut = star_of(rig_with(changes)), star_of(rig_with(changes))

    for time_s in np.arange(0.0, 1.0, 0.0035):
        cut.advance(time_s)

    assert moved_px(cut, 1.0) == pytest.approx(moved_px(whole, 1.0), abs=1e-12)


# ---------------------------------------------------------------- lines


def test_lines_begin_and_end_at_their_times():
    changes = timeline(
        at(1.0, f"lines=[{LINE}]"), at(2.0, "loop_width_fraction=0.15"), at(3.0, "lines=[]")
    )

    moved = moved_px(star_of(rig_with(STILL_AIR, changes)), 4.0)[:, 0, 0]

    assert np.ptp(moved[:2000]) < 1e-9
    assert np.std(moved[2000:6000]) == pytest.approx(0.1, rel=1e-3)
    assert np.ptp(moved[6000:]) < 1e-9


def test_a_line_that_another_one_replaces_goes_on_from_where_it_is():
    faster = LINE.replace("10.0", "14.0")
    changes = timeline(at(1.0, f"lines=[{faster}]"))

    moved = moved_px(
        star_of(rig_with(STILL_AIR, f"plant.loops.right.lines=[{LINE}]", changes)), 2.0
    )[:, 0, 0]

    assert np.abs(np.diff(moved)).max() < 1.01 * 2 * np.pi * 14 * 0.1 * np.sqrt(2) * 5e-4


# ---------------------------------------------------------------- hysteresis


def mirror_px(star, volts, time_s):
    """Where the star is once the first stack has met some volts."""
    star.inputs.stack_v[0, 0] = volts
    star.advance(time_s)
    return star.spots_px(time_s)[0, 0].copy()


def test_stacks_stay_where_they_are_when_their_hysteresis_changes():
    star = star_of(rig_with(STILL_AIR, timeline(at(1.0, "loop_width_fraction=0.3"))))
    mirror_px(star, 8.0, 0.2)

    before_px = mirror_px(star, 6.0, 0.9)

    assert mirror_px(star, 6.0, 1.5) == pytest.approx(before_px, abs=1e-6)


def test_stacks_follow_their_new_hysteresis_from_its_time_on():
    widths = {}
    for name, changes in (("same", ""), ("wider", at(1.0, "loop_width_fraction=0.3"))):
        star = star_of(rig_with(STILL_AIR, timeline(changes)))
        mirror_px(star, 9.0, 1.5)
        up_px = mirror_px(star, 5.0, 2.0)
        mirror_px(star, 1.0, 2.5)
        down_px = mirror_px(star, 5.0, 3.0)
        widths[name] = np.abs(up_px - down_px)[1]

    assert widths["wider"] / widths["same"] == pytest.approx(2.0, rel=0.15)


# ---------------------------------------------------------------- camera


def test_pixels_have_the_noise_of_their_time():
    rig = rig_with(
        "plant.timeline=[{at_s=1.0, pixel_noise_dn=60.0}, {at_s=2.0, pixel_noise_dn=5.0}]"
    )
    plant, scene = Plant(rig, [1]), Scene(rig.camera, rig.plant.loops["right"].spots[:1])
    away_px = np.array([[-100.0, 0.0]])

    found = [
        scene.frame(away_px, 1, number, plant.pixel_noise_dn(time_s)).std()
        for number, time_s in enumerate((0.0, 0.99, 1.0, 1.99, 2.0, 100.0))
    ]

    assert found == pytest.approx([20.0, 20.0, 60.0, 60.0, 5.0, 5.0], rel=4 / np.sqrt(2 * 1600))


# ---------------------------------------------------------------- the rig file


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([at(2.0, AIR), at(2.0, AIR)], "timeline: at_s must ascend"),
        (["{at_s=1.0, loops={wrong={}}}"], "loops.wrong is not a loop of kind stellar (right)"),
        ([at(1.0, f"lines=[{LINE.replace('10.0', '1200.0')}]")], "must be below 1000"),
        ([at(1.0, "air=1")], "timeline.0.loops.right.air: unknown key (allowed here: air_path, "),
    ],
)  # fmt: skip
def test_a_timeline_that_cannot_be_is_an_error(changes, expected):
    with pytest.raises(ConfigError) as error:
        rig_with(timeline(*changes))

    assert expected in str(error.value)


def test_a_hysteresis_that_no_stack_can_have_is_an_error_with_its_time():
    rig = rig_with(
        "plant.loops.right.hysteresis.breakpoints_v=[0.0, 0.5]",
        "plant.loops.right.hysteresis.loop_width_fraction=0.02",
        timeline(at(30.0, "loop_width_fraction=0.5")),
    )

    with pytest.raises(
        ConfigError, match=r"timeline at 30 s: loops\.right\.hysteresis: loop_width"
    ):
        Plant(rig, [1])
