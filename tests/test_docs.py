"""The documentation is true: its commands, outputs, tables, keys and links are checked here."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from itertools import pairwise
from pathlib import Path
from pkgutil import resolve_name

import numpy as np
import pytest
import typer
from documents import (
    DOCUMENTS,
    ROOT,
    anchors,
    between,
    blocks,
    commands,
    prose,
    quoted,
    table,
)

from fitctl.cli import app
from fitctl.commands.fault import kinds as fault_kinds
from fitctl.config import default_rig_path, load_rig, rig_from_document
from fitctl.logging.records import QuantityReading, RecorderStatus
from fitctl.logging.schemas import MESSAGES, TOPICS
from fitctl.logging.writer import LogWriter
from fitctl.mocks.faults import WIRE_FAULTS
from fitctl.supervisor.command_table import COMMANDS as COMMAND_ROWS
from fitctl.supervisor.command_table import command_of
from fitctl.supervisor.messages import Acquire, Shutdown, Status, TrippedInterlock
from fitctl.supervisor.metrics import InstrumentCollector
from fitctl.supervisor.modes import COMMANDS, MEANING, TRANSITIONS, Mode, mermaid
from fitctl.supervisor.run import run_info
from fitctl.supervisor.simulate import Simulation
from fitctl.tui.commands import OPERATOR_COMMANDS, VIEWS, keys_of
from tests.tui.fake import FakeSupervisor

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
        timeout=60,
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


# ---------------------------------------------------------------- tables that come from code


def test_the_table_of_modes_is_that_of_the_code():
    rows = [[mode.name, str(int(mode)), MEANING[mode]] for mode in Mode]

    assert between("operating.md", "modes") == table(
        ["mode", "number in logs", "what the loop does"], rows
    )


def test_the_table_of_transitions_is_that_of_the_code():
    rows = [
        [row.source.name, cause(row.trigger), row.target.name, row.condition]
        for row in sorted(TRANSITIONS, key=lambda row: row.source)
    ]

    assert between("operating.md", "transitions") == table(
        ["from", "what", "leads to", "when"], rows
    )


def cause(trigger):
    words = trigger.name.lower().replace("_", " ")
    return f"command `{words}`" if trigger in COMMANDS else words


def test_the_diagram_of_modes_is_that_of_the_code():
    diagrams = [b.text.strip() for b in blocks("mermaid") if b.document.name == "operating.md"]

    assert diagrams == [mermaid()]


def test_the_console_keys_are_those_of_the_console():
    rows = [[f"`{command.key}`", command.label, command.help] for command in OPERATOR_COMMANDS]
    rows += [[f"`{view.key}`", view.label, f"screen: {view.help}"] for view in VIEWS]

    assert between("console.md", "keys") == table(["key", "command", "what it does"], rows)


def test_the_other_keys_of_the_console_are_those_of_its_screens():
    screens = {"": "every screen"} | {view.name: view.label for view in VIEWS}
    rows = [
        [screen, f"`{key.shown}`", key.label, key.help]
        for name, screen in screens.items()
        for key in keys_of(name)
    ]

    assert between("console.md", "screens") == table(
        ["on", "key", "in the footer", "what it does"], rows
    )


def test_the_commands_are_those_of_the_table():
    rows = [
        [f"`{row.usage}`", row.help, row.needs, f"`{row.key}`" if row.key else ""]
        for row in COMMAND_ROWS
        if row.word
    ]

    assert between("remote.md", "commands") == table(
        ["`fitctl send`", "what it does", "needs", "console key"], rows
    )


def test_the_faults_are_those_of_the_mocks():
    tables = {"every device": WIRE_FAULTS} | {
        device: {name: kind for name, kind in kinds.items() if name not in WIRE_FAULTS}
        for device, kinds in fault_kinds().items()
    }
    rows = [
        [
            device,
            f"`{name}`",
            kind.text,
            f"{kind.value:g} {kind.unit}" if kind.unit else "",
            ", ".join(kind.parts),
        ]
        for device, kinds in tables.items()
        for name, kind in kinds.items()
    ]

    assert between("devices.md", "faults") == table(
        ["device", "fault", "what happens", "value, if none is given", "parts"], rows
    )


def test_the_topics_of_a_log_are_those_of_the_schemas():
    loop = next(iter(default_rig()["loops"]))
    rows = []
    for kind, topic in TOPICS.items():
        message = MESSAGES[kind].DESCRIPTOR
        fields = ", ".join(f"`{field.name}`" for field in message.fields)
        what = kind.__doc__.split("\n")[0].replace("``", "`").replace(":class:", "")
        rows.append([f"`{topic.format(loop=loop)}`", message.full_name, what, fields])

    assert between("logs.md", "topics") == table(["topic", "message", "what it is", "fields"], rows)


def test_the_metrics_are_those_that_are_served():
    supervisor = FakeSupervisor()
    supervisor.interlocks = [
        TrippedInterlock(name="any", since_s=0.0, action="warn", reset="itself", reason="")
    ]
    collector = InstrumentCollector()
    collector.accept(supervisor.message(), time.monotonic())
    rows = [
        [
            f"`{family.samples[0].name}`",
            family.type,
            ", ".join(family.samples[0].labels),
            family.documentation,
        ]
        for family in collector.collect()
    ]

    assert between("running-as-a-service.md", "metrics") == table(
        ["metric", "kind", "labels", "what it is"], rows
    )


def test_the_layers_are_those_of_the_import_contract():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = next(c["layers"] for c in contracts["contracts"] if c["type"] == "layers")

    assert between("architecture.md", "layers").splitlines()[1:-1] == layers


# ---------------------------------------------------------------- names and links


def default_rig():
    return tomllib.loads(default_rig_path().read_text())


def test_every_rig_key_that_the_documents_name_exists():
    # With those that the shipped rig shows as comments, because they may be left out.
    shown = re.sub(r"^# (?=\w+ = )", "", default_rig_path().read_text(), flags=re.MULTILINE)
    rig = tomllib.loads(shown)
    missing = []
    for document, text in quoted():
        key = text.partition("=")[0].strip()
        parts = key.split(".")
        if len(parts) < 2 or parts[0] not in rig or not re.fullmatch(r"[\w.]+", key):
            continue
        value = rig
        for part in parts:
            value = value.get(part) if isinstance(value, dict) else None
        if value is None:
            missing.append(f"{document.name}: {key}")

    assert not missing


@pytest.mark.parametrize("block", blocks("toml"), ids=str)
def test_toml_blocks_fit_into_the_default_rig(block):
    rig = rig_from_document(merged(default_rig(), tomllib.loads(block.text)), str(block))

    assert rig.name


def merged(base, change):
    if not (isinstance(base, dict) and isinstance(change, dict)):
        return change
    return base | {key: merged(base.get(key), value) for key, value in change.items()}


def test_every_module_function_and_file_that_the_documents_name_exists():
    missing = []
    for document, text in quoted():
        if re.fullmatch(r"fitctl(\.\w+)+", text):
            try:
                resolve_name(text)
            except (ImportError, AttributeError):
                missing.append(f"{document.name}: {text}")
        elif (
            re.fullmatch(r"(fitctl|tests|rigs|docs)/[\w./-]*", text) and not (ROOT / text).exists()
        ):
            missing.append(f"{document.name}: {text}")

    assert not missing


def test_every_internal_link_leads_somewhere():
    broken = []
    for document in DOCUMENTS:
        for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
            if re.match(r"[a-z]+:", target):
                continue
            name, _, anchor = target.partition("#")
            path = (document.parent / name).resolve() if name else document
            if not path.exists() or (anchor and anchor not in anchors(path)):
                broken.append(f"{document.relative_to(ROOT)}: {target}")

    assert not broken


def test_every_document_can_be_reached_from_readme_or_index():
    frontier = [ROOT / "README.md", ROOT / "docs" / "index.md"]
    reached = set(frontier)
    while frontier:
        document = frontier.pop()
        for name in re.findall(r"\]\(([^)#\s]+\.md)", document.read_text()):
            path = (document.parent / name).resolve()
            if path not in reached and path.exists():
                reached.add(path)
                frontier.append(path)

    assert set((ROOT / "docs").rglob("*.md")) <= reached


def test_documents_have_one_title_skip_no_heading_level_and_name_no_machine():
    for document in DOCUMENTS:
        levels = [len(marks) for marks in re.findall(r"^(#+) ", prose(document), re.MULTILINE)]
        assert levels[0] == 1, document
        assert levels.count(1) == 1, document
        assert all(after <= before + 1 for before, after in pairwise(levels)), document
        assert str(ROOT) not in document.read_text(), document
