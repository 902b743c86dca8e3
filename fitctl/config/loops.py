"""The rig file's loops: acquisition, controllers, and the settings of supervisor, service and log."""

from __future__ import annotations

import math
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field, field_validator, model_validator

from fitctl.config.base import (
    AxisPair,
    ConfigError,
    Count,
    Finite,
    Fraction,
    Name,
    NonNegative,
    Port,
    Positive,
    Range,
    Settings,
)
from fitctl.config.conflict import (
    Conflict,
    Conflicts,
    Part,
    above,
    at_least,
    at_most,
    below,
    short,
    written,
)
from fitctl.config.devices import AnySiderostat, Fsm

ControllerName = Literal["eq20", "lqg-ltr", "minimum-variance", "fslq"]
CONTROLLERS: tuple[ControllerName, ...] = get_args(ControllerName)
LEAST_OVERLAP, MOST_OVERLAP = 0.05, 0.6
FieldOverlap = Annotated[float, Field(ge=LEAST_OVERLAP, le=MOST_OVERLAP)]


class Acquisition(Settings):
    """How a star or a metrology beam is searched for, and when it counts as found or lost.

    Without ``search_again_s``, the search for one that was followed and lost ends only on a command.
    """

    search_radius_sky_arcsec: Positive
    detection_sigma: Annotated[float, Field(ge=3, le=100)]
    found_frames: Count
    lost_frames: Count
    field_overlap: FieldOverlap
    settle_s: Annotated[float, Field(ge=0, le=60)]
    confirm_timeout_s: Annotated[float, Field(gt=0, le=600)]
    search_again_pause_s: Annotated[float, Field(ge=0, le=86_400)]
    search_again_s: NonNegative | None = None


class Coarse(Settings):
    """The siderostat's integrator, and when it hands over to the mirror."""

    gain_rad_per_m: Annotated[float, Field(ge=1e-3, le=1e9)]
    reach_fraction: Fraction
    reach_frames: Count


# Wide enough for all that fits try, and no wider than the covariance can be computed.
AirB1S2 = Annotated[float, Field(ge=1e-6, le=1e4)]
AirB2S = Annotated[float, Field(ge=1e-5, le=1e4)]


class AirPathModel(Settings):
    """Eq. 8: gain / (b1 s^2 + b2 s + 1), px, driven by unit-intensity white noise."""

    gain_px: Annotated[float, Field(ge=0, le=1e6)]
    b1_s2: AirB1S2
    b2_s: AirB2S


class LqgLtr(Settings):
    """Design parameters of Eq. 10-19."""

    omega_n_rad_s: Positive
    zeta: Positive
    omega_notch_rad_s: Positive
    zeta_zero: Positive
    zeta_pole: Positive
    process_noise: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    measurement_noise: Positive
    control_weight: Positive


class MinimumVariance(Settings):
    """Design parameters of the minimum-variance pair."""

    drift_px_per_sqrt_s: Positive
    offload_per_s: Positive


class Fslq(Settings):
    """Design parameters of the frequency-shaped LQ pair."""

    crossover_hz: Positive
    control_weight: Positive
    drift_px_per_sqrt_s: Positive


class Vernier(Settings):
    """Which design drives mirror and siderostat in VERNIER, and what designs are made from."""

    controller: str
    air_path: AirPathModel
    lqg_ltr: LqgLtr
    minimum_variance: MinimumVariance
    fslq: Fslq

    @field_validator("controller")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in CONTROLLERS and not name.endswith((".json", ".py")):
            msg = (
                f"must be one of {', '.join(CONTROLLERS)}, a file *.json that `fitctl design` saved, or a "
                "Python file *.py of your own"
            )
            raise ValueError(msg)
        return name


class Prefilter(Settings):
    """The filter on commanded beam angle."""

    time_constant_s: Positive


_MOST_FLUX_DN = 1e9
FluxDn = Annotated[float, Field(gt=0, le=_MOST_FLUX_DN)]
SpotDiameterPx = Annotated[float, Field(ge=0.1, le=1000)]


class OtherSpot(Settings):
    """A spot that moves with the loop's star and is not the one to point, such as its fringe spot."""

    name: Name
    offset_px: AxisPair
    flux_dn: FluxDn


class Feedforward(Settings):
    """What the siderostat is moved by when the siderostat of the loop's link turns.

    Attributes
    ----------
    signal : str
        What says how far the link's siderostat turned the beam: its encoders. With the known backlash of both
        siderostats, the mirror makes up for what the encoders do not see.
    gain : float
        0 is off.
    matrix : list of list of float
        From the beam of the link's siderostat, az and el on the sky, to this loop's; ``fitctl identify
        feedforward`` measures it.
    """

    signal: Literal["encoders", "encoders+backlash"]
    gain: Finite
    matrix: Annotated[
        list[Annotated[list[Finite], Field(min_length=2, max_length=2)]],
        Field(min_length=2, max_length=2),
    ]


