"""Whether a star that is followed is still there, within the mirror's reach, and moved by the loop's stages."""

from __future__ import annotations

import math
from typing import NamedTuple

from fitctl.config import HALF_WINDOW_PX, Loop
from fitctl.controllers.centroid import Star
from fitctl.controllers.frame_counts import count_frame
from fitctl.loop.pointing import error_from
from fitctl.messages.modes import Finding, Mode, Trigger
from fitctl.model.optics import AzEl, Scales, rows, transformed

# Air, hysteresis and a slow drift move a star by less than the first while stages move it by the second.
_OFF_TARGET_PX = 1.0  # nearer to its target, a star is where the loop wants it
_MOVED_PX = 3.0 * HALF_WINDOW_PX  # so far stages must have moved a star that can be judged
_LEAST_ANSWER = 0.5  # of what the stages did


class Place(NamedTuple):
    """Where a frame showed a star, and how far the stages had moved it then."""

    star_px: AzEl
    stages_px: AzEl


class Following:
    """One loop's; :meth:`begin` begins it anew.

    Parameters
    ----------
    loop : Loop
    scale : Scales

    Attributes
    ----------
    lost, in_reach, out_of_reach : int
        Frames in a row without the star; with an error that the mirror has room for; with one that it has not.
    off_target : Place or None
        Since when the star has not been on its target.
    """

    def __init__(self, loop: Loop, scale: Scales) -> None:
        self._lost_frames = loop.acquisition.lost_frames
        self._reach_frames = loop.coarse.reach_frames
        self._reach_fraction = loop.coarse.reach_fraction
        self._range_px = scale.mirror_px_per_rad * loop.fsm.range_rad
        self._to_mirror = rows(scale.mirror_back)
        self.begin()

    def begin(self) -> None:
        """Count anew."""
        self.lost = self.in_reach = self.out_of_reach = 0
        self.off_target: Place | None = None

    def unmoved(self, star: Star | None, stages_px: AzEl, target_px: AzEl) -> Finding | None:
        """Whether the stages have moved all but what a frame shows; then it is not the loop's star.

        What stands still draws the siderostat on without end: another loop's star that rests, or a ghost.
        The star was last at `off_target` for sure.

        Parameters
        ----------
        star : Star or None
        stages_px : tuple of float
            How far the stages move the star, as they were when the frame was exposed.
        target_px : tuple of float
        """
        if star is None:
            return None
        if math.dist(star[:2], target_px) <= _OFF_TARGET_PX:
            self.off_target = None
            return None
        if self.off_target is None:
            self.off_target = Place(star[:2], stages_px)
            return None
        was = self.off_target
        az_px, el_px = stages_px[0] - was.stages_px[0], stages_px[1] - was.stages_px[1]
        stages_moved_px = math.hypot(az_px, el_px)
        if stages_moved_px < _MOVED_PX:
            return None
        moved_px = (
            (star.az_px - was.star_px[0]) * az_px + (star.el_px - was.star_px[1]) * el_px
        ) / stages_moved_px
        if moved_px < _LEAST_ANSWER * stages_moved_px:
            return Finding(
                Trigger.STAR_LOST,
                f"the stages moved the star by {stages_moved_px:.0f} px, but this spot did not move with them; "
                "it is another star or a reflection",
            )
        self.off_target = Place(star[:2], stages_px)
        return None

    def evaluate(self, mode: Mode, star: Star | None, target_px: AzEl) -> Finding | None:
        """What a frame showed, if it leads to another mode."""
        need = math.nan
        if star is not None:
            # The mirror's diamond lies along its own axes.
            az_px, el_px = transformed(self._to_mirror, *error_from(target_px, star))
            need = (abs(az_px) + abs(el_px)) / self._range_px
        count_frame(self, star is not None, need, self._reach_fraction)
        if self.lost >= self._lost_frames:
            return Finding(Trigger.STAR_LOST, f"no star on {self.lost} frames in a row")
        if mode is Mode.COARSE and self.in_reach >= self._reach_frames:
            return Finding(Trigger.IN_REACH, f"the mirror needs {need:.0%} of its range")
        if mode is Mode.VERNIER and self.out_of_reach >= self._reach_frames:
            return Finding(Trigger.OUT_OF_REACH, f"the mirror needs {need:.0%} of its range")
        return None
