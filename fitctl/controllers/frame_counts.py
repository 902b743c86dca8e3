"""What frames in a row mean: when a candidate is the star, and what becomes of a star that is followed.

Functions change the counts of what they are given: a live object, or a record of a compiled run.
"""

from __future__ import annotations

import math
from typing import Any

from fitctl.config import HALF_WINDOW_PX
from fitctl.model.compiled import compilable

# Air, hysteresis and a slow drift move a star by less than the first while stages move it by the second.
OFF_TARGET_PX = 1.0  # nearer to its target, a star is where the loop wants it
MOVED_PX = 3.0 * HALF_WINDOW_PX  # so far stages must have moved a star that can be judged
LEAST_ANSWER = 0.5  # of what the stages did
WAIT, CONFIRMED, REJECTED = 0, 1, 2  # what a frame means for a candidate


@compilable()
def look_again(acquisition: Any, candidate: Any, star_visible: bool, exposed_s: float) -> int:
    """Count a frame of a candidate's second look: WAIT, CONFIRMED or REJECTED.

    Parameters
    ----------
    acquisition : Acquisition
    candidate : has since_s, when a frame first showed it, and frames, the count in a row
    star_visible : bool
    exposed_s : float
    """
    settled_s = candidate.since_s + acquisition.settle_s
    candidate.frames = candidate.frames + 1 if star_visible and exposed_s >= settled_s else 0
    if candidate.frames >= acquisition.found_frames:
        return CONFIRMED
    return REJECTED if exposed_s > settled_s + acquisition.confirm_timeout_s else WAIT


@compilable()
def count_frame(counts: Any, star_visible: bool, need: float, reach_fraction: float) -> None:
    """Count a frame of a star that is followed.

    Parameters
    ----------
    counts : has lost, in_reach and out_of_reach
        Frames in a row without the star; with an error within `reach_fraction` of the mirror's range; with
        one beyond its range.
    star_visible : bool
    need : float
        The error over the mirror's range; ignored without a star.
    reach_fraction : float
    """
    counts.lost = 0 if star_visible else counts.lost + 1
    counts.in_reach = counts.in_reach + 1 if star_visible and need <= reach_fraction else 0
    counts.out_of_reach = counts.out_of_reach + 1 if star_visible and need > 1.0 else 0


@compilable()
def is_unmoved(
    judged: Any, star_px: tuple[float, float], stages_px: tuple[float, float], target_px: Any
) -> bool:
    """Whether the stages have moved all but the spot on a frame; then it is not the loop's star.

    What stands still draws the siderostat on without end: another loop's star that rests, or a ghost.

    Parameters
    ----------
    judged : has off_target, 0 while the star is on its target, and off_star_px and off_stages_px, shape (2,)
        Where the star was when it was last known to be the loop's, and how far stages had moved it then.
    star_px : tuple of float
    stages_px : tuple of float
        How far the stages move the star, as they were when the frame was exposed.
    target_px : tuple of float, or array, shape (2,)
    """
    if math.hypot(star_px[0] - target_px[0], star_px[1] - target_px[1]) <= OFF_TARGET_PX:
        judged.off_target = 0
        return False
    if judged.off_target:
        az_px = stages_px[0] - judged.off_stages_px[0]
        el_px = stages_px[1] - judged.off_stages_px[1]
        moved_px = math.hypot(az_px, el_px)
        if moved_px < MOVED_PX:
            return False
        came_px = (star_px[0] - judged.off_star_px[0]) * az_px / moved_px
        came_px += (star_px[1] - judged.off_star_px[1]) * el_px / moved_px
        if came_px < LEAST_ANSWER * moved_px:
            return True
    judged.off_target = 1
    for axis in range(2):
        judged.off_star_px[axis] = star_px[axis]
        judged.off_stages_px[axis] = stages_px[axis]
    return False


@compilable()
def count_sample(
    counts: Any, lost: bool, measured: bool, error: float, in_reach: float, out_of_reach: float
) -> None:
    """Count a sample of a beam that is followed.

    Parameters
    ----------
    counts : has lost, in_reach and out_of_reach
        Samples in a row without the beam; with one measured within the error `in_reach`; without one measured
        within the error `out_of_reach`.
    lost, measured : bool
        No photodiode has light, or all of them have.
    error, in_reach, out_of_reach : float
        In one unit; the error is ignored where the beam is not measured.
    """
    counts.lost = counts.lost + 1 if lost else 0
    counts.in_reach = counts.in_reach + 1 if measured and error <= in_reach else 0
    counts.out_of_reach = 0 if measured and error <= out_of_reach else counts.out_of_reach + 1
