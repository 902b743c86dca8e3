"""The mock drive as one CANopen node: NMT, heartbeats, SYNC, PDOs, SDO, EMCY, and its two axes.

The drive reads its encoders and commands its motors; how the motors move is the plant's business.
`fit_drive.eds` beside this file lists its objects for other CANopen tools.

Known limitations: those of the modules beside this one, and: SYNC has no counter, no node guarding (only
heartbeats), no LSS, no TIME, no parameter store, no limit switches or brake; controlwords are obeyed in
every NMT state but STOPPED; actual velocity (606C) is the encoder's difference between the last two SYNCs.
All links down does not stop it by itself: the loss of the master's heartbeat does, once it was seen.
Invented constants: identity, names and versions (objects.py); that leaving NMT state OPERATIONAL is a quick
stop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial

from fitctl.config import Siderostat
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import NmtCommand, NmtState, wrap_int32
from fitctl.mocks.cia402.axis import Axis, Command
from fitctl.mocks.cia402.dictionary import Dictionary, Entry, SdoServer, constant
from fitctl.mocks.cia402.emergency import Emergencies
from fitctl.mocks.cia402.objects import axis_objects, identity_objects
from fitctl.mocks.cia402.pdo import Pdo
from fitctl.mocks.cia402.slcan import CanFrame, SharedBus, SlcanAdapter
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults
from fitctl.mocks.motors import AXES, AXIS_FAULTS, FaultyMotors, Motors
from fitctl.mocks.timers import Periodic, Watchdog

FAULTS = (
    WIRE_FAULTS
    | AXIS_FAULTS
    | {
        "link_loss": FaultKind("the CAN cable between adapter and drive is cut"),
        "amplifier_fault": AXIS_FAULTS["amplifier_fault"]._replace(
            unit="error code of CiA 402", value=protocol.ERROR_OVER_CURRENT, least=0, most=0xFFFF
        ),
        "following_error": FaultKind(
            "the drive finds that a motor does not follow: fault 0x8611", parts=AXES
        ),
    }
)
BOTH_VELOCITY_MODES = 1 << (protocol.PROFILE_VELOCITY - 1) | 1 << (
    protocol.CYCLIC_SYNCHRONOUS_VELOCITY - 1
)
PDOS_EACH_WAY = 4
_CONTROL_S = 0.002  # how often the axes' ramps go on also without SYNC


class Encoders:
    """What the drive has last read of its motors.

    Parameters
    ----------
    motors : FaultyMotors

    Attributes
    ----------
    counts : pair of int
        Both counters as last sampled.
    """

    def __init__(self, motors: FaultyMotors) -> None:
        self.counts = (0, 0)
        self._motors = motors
        self._earlier = self._later = (0.0, self.counts)

    def sample(self) -> None:
        """Read both."""
        az_counts, el_counts = self._motors.position_counts()
        self.counts = (wrap_int32(az_counts), wrap_int32(el_counts))

    def latch(self, now_s: float) -> None:
        """Keep the sample, and its time, for the velocity."""
        self._earlier, self._later = self._later, (now_s, self.counts)

    def velocity_rad_s(self, axis: int) -> float:
        """Mean velocity between the last two samples that were latched."""
        (earlier_s, earlier), (later_s, later) = self._earlier, self._later
        if later_s <= earlier_s:
            return 0.0
        moved = wrap_int32(later[axis] - earlier[axis])
        return moved / (later_s - earlier_s) / self._motors.counts_per_rad


class Cia402DriveMock:
    """A two-axis drive on an SLCAN adapter, alone or with others.

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
    adapter : SlcanAdapter, optional
        Where the drive shares a bus with others; whoever made it starts and stops it.

    Attributes
    ----------
    faults : Faults
    dictionary : dict
        Its objects, by index and subindex.
    """

    def __init__(
        self,
        siderostat: Siderostat,
        motors: Motors,
        *,
        port: int,
        supported_modes: int = BOTH_VELOCITY_MODES,
        adapter: SlcanAdapter | None = None,
    ) -> None:
        self.faults = Faults(FAULTS)
        self._port = port
        self._node_id = siderostat.device.node_id
        self._motors = FaultyMotors(motors, self.faults, siderostat.encoder_counts_per_rev)
        self._encoders = Encoders(self._motors)
        self._adapter = (
            SlcanAdapter(siderostat.device.bitrate, self.faults, self._receive)
            if adapter is None
            else SharedBus(adapter, self.faults, self._receive)
        )
        self.nmt_state = NmtState.STOPPED
        self.axes = tuple(
            Axis(partial(self._motors.set_enabled, number), self._axis_changed)
            for number in range(len(AXES))
        )
        self.heartbeat_ms = 0
        self.consumer = 0
        self._controlled_s = 0.0
        self._emergencies = Emergencies(self.axes, self._send_emcy)
        self._heartbeat = Periodic(self._send_heartbeat)
        self._control = Periodic(self._go_on)
        self._master = Watchdog(self._master_lost)
        self.dictionary = self._objects(supported_modes)
        self._sdo = SdoServer(self.dictionary)
        self._rpdos = self._pdos(
            protocol.RPDO_COMMUNICATION, protocol.RPDO_MAPPING, protocol.RPDO1_BASE, sends=False
        )
        self._tpdos = self._pdos(
            protocol.TPDO_COMMUNICATION, protocol.TPDO_MAPPING, protocol.TPDO1_BASE, sends=True
        )
        self._events = tuple(Periodic(partial(self._send_pdo, tpdo)) for tpdo in self._tpdos)
        self._handlers: dict[int, Callable[[bytes], None]] = {}
        self.faults.on_change(self._fault_changed)

    async def start(self) -> int:
        """Power up: listen, boot, wait in PRE-OPERATIONAL. Returns the TCP port."""
        port = await self._adapter.start(self._port)
        self._control.set_period(_CONTROL_S)
        self._reset_communication()
        return port

    async def stop(self) -> None:
        """Power down: motors without current, every connection closed."""
        self.faults.close()
        self._power_off()
        self._control.set_period(0)
        await self._adapter.stop()

    # ------------------------------------------------------------ the objects
    def _objects(self, supported_modes: int) -> Dictionary:
        dictionary = identity_objects(self._node_id) | self._emergencies.objects()
        dictionary |= {
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
                velocity_rad_s=partial(self._encoders.velocity_rad_s, number),
                changed=self._command_motors,
            )
        return dictionary

    def _pdos(self, communication: int, mapping: int, base: int, *, sends: bool) -> tuple[Pdo, ...]:
        return tuple(
            Pdo(
                self.dictionary,
                communication + number,
                mapping + number,
                base + number * protocol.PDO_BASE_STEP + self._node_id,
                sends=sends,
                changed=self._rewire,
            )
            for number in range(PDOS_EACH_WAY)
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
        return self._encoders.counts[axis]

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
        if frame.extended:
            return
        if frame.remote_length is not None:
            self._on_remote(frame.can_id)
            return
        handler = self._handlers.get(frame.can_id)
        if handler:
            handler(frame.data)

    def _on_remote(self, can_id: int) -> None:
        if self.nmt_state is NmtState.OPERATIONAL:
            for tpdo in self._tpdos:
                if tpdo.in_service and tpdo.can_id == can_id and tpdo.answers_remote:
                    self._encoders.sample()
                    self._adapter.send(can_id, tpdo.remote_answer())

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
                self._power_off()
                self._reset_communication()
                self._update_causes()
            case NmtCommand.RESET_COMMUNICATION:
                self._reset_communication()

    def _on_sdo(self, data: bytes) -> None:
        if self.nmt_state is NmtState.STOPPED:
            return
        self._encoders.sample()
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
            self._emergencies.report(protocol.EMCY_PDO_TOO_SHORT, 0)

    def _on_sync(self, _data: bytes) -> None:
        self._encoders.sample()
        self._encoders.latch(asyncio.get_running_loop().time())
        for rpdo in self._rpdos:
            if rpdo.received is not None:
                data, rpdo.received = rpdo.received, None
                self._apply(rpdo, data)
        self._command_motors()
        for tpdo in self._tpdos:
            if tpdo.in_service and tpdo.due():
                self._send_pdo(tpdo)

    # ------------------------------------------------------------ what goes out
    def _send_pdo(self, tpdo: Pdo) -> None:
        self._adapter.send(tpdo.can_id, tpdo.message())

    def _send_events(self) -> None:
        """The TPDOs that are sent on change, if their contents have changed."""
        if self.nmt_state is NmtState.OPERATIONAL:
            for tpdo in self._tpdos:
                if tpdo.in_service and tpdo.on_event and tpdo.changed:
                    self._send_pdo(tpdo)

    def _send_heartbeat(self) -> None:
        self._adapter.send(protocol.HEARTBEAT_BASE + self._node_id, bytes([self.nmt_state]))

    def _send_emcy(self, data: bytes) -> None:
        if self.nmt_state is not NmtState.STOPPED:
            self._adapter.send(protocol.EMCY_BASE + self._node_id, data)

    # ------------------------------------------------------------ the motors
    def _command_motors(self) -> None:
        # Also when nothing changed: a command holds for one time-out only.
        now_s = asyncio.get_running_loop().time()
        elapsed_s, self._controlled_s = now_s - self._controlled_s, now_s
        for axis, counts in zip(self.axes, self._encoders.counts, strict=True):
            axis.advance(elapsed_s, counts, 1 / self._motors.counts_per_rad)
        az_rad_s, el_rad_s = (axis.demand_rad_s for axis in self.axes)
        self._motors.command_velocity_rad_s(az_rad_s, el_rad_s)

    def _go_on(self) -> None:
        """Ramps and limits also without SYNC; at 500 Hz there is nothing left to do here."""
        since_s = asyncio.get_running_loop().time() - self._controlled_s
        if since_s >= _CONTROL_S and any(axis.moves for axis in self.axes):
            self._encoders.sample()
            self._command_motors()
            self._send_events()

    # ------------------------------------------------------------ what happens
    def _axis_changed(self) -> None:
        self._command_motors()
        self._emergencies.update()
        self._send_events()

    def _fault_changed(self, kind: str) -> None:
        self._adapter.severed = self.faults.value("link_loss") is not None
        without_power = self.faults.value("reboot") is not None
        if kind == "reboot":
            self._power_off()
            if not without_power:
                self._reset_communication()
        if not without_power:
            self._update_causes()
            self._command_motors()

    def _update_causes(self) -> None:
        """A cause puts its axis in fault, and no reset helps before it is gone."""
        for number, (axis, part) in enumerate(zip(self.axes, AXES, strict=True)):
            cause = self._cause(part)
            axis.fault_persists = cause is not None
            if cause is not None and axis.fault(cause):
                self._emergencies.report(cause, number + 1)

    def _cause(self, part: str) -> int | None:
        """Error code of what is wrong with an axis now."""
        code = self.faults.value("amplifier_fault", part)
        if code is not None:
            return int(code)
        fails = self.faults.value("following_error", part) is not None
        return protocol.ERROR_FOLLOWING if fails else None

    def _master_lost(self) -> None:
        """The master's heartbeat is missing: each axis reacts as its object 6007 says."""
        for axis in self.axes:
            if axis.abort_option == protocol.ABORT_IS_FAULT:
                axis.fault(protocol.EMCY_HEARTBEAT_LOST)
            elif axis.abort_option == protocol.ABORT_DISABLES:
                axis.command(Command.DISABLE_VOLTAGE)
            elif axis.abort_option == protocol.ABORT_IS_QUICK_STOP:
                axis.command(Command.QUICK_STOP)
        self._emergencies.report(protocol.EMCY_HEARTBEAT_LOST, 0)

    def _enter(self, state: NmtState) -> None:
        """Change the NMT state; leaving OPERATIONAL stops the motors, entering it sends event TPDOs."""
        if state is self.nmt_state:
            return
        self.nmt_state = state
        if state is not NmtState.OPERATIONAL:
            for axis in self.axes:
                axis.command(Command.QUICK_STOP)
        self._rewire()
        self._send_events()

    def _power_off(self) -> None:
        """Motors without current, and nothing remembered."""
        self._enter(NmtState.STOPPED)
        self._heartbeat.set_period(0)
        self._master.set_timeout(0)
        for axis in self.axes:
            axis.power_off()
        self._emergencies.power_off()

    def _reset_communication(self) -> None:
        self._enter(NmtState.PRE_OPERATIONAL)
        self._set_heartbeat_ms(0)
        self._set_consumer(0)
        self._sdo.reset()
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.reset()
        self._rewire()
        self._adapter.send(protocol.HEARTBEAT_BASE + self._node_id, bytes([NmtState.BOOT_UP]))
