"""The bench about the devices: where the star truly was, and what shall go wrong. No device itself.

ZeroMQ REP on 127.0.0.1, msgpack. Known limitation: history is as long as ``plant.history_s``.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Mapping, Sequence
from typing import TypeVar

import msgspec
import numpy as np
import zmq
import zmq.asyncio
from pydantic import ValidationError

from fitctl.config import ARCSEC_PER_RAD, Fault, Fringes
from fitctl.config.base import must_be
from fitctl.mocks.faults import Faults, UnknownFault, check_fault, known_kind
from fitctl.model.metrology.fringes import mean_visibility
from fitctl.model.plant import Plant
from fitctl.model.stellar_part import StellarPart
from fitctl.text import UNDECODABLE

_MAX_QUESTION_BYTES = 1024
_TIMEOUT_MS = 5000
_VISIBILITY_EVERY = 10  # steps of the plant


class _Question(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """What a bench can be asked."""


class ResidualQuestion(_Question, frozen=True):
    """Asks how far the star was from a target, from one host time to another."""

    loop: str
    start_s: float
    end_s: float
    target_az_px: float
    target_el_px: float


class Residual(msgspec.Struct, frozen=True):
    """RMS distance of the pointing spot from the target, every plant step; NaN without samples."""

    az_rms_px: float
    el_rms_px: float
    samples: int
    error: str = ""


class BeamQuestion(_Question, frozen=True):
    """Asks how far a metrology loop's beam was from the centre of its photodiodes."""

    loop: str
    start_s: float
    end_s: float


class Beam(msgspec.Struct, frozen=True):
    """RMS of the beam's angle from the centre, every plant step; NaN without samples."""

    az_rms_arcsec: float
    el_rms_arcsec: float
    samples: int
    error: str = ""


class VisibilityQuestion(_Question, frozen=True):
    """Asks what the tilt between two loops' stars, each from its target, left of their fringes."""

    loops: tuple[str, str]
    targets_px: tuple[tuple[float, float], tuple[float, float]]
    aperture_m: float
    wavelength_m: float
    start_s: float
    end_s: float


class Visibility(msgspec.Struct, frozen=True):
    """The mean visibility; NaN without samples."""

    mean: float
    error: str = ""


class StagesQuestion(_Question, frozen=True):
    """Asks where the stages of a loop are, whatever their devices say."""

    loop: str


class StagesNow(msgspec.Struct, frozen=True):
    """Motor angles, and the stacks' volts in the D/A's scale, where it has them: az, el; stack 1 to 3."""

    motor_rad: list[float]
    stack_v: list[float]
    error: str = ""


class SetFault(_Question, frozen=True):
    """Begin a fault; fields as in :class:`fitctl.config.Fault`. ``rig`` is whose mocks are meant, empty any."""

    device: str
    kind: str
    part: str = ""
    value: float | None = None
    for_s: float | None = None
    probability: float = 1.0
    rig: str = ""


class ClearFaults(_Question, frozen=True):
    """End faults: of a device or, without one, of all; of a kind or all; of a part or all."""

    device: str = ""
    kind: str = ""
    part: str = ""
    rig: str = ""


class ListFaults(_Question, frozen=True):
    """Ask what is wrong now."""

    rig: str = ""


class ActiveFault(msgspec.Struct, frozen=True):
    """A fault that is there now; fields as in :class:`fitctl.config.Fault`."""

    device: str
    kind: str
    part: str
    value: float | None
    for_s: float | None
    probability: float


class FaultsNow(msgspec.Struct, frozen=True):
    """What is wrong now, or why the question could not be obeyed; and which rig's mocks these are."""

    active: list[ActiveFault]
    error: str = ""
    rig: str = ""


_FaultQuestion = SetFault | ClearFaults | ListFaults
_AnyQuestion = (
    ResidualQuestion | BeamQuestion | VisibilityQuestion | StagesQuestion | _FaultQuestion
)
_Answer = TypeVar("_Answer", Residual, Beam, Visibility, StagesNow, FaultsNow)


