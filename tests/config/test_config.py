"""Rig files as documents: what each key may be, and how a mistake is told."""

import copy
import json
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from fitctl.config import ConfigError, default_rig_path, load_rig, rig_from_document

RIGS = sorted((Path(__file__).parents[2] / "rigs").glob("*.toml"))
DOCUMENT = tomllib.loads(default_rig_path().read_text(encoding="utf-8"))
OPTIONAL = {"plant", "mocks"}  # a rig of real hardware leaves them out
LEFT_OUT_AT_WILL = {
    ("loops", "right", "fsm", "hysteresis"),
    ("loops", "right", "fsm", "structure"),
    ("loops", "right", "siderostat", "backlash_sky_arcsec"),
}


def keys_of(table, path=()):
    """Every key of a rig file, as paths; names that a rig chooses itself are left out."""
    items = enumerate(table) if isinstance(table, list) else table.items()
    for key, value in items:
        here = (*path, key)
        chosen = isinstance(key, int) or (path and path[-1] in {"loops", "interlocks"})
        if not chosen and key not in OPTIONAL and here not in LEFT_OUT_AT_WILL:
            yield here
        if isinstance(value, dict) or (
            isinstance(value, list) and value and isinstance(value[0], dict)
        ):
            yield from keys_of(value, here)


def value_at(document, path):
    for key in path:
        document = document[key]
    return document


def changed(path, value):
    document = copy.deepcopy(DOCUMENT)
    value_at(document, path[:-1])[path[-1]] = value
    return document


def dotted(path):
    return ".".join(map(str, path))


def complaint(document):
    with pytest.raises(ConfigError) as caught:
        rig_from_document(document, "my.toml")
    assert caught.value.__cause__ is None  # people see lines, not a chain of tracebacks
    return str(caught.value)


KEYS = list(keys_of(DOCUMENT))
FLOATS = [path for path in KEYS if isinstance(value_at(DOCUMENT, path), float)]
NUMBERS = [path for path in KEYS if type(value_at(DOCUMENT, path)) in {float, int}]
# An interlock needs one of its limits only.
REQUIRED = [p for p in KEYS if p[0] != "interlocks" or p[-1] not in {"low", "high", "stale_s"}]


# ---------------------------------------------------------------- rig files that load


@pytest.mark.parametrize("path", RIGS, ids=lambda path: path.stem)
def test_every_rig_file_loads_and_is_named_after_its_file(path):
    assert load_rig(path).name == path.stem


def test_the_default_rig_is_shipped(rig):
    assert default_rig_path() in RIGS
    assert rig.name == "fit-mock"


def test_a_rig_of_real_hardware_needs_neither_plant_nor_mocks(rig):
    document = {key: value for key, value in DOCUMENT.items() if key not in OPTIONAL}
    real = rig_from_document(document, "real.toml")
    with pytest.raises(ConfigError, match=r"fit-mock: sections plant and mocks are missing"):
        real.mock_parts()
    assert rig.mock_parts() == (rig.plant, rig.mocks)


def test_a_loaded_rig_cannot_be_changed(rig):
    with pytest.raises(ValidationError, match="frozen"):
        rig.camera.frame_rate_hz = 100.0


def test_the_period_follows_from_the_rate(rig):
    assert rig.camera.period_s == pytest.approx(0.02)


# ---------------------------------------------------------------- rig files that do not


@pytest.mark.parametrize("path", REQUIRED, ids=dotted)
def test_every_key_is_required(path):
    document = copy.deepcopy(DOCUMENT)
    del value_at(document, path[:-1])[path[-1]]
    assert (
        f"my.toml: {dotted(path)}: is missing; a rig file that fitctl init writes has"
        in complaint(document)
    )


@pytest.mark.parametrize("path", FLOATS, ids=dotted)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), "much"])
def test_every_number_must_be_one(path, value):
    assert complaint(changed(path, value)).startswith(f"my.toml: {dotted(path)}: must be ")


