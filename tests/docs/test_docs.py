"""The documentation is true: its commands are there, those that can be are run, and its Python runs too."""

import contextlib
import json
import re
import shutil
import signal
import subprocess
import sys
from fnmatch import fnmatchcase
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
from samples.logged_simulation import designs_of

from fitctl.cli import COMMANDS, app, load_command, main
from fitctl.config import default_rig_path, load_rig
from fitctl.daemon.run import run_info
from fitctl.logging.records import QuantityReading, RecorderStatus
from fitctl.logging.writer import LogWriter
from fitctl.messages.command_table import command_of
from fitctl.messages.commands import Acquire, Shutdown, Status
from fitctl.messages.modes import Mode
from fitctl.simulation.simulation import Simulation

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
INSTALLED = {"rerun", "pymcap-cli", "pytest", "python", "ruff", "pyrefly"}
NEARBY_PX = np.array([30.0, -10.0])  # a star that is found and held within 20 s
# Every documented command that the test below does not run, and why; a test named here runs its like.
NOT_RUN = {
    "fitctl commission --console*": "wants a terminal: tests/tui/views/test_commissioning.py",
    "fitctl commission --rig*": "asks a person, or wants mocks: tests/miswired/test_miswired.py",
    "fitctl console*": "wants a terminal: tests/system/screens.py",
    "fitctl demo*": "a whole instrument, in real time: tests/system/alone/test_demos.py",
    "fitctl fault clear": "needs running mocks: tests/commands/try_out/test_cli_fault.py",
    "fitctl fault now": "needs running mocks: tests/commands/try_out/test_cli_fault.py",
    "fitctl fault set *": "needs running mocks: tests/commands/try_out/test_cli_fault.py",
    "fitctl figures *": "takes minutes: tests/figures/test_figures.py makes them with --quick's amounts",
    "fitctl identify feedforward *": "needs a scan's log: tests/sequences/behaviours/test_scans.py",
    "fitctl identify hysteresis*": "needs a star, or its log: tests/commands/design/test_cli_identify.py",
    "fitctl init my-rig.toml": "asks a person on a terminal: tests/commands/set_up/test_cli_init.py",
    "fitctl mocks*": "a server: tests/commands/set_up/test_cli_doctor.py, and below",
    "fitctl plot *--window": "opens a window: tests/commands/analyse/test_cli_report.py without a display",
    "fitctl rehearse *": "needs an instrument that runs: tests/commands/operate/test_rehearse.py",
    "fitctl report *--open": "opens a browser: tests/commands/analyse/test_cli_report.py opens none",
    "fitctl rig upgrade *": "needs a file of an older version: tests/config/test_config_upgrade.py",
    "fitctl run*": "a server: tests/system/test_first_light.py",
    "fitctl send *": "needs a running supervisor: tests/system/test_tutorial.py, and below",
    "fitctl sequence pause*": "needs a running supervisor: tests/system/test_sequences.py",
    "fitctl sequence resume": "needs a running supervisor: tests/system/test_sequences.py",
    "fitctl sequence run *": "needs a running supervisor: tests/system/test_tutorial.py",
    "fitctl sequence end": "needs a running supervisor: tests/system/test_sequences.py",
    "fitctl simulate --runs 100 *": "as in designing.md, which is run",
    "fitctl status*": "needs a running supervisor: tests/system/test_tutorial.py",
    "fitctl watch*": "needs a running supervisor: tests/system/test_tutorial.py",
    "make *": "runs these tests, measures for minutes, or stays; its targets are looked up",
    "pipx *": "installs: tests/dist/test_dist.py with pip",
    "python -m *": "measures for minutes",
    "source *": "its shell's own",
    "sudo *": "for root, on the rig's machine",
}
# What the reader's own rig file says by then, that nothing leaves this machine, and that few runs show as much.
ALSO_SAID = {
    "fitctl simulate --runs *": ("--runs", "2"),
    "fitctl discover": ("--broadcast", "127.0.0.1"),
    "fitctl keys *": (
        *("--set", "service.tcp_address=10.0.0.5"),
        *("--set", "service.keys_folder=keys"),
    ),
}
# Where an answer other than "well" is what the document tells of.
STATUSES = {
    "fitctl doctor": {0, 1},  # no device is there, unless somebody's mocks are
    "* --set camera.frame_rate=50": {2},  # the document shows the mistake
    "* --set camera.frame_delay_s=0.2": {2},  # likewise
}


def ours():
    return [found for found in commands() if found.words[0] == "fitctl"]


def rows_of(table, found):
    """What a table has for a command: the values whose patterns its words fit."""
    line = " ".join(found.words)
    return [value for pattern, value in table.items() if fnmatchcase(line, pattern)]


def to_run():
    """The commands to be run, by document; what stands on several pages once, but for shown output."""
    met = set()
    by_document = {}
    for found in commands():
        if rows_of(NOT_RUN, found) or (found.words in met and not found.output):
            continue
        met.add(found.words)
        by_document.setdefault(found.document.name, []).append(found)
    return by_document


def parsed(name, arguments):
    """The options of a subcommand; raises if it does not know one or its value is wrong."""
    return load_command(name).make_context(name, list(arguments)).params


# ---------------------------------------------------------------- a folder to run things in


@pytest.fixture(scope="module")
def sample_log(tmp_path_factory):
    """What a recorder would have written of the first 42 s, but on the virtual clock."""
    rig = load_rig(default_rig_path())
    path = tmp_path_factory.mktemp("sample") / "sample.mcap"
    info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))

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
        simulation.run(42.0)  # of which 20 s in VERNIER once it has settled, to learn from
        now_s = simulation.clock.now_s()
        status = RecorderStatus(time_s=now_s, path=str(path), records=1, lost=0, bytes_written=1)
        log.write(status, log_time_s())
        disk = QuantityReading(time_s=now_s, name="disk_free_bytes", value=1e12)
        log.write(disk, log_time_s())
    return path


