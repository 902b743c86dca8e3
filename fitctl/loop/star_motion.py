"""What moves a star beside its loop's own siderostat: the siderostat of the link, and the sky."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import AxisPair
from fitctl.config import Loop as LoopSettings
from fitctl.logging.records import StarPlace
from fitctl.loop.link import Link
from fitctl.loop.sky import Sky
from fitctl.messages.commands import Acquire
from fitctl.model.optics import AzEl, Scales
from fitctl.stages.siderostat import SiderostatStage

Floats = NDArray[np.float64]


class StarMotion:
    """Of one stellar loop's star.

    Angles, shape (2,), are of the loop's own motors: those that turn the star as far.

    Parameters
    ----------
    settings : LoopSettings
    scale : Scales
    setpoint_period_s : float
        A set-point is where the motors are to be so much later.

    Attributes
    ----------
    link : Link or None
        Over which the star's light comes; None without.
    sky : Sky or None
        None of a star that has always stood.
    link_counts : bool
        What the link's siderostat turns moves the star that is expected.
    """

    def __init__(self, settings: LoopSettings, scale: Scales, setpoint_period_s: float) -> None:
        self.link: Link | None = None
        self.sky: Sky | None = None
        self.link_counts = False
        self._scale = scale
        self._period_s = setpoint_period_s
        self._rig_rate = settings.star_rate_sky_arcsec_s
        self._given_rate: AxisPair | None = None  # by the last acquire
        self._recalled_rate: AxisPair | None = None  # by one before a kill, until the next
        if self._rig_rate is not None:
            self.sky = Sky(scale, setpoint_period_s)
            self.sky.move_at(self._rig_rate)

    # ------------------------------------------------------------ how far

    def read_at(self, time_s: float) -> None:
        """Read the link's encoders and the sky at a recent time."""
        for part in self._parts:
            part.read_at(time_s)

    def read_now(self, now_s: float) -> AzEl:
        """Read both now; the motor angles of the link's siderostat, NaN without one."""
        if self.sky is not None:
            self.sky.read_at(now_s)
        if self.link is None:
            return math.nan, math.nan
        self.link.read_now()
        az_rad, el_rad = self.link.motor_rad.tolist()
        return az_rad, el_rad

    @property
    def turned_rad(self) -> Floats | None:
        """By link and sky, as last read, shape (2,); None without either."""
        parts = self._parts
        return sum((part.turned_rad for part in parts[1:]), parts[0].turned_rad) if parts else None

    @property
    def sky_rad(self) -> Floats:
        """By the sky alone, as last read, shape (2,)."""
        return np.zeros(2) if self.sky is None else self.sky.turned_rad

    def beam_rad(self, motor_rad: Floats) -> Floats:
        """By all siderostats and the sky, as last read, with the own motors at `motor_rad`, shape (2,)."""
        return sum((part.turned_rad for part in self._parts), motor_rad)

    def beam_at(self, time_s: float, motor_rad: Floats) -> Floats:
        """By all siderostats and the sky at a recent time, with the own motors at `motor_rad`, shape (2,)."""
        return sum((part.turned_at(time_s) for part in self._parts), motor_rad)

    # ------------------------------------------------------------ what the siderostat undoes

    def undo(
        self, siderostat: SiderostatStage, now_s: float, *, tracked: bool, searched: bool
    ) -> None:
        """Undo what has moved the star while it is tracked and its light arrives.

        Nothing is undone of what moves it before that, nor while a search is about to begin (not `searched`).
        """
        arrives = self.link is None or self.link.holds
        for part in self._parts:
            if not tracked:
                part.begin(now_s)
            elif arrives and searched:
                siderostat.undo(part.step_rad(now_s))

    @property
    def undone_rad(self) -> Floats:
        """What the siderostat undoes of both, shape (2,), from a zero that is always the same."""
        return sum((part.undone_rad for part in self._parts), np.zeros(2))

    def setpoint_rad(self, wanted_rad: Floats) -> Floats:
        """The set-point for motors that are wanted at `wanted_rad`, shape (2,), apart from what they undo."""
        if self.link is not None:
            wanted_rad = wanted_rad - self.link.undone_from_origin_rad
        return wanted_rad if self.sky is None else wanted_rad - self.sky.undone_rad

    # ------------------------------------------------------------ a search, and which star

    def count_link(self, *, anew: bool) -> bool:
        """From now on, what the link turns moves the star; whether nothing did that it turned before.

        What the link's siderostat turned to find its beam moved no star that was known. A command that gives a
        place means it with the link as it is now, and has it counted `anew`.
        """
        begins = self.link is not None and (anew or not self.link_counts)
        if self.link is not None and begins:
            self.link.set_origin()
        self.link_counts = True
        return begins

    def link_zero_was_lost(self) -> bool:
        """The link's encoders count from elsewhere than when last asked: what they turned counts no more."""
        if self.link is None or not self.link.zero_was_lost():
            return False
        self.link_counts = False
        self.link.set_origin()
        return True

    def forget(self) -> None:
        """The star's place is unknown, and so is its rate, if that is from before a kill."""
        self.link_counts = False
        self._recalled_rate = None

    def expect_rate(self, asked: Acquire, now_s: float) -> None:
        """From now on the star moves as a command says, or as the rig file does."""
        az, el = asked.rate_az_sky_arcsec_s, asked.rate_el_sky_arcsec_s
        self._given_rate, self._recalled_rate = self._recalled_rate, None
        if az is not None and el is not None:
            self._given_rate = AxisPair(az=az, el=el)
        elif asked.expected_az_sky_arcsec is not None:
            self._given_rate = None  # the star of a command before a kill was another one
        if self.sky is None and self._rate is not None:
            self.sky = Sky(self._scale, self._period_s, now_s)
            self.sky.begin(now_s)
        if self.sky is not None:
            self.sky.move_at(self._rate)

    # ------------------------------------------------------------ for the supervisor after this one

    def moved_by(self, time_s: float) -> dict[str, Any]:
        """How far the star has moved by itself by a time, and how fast it does: fields of a `StarPlace`."""
        moved_rad = np.zeros(2) if self.sky is None else self.sky.turned_at(time_s)
        moved_az_rad, moved_el_rad = moved_rad.tolist()
        rate = self._given_rate or AxisPair(az=0.0, el=0.0)
        return {
            "moved_az_rad": moved_az_rad,
            "moved_el_rad": moved_el_rad,
            "rate_is_given": self._given_rate is not None,
            "rate_az_sky_arcsec_s": rate.az,
            "rate_el_sky_arcsec_s": rate.el,
        }

    def recall(self, place: StarPlace) -> None:
        """Go on from where a supervisor that was killed had link and star, as far as that is known."""
        self.link_counts = True
        if self.link is not None:
            self.link.recall((place.link_az_rad, place.link_el_rad))
        if place.rate_is_given:
            given = AxisPair(az=place.rate_az_sky_arcsec_s, el=place.rate_el_sky_arcsec_s)
            self._given_rate = self._recalled_rate = given
        moved_rad = np.array([place.moved_az_rad, place.moved_el_rad])
        if np.isnan(moved_rad).any():
            return
        if self.sky is None and (self._rate is not None or moved_rad.any()):
            self.sky = Sky(self._scale, self._period_s, place.time_s)
        if self.sky is not None:
            self.sky.recall(place.time_s, moved_rad, self._rate)

    @property
    def _rate(self) -> AxisPair | None:
        return self._given_rate or self._rig_rate

    @property
    def _parts(self) -> list[Link | Sky]:
        return [part for part in (self.link, self.sky) if part is not None]