@pytest.mark.parametrize("path", NUMBERS, ids=dotted)
def test_a_number_in_quotes_or_a_truth_value_is_not_a_number(path):
    for value in (str(value_at(DOCUMENT, path)), True):
        assert f"my.toml: {dotted(path)}: " in complaint(changed(path, value))


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("camera.frame_rate_hz", 0.5, "must be greater than or equal to 1 (is 0.5)"),
        ("camera.width_px", 15, "must be greater than or equal to 16 (is 15)"),
        ("camera.pixel_noise_dn", 0.0, "must be greater than 0 (is 0.0)"),
        ("camera.device.gvcp_port", 70000, "must be less than or equal to 65535 (is 70000)"),
        ("camera.device.driver", "usb", "must be 'gige' or 'aravis' (is 'usb')"),
        ("logging.compression", "rar", "must be 'zstd', 'lz4' or 'none' (is 'rar')"),
        ("loops.right.siderostat.device.node_id", 128, "must be less than or equal to 127"),
        ("loops.right.fsm.dac.bits", 24, "must be less than or equal to 16 (is 24)"),
        ("loops.right.acquisition.found_frames", 0, "must be greater than or equal to 1 (is 0)"),
        ("loops.right.acquisition.found_frames", 2.5, "must be a valid integer"),
        ("plant.loops.right.structure.mode_hz", [330.0], "should have at least 2 items"),
        ("plant.loops.right.hysteresis.breakpoints_v", [0.0, 2.0, 1.0], "must start at 0 and ascend"),
        ("plant.loops.right.hysteresis.breakpoints_v", [0.1, 2.0], "must start at 0 and ascend"),
        ("schema_version", 3, "must be 2 (is 3)"),
        ("name", "no spaces", "pattern"),
    ],
)  # fmt: skip
def test_a_value_out_of_range_is_named_with_what_is_allowed(key, value, line):
    text = complaint(changed(tuple(key.split(".")), value))
    assert "\n" not in text
    assert text.startswith("my.toml: ")
    assert key.removesuffix(".breakpoints_v") in text
    assert line in text


def test_what_belongs_together_must_agree():
    assert (
        "camera.exposure_s: must be at most 0.02 (is 0.03), or camera.frame_rate_hz"
        in complaint(changed(("camera", "exposure_s"), 0.03))
    )
    assert (
        "loops.right.flux_range.low: must be below 1.6 (is 2), or loops.right.flux_range.high"
        in complaint(changed(("loops", "right", "flux_range", "low"), 2.0))
    )
    assert "loops.right.fsm.range_rad: must be at most 0.0001777 (is 0.00019)" in complaint(
        changed(("loops", "right", "fsm", "range_rad"), 1.9e-4)
    )
    assert (
        "loops.right.target_px.az: must be from 3 to 36 (is 40), or camera.width_px"
        in complaint(changed(("loops", "right", "target_px", "az"), 40.0))
    )


@pytest.mark.parametrize("section", ["plant", "mocks"])
def test_plant_and_mocks_name_the_same_loops(section):
    document = copy.deepcopy(DOCUMENT)
    document[section]["loops"]["left"] = document[section]["loops"].pop("right")
    text = complaint(document)
    assert f"{section}.loops must name the same loops as loops: right" in text


@pytest.mark.parametrize("section", ["loops", "plant", "mocks"])
def test_there_must_be_a_loop(section):
    path = (section,) if section == "loops" else (section, "loops")
    assert "at least 1 item" in complaint(changed(path, {}))


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("camera.frame_rate", "frame_rate_hz"),
        ("loops.right.coarse.gain_rad_m", "gain_rad_per_m"),
        ("loops.right.siderostat.device.chanel", "channel"),
        ("plant.loops.right.hysteresis.loop_width", "loop_width_fraction"),
        ("supervisr", "supervisor"),
    ],
)
def test_an_unknown_key_is_named_with_the_likely_one(key, hint):
    text = complaint(changed(tuple(key.split(".")), 1.0))
    assert f"my.toml: {key}: unknown key; did you mean {hint}? (allowed here: " in text


def test_a_key_that_is_misspelt_is_not_also_said_to_be_missing():
    document = changed(("camera", "frame_rate_Hz"), 50.0)
    del document["camera"]["frame_rate_hz"]
    del document["camera"]["bias_dn"]

    lines = complaint(document).splitlines()

    assert len(lines) == 2
    assert "camera.frame_rate_Hz: unknown key; did you mean frame_rate_hz?" in "".join(lines)
    assert "camera.bias_dn: is missing" in "".join(lines)


def test_an_unknown_key_in_a_list_of_tables_is_named_too():
    text = complaint(changed(("plant", "loops", "right", "spots", 1, "flux"), 1.0))
    assert "plant.loops.right.spots.1.flux: unknown key; did you mean flux_dn?" in text