class FaultTable:
    """The faults of all mock devices.

    Parameters
    ----------
    devices : mapping
        Of each device by its name, such as ``right.mdt693``.
    """

    def __init__(self, devices: Mapping[str, Faults]) -> None:
        self._devices = devices
        self._timers: list[asyncio.TimerHandle] = []

    def schedule(self, faults: Sequence[Fault]) -> None:
        """Begin each fault at its time from now.

        Raises
        ------
        UnknownFault
            If a device has none such; then none is begun.
        """
        for fault in faults:
            check_fault(fault, self._of(fault.device).kinds)
        loop = asyncio.get_running_loop()
        for fault in faults:
            begin = self._of(fault.device).set
            self._timers.append(loop.call_later(fault.at_s, begin, fault))

    def answer(self, question: _FaultQuestion) -> FaultsNow:
        """Obey, and say what is wrong then."""
        try:
            if isinstance(question, SetFault):
                fields = msgspec.structs.asdict(question)
                del fields["rig"]
                fault = Fault(**fields)
                self._of(fault.device).set(fault)
            elif isinstance(question, ClearFaults):
                names = [question.device] if question.device else list(self._devices)
                for name in names:
                    faults = self._of(name)
                    if question.device and question.kind:
                        known_kind(name, question.kind, question.part, faults.kinds)
                    faults.clear(question.kind, question.part)
        except UnknownFault as error:
            return FaultsNow([], str(error))
        except ValidationError as error:
            return FaultsNow([], _wrong(error))
        except (ArithmeticError, ValueError, struct.error) as error:
            return FaultsNow([], f"the mock device cannot have this value: {error}")
        active = [fault for faults in self._devices.values() for fault in faults.active]
        return FaultsNow([ActiveFault(**fault.model_dump(exclude={"at_s"})) for fault in active])

    def close(self) -> None:
        """Nothing goes wrong any more."""
        for timer in self._timers:
            timer.cancel()
        for faults in self._devices.values():
            faults.close()

    def _of(self, device: str) -> Faults:
        if device not in self._devices:
            msg = f"no device is named {device}; there are {', '.join(self._devices)}"
            raise UnknownFault(msg)
        return self._devices[device]


