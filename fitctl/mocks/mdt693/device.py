"""What an MDT693 does: three output voltages, and the commands that read and set them. No I/O."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fitctl.config import Mdt693Device, Mdt693Mock
from fitctl.drivers.mdt693.protocol import (
    LIMIT_MARGIN_V,
    LIMIT_SWITCH_V,
    format_three_volts,
    format_volts,
)

COMMAND_BYTES_MAX = 64
_SERIAL_NUMBER = "000000-00"
_NUMBER = r"([-+]?\d+(?:\.\d*)?)"
_HELP = "\r".join(
    (
        "id? restore echo? echo= vlimit? serial? cm? cm=",
        "xvoltage? xvoltage= yvoltage? yvoltage= zvoltage? zvoltage= allvoltage=",
        "xmin? xmin= xmax? xmax= ymin? ymin= ymax? ymax= zmin? zmin= zmax? zmax=",
    )
)


@dataclass(frozen=True, slots=True)
class Dialect:
    """How one firmware of the B differs from another.

    Attributes
    ----------
    prompt : str
        ``*``, ``>`` or ``> ``; in 693A compatibility mode it is always ``*``.
    all_voltages : bool
        Knows `xyzvoltage`.
    limit_as_position : bool
        Answers `vlimit?` with 0, 1 or 2 instead of volts.
    """

    prompt: str
    all_voltages: bool
    limit_as_position: bool


FIRMWARE_1 = Dialect("*", all_voltages=False, limit_as_position=False)
FIRMWARE_2 = Dialect(">", all_voltages=True, limit_as_position=False)


class CommandError(Exception):
    """The device does not know this command, or not with this value."""


class Amplifier:
    """Three channels whose output is front knob (here 0), serial set-point and external input.

    Parameters
    ----------
    settings : Mdt693Mock
        Model, firmware, voltage-limit switch.
    piezo : Mdt693Device
        The gain from external input to output.
    on_outputs : callable
        Gets the three output voltages whenever one changes.
    dialect : Dialect or None
        None for that of `settings.firmware`.
    """

    def __init__(
        self,
        settings: Mdt693Mock,
        piezo: Mdt693Device,
        on_outputs: Callable[[Sequence[float]], None],
        dialect: Dialect | None = None,
    ) -> None:
        self.is_a = settings.model == "MDT693A"
        self.echo = True
        self.compatible = False
        self._firmware = settings.firmware
        old = settings.firmware.startswith("1.")
        self._dialect = dialect or (FIRMWARE_1 if old else FIRMWARE_2)
        self._gain = piezo.gain
        self._on_outputs = on_outputs
        self._switch_v = float(settings.limit_switch_v)
        self._external_v = [0.0, 0.0, 0.0]
        self._restore()
        self.outputs_v = self._computed()

    @property
    def prompt(self) -> str:
        """What follows every answer that is not an error."""
        return "*" if self.speaks_a else self._dialect.prompt

    @property
    def speaks_a(self) -> bool:
        """Prompt and errors are those of the 693A."""
        return self.is_a or self.compatible

    def set_external_input_v(self, volts: Sequence[float]) -> None:
        """What the external inputs are given, three voltages before the gain."""
        self._external_v = list(volts)
        self._update()

    def set_limit_switch_v(self, volts: int) -> None:
        """Turn the voltage-limit switch: 75, 100 or 150 V."""
        if volts not in LIMIT_SWITCH_V:
            msg = f"the switch has the positions {LIMIT_SWITCH_V} V, not {volts}"
            raise ValueError(msg)
        self._switch_v = float(volts)
        self._update()

    def execute(self, command: str) -> str:
        """Do what a command says.

        Returns
        -------
        str
            The body of the answer; empty if the prompt says it all.

        Raises
        ------
        CommandError
        """
        text = re.sub(r"\s", "", command).lower()
        if len(command) > COMMAND_BYTES_MAX:
            raise CommandError
        table = _COMMANDS_A if self.is_a else _COMMANDS_B
        for pattern, action in table:
            if match := pattern.fullmatch(text):
                return action(self, *match.groups())
        raise CommandError

    def _restore(self) -> str:
        self._set_v = [0.0, 0.0, 0.0]
        self._low_v = [0.0, 0.0, 0.0]
        self._high_v = [LIMIT_SWITCH_V[-1] + LIMIT_MARGIN_V] * 3
        return ""

    def _high(self, channel: int) -> float:
        return min(self._high_v[channel], self._switch_v + LIMIT_MARGIN_V)

    def _computed(self) -> list[float]:
        return [
            min(
                self._high(i),
                max(self._low_v[i], self._external_v[i] * self._gain + self._set_v[i]),
            )
            for i in range(3)
        ]

    def _update(self) -> None:
        outputs_v = self._computed()
        if outputs_v != self.outputs_v:
            self.outputs_v = outputs_v
            self._on_outputs(outputs_v)

    # ------------------------------------------------------------------ commands
    def _identify(self) -> str:
        lines = (
            f"Model {'MDT693A' if self.is_a else 'MDT693B'} Piezo Control Module",
            f"Firmware Version: {self._firmware}",
            f"Voltage Range: 0 to {self._switch_v:g} V",
            f"Serial#:{_SERIAL_NUMBER}",
            "Name:fitctl mock",
        )
        return "\r\r\r" + "\r".join(lines) + "\r"

    def _type(self) -> str:
        return "MDT693A" if self.is_a else "MDT693B"

    def _read(self, name: str) -> str:
        return format_volts(self.outputs_v["xyz".index(name)])

    def _read_all(self) -> str:
        if not self._dialect.all_voltages:
            raise CommandError
        return format_three_volts(self.outputs_v)

    def _set(self, name: str, *numbers: str) -> str:
        """Set-points of one channel, or of all three by one number or by three."""
        channels = ["xyz".index(name)] if name in "xyz" else [0, 1, 2]
        values = [float(number) for number in numbers] * (len(channels) // len(numbers))
        if any(
            not self._low_v[i] <= v <= self._high(i) for i, v in zip(channels, values, strict=True)
        ):
            raise CommandError
        for i, value in zip(channels, values, strict=True):
            self._set_v[i] = value
        self._update()
        return ""

    def _set_three(self, *numbers: str) -> str:
        if not self._dialect.all_voltages:
            raise CommandError
        return self._set("all", *numbers)

    def _get_bound(self, name: str, which: str) -> str:
        channel = "xyz".index(name)
        value = self._high(channel) if which in {"h", "max"} else self._low_v[channel]
        return f"{value:g}" if which in {"min", "max"} else format_volts(value)

    def _set_bound(self, name: str, which: str, number: str) -> str:
        channel, value = "xyz".index(name), float(number)
        if which in {"h", "max"}:
            if not self._low_v[channel] <= value <= self._switch_v + LIMIT_MARGIN_V:
                raise CommandError
            self._high_v[channel] = value
        else:
            if not 0 <= value <= self._high(channel):
                raise CommandError
            self._low_v[channel] = value
        self._update()
        return ""

    def _get_switch(self) -> str:
        if self._dialect.limit_as_position and not self.speaks_a:
            return str(LIMIT_SWITCH_V.index(int(self._switch_v)))
        return f"[{self._switch_v:4.0f}]"

    def _toggle_echo(self, wanted: str | None) -> str:
        self.echo = not self.echo if wanted is None else wanted == "1"
        return self._get_echo()

    def _get_echo(self) -> str:
        return f"[Echo {'On' if self.echo else 'Off'}]"

    def _set_echo(self, wanted: str) -> str:
        self.echo = wanted == "1"
        return ""

    def _get_compatible(self) -> str:
        return f"[MDT693A Compatibility Mode {'On' if self.compatible else 'Off'}]"

    def _set_compatible(self, wanted: str) -> str:
        self.compatible = wanted == "1"
        return ""

    def _restore_all(self) -> str:
        self._restore()
        self.echo, self.compatible = True, False
        self._update()
        return ""

    def _help(self) -> str:
        return _HELP

    def _get_serial(self) -> str:
        return _SERIAL_NUMBER


_Table = tuple[tuple[re.Pattern[str], Callable[..., str]], ...]

_COMMANDS_A: _Table = (
    (re.compile("i"), Amplifier._identify),
    (re.compile("d"), Amplifier._type),
    (re.compile("e([01])?"), Amplifier._toggle_echo),
    (re.compile("%"), Amplifier._get_switch),
    (re.compile("([xyz])r\\??"), Amplifier._read),
    (re.compile(f"([xyza])v{_NUMBER}"), Amplifier._set),
    (re.compile("([xyz])([lh])\\?"), Amplifier._get_bound),
    (re.compile(f"([xyz])([lh]){_NUMBER}"), Amplifier._set_bound),
)
_COMMANDS_B: _Table = (
    *_COMMANDS_A,
    (re.compile("\\?"), Amplifier._help),
    (re.compile("id\\?"), Amplifier._identify),
    (re.compile("serial\\?"), Amplifier._get_serial),
    (re.compile("restore"), Amplifier._restore_all),
    (re.compile("echo\\?"), Amplifier._get_echo),
    (re.compile("echo=([01])"), Amplifier._set_echo),
    (re.compile("cm\\?"), Amplifier._get_compatible),
    (re.compile("cm=([01])"), Amplifier._set_compatible),
    (re.compile("vlimit\\?"), Amplifier._get_switch),
    (re.compile("([xyz])voltage\\?"), Amplifier._read),
    (re.compile(f"([xyz]|all)voltage={_NUMBER}"), Amplifier._set),
    (re.compile("xyzvoltage\\?"), Amplifier._read_all),
    (re.compile(f"xyzvoltage=\\[?{_NUMBER},{_NUMBER},{_NUMBER}\\]?"), Amplifier._set_three),
    (re.compile("([xyz])(min|max)\\?"), Amplifier._get_bound),
    (re.compile(f"([xyz])(min|max)={_NUMBER}"), Amplifier._set_bound),
)
