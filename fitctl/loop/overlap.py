"""The figure of merit: the tilt between two loops' stars, and the fringe visibility that it leaves."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fitctl.config import ARCSEC_PER_RAD, Rig
from fitctl.controllers.visibility import visibility
from fitctl.drivers.interface import Frame
from fitctl.logging.records import Overlap
from fitctl.loop.loop import Loop
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.modes import WITH_WINDOW
from fitctl.model.optics import AzEl, sky_px_per_rad


class OverlapMeter:
    """Measures it on each frame.

    Parameters
    ----------
    rig : Rig
        Must have its ``fringes`` section.
    loops : mapping of str to Loop
    """

    def __init__(self, rig: Rig, loops: Mapping[str, Loop]) -> None:
        if rig.fringes is None:
            msg = f"rig {rig.name}: an overlap needs the section fringes"
            raise ValueError(msg)
        self._fringes = rig.fringes
        self._sky_arcsec_per_px = ARCSEC_PER_RAD / sky_px_per_rad(rig)
        self._loops = [_stellar(loops[name]) for name in rig.fringes.loops]

    def measure(self, frame: Frame) -> Overlap:
        """Of the frame on which the loops have just ticked."""
        one, other = (_offset_px(loop, frame) for loop in self._loops)
        az_arcsec = self._sky_arcsec_per_px * (one[0] - other[0])
        el_arcsec = self._sky_arcsec_per_px * (one[1] - other[1])
        tilt_rad = math.hypot(az_arcsec, el_arcsec) / ARCSEC_PER_RAD
        name, other_name = self._fringes.loops
        return Overlap(
            time_s=frame.mid_exposure_s,
            loop=name,
            other_loop=other_name,
            number=frame.number,
            tilt_az_arcsec=az_arcsec,
            tilt_el_arcsec=el_arcsec,
            visibility=math.nan
            if math.isnan(tilt_rad)
            else visibility(tilt_rad, self._fringes.aperture_m, self._fringes.wavelength_m),
        )


def _stellar(loop: Loop) -> StellarLoop:
    if not isinstance(loop, StellarLoop):
        msg = f"fringes.loops: {loop.name} points no star"
        raise TypeError(msg)
    return loop


def _offset_px(loop: StellarLoop, frame: Frame) -> AzEl:
    """A loop's star from the rig file's target; NaN where it is not followed."""
    observation, target_px = loop.observation, loop.settings.target_px
    if loop.mode not in WITH_WINDOW or observation.star is None or observation.frame is not frame:
        return math.nan, math.nan
    return observation.star.az_px - target_px.az, observation.star.el_px - target_px.el
