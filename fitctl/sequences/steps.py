"""What a step is made of: frozen data, the same in a sequence file and in Python."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fitctl.config import Motion
from fitctl.config.base import Count, Finite, NonNegative, Positive, Settings
from fitctl.config.loops import ControllerName, FieldOverlap

LONGEST_S = 86_400.0
RENAMED_STEPS = {"target": "offset", "jog": "dither"}
RENAMED_KEYS = {"jog_px": "dither_px"}
RENAMED_VALUES = {("on_failure", "stop"): "fail"}
"""Names of an older fitctl, which are refused with the name of today."""

LoopName = Annotated[
    str,
    Field(
        description="name of the loop; optional if the rig has only one, or if the step is for all or none"
    ),
]
TimeoutS = Annotated[
    float,
    Field(gt=0, le=LONGEST_S, description="longest wait beyond the step's own duration"),
]
Attempts = Annotated[int, Field(ge=1, le=20, description="number of attempts in all")]
SearchRadius = Annotated[
    Positive | None, Field(description="radius of the first attempt; default: the rig file's")
]
RadiusGrowth = Annotated[
    float, Field(ge=1, le=10, description="factor of the radius from one attempt to the next")
]
LargestOffset = Annotated[
    Positive | None,
    Field(description="limit of all searches; without it, the radius does not grow"),
]
SettleS = Annotated[NonNegative, Field(le=600, description="time before the measurement starts")]
DurationS = Annotated[float, Field(gt=0, le=LONGEST_S)]
DwellS = Annotated[DurationS, Field(description="at each place")]
SteadyAfterS = Annotated[
    NonNegative, Field(description="time within a dwell before the RMS is measured")
]
OffsetPx = Annotated[Finite, Field(description="from the rig file's target_px, on the focal plane")]
RmsLimitPx = Annotated[
    Positive | None,
    Field(description="largest RMS of an axis; default: the rig file's requirement_px"),
]
ExpectedSkyArcsec = Annotated[
    Finite | None,
    Field(
        description="position of the star, from the zero of the encoders; default: on the target, or its last "
        "position"
    ),
]
StarFluxDn = Annotated[
    Positive | None,
    Field(
        description="brightness: a star that is not within `flux_range` of it is rejected; default: the rig "
        "file's"
    ),
]

RateSkyArcsecS = Annotated[
    Finite | None,
    Field(
        description="rate of the star with the stages at rest, along the siderostat's axes; the siderostat "
        "follows it; default: the rig file's"
    ),
]


class Step(Settings):
    """The common part of all steps."""

    step: str
    loop: LoopName = ""
    timeout_s: TimeoutS = 30.0
    attempts: Attempts = 1


class Standby(Step):
    """Power up the devices and release the star: STANDBY. Without a loop, all loops."""

    step: Literal["standby"] = "standby"
    timeout_s: TimeoutS = 60.0
    attempts: Attempts = 2


class Acquire(Step):
    """Power up the devices, search for the star, pull it in and hold it. A loop that holds a star keeps it.

    With an expected position, a flux or a rate, the loop stops tracking its star first. A metrology loop
    acquires its beam. Without a loop, all loops acquire; the step waits first for those that hold a link.
    """

    step: Literal["acquire"] = "acquire"
    search_radius_sky_arcsec: SearchRadius = None
    radius_growth: RadiusGrowth = 1.5
    max_offset_sky_arcsec: LargestOffset = None
    field_overlap: Annotated[
        FieldOverlap | None,
        Field(
            description="overlap of the field between turns of the spiral: more makes the search finer and "
            "slower; default: the rig file's"
        ),
    ] = None
    expected_az_sky_arcsec: ExpectedSkyArcsec = None
    expected_el_sky_arcsec: ExpectedSkyArcsec = None
    star_flux_dn: StarFluxDn = None
    rate_az_sky_arcsec_s: RateSkyArcsecS = None
    rate_el_sky_arcsec_s: RateSkyArcsecS = None
    timeout_s: TimeoutS = 120.0
    attempts: Attempts = 2


class Hold(Step):
    """Hold the star or the beam for a time and compare the RMS of each axis with the requirement."""

    step: Literal["hold"] = "hold"
    duration_s: Annotated[DurationS, Field(description="duration of the RMS measurement")]
    settle_s: SettleS = 10.0
    rms_limit_px: RmsLimitPx = None
    timeout_s: TimeoutS = 60.0


class Star(Settings):
    """A star of a list: where it is expected, from where the encoders read zero, how bright, and how fast.

    One with a rate is at its place when the step begins, once the devices are on.
    """

    name: Annotated[str, Field(min_length=1, max_length=60)]
    az_sky_arcsec: Finite
    el_sky_arcsec: Finite
    duration_s: DurationS | None = None
    star_flux_dn: Positive | None = None
    rate_az_sky_arcsec_s: Finite | None = None
    rate_el_sky_arcsec_s: Finite | None = None


class Stars(Step):
    """Acquire a list of stars one after the other, each at its position, and hold each as `hold` does."""

    step: Literal["stars"] = "stars"
    stars: Annotated[
        list[Star] | None,
        Field(
            min_length=1,
            max_length=1000,
            description="each with `name`, `az_sky_arcsec`, `el_sky_arcsec` and optionally `duration_s`, "
            "`star_flux_dn`, `rate_az_sky_arcsec_s` and `rate_el_sky_arcsec_s`",
        ),
    ] = None
    file: Annotated[
        str,
        Field(description="TOML, YAML or CSV file with the stars, beside the sequence's own file"),
    ] = ""
    duration_s: Annotated[
        DurationS, Field(description="duration of the RMS measurement of each star")
    ] = 30.0
    settle_s: SettleS = 10.0
    rms_limit_px: RmsLimitPx = None
    search_radius_sky_arcsec: SearchRadius = None
    radius_growth: RadiusGrowth = 1.5
    max_offset_sky_arcsec: LargestOffset = None
    on_failure: Annotated[
        Literal["skip", "fail"],
        Field(description="what to do after a star that is not found or not held well"),
    ] = "skip"
    least_held: Annotated[Count, Field(description="the step fails if fewer stars were held")] = 1
    timeout_s: TimeoutS = 120.0


class Moving(Step):
    """The common part of steps that move the star on the focal plane."""

    timeout_s: TimeoutS = 60.0
    max_offset_px: Annotated[
        Positive, Field(description="a step that goes farther than this is refused")
    ] = 5.0
    max_offset_sky_arcsec: Annotated[
        Positive | None, Field(description="the same limit on the sky")
    ] = None


class Visiting(Moving):
    """The common part of steps that lead the star to one place after another."""

    dwell_s: DwellS = 20.0
    steady_after_s: SteadyAfterS = 10.0
    rms_limit_px: RmsLimitPx = None


class Offset(Visiting):
    """Move the target by an offset in one step (Fig. 11); the star stays there."""

    step: Literal["offset"] = "offset"
    offset_az_px: OffsetPx
    offset_el_px: OffsetPx


class Dither(Visiting):
    """Move the target on both axes to one side, to the other side, and back (Fig. 12)."""

    step: Literal["dither"] = "dither"
    dither_px: Annotated[Positive, Field(description="on each axis, to either side")] = 1.0


class Raster(Visiting):
    """Move the target through the places of a grid, row by row, to and fro, and back."""

    step: Literal["raster"] = "raster"
    columns: Annotated[Count, Field(le=21, description="in azimuth")] = 3
    rows: Annotated[Count, Field(le=21, description="in elevation")] = 3
    spacing_px: Annotated[Positive, Field(description="between neighbours")] = 1.0
    dwell_s: DwellS = 12.0
    steady_after_s: SteadyAfterS = 8.0


class Controller(Step):
    """Switch to another design. With `learnt`, wait for the learner's, and switch if it would leave less."""

    step: Literal["controller"] = "controller"
    name: Annotated[
        Literal[ControllerName, "learnt"], Field(description="as in `fitctl send controller`")
    ]
    timeout_s: TimeoutS = 60.0


