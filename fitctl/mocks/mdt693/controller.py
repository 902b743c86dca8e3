"""The digital half of an MDT693: the commands of both sets, and how each model answers them. No I/O."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

from fitctl.config import Mdt693Mock
from fitctl.drivers.mdt693.protocol import (
    ACKNOWLEDGED,
    LIMIT_SWITCH_V,
    NOT_DEFINED,
    REFUSED,
    format_three_volts,
    format_volts,
    format_volts_a,
)
from fitctl.mocks.mdt693.amplifier import CHANNELS, Amplifier, OutOfLimitsError
from fitctl.mocks.mdt693.help_text import HELP

COMMAND_BYTES_MAX = 64
SERIAL_NUMBER = "000000-00"
DAC_STEP_V = 150 / 65536  # the arrow keys' smallest step
_NUMBER = r"([-+]?\d+(?:\.\d*)?)"


class Stored(NamedTuple):
    """A number that the device keeps, and in which range."""

    low: int
    high: int
    default: int


class CommandError(Exception):
    """The device does not know this command, or not with this value."""


class Controller:
    """Executes commands on an amplifier.

    Parameters
    ----------
    settings : Mdt693Mock
        Model, and how its firmware speaks.
    amplifier : Amplifier
    """

    def __init__(self, settings: Mdt693Mock, amplifier: Amplifier) -> None:
        self.amplifier = amplifier
        self._settings = settings
        self._is_a = settings.model == "MDT693A"
        self._stored = {
            "intensity": Stored(0, 15, 15),
            "msenable": Stored(0, 1, 0),
            "dacstep": Stored(1, settings.dacstep_max, 1),
            "rotarymode": Stored(0, 2, 0),
            settings.push_command: Stored(0, 1, 0),
        }
        self._table = _COMMANDS_A if self._is_a else _COMMANDS_B
        self.power_up()

    def power_up(self) -> None:
        """As when power comes."""
        self.echo = self._settings.echo
        self.compatible = self._settings.compatibility_mode and not self._is_a
        self._set_defaults()

    def answer(self, command: str) -> str:
        """Execute a command; returns everything that the device sends back, its echo included."""
        text = command.replace("\n", "")
        echo = f"{command.lower() if self._is_a else command}\r" if self.echo else ""
        try:
            body = self._execute(text)
        except (CommandError, OutOfLimitsError):
            return echo + (REFUSED if self._is_a or self.compatible else NOT_DEFINED)
        if self._is_a:
            return f"{echo}{ACKNOWLEDGED}{body}"
        prompt = ACKNOWLEDGED if self.compatible else self._settings.prompt
        # Firmware 1.05 was recorded with a second star, before the answer, while echo was on.
        lead = ACKNOWLEDGED if body and echo and prompt == ACKNOWLEDGED else ""
        return f"{echo}{lead}{body}{prompt}"

    def _execute(self, text: str) -> str:
        if len(text) > COMMAND_BYTES_MAX:
            raise CommandError
        for pattern, action in self._table:
            if match := pattern.fullmatch(text):
                words = (group and group.lower() for group in match.groups())
                answer = action(self, *words) or ""
                return answer if self._is_a or not answer else f"{answer}\r"
        if not self._is_a and (match := _FRIENDLY.fullmatch(text)):
            self._friendly = match[1]
            return ""
        if not self._is_a and (match := _STORED.fullmatch(text)):
            return self._get_or_set(match[1].lower(), match[2])
        raise CommandError

    def _set_defaults(self) -> None:
        self._values = {name: stored.default for name, stored in self._stored.items()}
        self._scan_v = 0.0
        self._friendly = self._settings.model
        self._selected = 0

    # ------------------------------------------------------------------ who it is
    def _identify(self) -> str:
        lines = [
            f"Model {self._settings.model} Piezo Control Module",
            f"Firmware Version: {self._settings.firmware}",
            f"Voltage Range: 0V to {self.amplifier.switch_v:g}V",
        ]
        if not self._is_a:
            lines += [f"Serial#:{SERIAL_NUMBER}", f"Friendly Name:{self._friendly}"]
        lines += ["Thorlabs, Inc. Newton, NJ 07860", "www.thorlabs.com"]
        text = "\r".join(lines)
        return f"     \r\r\r{text}\r\r" if self._is_a else f"\r\r\r{text}\r"

    # ------------------------------------------------------------------ how it speaks
    def _switch_echo(self, wanted: str | None = None) -> str:
        self.echo = not self.echo if wanted is None else wanted == "1"
        return self._get_echo()

    def _get_echo(self) -> str:
        return f"[Echo {'On' if self.echo else 'Off'}]" + ("\r" if self._is_a else "")

    def _set_echo(self, wanted: str) -> None:
        self.echo = wanted == "1"

    def _get_compatible(self) -> str:
        return f"[MDT693A Compatibility Mode {'On' if self.compatible else 'Off'}]"

    def _set_compatible(self, wanted: str) -> None:
        self.compatible = wanted == "1"

    def _restore(self) -> None:
        self._set_defaults()
        self.amplifier.restore()

    # ------------------------------------------------------------------ voltages
    def _read(self, name: str) -> str:
        volts = self.amplifier.measured_v(CHANNELS.index(name))
        if self._is_a:
            return f"{format_volts_a(volts)}\r"
        return format_volts(volts, self._settings.decimals)

    def _read_all(self) -> str:
        if not self._settings.xyzvoltage:
            raise CommandError
        volts = [self.amplifier.measured_v(i) for i in range(3)]
        return format_three_volts(volts, self._settings.decimals)

    def _set(self, name: str, number: str) -> None:
        """Set-point of one channel, or of all three."""
        self.amplifier.set_points(
            [float(number) if name in {one, "a", "all"} else None for one in CHANNELS]
        )

    def _set_three(self, *numbers: str) -> None:
        if not self._settings.xyzvoltage:
            raise CommandError
        self.amplifier.set_points([float(number) for number in numbers])

    def _press_arrow(self, key: str) -> None:
        """Right and left choose a channel, up and down move its set-point."""
        turn = {"c": 1, "d": -1}.get(key, 0)
        self._selected = (self._selected + turn) % len(CHANNELS)
        steps = {"a": 1, "b": -1}.get(key, 0) * self._values["dacstep"]
        self.amplifier.step(self._selected, steps * DAC_STEP_V)

    def _set_scan(self, number: str) -> None:
        volts = float(number)
        if not 0 <= volts <= max(self.amplifier.high_v(i) for i in range(3)):
            raise CommandError
        self._scan_v = volts
        self._scan()

    def _scan(self) -> None:
        self.amplifier.set_scan(self._scan_v if self._values["msenable"] else None)

    # ------------------------------------------------------------------ limits
    def _get_switch(self) -> str:
        position = LIMIT_SWITCH_V.index(int(self.amplifier.switch_v))
        if self._settings.vlimit_as == "position" and not (self._is_a or self.compatible):
            return str(position)
        return f"[{LIMIT_SWITCH_V[position]:4d}]" + ("\r" if self._is_a else "")

    def _get_low(self, name: str) -> str:
        return self._bound(self.amplifier.low_v(_channel(name)))

    def _get_high(self, name: str) -> str:
        return self._bound(self.amplifier.high_v(_channel(name)))

    def _set_low(self, name: str, number: str) -> None:
        self.amplifier.set_low_v(_channel(name), float(number))

    def _set_high(self, name: str, number: str) -> None:
        self.amplifier.set_high_v(_channel(name), float(number))

    def _bound(self, volts: float) -> str:
        if self._is_a:
            return f"{volts:.0f}"
        return f"{volts:.{self._settings.decimals}f}" if volts else "0"

    # ------------------------------------------------------------------ numbers that are kept
    def _get_or_set(self, name: str, number: str) -> str:
        stored = self._stored.get(name)
        if stored is None:
            raise CommandError
        if not number:
            return f"{self._values[name]}\r"
        if not stored.low <= int(number) <= stored.high:
            raise CommandError
        self._values[name] = int(number)
        self._scan()
        return ""


def _channel(name: str) -> int | None:
    return None if name == "sys" else CHANNELS.index(name)


_Table = list[tuple[re.Pattern[str], Callable[..., str | None]]]


def _table(commands: dict[str, Callable[..., str | None]]) -> _Table:
    return [(re.compile(pattern, re.IGNORECASE), action) for pattern, action in commands.items()]


_COMMANDS_A = _table(
    {
        "i.*": Controller._identify,  # a recorded A takes anything that begins so
        "d": lambda self: f"{self._settings.model}\r",
        "e": Controller._switch_echo,
        "%": Controller._get_switch,
        r"([xyz])r\?": Controller._read,
        rf"([xyza])v{_NUMBER}": Controller._set,
        r"([xyz])l\?": Controller._get_low,
        r"([xyz])h\?": Controller._get_high,
        rf"([xyz])l{_NUMBER}": Controller._set_low,
        rf"([xyz])h{_NUMBER}": Controller._set_high,
    }
)
_COMMANDS_B = _table(
    {
        r"\?": lambda self: HELP.replace("PUSHDISABLE", self._settings.push_command.upper()),
        r"i|id\?": Controller._identify,
        "d": lambda self: self._settings.model,
        r"serial\?": lambda self: SERIAL_NUMBER,
        r"friendly\?": lambda self: self._friendly,
        "restore": Controller._restore,
        "e([01])?": Controller._switch_echo,
        r"echo\?": Controller._get_echo,
        "echo=([01])": Controller._set_echo,
        r"cm\?": Controller._get_compatible,
        "cm=([01])": Controller._set_compatible,
        r"vlimit\?|%": Controller._get_switch,
        r"([xyz])(?:r\??|voltage\?)": Controller._read,
        rf"([xyz]|all)voltage={_NUMBER}": Controller._set,
        rf"([xyza])v{_NUMBER}": Controller._set,
        r"xyzvoltage\?": Controller._read_all,
        rf"xyzvoltage=\[?{_NUMBER}, *{_NUMBER}, *{_NUMBER}\]?": Controller._set_three,
        r"([xyz]|sys)min\?": Controller._get_low,
        r"([xyz]|sys)max\?": Controller._get_high,
        r"([xyz])l\?": Controller._get_low,
        r"([xyz])h\?": Controller._get_high,
        rf"([xyz]|sys)min={_NUMBER}": Controller._set_low,
        rf"([xyz]|sys)max={_NUMBER}": Controller._set_high,
        rf"([xyz])l{_NUMBER}": Controller._set_low,
        rf"([xyz])h{_NUMBER}": Controller._set_high,
        r"msvoltage\?": lambda self: self._bound(self._scan_v),
        f"msvoltage={_NUMBER}": Controller._set_scan,
        r"\x1b\[([abcd])": Controller._press_arrow,
    }
)
_STORED = re.compile(r"([a-z]+)(?:\?|=(\d{1,5}))", re.IGNORECASE)
_FRIENDLY = re.compile(r"friendly=([ -~]*)", re.IGNORECASE)
