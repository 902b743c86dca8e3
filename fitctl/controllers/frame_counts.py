"""Counting frames in a row: when a candidate is the star, and what becomes of a star that is followed.

Functions change the counts of what they are given: a live object, or a record of a compiled run.
"""

from __future__ import annotations

from typing import Any

from fitctl.model.compiled import compilable

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
