"""The rig file's plant: what is true of the simulated instrument."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field, Tag, model_validator

from fitctl.config.base import (
    BY_KIND,
    METROLOGY,
    STELLAR,
    AxisPair,
    Name,
    NonNegative,
    Positive,
    Settings,
    of_kind,
)
from fitctl.config.devices import Structure
from fitctl.config.loops import AirPathModel
from fitctl.config.metrology import BeamSensor

_MOST_HISTORY_STEPS = 10_000_000  # some hundred megabytes


class Hysteresis(Settings):
    """Play operators of one stack."""

    full_swing_stroke_m: Positive
    loop_width_fraction: Annotated[float, Field(ge=0, le=0.5)]
    breakpoints_from: Literal["virgin", "swept"]
    breakpoints_v: Annotated[list[NonNegative], Field(min_length=2)]

    @model_validator(mode="after")
    def _ascending_from_zero(self) -> Hysteresis:
        points = self.breakpoints_v
        if points[0] != 0 or any(b <= a for a, b in itertools.pairwise(points)):
            msg = "breakpoints_v must start at 0 and ascend"
            raise ValueError(msg)
        return self


class AirPath(AirPathModel):
    """The air path as it truly is."""

    relative_rms_px: NonNegative


class Spot(Settings):
    """One spot on the focal plane."""

    name: Name
    offset_px: AxisPair
    flux_dn: Positive
    diameter_px: Positive


class HotPixel(Settings):
    """A pixel that reads more than the others, light or no light."""

    az_px: Annotated[int, Field(ge=0)]
    el_px: Annotated[int, Field(ge=0)]
    dn: Positive


class LoopPlant(Settings):
    """What one stellar loop's hardware truly is; nothing but mocks and simulation reads it."""

    kind: Literal["stellar"] = "stellar"
    star_offset_sky_arcsec_max: NonNegative
    backlash_sky_arcsec: NonNegative
    amplifier_bandwidth_hz: Positive
    hysteresis: Hysteresis
    structure: Structure
    air_path: AirPath
    spots: Annotated[list[Spot], Field(min_length=1)]


class LinkAir(Settings):
    """The air of a metrology loop's path: Eq. 8's filter, scaled to an RMS angle of the beam on each axis."""

    rms_sky_arcsec: NonNegative
    b1_s2: Positive
    b2_s: Positive


class MetrologyPlant(Settings):
    """What a metrology loop's hardware truly is, as :class:`LoopPlant`.

    Attributes
    ----------
    beam_offset_sky_arcsec_max : float
        The seed places the beam within this radius of the centre of the array at the start.
    backlash_sky_arcsec, amplifier_bandwidth_hz : float
        Of its siderostat.
    air_path : LinkAir
    link_round_trip_s : float
        From a request for a sample to its answer; the sample is from the middle of it.
    sensor : BeamSensor
        What beam and photodiodes truly are.
    """

    kind: Literal["metrology"]
    beam_offset_sky_arcsec_max: NonNegative
    backlash_sky_arcsec: NonNegative
    amplifier_bandwidth_hz: Positive
    air_path: LinkAir
    link_round_trip_s: NonNegative
    sensor: BeamSensor


class PlantTruth(Settings):
    """The simulated hardware."""

    step_s: Annotated[float, Field(gt=0, le=1e-3)]
    frame_delay_s: NonNegative | None = (
        None  # where the truth is not what camera.frame_delay_s says
    )
    history_s: Annotated[float, Field(ge=1, le=3600)]
    hot_pixels: tuple[HotPixel, ...] = Field(default=(), strict=False)
    loops: Annotated[
        dict[
            str,
            Annotated[
                Annotated[LoopPlant, Tag(STELLAR)] | Annotated[MetrologyPlant, Tag(METROLOGY)],
                BY_KIND,
            ],
        ],
        Field(min_length=1),
    ]

    @property
    def stellar_loops(self) -> dict[str, LoopPlant]:
        """Those of kind stellar."""
        return of_kind(self.loops, LoopPlant)

    @property
    def metrology_loops(self) -> dict[str, MetrologyPlant]:
        """Those of kind metrology."""
        return of_kind(self.loops, MetrologyPlant)

    @model_validator(mode="after")
    def _history_fits_in_memory(self) -> PlantTruth:
        if self.history_s / self.step_s > _MOST_HISTORY_STEPS:
            msg = f"history_s may be at most {_MOST_HISTORY_STEPS * self.step_s:g} at this step_s"
            raise ValueError(msg)
        return self
