"""The LabJack T7 driver: one Modbus request reads all four photodiodes, and no tick waits for the answer."""

from __future__ import annotations

import time
from collections import deque
from contextlib import closing
from typing import NamedTuple

from fitctl.config import LabJackT7Device
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    DeviceError,
    DeviceIdentity,
    DeviceMismatch,
    DiodeReading,
)
from fitctl.drivers.labjack_t7 import protocol
from fitctl.drivers.labjack_t7.link import DEVICE, KEYS, Facts, T7Link
from fitctl.drivers.labjack_t7.protocol import Register
from fitctl.drivers.modbus import Answer
from fitctl.drivers.probe import Probe, round_trip_s

_CHECK_EVERY_S = 0.1


class _Request(NamedTuple):
    """A request without an answer so far: for a sample, or for the inputs' settings."""

    transaction: int
    sent_s: float
    for_settings: bool


class LabJackT7:
    """Four photodiodes on AIN0 to AIN3; a :class:`~fitctl.drivers.interface.Photodiodes`.

    Now and then it reads the inputs' settings too, which another client can change: in a smaller range all four
    voltages end at the same value, and look like a beam on the centre.

    A request is sent once and never repeated. Its answer is known by its transaction number, whenever it
    comes; one that comes after a later request's, twice, or after :meth:`receive` has given it up is dropped.

    Parameters
    ----------
    device : LabJackT7Device
        Where the T7 is, how its inputs are set, and which photodiode is on which.
    check_every_s : float
        Time between readings of the settings.
    """

    def __init__(self, device: LabJackT7Device, check_every_s: float = _CHECK_EVERY_S) -> None:
        self._device = device
        self._endpoint = Endpoint(DEVICE, device.endpoint)
        self._link: T7Link | None = None
        self._outstanding: deque[_Request] = deque()
        self._settings = _settings(device)
        self._check_every_s = check_every_s
        self._check_s = 0.0

    def open(self) -> DeviceIdentity:
        """Connect, check that it is the T7 of the rig file, write its inputs' settings and read them back.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        DeviceMismatch
            It is another device or another T7, cannot do what the rig file says, or did not keep a setting.
        """
        self.close()
        device = self._device
        self._link = link = T7Link(device)
        try:
            facts = link.read_facts()
            disagreement = _disagreement(facts, device)
            if disagreement is not None:
                raise self._endpoint.error(DeviceMismatch, *disagreement)
            for register, value in self._settings.items():
                link.set(register, value)
            self._check_volts(link, link.read_inputs())
        except DeviceError:
            self.close()
            raise
        self._check_s = time.monotonic() + self._check_every_s
        return facts.identity

    def send_request(self) -> None:
        """Ask for one sample of all four, and for the inputs' settings when that is due; returns at once.

        Raises
        ------
        DeviceUnreachable
        """
        link = self._opened()
        sent_s = time.monotonic()
        self._outstanding.append(_Request(link.request_inputs(), sent_s, for_settings=False))
        if sent_s >= self._check_s:
            self._check_s = sent_s + self._check_every_s
            number = link.request_settings()
            self._outstanding.append(_Request(number, sent_s, for_settings=True))

    def receive(self) -> DiodeReading | None:
        """The newest sample that has arrived, without waiting.

        Raises
        ------
        DeviceTimeout
            No answer has come, and the oldest request has waited for `response_timeout_s`; all requests so
            far are given up, and the next may be sent.
        DeviceMismatch
            An input is no longer set as the rig file says; opening writes the settings again.
        DeviceUnreachable, DeviceRefused, DeviceProtocolError
            After a protocol error the connection is closed: open it again.
        """
        link = self._opened()
        newest: DiodeReading | None = None
        while (answer := link.receive(0.0)) is not None:
            request = self._request_of(answer)
            if request is None:
                continue
            if request.for_settings:
                self._check_settings(link, answer)
            else:
                newest = self._reading(link, answer, request.sent_s)
        if newest is None and self._outstanding:
            waited_s = time.monotonic() - self._outstanding[0].sent_s
            if waited_s > self._device.response_timeout_s:
                self._outstanding.clear()
                raise link.silent()
        return newest

    def close(self) -> None:
        """Disconnect; settings stay as they are. Safe to call twice and after a failure."""
        link, self._link = self._link, None
        self._outstanding.clear()
        if link is not None:
            link.close()

    def _request_of(self, answer: Answer) -> _Request | None:
        """The outstanding request that it answers, if any.

        Requests before it will not be answered any more: the T7 answers in turn.
        """
        numbers = [request.transaction for request in self._outstanding]
        if answer.transaction not in numbers:
            return None
        for _ in range(numbers.index(answer.transaction)):
            self._outstanding.popleft()
        return self._outstanding.popleft()

    def _check_settings(self, link: T7Link, answer: Answer) -> None:
        """Raise DeviceMismatch if an input is set otherwise than it was at opening."""
        for register, value in link.decode_settings(answer).items():
            wanted = protocol.decode(register, protocol.encode(register, self._settings[register]))
            if value != wanted:
                raise self._endpoint.error(
                    DeviceMismatch,
                    f"register {register.address} to read {wanted:g}, as it was set",
                    "other values of some inputs" if value in protocol.UNEQUAL else f"{value:g}",
                    "another client has set the T7's inputs: end it, then recover",
                )

    def _reading(self, link: T7Link, answer: Answer, sent_s: float) -> DiodeReading:
        arrived_s = max(sent_s, link.arrived_s)
        inputs_v = link.decode_inputs(answer)
        self._check_volts(link, inputs_v)
        az_plus, az_minus, el_plus, el_minus = (inputs_v[number] for number in self._device.inputs)
        return DiodeReading((sent_s + arrived_s) / 2, (az_plus, az_minus, el_plus, el_minus))

    def _check_volts(self, link: T7Link, inputs_v: list[float]) -> None:
        """Raise DeviceProtocolError if an input reads what none can read in its range."""
        most_v = protocol.BEYOND_RANGE * self._device.range_v
        for number, value in enumerate(inputs_v):
            if not abs(value) <= most_v:  # so that NaN is wrong too
                raise link.nonsense(
                    f"AIN{number} to read {-most_v:g} to {most_v:g} V", f"{value:g}"
                )

    def _opened(self) -> T7Link:
        if self._link is None:
            raise self._endpoint.not_open()
        return self._link


