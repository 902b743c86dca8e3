"""The link over which a stellar loop's light comes: whether it holds, and what its siderostat turned."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD
from fitctl.config import Loop as LoopSettings
from fitctl.controllers.feedforward import link_matrix
from fitctl.loop.metrology import MetrologyLoop
from fitctl.messages.modes import Mode
from fitctl.model.hysteresis import play
from fitctl.model.optics import AzEl, Scales
from fitctl.stages.servo import ServoState
from fitctl.stages.siderostat import SiderostatStage

Floats = NDArray[np.float64]
_HISTORY_TICKS = 50


class LinkServo(Protocol):
    """Where the motors of a link's siderostat are; :class:`fitctl.stages.servo.SiderostatServo` is one."""

    @property
    def position_rad(self) -> Floats:
        """As last read, shape (2,)."""
        ...

    def position_at(self, time_s: float) -> Floats:
        """At a recent time, shape (2,)."""
        ...


class Link:
    """One stellar loop's.

    Angles, shape (2,), are of the loop's own motors: those that turn the star as far as the link's siderostat.

    Parameters
    ----------
    loop : MetrologyLoop
        Holds the link.
    settings : LoopSettings
        Of the stellar loop.

    Attributes
    ----------
    origin_rad : array, shape (2,)
        What counts as no turn.
    undone_rad : array, shape (2,)
        How much of the turn the own siderostat has undone, from the same zero as `origin_rad`.
    motor_rad : array, shape (2,)
        Angles of the link's motors, by the last :meth:`read_at` or :meth:`read_now`.
    servo : LinkServo
        Where they are read.
    """

    def __init__(self, loop: MetrologyLoop, settings: LoopSettings) -> None:
        given = settings.feedforward
        self.loop = loop
        self.servo: LinkServo = loop.servo
        self.motor_rad = np.zeros(2)
        self.origin_rad = np.zeros(2)
        self.undone_rad = np.zeros(2)
        self._matrix = link_matrix(
            0.0 if given is None else given.gain,
            np.eye(2) if given is None else given.matrix,
            loop.settings.siderostat.sky_rad_per_motor_rad,
            settings.siderostat.sky_rad_per_motor_rad,
        )
        self._zeros_lost = loop.zeros_lost
        self._settle_s = settings.acquisition.settle_s

    @property
    def holds(self) -> bool:
        """The beam is on the centre: the star's light arrives, and what turns is known."""
        return self.loop.mode is Mode.LOCKED

    def settled(self, now_s: float) -> bool:
        """It has held for so long that the own siderostat has undone what happened meanwhile."""
        return self.holds and now_s - self.loop.mode_since_s >= self._settle_s

    @property
    def zero_is_lost(self) -> bool:
        """The encoders count from elsewhere than when :meth:`zero_was_lost` was last asked."""
        return self._zeros_lost != self.loop.zeros_lost or self.loop.servo.encoders_jumped

    def zero_was_lost(self) -> bool:
        """The encoders count from elsewhere than when last asked: what was turned before is unknown."""
        before, self._zeros_lost = self._zeros_lost, self.loop.zeros_lost
        return self._zeros_lost != before

    def read_at(self, time_s: float) -> None:
        """Read the encoders at a recent time."""
        self.motor_rad = self.servo.position_at(time_s)

    def read_now(self) -> None:
        """Read the newest of the encoders."""
        self.motor_rad = self.servo.position_rad

    @property
    def turned_rad(self) -> Floats:
        """From the origin, by the encoders as last read."""
        return self.turned_with(self.motor_rad)

    def turned_at(self, time_s: float) -> Floats:
        """From the origin, by the encoders at a recent time."""
        return self.turned_with(self.servo.position_at(time_s))

    def turned_with(self, motor_rad: Floats) -> Floats:
        """From the origin, with the motors of the link's siderostat at `motor_rad`, shape (2,)."""
        return self._matrix @ motor_rad - self.origin_rad

    @property
    def matrix(self) -> Floats:
        """From the motors of the link's siderostat to those of the own one, shape (2, 2)."""
        return self._matrix

    def begin(self, _now_s: float) -> None:
        """Nothing is to be undone of what was turned so far."""
        self.undone_rad = self._ahead_rad()

    def set_origin(self) -> None:
        """Count turns from here on."""
        self.origin_rad = self.undone_rad = self._ahead_rad()

    def recall(self, motor_rad: AzEl) -> None:
        """Count turns from where a supervisor that was killed had the motors of the link's siderostat."""
        self.loop.servo.recall(motor_rad)
        self.origin_rad = self._matrix @ np.array(motor_rad)

    @property
    def undone_from_origin_rad(self) -> Floats:
        """By how much the own set-point differs from one that knows nothing of the link."""
        return self.undone_rad - self.origin_rad

    def step_rad(self, now_s: float) -> Floats:
        """By how much the own set-point is to move now, so that the star stays where it is."""
        before_rad = self.undone_rad
        self.begin(now_s)
        return before_rad - self.undone_rad

    def _ahead_rad(self) -> Floats:
        """Where the encoders of the link's siderostat will be when the own one has made its next step.

        That is the set-point that it was given in this same tick: both servos follow theirs alike.
        """
        return self._matrix @ self.loop.siderostat.setpoint_rad


