"""The mock drive as one CANopen node: NMT, heartbeats, SYNC, PDOs, SDO, EMCY, and its two axes.

The drive reads its encoders and commands its motors; how the motors move is the plant's business.

Known limitations: those of the modules beside this one, and: SYNC has no counter, remote frames are not
answered, no LSS, no TIME, no parameter store, no limit switches or brake; controlwords are obeyed in every
NMT state but STOPPED; actual velocity (606C) is the encoder's difference between the last two SYNCs. All
links down does not stop it by itself: the loss of the master's heartbeat does, once it was seen.
Invented constants: identity, names and versions (objects.py); the axis number in the EMCY's first
manufacturer byte (0: whole drive); `QUICK_STOP_S` (axis.py).
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

from fitctl.config import Siderostat
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import NmtCommand, NmtState
from fitctl.mocks.cia402.axis import Axis
from fitctl.mocks.cia402.dictionary import Dictionary, Entry, SdoServer, constant
from fitctl.mocks.cia402.objects import axis_objects, identity_objects
from fitctl.mocks.cia402.pdo import Pdo
from fitctl.mocks.cia402.slcan import CanFrame, SlcanAdapter
from fitctl.mocks.cia402.timers import Periodic, Watchdog
from fitctl.mocks.faults import WIRE_FAULTS, Faults

FAULTS = dict(WIRE_FAULTS)
BOTH_VELOCITY_MODES = 1 << (protocol.PROFILE_VELOCITY - 1) | 1 << (
    protocol.CYCLIC_SYNCHRONOUS_VELOCITY - 1
)
_EMCY_PDO_LENGTH = 0x8210


class Motors(Protocol):
    """The plant's side of the drive: azimuth is axis 0, elevation axis 1."""

    def position_rad(self) -> Sequence[float]:
        """Both motors' angles now."""
        ...

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Drive the motors at these velocities; said again at every SYNC."""
        ...

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Give one motor current, or take it away."""
        ...


