"""One loop's stages, mirror and siderostat: what they were told, and where the mirror was when."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.controllers.mirror import Mirror
from fitctl.drivers.interface import MirrorDac
from fitctl.model.optics import saturate_diamond, scales
from fitctl.stages.injector import Injection, Injector, stack_v_per_px
from fitctl.stages.servo import SiderostatServo

Floats = NDArray[np.float64]
HISTORY_S = 0.3  # of mirror angles; frames are far younger when they are used


class Stages:
    """Commands of one loop's stages.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    servo : SiderostatServo
    dac : MirrorDac
    clock : Clock

    Attributes
    ----------
    ready : bool
        The D/A may be written to.
    stack_v : array, shape (3,)
        Wanted at the D/A, from the next write on.
    mirror_rad, setpoint_rad : arrays, shape (2,)
        Commanded mirror angles and motor set-points.
    written_s, round_trip_s : float
        When the D/A last took voltages, and how long that took.
    asked_fraction : float
        Of the siderostat's travel: the wanted set-point before it was limited.
    travel_rad : float
        Of the motors, each way from the encoders' zero.
    bias_offset_rad : array, shape (2,)
        How far from its bias the mirror rests.
    injector : Injector
        Writes the D/A in this one's stead while an experiment runs.
    """

    def __init__(
        self, rig: Rig, loop_name: str, servo: SiderostatServo, dac: MirrorDac, clock: Clock
    ) -> None:
        loop = rig.loops[loop_name]
        scale = scales(rig, loop)
        self.ready = False
        self.stack_v = np.full(3, loop.fsm.bias_v)
        self.mirror_rad = np.zeros(2)
        self.bias_offset_rad = np.zeros(2)
        self._rest_v = self.stack_v
        self.setpoint_rad = np.zeros(2)
        self.written_s = clock.now_s()
        self.round_trip_s = 0.0
        self.asked_fraction = 0.0
        self.injector = Injector(
            dac,
            clock,
            stack_v_per_px(
                loop.fsm.stack_radius_m, loop.fsm.stack_scale_m_per_v, scale.mirror_px_per_rad
            ),
            loop.fsm.bias_v,
            loop.fsm.dac.full_scale_v,
        )
        self._fsm = loop.fsm
        self._servo = servo
        self._dac = dac
        self._clock = clock
        self._mirror = Mirror(loop.fsm)
        self._most_slew_v = loop.fsm.slew_v_per_s * rig.camera.period_s
        self._motor_sky_arcsec_per_rad = scale.motor_sky_arcsec_per_rad
        self.travel_rad = loop.siderostat.travel_sky_arcsec / scale.motor_sky_arcsec_per_rad
        shortest_s = min(rig.camera.period_s, self.injector.period_s)
        self._lowest_v, self._highest_v = self.stack_v.copy(), self.stack_v.copy()
        self._mirror_history: deque[tuple[float, Floats]] = deque(
            [(-math.inf, np.zeros(2))], maxlen=math.ceil(HISTORY_S / shortest_s)
        )

    # ------------------------------------------------------------ mirror

    @property
    def mirror_now_rad(self) -> Floats:
        """Where the mirror is, as far as it is known, shape (2,)."""
        return self._mirror.angles_rad

    def mirror_held_rad(self, *, hysteresis_inverse: bool) -> Floats:
        """What :meth:`mirror_to` must be asked for, shape (2,), to leave the mirror as it is."""
        return self._mirror.held_rad(hysteresis_inverse=hysteresis_inverse)

    def mirror_at(self, time_s: float) -> Floats:
        """Where it was at a recent time, shape (2,)."""
        for since_s, mirror_rad in reversed(self._mirror_history):
            if since_s <= time_s:
                return mirror_rad
        return self._mirror_history[0][1]

    def start_from(self, stack_v: Floats) -> None:
        """Take the D/A's outputs, shape (3,), as found."""
        self.rest_off_bias(np.zeros(2))
        self._mirror.assume(stack_v)
        self.stack_v = self._mirror.stack_v
        self.mirror_rad = self._mirror.angles_rad
        self.drain_commanded_range()
        self.written_s = self._clock.now_s()
        self.ready = True

    def at_bias(self) -> bool:
        """The mirror is commanded to its bias."""
        return bool(np.allclose(self.stack_v, self._fsm.bias_v))

    def mirror_to(self, mirror_rad: Floats, *, hysteresis_inverse: bool) -> None:
        """Turn the mirror, no farther than its diamond."""
        self.mirror_rad = saturate_diamond(mirror_rad, self._fsm.range_rad)
        self.stack_v = self._mirror.volts_for(
            self.mirror_rad, hysteresis_inverse=hysteresis_inverse
        )

    def rest_off_bias(self, offset_rad: Floats) -> None:
        """From now on the mirror rests this far from its bias, shape (2,), within its diamond."""
        self.bias_offset_rad = saturate_diamond(offset_rad, self._fsm.range_rad)
        # Without one, the bias itself; with one, the angle that was asked for, from where the mirror is now.
        self._rest_v = self._mirror.volts_for(
            self.bias_offset_rad, hysteresis_inverse=bool(self.bias_offset_rad.any())
        )

    def mirror_to_rest(self) -> None:
        """One frame's way back to where it rests."""
        self._go_to_v(self._rest_v)

    def mirror_to_bias(self) -> None:
        """One frame's way back to the bias; an offset from it is forgotten."""
        if self.bias_offset_rad.any():
            self.rest_off_bias(np.zeros(2))
        self._go_to_v(self._rest_v)

    def _go_to_v(self, rest_v: Floats) -> None:
        left_v = rest_v - self.stack_v
        self.stack_v = self.stack_v + np.clip(left_v, -self._most_slew_v, self._most_slew_v)
        self.mirror_rad = self._mirror.angles_rad

    def write(self) -> None:
        """Give the D/A what is wanted.

        Raises
        ------
        DeviceError
            If it does not take it; then nothing more is written until :meth:`start_from`.
        """
        self.ready = False
        begun_s = self._clock.now_s()
        self._dac.write_v(self.stack_v)
        self.ready = True
        self.written_s = self._clock.now_s()
        self.round_trip_s = self.written_s - begun_s
        self._mirror.written(self.stack_v)
        self._extend_commanded_range(self.stack_v)
        self._mirror_history.append((self.written_s, self._mirror.angles_rad))

    def drain_commanded_range(self) -> tuple[Floats, Floats]:
        """Lowest and highest voltages, shape (3,) each, that the D/A was told since last asked."""
        commanded = self._lowest_v, self._highest_v
        self._lowest_v, self._highest_v = self.stack_v.copy(), self.stack_v.copy()
        return commanded

    def _extend_commanded_range(self, stack_v: Floats) -> None:
        np.minimum(self._lowest_v, stack_v, out=self._lowest_v)
        np.maximum(self._highest_v, stack_v, out=self._highest_v)

    def drain_injections(self) -> list[Injection]:
        """What an experiment has written since last asked."""
        injections = self.injector.drain_written()
        for time_s, stack_v in injections:
            self._mirror.written(stack_v)
            self._extend_commanded_range(stack_v)
            self.stack_v, self.mirror_rad = stack_v, self._mirror.angles_rad
            self._mirror_history.append((time_s, self.mirror_rad))
            self.written_s = time_s
        return injections

    # ------------------------------------------------------------ siderostat

    def keep_siderostat(self) -> None:
        """The servo holds the siderostat where it is."""
        self.setpoint_rad = self._servo.setpoint_rad
        self.asked_fraction = 0.0

    def jog(self, step_sky_arcsec: Floats) -> None:
        """Move the set-point by an angle on the sky, shape (2,)."""
        self.siderostat_to(self.setpoint_rad + step_sky_arcsec / self._motor_sky_arcsec_per_rad)

    def siderostat_to(self, setpoint_rad: Floats) -> None:
        """Move the set-point, shape (2,), no farther than its travel."""
        az_rad, el_rad = setpoint_rad.tolist()
        most_rad = self.travel_rad
        self.asked_fraction = max(abs(az_rad), abs(el_rad)) / most_rad
        within = self.asked_fraction <= 1.0
        self.setpoint_rad = setpoint_rad if within else np.clip(setpoint_rad, -most_rad, most_rad)
        self._servo.move_to(self.setpoint_rad)