class Bench:
    """Answers questions about the truth of one rig's mocks until stopped."""

    def __init__(
        self,
        rig_name: str,
        plant: Plant,
        faults: FaultTable,
        started_s: float,
        port: int,
        *,
        or_any_port: bool = False,
    ) -> None:
        self._rig_name = rig_name
        self._plant = plant
        self._faults = faults
        self._started_s = started_s
        self._port = port
        self._or_any_port = or_any_port
        self._context = zmq.asyncio.Context()
        self._socket = self._context.socket(zmq.REP)
        self._task: asyncio.Task | None = None

    def start(self) -> int:
        """Listen; returns the port."""
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, _MAX_QUESTION_BYTES)
        try:
            self._socket.bind(f"tcp://127.0.0.1:{self._port or '*'}")
        except zmq.ZMQError:
            if not self._or_any_port:
                raise
            self._socket.bind("tcp://127.0.0.1:*")
        endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self._port = int(endpoint.rpartition(":")[2])
        self._task = asyncio.create_task(self._serve())
        return self._port

    async def stop(self) -> None:
        """Close."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self._socket.close()
        self._context.term()

    async def _serve(self) -> None:
        while True:
            answer = self._answer(await self._socket.recv())
            await self._socket.send(msgspec.msgpack.encode(answer))

    def _answer(self, message: bytes) -> Residual | Beam | Visibility | StagesNow | FaultsNow:
        try:
            question = msgspec.msgpack.decode(message, type=_AnyQuestion)
        except UNDECODABLE as error:
            return Residual(np.nan, np.nan, 0, f"not a question: {error}")
        match question:
            case ResidualQuestion():
                return self._residual(question)
            case BeamQuestion():
                return self._beam(question)
            case VisibilityQuestion():
                return self._visibility(question)
            case StagesQuestion():
                return self._stages(question)
        return self._of_faults(question)

    def _of_faults(self, question: _FaultQuestion) -> FaultsNow:
        if question.rig not in {"", self._rig_name}:
            why_not = f"these are the mocks of rig {self._rig_name}, and not of rig {question.rig}"
            return FaultsNow([], why_not, self._rig_name)
        return msgspec.structs.replace(self._faults.answer(question), rig=self._rig_name)

    def _stages(self, question: StagesQuestion) -> StagesNow:
        part = self._plant.loops.get(question.loop)
        if part is None:
            return StagesNow([], [], f"no loop is named {question.loop}")
        stack_v = part.state.stack_v[0].tolist() if isinstance(part, StellarPart) else []
        return StagesNow(part.state.motor_rad[0].tolist(), stack_v)

    def _residual(self, question: ResidualQuestion) -> Residual:
        if not _times(question):
            return Residual(np.nan, np.nan, 0, "start_s and end_s must be times")
        part = self._plant.stellar_loops.get(question.loop)
        if part is None:
            return Residual(np.nan, np.nan, 0, f"no loop is named {question.loop}")
        track_px = part.history_px(*self._span_s(question))[:, 0, 0, :]
        if len(track_px) == 0:
            return Residual(np.nan, np.nan, 0, "no history for that time")
        error_px = track_px - [question.target_az_px, question.target_el_px]
        az, el = np.sqrt(np.mean(error_px**2, axis=0))
        return Residual(float(az), float(el), len(track_px))

    def _beam(self, question: BeamQuestion) -> Beam:
        if not _times(question):
            return Beam(np.nan, np.nan, 0, "start_s and end_s must be times")
        part = self._plant.metrology_loops.get(question.loop)
        if part is None:
            return Beam(np.nan, np.nan, 0, f"no metrology loop is named {question.loop}")
        track_m = part.history_offset_m(*self._span_s(question))[:, 0]
        if len(track_m) == 0:
            return Beam(np.nan, np.nan, 0, "no history for that time")
        az_m, el_m = np.sqrt(np.mean(track_m**2, axis=0))
        arcsec_per_m = ARCSEC_PER_RAD / part.sensor.link_length_m
        return Beam(float(az_m * arcsec_per_m), float(el_m * arcsec_per_m), len(track_m))

    def _visibility(self, question: VisibilityQuestion) -> Visibility:
        if not _times(question):
            return Visibility(np.nan, "start_s and end_s must be times")
        parts = [self._plant.stellar_loops.get(name) for name in question.loops]
        one, other = parts
        if one is None or other is None:
            return Visibility(np.nan, f"no two loops are named {', '.join(question.loops)}")
        span_s = self._span_s(question)
        # Every 5 ms: the wavefronts turn much slower.
        one_px, other_px = (
            part.history_px(*span_s)[::_VISIBILITY_EVERY, 0, 0] - np.array(target)
            for part, target in zip((one, other), question.targets_px, strict=True)
        )
        try:
            fringes = Fringes(
                loops=list(question.loops),
                aperture_m=question.aperture_m,
                wavelength_m=question.wavelength_m,
            )
        except ValidationError as error:
            return Visibility(np.nan, _wrong(error))
        tilt_rad = (one_px - other_px) / one.constants.sky_px_per_rad
        return Visibility(mean_visibility(tilt_rad, fringes))

    def _span_s(
        self, question: ResidualQuestion | BeamQuestion | VisibilityQuestion
    ) -> tuple[float, float]:
        """In the plant's time."""
        return question.start_s - self._started_s, question.end_s - self._started_s


def _wrong(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(map(str, first["loc"]))
    return f"{where}: {must_be(first)} (is {first['input']})"


def _times(question: ResidualQuestion | BeamQuestion | VisibilityQuestion) -> bool:
    return bool(np.all(np.isfinite([question.start_s, question.end_s])))


def ask_bench(port: int, question: _AnyQuestion, answer: type[_Answer]) -> _Answer:
    """Send a question to a running bench and return its answer, which is an `answer`.

    Raises
    ------
    ConnectionError
        If none answers within five seconds, or what answers is no bench.
    """
    context = zmq.Context()
    try:
        with context.socket(zmq.REQ) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(f"tcp://127.0.0.1:{port}")
            socket.send(msgspec.msgpack.encode(question))
            if not socket.poll(_TIMEOUT_MS):
                msg = f"the mock testbed's bench does not answer at 127.0.0.1:{port}"
                raise ConnectionError(msg)
            try:
                return msgspec.msgpack.decode(socket.recv(), type=answer)
            except UNDECODABLE:
                msg = f"another program answers at 127.0.0.1:{port}; expected the mocks of this fitctl"
                raise ConnectionError(msg) from None
    finally:
        context.term()
