"""Values that a device cannot have or that contradict others: the line names the key that was changed."""

import copy
import re

import pytest

from fitctl.config import ConfigError, default_rig_path, load_rig, rig_from_document
from fitctl.config.reading import read_parts

RIGS = {
    name: read_parts(default_rig_path().with_name(f"{name}.toml")).document
    for name in ("fit-mock", "fit-testbed", "ensemble", "fit-bal-analog")
}
ONE_STAR = RIGS["fit-mock"]
MOTORS, DRIVE = "loops.right.siderostat", "loops.right.siderostat.device"
SERVO, SEARCH = f"{MOTORS}.servo", "loops.right.acquisition"
FSM, DAC, PIEZO = "loops.right.fsm", "loops.right.fsm.dac", "loops.right.fsm.piezo"


def changed(document, changes):
    document = copy.deepcopy(document)
    for key, value in changes.items():
        *path, last = key.split(".")
        table = document
        for part in path:
            table = table.setdefault(part, {})
        table[last] = value
    return document


def complaints(document):
    try:
        rig_from_document(document, "my.toml")
    except ConfigError as error:
        return str(error).splitlines()
    return []


def refusal(document, changes):
    """The one line that a rig with changes is refused with."""
    lines = complaints(changed(document, changes))
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize("name", RIGS)
def test_the_rigs_that_are_changed_here_are_sound(name):
    assert complaints(RIGS[name]) == []


# ---------------------------------------------------------------- what a device cannot be

IMPOSSIBLE = [
    # optics and camera
    ("optics.focal_length_m", 457.0),  # mm
    ("optics.compressor_ratio", 0.0),
    ("camera.width_px", 8),
    ("camera.pixel_size_m", 24e-3),
    ("camera.frame_rate_hz", 5000.0),
    ("camera.device.address", "10.0.0.500"),
    ("camera.device.address", "10.0.0"),
    ("camera.device.address", "camera-1"),
    ("camera.device.address", "239.1.1.1"),
    ("camera.device.address", "0.0.0.0"),
    ("camera.device.address", "192.168.1.20:3956"),
    ("camera.device.packet_size_bytes", 9216),
    ("camera.device.pixel_format", "Mono10"),
    ("camera.frame_delay_s", 1e307),
    # star
    ("loops.right.spot_diameter_px", 1e200),
    ("loops.right.vernier.air_path.gain_px", 1e308),
    ("loops.right.vernier.air_path.b1_s2", 1e10),
    ("loops.right.vernier.air_path.b2_s", 1e8),
    # siderostat
    ("loops.right.coarse.gain_rad_per_m", 5e-324),
    (f"{MOTORS}.encoder_counts_per_rev", 0),
    (f"{MOTORS}.ball_screw_m_per_rad", 0.113),  # mm
    (f"{MOTORS}.lever_arm_m", 115.0),  # mm
    (f"{MOTORS}.velocity_limit_rad_s", 60_000.0),
    (f"{MOTORS}.rotation_deg", 270.0),
    (f"{DRIVE}.position_limit_rad", 5e-324),
    (f"{DRIVE}.node_id", 0),
    (f"{DRIVE}.node_id", 128),
    (f"{DRIVE}.bitrate", 1_000_001),
    (f"{DRIVE}.interface", "socketcna"),
    (f"{DRIVE}.interface", "udp_multicast"),
    (f"{DRIVE}.channel", "can0"),  # slcan wants a port
    (f"{DRIVE}.channel", "socket://127.0.0.1"),
    (f"{DRIVE}.channel", "socket://10.0.0.300:29536"),
    # mirror
    (f"{FSM}.beam_per_mirror", 20.0),
    (f"{FSM}.stack_scale_m_per_v", 0.8),  # um
    (f"{FSM}.stack_radius_m", 22.5),  # mm
    (f"{DAC}.host", "10.0.0.500"),
    (f"{DAC}.host", "10.0.0.5:502"),
    (f"{DAC}.host", "http://station"),
    (f"{DAC}.host", ""),
    (f"{DAC}.baud_rate", 11520),
    (f"{DAC}.full_scale_v", 100.0),
    (f"{DAC}.bits", 24),
    (f"{DAC}.writes_per_frame", 0),
    (f"{DAC}.writes_per_frame", 11),
    (f"{PIEZO}.limit_v", 120.0),
    (f"{PIEZO}.limit_v", 0.0),
    (f"{PIEZO}.port", "10.0.0.5"),
    (f"{PIEZO}.port", "ttyUSB0"),
    (f"{PIEZO}.port", "socket://10.0.0.5"),
    (f"{PIEZO}.port", "socket://10.0.0.5:99999"),
    (f"{PIEZO}.baud_rate", 115201),
    (f"{PIEZO}.gain", 150.0),
    # plant
    ("plant.frame_delay_s", 1e308),
    ("plant.loops.right.amplifier_bandwidth_hz", 1e308),
    ("plant.loops.right.backlash_sky_arcsec", 1e308),
    ("plant.loops.right.star_offset_sky_arcsec_max", 1e308),
    ("plant.loops.right.air_path.gain_px", 1e308),
    ("plant.loops.right.air_path.b1_s2", 1e10),
    ("plant.loops.right.air_path.b2_s", 1e8),
    ("plant.loops.right.air_path.relative_rms_px", 1e308),
    ("plant.loops.right.hysteresis.full_swing_stroke_m", 9.1),  # um
]


