"""Substitutes for the devices in a replay: each behaves as the log recorded of its original."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.pair import LEARNT
from fitctl.drivers import interface
from fitctl.drivers.interface import (
    AzEl,
    CameraCounts,
    DeviceError,
    DeviceIdentity,
    DeviceRefused,
    DiodeReading,
    Frame,
    ServoReading,
)
from fitctl.logging.records import (
    CAMERA,
    ControllerChange,
    DeviceFailure,
    DevicesOpened,
    ExperimentStart,
    InjectionRecord,
    ModeChange,
    OutputsFound,
)
from fitctl.replay.log import LoggedStep
from fitctl.stages.injector import Injection, Injector
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.servo import ServoState, ServoTiming, SiderostatServo
from fitctl.supervisor.power import Opened, close_devices, open_devices

Floats = NDArray[np.float64]
_NOBODY = DeviceIdentity("fitctl", "log", "", "")


class LoggedClock:
    """A clock that shows the time last set; nothing waits on it."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def set(self, now_s: float) -> None:
        """It is this late; what is not a number changes nothing."""
        if not math.isnan(now_s):
            self._now_s = now_s

    def now_s(self) -> float:
        """As last set."""
        return self._now_s

    def sleep_until(self, deadline_s: float) -> None:
        """At once."""


def logged_error(kind: str, text: str) -> DeviceError:
    """An error of a device as it was logged: its class, and all of its text."""
    of = getattr(interface, kind, None)
    if not (isinstance(of, type) and issubclass(of, DeviceError)):
        of = DeviceError
    return of.__new__(of, text)  # its parts are in the text already


def failures(step: LoggedStep, loop: str) -> dict[str, DeviceError]:
    """By device, what failed in a step."""
    return {
        message.device: logged_error(message.kind, message.error)
        for message in step.of(DeviceFailure, loop)
    }


class NoDevice:
    """Any device, as far as a replay never speaks to it."""

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _NOBODY

    def close(self) -> None:
        """Nothing to disconnect; the same for every other command."""

    start = stop = enable = disable = reset_fault = confirm = close

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """Silence."""
        return None

    def send_v(self, volts: Floats) -> None:
        """Nothing to write to."""

    def read_v(self) -> Floats:
        """Not a number; the same for whatever else a device can be asked."""
        return np.full(3, math.nan)

    stack_volts = read_v

    def limit_v(self) -> float:
        """Not a number."""
        return math.nan


class LoggedCamera(NoDevice):
    """Gives each step the frames that came in it, or none, or the camera's error."""

    def __init__(self) -> None:
        self._frames: deque[Frame] = deque()
        self._error: DeviceError | None = None

    def load_step(self, step: LoggedStep) -> None:
        """What :meth:`next_frame` gives next."""
        self._error = next(
            (errors[CAMERA] for loop in step.ticks if CAMERA in (errors := failures(step, loop))),
            None,
        )
        self._frames.clear()
        tick = next(filter(is_stellar, step.ticks.values()), None)
        if step.frame is not None and tick is not None:  # its tick may be among the lost records
            exposed_s = tick.mid_exposure_s
            # To the last bit: the age was had by subtracting times that lie close together.
            received_s = exposed_s + tick.frame_age_s
            self._frames.extend(Frame(-1, math.nan, math.nan, _image(old)) for old in step.older)
            self._frames.append(Frame(tick.number, exposed_s, received_s, _image(step.frame)))

    def next_frame(self, timeout_s: float) -> Frame | None:
        """The step's next, oldest first."""
        if self._error is not None:
            raise self._error
        return self._frames.popleft() if self._frames else None

    def set_frame_rate(self, rate_hz: float) -> None:
        """Refuse it: the log has the frames as they came, and experiments that were accepted."""
        raise DeviceRefused(CAMERA, "log", f"{rate_hz:g} frames/s", "the frames as they came")

    def counts(self) -> CameraCounts:
        """Nobody decides by them."""
        return CameraCounts(0, 0, 0)


