"""The MDT693 driver: asks what the amplifier measures and how it is set, and changes nothing."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from typing import NoReturn

import numpy as np
import serial
from numpy.typing import NDArray

from fitctl.config import Mdt693Device
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    DeviceError,
    DeviceIdentity,
    DeviceMismatch,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.mdt693.protocol import (
    ANSWER_BYTES_MAX,
    MODEL_A,
    MODEL_B,
    TERMINATOR,
    Answer,
    Commands,
    is_complete,
    is_frame_only,
    parse_answer,
    parse_identity,
    parse_limit_switch,
    parse_three_volts,
    parse_volts,
)
from fitctl.drivers.probe import Probe, round_trip_s

_CHANNEL_NAMES = ("x", "y", "z")
_POLL_S = 0.02  # how long one read waits; the time limits are counted above it
# An answer without a prompt is complete after this silence. A slow command takes 0.15 s, a stall of
# the machine 0.1 s.
_QUIET_S = 0.25
_LATE = b"\0 >*"
_LIMIT_TOLERANCE_V = 1.0
_AGREE_V = 1.0  # two answers in a row this near each other are believed

_Volts = tuple[float, ...]


class Mdt693:
    """An MDT693A or MDT693B; a :class:`~fitctl.drivers.interface.PiezoAmplifier`.

    At :meth:`open` it finds out which model answers, whether it echoes, and whether it can give three
    voltages in one answer; it takes the device as it is and leaves it so. RS-232 has no checksum, so
    every value is asked for twice; when the answers differ by more than 1 V, a third time, and then
    the one in the middle counts. A question takes at most `response_timeout_s`, and twice that after
    one that went wrong. Through ``socket://``, pyserial itself allows 5 s to connect and takes 0.3 s to
    close.

    Parameters
    ----------
    piezo : Mdt693Device
        A serial port or ``socket://host:port``, and the limit that the amplifier must be set to.
    """

    def __init__(self, piezo: Mdt693Device) -> None:
        self._piezo = piezo
        self._endpoint = Endpoint("piezo amplifier", piezo.port)
        self._port: serial.Serial | None = None
        self._link_error: DeviceUnreachable | None = None  # that has closed the port
        self._commands: Commands = MODEL_B
        self._echoes: bool | None = None  # not known yet
        self._in_step = False
        self._all_at_once = False

    def open(self) -> DeviceIdentity:
        """Connect, find the dialect, and check every voltage limit against the rig file.

        Raises
        ------
        DeviceMismatch
            If the voltage-limit switch or another high limit is not `limit_v`, or a low limit is not
            0 V, within 1 V.
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        self.close()
        self._port = self._endpoint.open_serial(
            "an MDT693 amplifier",
            "check its cable and power, who else has the port open, and piezo.port",
            baud_rate=self._piezo.baud_rate,
            poll_s=_POLL_S,
            write_timeout_s=self._piezo.response_timeout_s,
        )
        try:
            identity = self._identify()
            self._check_limits()
        except DeviceError:
            self.close()
            raise
        return identity

    def stack_volts(self) -> NDArray[np.float64]:
        """Measured output voltages at the stacks.

        Returns
        -------
        float array, shape (3,)
            Stack 1 (channel x) first.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        if self._all_at_once:
            return np.array(self._volts(self._commands.all_voltages, _three))
        return np.array([self._volts(command, _one)[0] for command in self._commands.voltages])

    def limit_v(self) -> float:
        """The voltage-limit switch as the device reports it: 75, 100 or 150 V.

        Raises
        ------
        DeviceMismatch
            If somebody moved it: it is not `limit_v` of the rig file, within 1 V.
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        (volts,) = self._volts(self._commands.limit, _switch)
        self._check_limit("the voltage-limit switch", volts, self._piezo.limit_v)
        return volts

    def ask_once(self) -> None:
        """Send one query and read its answer without checking it, to time a round trip.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceProtocolError
        """
        self._ask(self._commands.limit)

    def close(self) -> None:
        """Let go of the port; safe to call twice and after a failure."""
        self._in_step = False
        self._echoes = self._link_error = None
        if self._port is not None:
            self._port.close()
            self._port = None

    def _identify(self) -> DeviceIdentity:
        """Find model and dialect. Some As refuse what the B is asked first, others answer it."""
        answer = self._ask(MODEL_B.identity)
        self._echoes = answer.echoed
        if answer.refused:
            answer = self._ask(MODEL_A.identity)
        try:
            model, firmware = parse_identity(answer.body)
        except ValueError as error:
            self._nonsense("the name of an MDT693", str(error))
        self._commands = MODEL_A if model.endswith("A") else MODEL_B
        together = self._commands.all_voltages
        self._all_at_once = bool(together) and not self._ask(together).refused
        number = self._ask(self._commands.serial).body if self._commands.serial else ""
        if number and self._ask(self._commands.serial).body != number:
            self._nonsense("the same serial number twice", "another")
        return DeviceIdentity("Thorlabs", model, number, firmware)

    def _check_limits(self) -> None:
        self.limit_v()
        for bound, commands, expected_v in (
            ("high", self._commands.high_limits, self._piezo.limit_v),
            ("low", self._commands.low_limits, 0.0),
        ):
            for name, command in zip(_CHANNEL_NAMES, commands, strict=True):
                (volts,) = self._volts(command, _one)
                self._check_limit(f"channel {name}'s {bound} limit", volts, expected_v)
        for bound, command, expected_v in (
            ("low", self._commands.system_low, 0.0),
            ("high", self._commands.system_high, self._piezo.limit_v),
        ):
            if command and not self._ask(command).refused:  # not every firmware has them
                (volts,) = self._volts(command, _one)
                volts = min(volts, self._piezo.limit_v)  # beyond the switch it limits nothing
                self._check_limit(f"the system's {bound} limit", volts, expected_v)

    def _check_limit(self, what: str, volts: float, expected_v: float) -> None:
        if abs(volts - expected_v) > _LIMIT_TOLERANCE_V:
            raise self._endpoint.error(
                DeviceMismatch,
                f"{what} at {expected_v:g} V",
                f"{volts:g} V",
                f"set {what} on the amplifier, or correct piezo.limit_v in the rig file "
                "if the stacks allow it",
            )

    def _volts(self, command: str, parse: Callable[[str], _Volts]) -> _Volts:
        """Ask twice and, when the answers differ, a third time: one wrong answer is never believed."""
        first, second = self._value(command, parse), self._value(command, parse)
        if all(abs(a - b) <= _AGREE_V for a, b in zip(first, second, strict=True)):
            return second
        third = self._value(command, parse)
        return tuple(sorted(answers)[1] for answers in zip(first, second, third, strict=True))

    def _value(self, command: str, parse: Callable[[str], _Volts]) -> _Volts:
        """Ask for a value and insist on one, in the dialect found at open."""
        answer = self._ask(command)
        if answer.refused:
            raise self._endpoint.error(
                DeviceRefused,
                f"an answer to {command}",
                "an error",
                "check that this is an MDT693A or MDT693B and see its manual for this command",
            )
        try:
            return parse(answer.body)
        except ValueError as error:
            self._nonsense(f"an answer to {command}", str(error))

    def _ask(self, command: str) -> Answer:
        if not self._in_step:
            # An empty command ends what an earlier client left half typed, and by the silence after
            # its answer, an error, whatever still came late has come too.
            self._send("")
            self._collect("", until_quiet=True)
        self._in_step = False
        self._send(command)
        data = self._collect(command)
        # Without echo an answer does not name its question, so nothing may follow it.
        more = b"" if self._echoes else self._read(command)
        if not is_frame_only(command, more):
            self._nonsense(f"one answer to {command}", f"{(data + more)[:80]!r}")
        # Where commands are echoed, a prompt alone came late with the answer before.
        if not (data.strip(_LATE) if self._echoes else data):
            self._silence(f"an answer to {command}")
        try:
            answer = parse_answer(command, data)
        except ValueError as error:
            self._nonsense(f"an answer to {command}", f"{data[:80]!r} ({error})")
        if self._echoes not in {None, answer.echoed}:
            dialect = "echoed" if self._echoes else "not echoed"
            self._nonsense(f"{command} {dialect}, as at open", f"{data[:80]!r}")
        self._in_step = True
        return answer

    def _send(self, command: str) -> None:
        port = self._opened()
        try:
            port.write(command.encode("ascii") + TERMINATOR)
        except serial.SerialTimeoutException:
            self._silence(f"{command or 'CR'} to be taken")
        except OSError as error:
            self._broken(f"{command or 'CR'} to be taken", error)

    def _collect(self, command: str, *, until_quiet: bool = False) -> bytes:
        """What comes after `command`, up to a prompt, a silence after something came, or the limit."""
        data = bytearray()
        heard_s = time.monotonic()
        deadline_s = heard_s + self._piezo.response_timeout_s
        while len(data) < ANSWER_BYTES_MAX:
            chunk = self._read(command)
            now_s = time.monotonic()
            if chunk:
                data += chunk
                heard_s = now_s
                if not until_quiet and is_complete(command, bytes(data)):
                    break
            elif now_s > heard_s + _QUIET_S and not is_frame_only(command, bytes(data)):
                break
            if now_s > deadline_s:
                # What the time limit cuts off is no answer; a prompt alone is one without a body.
                return bytes(data) if is_frame_only(command, bytes(data)) else b""
        return bytes(data)

    def _read(self, command: str) -> bytes:
        """What has come; waits for the first of it, `_POLL_S` at most."""
        port = self._opened()
        try:
            return port.read(max(1, port.in_waiting))
        except OSError as error:
            self._broken(f"an answer to {command or 'CR'}", error)

    def _opened(self) -> serial.Serial:
        if self._port is None:
            raise self._link_error or self._endpoint.not_open()
        return self._port

    def _broken(self, expected: str, error: OSError) -> NoReturn:
        self.close()
        self._link_error = self._endpoint.error(
            DeviceUnreachable,
            expected,
            f"a broken link ({error})",
            "check its power and its cable, then recover",
        )
        raise self._link_error from error

    def _silence(self, expected: str) -> NoReturn:
        raise self._endpoint.error(
            DeviceTimeout,
            f"{expected} within {self._piezo.response_timeout_s:g} s",
            "none",
            "check that it is switched on, that the port is the right one, and piezo.baud_rate",
        )

    def _nonsense(self, expected: str, got: str) -> NoReturn:
        raise self._endpoint.error(
            DeviceProtocolError,
            expected,
            got,
            "check piezo.baud_rate, and that no other program uses the port",
        )


def probe_mdt693(piezo: Mdt693Device) -> Probe:
    """Who an amplifier is; its limits are held against the rig file on the way.

    Raises
    ------
    DeviceError
        If it does not answer, or its limits are not the rig file's.
    """
    with closing(Mdt693(piezo)) as driver:
        identity = driver.open()
        return Probe(identity, round_trip_s(driver.ask_once))


def _one(body: str) -> _Volts:
    return (parse_volts(body),)


def _three(body: str) -> _Volts:
    return tuple(parse_three_volts(body))


def _switch(body: str) -> _Volts:
    return (parse_limit_switch(body),)