class Experiment(Moving):
    """Make the motions of an identification, open loop; the log is for `fitctl identify WHAT --log`."""

    step: Literal["experiment"] = "experiment"
    what: Annotated[
        Literal["backlash", "delay", "hysteresis", "airpath", "spot"],
        Field(description="as in `fitctl identify`"),
    ]


class Chirp(Moving):
    """Move one axis of one stage in a sine of rising or falling frequency, open loop."""

    step: Literal["chirp"] = "chirp"
    channel: Annotated[
        Literal["fsm_az", "fsm_el", "siderostat_az", "siderostat_el"],
        Field(description="stage and axis"),
    ]
    amplitude_px: Annotated[Positive, Field(description="of the star on the focal plane")] = 1.0
    from_hz: Annotated[Positive, Field(description="at the beginning")] = 0.2
    to_hz: Annotated[Positive, Field(description="at the end")] = 5.0
    duration_s: Annotated[DurationS, Field(le=600, description="of the sweep")] = 30.0


class PlateScale(Moving):
    """Drive both stages along both axes, open loop, and solve how each moves the star."""

    step: Literal["plate_scale"] = "plate_scale"
    amplitude_px: Annotated[Positive, Field(description="of each stage's swing")] = 3.0
    duration_s: Annotated[DurationS, Field(le=120, description="of each of the four swings")] = 20.0
    max_error: Annotated[
        Positive,
        Field(le=0.5, description="largest standard deviation of a scale that is accepted"),
    ] = 0.02
    max_residual_px: Annotated[
        Positive, Field(description="largest accepted RMS of the rest of the fit")
    ] = 0.5
    max_rotation_deg: Annotated[
        Positive,
        Field(
            le=180, description="a stage turned farther than this from the rig file's is refused"
        ),
    ] = 45.0


