"""Coverage-guided fuzzing of gateway and service: any payload from anybody, up to the supervisor and back.

The first byte chooses who sends: somebody on this machine, a commander's key, a viewer's, a revoked one, or the
gateway itself. The second chooses one of the commands, of the gateway one of its envelopes, the third a place
in it, and the rest is written over what is there; or the rest is all. Only ZeroMQ is left out: see
``tests/service/test_service_garbage.py``. The instrument is simulated and lives on from one input to the
next, so that commands meet it in every mode.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import msgspec
import numpy as np

from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import RecorderStatus
from fitctl.messages.command_table import COMMANDS
from fitctl.messages.commands import (
    MoveCollector,
    RecentEvents,
    RecorderReport,
    Reply,
    SequenceStatus,
    SetController,
    Shutdown,
    Status,
    decode_command,
)
from fitctl.messages.keys import AllowedKey
from fitctl.model.drives import Drive
from fitctl.service.admission import Sender
from fitctl.service.doors import Door
from fitctl.service.envelope import Passed, Report, decode_envelope
from fitctl.service.gateway import admit
from fitctl.service.intake import Intake, Limit
from fitctl.service.service import Service, Waiting
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.simulation.simulation import Simulation

_OWNER = Sender("owner@here", "process 1", "commander", is_local=True)
_KEYS = (
    AllowedKey(name="anna", role="commander", public="a" * 40),
    AllowedKey(name="bob", role="viewer", public="b" * 40),
    None,  # revoked
)
_GATEWAY = "the gateway"
_SENDERS = (_OWNER, *_KEYS, _GATEWAY)
_COMMANDS_PER_S = 1000.0
_SLOW = SetController | Shutdown  # a design takes seconds; after a shutdown nothing is obeyed
_STATUS = SequenceStatus(run="a", name="night", state="running", steps=3)
_DRIVE = Drive(channel="fsm_az", shape="sine", amplitude=0.5, frequency_hz=1.0, duration_s=2.0)
_VALUES = {
    "az_px": 21.5,
    "el_px": 19.0,
    "az_sky_arcsec": 1.5,
    "el_sky_arcsec": -2.0,
    "az_urad": 10.0,
    "el_urad": -5.0,
    "search_radius_sky_arcsec": 100.0,
    "field_overlap": 0.3,
    "expected_az_sky_arcsec": 20.0,
    "expected_el_sky_arcsec": -20.0,
    "star_flux_dn": 30_000.0,
    "rate_az_sky_arcsec_s": 0.3,
    "rate_el_sky_arcsec_s": -0.2,
    "name": "flux_low",
    "drives": [_DRIVE],
    "action": "pause",
    "status": _STATUS,
    "kind": "sine",
    "direction_deg": 30.0,
    "range_mm": 20.0,
    "velocity_mm_s": 0.1,
    "amplitude_mm": 1.0,
    "frequency_hz": 0.05,
    "rms_mm_s": 0.2,
    "correlation_s": 5.0,
    "design_json": "{}",
    "text": "air 0.45 px, 6 Hz line 0.05 px",
    "evaluated_s": 60.0,
    "present_px": 0.02,
    "learnt_px": 0.015,
    "bound_px": 0.014,
    "learnt_camera_px": 0.018,
    "measured_px": 0.022,
    "noise_px": 0.01,
    "worth_it": True,
    "fits": True,
    "classifying_rate_hz": 48.0,
    "rate_hz": 48.0,
    "duration_s": 2.0,
}
_RECORDER = RecorderStatus(time_s=1.0, path="x.mcap", records=5, lost=2, bytes_written=9)
# Where a field of one command means something else.
_OWN_VALUES = {RecorderReport: {"status": _RECORDER}, MoveCollector: {"action": "start"}}
_COMMANDS = [
    msgspec.msgpack.encode(
        {"type": row.name, "loop": "right"}
        | {name: (_VALUES | _OWN_VALUES.get(row.make, {}))[name] for name in row.fields}
    )
    for row in COMMANDS
]
_ENVELOPES = [
    msgspec.msgpack.encode(envelope)
    for envelope in (
        *(Passed(name="anna", role="commander", address="", payload=one) for one in _COMMANDS),
        Passed(name="bob", role="viewer", address="", payload=_COMMANDS[0]),
        Report(keys=[key for key in _KEYS if key], events=[("info", "listening")]),
        Report(keys=[], events=[]),
    )
]


class _Door(Door):
    """Keeps replies; has no socket."""

    def __init__(self) -> None:
        self.replies: list[Reply] = []

    def answer(self, identity: bytes, tag: bytes, payload: bytes) -> bool:
        self.replies.append(msgspec.msgpack.decode(payload, type=Reply))
        return True


def _service() -> tuple[Service, Simulation]:
    rig = load_rig(default_rig_path(), [f"service.commands_per_s={_COMMANDS_PER_S}"])
    buffer = TelemetryBuffer()
    simulation = Simulation(
        rig, 0, star_offset_px=np.array([3.0, 1.0]), record=buffer.add, history_s=1.0
    )
    state = ServiceState(
        pid=os.getpid(),
        wall_minus_monotonic_s=0.0,
        scheduling="",
        records_lost=lambda: 0,
        records_offered=lambda: 0,
    )
    with tempfile.TemporaryDirectory() as folder:
        service = Service(simulation.supervisor, buffer, Path(folder), state, simulation.clock)
        service._ending.set()
        service.run()  # lets go of its sockets, which nothing here needs and which would hold up the end
    return service, simulation


_SERVICE, _SIMULATION = _service()
_INTAKE = Intake(_COMMANDS_PER_S, _SERVICE._supervisor.loops)
# Every refusal is to be seen here.
_SERVICE._intake._answers = _INTAKE._answers = Limit(_COMMANDS_PER_S, _COMMANDS_PER_S)


def TestOneInput(data: bytes) -> None:  # noqa: N802 - atheris wants this name
    """Every payload is answered once, a stop at the latest with the next step; who may not, does not."""
    sender = _SENDERS[data[0] % len(_SENDERS)] if data else None
    payload = _payload(data[1:], _ENVELOPES if sender == _GATEWAY else _COMMANDS)
    envelope = decode_envelope(payload) if sender == _GATEWAY else None
    said = envelope.payload if isinstance(envelope, Passed) else payload
    if isinstance(decode_command(said), _SLOW):
        return
    door = _Door()
    _SERVICE._gateway = door
    if isinstance(sender, str):  # the gateway itself
        _SERVICE._open(b"gateway", b"route", payload)
        role, replies = (envelope.role, 1) if isinstance(envelope, Passed) else ("", 0)
    elif isinstance(sender, Sender):
        _SERVICE._receive(Waiting(door, b"identity", b"tag", sender), payload)
        role, replies = sender.role, 1
    else:
        _through_the_gateway(sender, payload, door)
        role, replies = sender.role if sender else "", 1
    _SIMULATION.supervisor.step()
    _SIMULATION.ticks.clear()
    _SERVICE._send_replies()
    if len(door.replies) != replies:
        raise AssertionError(f"{payload!r} has {len(door.replies)} replies, not {replies}")
    may = role == "commander" or (role and isinstance(decode_command(said), Status | RecentEvents))
    if any(reply.accepted for reply in door.replies) and not may:
        raise AssertionError(f"{payload!r} of {sender} was accepted")
    for name, loop in _SIMULATION.supervisor.loops.items():
        place_rad = _SIMULATION.supervisor.servos[name].setpoint_rad
        if not (np.isfinite(place_rad).all() and np.isfinite(loop.target_px).all()):
            raise AssertionError(f"{payload!r} makes {place_rad} rad, {loop.target_px} px")


def _through_the_gateway(key: AllowedKey | None, payload: bytes, door: _Door) -> None:
    admitted = admit(key, "10.0.0.1", payload, _INTAKE, _SIMULATION.clock.now_s())
    if isinstance(admitted, Passed):
        _SERVICE._open(b"gateway", b"route", msgspec.msgpack.encode(admitted))
    else:
        door.answer(b"identity", b"tag", msgspec.msgpack.encode(admitted))


def _payload(data: bytes, whole: list[bytes]) -> bytes:
    if len(data) < 2 or data[0] >= len(whole):
        return data[1:]
    message, place = whole[data[0]], data[1]
    return message[:place] + data[2:] + message[place + len(data) - 2 :]


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
