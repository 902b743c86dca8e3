"""Rig files with several loops, a metrology loop and a collector."""

import copy
import tomllib

import pytest
from documents import blocks

from fitctl.config import ConfigError, default_rig_path, load_rig, rig_from_document

TESTBED = default_rig_path().parent / "fit-testbed.toml"
RIG = load_rig(TESTBED)
DOCUMENT = RIG.model_dump(mode="json", exclude_none=True)


def complaint(changes, *, without=(), document=DOCUMENT):
    changed = copy.deepcopy(document)
    for key in without:
        *path, last = key.split(".")
        table = changed
        for part in path:
            table = table[part]
        del table[last]
    for key, value in changes.items():
        *path, last = key.split(".")
        table = changed
        for part in path:
            table = table[part]
        table[last] = value
    with pytest.raises(ConfigError) as caught:
        rig_from_document(changed, "my.toml")
    return str(caught.value)


def test_loops_are_parted_by_kind_in_the_rig_files_order():
    assert list(RIG.loops) == ["right", "metrology", "left"]
    assert list(RIG.stellar_loops) == ["right", "left"]
    assert list(RIG.metrology_loops) == ["metrology"]
    truth, mocks = RIG.mock_parts()
    assert list(truth.stellar_loops) == list(mocks.stellar_loops) == ["right", "left"]
    assert list(truth.metrology_loops) == list(mocks.metrology_loops) == ["metrology"]


ON_ONE_BUS = {
    f"loops.{name}.siderostat.device.{key}": value
    for node, name in enumerate(("right", "metrology", "left"), 1)
    for key, value in (("interface", "socketcan"), ("channel", "can0"), ("node_id", node))
}


def test_drives_may_share_a_can_bus_and_then_are_found_on_it():
    shared = load_rig(TESTBED, [f"{key}={value!r}" for key, value in ON_ONE_BUS.items()])
    assert [list(drives) for drives in RIG.can_buses] == [["right"], ["metrology"], ["left"]]
    assert [list(drives) for drives in shared.can_buses] == [["right", "metrology", "left"]]


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        (
            "device.node_id",
            2,
            "loops.left.siderostat.device.node_id: must be another node id (is 2), or "
            "loops.metrology.siderostat.device.node_id must be another",
        ),
        ("device.node_id", 127, "loops.left.siderostat.device.node_id: must be below 127"),
        (
            "device.bitrate",
            500000,
            "loops.left.siderostat.device.bitrate: must be 1000000 (is 500000), or loops.right.siderostat.",
        ),
        (
            "servo.rate_hz",
            400.0,
            "loops.left.siderostat.servo.rate_hz: must be 500 (is 400), or loops.right.siderostat.servo",
        ),
    ],
)
def test_drives_on_one_can_bus_must_agree(key, value, line):
    assert line in complaint(ON_ONE_BUS | {f"loops.left.siderostat.{key}": value})


def test_a_loop_without_a_kind_points_a_star(rig):
    assert rig.stellar_loops == rig.loops
    assert rig.loops["right"].link is None


def test_a_rig_survives_its_own_document():
    assert rig_from_document(DOCUMENT, "again") == RIG


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"loops.left.link": "laser"},
         "loops.left.link: must name a loop of kind metrology (metrology), is 'laser'"),
        ({"collector.motion.kind": "sine", "collector.motion.amplitude_mm": 60.0,
          "collector.motion.frequency_hz": 0.01},
         "collector.motion.amplitude_mm: must be at most 50 (is 60)"),
        ({"collector.motion.kind": "drift", "collector.motion.range_mm": 40.0,
          "collector.motion.direction_deg": 90.0},
         "collector.motion.range_mm: must be at most 25 (is 40)"),
        ({"loops.left.link": "right"},
         "loops.left.link: must name a loop of kind metrology (metrology), is 'right'"),
        ({"loops.metrology.kind": "laser"},
         "loops.metrology.kind: must be one of 'stellar', 'metrology' (is 'laser')"),
        ({"plant.loops.metrology": DOCUMENT["plant"]["loops"]["right"]},
         "plant.loops.metrology.kind: must be metrology, as loops.metrology.kind (is stellar)"),
        ({"mocks.loops.metrology": DOCUMENT["mocks"]["loops"]["right"]},
         "mocks.loops.metrology.kind: must be metrology, as loops.metrology.kind (is stellar)"),
        ({"loops.left.target_px.az": 15.0},
         "loops.left.target_px: must be at least 13.75 px from loops.right.target_px (is [15.0, 20.0])"),
        ({"loops.left.siderostat.servo.gain_per_s": 300.0},
         "loops.left.siderostat.servo.gain_per_s: must be at most 200 (is 300)"),
        ({"loops.metrology.siderostat.servo.gain_per_s": 300.0},
         "loops.metrology.siderostat.servo.gain_per_s: must be at most 200 (is 300)"),
        ({"loops.left.feedforward.gian": 1.0},
         "loops.left.feedforward.gian: unknown key; did you mean gain?"),
        ({"loops.metrology.hold.crossover": 1.0},
         "loops.metrology.hold.crossover: unknown key; did you mean crossover_hz?"),
        ({"plant.loops.metrology.air_path.rms_arcsec": 1.0},
         "plant.loops.metrology.air_path.rms_arcsec: unknown key; did you mean rms_sky_arcsec?"),
        ({"loops.left.feedforward.matrix": [[1.0, 0.0]]},
         "loops.left.feedforward.matrix: List should have at least 2 items"),
        ({"loops.metrology.sensor.ambient_v": [0.0, 0.0, 0.0]},
         "loops.metrology.sensor.ambient_v: List should have at least 4 items"),
        ({"loops.metrology.sensor.on_axis_v": 10.0},
         "loops.metrology.sensor.on_axis_v: must be below 9.87 (is 10), or loops.metrology.sensor.saturated_v"),
        ({"loops.metrology.hold.second_integrator_hz": 1.1},
         "loops.metrology.hold.second_integrator_hz: must be at most 1 (is 1.1), or loops.metrology.hold.cr"),
        ({"collector.geometry.link": [2.0, 0.0, 0.0]},
         "collector.geometry: link must be a direction of length 1"),
        ({"collector.geometry.link_azimuth": [1.0, 0.0, 0.0]},
         "collector.geometry: link_azimuth must be at a right angle to link"),
        ({"collector.geometry.array_m": [0.1, 0.0, 0.15]},
         "collector.geometry: siderostat_m and array_m must be two places"),
        ({"collector.geometry.starlight": [0.0, 0.0, 1.0]},
         "collector.geometry: starlight must differ from the direction from siderostat_m to array_m"),
        ({"collector.motion.kind": "file"},
         'collector.motion: file must name a CSV file where kind is "file"'),
        ({"collector.motion.kind": "jump"},
         "collector.motion.kind: must be 'still', 'drift', 'sine', 'random' or 'file'"),
        ({"fringes.loops": ["left", "metrology"]},
         "fringes.loops: must name two loops of kind stellar (right, left), is left, metrology"),
        ({"fringes.loops": ["left", "left"]}, "fringes.loops: must name two loops of kind stellar"),
    ],
)  # fmt: skip
def test_a_rig_that_does_not_agree_is_refused_by_the_key_that_is_wrong(changes, line):
    assert f"my.toml: {line}" in complaint(changes)