def _image(message: Any) -> NDArray[np.uint16]:
    return np.frombuffer(message.data, "<u2").reshape(message.height, message.width)


class LoggedServo(SiderostatServo):
    """Where the motors were, and what the servo told, at each tick; nothing moves.

    Parameters
    ----------
    name : str
    rig : Rig
    clock : LoggedClock
        Set when a tick begins.
    """

    def __init__(self, name: str, rig: Rig, clock: LoggedClock) -> None:
        super().__init__(name, rig.loops[name], NoDevice(), clock, rig.camera.period_s)
        self._logged_clock = clock
        self._tick: Any = None
        self._ticked = False
        self._moments: deque[Any] = deque()
        self._timing = ServoTiming([], 0, 0)

    def load_step(self, step: LoggedStep) -> None:
        """What is known of it in a step."""
        if self._ticked:  # else what was logged may still be to come
            self._moments.clear()
        self._ticked = self.name in step.ticks
        self._tick = step.ticks.get(self.name, self._tick)
        changes = (ModeChange, ControllerChange)
        self._moments.extend(
            record.message
            for record in step.before_tick.get(self.name, ())
            if record.kind in changes
        )
        self.fault = failures(step, self.name).get("siderostat", self.fault)
        for opened in step.of(DevicesOpened):
            if opened.loop == self.name:
                self.encoders_jumped = opened.encoders_jumped
        timing = step.timing.get(self.name)
        if timing is not None:
            late_s = [0.0] * timing.servo_periods
            self._timing = ServoTiming(late_s, timing.servo_missed, timing.servo_skipped)

    def changed(self) -> Any:
        """A mode or a controller has changed: the log's record of it; None if the log has no change here."""
        return self._moments.popleft() if self._moments else None

    @property
    def position_rad(self) -> Floats:
        """As it was taken at the step's next change of mode or controller; else the tick's, shape (2,)."""
        return self._newest("siderostat")

    def _newest(self, name: str) -> Floats:
        message = self._moments[0] if self._moments else self._tick
        return np.zeros(2) if message is None else az_el(message, name)

    def position_at(self, time_s: float) -> Floats:
        """As the tick had it, shape (2,)."""
        return az_el(self._tick, "siderostat")

    def link_position_at(self, time_s: float) -> Floats:
        """Of the siderostat of this loop's link, as this loop's tick read it, shape (2,)."""
        return np.zeros(2) if self._tick is None else az_el(self._tick, "link")

    @property
    def link_position_rad(self) -> Floats:
        """The same, as :attr:`position_rad`."""
        return self._newest("link")

    def read_state(self) -> ServoState:
        """As the tick found it; its time begins here."""
        tick = self._tick
        if tick is None:
            return super().read_state()
        self._logged_clock.set(tick.time_s - tick.compute_s)  # exact, as these are close together
        read = not math.isnan(tick.encoder_read_s)
        if read and (not self._history or self._history[-1].time_s != tick.encoder_read_s):
            position_rad = (tick.encoder_az_rad, tick.encoder_el_rad)
            self._history.append(ServoReading(tick.encoder_read_s, position_rad, True, ""))
        return ServoState(
            az_el(tick, "siderostat"),
            self._history[-1] if read else None,
            self.fault,
            tick.following_error_rad,
            tick.amplifier_round_trip_s,
        )

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _NOBODY

    def disable(self) -> None:
        """Nothing to switch off."""

    def close(self) -> None:
        """Nothing to disconnect."""

    def drain_timing(self) -> ServoTiming:
        """As the log has it of this second."""
        return self._timing


class LoggedLink:
    """Where one loop read the siderostat of its link, by its own log: loops read at times of their own.

    Parameters
    ----------
    reader : LoggedServo
        Of the loop that read it.
    """

    def __init__(self, reader: LoggedServo) -> None:
        self._reader = reader

    @property
    def position_rad(self) -> Floats:
        """As read at the step's next change of mode or controller; else the tick's, shape (2,)."""
        return self._reader.link_position_rad

    def position_at(self, time_s: float) -> Floats:
        """As the tick had it, shape (2,)."""
        return self._reader.link_position_at(time_s)