@pytest.mark.parametrize(("key", "value"), IMPOSSIBLE)
def test_what_a_device_cannot_be_is_refused_by_its_key(key, value):
    line = refusal(ONE_STAR, {key: value})
    assert line.startswith(f"my.toml: {key}: must ")
    assert f"(is {value!r}" in line or f"(is {value:g}" in line


LINE = {
    "frequency_hz": 6.0,
    "rms_px": 0.05,
    "direction_deg": 0.0,
    "damping": 0.01,
    "drift_hz_per_min": 0.0,
}
SPOT = {"name": "a", "offset_px": {"az": 0.0, "el": 0.0}, "flux_dn": 28000.0, "diameter_px": 3.0}


@pytest.mark.parametrize(
    ("key", "value", "item"),
    [
        (f"{FSM}.structure.mode_hz", [330.0, 1e200], "1"),
        ("plant.loops.right.lines", [LINE | {"rms_px": 1e308}], "0.rms_px"),
        ("plant.loops.right.lines", [LINE | {"direction_deg": 1e308}], "0.direction_deg"),
        ("plant.loops.right.lines", [LINE | {"drift_hz_per_min": -1e308}], "0.drift_hz_per_min"),
        ("plant.loops.right.spots", [SPOT | {"diameter_px": 1e200}], "0.diameter_px"),
        ("plant.loops.right.spots", [SPOT | {"flux_dn": 1e308}], "0.flux_dn"),
    ],
)
def test_so_is_what_an_item_of_a_list_cannot_be(key, value, item):
    assert refusal(ONE_STAR, {key: value}).startswith(f"my.toml: {key}.{item}: must be ")


@pytest.mark.parametrize(
    ("rig", "key", "value"),
    [
        ("ensemble", f"{DRIVE}.port", "10.0.0.5"),
        ("ensemble", f"{DRIVE}.baud_rate", 100),
        ("ensemble", f"{DRIVE}.axes", [0, 0]),
        ("fit-bal-analog", f"{DRIVE}.host", "10.0.0.256"),
        ("fit-bal-analog", f"{DRIVE}.full_scale_v", 24.0),
        ("fit-testbed", "loops.metrology.sensor.device.host", "labjack t7"),
        ("fit-testbed", "collector.hexapod.port", "192.168.1.40"),
        ("fit-testbed", "fringes.wavelength_m", 700.0),  # nm
    ],
)
def test_so_is_what_another_kind_of_device_cannot_be(rig, key, value):
    assert refusal(RIGS[rig], {key: value}).startswith(f"my.toml: {key}: must ")


POSSIBLE = [
    ("camera.device.address", "192.168.1.20"),
    (f"{DAC}.host", "station.observatory.org"),
    (f"{DAC}.host", "fd00::5"),
    (f"{PIEZO}.port", "/dev/serial/by-id/usb-Thorlabs_MDT693B_140421-07-if00"),
    (f"{PIEZO}.port", "COM7"),
    (f"{PIEZO}.port", "socket://[fd00::5]:4001"),
    (f"{PIEZO}.port", "socket://terminal-server:4001"),
    (f"{PIEZO}.limit_v", 150.0),
    (f"{DRIVE}.channel", "/dev/ttyACM0@115200"),
    (f"{DRIVE}.position_limit_rad", 0.0),  # the drive keeps what it has
]


@pytest.mark.parametrize(("key", "value"), POSSIBLE)
def test_what_a_device_can_be_is_accepted(key, value):
    assert complaints(changed(ONE_STAR, {key: value})) == []