def _settings(device: LabJackT7Device) -> dict[Register, float]:
    """What the inputs are set to, by the register that has it for all of them."""
    return {
        protocol.AIN_ALL_RANGE: device.range_v,
        protocol.AIN_ALL_NEGATIVE_CH: protocol.SINGLE_ENDED,
        protocol.AIN_ALL_RESOLUTION_INDEX: device.resolution_index,
        protocol.AIN_ALL_SETTLING_US: device.settling_us,
    }


def probe_labjack(device: LabJackT7Device) -> Probe:
    """Who a T7 is, and whether it can do what the rig file says; nothing is written.

    Raises
    ------
    DeviceError
        If it does not answer, or is no LabJack.
    """
    with closing(T7Link(device)) as link:
        facts = link.read_facts()
        disagreement = _disagreement(facts, device)
        if disagreement is not None and facts.product != protocol.T7:
            raise Endpoint(DEVICE, device.endpoint).error(DeviceMismatch, *disagreement)
        question_s = round_trip_s(link.read_inputs)
    if disagreement is None:
        return Probe(facts.identity, question_s)
    expected, got, hint = disagreement
    return Probe(facts.identity, question_s, (f"expected {expected}, got {got}; {hint}",))


def _disagreement(facts: Facts, device: LabJackT7Device) -> tuple[str, str, str] | None:
    """What differs from the rig file: what was expected, what there is, what to do; None if nothing does."""
    if facts.product != protocol.T7:
        return (
            f"a T7, PRODUCT_ID {protocol.T7:g}",
            f"{facts.product:g}",
            f"check that {KEYS}.host and .port lead to the T7",
        )
    if device.serial_number not in {None, facts.serial_number}:
        return (
            f"serial number {device.serial_number}",
            f"{facts.serial_number}",
            f"check that {KEYS}.host leads to the right T7, or correct {KEYS}.serial_number",
        )
    if device.resolution_index >= protocol.FIRST_PRO_INDEX and not facts.pro:
        return (
            f"a T7-Pro, for resolution_index {device.resolution_index}",
            "a T7 without the high-resolution converter",
            f"set {KEYS}.resolution_index to {protocol.FIRST_PRO_INDEX - 1} or less",
        )
    return None
