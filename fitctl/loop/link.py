"""The link over which a stellar loop's light comes: whether it holds, and what its siderostat turned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Loop as LoopSettings
from fitctl.controllers.feedforward import link_matrix
from fitctl.loop.metrology import MetrologyLoop
from fitctl.messages.modes import Mode
from fitctl.model.optics import motor_sky_rad_per_rad

Floats = NDArray[np.float64]


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
    """

    def __init__(self, loop: MetrologyLoop, settings: LoopSettings) -> None:
        given = settings.feedforward
        self.loop = loop
        self.origin_rad = np.zeros(2)
        self.undone_rad = np.zeros(2)
        self._matrix = link_matrix(
            0.0 if given is None else given.gain,
            np.eye(2) if given is None else given.matrix,
            motor_sky_rad_per_rad(loop.settings.siderostat),
            motor_sky_rad_per_rad(settings.siderostat),
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

    def zero_was_lost(self) -> bool:
        """The encoders count from elsewhere than when last asked: what was turned before is unknown."""
        before, self._zeros_lost = self._zeros_lost, self.loop.zeros_lost
        return self._zeros_lost != before

    def turned_rad(self, time_s: float) -> Floats:
        """From the origin, at a recent time, by the encoders."""
        return self._matrix @ self.loop.servo.position_at(time_s) - self.origin_rad

    def begin(self) -> None:
        """Nothing is to be undone of what was turned so far."""
        self.undone_rad = self._ahead_rad()

    def set_origin(self) -> None:
        """Count turns from here on."""
        self.begin()
        self.origin_rad = self.undone_rad

    @property
    def undone_from_origin_rad(self) -> Floats:
        """By how much the own set-point differs from one that knows nothing of the link."""
        return self.undone_rad - self.origin_rad

    def step_rad(self) -> Floats:
        """By how much the own set-point is to move now, so that the star stays where it is."""
        before_rad = self.undone_rad
        self.begin()
        return before_rad - self.undone_rad

    def _ahead_rad(self) -> Floats:
        """Where the encoders of the link's siderostat will be when the own one has made its next step.

        That is the set-point that it was given in this same tick: both servos follow theirs alike.
        """
        return self._matrix @ self.loop.siderostat.setpoint_rad