def test_an_address_where_a_port_is_expected_is_answered_with_the_port_to_write():
    line = refusal(RIGS["ensemble"], {f"{DRIVE}.port": "10.0.0.5"})
    assert "for this address, write socket://10.0.0.5:PORT" in line


@pytest.mark.parametrize(
    ("interface", "channel", "accepted"),
    [
        ("socketcan", "can0", True),
        ("socketcan", "/dev/can0", False),
        ("socketcan", "", False),
        ("pcan", "PCAN_USBBUS1", True),
        ("kvaser", "", False),
    ],
)
def test_a_channel_is_one_of_its_can_interface(interface, channel, accepted):
    lines = complaints(
        changed(ONE_STAR, {f"{DRIVE}.interface": interface, f"{DRIVE}.channel": channel})
    )
    assert (lines == []) == accepted
    assert all(f"{DRIVE}.channel: must be" in line for line in lines)


# ---------------------------------------------------------------- what does not fit other values

# (changes, the key that was changed, the key that it contradicts)
CONTRADICTIONS = [
    # camera
    ({"camera.exposure_s": 0.03}, "camera.frame_rate_hz"),
    ({"camera.frame_rate_hz": 150.0}, "camera.exposure_s"),
    ({"camera.frame_delay_s": 0.001}, "camera.exposure_s"),
    ({"camera.frame_delay_s": 0.2}, "interlocks.star_lost.stale_s"),
    ({"interlocks.star_lost.stale_s": 0.05}, "camera.frame_delay_s"),
    ({"camera.frame_rate_hz": 5.0}, "interlocks.star_lost.stale_s"),
    ({"camera.device.packet_delay_s": 0.009}, "camera.frame_rate_hz"),
    ({"camera.device.pixel_format": "Mono8"}, "camera.bias_dn"),
    ({"camera.bias_dn": 70_000.0}, "camera.device.pixel_format"),
    ({"camera.device.pixel_format": "Mono12"}, "loops.right.star_flux_dn"),
    ({"loops.right.star_flux_dn": 500_000.0}, "camera.device.pixel_format"),
    ({"camera.pixel_noise_dn": 2000.0}, "loops.right.star_flux_dn"),
    ({"camera.pixel_noise_dn": 90.0, f"{SEARCH}.detection_sigma": 100.0}, f"{SEARCH}.detection_sigma"),
    ({"camera.width_px": 24}, "loops.right.target_px.az"),
    ({"loops.right.target_px.el": 38.0}, "camera.height_px"),
    ({"loops.right.star_flux_dn": 15_000.0}, "loops.right.other_spots"),
    ({"loops.right.flux_range.low": 0.3}, "loops.right.other_spots"),
    ({"loops.right.flux_range.low": 0.0}, "loops.right.other_spots"),
    # siderostat
    ({f"{SERVO}.gain_per_s": 300.0}, f"{SERVO}.rate_hz"),
    ({f"{SERVO}.rate_hz": 100.0}, f"{SERVO}.gain_per_s"),
    ({f"{SERVO}.following_error_limit_rad": 0.3}, f"{MOTORS}.velocity_limit_rad_s"),
    ({f"{MOTORS}.velocity_limit_rad_s": 200.0}, f"{SERVO}.following_error_limit_rad"),
    ({f"{SERVO}.reading_timeout_s": 0.001}, f"{SERVO}.rate_hz"),
    ({"loops.right.star_rate_sky_arcsec_s.el": -1200.0, "loops.right.star_rate_sky_arcsec_s.az": 0.0},
      f"{MOTORS}.velocity_limit_rad_s"),
    ({f"{MOTORS}.travel_sky_arcsec": 2000.0}, f"{DRIVE}.position_limit_rad"),
    ({f"{DRIVE}.position_limit_rad": 50.0}, f"{MOTORS}.travel_sky_arcsec"),
    ({f"{DRIVE}.position_limit_rad": 4e6}, f"{MOTORS}.encoder_counts_per_rev"),
    ({f"{MOTORS}.spur_gear_ratio": 50.0}, f"{MOTORS}.travel_sky_arcsec"),
    ({f"{MOTORS}.backlash_sky_arcsec": 5000.0}, f"{MOTORS}.travel_sky_arcsec"),
    ({f"{SEARCH}.search_radius_sky_arcsec": 1300.0}, f"{MOTORS}.travel_sky_arcsec"),
    ({f"{MOTORS}.travel_sky_arcsec": 100.0}, f"{SEARCH}.search_radius_sky_arcsec"),
    ({f"{DRIVE}.master_heartbeat_timeout_s": 0.02, f"{SERVO}.rate_hz": 140.0, f"{SERVO}.gain_per_s": 55.0,
      f"{SERVO}.following_error_limit_rad": 2.0}, f"{SERVO}.rate_hz"),
    ({f"{DRIVE}.bitrate": 125_000}, f"{SERVO}.rate_hz"),
    # mirror
    ({f"{FSM}.range_rad": 1.9e-4}, f"{FSM}.stack_radius_m"),
    ({f"{FSM}.bias_v": 4.0}, f"{FSM}.range_rad"),
    ({f"{DAC}.full_scale_v": 5.0}, f"{FSM}.range_rad"),
    ({f"{PIEZO}.limit_v": 100.5}, f"{FSM}.range_rad"),
    ({f"{PIEZO}.gain": 20.0}, f"{FSM}.range_rad"),
    ({f"{FSM}.stack_scale_m_per_v": 8e-6}, f"{FSM}.hysteresis.gains_m_per_v"),
    ({f"{DAC}.transport": "rtu"}, f"{DAC}.serial_port"),
    ({f"{DAC}.baud_rate": 9600, f"{DAC}.transport": "rtu", f"{DAC}.serial_port": "/dev/ttyS0"},
     "camera.frame_rate_hz"),
    ({f"{DAC}.writes_per_frame": 4}, "camera.frame_delay_s"),
    ({f"{PIEZO}.poll_s": 20.0}, "interlocks.piezo_limit.stale_s"),
    # pointing
    ({f"{SEARCH}.confirm_timeout_s": 0.08}, f"{SEARCH}.found_frames"),
    ({f"{SEARCH}.found_frames": 100}, f"{SEARCH}.confirm_timeout_s"),
    ({"camera.frame_delay_s": 3.3}, f"{SEARCH}.confirm_timeout_s"),
    ({"loops.right.coarse.gain_rad_per_m": 500_000.0}, "camera.frame_delay_s"),
    ({"loops.right.vernier.fslq.crossover_hz": 40.0}, "camera.frame_rate_hz"),
    # interlocks
    ({"interlocks.dac_watchdog.high": 0.01}, "camera.frame_rate_hz"),
    ({"interlocks.following_error.high": 1.5}, f"{SERVO}.following_error_limit_rad"),
    ({"interlocks.piezo_limit.stale_s": 0.5}, f"{PIEZO}.poll_s"),
    ({"interlocks.frame_interval.low": 1.6}, "interlocks.frame_interval.high"),
    # logging
    ({"logging.retain_bytes": 1_000_000_000}, "logging.rotate_bytes"),
    ({"logging.rotate_bytes": 100_000}, "logging.chunk_bytes"),
    # places
    ({"service.command_port": 7421}, "service.telemetry_port"),
    ({f"{PIEZO}.port": "socket://127.0.0.1:29536"}, f"{DRIVE}.channel"),
    ({"mocks.bench_port": 29502}, "mocks.loops.right.modbus_port"),
    ({"service.metrics_port": 7420, "service.tcp_address": "10.0.0.5"}, "service.command_port"),
]  # fmt: skip


