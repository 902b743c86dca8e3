"""The documentation is true: its tables and diagrams are those of the code."""

import time
import tomllib

import msgspec
import pytest
from documents import ROOT, between, blocks, table

from fitctl.commands.shared.fault_kinds import kinds as fault_kinds
from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import MetrologyTick, Overlap
from fitctl.logging.schemas import MESSAGES, TOPICS
from fitctl.messages.command_table import COMMANDS as COMMAND_ROWS
from fitctl.messages.modes import (
    COMMANDS,
    MEANING,
    METROLOGY_TRANSITIONS,
    TRANSITIONS,
    Mode,
    mermaid,
)
from fitctl.messages.telemetry import TrippedInterlock
from fitctl.mocks.faults import WIRE_FAULTS
from fitctl.service.metrics import InstrumentCollector
from fitctl.tui.commands import OPERATOR_COMMANDS, SCREENS, keys_of
from tests.instruments.fake_supervisor import FakeSupervisor


def test_the_table_of_modes_is_that_of_the_code():
    rows = [[mode.name, str(int(mode)), MEANING[mode]] for mode in Mode]

    assert between("operating.md", "modes") == table(
        ["mode", "number in logs", "what the loop does"], rows
    )


@pytest.mark.parametrize(
    ("name", "transitions"),
    [("transitions", TRANSITIONS), ("metrology transitions", METROLOGY_TRANSITIONS)],
)
def test_the_table_of_transitions_is_that_of_the_code(name, transitions):
    rows = [
        [row.source.name, cause(row.trigger), row.target.name, row.condition]
        for row in sorted(transitions, key=lambda row: row.source)
    ]

    assert between("operating.md", name) == table(["from", "what", "leads to", "when"], rows)


def cause(trigger):
    words = trigger.name.lower().replace("_", " ")
    return f"command `{words}`" if trigger in COMMANDS else words


def test_the_diagram_of_modes_is_that_of_the_code():
    diagrams = [b.text.strip() for b in blocks("mermaid") if b.document.name == "operating.md"]

    assert diagrams == [mermaid(), mermaid(METROLOGY_TRANSITIONS)]


def test_the_console_keys_are_those_of_the_console():
    rows = [[f"`{command.key}`", command.label, command.help] for command in OPERATOR_COMMANDS]
    rows += [[f"`{view.key}`", view.label, f"screen: {view.help}"] for view in SCREENS]

    assert between("console.md", "keys") == table(["key", "command", "what it does"], rows)


def test_the_other_keys_of_the_console_are_those_of_its_screens():
    screens = {"": "every screen"} | {view.name: view.label for view in SCREENS}
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
    loop = next(iter(load_rig(default_rig_path()).loops))
    rows = []
    for kind, topic in TOPICS.items():
        message = MESSAGES[kind].DESCRIPTOR
        fields = ", ".join(f"`{field.name}`" for field in message.fields)
        what = kind.__doc__.split("\n")[0].replace("``", "`").replace(":class:", "")
        rows.append([f"`{topic.format(loop=loop)}`", message.full_name, what, fields])

    assert between("logs.md", "topics") == table(["topic", "message", "what it is", "fields"], rows)


def of_kind(kind):
    """A record of a kind, of which nothing counts but that there is one."""
    nothing = {"int": 0, "float": 0.0, "str": "one", "bool": False}
    return kind(time_s=0.0, **{name: nothing[of] for name, of in kind.__annotations__.items()})


def test_the_metrics_are_those_that_are_served():
    supervisor = FakeSupervisor()
    supervisor.interlocks = [
        TrippedInterlock(name="any", since_s=0.0, action="warn", reset="itself", reason="")
    ]
    collector = InstrumentCollector()
    message = supervisor.message()
    overlap = msgspec.structs.replace(of_kind(Overlap), time_s=message.time_s)
    message = msgspec.structs.replace(
        message, metrology_ticks=[of_kind(MetrologyTick)], overlaps=[overlap]
    )
    collector.accept(message, time.monotonic())
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