class Dark(Step):
    """Measure bias and noise of the camera from frames without a star: close the shutter first."""

    step: Literal["dark"] = "dark"
    frames: Annotated[int, Field(ge=10, le=2000, description="number of frames")] = 100
    max_bright_pixels: Annotated[
        int,
        Field(
            ge=0,
            description="the step fails with more pixels that are 5 times the noise above the bias",
        ),
    ] = 5


class Wait(Step):
    """Wait for a time."""

    step: Literal["wait"] = "wait"
    duration_s: Annotated[DurationS, Field(description="how long")]


class Collector(Step):
    """Reference the hexapod, or start or stop a motion of the collector.

    A motion continues during the next steps. The sequence stops it at its end, also after a failure.
    """

    step: Literal["collector"] = "collector"
    action: Annotated[
        Literal["reference", "start", "stop"], Field(description="as in `fitctl send collector`")
    ]
    kind: Annotated[
        Motion | None,
        Field(description="kind of the motion; the rig file provides the values that you omit"),
    ] = None
    direction_deg: Annotated[
        Finite | None, Field(description="from the link's azimuth towards elevation")
    ] = None
    range_mm: Annotated[
        Positive | None, Field(description="drift and random motion turn back this far out")
    ] = None
    velocity_mm_s: Annotated[Positive | None, Field(description="of a drift")] = None
    amplitude_mm: Annotated[Positive | None, Field(description="of a sine")] = None
    frequency_hz: Annotated[Positive | None, Field(description="of a sine")] = None
    rms_mm_s: Annotated[Positive | None, Field(description="of a random velocity")] = None
    correlation_s: Annotated[Positive | None, Field(description="of a random velocity")] = None

    @property
    def motion(self) -> dict[str, object]:
        """What is given of the motion."""
        common = {"action", *Step.model_fields}
        return {k: v for k, v in self.model_dump().items() if k not in common and v is not None}


