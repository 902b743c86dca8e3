"""Coverage-guided fuzzing of what parses the MDT693's wire, on both sides: driver and mock.

The first byte chooses the side and the dialect, the rest is what comes over the line.
"""

from __future__ import annotations

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.mdt693 import protocol
from fitctl.mocks.mdt693.amplifier import Amplifier
from fitctl.mocks.mdt693.controller import Controller
from fitctl.mocks.mdt693.line import CommandSplitter

_, _MOCKS = load_rig(default_rig_path()).mock_parts()
_SETTINGS = _MOCKS.loops["right"].mdt693
_DIALECTS = [
    _SETTINGS.model_copy(update=update)
    for update in (
        {"model": "MDT693A"},
        {"prompt": "*"},
        {"prompt": ">", "decimals": 2, "xyzvoltage": True, "echo": False},
        {"prompt": "> ", "vlimit_as": "position", "push_command": "disablepush"},
        {"compatibility_mode": True, "xyzvoltage": True},
    )
]
_COMMANDS = ("", "id?", "I", "%", "xvoltage?", "XL?", "xyzvoltage?", "vlimit?")
_PARSERS = (
    protocol.parse_volts,
    protocol.parse_three_volts,
    protocol.parse_limit_switch,
    protocol.parse_identity,
)


def TestOneInput(data: bytes) -> None:  # noqa: N802 - atheris wants this name
    """Any bytes leave both sides alive, and what the mock says the driver can read."""
    if not data:
        return
    choice, line = data[0], data[1:]
    if choice % 2:
        _driver_reads(_COMMANDS[choice // 2 % len(_COMMANDS)], line)
    else:
        _mock_takes(choice // 2 % len(_DIALECTS), line)


def _driver_reads(command: str, line: bytes) -> None:
    protocol.is_complete(command, line)
    protocol.is_frame_only(command, line)
    try:
        answer = protocol.parse_answer(command, line)
    except ValueError:
        return
    for parse in _PARSERS:
        try:
            parse(answer.body)
        except ValueError:
            continue


def _mock_takes(dialect: int, line: bytes) -> None:
    amplifier = Amplifier(_DIALECTS[dialect], 15.0, lambda volts: None, lambda: 0.0)
    controller = Controller(_DIALECTS[dialect], amplifier)
    for command in CommandSplitter().feed(line):
        text = command.decode("latin-1")
        answer = controller.answer(text).encode("latin-1")
        if len(answer) > protocol.ANSWER_BYTES_MAX:
            raise AssertionError(f"{text!r} has an answer of {len(answer)} bytes")
        if not all(0 <= volts <= 150.5 for volts in amplifier.outputs_v):
            raise AssertionError(f"{text!r} makes {amplifier.outputs_v} V")
        if text.isascii() and text.isprintable():
            protocol.parse_answer(text, answer)


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