def names(of):
    if isinstance(of, str):
        return of
    return ",".join(f"{key.rpartition('.')[2]}={value}" for key, value in of.items())


@pytest.mark.parametrize(("changes", "contradicted"), CONTRADICTIONS, ids=names)
def test_a_contradiction_names_the_changed_key_first_and_then_the_other(changes, contradicted):
    line = refusal(ONE_STAR, changes)
    assert line.startswith(f"my.toml: {next(iter(changes))}: must be ")
    assert contradicted in re.findall(r", (?:or|beside) (\S+) ", line)


TESTBED_CONTRADICTIONS = [
    ({"loops.metrology.acquisition.search_radius_sky_arcsec": 1600.0},
     "loops.metrology.siderostat.travel_sky_arcsec"),
    ({"loops.metrology.sensor.device.range_v": 1.0}, "loops.metrology.sensor.saturated_v"),
    ({"loops.metrology.hold.crossover_hz": 20.0}, "loops.metrology.sensor.link_delay_s"),
    ({"interlocks.diode_samples.high": 0.01}, "loops.metrology.sensor.link_delay_s"),
    ({"collector.hexapod.travel.z_mm": [-50.0, 50.0]}, "collector.hexapod.stage"),
    ({"collector.hexapod.velocity_limit_mm_s": 80.0}, "collector.hexapod.stage"),
    ({"collector.motion.velocity_mm_s": 9.0}, "collector.hexapod.velocity_limit_mm_s"),
    ({"collector.motion.frequency_hz": 5.0, "collector.motion.kind": "sine"},
     "collector.motion.amplitude_mm"),
    ({"loops.left.fsm.dac.port": 29502}, "loops.right.fsm.dac.first_register"),
    ({"loops.left.fsm.piezo.port": "socket://127.0.0.1:29693"}, "loops.right.fsm.piezo.port"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "contradicted"), TESTBED_CONTRADICTIONS, ids=names)
