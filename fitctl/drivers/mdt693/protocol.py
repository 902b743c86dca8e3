"""What an MDT693A or MDT693B sends, in every variant that public sources report.

A command ends in CR. The answer is, where echo is on, the command itself, in lower case from some;
then, from some, a ``*``; then the body; then CR and a prompt: ``>``, ``> `` or ``*``. The A has no prompt
after its answers, and no CR after a limit. An error is ``CMD_NOT_DEFINED>`` or ``!``. LF means
nothing, nor does a NUL, which a recorded A sends after some answers. Volts come with and without
brackets, with no decimal to two, and the voltage-limit switch as volts or as a position.

Sources: Thorlabs MDT693A and MDT693B manuals (commands); recorded sessions of an MDT693A with firmware
3.01 and of MDT693Bs with 1.05 and 1.10 (echo, stars, prompts, bodies, NULs); public drivers (errors,
prompts, limit codes).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

TERMINATOR = b"\r"
NOT_DEFINED = "CMD_NOT_DEFINED>"
REFUSED = "!"
ACKNOWLEDGED = "*"

LIMIT_SWITCH_V = (75, 100, 150)  # by position: 0, 1, 2
LIMIT_MARGIN_V = 0.5  # the highest output is this much above the switch position
ANSWER_BYTES_MAX = 4096  # the longest real one is the help text of the B, below 3 kB
BITS_PER_BYTE = 10  # 8N1: start bit, eight data bits, stop bit


@dataclass(frozen=True, slots=True)
class Commands:
    """How one model is asked for the things that fitctl wants to know; channels in order x, y, z."""

    identity: str
    limit: str
    low_limits: tuple[str, str, str]
    high_limits: tuple[str, str, str]
    voltages: tuple[str, str, str]
    # What only some have; empty where a model has none.
    system_low: str
    system_high: str
    all_voltages: str
    serial: str


MODEL_A = Commands(
    identity="I",
    limit="%",
    low_limits=("XL?", "YL?", "ZL?"),
    high_limits=("XH?", "YH?", "ZH?"),
    voltages=("XR?", "YR?", "ZR?"),
    system_low="",
    system_high="",
    all_voltages="",
    serial="",
)
MODEL_B = Commands(
    identity="id?",
    limit="vlimit?",
    low_limits=("xmin?", "ymin?", "zmin?"),
    high_limits=("xmax?", "ymax?", "zmax?"),
    voltages=("xvoltage?", "yvoltage?", "zvoltage?"),
    system_low="sysmin?",
    system_high="sysmax?",
    all_voltages="xyzvoltage?",
    serial="serial?",
)


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer without its frame.

    Attributes
    ----------
    body : str
        The answer itself; lines are separated by CR.
    refused : bool
        The device does not know the command, or not with this value.
    echoed : bool
        The command came back before the answer.
    """

    body: str
    refused: bool
    echoed: bool


_COMPLETE = re.compile(
    rf"{REFUSED}\0?$"
    r"|CMD_[A-Z_]+\s*[>*] ?$"
    r"|[^\s>*]\s*\r\s*[>*] ?$"
    r"|\*\[[^\]\r]*\]\r$"  # a star before a value: no prompt need follow, and if one does it is skipped
)
_ERROR = re.compile(r"CMD_[A-Z_]+")
_NUMBER = r"-?\d{1,4}(?:\.\d{1,3})?"
_VOLTS = re.compile(rf"\[\s*({_NUMBER})\s*\]|({_NUMBER})")
_THREE = re.compile(rf"({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*({_NUMBER})")
_SWITCH = re.compile(r"\[\s*(\d{2,3})\s*\]|(\d{1,3})")
_FRAME = "\r\n\0 >*"


def is_complete(command: str, data: bytes) -> bool:
    """Whether `data`, received after `command`, ends as an answer ends.

    After some answers some firmware sends no prompt; those are complete when nothing more comes.
    """
    text, _ = _without_echo(command, data.decode("ascii", "replace"))
    return _COMPLETE.search(text) is not None


def is_frame_only(command: str, data: bytes) -> bool:
    """Whether there is nothing in `data` but what surrounds an answer: echo, prompt, line ends, NULs."""
    text, _ = _without_echo(command, data.decode("ascii", "replace"))
    return not text.strip(_FRAME)