class LoggedPhotodiodes(NoDevice):
    """Give each tick the sample that it used then, or none, or the converter's error."""

    def __init__(self, loop: str) -> None:
        self._loop = loop
        self._tick: Any = None
        self._error: DeviceError | None = None

    def load_step(self, step: LoggedStep) -> None:
        """What :meth:`receive` gives next, or how it or the next request fails."""
        self._tick = step.ticks.get(self._loop)
        self._error = failures(step, self._loop).get("photodiodes")

    def receive(self) -> DiodeReading | None:
        """The tick's sample."""
        tick = self._tick
        # Where no request followed, it was here that the converter failed.
        if self._error is not None and (tick is None or math.isnan(tick.requested_s)):
            raise self._error
        if tick is None or math.isnan(tick.sampled_s):
            return None
        diodes = ("az_plus", "az_minus", "el_plus", "el_minus")
        return DiodeReading(tick.sampled_s, tuple(getattr(tick, f"diode_{d}_v") for d in diodes))

    def send_request(self) -> None:
        """Nothing to ask; fails as then."""
        if self._error is not None:
            raise self._error


class LoggedMirror(MirrorStage):
    """A mirror that ends up, at each tick, where the log says it was sent.

    What today's code wants is kept aside: the frames that follow show the mirror as it was sent then, and
    not otherwise.
    """

    def __init__(self, name: str, rig: Rig, clock: LoggedClock) -> None:
        self._logged_dac = LoggedDac(clock)
        self._logged_injector = LoggedInjector(self._logged_dac, clock)
        super().__init__(rig, name, self._logged_dac, clock, self._logged_injector)
        self._wanted_v: Floats | None = None
        self._name = name
        self._tick: Any = None

    def load_step(self, step: LoggedStep) -> None:
        """What is known of it in a step."""
        self._tick = step.ticks.get(self._name)
        failed = failures(step, self._name)
        found = step.of(OutputsFound, self._name)
        self._logged_dac.load_tick(
            self._tick, failed.get("D/A"), _stacks(found[0]) if found else None
        )
        self._logged_injector.load_step(step, self._name)
        self.injector.fault = failed.get("injector", self.injector.fault)
        self.fault = failed.get("D/A between frames")
        self.ready = self.ready and self.fault is None

    @property
    def wanted_v(self) -> Floats:
        """What today's code wants at the D/A, shape (3,)."""
        return self.stack_v if self._wanted_v is None else self._wanted_v

    def send(self) -> None:
        """Send what was sent then."""
        self._wanted_v = self.stack_v
        if self._tick is not None:
            self.stack_v = _stacks(self._tick)
        super().send()

    def write_due(self) -> float:
        """Nothing: what was written between ticks is in the log as well."""
        return math.inf

    def follow(self) -> None:
        """After the tick: go on from where it was sent then."""
        tick = self._tick
        self.stack_v, self._wanted_v = _stacks(tick), None
        self.command_rad = az_el(tick, "fsm")
        self.written_s, self.round_trip_s = tick.fsm_written_s, tick.dac_round_trip_s


class LoggedDac(NoDevice):
    """Confirms voltages, finds outputs and fails at the times of the log."""

    def __init__(self, clock: LoggedClock) -> None:
        self._clock = clock
        self._written_s = math.nan
        self._error: DeviceError | None = None
        self._found_v: Floats | None = None

    def load_tick(self, tick: Any, error: DeviceError | None, found_v: Floats | None) -> None:
        """How the next write ends, and what the outputs are found to be, if that was news."""
        self._written_s = math.nan if tick is None else tick.fsm_written_s
        self._error, self._found_v = error, found_v

    def read_v(self) -> Floats:
        """As found then; not a number where that was no news."""
        if self._found_v is None:
            return super().read_v()
        if self._error is not None and np.isnan(self._found_v).any():
            raise self._error
        return self._found_v

    def confirm(self) -> None:
        """At the time of the log."""
        if self._error is not None:
            raise self._error
        self._clock.set(self._written_s)