@pytest.fixture
def checkout(tmp_path, sample_log):
    """A folder that looks to a command as a checkout does: rig files, and a log."""
    shutil.copytree(ROOT / "rigs", tmp_path / "rigs")
    (tmp_path / "logs").mkdir()
    shutil.copy(sample_log, tmp_path / "logs" / sample_log.name)
    return tmp_path


def supply(folder, words):
    """What a command reads and its reader has by then: logs, a rig file of his own, the tutorial's sequence."""
    (sequence,) = (each for each in blocks("TOML") if each.document.name == "tutorial.md")
    for before, word in pairwise(words):
        path = folder / word
        if before == "--out" or "*" in word or path.exists():
            continue
        if path.suffix == ".mcap":
            shutil.copy(folder / "logs" / "sample.mcap", path)
        elif (before, word) == ("--rig", "my-rig.toml"):
            shutil.copy(folder / "rigs" / "fit-mock.toml", path)
        elif word == "first.toml":
            path.write_text(sequence.text)
        elif word == "my_integrator.py":
            (code,) = (each.text for each in blocks("python") if "def design" in each.text)
            path.write_text(code)


# ---------------------------------------------------------------- commands


@pytest.mark.parametrize("found", commands(), ids=str)
def test_every_command_exists_with_its_options(found):
    program, *arguments = found.words
    if program == "fitctl":
        if not arguments or arguments[0].startswith("-"):
            known = {option for parameter in CLI.params for option in parameter.opts}
            assert set(arguments) <= known | {"--help"}
            return
        assert arguments[0] in COMMANDS, f"fitctl has no command {arguments[0]}"
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
    return [
        re.sub(r"\s+", " ", re.sub(r"\d[\d.:-]*(e[+-]\d+)?", "#", text)).strip() for text in texts
    ]


def carried_out(words, folder, capsys):
    """Status, standard output, both outputs; ours within this process: an interpreter each is slow."""
    if words[0] != "fitctl":
        program = Path(sys.executable).parent / words[0]
        done = subprocess.run(
            [program, *words[1:]],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return done.returncode, done.stdout, done.stdout + done.stderr
    with pytest.raises(SystemExit) as ended:
        main(list(words[1:]))
    told = capsys.readouterr()
    return ended.value.code or 0, told.out, told.out + told.err


def expanded(words, folder):
    """The words as a shell gives them on."""
    for word in words:
        named = [] if word.startswith("/") or "*" not in word else sorted(folder.glob(word))
        yield from (str(path.relative_to(folder)) for path in named) if named else (word,)


@pytest.mark.long
@pytest.mark.timeout(600)  # a batch compiles its kernels first
@pytest.mark.parametrize("document", to_run())
def test_commands_run_in_their_order_and_print_what_the_document_shows(
    document, checkout, monkeypatch, capsys
):
    monkeypatch.chdir(checkout)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")
    for found in to_run()[document]:
        supply(checkout, found.words)
        words = [*expanded(found.words, checkout), *sum(rows_of(ALSO_SAID, found), ())]

        status, out, printed = carried_out(words, checkout, capsys)

        (expected,) = rows_of(STATUSES, found) or [{0}]
        assert status in expected, f"{found}: {status}\n{printed}"
        missing = set(masked(found.output)) - set(masked(printed.splitlines()))
        assert not missing, f"{found}: {missing} is not in\n{printed}"
        if "--json" in found.words:
            json.loads(out)


@pytest.mark.long
def test_the_figures_of_a_controller_of_ones_own_are_those_that_its_page_shows(
    checkout, monkeypatch, capsys
):
    monkeypatch.chdir(checkout)
    shown = [found for found in ours() if "my_integrator.py" in found.words and found.output]
    assert {found.words[2] for found in shown} == {"my_integrator.py", "compare"}

    for found in shown:
        supply(checkout, found.words)
        status, out, _ = carried_out(found.words, checkout, capsys)

        assert (status, tuple(out.splitlines())) == (0, found.output)


def test_what_is_not_run_is_documented_and_the_tests_that_run_it_are_there():
    for pattern, reason in NOT_RUN.items():
        assert any(fnmatchcase(" ".join(found.words), pattern) for found in commands()), pattern
        for path in re.findall(r"tests/\S+\.py", reason):
            text = (ROOT / path).read_text()
            said = pattern.replace("*", "").split()[1:2]
            assert path.endswith("test_tutorial.py") or all(f'"{w}"' in text for w in said), pattern
    for table in (ALSO_SAID, STATUSES):
        for pattern in table:
            ran = [found for found in commands() if not rows_of(NOT_RUN, found)]
            assert any(fnmatchcase(" ".join(found.words), pattern) for found in ran), pattern


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if command.summary])
def test_every_command_is_documented_and_has_help(name, capsys):
    assert any(found.words[1:2] == (name,) for found in ours()), f"no document shows fitctl {name}"
    with pytest.raises(typer.Exit):
        parsed(name, ["--help"])
    assert "Usage:" in capsys.readouterr().out


# Those of sequences.md run in tests/sequences/test_sequence_docs.py.
ON_A_LOG = [block for block in blocks("python") if block.document.name != "sequences.md"]


@pytest.mark.long
@pytest.mark.parametrize("block", ON_A_LOG, ids=str)
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
