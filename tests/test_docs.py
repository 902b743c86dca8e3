"""The documentation is true: its commands are there, those that can be are run, and its Python runs too."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import typer
from documents import (
    ROOT,
    blocks,
    commands,
)

from fitctl.cli import app
from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import QuantityReading, RecorderStatus
from fitctl.logging.writer import LogWriter
from fitctl.supervisor.command_table import command_of
from fitctl.supervisor.messages import Acquire, Shutdown, Status
from fitctl.supervisor.modes import Mode
from fitctl.supervisor.run import run_info
from fitctl.supervisor.simulate import Simulation

MAKE_TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
CLI = typer.main.get_command(app)
# Programs that are not ours: that they are called is all that is checked, or that they are installed.
OUTSIDE = {
    "git",
    "cd",
    "cp",
    "sudo",
    "uv",
    "pip",
    "pipx",
    "python3",
    "export",
    "source",
    "ssh",
    "tmux",
}
INSTALLED = {"rerun", "pymcap-cli", "pytest", "python", "ruff", "mypy"}
LONGEST_RUN_S = 60.0  # of virtual time
NEARBY_PX = np.array([30.0, -10.0])  # a star that is found and held within 20 s


def ours():
    return [found for found in commands() if found.words[0] == "fitctl"]


def runnable(found):
    """Whether it ends by itself, soon, without hardware, terminal or supervisor."""
    match found.words[1:]:
        case ["--help"] | ["check" | "log", *_] | [_, "--help"] | ["replay", _]:
            return True
        case ["init", *options]:
            return "--no-doctor" in options
        case ["simulate", *options] if "--duration" in options:
            return float(options[options.index("--duration") + 1]) <= LONGEST_RUN_S
    return False


def parsed(name, arguments):
    """The options of a subcommand; raises if it does not know one or its value is wrong."""
    return CLI.commands[name].make_context(name, list(arguments)).params


# ---------------------------------------------------------------- a folder to run things in


@pytest.fixture(scope="module")
def sample_log(tmp_path_factory):
    """What a recorder would have written of the first 20 s, but on the virtual clock."""
    rig = load_rig(default_rig_path())
    path = tmp_path_factory.mktemp("sample") / "sample.mcap"
    info = run_info(rig, "simulated", now_s=0.0)

    def log_time_s():
        return simulation.clock.now_s() + info.wall_minus_monotonic_s

    with LogWriter(path, rig.logging) as log:
        log.write(info, info.wall_minus_monotonic_s)
        simulation = Simulation(
            rig,
            seed=1,
            star_offset_px=NEARBY_PX,
            record=lambda record: log.write(record, log_time_s()),
        )
        simulation.acquire()
        simulation.run(20.0)
        now_s = simulation.clock.now_s()
        status = RecorderStatus(time_s=now_s, path=str(path), records=1, lost=0, bytes_written=1)
        log.write(status, log_time_s())
        disk = QuantityReading(time_s=now_s, name="disk_free_bytes", value=1e12)
        log.write(disk, log_time_s())
    return path


@pytest.fixture
def checkout(tmp_path, sample_log):
    """A folder that looks to a command as a checkout does: rig files, and logs of every name."""
    shutil.copytree(ROOT / "rigs", tmp_path / "rigs")
    shutil.copy(ROOT / "rigs" / "fit-mock.toml", tmp_path / "my-rig.toml")
    (tmp_path / "logs").mkdir()
    shutil.copy(sample_log, tmp_path / "logs" / sample_log.name)
    return tmp_path


# ---------------------------------------------------------------- commands


@pytest.mark.parametrize("found", commands(), ids=str)
def test_every_command_exists_with_its_options(found):
    program, *arguments = found.words
    if program == "fitctl":
        if not arguments or arguments[0].startswith("-"):
            known = {option for parameter in CLI.params for option in parameter.opts}
            assert set(arguments) <= known | {"--help"}
            return
        assert arguments[0] in CLI.commands, f"fitctl has no command {arguments[0]}"
        if arguments[0] == "send" and "--help" not in arguments:
            sent_command(arguments[1:])
        with contextlib.suppress(typer.Exit):  # --help
            parsed(arguments[0], arguments[1:])
    elif program == "make":
        assert {word for word in arguments if "=" not in word} <= MAKE_TARGETS
    elif program in INSTALLED:
        assert (Path(sys.executable).parent / program).exists()
    else:
        assert program in OUTSIDE, f"{program}: add it to OUTSIDE if it should be there"


def sent_command(words):
    options = parsed("send", words)
    return command_of(options["command"], options["values"] or [], options["loop"])


def masked(lines):
    """Lines with every number, length of space and file name replaced: what stays when values change."""
    texts = (re.sub(r"\S+\.mcap", "LOG", line) for line in lines)
    return [re.sub(r"\s+", " ", re.sub(r"\d[\d.:-]*", "#", text)).strip() for text in texts]


@pytest.mark.parametrize("found", filter(runnable, ours()), ids=str)
def test_quick_commands_run_and_print_what_the_document_shows(found, checkout):
    for before, word in pairwise(found.words):
        if word.endswith(".mcap") and before != "--out":
            shutil.copy(checkout / "logs" / "sample.mcap", checkout / word)

    done = subprocess.run(
        [sys.executable, "-m", *found.words],
        cwd=checkout,
        env=os.environ | {"COLUMNS": "80", "TERM": "dumb"},
        capture_output=True,
        text=True,
        timeout=110,  # a batch compiles its kernels first
        check=False,
    )

    printed = done.stdout + done.stderr
    shows_a_mistake = any("unknown key" in line for line in found.output)
    assert done.returncode == (2 if shows_a_mistake else 0), printed
    assert set(masked(found.output)) <= set(masked(printed.splitlines())), printed
    if "--json" in found.words:
        json.loads(done.stdout)


def test_the_mocks_print_the_endpoints_that_the_documents_show():
    documented = next(c.output for c in ours() if c.words[1:2] == ("mocks",) and c.output)
    arguments = [sys.executable, "-m", "fitctl", "mocks", "--free-ports"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as mocks:
        try:
            printed = [mocks.stdout.readline() for _ in documented]
            mocks.send_signal(signal.SIGINT)
            assert mocks.wait(20) == 0
        finally:
            mocks.kill()

    assert masked(printed) == masked(documented)


def test_the_session_in_operating_is_what_the_supervisor_answers():
    simulation = Simulation(load_rig(default_rig_path()), seed=0, star_offset_px=NEARBY_PX)
    for found in ours():
        if found.document.name != "operating.md" or found.words[1] != "send" or not found.output:
            continue
        command = sent_command(found.words[2:])
        if isinstance(command, Status):
            answer = ", ".join(
                f"{n} {loop.mode.name}" for n, loop in simulation.supervisor.loops.items()
            )
        else:
            reply = simulation.command(command)
            answer = reply.text or ("accepted" if reply.accepted else "refused")
        assert found.output == (answer,), str(found)
        if (
            isinstance(command, Acquire)
            and simulation.supervisor.loops["right"].mode is Mode.ACQUISITION
        ):
            simulation.run(20.0)
        if isinstance(command, Shutdown):
            return
    pytest.fail("operating.md shows no session that ends in a shutdown")


@pytest.mark.parametrize("name", [name for name, c in CLI.commands.items() if not c.hidden])
def test_every_command_is_documented_and_has_help(name, capsys):
    assert any(found.words[1:2] == (name,) for found in ours()), f"no document shows fitctl {name}"
    with pytest.raises(typer.Exit):
        parsed(name, ["--help"])
    assert "Usage:" in capsys.readouterr().out


@pytest.mark.parametrize("block", blocks("python"), ids=str)
def test_python_blocks_run_on_a_log(block, checkout):
    done = subprocess.run(
        [sys.executable, "-c", block.text],
        cwd=checkout,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert "nan" not in done.stdout