def test_what_is_missing_is_named():
    assert "my.toml: loops.left: feedforward needs link" in complaint(
        {}, without=["loops.left.link"]
    )
    assert "mocks.hexapod is missing: the rig has a collector" in complaint(
        {}, without=["mocks.hexapod"]
    )
    parts = ["loops", "plant.loops", "mocks.loops"]
    assert (
        "collector: needs one loop of kind metrology, which follows it; loops has 0"
        in complaint(
            {},
            without=[
                "loops.left.feedforward",
                "loops.left.link",
                *(f"{p}.metrology" for p in parts),
            ],
        )
    )
    only_metrology = {"loops": {"metrology": DOCUMENT["loops"]["metrology"]}}
    assert "loops: at least one must be of kind stellar" in complaint(
        only_metrology, without=["plant", "mocks", "collector", "fringes"]
    )


def test_a_link_comes_before_the_loop_that_uses_it():
    loops = DOCUMENT["loops"]
    swapped = {name: loops[name] for name in ("right", "left", "metrology")}
    assert (
        "loops.left.link: loops.metrology must come before loops.left in the rig file"
        in complaint({"loops": swapped})
    )


def test_fringe_spots_that_lie_on_each_other_are_checked_as_they_interfere():
    brighter = copy.deepcopy(DOCUMENT["loops"])
    brighter["left"]["other_spots"][0]["flux_dn"] = 4500.0
    line = complaint({"loops": brighter})
    assert line.startswith(
        "my.toml: loops.left.other_spots: must be dimmer, by flux_dn, or elsewhere"
    )
    assert "loops.right.flux_range.low must be above 0.6067 (is 0.6)" in line
    assert (
        "fringe lies on fringe of loop right, and both reach 16985.3 DN: loop right could accept it "
        "as its star, which may have 16800 to 44800" in line
    )
    apart = copy.deepcopy(brighter)
    apart["left"]["other_spots"][0]["offset_px"]["el"] = 8.0
    assert rig_from_document(DOCUMENT | {"loops": apart}, "apart.toml")


def test_two_stars_need_no_metrology():
    parts = copy.deepcopy(DOCUMENT)
    del parts["collector"]
    for section in (parts, parts["plant"], parts["mocks"]):
        section["loops"] = {n: section["loops"][n] for n in ("right", "left")}
    del parts["loops"]["left"]["link"], parts["loops"]["left"]["feedforward"]
    assert list(rig_from_document(parts, "two.toml").loops) == ["right", "left"]


def test_the_rig_of_two_stars_is_what_its_how_to_shows():
    (shown,) = [
        tomllib.loads(block.text)
        for block in blocks("text")
        if block.document.name == "testbed.md" and "[loops.left]" in block.text
    ]
    path = TESTBED.with_name("two-stars.toml")

    def assert_holds(document, part):
        for key, value in part.items():
            if isinstance(value, dict):
                assert_holds(document[key], value)
            else:
                assert document[key] == value, key

    rig = load_rig(path)
    assert_holds(tomllib.loads(path.read_text()), shown)
    assert list(rig.stellar_loops) == list(rig.loops) == ["right", "left"]
    assert all(loop.link is None and loop.feedforward is None for loop in rig.loops.values())
    assert rig.collector is None
    assert list(rig.fringes.loops) == ["left", "right"]
