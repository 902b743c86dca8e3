"""The C-887 driver: moves a hexapod, and can stop it at any time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from typing import TypeVar

from fitctl.config import C887Device
from fitctl.drivers.c887 import protocol
from fitctl.drivers.c887.link import DEVICE, C887Link
from fitctl.drivers.c887.protocol import AXES, GcsError
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceIdentity,
    DeviceMismatch,
    DeviceRefused,
    DeviceTimeout,
    HexapodReading,
    Pose,
    beyond_travel,
)
from fitctl.drivers.probe import Probe, round_trip_s

T = TypeVar("T")
_MODEL = "C-887"
_GCS_VERSION = 2.0
_POLL_S = 0.05
_SAME_VELOCITY = 1e-6
_ALL = " ".join(AXES)


class C887Hexapod:
    """A C-887 with its hexapod; a :class:`~fitctl.drivers.interface.Hexapod`.

    Opening moves nothing and sets nothing; of the controller's state it clears the error number only.
    Several threads may use it: questions take turns, and :meth:`stop` goes between them.

    Parameters
    ----------
    device : C887Device
        Where it is, and how far and how fast the rig may send it.
    """

    def __init__(self, device: C887Device) -> None:
        self._device = device
        self._endpoint = Endpoint(DEVICE, device.port)
        self._link: C887Link | None = None
        self._velocity_mm_s = math.nan

    def open(self) -> DeviceIdentity:
        """Connect, and check controller, stage, axes and travel against the rig file.

        Raises
        ------
        DeviceMismatch
            It is no C-887 with GCS 2.0 and axes X to W, or not with the rig's stage, or the rig's travel is
            beyond the controller's.
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        self.close()
        link = self._link = C887Link(self._device)
        try:
            link.resynchronise()
            identity = self._identify(link)
            self._check_travel(link)
            self._velocity_mm_s = link.ask("VLS?", protocol.parse_float)
        except DeviceError:
            self.close()
            raise
        return identity

    def reference(self, is_wanted: Callable[[], bool] = lambda: True) -> None:
        """Switch servos on that are off, reference all axes, and wait until that is done: the platform moves.

        Parameters
        ----------
        is_wanted : callable
            The move is stopped when this is false.

        Raises
        ------
        DeviceRefused, DeviceFault
            The controller does not start, such as while the emergency stop is pressed.
        DeviceFault
            The reference move has ended and the hexapod is not referenced: it was stopped, or blocked.
        DeviceTimeout
            It takes longer than `reference_timeout_s`; then it has been stopped.
        DeviceUnreachable, DeviceProtocolError
        """
        link = self._opened()
        if not self._are_servos_on(link):
            link.command(protocol.line("SVO", *(f"{axis} 1" for axis in AXES)))
        link.command(protocol.line("FRF", *AXES))
        limit_s = self._device.reference_timeout_s
        deadline_s = time.monotonic() + limit_s
        while not link.ask(protocol.GET_READY, protocol.parse_ready):
            if not is_wanted():
                self.stop()
            if time.monotonic() > deadline_s:
                self.stop()
                raise self._endpoint.error(
                    DeviceTimeout,
                    f"the reference move to end within {limit_s:g} s",
                    "a controller that is still busy",
                    "see what blocks the platform, or raise collector.hexapod.reference_timeout_s",
                )
            time.sleep(_POLL_S)
        number = link.ask("ERR?", protocol.parse_error)
        if not self._is_referenced(link):
            raise self._endpoint.error(
                DeviceFault,
                "all axes referenced",
                protocol.error_text(number) if number else "a reference move that ended early",
                "clear the way of the platform, then reference it again",
            )

    def move_to(self, pose: Pose, velocity_mm_s: float) -> None:
        """Start a move, or give a running one another target; returns when the controller accepts it.

        Raises
        ------
        DeviceRefused
            The pose or the velocity is beyond the rig's limits or the controller's, the hexapod is not
            referenced, a servo is off, or the velocity is another one while the platform moves.
        DeviceFault
            The controller reports an emergency stop, or an axis that did not follow.
        DeviceTimeout, DeviceUnreachable, DeviceProtocolError
        """
        self._check_move(pose, velocity_mm_s)
        link = self._opened()
        with link.turn("MOV"):
            self._set_velocity(link, velocity_mm_s)
            link.command(protocol.with_values("MOV", zip(AXES, map(float, pose), strict=True)))

    def pose(self) -> HexapodReading:
        """Where the platform is, whether it moves, and the error that the controller had latched.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceProtocolError
        """
        link = self._opened()
        with link.turn("#3"):
            moving = link.ask(
                protocol.GET_MOTION, protocol.parse_bits
            )  # first: at rest, it stays there
            requested_s = time.monotonic()
            pose = link.ask(protocol.GET_POSITION, _six_numbers)
            read_s = time.monotonic()
            referenced = self._is_referenced(link)
            servos_on = self._are_servos_on(link)
            number = link.ask("ERR?", protocol.parse_error)
        return HexapodReading(
            time_s=(requested_s + read_s) / 2,
            pose=Pose(*pose),
            moving=moving != 0,
            referenced=referenced,
            servos_on=servos_on,
            error=protocol.error_text(number) if number else "",
        )

    def stop(self) -> None:
        """Stop every motion, at once and without waiting for another thread's question; then check it.

        A move that another thread starts after this is not stopped.

        Raises
        ------
        DeviceFault
            It still moves after `response_timeout_s`.
        DeviceUnreachable, DeviceTimeout, DeviceProtocolError
        """
        link = self._opened()
        link.interrupt(protocol.STOP_ALL)
        # Its error number, 10, may have gone to another thread's question already.
        number = link.ask("ERR?", protocol.parse_error)
        if number not in {GcsError.NONE, GcsError.STOPPED}:
            raise link.refused("#24", number)
        deadline_s = time.monotonic() + self._device.response_timeout_s
        while link.ask(protocol.GET_MOTION, protocol.parse_bits):
            if time.monotonic() > deadline_s:
                raise self._endpoint.error(
                    DeviceFault,
                    f"all axes at rest within {self._device.response_timeout_s:g} s of #24",
                    "a platform that still moves",
                    "press its emergency stop",
                )
            time.sleep(_POLL_S)

    def ask_once(self) -> None:
        """Ask for the pose once, to time a round trip."""
        self._opened().ask(protocol.GET_POSITION, _six_numbers)

    def disagreements(self) -> tuple[str, ...]:
        """What an operator must see to before it can move, one line each.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceProtocolError
        """
        link = self._opened()
        found = []
        if not self._is_referenced(link):
            found.append("the hexapod is not referenced: clear its way, then reference it")
        if not self._are_servos_on(link):
            found.append("a servo is off: reference the hexapod, which switches it on")
        return tuple(found)

    def close(self) -> None:
        """Close the port; safe to call twice and after a failure."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _identify(self, link: C887Link) -> DeviceIdentity:
        identity = link.ask("*IDN?", protocol.parse_identity)
        if not identity.model.startswith(_MODEL):
            self._mismatch(f"a {_MODEL}", identity.model, "collector.hexapod.port")
        version = link.ask("CSV?", protocol.parse_float)
        if version != _GCS_VERSION:
            self._mismatch(f"GCS {_GCS_VERSION:g}", f"GCS {version:g}", "the controller's firmware")
        axes = link.ask("SAI?", protocol.lines_of)
        if [axis.strip() for axis in axes[: len(AXES)]] != list(AXES):
            self._mismatch(f"axes {_ALL}", " ".join(axes), "the controller's configuration")
        stage = link.ask("CST? X", _stage)
        if self._device.stage not in stage:
            self._mismatch(f"a {self._device.stage}", stage, "collector.hexapod.stage")
        return DeviceIdentity(
            "Physik Instrumente",
            f"{identity.model} with {stage}",
            identity.serial,
            identity.firmware,
        )

    def _check_travel(self, link: C887Link) -> None:
        lows = link.ask(f"TMN? {_ALL}", _six_numbers)
        highs = link.ask(f"TMX? {_ALL}", _six_numbers)
        for axis, (low, high), least, most in zip(
            AXES, self._device.travel.ends, lows, highs, strict=True
        ):
            if low < least or high > most:
                self._mismatch(
                    f"a travel of {axis} of at least {low:g} to {high:g}",
                    f"{least:g} to {most:g}",
                    "collector.hexapod.travel",
                )

    def _check_move(self, pose: Pose, velocity_mm_s: float) -> None:
        hint = "correct the motion, or collector.hexapod in the rig file"
        for name, value, low, high in beyond_travel(pose, self._device.travel.ends):
            raise self._endpoint.error(
                DeviceRefused, f"{name} within {low:g} and {high:g}", f"{value:g}", hint
            )
        most = self._device.velocity_limit_mm_s
        if not 0 < velocity_mm_s <= most:
            raise self._endpoint.error(
                DeviceRefused, f"a velocity up to {most:g} mm/s", f"{velocity_mm_s:g} mm/s", hint
            )

    def _set_velocity(self, link: C887Link, velocity_mm_s: float) -> None:
        """The controller takes another velocity only while the platform stands still."""
        if abs(velocity_mm_s - self._velocity_mm_s) <= _SAME_VELOCITY:
            return
        if link.ask(protocol.GET_MOTION, protocol.parse_bits):
            raise link.refused(f"VLS {velocity_mm_s:g}", GcsError.NOT_WHILE_MOVING)
        self._velocity_mm_s = math.nan
        link.command(protocol.line("VLS", float(velocity_mm_s)))
        self._velocity_mm_s = velocity_mm_s

    def _is_referenced(self, link: C887Link) -> bool:
        return all(link.ask(f"FRF? {_ALL}", _six_flags))

    def _are_servos_on(self, link: C887Link) -> bool:
        return all(link.ask(f"SVO? {_ALL}", _six_flags))

    def _opened(self) -> C887Link:
        if self._link is None:
            raise self._endpoint.not_open()
        return self._link

    def _mismatch(self, expected: str, got: str, where: str) -> None:
        raise self._endpoint.error(DeviceMismatch, expected, got, f"check {where}")


def probe_c887(device: C887Device) -> Probe:
    """Who a controller is, and whether its hexapod is ready to move.

    Raises
    ------
    DeviceError
        If it does not answer, or is not the rig file's.
    """
    with closing(C887Hexapod(device)) as driver:
        identity = driver.open()
        return Probe(identity, round_trip_s(driver.ask_once), driver.disagreements())


def _of_all_axes(parse: Callable[[bytes, tuple[str, ...]], T]) -> Callable[[bytes], T]:
    return lambda answer: parse(answer, AXES)


_six_numbers = _of_all_axes(protocol.parse_numbers)
_six_flags = _of_all_axes(protocol.parse_flags)


def _stage(answer: bytes) -> str:
    return protocol.parse_values(answer, ["X"])[0]
