"""Which loop a star on a shared frame belongs to: a loop's own star moves as the loop's stages do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX, Camera
from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]
FOLLOWED_PX = 2.0 * HALF_WINDOW_PX  # from where it is expected to a star that is followed
PROVEN_PX = 1.0 * HALF_WINDOW_PX  # likewise to a candidate that the stages have moved
MOVE_PX = 3.0 * HALF_WINDOW_PX  # from the target to the other places of a second look
LOOKS = 3
MOST_STRANGERS = 4  # places of rejected candidates that are remembered in a round of the search


@compilable()
def is_within(az_px: float, el_px: float, of_az_px: float, of_el_px: float, px: float) -> bool:
    """Whether two places are no farther apart than `px` along either axis."""
    return bool(abs(az_px - of_az_px) <= px and abs(el_px - of_el_px) <= px)


@compilable()
def second_look(looks_px: Any, az_px: float, el_px: float, rejected: int) -> int:
    """Which of the places the siderostat brings a candidate to, so that it shows whether it comes along.

    That is the first that is far enough from the candidate. Another star may stand at any one place, so they
    come in turn.

    Parameters
    ----------
    looks_px : array, shape (LOOKS, 2)
        Of :func:`look_places_px`.
    az_px, el_px : float
        Where the candidate is.
    rejected : int
        Candidates of this search that have been rejected.
    """
    for more in range(LOOKS):
        look = (rejected + more) % LOOKS
        if not is_within(az_px, el_px, looks_px[look, 0], looks_px[look, 1], FOLLOWED_PX):
            return look
    return rejected % LOOKS


def look_places_px(camera: Camera, target_px: Floats, other_targets_px: Iterable[Floats]) -> Floats:
    """Where a loop looks at candidates again, shape (LOOKS, 2): at its target, and on both sides of it.

    To both sides means across the direction of the nearest other target: near its own, a candidate's light does
    not reach what another loop follows there.

    Parameters
    ----------
    camera : Camera
    target_px : array, shape (2,)
    other_targets_px : iterable of arrays, shape (2,)
        Those of other loops.
    """
    away_px = [np.abs(other_px - target_px) for other_px in other_targets_px]
    nearest_px = min(away_px, key=np.max, default=np.zeros(2))
    aside_px = MOVE_PX * np.array([0.0, 1.0] if nearest_px[0] >= nearest_px[1] else [1.0, 0.0])
    places_px = np.array([target_px, target_px + aside_px, target_px - aside_px])
    return np.clip(places_px, HALF_WINDOW_PX, camera.largest_window_px)