class Visibility(Step):
    """Measure the tilt between the two stars of `[fringes]`, and the resulting visibility, for a time."""

    step: Literal["visibility"] = "visibility"
    duration_s: Annotated[DurationS, Field(description="duration of the measurement")]
    settle_s: SettleS = 10.0
    least_visibility: Annotated[
        Positive | None, Field(le=1, description="the step fails if the mean is smaller")
    ] = None


class CollectorScan(Step):
    """Move the collector to and fro along both axes of the link; the log is for `fitctl identify feedforward`.

    The loop holds its star over the link meanwhile. The collector ends where it began.
    """

    step: Literal["collector_scan"] = "collector_scan"
    amplitude_mm: Annotated[Positive, Field(description="to either side")] = 3.0
    frequency_hz: Annotated[Positive, Field(description="of the sine")] = 0.15
    cycles: Annotated[Count, Field(le=100, description="along each axis")] = 6


class BeamScan(Step):
    """Move the beam over the photodiodes; its log is for `fitctl identify photodiodes` and `link_delay`.

    The loop stops holding the beam and moves it to and fro along each axis, fast and then slowly. It ends in
    STANDBY.
    """

    step: Literal["beam_scan"] = "beam_scan"
    span_sky_arcsec: Annotated[
        Positive, Field(description="to either side of where it is held")
    ] = 400.0
    fast_sky_arcsec_s: Annotated[Positive, Field(description="faster sweeps")] = 240.0
    slow_sky_arcsec_s: Annotated[Positive, Field(description="slower sweeps")] = 80.0
    cycles: Annotated[Count, Field(le=20, description="at each speed along each axis")] = 2


class Ambient(Step):
    """Sample the photodiodes without the beam, for `fitctl identify ambient`: block the laser first."""

    step: Literal["ambient"] = "ambient"
    duration_s: Annotated[DurationS, Field(le=600, description="for how long")] = 20.0


class Overlap(Moving):
    """Move the target so that the fringe spots of both stars of `[fringes]` lie on each other; stay there.

    The target steps aside, to both sides of where it is, so that the camera separates the two fringe spots.
    Each is measured from its own star. The target then moves by what was found, and the step measures again.
    """

    step: Literal["overlap"] = "overlap"
    max_offset_px: Annotated[
        Positive, Field(description="a step that goes farther than this is refused")
    ] = 10.0
    separation_px: Annotated[
        Positive, Field(ge=7, description="how far the target steps to either side")
    ] = 7.0
    dwell_s: Annotated[DurationS, Field(description="at each of five places")] = 20.0
    steady_after_s: Annotated[
        NonNegative, Field(description="time within a dwell before its frames are used")
    ] = 5.0
    max_error_px: Annotated[
        Positive, Field(description="largest standard deviation of an offset that is accepted")
    ] = 0.1


class Off(Step):
    """Move the mirror to its bias, disable amplifiers, close devices: OFF. Without a loop, all loops."""

    step: Literal["off"] = "off"


AnyStep = (
    Standby
    | Acquire
    | Hold
    | Stars
    | Offset
    | Dither
    | Raster
    | Controller
    | Experiment
    | Chirp
    | PlateScale
    | Dark
    | Wait
    | Collector
    | Visibility
    | CollectorScan
    | BeamScan
    | Ambient
    | Overlap
    | Off
)


class Sequence(Settings):
    """A sequence file."""

    schema_version: Literal[1]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,40}$")]
    description: Annotated[str, Field(min_length=1, max_length=300)]
    steps: Annotated[
        list[Annotated[AnyStep, Field(discriminator="step")]], Field(min_length=1, max_length=500)
    ]

    @property
    def uses_what_is_learnt(self) -> bool:
        """A step switches to a learnt design."""
        return any(isinstance(step, Controller) and step.name == "learnt" for step in self.steps)
