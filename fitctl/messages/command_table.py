"""Every command: how people call it, and who may give it.

Command line, console and documentation are made from this table and from the structs of
:mod:`fitctl.messages.commands`, which say what a command does and which values it needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args, get_origin

import msgspec

from fitctl.config import ConfigError
from fitctl.logging.records import CommandRecord
from fitctl.messages import commands
from fitctl.messages.commands import AnyCommand, Command, MoveCollector, Reply, Stop

Needs = Literal["any key", "the Unix socket", "a commander's key", "the instrument"]


class CommandRow(NamedTuple):
    """One command.

    Attributes
    ----------
    make : type
        Its message.
    needs : str
        "the instrument" is a commander's key, and that nobody else has the lease.
    word : str
        On a command line; empty for what programs alone send.
    key, label : str
        In the console; what has neither a label nor a word is sent by no person.
    question : str
        What the console asks first, where the command is laborious to undo.
    logged : bool
        Each gets a record of its own in the log; reports, which come every second, do not.
    wait_s : float
        How long ``fitctl send`` waits by default for its outcome; 0 for a command whose reply is its outcome.
    of_rig : bool
        It is for the whole rig, and for no single loop.
    """

    make: type[AnyCommand]
    needs: Needs
    word: str = ""
    key: str = ""
    label: str = ""
    question: str = ""
    logged: bool = True
    wait_s: float = 0.0
    of_rig: bool = False

    @property
    def name(self) -> str:
        """As ``LoopState.usable_commands`` calls it."""
        return self.make.__name__

    @property
    def title(self) -> str:
        """What people call it."""
        return self.word.capitalize() or self.label

    @property
    def fields(self) -> dict[str, bool]:
        """Names of its values, and whether each must be given."""
        common = {field.name for field in msgspec.structs.fields(Command)}
        return {
            field.name: field.required
            for field in msgspec.structs.fields(self.make)
            if field.name not in common
        }

    @property
    def values(self) -> list[str]:
        """Names of the values that it needs, in the order in which they are given."""
        return [name for name, required in self.fields.items() if required]

    @property
    def options(self) -> list[str]:
        """Names of the values that it may be given, as NAME=VALUE."""
        return [name for name, required in self.fields.items() if not required]

    @property
    def usage(self) -> str:
        """Its word and what must follow."""
        may = [f"[{name}=]" for name in self.options]
        return " ".join([self.word, *(value.upper() for value in self.values), *may])

    @property
    def help(self) -> str:
        """What it does, as a part of a sentence."""
        text = (self.make.__doc__ or "").partition("\n")[0].removesuffix(".")
        return text if text[:2].isupper() else text[:1].lower() + text[1:]


COMMANDS = (
    CommandRow(commands.Stop, "a commander's key", "stop", "s", "STOP"),
    CommandRow(commands.Standby, "the instrument", "standby", "b", "Standby", wait_s=60.0),
    CommandRow(commands.Acquire, "the instrument", "acquire", "a", "Acquire", wait_s=600.0),
    CommandRow(commands.Release, "the instrument", "release", "h", "Release"),
    CommandRow(commands.Recover, "the instrument", "recover", "r", "Recover", wait_s=60.0),
    CommandRow(
        commands.Off,
        "the instrument",
        "off",
        "o",
        "Off",
        question="Disable the amplifiers and close all devices?",
        wait_s=60.0,
    ),
    CommandRow(commands.SetTarget, "the instrument", "target"),
    CommandRow(commands.Look, "the instrument", "look"),
    CommandRow(commands.Jog, "the instrument", "jog"),
    CommandRow(commands.SetBiasOffset, "the instrument", "bias-offset"),
    CommandRow(commands.SetController, "the instrument", "controller", wait_s=120.0),
    CommandRow(commands.Reset, "the instrument", "reset"),
    CommandRow(commands.MoveCollector, "the instrument", "collector", of_rig=True),
    CommandRow(commands.FrameRate, "the instrument", "frame-rate", of_rig=True),
    CommandRow(commands.Status, "any key", "status", logged=False, of_rig=True),
    CommandRow(commands.RecentEvents, "any key", "events", logged=False, of_rig=True),
    CommandRow(commands.TakeOver, "a commander's key", "take-over", of_rig=True),
    CommandRow(commands.Shutdown, "the instrument", "shutdown", wait_s=120.0, of_rig=True),
    CommandRow(commands.Experiment, "the instrument", label="Experiment"),
    CommandRow(commands.SequenceControl, "a commander's key", label="Sequence control"),
    CommandRow(commands.SequenceReport, "a commander's key", logged=False),
    CommandRow(commands.RecorderReport, "the Unix socket", logged=False),
    CommandRow(commands.LearnerReport, "the Unix socket"),
)
MOST_WAIT_S = 1.75
"""The supervisor carries out no command that is older: its sender gives up after ``REPLY_TIMEOUT_S``."""
_MOST_SHOWN = 40  # characters of a word that is no command
_LOGGED_OF_REFUSED = 100  # characters of its loop, of its values and of the answer
ROWS = {row.make: row for row in COMMANDS}
RENAMED = {"hold": "release"}
"""Words of an older fitctl, which are refused with the word of today."""
WORDS = {row.word: row for row in COMMANDS if row.word}


def command_of(word: str, values: Sequence[str], loop: str, caller: str = "send") -> AnyCommand:
    """The command that words on a command line ask for; errors begin with `caller`.

    Raises
    ------
    ConfigError
        If there is no such command, or its values are not what it needs.
    """
    if word in RENAMED:
        msg = f"{caller}: {word} is now {RENAMED[word]}"
        raise ConfigError(msg)
    if word not in WORDS:
        shown = word if len(word) <= _MOST_SHOWN else word[:_MOST_SHOWN] + "…"
        msg = f"{caller}: unknown command {shown!r}. Available: {', '.join(WORDS)}"
        raise ConfigError(msg)
    row = WORDS[word]
    if loop and row.of_rig:
        msg = f"{caller}: {word} is for the whole rig; expected no loop, got {loop}"
        raise ConfigError(msg)
    named = [text for text in values if "=" in text and text.partition("=")[0] in row.options]
    plain = [text for text in values if text not in named]
    if len(plain) != len(row.values):
        takes = " ".join(map(str.upper, row.values)) or "no values"
        may = (
            f", and may have {', '.join(f'{name}=' for name in row.options)}" if row.options else ""
        )
        msg = f"{caller}: {word} takes {takes}{may}; got {' '.join(values) or 'nothing'}"
        raise ConfigError(msg)
    options = dict(text.split("=", 1) for text in named)
    given = dict(zip(row.values, plain, strict=True)) | options | {"loop": loop}
    try:
        # Numbers come as text here; msgspec reads them, and checks what they may be.
        return msgspec.convert(given, row.make, strict=False)
    except msgspec.ValidationError as error:
        wrong = _wrong_value(row.make, given) or str(error)
        msg = f"{caller}: {word} {' '.join(values)}: {wrong}"
        raise ConfigError(msg) from None


def _wrong_value(make: type[AnyCommand], given: dict[str, str]) -> str:
    """The first value that the command cannot have, and what was expected; empty if each could be."""
    for field in msgspec.structs.fields(make):
        if field.name not in given:
            continue
        text = given[field.name]
        try:
            msgspec.convert(text, field.type, strict=False)
        except msgspec.ValidationError:
            if choices := _choices(field.type):
                return f"unknown {field.name} {text!r}. Available: {', '.join(choices)}"
            return f"{field.name} must be a number, got {text!r}"
    return ""


def _choices(kind: Any) -> list[str]:
    """The texts that a value may be; empty for a number."""
    if get_origin(kind) is Literal:
        return list(get_args(kind))
    return [choice for part in get_args(kind) for choice in _choices(part)]


def as_command(command: AnyCommand | str, loop: str = "") -> AnyCommand:
    """A command from Python: a message as it is, or words as after ``fitctl send``.

    Raises
    ------
    ConfigError
        If words are no command, or its values are not what it needs.
    TypeError
        If it is neither, or a message with a loop beside it.
    """
    if isinstance(command, str):
        word, *values = command.split() or [""]
        return command_of(word, values, loop)
    if type(command) not in ROWS or loop:
        msg = (
            "send: expected words such as 'target 24 19.5', with loop= if it is for one, or a message of "
            f"fitctl.messages.commands; got {command!r}"
        )
        raise TypeError(msg)
    return command


def may_be_too_late(command: AnyCommand) -> bool:
    """Whether a command must not be carried out long after it was sent.

    What stops something is carried out however late; reports and questions, which are not logged one by one,
    change nothing.
    """
    stops = isinstance(command, MoveCollector) and command.action == "stop"
    return ROWS[type(command)].logged and not (stops or isinstance(command, Stop))


def why_too_late(command: AnyCommand, now_s: float) -> str:
    """Why a command that was sent long ago is refused; empty if it is not."""
    waited_s = 0.0 if command.sent_s is msgspec.UNSET else now_s - command.sent_s
    if not (waited_s > MOST_WAIT_S and may_be_too_late(command)):
        return ""
    return (
        f"{type(command).__name__} was sent {waited_s:.1f} s ago; what arrives after {MOST_WAIT_S:g} s is not "
        "carried out, because its sender may have given up: send it again"
    )


def command_record(
    command: AnyCommand, reply: Reply, sender: str, address: str, now_s: float
) -> CommandRecord:
    """What the log keeps of a command and its answer; of a refused one, the beginning of each text."""
    values = {name: getattr(command, name) for name in ROWS[type(command)].fields}
    longest = None if reply.accepted else _LOGGED_OF_REFUSED
    return CommandRecord(
        time_s=now_s,
        sender=sender,
        address=address,
        command=type(command).__name__,
        loop=command.loop[:longest],
        values_json=msgspec.json.encode(values).decode()[:longest],
        accepted=reply.accepted,
        text=reply.text[:longest],
    )
