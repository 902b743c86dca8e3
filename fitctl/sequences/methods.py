"""The steps as methods, each with its keys as arguments; what a method gives is its class's choice."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Generic, Literal, TypedDict, TypeVar, Unpack

from fitctl.config import ControllerName
from fitctl.sequences import steps
from fitctl.sequences.reading import make_step

R_co = TypeVar("R_co", covariant=True)


class Limits(TypedDict, total=False):
    """What every step takes."""

    loop: str
    timeout_s: float
    attempts: int


class MotionLimits(Limits, total=False):
    """What steps take that move the star on the focal plane."""

    max_offset_px: float
    max_offset_sky_arcsec: float


class VisitLimits(MotionLimits, total=False):
    """What steps take that lead the star to one place after another."""

    dwell_s: float
    steady_after_s: float
    rms_limit_px: float


class StepMethods(ABC, Generic[R_co]):
    """The steps, each of which gives its figures, with units in their names."""

    @abstractmethod
    def run(self, step: steps.Step) -> R_co:
        """Run one step."""

    def _do(self, kind: type[steps.Step], keys: Mapping[str, Any]) -> R_co:
        return self.run(make_step(kind, keys))

    def standby(self, **limits: Unpack[Limits]) -> R_co:
        """Devices on and ready, the stages held where they are."""
        return self._do(steps.Standby, limits)

    def acquire(
        self,
        *,
        search_radius_sky_arcsec: float | None = None,
        radius_growth: float = 1.5,
        max_offset_sky_arcsec: float | None = None,
        field_overlap: float | None = None,
        expected_az_sky_arcsec: float | None = None,
        expected_el_sky_arcsec: float | None = None,
        star_flux_dn: float | None = None,
        **limits: Unpack[Limits],
    ) -> R_co:
        """Search for the star, pull it in, until it is held in VERNIER."""
        keys = {
            "search_radius_sky_arcsec": search_radius_sky_arcsec,
            "radius_growth": radius_growth,
            "max_offset_sky_arcsec": max_offset_sky_arcsec,
            "field_overlap": field_overlap,
            "expected_az_sky_arcsec": expected_az_sky_arcsec,
            "expected_el_sky_arcsec": expected_el_sky_arcsec,
            "star_flux_dn": star_flux_dn,
        }
        return self._do(steps.Acquire, {**keys, **limits})

    def hold(
        self,
        duration_s: float,
        *,
        settle_s: float = 10.0,
        rms_limit_px: float | None = None,
        **limits: Unpack[Limits],
    ) -> R_co:
        """Hold the star for a time and judge each axis against the requirement."""
        keys = {"duration_s": duration_s, "settle_s": settle_s, "rms_limit_px": rms_limit_px}
        return self._do(steps.Hold, {**keys, **limits})

    def stars(
        self,
        stars: Sequence[steps.Star | Mapping[str, Any]] | None = None,
        *,
        file: str = "",
        duration_s: float = 30.0,
        settle_s: float = 10.0,
        rms_limit_px: float | None = None,
        search_radius_sky_arcsec: float | None = None,
        radius_growth: float = 1.5,
        max_offset_sky_arcsec: float | None = None,
        on_failure: Literal["skip", "stop"] = "skip",
        least_held: int = 1,
        **limits: Unpack[Limits],
    ) -> R_co:
        """Go through a list of stars, or a file of them: acquire, hold and judge each."""
        keys = {
            "stars": stars if stars is None else list(stars),
            "file": file,
            "duration_s": duration_s,
            "settle_s": settle_s,
            "rms_limit_px": rms_limit_px,
            "search_radius_sky_arcsec": search_radius_sky_arcsec,
            "radius_growth": radius_growth,
            "max_offset_sky_arcsec": max_offset_sky_arcsec,
            "on_failure": on_failure,
            "least_held": least_held,
        }
        return self._do(steps.Stars, {**keys, **limits})

    def target(
        self, offset_az_px: float, offset_el_px: float, **limits: Unpack[VisitLimits]
    ) -> R_co:
        """Lead the star to a place beside the rig file's target; it stays there."""
        keys = {"offset_az_px": offset_az_px, "offset_el_px": offset_el_px}
        return self._do(steps.Target, {**keys, **limits})

    def jog(self, jog_px: float = 1.0, **limits: Unpack[VisitLimits]) -> R_co:
        """Both axes to one side, to the other and back."""
        return self._do(steps.Jog, {"jog_px": jog_px, **limits})

    def raster(
        self,
        columns: int = 3,
        rows: int = 3,
        spacing_px: float = 1.0,
        **limits: Unpack[VisitLimits],
    ) -> R_co:
        """Places on a grid about the target, row by row; then back to it."""
        keys = {"columns": columns, "rows": rows, "spacing_px": spacing_px}
        return self._do(steps.Raster, {**keys, **limits})

    def controller(self, name: ControllerName, **limits: Unpack[Limits]) -> R_co:
        """Work with another design from now on."""
        return self._do(steps.Controller, {"name": name, **limits})

    def experiment(
        self,
        what: Literal["backlash", "delay", "hysteresis", "airpath"],
        **limits: Unpack[MotionLimits],
    ) -> R_co:
        """Make the motions of an identification, open loop."""
        return self._do(steps.Experiment, {"what": what, **limits})

    def chirp(
        self,
        channel: Literal["fsm_az", "fsm_el", "siderostat_az", "siderostat_el"],
        *,
        amplitude_px: float = 1.0,
        from_hz: float = 0.2,
        to_hz: float = 5.0,
        duration_s: float = 30.0,
        **limits: Unpack[MotionLimits],
    ) -> R_co:
        """Sweep one axis of one stage in frequency, open loop."""
        keys = {
            "channel": channel,
            "amplitude_px": amplitude_px,
            "from_hz": from_hz,
            "to_hz": to_hz,
            "duration_s": duration_s,
        }
        return self._do(steps.Chirp, {**keys, **limits})

    def plate_scale(
        self,
        *,
        amplitude_px: float = 3.0,
        duration_s: float = 20.0,
        max_error: float = 0.02,
        max_residual_px: float = 0.5,
        max_rotation_deg: float = 45.0,
        **limits: Unpack[MotionLimits],
    ) -> R_co:
        """Drive both stages, open loop, and solve how each moves the star."""
        keys = {
            "amplitude_px": amplitude_px,
            "duration_s": duration_s,
            "max_error": max_error,
            "max_residual_px": max_residual_px,
            "max_rotation_deg": max_rotation_deg,
        }
        return self._do(steps.PlateScale, {**keys, **limits})

    def dark(
        self, frames: int = 100, *, max_bright_pixels: int = 5, **limits: Unpack[Limits]
    ) -> R_co:
        """Measure the camera's bias and noise, from frames without a star."""
        keys = {"frames": frames, "max_bright_pixels": max_bright_pixels}
        return self._do(steps.Dark, {**keys, **limits})

    def wait(self, duration_s: float, **limits: Unpack[Limits]) -> R_co:
        """Do nothing, for a time."""
        return self._do(steps.Wait, {"duration_s": duration_s, **limits})

    def off(self, **limits: Unpack[Limits]) -> R_co:
        """Hold, mirror to its bias, amplifiers disabled, devices let go."""
        return self._do(steps.Off, limits)