class Cia402DriveMock:
    """A two-axis drive on an SLCAN adapter.

    Parameters
    ----------
    siderostat : Siderostat
        Encoder and device settings of the rig.
    motors : Motors
        What the drive acts on.
    port : int
        TCP port on 127.0.0.1; 0 for a free one.
    supported_modes : int
        Object 6502 of both axes; bit n is mode n + 1.
    """

    def __init__(
        self,
        siderostat: Siderostat,
        motors: Motors,
        *,
        port: int,
        supported_modes: int = BOTH_VELOCITY_MODES,
    ) -> None:
        self.faults = Faults(FAULTS)
        self._motors = motors
        self._port = port
        self._node_id = siderostat.device.node_id
        self._counts_per_rad = siderostat.encoder_counts_per_rev / (2 * math.pi)
        self._adapter = SlcanAdapter(siderostat.device.bitrate, self._receive)
        self.nmt_state = NmtState.STOPPED
        self.axes = tuple(
            Axis(partial(motors.set_enabled, number), self._axis_changed)
            for number in range(len(protocol.AXES))
        )
        self.heartbeat_ms = 0
        self.consumer = 0
        self._counts = (0, 0)
        self._at_syncs = [(0.0, (0, 0)), (0.0, (0, 0))]
        self._in_error = False
        self._heartbeat = Periodic(self._send_heartbeat)
        self._master = Watchdog(self._master_lost)
        self._dictionary = self._objects(supported_modes)
        self._sdo = SdoServer(self._dictionary)
        self._rpdos = (self._rpdo(0, protocol.RPDO1_BASE), self._rpdo(1, protocol.RPDO2_BASE))
        self._tpdos = (self._tpdo(0, protocol.TPDO1_BASE), self._tpdo(1, protocol.TPDO2_BASE))
        self._events = tuple(Periodic(partial(self._send_pdo, tpdo)) for tpdo in self._tpdos)
        self._sent: dict[Pdo, bytes] = {}
        self._handlers: dict[int, Callable[[bytes], None]] = {}

    async def start(self) -> int:
        """Power up: listen, boot, wait in PRE-OPERATIONAL. Returns the TCP port."""
        port = await self._adapter.start(self._port)
        self._reset_communication()
        return port

    async def stop(self) -> None:
        """Power down: motors without current, every connection closed."""
        self._enter(NmtState.STOPPED)
        self._heartbeat.set_period(0)
        self._master.set_timeout(0)
        for axis in self.axes:
            axis.power_off()
        await self._adapter.stop()

    def inject_fault(self, axis: int, error_code: int, *, persists: bool = False) -> None:
        """Make an axis fail as if by itself; a cause that `persists` defeats the fault reset."""
        self.axes[axis].fault_persists = persists
        self.axes[axis].fault(error_code)
        self._send_emcy(error_code, axis + 1)

    def remove_fault_cause(self, axis: int) -> None:
        """Let the next fault reset of this axis succeed."""
        self.axes[axis].fault_persists = False

    def drop_links(self) -> None:
        """Cut every SLCAN connection; clients may connect again."""
        self._adapter.drop_clients()

    # ------------------------------------------------------------ the objects
    def _objects(self, supported_modes: int) -> Dictionary:
        dictionary = identity_objects(self._node_id) | {
            (protocol.ERROR_REGISTER, 0): Entry("B", self._error_register, mappable=True),
            (protocol.HEARTBEAT_CONSUMER, 0): constant("B", 1),
            (protocol.HEARTBEAT_CONSUMER, 1): Entry("I", lambda: self.consumer, self._set_consumer),
            (protocol.HEARTBEAT_PRODUCER, 0): Entry(
                "H", lambda: self.heartbeat_ms, self._set_heartbeat_ms
            ),
        }
        for number, axis in enumerate(self.axes):
            dictionary |= axis_objects(
                axis,
                number * protocol.AXIS_OFFSET,
                supported_modes=supported_modes,
                statusword=partial(self._statusword, axis),
                position_counts=partial(self._position_counts, number),
                velocity_rad_s=partial(self._velocity_rad_s, number),
                changed=self._command_motors,
            )
        return dictionary

    def _rpdo(self, number: int, base: int) -> Pdo:
        return Pdo(
            self._dictionary,
            protocol.RPDO_COMMUNICATION + number,
            protocol.RPDO_MAPPING + number,
            base + self._node_id,
            sends=False,
            changed=self._rewire,
        )

    def _tpdo(self, number: int, base: int) -> Pdo:
        return Pdo(
            self._dictionary,
            protocol.TPDO_COMMUNICATION + number,
            protocol.TPDO_MAPPING + number,
            base + self._node_id,
            sends=True,
            changed=self._rewire,
        )

    def _set_heartbeat_ms(self, heartbeat_ms: int) -> None:
        self.heartbeat_ms = heartbeat_ms
        self._heartbeat.set_period(heartbeat_ms / 1e3)

    def _set_consumer(self, consumer: int) -> None:
        self.consumer = consumer
        self._master.set_timeout((consumer & 0xFFFF) / 1e3)
        self._rewire()

    def _statusword(self, axis: Axis) -> int:
        return axis.statusword(remote=self.nmt_state is NmtState.OPERATIONAL)

    def _position_counts(self, axis: int) -> int:
        return self._counts[axis]

    def _velocity_rad_s(self, axis: int) -> float:
        (earlier_s, earlier), (later_s, later) = self._at_syncs
        if later_s <= earlier_s:
            return 0.0
        moved = protocol.wrap_int32(later[axis] - earlier[axis])
        return moved / (later_s - earlier_s) / self._counts_per_rad

    def _error_register(self) -> int:
        codes = [axis.error_code for axis in self.axes]
        register = protocol.ERROR_REGISTER_GENERIC if any(codes) else 0
        if any(code >> 8 == 0x81 for code in codes):
            register |= protocol.ERROR_REGISTER_COMMUNICATION
        return register

    # ------------------------------------------------------------ what comes in
    def _rewire(self) -> None:
        """Look up once, not at each frame, who handles which identifier."""
        node = self._node_id
        self._handlers = {
            protocol.NMT_ID: self._on_nmt,
            protocol.SDO_REQUEST_BASE + node: self._on_sdo,
        }
        if self.consumer & 0xFFFF:
            master = protocol.HEARTBEAT_BASE + (self.consumer >> 16 & 0x7F)
            self._handlers[master] = lambda _data: self._master.feed()
        operational = self.nmt_state is NmtState.OPERATIONAL
        if operational:
            self._handlers[protocol.SYNC_ID] = self._on_sync
            for rpdo in self._rpdos:
                if rpdo.in_service:
                    self._handlers[rpdo.can_id] = partial(self._on_rpdo, rpdo)
        for tpdo, event in zip(self._tpdos, self._events, strict=True):
            runs = operational and tpdo.in_service and tpdo.on_event
            event.set_period(tpdo.event_ms / 1e3 if runs else 0)

    def _receive(self, frame: CanFrame) -> None:
        handler = self._handlers.get(frame.can_id)
        if handler and not frame.extended and frame.remote_length is None:
            handler(frame.data)

    def _on_nmt(self, data: bytes) -> None:
        if len(data) < 2 or data[1] not in {0, self._node_id}:
            return
        match data[0]:
            case NmtCommand.START:
                self._enter(NmtState.OPERATIONAL)
            case NmtCommand.STOP:
                self._enter(NmtState.STOPPED)
            case NmtCommand.PRE_OPERATIONAL:
                self._enter(NmtState.PRE_OPERATIONAL)
            case NmtCommand.RESET_NODE:
                for axis in self.axes:
                    axis.power_off()
                self._reset_communication()
            case NmtCommand.RESET_COMMUNICATION:
                self._reset_communication()

    def _on_sdo(self, data: bytes) -> None:
        if self.nmt_state is NmtState.STOPPED:
            return
        self._sample()
        answer = self._sdo.answer(data)
        self._command_motors()
        if answer is not None:
            self._adapter.send(protocol.SDO_RESPONSE_BASE + self._node_id, answer)

    def _on_rpdo(self, rpdo: Pdo, data: bytes) -> None:
        if rpdo.on_event:
            self._apply(rpdo, data)
            self._command_motors()
        else:
            rpdo.received = data

    def _apply(self, rpdo: Pdo, data: bytes) -> None:
        if not rpdo.apply(data):
            self._send_emcy(_EMCY_PDO_LENGTH, 0)

    def _on_sync(self, _data: bytes) -> None:
        for rpdo in self._rpdos:
            if rpdo.received is not None:
                data, rpdo.received = rpdo.received, None
                self._apply(rpdo, data)
        self._command_motors()
        self._sample()
        self._at_syncs = [self._at_syncs[1], (asyncio.get_running_loop().time(), self._counts)]
        for tpdo in self._tpdos:
            if tpdo.in_service and tpdo.due():
                self._send_pdo(tpdo)

    # ------------------------------------------------------------ what goes out
    def _send_pdo(self, tpdo: Pdo) -> None:
        data = tpdo.pack()
        self._sent[tpdo] = data
        self._adapter.send(tpdo.can_id, data)

    def _send_heartbeat(self) -> None:
        self._adapter.send(protocol.HEARTBEAT_BASE + self._node_id, bytes([self.nmt_state]))

    def _send_emcy(self, code: int, axis_number: int) -> None:
        if self.nmt_state is not NmtState.STOPPED:
            data = protocol.encode_emcy(code, self._error_register(), bytes([axis_number]))
            self._adapter.send(protocol.EMCY_BASE + self._node_id, data)

    # ------------------------------------------------------------ what happens
    def _sample(self) -> None:
        az_rad, el_rad = self._motors.position_rad()
        scale = self._counts_per_rad
        self._counts = (
            protocol.wrap_int32(math.floor(az_rad * scale + 0.5)),
            protocol.wrap_int32(math.floor(el_rad * scale + 0.5)),
        )

    def _command_motors(self) -> None:
        # Also when nothing changed: a command holds for one time-out only.
        az, el = self.axes
        self._motors.command_velocity_rad_s(az.velocity_rad_s, el.velocity_rad_s)

    def _axis_changed(self) -> None:
        self._command_motors()
        in_error = any(axis.error_code for axis in self.axes)
        if self._in_error and not in_error:
            self._send_emcy(protocol.EMCY_NO_ERROR, 0)
        self._in_error = in_error
        if self.nmt_state is NmtState.OPERATIONAL:
            for tpdo in self._tpdos:
                if tpdo.in_service and tpdo.on_event and tpdo.pack() != self._sent.get(tpdo):
                    self._send_pdo(tpdo)

    def _master_lost(self) -> None:
        for axis in self.axes:
            axis.fault(protocol.EMCY_HEARTBEAT_LOST)
        self._send_emcy(protocol.EMCY_HEARTBEAT_LOST, 0)

    def _enter(self, state: NmtState) -> None:
        """Change the NMT state; leaving OPERATIONAL stops the motors, entering it sends event TPDOs."""
        if state is self.nmt_state:
            return
        self.nmt_state = state
        if state is not NmtState.OPERATIONAL:
            for axis in self.axes:
                axis.quick_stop()
        self._rewire()
        if state is NmtState.OPERATIONAL:
            for tpdo in self._tpdos:
                if tpdo.in_service and tpdo.on_event:
                    self._send_pdo(tpdo)

    def _reset_communication(self) -> None:
        self._enter(NmtState.PRE_OPERATIONAL)
        self._set_heartbeat_ms(0)
        self._set_consumer(0)
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.reset()
        self._rewire()
        self._adapter.send(protocol.HEARTBEAT_BASE + self._node_id, bytes([NmtState.BOOT_UP]))