@pytest.mark.parametrize("name", ["ensemble", "cia402", "dac", "device", "hexapod", "loops"])
def test_an_unknown_key_of_a_loop_with_a_device_s_name_is_named_too(name):
    document = json.loads(json.dumps(DOCUMENT).replace('"right"', f'"{name}"'))
    document["plant"]["loops"][name]["line"] = []
    text = complaint(document)
    assert f"plant.loops.{name}.line: unknown key; did you mean lines? (allowed here: " in text


def test_an_unknown_key_of_a_mock_has_the_mock_s_keys():
    text = complaint(changed(("mocks", "loops", "right", "ensemble"), {"tcp_prt": 1}))
    assert "mocks.loops.right.ensemble.tcp_prt: unknown key; did you mean tcp_port?" in text


def test_an_unknown_key_like_no_other_has_no_hint():
    text = complaint(changed(("optics", "zzz"), 1.0))
    assert "optics.zzz: unknown key (allowed here: compressor_ratio, focal_length_m)" in text


def test_everything_that_is_wrong_is_told_at_once():
    document = changed(("camera", "width_px"), 1)
    del document["optics"]["focal_length_m"]
    document["logging"]["colour"] = "red"
    lines = complaint(document).splitlines()
    assert sorted(line.split(": ")[1] for line in lines) == [
        "camera.width_px",
        "logging.colour",
        "optics.focal_length_m",
    ]
    assert all(line.startswith("my.toml: ") for line in lines)


def complaint_or_nothing(document):
    try:
        rig_from_document(document, "my.toml")
    except ConfigError as error:
        return str(error)
    return ""


@given(path=st.sampled_from(KEYS), value=st.none() | st.text(max_size=5) | st.lists(st.integers()))
def test_no_value_whatever_ends_in_another_error(path, value):
    lines = complaint_or_nothing(changed(path, value)).splitlines()
    assert all(line.startswith("my.toml: ") for line in lines)


def test_an_amplifiers_mock_that_is_not_described_is_asked_for():
    document = copy.deepcopy(DOCUMENT)
    document["loops"]["right"]["siderostat"]["device"] = {
        "driver": "ensemble",
        "port": "socket://127.0.0.1:8000",
        "baud_rate": 115200,
        "axes": [0, 1],
        "response_timeout_s": 0.5,
        "software_limits_verified": False,
    }
    assert "mocks.loops.right.ensemble is missing" in complaint(document)


@pytest.mark.parametrize("driver", ["gpib", 3])
def test_an_amplifier_that_nobody_knows_is_named_with_those_there_are(driver):
    text = complaint(changed(("loops", "right", "siderostat", "device", "driver"), driver))
    assert text == (
        "my.toml: loops.right.siderostat.device.driver: must be one of 'cia402', 'ensemble', "
        f"'bal_analog' (is '{driver}')"
    )


def test_a_spot_that_would_be_taken_for_the_star_is_refused():
    (spot,) = DOCUMENT["loops"]["right"]["other_spots"]
    as_bright = changed(("loops", "right", "other_spots"), [spot | {"flux_dn": 20000.0}])
    assert complaint(as_bright).startswith(
        "my.toml: loops.right.other_spots: must be below 16800 or above 44800 (is 20000), or "
    )
    assert (
        not rig_from_document(changed(("loops", "right", "other_spots"), []), "x")
        .loops["right"]
        .other_spots
    )


NO_NAMES = (
    "",
    "Right",
    "../up",
    "a b",
    "a\n",
    "a/b",
    "a.b",
    "<img>",
    'a"',
    "1a",
    "ä",
    "\x1b]0;x\x07",
    "a" * 33,
)


@pytest.mark.parametrize("name", NO_NAMES)
@pytest.mark.parametrize("place", ["loops", "interlocks", "other_spots", "plant.spots"])
def test_a_name_is_one_that_files_and_pages_can_have(place, name, rig):
    document = rig.model_dump(mode="json")
    loop, plant = document["loops"]["right"], document["plant"]["loops"]["right"]
    if place == "loops":
        document["loops"][name] = loop
    elif place == "interlocks":
        document["interlocks"][name] = document["interlocks"]["fsm_edge"]
    elif place == "other_spots":
        loop["other_spots"][0]["name"] = name
    else:
        plant["spots"][0]["name"] = name

    with pytest.raises(ConfigError, match=r"must be 1 to 32 characters: a letter a to z"):
        rig_from_document(document, "rig.toml")