def test_so_does_one_in_the_testbed(changes, contradicted):
    line = refusal(RIGS["fit-testbed"], changes)
    assert line.startswith(f"my.toml: {next(iter(changes))}: must be ")
    assert f", or {contradicted} must be " in line


@pytest.mark.parametrize(
    ("changes", "contradicted"),
    [
        ({f"{MOTORS}.travel_sky_arcsec": 1200.0}, f"{MOTORS}.encoder_counts_per_rev"),
        ({f"{MOTORS}.encoder_counts_per_rev": 8000}, f"{MOTORS}.travel_sky_arcsec"),
        ({f"{DRIVE}.velocity_rad_s_per_v": {"az": 6.0, "el": -3.0}}, f"{MOTORS}.velocity_limit_rad_s"),
        ({f"{MOTORS}.velocity_limit_rad_s": 70.0}, f"{DRIVE}.velocity_rad_s_per_v.az"),
        ({f"{DRIVE}.first_input_register": 2}, f"{DRIVE}.first_output_register"),
    ],
)  # fmt: skip
def test_so_does_one_of_analogue_amplifiers(changes, contradicted):
    line = complaints(changed(RIGS["fit-bal-analog"], changes))[0]
    assert line.startswith(f"my.toml: {next(iter(changes))}")
    assert contradicted in line


@pytest.mark.parametrize(
    ("key", "value", "demand"),
    [
        ("loops.right.flux_range.low", 1.2, "below 1"),
        ("loops.right.flux_range.high", 0.9, "above 1"),
        ("interlocks.flux_low.low", 1.5, "below 1"),
        ("interlocks.fsm_edge.high", 1.0, "below 1"),
        ("interlocks.frame_interval.high", 0.9, "above 1"),
        ("interlocks.amplifier_fault.high", 1.0, "below 1"),
        (f"{PIEZO}.follow_tolerance_v", 100.0, "below 75.25"),
    ],
)
def test_a_limit_that_always_or_never_holds_is_refused(key, value, demand):
    assert refusal(ONE_STAR, {key: value}).startswith(f"my.toml: {key}: must be {demand}")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (f"{SERVO}.reading_timeout_s", 1e-308),
        (f"{SERVO}.following_error_limit_rad", 1e-308),
        ("loops.right.flux_range.low", 1e-308),
        (f"{SERVO}.gain_per_s", 1e-308),
        (f"{FSM}.range_rad", 1e308),
        (f"{FSM}.bias_v", 1e308),
        ("camera.pixel_noise_dn", 1e308),
        ("loops.right.star_flux_dn", 1e308),
        ("loops.right.vernier.fslq.crossover_hz", 1e308),
    ],
)
def test_no_line_has_an_infinite_number_or_one_of_many_digits(key, value):
    line = refusal(ONE_STAR, {key: value})
    assert line.startswith(f"my.toml: {key}: must be ")
    assert not re.search(r"\binf\b|[0-9]{20}", line)


@pytest.mark.parametrize(
    ("interface", "why"),
    [
        ("udp_multicast", "its frames can leave the machine"),
        ("socketcand", "it needs a host and a port beside the channel"),
    ],
)
def test_a_can_interface_that_no_drive_can_have_is_refused_with_the_reason(interface, why):
    line = refusal(ONE_STAR, {f"{DRIVE}.interface": interface})
    assert line.startswith(f"my.toml: {DRIVE}.interface: must not be {interface}: {why}; choose")


