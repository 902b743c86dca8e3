"""What stops an identification, before its experiment and after it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig

_LEAST_SEEN = 0.9  # of the frames
_LONGEST_S = 86_400.0  # of an experiment or a step, with all that interrupts it


class IdentifyError(ValueError):
    """A record, or a rig, from which nothing can be learned: one line with what, expected, next step."""


def require_room(rig: Rig, loop_name: str, what: str, az_px: float, el_px: float) -> None:
    """Refuse motions that would take the star off the frame, az_px or el_px to either side of its target.

    Raises
    ------
    IdentifyError
    """
    target = rig.stellar_loops[loop_name].target_px
    for sign in (-1, 1):
        if not rig.camera.window_fits(target.az + sign * az_px, target.el + sign * el_px):
            msg = (
                f"{what} needs {max(az_px, el_px):.1f} px to either side of the star, which must stay on the "
                f"frame; move loops.{loop_name}.target_px nearer to the frame's middle"
            )
            raise IdentifyError(msg)


def require_star(with_star: int, due: int, frames: str, least: int) -> None:
    """Refuse a record with the star on too few of the `due` frames, which `frames` names.

    Raises
    ------
    IdentifyError
    """
    if with_star < max(least, _LEAST_SEEN * due):
        msg = (
            f"the star is on {with_star} of {due} {frames}, expected at least {least} and "
            f"{100 * _LEAST_SEEN:g} %; look at the flux, then run it again"
        )
        raise IdentifyError(msg)


def require_times(times_s: NDArray[np.float64], period_s: float, what: str) -> None:
    """Refuse times, shape (n,), that cannot be of one experiment with a frame in each period or less often.

    Within a period, they may go back by what is the clocks' noise.

    Raises
    ------
    IdentifyError
    """
    steps_s = np.diff(times_s)
    span_s = np.ptp(times_s)
    # NaN fulfils none of these.
    if span_s <= _LONGEST_S and steps_s.min() > -period_s and np.median(steps_s) > period_s / 2:
        return
    msg = (
        f"the times of the {what} go on by {np.median(steps_s):.4g} s in the median and {steps_s.min():.4g} s "
        f"at the least, over {span_s:.4g} s; expected one every {period_s:.4g} s, none before the one before "
        "it, and no more than a day; name the rig and the whole log of one run"
    )
    raise IdentifyError(msg)
