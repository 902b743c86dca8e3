"""One loop's fast steering mirror: what its D/A is commanded, at which slew, and where it was when."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.controllers.mirror import Mirror
from fitctl.drivers.interface import DeviceError, MirrorDac
from fitctl.model.optics import saturate_diamond, scales
from fitctl.stages.injector import Injection, Injector, stack_v_per_px

Floats = NDArray[np.float64]
HISTORY_S = 0.3  # of mirror angles; frames are far younger when they are used
_PROMPT_S = 1e-6  # a write is due so early: sums of times are not exact
_UNWRITTEN_S = 0.4  # after so long without a write, the D/A's own watchdog may have acted


class _Later(NamedTuple):
    """A write between ticks: when it is due, and to which angles, shape (2,)."""

    due_s: float
    mirror_rad: Floats
    hysteresis_inverse: bool


class MirrorStage:
    """Commands of one mirror.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    dac : MirrorDac
    clock : Clock
    injector : Injector, optional
        Instead of one that writes `dac`.

    Attributes
    ----------
    ready : bool
        The D/A may be written to.
    stack_v : array, shape (3,)
        Wanted at the D/A, from the next write on.
    command_rad : array, shape (2,)
        Commanded mirror angles.
    sent_s, written_s, round_trip_s : float
        When the last write was on its way, when the D/A confirmed it, and how long both took.
    bias_offset_rad : array, shape (2,)
        How far from its bias the mirror rests.
    injector : Injector
        Writes the D/A in the tick's stead while an experiment runs.
    fault : DeviceError or None
        What failed in a write between ticks.
    """

    def __init__(
        self,
        rig: Rig,
        loop_name: str,
        dac: MirrorDac,
        clock: Clock,
        injector: Injector | None = None,
    ) -> None:
        fsm = rig.stellar_loops[loop_name].fsm
        mirror_px_per_rad = scales(rig, rig.stellar_loops[loop_name]).mirror_px_per_rad
        self.ready = False
        self.stack_v = np.full(3, fsm.bias_v)
        self.command_rad = np.zeros(2)
        self.bias_offset_rad = np.zeros(2)
        self.fault: DeviceError | None = None
        self.sent_s = math.nan
        self.written_s = clock.now_s()
        self.round_trip_s = 0.0
        self.injector = injector or Injector(
            dac,
            clock,
            stack_v_per_px(fsm.stack_radius_m, fsm.stack_scale_m_per_v, mirror_px_per_rad),
            fsm.bias_v,
            fsm.dac.full_scale_v,
            fsm.slew_v_per_s,
        )
        self._rest_v = self.stack_v
        self._fsm = fsm
        self._dac = dac
        self._clock = clock
        self._mirror = Mirror(fsm)
        self._most_slew_v = fsm.slew_v_per_s * rig.camera.period_s
        self._begun_s = math.nan  # of a write that is not confirmed yet
        self._known_s = -math.inf  # the last write or reading of the outputs began then
        self._lowest_v = self._highest_v = self.stack_v
        write_s = rig.camera.period_s / fsm.dac.writes_per_frame
        shortest_s = min(write_s, self.injector.period_s)
        self._later: deque[_Later] = deque()
        self._written: list[Injection] = []  # between ticks, since last asked
        self._history: deque[tuple[float, Floats]] = deque(
            [(-math.inf, np.zeros(2))], maxlen=math.ceil(HISTORY_S / shortest_s)
        )

    @property
    def now_rad(self) -> Floats:
        """Where the mirror is, as far as it is known, shape (2,)."""
        return self._mirror.angles_rad

    def held_rad(self, *, hysteresis_inverse: bool) -> Floats:
        """What :meth:`move_to` must be given, shape (2,), to leave the mirror as it is."""
        return self._mirror.held_rad(hysteresis_inverse=hysteresis_inverse)

    def at(self, time_s: float) -> Floats:
        """Where it was at a recent time, shape (2,)."""
        for since_s, mirror_rad in reversed(self._history):
            if since_s <= time_s:
                return mirror_rad
        return self._history[0][1]

    def at_bias(self) -> bool:
        """The mirror is commanded to its bias."""
        return bool(np.allclose(self.stack_v, self._fsm.bias_v))

    # ------------------------------------------------------------ commands

    def start_from(self, stack_v: Floats) -> None:
        """Begin with the D/A's outputs, shape (3,), as found."""
        self.rest_off_bias(np.zeros(2))
        self._mirror.assume(stack_v)
        self.stack_v = self._mirror.stack_v
        self.command_rad = self._mirror.angles_rad
        self.drain_commanded_range()
        self.written_s = self._clock.now_s()
        self._begun_s = math.nan
        self._known_s = -math.inf  # the other devices were opened since
        self.ready = True
        self.fault = None
        self.drop_later()

    def move_to(self, mirror_rad: Floats, *, hysteresis_inverse: bool) -> None:
        """Turn the mirror, no farther than its diamond."""
        self.command_rad = saturate_diamond(mirror_rad, self._fsm.range_rad)
        self.stack_v = self._mirror.volts_for(
            self.command_rad, hysteresis_inverse=hysteresis_inverse
        )

    def move_later(
        self,
        wanted_rad: Sequence[Floats],
        first_s: float,
        every_s: float,
        *,
        hysteresis_inverse: bool,
    ) -> None:
        """Turn the mirror to each of these angles, shape (2,), by :meth:`write_due`, the first at `first_s`."""
        self._later.extend(
            _Later(first_s + index * every_s, mirror_rad, hysteresis_inverse)
            for index, mirror_rad in enumerate(wanted_rad)
        )

    def drop_later(self) -> None:
        """Forget what :meth:`move_later` was given and is not written yet."""
        self._later.clear()

    def rest_off_bias(self, offset_rad: Floats) -> None:
        """From now on the mirror rests this far from its bias, shape (2,), within its diamond."""
        self.bias_offset_rad = saturate_diamond(offset_rad, self._fsm.range_rad)
        # Without one, the bias itself; with one, the angle that was asked for, from where the mirror is now.
        self._rest_v = self._mirror.volts_for(
            self.bias_offset_rad, hysteresis_inverse=bool(self.bias_offset_rad.any())
        )

    def rest_at_bias(self) -> None:
        """From now on the mirror rests at its bias."""
        if any(self.bias_offset_rad.tolist()):
            self.rest_off_bias(np.zeros(2))

    def step_to_rest(self) -> None:
        """One frame's way back to where it rests, as far as the slew limit lets it."""
        left_v = self._rest_v - self.stack_v
        if any(left_v.tolist()):  # `left_v.any()` takes five times as long, and np.clip as well
            most_v = self._most_slew_v
            self.stack_v = self.stack_v + np.minimum(np.maximum(left_v, -most_v), most_v)
        self.command_rad = self._mirror.angles_rad

    def step_to_bias(self) -> None:
        """One frame's way back to the bias; an offset from it is forgotten."""
        self.rest_at_bias()
        self.step_to_rest()

    # ------------------------------------------------------------ the D/A

    def send(self) -> None:
        """Send the D/A what is wanted; :meth:`confirm` is next.

        Raises
        ------
        DeviceError
            If it cannot be sent; then nothing more is sent until :meth:`start_from`.
        """
        self.ready = False
        begun_s = self._clock.now_s()
        self._dac.send_v(self.stack_v)
        self.sent_s, self._begun_s = self._clock.now_s(), begun_s
        self.ready = True

    def find_after_pause(self) -> Floats | None:
        """Read the D/A where it was not written to for long: its own watchdog may have moved the mirror.

        The next steps then go on from where it is, and not from where it was.

        Returns
        -------
        array, shape (3,), or None
            The outputs, where they are not what was written.

        Raises
        ------
        DeviceError
            If it does not answer; then nothing more is sent until :meth:`start_from`.
        """
        now_s = self._clock.now_s()
        if now_s - self._known_s <= _UNWRITTEN_S:
            return None
        self.ready = False
        found_v = self._dac.read_v()
        self.ready, self._known_s = True, now_s
        if not np.abs(found_v - self._mirror.stack_v).max() > self._fsm.dac.step_v:
            return None  # what is not a number, too
        self._mirror.written(found_v)
        self.stack_v, self.command_rad = self._mirror.stack_v, self._mirror.angles_rad
        self._extend_commanded_range(found_v)
        self._history.append((now_s, self.command_rad))
        return found_v

    def confirm(self) -> None:
        """Wait until the D/A confirms what was sent; nothing to wait for is well.

        Raises
        ------
        DeviceError
            If it does not; then nothing more is sent until :meth:`start_from`.
        """
        if math.isnan(self._begun_s):
            return
        begun_s, self._begun_s = self._begun_s, math.nan
        self.ready = False
        self._dac.confirm()
        self.ready = True
        self.written_s = self._clock.now_s()
        self.round_trip_s = self.written_s - begun_s
        self._known_s = begun_s  # the confirmation may be read long after the D/A obeyed
        self._extend_commanded_range(self.stack_v)
        self._mirror.written(self.stack_v)
        self._history.append((self.written_s, self._mirror.angles_rad))

    def write_due(self) -> float:
        """Write what :meth:`move_later` was given and is due; of several, the newest.

        A D/A that fails leaves its error in `fault`.

        Returns
        -------
        float
            When the next is due; infinite without one.
        """
        later, due = self._later, None
        while later and later[0].due_s <= self._clock.now_s() + _PROMPT_S:
            due = later.popleft()
        if due is not None and self.ready:
            self.move_to(due.mirror_rad, hysteresis_inverse=due.hysteresis_inverse)
            try:
                self.send()
                self.confirm()
            except DeviceError as error:
                self.fault = error
                later.clear()
            else:
                self._written.append(Injection(self.written_s, self.stack_v))
            self.stack_v, self.command_rad = self._mirror.stack_v, self._mirror.angles_rad
        return later[0].due_s if later else math.inf

    def drain_commanded_range(self) -> tuple[Floats, Floats]:
        """Lowest and highest voltages, shape (3,) each, that the D/A was sent since last asked."""
        commanded = self._lowest_v, self._highest_v
        self._lowest_v = self._highest_v = self.stack_v
        return commanded

    def _extend_commanded_range(self, stack_v: Floats) -> None:
        self._lowest_v = np.minimum(self._lowest_v, stack_v)
        self._highest_v = np.maximum(self._highest_v, stack_v)

    def drain_injections(self) -> list[Injection]:
        """What was written outside the tick since last asked: between ticks, or by an experiment."""
        between, self._written = self._written, []
        injections = self.injector.drain_written()
        for time_s, stack_v in injections:
            self._mirror.written(stack_v)
            self._extend_commanded_range(stack_v)
            self.stack_v, self.command_rad = stack_v, self._mirror.angles_rad
            self._history.append((time_s, self.command_rad))
            self.written_s = time_s
        return between + injections if between else injections
