"""Whether a star that is followed is still there, within the mirror's reach, and moved by the loop's stages."""

from __future__ import annotations

import math

from fitctl.config import Loop
from fitctl.controllers.centroid import Star
from fitctl.controllers.frame_counts import count_frame, is_unmoved
from fitctl.loop.pointing import error_from
from fitctl.messages.modes import Finding, Mode, Trigger
from fitctl.model.optics import AzEl, Scales, rows, transformed


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
    off_target : int
        0 while the star is on its target.
    off_star_px, off_stages_px : list of float
        Where the star was when it was last known to be the loop's, and how far the stages had moved it then.
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
        self.off_target = 0
        self.off_star_px, self.off_stages_px = [0.0, 0.0], [0.0, 0.0]

    def unmoved(self, star: Star | None, stages_px: AzEl, target_px: AzEl) -> Finding | None:
        """A star that does not move with the stages is another, or a reflection."""
        if star is None or not is_unmoved(self, star[:2], stages_px, target_px):
            return None
        moved_px = math.dist(stages_px, self.off_stages_px)
        return Finding(
            Trigger.STAR_LOST,
            f"the stages moved the star by {moved_px:.0f} px, but this spot did not move with them; "
            "it is another star or a reflection",
        )

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