class Loop(Settings):
    """One stellar loop.

    With ``link``, its star's light comes over the link that this metrology loop holds. ``spot_diameter_px`` is
    the 1/e^2 diameter of its spots; other loops on the same camera subtract their light by it. ``sensor`` is
    how the star is measured: by Eq. 7's centre of gravity, or by a fit of a spot of that diameter.
    ``star_rate_sky_arcsec_s`` is how fast the star is known to move along the axes of the siderostat, with the
    stages at rest; the siderostat follows it. ``learn`` says what the loop does with a design
    that was learnt from its own frames: nothing, advise the operator, or use it. ``fastest_line_hz`` is the
    highest frequency of the rig's vibrations, if it is known. Without it, any line may be an alias.
    """

    kind: Literal["stellar"] = "stellar"
    link: Name | None = None
    feedforward: Feedforward | None = None
    target_px: AxisPair
    star_flux_dn: FluxDn
    flux_range: Range
    spot_diameter_px: SpotDiameterPx = 3.0
    sensor: Literal["centroid", "fit"] = "centroid"
    other_spots: Annotated[tuple[OtherSpot, ...], Field(strict=False)]
    requirement_px: Positive
    star_rate_sky_arcsec_s: AxisPair | None = None
    siderostat: AnySiderostat
    fsm: Fsm
    acquisition: Acquisition
    coarse: Coarse
    vernier: Vernier
    prefilter: Prefilter
    learn: Literal["off", "advise", "on"] = "advise"
    fastest_line_hz: Positive | None = None

    @property
    def flux_range_dn(self) -> tuple[float, float]:
        """The least and the most light that a spot of this loop's star may have."""
        return self.flux_range.low * self.star_flux_dn, self.flux_range.high * self.star_flux_dn

    @property
    def brightest_part(self) -> float:
        """Of a spot's light, in the pixel on whose middle it is."""
        return math.erf(math.sqrt(2) / self.spot_diameter_px) ** 2

    @model_validator(mode="after")
    def _feedforward_is_over_a_link(self) -> Loop:
        if self.feedforward is not None and self.link is None:
            msg = "feedforward needs link, the metrology loop whose siderostat it follows"
            raise ValueError(msg)
        return self

    @model_validator(mode="after")
    def _one_spot_is_the_star(self) -> Loop:
        low_dn, high_dn = self.flux_range_dn
        found = []
        for spot in self.other_spots:
            if low_dn <= spot.flux_dn <= high_dn:
                star_dn, low, high = self.star_flux_dn, self.flux_range.low, self.flux_range.high
                # With a range from 0, or nearly, no spot is too dim, and no star bright enough.
                dimmer = f"below {low_dn:g} or " if low_dn > 0 else ""
                has_brighter = low * _MOST_FLUX_DN > spot.flux_dn
                brighter = f" or above {spot.flux_dn / low:.5g}" if has_brighter else ""
                parts = (
                    Part("other_spots", spot.flux_dn, f"{dimmer}above {high_dn:g}"),
                    Part("star_flux_dn", star_dn, f"below {spot.flux_dn / high:.5g}{brighter}"),
                    above("flux_range.low", low, spot.flux_dn / star_dn),
                    below("flux_range.high", high, spot.flux_dn / star_dn),
                )
                found.append(
                    Conflict(f"by its light, the loop could accept {spot.name} as its star", parts)
                )
        if found:
            raise Conflicts(found)
        return self


class Supervisor(Settings):
    """Time limits and rates of the supervisor."""

    late_tick_s: Annotated[float, Field(gt=0, le=1)]
    stall_s: Annotated[float, Field(gt=0, le=1)]
    safe_disable_after_s: Annotated[float, Field(ge=0, le=3600)]
    telemetry_hz: Annotated[float, Field(ge=1, le=100)]


class Service(Settings):
    """Where the supervisor can be reached, by whom, and how often; an empty address is none."""

    folder: str
    lease_s: Annotated[float, Field(ge=10, le=3600)]
    commands_per_s: Annotated[float, Field(ge=5, le=1000)]
    tcp_address: str
    command_port: Annotated[int, Field(ge=1, le=65535)]
    telemetry_port: Annotated[int, Field(ge=1, le=65535)]
    keys_folder: str
    metrics_port: Port

    @field_validator("tcp_address")
    @classmethod
    def _address(cls, text: str) -> str:
        if text:
            try:
                ip_address(text)
            except ValueError:
                msg = 'must be an address of this machine, such as "10.0.0.5", or "0.0.0.0" for all, or empty'
                raise ValueError(msg) from None
        return text

    @model_validator(mode="after")
    def _two_ports(self) -> Service:
        if self.command_port == self.telemetry_port:
            parts = tuple(
                Part(key, self.command_port, "another port")
                for key in ("telemetry_port", "command_port")
            )
            raise Conflicts([Conflict("each listens on a port of its own", parts)])
        return self


class Logging(Settings):
    """The log: where, how much may be lost, when a new file begins, and how long files stay."""

    folder: str
    chunk_bytes: Annotated[int, Field(ge=4096, le=16_777_216)]
    flush_s: Annotated[float, Field(gt=0, le=60)]
    queue_records: Annotated[int, Field(ge=16, le=1_000_000)]
    compression: Literal["zstd", "lz4", "none"]
    rotate_bytes: Annotated[int, Field(ge=65_536)]
    rotate_s: Annotated[float, Field(ge=1, le=31_536_000)]
    retain_bytes: Count
    retain_days: Annotated[float, Field(gt=0, le=36_500)]

    @property
    def folder_path(self) -> Path:
        """The folder, with ``~`` expanded to the user's home directory.

        Raises
        ------
        ConfigError
            If there is no such user.
        """
        try:
            return Path(self.folder).expanduser()
        except RuntimeError as error:
            msg = f"logging.folder: {written(self.folder)}: {short(str(error))}; choose another"
            raise ConfigError(msg) from None

    @model_validator(mode="after")
    def _room_to_write(self) -> Logging:
        retain, rotate = self.retain_bytes, self.rotate_bytes
        if retain < 2 * rotate:
            parts = (
                at_least("retain_bytes", retain, 2 * rotate),
                at_most("rotate_bytes", rotate, retain // 2),
            )
            raise Conflicts([Conflict("no finished file would stay", parts)])
        if self.chunk_bytes > rotate:
            parts = (
                at_most("chunk_bytes", self.chunk_bytes, rotate),
                at_least("rotate_bytes", rotate, self.chunk_bytes),
            )
            raise Conflicts([Conflict("a file has at least one whole chunk", parts)])
        return self