class LoggedInjector(Injector):
    """What was written outside the ticks, as the log has it."""

    def __init__(self, dac: LoggedDac, clock: Clock) -> None:
        super().__init__(dac, clock, np.zeros((3, 2)), 0.0, 0.0, 0.0)
        self._logged: list[Injection] = []

    def load_step(self, step: LoggedStep, loop: str) -> None:
        """What was written in a step; the first after a start is where the voltages were before."""
        injections = step.of(InjectionRecord, loop)
        skipped = len(step.of(ExperimentStart, loop))
        self._logged = [
            Injection(message.time_s, _stacks(message)) for message in injections[skipped:]
        ]

    def drain_written(self) -> list[Injection]:
        """What was written since last asked."""
        logged, self._logged = self._logged, []
        return logged


class _Waiting(NamedTuple):
    """Work that will be done at the step at which it was done then."""

    future: Future
    loops: Sequence[str]
    work: Callable[[], Any]


class LoggedExecutor(Executor):
    """Device work ends in the step, and with the result, of the log; designs are made anew by today's code."""

    def __init__(self) -> None:
        self._opened: defaultdict[str, deque[Any]] = defaultdict(deque)
        self._designed: list[tuple[str, str]] = []
        self._openings: list[_Waiting] = []
        self._designs: list[tuple[tuple[str, str], _Waiting]] = []

    def load_step(self, step: LoggedStep) -> None:
        """What ends in a step."""
        for message in step.of(DevicesOpened):
            self._opened[message.loop].append(message)
        self._designed = [(message.loop, message.target) for message in step.of(ControllerChange)]
        self._end_what_ends()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Begin; what ended at once then ends at once now."""
        future: Future = Future()
        if fn is open_devices:
            _, servos, loops, *_ = args
            for loop in loops:
                servos[loop].fault = None
            self._openings.append(_Waiting(future, loops, lambda: self._found(loops)))
        elif fn is design_for:
            _, loop, controller, *_ = args
            waiting = _Waiting(future, [loop], lambda: fn(*args))
            title = LEARNT if controller.startswith("{") else controller
            self._designs.append(((loop, title), waiting))
        elif fn is close_devices:
            future.set_result(None)
        elif getattr(fn, "__func__", None) is LoggedCamera.set_frame_rate:
            _end(_Waiting(future, (), lambda: fn(*args)))
        # What the piezo amplifier answers reaches its watch as the log has it.
        self._end_what_ends()
        return future

    def _end_what_ends(self) -> None:
        self._designs = [
            (key, waiting) for key, waiting in self._designs if not waiting.future.cancelled()
        ]
        while self._openings and all(self._opened[loop] for loop in self._openings[0].loops):
            _end(self._openings.pop(0))
        while any(key in self._designed for key, _ in self._designs):
            key, waiting = self._designs.pop(0)
            if key in self._designed:
                self._designed.remove(key)
                _end(waiting)
            else:
                waiting.future.set_exception(DeviceError("design", "", "one", "none then"))

    def _found(self, loops: Sequence[str]) -> Opened:
        opened = [self._opened[loop].popleft() for loop in loops]
        for message in opened:
            if message.error:
                raise logged_error("DeviceError", message.error)
        return Opened({}, {message.loop: _stacks(message) for message in opened})


def _end(waiting: _Waiting) -> None:
    try:
        waiting.future.set_result(waiting.work())
    except Exception as error:
        waiting.future.set_exception(error)


def is_stellar(tick: Any) -> bool:
    """Whether a logged tick is a stellar loop's."""
    return "mid_exposure_s" in tick.DESCRIPTOR.fields_by_name


def _stacks(message: Any) -> Floats:
    return np.array([message.stack1_v, message.stack2_v, message.stack3_v])


def az_el(message: Any, name: str) -> Floats:
    """Both axes of a field of a record, shape (2,)."""
    return np.array([getattr(message, f"{name}_az_rad"), getattr(message, f"{name}_el_rad")])
