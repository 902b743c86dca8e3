"""The search for a metrology beam: its siderostat goes along a spiral until a photodiode has light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.spiral import plan_beam_spiral
from fitctl.loop.search.spiral import SpiralSearch, Wanted, asked_place_sky_arcsec
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Finding, Trigger
from fitctl.model.optics import sky_px_per_rad

Floats = NDArray[np.float64]
_CHECK = "the laser and its path"
_BEAM = Wanted(
    name="beam",
    found=Trigger.BEAM_FOUND,
    confirmed="light on {} samples in a row",
    rejected="light was not confirmed; the search for the beam goes on",
    check=f"{_CHECK}, and give expected_az_sky_arcsec and expected_el_sky_arcsec if the beam is elsewhere",
    check_long=_CHECK,
)


class BeamSearch(SpiralSearch):
    """One metrology loop's; :meth:`start_as_asked` begins it anew.

    Parameters
    ----------
    rig : Rig
    loop_name : str

    Attributes
    ----------
    unfound_rad : array, shape (2,), or None
        Motor angles in the middle of a search that has not found the beam; None after one that has.
    """

    def __init__(self, rig: Rig, loop_name: str) -> None:
        loop = rig.metrology_loops[loop_name]
        siderostat = loop.siderostat
        self._sky_arcsec_per_motor_rad = siderostat.sky_arcsec_per_motor_rad
        px_per_motor_rad = siderostat.sky_rad_per_motor_rad * sky_px_per_rad(rig)
        self.unfound_rad: Floats | None = None
        super().__init__(
            _BEAM,
            loop.acquisition,
            lambda radius: plan_beam_spiral(rig, loop_name, radius_sky_arcsec=radius),
            lambda offset_px: offset_px / px_per_motor_rad,
            siderostat,
            px_per_motor_rad,
        )

    def start_as_asked(self, asked: Acquire, motor_rad: Floats, *, again: bool) -> None:
        """A new search: where a command asks; else where the last one did not find the beam; else here.

        Here, with the motors at `motor_rad`, shape (2,), is the last place of a beam that was lost.
        """
        centre_rad = motor_rad if self.unfound_rad is None else self.unfound_rad
        place_sky_arcsec = asked_place_sky_arcsec(asked)
        if place_sky_arcsec is not None:
            centre_rad = place_sky_arcsec / self._sky_arcsec_per_motor_rad
        self.unfound_rad = centre_rad
        self.start(centre_rad, again=again, radius_sky_arcsec=asked.search_radius_sky_arcsec)

    def forget(self) -> None:
        """The next search begins where the siderostat then is."""
        self.unfound_rad = None

    def evaluate(self, has_light: bool, motor_rad: Floats, now_s: float) -> Finding | None:
        """What a sample taken at `now_s`, with the motors at `motor_rad`, means for the search."""
        if not (has_light or self._candidate or self._arrived):
            return self._wait_for_siderostat(now_s)
        finding = self.look(has_light, motor_rad, now_s)
        if finding is not None and finding.trigger is Trigger.BEAM_FOUND:
            self.forget()
        return finding
