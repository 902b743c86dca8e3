"""`fitctl check`: what it says of a sound rig, and where each value of it comes from."""

import json
import tomllib

import pytest

from fitctl.cli import main
from fitctl.config import default_rig_path, load_rig
from fitctl.config.simulated import mixture, places

SHIPPED = sorted(default_rig_path().parent.glob("*.toml"))
TESTBED = default_rig_path().with_name("fit-testbed.toml")
REAL_MOTORS = "loops.right.siderostat.device.channel=/dev/ttyACM0"
REAL_CAMERA = "camera.device.address=192.168.1.20"
REAL_DAC = "loops.right.fsm.dac.host=192.168.1.31"
REAL_PIEZO = "loops.right.fsm.piezo.port=/dev/ttyUSB2"


@pytest.fixture
def check(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["check", *map(str, arguments)])
        assert not end.value.code
        return capsys.readouterr().out.splitlines()

    return run


def origins(lines):
    """The origin that `--show` prints behind each key."""
    return {line.split(" = ")[0]: line.rpartition(" # ")[2] for line in lines}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_what_show_prints_is_a_rig_file_that_says_the_same(path, check, tmp_path):
    shown = tmp_path / "shown.toml"
    shown.write_text("\n".join(check("--rig", path, "--show")))

    assert load_rig(shown) == load_rig(path)


def test_each_value_is_shown_with_the_file_or_option_that_says_it(check, tmp_path):
    base, fragment, mine = (tmp_path / name for name in ("base.toml", "delay.toml", "mine.toml"))
    base.write_bytes(default_rig_path().read_bytes())
    fragment.write_text("[camera]\nframe_delay_s = 0.03\n")
    mine.write_text('base = "base.toml"\ninclude = ["delay.toml"]\nname = "mine"\n')
    shown = origins(
        check("--rig", mine, "--show", "--set", "loops.right.target_px={az=20.0, el=20.0}")
    )

    assert shown["name"] == str(mine)
    assert shown["camera.width_px"] == f"{base} (base)"
    assert shown["camera.frame_delay_s"] == f"{fragment} (include)"
    assert shown["loops.right.target_px.az"] == "--set"
    assert shown["loops.right.sensor"] == "default"


def test_a_device_of_another_kind_comes_from_the_file_that_names_it(check):
    shown = origins(check("--rig", default_rig_path().with_name("ensemble.toml"), "--show"))

    device = {key: origin for key, origin in shown.items() if ".siderostat.device." in key}
    assert "loops.right.siderostat.device.axes" in device
    assert {origin.rpartition("/")[2] for origin in device.values()} == {"ensemble.toml"}


def test_every_value_of_the_file_is_shown(check):
    def keys(table, place=()):
        for key, value in table.items():
            yield from keys(value, (*place, key)) if isinstance(value, dict) else [(*place, key)]

    in_file = {".".join(path) for path in keys(tomllib.loads(default_rig_path().read_text()))}
    assert in_file <= origins(check("--show")).keys()


def test_a_program_gets_each_value_with_its_origin(check):
    shown = json.loads("\n".join(check("--show", "--json", "--set", "camera.frame_delay_s=0.036")))
    assert shown["rig"] == "fit-mock"
    assert shown["values"]["camera.frame_delay_s"] == {"value": 0.036, "origin": "--set"}
    assert shown["values"]["camera.exposure_s"]["origin"].endswith("fit-mock.toml")


# ---------------------------------------------------------------- mocks and hardware in one rig


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_of_a_rig_of_mocks_there_is_nothing_to_warn(path, check):
    rig = load_rig(path)
    assert all(place.simulated for place in places(rig).values())
    assert len(check("--rig", path)) == 1


def test_of_a_rig_of_hardware_there_is_nothing_to_warn():
    rig = load_rig(default_rig_path(), [REAL_MOTORS, REAL_CAMERA, REAL_DAC, REAL_PIEZO])
    rig = rig.model_copy(update={"plant": None, "mocks": None})
    assert not any(place.simulated for place in places(rig).values())
    assert mixture(rig) == []


@pytest.mark.parametrize(
    ("real", "warning"),
    [
        ([REAL_MOTORS], "loop right: right siderostat real, camera simulated: "),
        ([REAL_MOTORS, REAL_DAC, REAL_PIEZO], "right siderostat and right D/A real, camera simulated"),
        ([REAL_CAMERA], "camera real, right siderostat and right D/A simulated"),
        ([REAL_CAMERA, REAL_MOTORS, REAL_DAC], "nothing checks the voltage limit of the amplifier"),
        ([REAL_CAMERA, REAL_MOTORS], "camera real, right D/A simulated"),
    ],
)  # fmt: skip
def test_hardware_that_a_mock_does_not_see_is_warned_of(real, warning, check):
    well, who, *warnings = check(*(part for each in real for part in ("--set", each)))

    assert ": well; rig fit-mock" in well
    assert who.startswith("real: ")
    assert any(line.startswith("warning: ") and warning in line for line in warnings)


@pytest.mark.parametrize("channel", ["[0", "a\u2100b"])
def test_a_channel_that_cannot_be_read_as_a_host_is_hardware(check, channel):
    device = "loops.right.siderostat.device"
    lines = check("--set", f"{device}.interface=kvaser", "--set", f"{device}.channel='{channel}'")

    assert "real: right siderostat; simulated: camera, right D/A, right piezo amplifier" in lines


def test_real_motors_of_the_metrology_need_real_photodiodes():
    rig = load_rig(TESTBED, ["loops.metrology.siderostat.device.channel=/dev/ttyACM0"])
    assert any(
        "metrology siderostat real, metrology photodiodes simulated" in line
        for line in mixture(rig)
    )


def test_one_real_device_without_a_stage_or_sensor_is_named_and_no_more():
    rig = load_rig(default_rig_path(), [REAL_PIEZO])
    assert mixture(rig) == [
        "real: right piezo amplifier; simulated: camera, right siderostat, right D/A"
    ]