def parse_answer(command: str, data: bytes) -> Answer:
    """Remove the frame from an answer.

    Raises
    ------
    ValueError
        If there is anything but ASCII in it, or neither body, error nor prompt.
    """
    text, echoed = _without_echo(command, data.decode("ascii"))
    if _ERROR.search(text) or text.strip(_FRAME) == REFUSED:
        return Answer("", refused=True, echoed=echoed)
    body = text.lstrip("\r >*!").rstrip("\0")
    body = re.sub(r"\r\s*[>*] ?$", "", body).strip("\r ")
    if not body and not text.strip("\r \0"):
        msg = "neither answer nor prompt"
        raise ValueError(msg)
    if any(not character.isprintable() for character in body.replace("\r", "").replace("\t", "")):
        msg = "control characters"
        raise ValueError(msg)
    return Answer(body, refused=False, echoed=echoed)


def parse_volts(body: str) -> float:
    """One voltage, such as ``[  24.8]`` or ``100.5``.

    Raises
    ------
    ValueError
        If it is anything else.
    """
    match = _VOLTS.fullmatch(body)
    if match is None:
        msg = f"{body!r} is not a voltage"
        raise ValueError(msg)
    return float(match[1] or match[2])


def parse_three_volts(body: str) -> list[float]:
    """Three voltages, such as ``[ 75.0, 75.0, 75.0]``, brackets or not.

    Raises
    ------
    ValueError
        If it is anything else.
    """
    bracketed = body.startswith("[") and body.endswith("]")
    match = _THREE.fullmatch((body[1:-1] if bracketed else body).strip())
    if match is None:
        msg = f"{body!r} is not three voltages"
        raise ValueError(msg)
    return [float(text) for text in match.groups()]


def parse_limit_switch(body: str) -> float:
    """The voltage-limit switch, in volts: ``[ 100]``, ``100``, or its position 0, 1 or 2.

    Raises
    ------
    ValueError
        If it is no voltage that the switch has.
    """
    match = _SWITCH.fullmatch(body)
    value = int(match[1] or match[2]) if match is not None else -1
    if match is not None and match[2] and value < len(LIMIT_SWITCH_V):
        value = LIMIT_SWITCH_V[value]
    if value not in LIMIT_SWITCH_V:
        msg = f"{body!r} is not a position of the voltage-limit switch"
        raise ValueError(msg)
    return float(value)


def parse_identity(body: str) -> tuple[str, str]:
    """Model and firmware from the lines that ``id?`` and ``I`` give.

    Raises
    ------
    ValueError
        If no MDT69x model is named.
    """
    model = re.search(r"MDT69\d[AB]?", body, re.IGNORECASE)
    if model is None:
        msg = f"no MDT693 in {body!r}"
        raise ValueError(msg)
    firmware = re.search(r"(?:Firmware|Software)\s*(?:Version)?\s*:?\s*([\w.]+)", body)
    return model[0].upper(), firmware[1] if firmware else ""


def format_volts(volts: float, decimals: int) -> str:
    """A measured voltage as the B sends it, such as ``[  24.8]``."""
    return f"[{volts:6.{decimals}f}]"


def format_three_volts(volts: Sequence[float], decimals: int) -> str:
    """Three measured voltages in one answer, such as ``[  0.24,  0.21,  0.22]``."""
    return f"[{','.join(f'{value:6.{decimals}f}' for value in volts)}]"


def format_volts_a(volts: float) -> str:
    """A measured voltage as the A sends it: to 0.1 V, but ``[     1]`` for a whole number."""
    return f"[{round(volts, 1):6g}]"


def _without_echo(command: str, text: str) -> tuple[str, bool]:
    """Remove LFs and the echo of the command; returns whether there was an echo."""
    text = text.replace("\n", "")
    # What ends an answer may come after that answer has been taken as complete.
    echo = re.match(rf"[\0 >*]*{re.escape(command)}\r", text, re.IGNORECASE)
    if echo is None:
        return text.lstrip("\0 "), False
    return text[echo.end() :], True
