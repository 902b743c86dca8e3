"""The rig file's collector bench, which a hexapod moves, and the fringes that the instrument is for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from fitctl.config.base import ConfigError, Finite, Name, NonNegative, Positive, Settings, must_be
from fitctl.config.conflict import written
from fitctl.config.devices import C887Device

Vector = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Motion = Literal["still", "drift", "sine", "random", "file"]
_KEYS: dict[Motion, tuple[str, ...]] = {
    "still": (),
    "drift": ("direction_deg", "range_mm", "velocity_mm_s"),
    "sine": ("direction_deg", "amplitude_mm", "frequency_hz"),
    "random": ("direction_deg", "range_mm", "rms_mm_s", "correlation_s"),
    "file": ("file",),
}
_NEARLY = 1e-6


class CollectorGeometry(Settings):
    """Where the parts of the collector bench are, in the hexapod's axes X, Y, Z.

    Attributes
    ----------
    starlight, link : list of float
        Directions: of the starlight before the collector, and from the collector to the combiner.
    link_azimuth : list of float
        The direction at the array in which the beam moves when its siderostat's azimuth grows; elevation is
        ``link`` x ``link_azimuth``.
    siderostat_m, array_m, pivot_m : list of float
        Places of the collector siderostat's mirror, of the transfer mirror with the photodiodes, and of the
        point about which U, V and W turn the bench.
    """

    starlight: Vector
    link: Vector
    link_azimuth: Vector
    siderostat_m: Vector
    array_m: Vector
    pivot_m: Vector

    @model_validator(mode="after")
    def _is_a_light_path(self) -> CollectorGeometry:
        for key in ("starlight", "link", "link_azimuth"):
            if abs(math.hypot(*getattr(self, key)) - 1) > _NEARLY:
                msg = f"{key} must be a direction of length 1"
                raise ValueError(msg)
        if abs(_dot(self.link, self.link_azimuth)) > _NEARLY:
            msg = "link_azimuth must be at a right angle to link"
            raise ValueError(msg)
        between = [b - a for a, b in zip(self.siderostat_m, self.array_m, strict=True)]
        length_m = math.hypot(*between)
        if length_m == 0:
            msg = "siderostat_m and array_m must be two places"
            raise ValueError(msg)
        for key, direction in (("starlight", self.starlight), ("link", self.link)):
            if _dot(between, direction) / length_m > 1 - _NEARLY:
                msg = (
                    f"{key} must differ from the direction from siderostat_m to array_m, "
                    "or a mirror would turn no light"
                )
                raise ValueError(msg)
        return self


def _dot(one: list[float], other: list[float]) -> float:
    return sum(a * b for a, b in zip(one, other, strict=True))


class CollectorMotion(Settings):
    """How fitctl makes the hexapod move the collector across the link; `kind` says which keys are used.

    Attributes
    ----------
    start_s : float
        In a simulated run: when the motion begins.
    direction_deg : float
        Of drift, sine and random motion: from the link's azimuth towards elevation.
    range_mm : float
        Drift and random motion turn back at this distance from the start.
    velocity_mm_s : float
        Of a drift.
    amplitude_mm, frequency_hz : float
        Of a sine.
    rms_mm_s, correlation_s : float
        Of the random velocity.
    file : str
        CSV with columns time_s, az_mm, el_mm; empty for the other kinds.
    """

    kind: Motion
    start_s: NonNegative
    direction_deg: Annotated[float, Field(ge=-180, le=180)]
    range_mm: Positive
    velocity_mm_s: Positive
    amplitude_mm: Positive
    frequency_hz: Positive
    rms_mm_s: Positive
    correlation_s: Positive
    file: str

    @model_validator(mode="after")
    def _file_is_named(self) -> CollectorMotion:
        if self.kind == "file" and not self.file:
            msg = 'file must name a CSV file where kind is "file"'
            raise ValueError(msg)
        return self

    def changed(self, values: Mapping[str, Any]) -> CollectorMotion:
        """The motion that it is with some values replaced.

        Raises
        ------
        ConfigError
            If it is none, or has no use for a value; the text names each key and what is allowed.
        """
        try:
            motion = CollectorMotion.model_validate(self.model_dump() | dict(values))
        except ValidationError as error:
            wrong = [
                f"{key}: {must_be(each)} (is {written(each['input'])})"
                if (key := ".".join(map(str, each["loc"])))
                else must_be(each)
                for each in error.errors()
            ]
            raise ConfigError("; ".join(wrong)) from None
        its = _KEYS[motion.kind]
        if unused := [key for key in values if key not in {"kind", "start_s", *its}]:
            msg = f"{motion.kind} has no {', '.join(unused)}; it has {', '.join(its) or 'no keys'}"
            raise ConfigError(msg)
        return motion


class Collector(Settings):
    """The collector bench: the hexapod under it, where its parts are, and how it is moved."""

    hexapod: C887Device
    geometry: CollectorGeometry
    motion: CollectorMotion


class Fringes(Settings):
    """Which two loops' stars interfere, and at what aperture and wavelength."""

    loops: Annotated[list[Name], Field(min_length=2, max_length=2)]
    aperture_m: Annotated[float, Field(ge=1e-3, le=100)]
    wavelength_m: Annotated[float, Field(ge=1e-7, le=1e-4)]