class BacklashFeedforward:
    """What the mirror makes up for: the plays of both siderostats, which their encoders do not see.

    Only changes since :meth:`rest` count, so that nothing jumps. A backlash that the rig file does not
    know counts as none.

    Parameters
    ----------
    link : Link
    own : SiderostatStage
    settings : LoopSettings
        Of the stellar loop.
    scale : Scales

    Attributes
    ----------
    offset_rad : array, shape (2,)
        The mirror's, in force now.
    """

    def __init__(
        self, link: Link, own: SiderostatStage, settings: LoopSettings, scale: Scales
    ) -> None:
        self.offset_rad = np.zeros(2)
        self._link = link
        self._stages = link.loop.siderostat, own
        self._half_rad = [
            np.full(2, (one.backlash_sky_arcsec or 0.0) / ARCSEC_PER_RAD / 2)
            / one.sky_rad_per_motor_rad
            for one in (link.loop.settings.siderostat, settings.siderostat)
        ]
        self._beams_rad = [stage.servo.position_rad for stage in self._stages]
        self._mirror_per_motor = -scale.motor_px_per_rad / scale.mirror_px_per_rad
        self._turn = scale.siderostat_turn.T @ scale.mirror_back.T
        self._lost_rad = np.zeros(2)
        self._origin_rad = np.zeros(2)
        self._in_force: deque[tuple[float, Floats]] = deque(maxlen=_HISTORY_TICKS)

    def begin(self, offset_rad: Floats) -> None:
        """Go on from an offset of the mirror, shape (2,)."""
        self.offset_rad = offset_rad
        self._origin_rad = self._lost_rad - offset_rad

    def rest(self, now_s: float, own: ServoState) -> None:
        """Follow both plays; the mirror makes up for nothing that they have lost until now."""
        self.follow(own)
        self.begin(np.zeros(2))
        self._in_force.append((now_s, self.offset_rad))

    def update(self, now_s: float, own: ServoState) -> None:
        """Follow both plays; the mirror makes up for them from now on."""
        self.follow(own)
        self.offset_rad = self._lost_rad - self._origin_rad
        self._in_force.append((now_s, self.offset_rad))

    def follow(self, own: ServoState) -> None:
        """Follow both plays from the encoders that this tick read; the mirror stays as it is."""
        lost_rad = []
        servos = self._link.loop.servo_state, own
        for index, (stage, servo) in enumerate(zip(self._stages, servos, strict=True)):
            # Halfway between where the motors are and where they are to be at the next tick.
            motor_rad = 0.5 * (servo.newest_rad + stage.setpoint_rad)
            beam_rad = play(self._beams_rad[index], motor_rad, self._half_rad[index])
            self._beams_rad[index] = beam_rad
            lost_rad.append(beam_rad - motor_rad)
        turned_rad = self._link.matrix @ lost_rad[0] + lost_rad[1]
        self._lost_rad = self._mirror_per_motor * turned_rad.dot(self._turn)

    def at(self, time_s: float) -> Floats:
        """The offset in force at a recent time, shape (2,)."""
        return next(
            (offset for since_s, offset in reversed(self._in_force) if since_s <= time_s),
            np.zeros(2),
        )
