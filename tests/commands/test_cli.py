"""The commands as a stranger meets them: help, results on standard output, one line for what is wrong."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from fitctl import __main__ as entry_point
from fitctl import __version__
from fitctl.cli import COMMANDS, main
from fitctl.config import default_rig_path


def fitctl(*arguments, timeout_s=60):
    return subprocess.run(
        [sys.executable, "-m", "fitctl", *map(str, arguments)],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=timeout_s,
        check=False,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help_text(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])

    assert end.value.code == 0
    text = capsys.readouterr().out
    assert "Usage" in text
    assert len(text.splitlines()) > 5


def test_the_version_is_said():
    said = fitctl("--version")

    assert said.returncode == 0
    assert said.stdout == f"fitctl {__version__}\n"


def test_help_and_completion_of_commands_do_not_import_what_is_slow():
    slow = ("numpy", "scipy", "control", "textual", "zmq", "can", "pydantic", "pymodbus")
    probe = (
        "import sys, fitctl.cli\n"
        "try: fitctl.cli.main(['--help'])\n"
        f"finally: print([m for m in {slow} if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", probe], capture_output=True, text=True, check=True
    )

    assert result.stdout.splitlines()[-1] == "[]"


@pytest.mark.long
def test_a_console_without_a_terminal_says_what_to_use_instead():
    result = fitctl("console", timeout_s=20)

    assert result.returncode == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    for instead in ("needs a terminal", "fitctl watch", "fitctl status", "--web"):
        assert instead in line


BAD_INPUT = {
    "an unknown key": (["check", "--set", "camera.frame_rate=3"], "camera.frame_rate: unknown key"),
    "a value out of range": (["check", "--set", "camera.frame_rate_hz=-3"], "camera.frame_rate_hz"),
    "a value of a wrong type": (["check", "--set", "camera.width_px=wide"], "camera.width_px"),
    "a missing rig file": (["check", "--rig", "no-such.toml"], "no-such.toml: no such rig file"),
    "a --set without a value": (["check", "--set", "camera.width_px"], "expected key.path=value"),
    "a log that is not there": (["log", "info", "no-such.mcap"], "no-such.mcap"),
    "a command that is none": (["send", "explode"], "unknown command 'explode'"),
    "a negative duration": (["simulate", "--duration", "-3"], "duration"),
    "a negative seed": (["simulate", "--seed", "-1"], "seed"),
    "a loop that is none": (
        ["send", "off", "--loop", "left", "--rig", str(default_rig_path())],
        "has right",
    ),
    "a loop for a command of the rig": (
        ["send", "shutdown", "--loop", "right"],
        "send: shutdown is for the whole rig; expected no loop, got right",
    ),
    "a log folder that is none": (["run", "--set", "logging.folder=/dev/null/x"], "logging.folder"),
    "a servo that would swing": (
        ["check", "--set", "loops.right.siderostat.servo.rate_hz=50.0"],
        "servo.rate_hz: must be at least 337.5",
    ),
    "a frame limit below the delay": (
        ["check", "--set", "camera.frame_delay_s=0.3"],
        "camera.frame_delay_s: must be below 0.11",
    ),
    "a stack that cannot be": (
        ["simulate", "--set", "plant.loops.right.hysteresis.breakpoints_v=[0.0, 0.1]"],
        "lower it",
    ),
    "a history beyond memory": (
        ["check", "--set", "plant.step_s=1e-6", "--set", "plant.history_s=3600.0"],
        "history_s may be at most",
    ),
    "a table that is none": (["check", "--set", "camera.width_px.of=3"], "is not a table"),
    "a group without a command": (["fault"], "fitctl fault: expected a command: set, clear, now"),
    "an option that is none": (["demo", "--fast"], "--fast"),
    "an option that is misspelt": (
        ["status", "--jsn"],
        "fitctl status: No such option: --jsn; did you mean --json or --set? (see fitctl status --help)",
    ),
    "a command that is not there": (["point"], "point"),
    "a broadcast address that is none": (
        ["discover", "--broadcast", "300.1.1.1"],
        "discover: --broadcast 300.1.1.1: expected an IPv4 address",
    ),
    "a way to draw that there is not": (
        ["console", "--graphics", "ascii"],
        "(env var: 'FITCTL_GRAPHICS'): 'ascii' is not one of 'auto', 'half-blocks', 'sixel', 'kitty' (see",
    ),
    "a rehearsal of what is no command": (["rehearse", "jog", "a", "1"], "rehearse: jog a 1: "),
    "a word that is no number": (["simulate", "--duration", "long"], "--duration"),
    "more runs than anybody waits for": (["simulate", "--runs", "9" * 20], "--runs"),
    "an option without its value": (["console", "--log"], "fitctl console: Option '--log'"),
    "a controller that is none": (
        ["simulate", "--controller", "minvar"],
        "--controller: loops.right.vernier.controller: must be one of",
    ),
}


# How a line says what was expected, or what to do now.
NEXT_STEPS = (
    *(
        "must be",
        "may be at most",
        "expected",
        "did you mean",
        "there are",
        "Available: ",
        "rig fit-mock has",
    ),
    *("name another", "choose another", "lower it", "logs are", "(see fitctl"),
)


def names_a_next_step(line):
    return any(words in line for words in NEXT_STEPS)


@pytest.mark.parametrize("what", BAD_INPUT)
def test_bad_input_gets_a_clear_line_and_status_2(what, capfd):
    arguments, complaint = BAD_INPUT[what]
    with pytest.raises(
        SystemExit
    ) as end:  # in this process: an interpreter for each takes a second
        main(arguments)

    printed = capfd.readouterr()
    assert end.value.code == 2
    assert complaint in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert names_a_next_step(printed.err), printed.err
    assert printed.out == ""


def test_ctrl_c_during_the_imports_ends_without_a_traceback(monkeypatch):
    def find_spec(name, *_):
        if name == "fitctl.cli":
            raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "fitctl.cli")
    monkeypatch.setattr(sys, "meta_path", [SimpleNamespace(find_spec=find_spec), *sys.meta_path])
    with pytest.raises(SystemExit) as end:
        entry_point.main()

    assert end.value.code == 130


@pytest.mark.parametrize("arguments", [["--help"], ["check", default_rig_path()]])
@pytest.mark.long
def test_output_that_a_full_disk_refuses_gets_a_clear_line(arguments):
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "fitctl", *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
        )

    assert result.returncode == 1
    assert result.stderr == (
        "fitctl: its output cannot be written: No space left on device; free some space, or direct it to "
        "another disk\n"
    )


@pytest.mark.long
def test_bad_input_ends_a_process_with_a_clear_line_and_status_2():
    arguments, complaint = BAD_INPUT["an unknown key"]
    result = fitctl(*arguments)

    assert result.returncode == 2
    assert complaint in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert result.stdout == ""


@pytest.mark.long
def test_a_rig_file_that_is_not_toml_or_not_text_gets_a_clear_line(tmp_path):
    for content in (b"[camera\nwidth", b"\xff\xfe\x00"):
        path = tmp_path / "bad.toml"
        path.write_bytes(content)
        result = fitctl("check", "--rig", path)

        assert result.returncode == 2
        assert str(path) in result.stderr
        assert len(result.stderr.strip().splitlines()) == 1
        assert names_a_next_step(result.stderr), result.stderr


@pytest.mark.long
def test_simulate_prints_one_json_object_on_its_last_line():
    result = fitctl("simulate", "--duration", 25, "--seed", 4, "--json")

    summary = json.loads(result.stdout.splitlines()[-1])
    assert result.returncode == 0
    assert summary.keys() >= {"rms_px", "measured_rms_px", "mode_times", "speed_x"}
    assert sum(summary["mode_times"].values()) == pytest.approx(25, abs=0.1)


@pytest.mark.long
def test_simulate_that_finds_no_star_says_so_by_its_status_and_null():
    result = fitctl(
        "simulate", "--duration", 12, "--json", "--set", "loops.right.star_flux_dn=120000.0"
    )

    assert result.returncode == 1
    assert json.loads(result.stdout.splitlines()[-1])["vernier_s"] is None


@pytest.mark.long
def test_simulate_that_is_too_short_says_so_in_one_line():
    result = fitctl("simulate", "--duration", 5)

    assert result.returncode == 1
    assert "VERNIER not reached within 5 s; use a longer --duration" in result.stdout
    assert len(result.stdout.splitlines()) == 1


@pytest.mark.long
def test_console_and_send_without_a_supervisor_say_how_to_start_one(tmp_path):
    result = fitctl("send", "status", "--set", f"service.folder={tmp_path}")

    assert result.returncode == 1
    assert "fitctl run" in result.stderr


@pytest.mark.long
def test_mocks_on_a_taken_port_say_so():
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = fitctl(
            "mocks",
            *(
                part
                for key in (
                    "gvcp_port",
                    "bench_port",
                    "loops.right.slcan_port",
                    "loops.right.mdt693_port",
                )
                for part in ("--set", f"mocks.{key}=0")
            ),
            "--set",
            f"mocks.loops.right.modbus_port={port}",
        )

    assert result.returncode == 2
    assert "port is in use" in result.stderr
    assert "Traceback" not in result.stderr
