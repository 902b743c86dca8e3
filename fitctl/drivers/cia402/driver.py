"""The siderostat's two amplifiers: a CiA 402 drive in cyclic synchronous (or profile) velocity mode.

Three frames a servo period: an RPDO with both target velocities, the SYNC that makes the drive act on it
and latch its encoders, and the TPDO with both positions. Statuswords come in a TPDO of their own, on
change and ten times a second. While the amplifiers are enabled the drive watches our heartbeat, which
:meth:`Cia402Amplifiers.exchange` sends: it must be called at least every `master_heartbeat_timeout_s`.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from fitctl.clock import Watchdog
from fitctl.config import Cia402Device, Siderostat
from fitctl.drivers.amplifiers import AXES, LinkedAmplifiers
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.positions import Encoders
from fitctl.drivers.cia402.protocol import NmtCommand, State
from fitctl.drivers.interface import (
    AzEl,
    DeviceFault,
    DeviceIdentity,
    DeviceProtocolError,
    DeviceTimeout,
    ServoReading,
)

if TYPE_CHECKING:
    from fitctl.drivers.cia402.bus import BusLink, CanBus
    from fitctl.drivers.cia402.node import Node

    _Base = LinkedAmplifiers[Node, Cia402Device]
else:
    _Base = LinkedAmplifiers

_POLL_S = 0.001
_STATUS_EVERY_S = protocol.STATUS_EVERY_MS / 1e3
_BEHIND_PERIODS = 10
_SHARED_BUS = (
    0.75  # of a period: a silent drive must not cost the others on its bus their next period
)
_PAIR = struct.Struct("<ii")
_STATUS_PAIR = struct.Struct("<HH")

_TOWARDS_ENABLED = {
    State.SWITCH_ON_DISABLED: protocol.CW_SHUTDOWN,
    State.READY_TO_SWITCH_ON: protocol.CW_SWITCH_ON,
    State.SWITCHED_ON: protocol.CW_ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: protocol.CW_DISABLE_VOLTAGE,
}
_TOWARDS_DISABLED = dict.fromkeys(
    (
        State.READY_TO_SWITCH_ON,
        State.SWITCHED_ON,
        State.OPERATION_ENABLED,
        State.QUICK_STOP_ACTIVE,
    ),
    protocol.CW_DISABLE_VOLTAGE,
)
_OUT_OF_FAULT = {State.FAULT: protocol.CW_FAULT_RESET}
_ENABLED = frozenset({State.OPERATION_ENABLED})
_DISABLED = frozenset({State.NOT_READY, State.SWITCH_ON_DISABLED, State.FAULT})
_NOT_FAULT = frozenset(State) - protocol.FAULT_STATES


class Cia402Amplifiers(_Base):
    """Both axes' amplifiers (:class:`fitctl.drivers.interface.ServoAmplifiers`).

    Parameters
    ----------
    siderostat : Siderostat
        Encoder, servo rate and device settings of the rig.
    bus : CanBus, optional
        Where the drive shares its bus with others; without it, the drive has a connection of its own.
    """

    def __init__(self, siderostat: Siderostat[Cia402Device], bus: CanBus | None = None) -> None:
        device = siderostat.device
        super().__init__(siderostat, f"{device.interface} {device.channel}, node {device.node_id}")
        self._period_s = 1.0 / siderostat.servo.rate_hz
        self._rad_per_count = 2 * math.pi / siderostat.encoder_counts_per_rev
        self._rpdo_id = protocol.RPDO1_BASE + self._device.node_id
        self._position_limit_counts = int(self._device.position_limit_rad / self._rad_per_count)
        self._encoders = Encoders(siderostat.velocity_limit_rad_s / self._rad_per_count)
        self._statuswords = [0, 0]
        self._status = Watchdog(5 * _STATUS_EVERY_S, _STATUS_EVERY_S, 0.0)
        self._behind = 0
        self._bus = bus
        self._bus_link: BusLink | None = None
        self._staged = False
        self._commanded_rad_s: AzEl = (0.0, 0.0)
        self._sync_s = 0.0
        self._answers_within_s = self._period_s * (1.0 if bus is None else _SHARED_BUS)

    def open(self) -> DeviceIdentity:
        """Connect, check and configure the drive, start the node; nothing moves, no motor has current.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout
            No adapter; no drive behind it.
        DeviceMismatch
            Not a CiA 402 drive with two axes and a velocity mode.
        DeviceRefused
            The drive does not take a setting.
        """
        # Here, because python-can costs 140 ms that a command without hardware need not wait for.
        from fitctl.drivers.cia402.configure import configure
        from fitctl.drivers.cia402.link import CanLink
        from fitctl.drivers.cia402.node import Node

        self.close()
        self._encoders.restart()
        self._behind = 0
        self._staged = False
        link = self._bus_link = None if self._bus is None else self._bus.connect(self._device)
        with self._connected(Node(link or CanLink(self._device), self._device)) as node:
            identity = configure(node, self._device, self._position_limit_counts)
            node.handlers |= {
                protocol.TPDO1_BASE + self._device.node_id: self._on_positions,
                protocol.TPDO2_BASE + self._device.node_id: self._on_statuswords,
            }
            if link is not None:
                link.on_sync = self._on_sync
            node.start()
            for axis in range(2):
                self._state(axis)
            self._status.feed(time.monotonic())
        return identity

    def enable(self) -> None:
        """Give both motors current, at zero velocity, with the drive watching our heartbeat.

        Raises
        ------
        DeviceFault
            An axis is in fault or does not come up in time; then neither has current.
        """
        node = self._opened()
        node.guard(on=True)
        with self._disabled_on_failure():
            self._stand_still()
            for axis in range(2):
                self._walk(axis, _TOWARDS_ENABLED, _ENABLED, refused=protocol.FAULT_STATES)

    def disable(self) -> None:
        """Command zero velocity, then take current from both motors; a latched fault stays.

        Raises
        ------
        DeviceFault
            An axis does not let go in time; the other one has been disabled all the same.
        """
        node = self._opened()
        self._stand_still()
        stuck: DeviceFault | None = None
        for axis in range(2):
            try:
                self._walk(axis, _TOWARDS_DISABLED, _DISABLED)
            except DeviceFault as fault:
                stuck = stuck or fault
        if stuck:
            raise stuck
        node.guard(on=False)

    def reset_fault(self) -> None:
        """Disable both axes and clear a latched fault of either; no motor has current afterwards.

        Raises
        ------
        DeviceFault
            The fault stays, because its cause does.
        """
        node = self._opened()
        # Also ends the drive's watch on us, which a pause before enable() would trip again.
        self.disable()
        for axis in range(2):
            if self._state(axis) in protocol.FAULT_STATES:
                # The reset is an edge: an earlier one may have left the bit set.
                self._write(axis, protocol.CONTROLWORD, "H", protocol.CW_DISABLE_VOLTAGE)
                self._walk(axis, _OUT_OF_FAULT, _NOT_FAULT)
                self._write(axis, protocol.CONTROLWORD, "H", protocol.CW_DISABLE_VOLTAGE)
        node.drain()
        node.error_code = 0
        self._encoders.motion.trust()

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period: command both motors, read both encoders.

        Parameters
        ----------
        velocity_rad_s : pair of float
            Motor velocities, azimuth and elevation.

        Returns
        -------
        ServoReading or None
            The first positions that come within one servo period, else those that came late since
            the last call; None when there are neither. `time_s` is when the SYNC was sent that they
            answer, which may be that of an earlier call.

        Raises
        ------
        DeviceUnreachable
            The link broke.
        DeviceTimeout
            The drive's heartbeat or its statuswords are missing, or, when positions are behind, the
            answer to an SDO request.
        DeviceFault
            The drive left the operational state of CANopen, or an encoder jumped. A fault of an axis
            does not raise: the reading carries it.
        DeviceProtocolError
            What came is no CAN frame, or no PDO as configured.
        ValueError
            A velocity is not finite.

        Whatever it raises but ValueError, the velocities have been sent before, if they could be.
        """
        try:
            if not self._staged:
                self.stage(velocity_rad_s)
        finally:
            self._staged = False
            self._synchronize()
        node, encoders = self._opened(), self._encoders
        late, encoders.latched = encoders.latched, None
        deadline_s = self._sync_s + self._answers_within_s
        while encoders.latched is None:
            left_s = deadline_s - time.monotonic()
            if not node.pump(max(0.0, left_s)) or left_s <= 0:
                break
        node.check_alive()
        self._check_status()
        self._check_jumped(encoders.motion, self._rad_per_count)
        latched = encoders.latched or late
        if latched is None:
            return None
        time_s, (az_counts, el_counts) = latched
        return ServoReading(
            time_s=time_s,
            position_rad=(az_counts * self._rad_per_count, el_counts * self._rad_per_count),
            enabled=all(
                protocol.state_of(word) is State.OPERATION_ENABLED for word in self._statuswords
            ),
            fault=self._fault_text(node.error_code),
        )

    def stage(self, velocity_rad_s: AzEl) -> None:
        """Begin a servo period that :meth:`exchange` ends; on a shared bus, before any drive's SYNC.

        Raises
        ------
        DeviceError, ValueError
            As :meth:`exchange`.
        """
        node = self._opened()
        self._encoders.latched = None
        try:
            node.drain()
            self._find_lost()
        finally:
            # Also when nothing sound comes back, the drive must hear what it shall do, and that we live.
            node.beat()
            self._command(velocity_rad_s)
        self._staged = True

    def _shut_down(self) -> None:
        # Where nothing answers, or it answers wrongly, the drive's own watch on us stops it.
        self.disable()
        self._opened().command(NmtCommand.PRE_OPERATIONAL)

    # ------------------------------------------------------------ one axis
    def _state(self, axis: int) -> State | None:
        self._statuswords[axis] = self._read(axis, protocol.STATUSWORD, "H")
        return protocol.state_of(self._statuswords[axis])

    def _walk(
        self,
        axis: int,
        steps: Mapping[State, int],
        goals: frozenset[State],
        *,
        refused: frozenset[State] = frozenset(),
    ) -> None:
        """Send the controlword that each state asks for, until the axis is in one of `goals`."""
        node = self._opened()
        deadline_s = time.monotonic() + self._device.response_timeout_s
        answered: State | None = None
        while (state := self._state(axis)) not in goals:
            if state in refused or time.monotonic() > deadline_s:
                raise self._axis_fault(axis, goals)
            if state is not None and state in steps and state is not answered:
                self._write(axis, protocol.CONTROLWORD, "H", steps[state])
                answered = state
            else:
                node.pump_until(lambda: False, _POLL_S)

    def _read(self, axis: int, index: int, code: str) -> int:
        return self._opened().read(index + axis * protocol.AXIS_OFFSET, 0, code)

    def _write(self, axis: int, index: int, code: str, value: int) -> None:
        self._opened().write(index + axis * protocol.AXIS_OFFSET, 0, code, value)

    # ------------------------------------------------------------ process data
    def _stand_still(self) -> None:
        for axis in range(2):
            self._write(axis, protocol.TARGET_VELOCITY, "i", 0)
        self._command((0.0, 0.0))
        self._synchronize()

    def _command(self, velocity_rad_s: AzEl) -> None:
        """Send both velocities, within the motors' limit, and a SYNC; on a bus, leave them for its SYNC."""
        az_rad_s, el_rad_s = self._commanded_rad_s = self._limited(velocity_rad_s)
        to_wire = protocol.velocity_to_wire
        rpdo = self._rpdo_id, _PAIR.pack(to_wire(az_rad_s), to_wire(el_rad_s))
        if self._bus_link is not None:
            self._bus_link.staged = rpdo
            return
        sync_s = time.monotonic()
        self._opened().link.send(rpdo, (protocol.SYNC_ID, b""))
        self._on_sync(sync_s)

    def _synchronize(self) -> None:
        if self._bus_link is not None:
            self._bus_link.synchronize()

    def _on_sync(self, sync_s: float) -> None:
        """A SYNC is sent: the drive latches its encoders, and acts on what it was last commanded."""
        self._sync_s = sync_s
        self._encoders.sync_sent(sync_s, self._driven(*self._commanded_rad_s))

    def _driven(self, az_rad_s: float, el_rad_s: float) -> AzEl | None:
        """Velocities in encoder counts/s; None while an axis may be without current."""
        if not all(
            protocol.state_of(word) is State.OPERATION_ENABLED for word in self._statuswords
        ):
            return None
        return az_rad_s / self._rad_per_count, el_rad_s / self._rad_per_count

    def _find_lost(self) -> None:
        """Once behind for long, distinguish a lost TPDO from a slow link.

        On both the oldest SYNC stays unanswered. By the time that the drive answers a request it has
        long sent its TPDOs of earlier SYNCs: those that have not come before the answer never will. It
        costs a round trip, but only when behind. On a bus where no other drive is servoed meanwhile, such as
        in a period between two answers that another drive waits for, it is left to a later period: a silent
        drive would hold up all others for the whole time limit.
        """
        self._behind = self._behind + 1 if self._encoders.outstanding else 0
        may_wait = self._bus is None or self._bus.meanwhile is not None
        if self._behind >= _BEHIND_PERIODS and may_wait:
            self._behind = 0
            self._opened().read(protocol.ERROR_REGISTER, 0, "B")
            self._encoders.give_up()

    def _on_positions(self, data: bytes) -> None:
        self._encoders.add(_PAIR.unpack(self._sized(data, _PAIR.size, "both positions")))

    def _on_statuswords(self, data: bytes) -> None:
        sized = self._sized(data, _STATUS_PAIR.size, "both statuswords")
        self._statuswords[:] = _STATUS_PAIR.unpack(sized)
        self._status.feed(time.monotonic())

    def _check_status(self) -> None:
        now_s = time.monotonic()
        if self._status.expired(now_s):
            raise self._endpoint.error(
                DeviceTimeout,
                f"the TPDO with the statuswords within {self._status.limit_s:g} s",
                f"none for {self._status.silent_s(now_s):.2f} s",
                "another CANopen master changed it; recover",
            )

    # ------------------------------------------------------------ errors
    def _sized(self, data: bytes, size: int, what: str) -> bytes:
        if len(data) != size:
            expected = f"a TPDO of {size} bytes with {what}"
            hint = "another CANopen master changed the mapping; recover"
            raise self._endpoint.error(DeviceProtocolError, expected, f"{len(data)}", hint)
        return data

    def _axis_fault(self, axis: int, goals: frozenset[State]) -> DeviceFault:
        statusword = self._statuswords[axis]
        code = self._read(axis, protocol.ERROR_CODE, "H")
        wanted = " or ".join(sorted(state.name.lower().replace("_", " ") for state in goals))
        return self._endpoint.error(
            DeviceFault,
            f"{AXES[axis]} in state {wanted}",
            f"{protocol.state_name(statusword)} (statusword 0x{statusword:04X}), "
            f"{protocol.error_text(code)}",
            "remove the cause, then recover",
        )

    def _fault_text(self, error_code: int) -> str:
        texts = [
            f"{name}: {protocol.state_name(word)} (statusword 0x{word:04X})"
            for name, word in zip(AXES, self._statuswords, strict=True)
            if protocol.state_of(word) in protocol.FAULT_STATES
        ]
        if error_code:
            texts.append(protocol.error_text(error_code))
        return ", ".join(texts)