def test_an_integer_is_offered_where_an_integer_is_wanted(tmp_path):
    line = refusal(ONE_STAR, {"logging.rotate_bytes": 1_000_000_000_000})
    most = re.search(r"rotate_bytes: must be at most (\S+) \(", line)[1]
    least = re.search(r"retain_bytes must be at least (\S+) \(", line)[1]

    assert most.isdecimal()
    assert least.isdecimal()
    assert complaints(changed(ONE_STAR, {"logging.rotate_bytes": int(most)})) == []


def test_a_spot_in_the_stars_own_window_is_refused():
    (spot,) = ONE_STAR["loops"]["right"]["other_spots"]
    near = spot | {"offset_px": {"az": 2.0, "el": -3.0}}
    line = refusal(ONE_STAR, {"loops.right.other_spots": [near]})
    assert "loops.right.other_spots: must be more than 3 px away" in line
    assert "fringe" in line


def advised(line):
    """A value that the line allows for the key that it blames."""
    key, demand = re.match(r"my\.toml: (\S+): must be (.*?) \(is ", line).groups()
    word, number = re.match(
        r"(at most|at least|below|above|from)? ?(-?[0-9.e+-]+)", demand
    ).groups()
    margin = {"below": 1 - 1e-9, "above": 1 + 1e-9}.get(word, 1)
    return key, float(number) * margin


NUMERIC = [
    changes for changes, _ in CONTRADICTIONS if isinstance(next(iter(changes.values())), float)
]


def reason(line):
    """Why a line refuses, whatever the figures."""
    return re.sub(r"[-+]?[0-9][0-9.e+-]*", "#", line.partition("; ")[2])


@pytest.mark.parametrize("changes", NUMERIC, ids=names)
def test_a_value_that_the_line_allows_is_not_refused_for_the_same_reason(changes):
    line = refusal(ONE_STAR, changes)
    key, value = advised(line)
    after = complaints(changed(ONE_STAR, changes | {key: value}))
    assert reason(line) not in map(reason, after)


# ---------------------------------------------------------------- whose value it is


def test_of_two_files_the_one_on_top_is_to_blame(tmp_path):
    base = tmp_path / "base.toml"
    base.write_text(default_rig_path().read_text().replace("stale_s = 0.15", "stale_s = 0.2"))
    mine = tmp_path / "mine.toml"
    mine.write_text('base = "base.toml"\n[camera]\nframe_delay_s = 0.18\n')
    with pytest.raises(ConfigError) as caught:
        load_rig(mine)
    assert str(caught.value).startswith(f"{mine}: camera.frame_delay_s: must be below 0.16 ")


def test_a_mistake_of_the_base_is_named_with_the_base(tmp_path):
    base = tmp_path / "base.toml"
    base.write_text(default_rig_path().read_text().replace("width_px = 40", "width_px = 4"))
    mine = tmp_path / "mine.toml"
    mine.write_text('base = "base.toml"\n[camera]\nframe_delay_s = 0.03\n')
    with pytest.raises(ConfigError, match=rf"^{base}: camera\.width_px: must be "):
        load_rig(mine)


def test_a_fragment_that_contradicts_the_rig_is_to_blame_and_one_that_repeats_it_is_not(tmp_path):
    (tmp_path / "late.toml").write_text("[camera]\nframe_delay_s = 0.2\nexposure_s = 0.01\n")
    (tmp_path / "same.toml").write_text("[interlocks.star_lost]\nstale_s = 0.15\n")
    mine = tmp_path / "mine.toml"
    mine.write_text(
        'include = ["late.toml", "same.toml"]\n' + default_rig_path().read_text(encoding="utf-8")
    )
    with pytest.raises(ConfigError) as caught:
        load_rig(mine)
    assert str(caught.value).startswith(f"{tmp_path / 'late.toml'}: camera.frame_delay_s: must be")


def test_what_is_set_is_to_blame_before_what_any_file_says():
    with pytest.raises(ConfigError) as caught:
        load_rig(default_rig_path(), ["interlocks.frame_missing.stale_s=0.07"])
    assert str(caught.value).startswith("--set: interlocks.frame_missing.stale_s: must be above")


def test_several_contradictions_are_several_lines_each_with_its_own_key():
    lines = complaints(
        changed(ONE_STAR, {f"{SERVO}.gain_per_s": 300.0, f"{FSM}.bias_v": 5.0, f"{PIEZO}.gain": 20.0})
    )  # fmt: skip
    assert [line.split(": ")[1] for line in lines] == [f"{SERVO}.gain_per_s", f"{PIEZO}.gain"]
