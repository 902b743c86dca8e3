"""Which star on a shared frame belongs to a loop."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX, Camera
from fitctl.controllers.attribution import (
    FOLLOWED_PX,
    MOST_STRANGERS,
    PROVEN_PX,
    is_within,
    look_places_px,
    second_look,
)
from fitctl.controllers.centroid import Star
from fitctl.controllers.estimator import StarEstimator
from fitctl.messages.modes import FOLLOWING, Mode
from fitctl.model.optics import AzEl

Floats = NDArray[np.float64]


class OtherStages(NamedTuple):
    """Of another loop whose star may be on the frame, at the exposure."""

    moved_px: AzEl  # how far they, and a link's siderostat, move its star
    follow: bool  # its loop follows that star, which is then no candidate here
    lost: bool  # its loop does not find that star on the newest frame
    target_px: Floats  # where its loop holds that star, shape (2,)


class Attribution:
    """One loop's, where the stars of other loops are on the same frame.

    A star that is followed is accepted only near where it is expected. In a search, a star is a candidate at
    first: the siderostat moves it, and it is the loop's own only if it comes to where that should bring it.

    Parameters
    ----------
    camera : Camera
    estimator : StarEstimator

    Attributes
    ----------
    candidate : Star or None
        As a frame first showed it, while the second look at it lasts.
    """

    def __init__(self, camera: Camera, estimator: StarEstimator) -> None:
        self.candidate: Star | None = None
        self._estimator = estimator
        self._camera = camera
        self._strangers_px: deque[AzEl] = deque(maxlen=MOST_STRANGERS)
        self._rejected = 0
        self._last_stages_px = 0.0, 0.0
        self._others: Mapping[str, OtherStages] = {}  # on the frame that showed the candidate

    def begin_search(self) -> None:
        """A new search: the loop has no candidate."""
        self._drop()
        self._rejected = 0

    def begin_round(self) -> None:
        """A new spiral, about a place where the star may have been rejected before."""
        self._strangers_px.clear()

    def choose(self, candidates: Iterable[Star], mode: Mode, expected_px: AzEl) -> Star | None:
        """The star that may be the loop's own: the nearest to `expected_px` of all that may be it, or none."""
        strangers: Iterable[AzEl] = ()
        reach_px = math.inf
        if mode in FOLLOWING:
            reach_px = FOLLOWED_PX
        elif mode is Mode.ACQUISITION and self.candidate is not None:
            reach_px = PROVEN_PX
        elif mode is Mode.ACQUISITION:
            strangers = self._strangers_px
        own = (
            star
            for star in candidates
            if is_within(*star[:2], *expected_px, reach_px)
            and not any(is_within(*star[:2], *place_px, HALF_WINDOW_PX) for place_px in strangers)
        )
        return nearest(own, expected_px)

    def observe(self, star: Star, mode: Mode, stages_px: AzEl) -> None:
        """A frame shows `star`, exposed with the stages where they move a star by `stages_px`."""
        self._last_stages_px = stages_px
        if mode in FOLLOWING:
            self._estimator.observe(star[:2], stages_px)

    def moved_px(self, stages_px: AzEl) -> AzEl:
        """How far the stages, moved to `stages_px`, have taken the star since it was last seen."""
        az_px, el_px = self._last_stages_px
        return stages_px[0] - az_px, stages_px[1] - el_px

    # ------------------------------------------------------------ the second look

    def propose(self, star: Star, target_px: Floats, others: Mapping[str, OtherStages]) -> Floats:
        """A frame shows a candidate: where the siderostat is to bring it, shape (2,)."""
        self.candidate, self._others = star, others
        self._estimator.suppose(star[:2], self._last_stages_px)
        others_px = (other.target_px for other in others.values())
        looks_px = look_places_px(self._camera, target_px, others_px)
        place_px: Floats = looks_px[second_look(looks_px, *star[:2], self._rejected)]
        return place_px

    def has_moved(self, star: Star, others: Mapping[str, OtherStages]) -> bool:
        """What the second look shows, where the candidate is expected now, was moved by the own stages alone.

        It has left the candidate's place, and is not where it would be if it were the star of another loop that
        does not follow it: a jog or a link may take that one to where the own one is expected. Nor has a loop
        that follows its star just lost it: a gust may have taken that one there.
        """
        if self.candidate is None or any(other.follow and other.lost for other in others.values()):
            return False
        az_px, el_px, *_ = self.candidate
        places_px = [(az_px, el_px)]
        for name, other in others.items():
            now_px, then_px = other.moved_px, self._others[name].moved_px
            if not other.follow:
                places_px.append((az_px + now_px[0] - then_px[0], el_px + now_px[1] - then_px[1]))
        return not any(is_within(*star[:2], *place_px, HALF_WINDOW_PX) for place_px in places_px)

    def confirm(self) -> None:
        """The candidate is the loop's own star."""
        self.candidate = None
        self._estimator.keep()

    def reject(self) -> None:
        """The candidate is not: what stands at its place is another star, until the next round."""
        if self.candidate is not None:
            self._strangers_px.append(self.candidate[:2])
        self._rejected += 1
        self._drop()

    def _drop(self) -> None:
        self.candidate = None
        self._estimator.withdraw()


def nearest(stars: Iterable[Star], px: AzEl) -> Star | None:
    """The star that is nearest to a place; None of none."""
    return min(stars, key=lambda star: math.dist(star[:2], px), default=None)
