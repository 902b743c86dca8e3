"""The rig file's plant: what is true of the simulated instrument."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field, Tag, model_validator

from fitctl.config.base import (
    BY_KIND,
    METROLOGY,
    STELLAR,
    AxisGains,
    AxisPair,
    DelayS,
    Name,
    NonNegative,
    OffsetSkyArcsec,
    Positive,
    Settings,
    of_kind,
)
from fitctl.config.devices import PixelNoiseDn, Structure
from fitctl.config.loops import AirB1S2, AirB2S, AirPathModel, FluxDn, SpotDiameterPx
from fitctl.config.metrology import BeamSensor

MOST_INSTANTS = 16
_MOST_HISTORY_STEPS = 10_000_000  # some hundred megabytes


LoopWidth = Annotated[float, Field(ge=0, le=0.5)]
BandwidthHz = Annotated[float, Field(ge=0.1, le=1e6)]
RmsPx = Annotated[float, Field(ge=0, le=1000)]


class Hysteresis(Settings):
    """Play operators of one stack, and by which part of its way it creeps on with each decade of time."""

    full_swing_stroke_m: Annotated[float, Field(gt=0, le=0.01)]
    loop_width_fraction: LoopWidth
    breakpoints_from: Literal["virgin", "swept"]
    breakpoints_v: Annotated[list[NonNegative], Field(min_length=2)]
    creep_per_decade: Annotated[float, Field(ge=0, le=0.2)] = 0.0

    @model_validator(mode="after")
    def _ascending_from_zero(self) -> Hysteresis:
        points = self.breakpoints_v
        if points[0] != 0 or any(b <= a for a, b in itertools.pairwise(points)):
            msg = "breakpoints_v must start at 0 and ascend"
            raise ValueError(msg)
        return self


class AirPath(AirPathModel):
    """The air path as it truly is."""

    relative_rms_px: RmsPx


class Spot(Settings):
    """One spot on the focal plane."""

    name: Name
    offset_px: AxisPair
    flux_dn: FluxDn
    diameter_px: SpotDiameterPx


class Line(Settings):
    """A line in the spectrum of a star's motion: a vibration, of a pump or of a mount.

    Attributes
    ----------
    frequency_hz : float
    rms_px : float
        Along its direction.
    direction_deg : float
        0 is az, 90 is el.
    damping : float
        Of the oscillator that random forces drive; 0 is a sine.
    drift_hz_per_min : float
        By how much the frequency changes.
    """

    frequency_hz: Positive
    rms_px: RmsPx
    direction_deg: Annotated[float, Field(ge=-360, le=360)]
    damping: Annotated[float, Field(ge=0, le=0.5)]
    drift_hz_per_min: Annotated[float, Field(ge=-1e4, le=1e4)]


Lines = Annotated[tuple[Line, ...], Field(strict=False)]


class HotPixel(Settings):
    """A pixel that reads more than the others, light or no light."""

    az_px: Annotated[int, Field(ge=0)]
    el_px: Annotated[int, Field(ge=0)]
    dn: Positive


class LoopPlant(Settings):
    """What one stellar loop's hardware truly is; nothing but mocks and simulation reads it.

    The star of a loop without ``star_rate_sky_arcsec_s`` stands still but for the air. Without gains of
    their own, its stages have those of the loop.
    """

    kind: Literal["stellar"] = "stellar"
    star_offset_sky_arcsec_max: OffsetSkyArcsec
    backlash_sky_arcsec: OffsetSkyArcsec
    amplifier_bandwidth_hz: BandwidthHz
    hysteresis: Hysteresis
    structure: Structure
    air_path: AirPath
    spots: Annotated[list[Spot], Field(min_length=1)]
    lines: Lines = ()
    star_rate_sky_arcsec_s: AxisPair | None = None
    siderostat_axis_gains: AxisGains | None = None
    fsm_axis_gains: AxisGains | None = None


class LinkAir(Settings):
    """The air of a metrology loop's path: Eq. 8's filter, scaled to an RMS angle of the beam on each axis."""

    rms_sky_arcsec: OffsetSkyArcsec
    b1_s2: AirB1S2
    b2_s: AirB2S


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
    beam_offset_sky_arcsec_max: OffsetSkyArcsec
    backlash_sky_arcsec: OffsetSkyArcsec
    amplifier_bandwidth_hz: BandwidthHz
    air_path: LinkAir
    link_round_trip_s: DelayS
    sensor: BeamSensor


class LoopChange(Settings):
    """What changes of one stellar loop's hardware; what is left out stays as it is."""

    air_path: AirPathModel | None = None
    loop_width_fraction: LoopWidth | None = None
    lines: Annotated[tuple[Line, ...] | None, Field(strict=False)] = None


class Change(Settings):
    """What changes of the hardware during a run, at a time from its start."""

    at_s: Positive
    pixel_noise_dn: PixelNoiseDn | None = None
    loops: dict[str, LoopChange] = Field(default_factory=dict)


class PlantTruth(Settings):
    """The simulated hardware.

    ``exposure_instants`` is at how many instants of its exposure a frame sees the spots; with one, nothing
    smears.
    """

    step_s: Annotated[float, Field(gt=0, le=1e-3)]
    frame_delay_s: DelayS | None = None  # where the truth is not what camera.frame_delay_s says
    history_s: Annotated[float, Field(ge=1, le=3600)]
    hot_pixels: tuple[HotPixel, ...] = Field(default=(), strict=False)
    exposure_instants: Annotated[int, Field(ge=1, le=MOST_INSTANTS)] = 1
    timeline: tuple[Change, ...] = Field(default=(), strict=False)
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

    def changes(self, loop_name: str) -> list[tuple[float, LoopChange]]:
        """The times at which a stellar loop's hardware changes, and how."""
        return [
            (change.at_s, change.loops[loop_name])
            for change in self.timeline
            if loop_name in change.loops
        ]

    @model_validator(mode="after")
    def _timeline_is_in_order(self) -> PlantTruth:
        if any(b.at_s <= a.at_s for a, b in itertools.pairwise(self.timeline)):
            msg = "timeline: at_s must ascend from table to table"
            raise ValueError(msg)
        known = self.stellar_loops
        for change in self.timeline:
            for name in change.loops.keys() - known.keys():
                msg = f"timeline: loops.{name} is not a loop of kind stellar ({', '.join(known)})"
                raise ValueError(msg)
        return self

    @model_validator(mode="after")
    def _lines_are_slower_than_the_grid(self) -> PlantTruth:
        highest_hz = 0.5 / self.step_s
        for name, loop in self.stellar_loops.items():
            changed = [line for _, to in self.changes(name) for line in to.lines or ()]
            for line in (*loop.lines, *changed):
                if line.frequency_hz >= highest_hz:
                    msg = (
                        f"loops.{name}.lines: frequency_hz must be below {highest_hz:g}, half the rate of "
                        f"step_s (is {line.frequency_hz:g})"
                    )
                    raise ValueError(msg)
        return self
