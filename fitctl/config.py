"""Rig files: TOML in, frozen and validated settings with units in their names out.

Every key is required, so that a rig file shows everything that fitctl will use. A wrong file ends in a
:class:`ConfigError` whose lines each name the file, the key and what is allowed.
"""

from __future__ import annotations

import difflib
import itertools
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

_MOST_HISTORY_STEPS = 10_000_000  # some hundred megabytes
_LARGEST_SERVO_STEP = 0.4  # part of an error that one servo period may take back, with its latency
HALF_WINDOW_PX = 3  # of Eq. 7's 7x7 window, about its central pixel
ARCSEC_PER_RAD = 180 * 3600 / math.pi
ControllerName = Literal["eq20", "lqg-ltr", "minimum-variance", "fslq"]
CONTROLLERS: tuple[ControllerName, ...] = get_args(ControllerName)


class ConfigError(Exception):
    """A rig file that cannot be used; ``str()`` gives one line for each thing that is wrong."""


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0, le=1)]
TimeoutS = Annotated[float, Field(gt=0, le=60)]
Port = Annotated[int, Field(ge=0, le=65535)]
Count = Annotated[int, Field(ge=1)]


class Settings(BaseModel):
    """A part of a rig file: frozen; unknown keys are errors, and so are numbers given as text."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class AxisPair(Settings):
    """One number for each axis."""

    az: Finite
    el: Finite


class Range(Settings):
    """A closed range."""

    low: NonNegative
    high: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Range:
        if self.low >= self.high:
            msg = "low must be below high"
            raise ValueError(msg)
        return self


class Optics(Settings):
    """Optics that all loops share."""

    compressor_ratio: Positive
    focal_length_m: Positive


class GigeDevice(Settings):
    """Where a GigE Vision camera answers."""

    driver: Literal["gige", "aravis"]
    address: str
    gvcp_port: Annotated[int, Field(ge=1, le=65535)]
    pixel_format: Literal["Mono8", "Mono12", "Mono16"]
    gain: NonNegative
    packet_size_bytes: Annotated[int, Field(ge=576, le=9000)]
    packet_delay_s: Annotated[float, Field(ge=0, le=0.01)]
    response_timeout_s: TimeoutS
    heartbeat_s: Annotated[float, Field(ge=0.5, le=60)]


class Camera(Settings):
    """The focal plane and the camera that reads it."""

    width_px: Annotated[int, Field(ge=16, le=4096)]  # below, the search's field would vanish
    height_px: Annotated[int, Field(ge=16, le=4096)]
    pixel_size_m: Annotated[float, Field(ge=1e-6, le=1e-3)]
    frame_rate_hz: Annotated[float, Field(ge=1, le=2000)]
    exposure_s: Positive
    frame_delay_s: NonNegative
    bias_dn: NonNegative
    pixel_noise_dn: Positive
    device: GigeDevice

    @property
    def period_s(self) -> float:
        """Time between frames."""
        return 1.0 / self.frame_rate_hz

    @property
    def largest_window_px(self) -> tuple[int, int]:
        """The last pixel, az and el, about which the window fits; the first is `HALF_WINDOW_PX`."""
        return self.width_px - 1 - HALF_WINDOW_PX, self.height_px - 1 - HALF_WINDOW_PX

    def window_fits(self, az_px: float, el_px: float) -> bool:
        """Whether the whole window about a place is on the frame."""
        az, el = self.largest_window_px
        return HALF_WINDOW_PX <= az_px <= az and HALF_WINDOW_PX <= el_px <= el

    @property
    def window_range_text(self) -> str:
        """Where the window fits, for people."""
        az, el = self.largest_window_px
        return (
            f"must lie in {HALF_WINDOW_PX}..{az} px az and {HALF_WINDOW_PX}..{el} px el, "
            "so that the 7x7 window fits on the frame"
        )

    @model_validator(mode="after")
    def _exposure_fits(self) -> Camera:
        if self.exposure_s > self.period_s:
            msg = f"exposure_s must not pass the frame period, {self.period_s:g} s"
            raise ValueError(msg)
        return self


class ServoSettings(Settings):
    """The siderostat's position servo."""

    rate_hz: Annotated[float, Field(ge=50, le=2000)]
    gain_per_s: Positive
    following_error_limit_rad: Positive
    reading_timeout_s: TimeoutS


class Cia402Device(Settings):
    """A two-axis CANopen CiA 402 drive."""

    driver: Literal["cia402"]
    interface: str
    channel: str
    bitrate: Literal[10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000, 1000000]
    node_id: Annotated[int, Field(ge=1, le=127)]
    response_timeout_s: TimeoutS
    drive_heartbeat_s: Annotated[float, Field(ge=0.01, le=10)]
    master_heartbeat_timeout_s: Annotated[float, Field(ge=0.02, le=10)]
    position_limit_rad: NonNegative

    @property
    def endpoint(self) -> str:
        """Where it is, for people."""
        return self.channel


class EnsembleDevice(Settings):
    """An Aerotech Ensemble with two axes, spoken to in its ASCII commands."""

    driver: Literal["ensemble"]
    port: str
    baud_rate: Count
    axes: Annotated[list[Annotated[int, Field(ge=0, le=9)]], Field(min_length=2, max_length=2)]
    response_timeout_s: TimeoutS

    @property
    def endpoint(self) -> str:
        """Where it is, for people."""
        return self.port


class BalAnalogDevice(Settings):
    """Two analogue velocity amplifiers behind Modbus/TCP I/O.

    Attributes
    ----------
    first_output_register : int
        Velocity commands of az and el, then a word with the enable lines: bit 0 az, bit 1 el.
    first_input_register : int
        Encoder counters of az and el, then a word with the fault lines, as the enable lines.
    full_scale_counts, full_scale_v : int, float
        Of the analogue outputs, both ways from zero.
    velocity_rad_s_per_v : AxisPair
        What the amplifiers are adjusted to; negative where a motor turns the other way.
    """

    driver: Literal["bal_analog"]
    host: str
    port: Annotated[int, Field(ge=1, le=65535)]
    device_id: Annotated[int, Field(ge=0, le=255)]
    first_output_register: Annotated[int, Field(ge=0, le=65533)]
    first_input_register: Annotated[int, Field(ge=0, le=65533)]
    full_scale_counts: Annotated[int, Field(ge=100, le=32767)]
    full_scale_v: Positive
    velocity_rad_s_per_v: AxisPair
    enabled_level: Literal["high", "low"]
    fault_level: Literal["high", "low"]
    response_timeout_s: TimeoutS

    @model_validator(mode="after")
    def _can_be_commanded(self) -> BalAnalogDevice:
        if 0 in {self.velocity_rad_s_per_v.az, self.velocity_rad_s_per_v.el}:
            msg = "velocity_rad_s_per_v must not be 0"
            raise ValueError(msg)
        return self

    @property
    def endpoint(self) -> str:
        """Where it is, for people."""
        return f"{self.host}:{self.port}"


SiderostatDevice = Annotated[
    Cia402Device | EnsembleDevice | BalAnalogDevice, Field(discriminator="driver")
]
_TAGGED: dict[str, type[Settings]] = {
    "cia402": Cia402Device,
    "ensemble": EnsembleDevice,
    "bal_analog": BalAnalogDevice,
}
AmplifierDevice = TypeVar("AmplifierDevice", bound=Settings)


class Siderostat(Settings, Generic[AmplifierDevice]):
    """The coarse stage: geometry, limits, servo, amplifiers; generic in what its amplifiers are."""

    encoder_counts_per_rev: Count
    spur_gear_ratio: Positive
    ball_screw_m_per_rad: Positive
    lever_arm_m: Positive
    travel_sky_arcsec: Positive
    velocity_limit_rad_s: Positive
    acceleration_limit_rad_s2: Positive
    servo: ServoSettings
    device: AmplifierDevice
    backlash_sky_arcsec: NonNegative | None = None


AnySiderostat = Siderostat[SiderostatDevice]


class ModbusDacDevice(Settings):
    """A Modbus D/A converter: consecutive holding registers, one a channel."""

    driver: Literal["modbus_dac"]
    transport: Literal["tcp", "rtu"]
    host: str
    port: Annotated[int, Field(ge=1, le=65535)]
    serial_port: str
    baud_rate: Annotated[int, Field(ge=1200, le=4_000_000)]
    serial_format: Literal["8E1", "8O1", "8N1", "8N2"]
    device_id: Annotated[int, Field(ge=0, le=255)]
    first_register: Annotated[int, Field(ge=0, le=65533)]
    full_scale_v: Positive
    bits: Annotated[int, Field(ge=8, le=16)]
    response_timeout_s: TimeoutS

    @model_validator(mode="after")
    def _can_be_reached(self) -> ModbusDacDevice:
        if self.transport == "rtu" and not self.serial_port:
            msg = "serial_port must name a port, such as /dev/ttyUSB0, where transport is rtu"
            raise ValueError(msg)
        if self.transport == "rtu" and not 1 <= self.device_id <= 247:
            msg = "device_id must be from 1 to 247 where transport is rtu: to 0, nobody answers"
            raise ValueError(msg)
        return self

    @property
    def endpoint(self) -> str:
        """Where it is, for people."""
        return self.serial_port if self.transport == "rtu" else f"{self.host}:{self.port}"


class Mdt693Device(Settings):
    """A Thorlabs MDT693A or MDT693B."""

    driver: Literal["mdt693"]
    port: str
    baud_rate: Count
    response_timeout_s: TimeoutS
    gain: Positive
    limit_v: Annotated[float, Field(gt=0, le=151)]
    poll_s: Annotated[float, Field(ge=0.2, le=60)]


class Structure(Settings):
    """Lightly damped modes of the mirror's mount."""

    mode_hz: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    damping: Annotated[float, Field(gt=0, lt=1)]
    cross_axis: NonNegative
    participation: Annotated[float, Field(ge=0, le=1)]


class StackHysteresis(Settings):
    """What is known of the three stacks' hysteresis: `fitctl identify hysteresis` measures it."""

    half_widths_v: Annotated[list[NonNegative], Field(min_length=2)]
    gains_m_per_v: Annotated[list[list[Finite]], Field(min_length=3, max_length=3)]

    @model_validator(mode="after")
    def _can_be_inverted(self) -> StackHysteresis:
        widths = self.half_widths_v
        if widths[0] != 0 or any(b <= a for a, b in itertools.pairwise(widths)):
            msg = "half_widths_v must start at 0 and ascend"
            raise ValueError(msg)
        for stack, gains in enumerate(self.gains_m_per_v, start=1):
            if len(gains) != len(widths):
                msg = f"gains_m_per_v: stack {stack} has {len(gains)}, half_widths_v {len(widths)}"
                raise ValueError(msg)
            if min(itertools.accumulate(gains)) <= 0:
                msg = f"gains_m_per_v: stack {stack} would move against its voltage; identify it again"
                raise ValueError(msg)
        return self


class Fsm(Settings):
    """The fast steering mirror, its D/A and its piezo amplifier."""

    stack_scale_m_per_v: Positive
    stack_radius_m: Positive
    beam_per_mirror: Positive
    bias_v: Positive
    range_rad: Positive
    slew_v_per_s: Positive
    dac: ModbusDacDevice
    piezo: Mdt693Device
    hysteresis: StackHysteresis | None = None
    structure: Structure | None = None

    @model_validator(mode="after")
    def _range_fits_the_dac(self) -> Fsm:
        swing_v = self.stack_radius_m * self.range_rad / self.stack_scale_m_per_v
        if self.bias_v - swing_v < 0 or self.bias_v + swing_v > self.dac.full_scale_v:
            msg = (
                f"range_rad needs {self.bias_v - swing_v:.3f} to {self.bias_v + swing_v:.3f} V, "
                f"and the D/A gives 0 to {self.dac.full_scale_v:g} V; lower range_rad"
            )
            raise ValueError(msg)
        return self


class Acquisition(Settings):
    """How the star is searched for, and when it counts as found or lost."""

    search_radius_sky_arcsec: Positive
    detection_sigma: Annotated[float, Field(ge=3, le=100)]
    found_frames: Count
    lost_frames: Count
    field_overlap: Annotated[float, Field(ge=0.05, le=0.6)]
    settle_s: NonNegative
    confirm_timeout_s: Positive


class Coarse(Settings):
    """The siderostat's integrator, and when it hands over to the mirror."""

    gain_rad_per_m: Positive
    reach_fraction: Fraction
    reach_frames: Count


class AirPathModel(Settings):
    """Eq. 8: gain / (b1 s^2 + b2 s + 1), px, driven by unit-intensity white noise."""

    gain_px: NonNegative
    b1_s2: Positive
    b2_s: Positive


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
        if name not in CONTROLLERS and not name.endswith(".json"):
            msg = f"must be one of {', '.join(CONTROLLERS)}, or a file *.json that `fitctl design` saved"
            raise ValueError(msg)
        return name


class Prefilter(Settings):
    """The filter on commanded beam angle."""

    time_constant_s: Positive


class Loop(Settings):
    """One stellar loop."""

    target_px: AxisPair
    star_flux_dn: Positive
    flux_range: Range
    requirement_px: Positive
    siderostat: AnySiderostat
    fsm: Fsm
    acquisition: Acquisition
    coarse: Coarse
    vernier: Vernier
    prefilter: Prefilter


class Supervisor(Settings):
    """Time limits and rates of the supervisor."""

    frame_timeout_s: TimeoutS
    late_tick_s: Positive
    stall_s: Positive
    safe_disable_after_s: NonNegative
    telemetry_hz: Annotated[float, Field(ge=1, le=100)]


class Service(Settings):
    """Where the supervisor's sockets live."""

    folder: str


class Logging(Settings):
    """The log: where, and how much may be lost."""

    folder: str
    chunk_bytes: Annotated[int, Field(ge=4096, le=16_777_216)]
    flush_s: Annotated[float, Field(gt=0, le=60)]
    queue_records: Annotated[int, Field(ge=16, le=1_000_000)]
    compression: Literal["zstd", "lz4", "none"]


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

    name: str
    offset_px: AxisPair
    flux_dn: Positive
    diameter_px: Positive


class LoopPlant(Settings):
    """What one loop's hardware truly is; nothing but mocks and simulation reads it."""

    star_offset_sky_arcsec_max: NonNegative
    backlash_sky_arcsec: NonNegative
    amplifier_bandwidth_hz: Positive
    hysteresis: Hysteresis
    structure: Structure
    air_path: AirPath
    spots: Annotated[list[Spot], Field(min_length=1)]


class PlantTruth(Settings):
    """The simulated hardware."""

    step_s: Annotated[float, Field(gt=0, le=1e-3)]
    frame_delay_s: NonNegative | None = (
        None  # where the truth is not what camera.frame_delay_s says
    )
    history_s: Annotated[float, Field(ge=1, le=3600)]
    loops: Annotated[dict[str, LoopPlant], Field(min_length=1)]

    @model_validator(mode="after")
    def _history_fits_in_memory(self) -> PlantTruth:
        if self.history_s / self.step_s > _MOST_HISTORY_STEPS:
            msg = f"history_s may be at most {_MOST_HISTORY_STEPS * self.step_s:g} at this step_s"
            raise ValueError(msg)
        return self


class DacMock(Settings):
    """Settings of the mock D/A."""

    watchdog_s: Positive
    watchdog_latches: bool
    safe_v: NonNegative
    unknown_unit: Literal["refuse", "ignore", "serve"]


class Mdt693Mock(Settings):
    """Settings of the mock piezo amplifier; from `prompt` on they are what firmware of the B differs in.

    Attributes
    ----------
    firmware : str
        What the device says of itself.
    knobs_v : list of float
        Front knobs: volts that they add to each output.
    readback_offset_v, readback_noise_v, readback_settling_s : float
        Of the measured voltages: reads this much too high; one standard deviation; time constant.
    baud_rate : int
        Of the device; a pty's client with another one is not understood.
    reply_s : float
        From a command's last byte to the first of its answer.
    prompt : str
        After an answer; the A and the compatibility mode have their own.
    vlimit_as : str
        How `vlimit?` tells the switch: in volts, or as its position.
    decimals : int
        Of the voltages that the B tells.
    xyzvoltage : bool
        It knows `xyzvoltage?` and `xyzvoltage=`.
    dacstep_max : int
        Largest step of the arrow keys.
    push_command : str
        What the command is called that says whether knobs must be pushed.
    """

    model: Literal["MDT693A", "MDT693B"]
    firmware: str
    echo: bool
    compatibility_mode: bool
    limit_switch_v: Literal[75, 100, 150]
    knobs_v: Annotated[list[NonNegative], Field(min_length=3, max_length=3)]
    readback_offset_v: Finite
    readback_noise_v: NonNegative
    readback_settling_s: NonNegative
    baud_rate: Count
    reply_s: NonNegative
    prompt: Literal[">", "> ", "*"]
    vlimit_as: Literal["volts", "position"]
    decimals: Annotated[Count, Field(le=2)]
    xyzvoltage: bool
    dacstep_max: Literal[1000, 5000]
    push_command: Literal["pushdisable", "disablepush"]


class GigeMock(Settings):
    """Settings of the mock camera."""

    description: Literal["xml", "zip"]
    resends: bool
    clock: bool


class EnsembleMock(Settings):
    """Settings of the mock Ensemble controller.

    Attributes
    ----------
    tcp_port : int
    axis_names : list of str
        Beside ``@0`` and ``@1``.
    counts_per_unit : float
        Encoder counts in one of the controller's own units.
    software_limit_units : float
        Each way from zero; 0 is none.
    position_error_units : float
        A larger one disables an axis.
    reply_s : float
        From a command to its answer.
    idle_timeout_s : float
        A connection over which nothing came for so long is closed.
    always_send_eos : bool
        Whether answers without a value end in a newline too.
    """

    tcp_port: Port
    axis_names: Annotated[
        list[Annotated[str, Field(pattern="^[A-Z]+$")]], Field(min_length=2, max_length=2)
    ]
    counts_per_unit: Positive
    software_limit_units: NonNegative
    position_error_units: Positive
    reply_s: NonNegative
    idle_timeout_s: Positive
    always_send_eos: bool


class BalAnalogMock(Settings):
    """Settings of the mock analogue amplifiers and of the I/O station before them.

    Attributes
    ----------
    modbus_port : int
    watchdog_s : float
        Without a write for so long, the outputs go to 0 V and the amplifiers are disabled.
    counters_at_start : list of int
        Where the encoder counters stand at power-up, az and el.
    """

    modbus_port: Port
    watchdog_s: Positive
    counters_at_start: Annotated[
        list[Annotated[int, Field(ge=0, le=65535)]], Field(min_length=2, max_length=2)
    ]


class LoopMocks(Settings):
    """Where the mock devices of one loop listen, and how they are."""

    slcan_port: Port
    modbus_port: Port
    mdt693_port: Port
    drive_command_timeout_s: Positive
    ensemble: EnsembleMock | None = None  # where siderostat.device is one
    bal_analog: BalAnalogMock | None = None  # likewise
    dac: DacMock
    mdt693: Mdt693Mock


class Fault(Settings):
    """Something that goes wrong with a mock device.

    Attributes
    ----------
    at_s : float
        When it begins, from the start of the mocks.
    device : str
        ``camera``, or a loop's device such as ``right.mdt693``.
    kind : str
        What goes wrong; `fitctl fault kinds` shows what can.
    part : str
        Of the device, where the kind has parts; empty is all of it.
    value : float, optional
        In the kind's unit; absent is the kind's own.
    for_s : float, optional
        How long it lasts; absent is until it is cleared.
    probability : float
        That it hits a message, or whatever the kind acts on, each time.
    """

    at_s: NonNegative = 0.0
    device: str
    kind: str
    part: str = ""
    value: Finite | None = None
    for_s: Positive | None = None
    probability: Fraction = 1.0


class Mocks(Settings):
    """Where the mock devices listen, always on 127.0.0.1; port 0 means any free one."""

    gvcp_port: Port
    bench_port: Port
    camera: GigeMock
    loops: Annotated[dict[str, LoopMocks], Field(min_length=1)]
    faults: list[Fault] = []


class Rig(Settings):
    """A whole rig file. ``plant`` and ``mocks`` are for mock rigs; a rig of real hardware leaves them out."""

    schema_version: Literal[1]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,40}$")]
    description: str
    optics: Optics
    camera: Camera
    loops: Annotated[dict[str, Loop], Field(min_length=1)]
    supervisor: Supervisor
    service: Service
    logging: Logging
    plant: PlantTruth | None = None
    mocks: Mocks | None = None

    @model_validator(mode="after")
    def _names_agree(self) -> Rig:
        for name, loop in self.loops.items():
            if not self.camera.window_fits(loop.target_px.az, loop.target_px.el):
                msg = f"loops.{name}.target_px {self.camera.window_range_text}"
                raise ValueError(msg)
            servo = loop.siderostat.servo
            if servo.gain_per_s / servo.rate_hz > _LARGEST_SERVO_STEP:
                msg = (
                    f"loops.{name}.siderostat.servo: gain_per_s may be at most "
                    f"{_LARGEST_SERVO_STEP * servo.rate_hz:g} at {servo.rate_hz:g} Hz, "
                    "or the servo would swing"
                )
                raise ValueError(msg)
        oldest_s = self.camera.frame_delay_s + 2 * self.camera.period_s
        if self.supervisor.frame_timeout_s <= oldest_s:
            msg = (
                f"supervisor.frame_timeout_s must be above {oldest_s:g} s, "
                "the camera's delay and two frames"
            )
            raise ValueError(msg)
        for section, part in (("plant", self.plant), ("mocks", self.mocks)):
            if part is not None and set(part.loops) != set(self.loops):
                msg = f"{section}.loops must name the same loops as loops: {', '.join(self.loops)}"
                raise ValueError(msg)
        for name, mocks in (self.mocks.loops if self.mocks else {}).items():
            driver = self.loops[name].siderostat.device.driver
            if driver in {"ensemble", "bal_analog"} and getattr(mocks, driver) is None:
                msg = (
                    f"mocks.loops.{name}.{driver} is missing: siderostat.device.driver is {driver}"
                )
                raise ValueError(msg)
        return self

    @property
    def true_camera(self) -> Camera:
        """The camera as mocks and simulation have it: delayed as the plant says."""
        true_s = None if self.plant is None else self.plant.frame_delay_s
        if true_s is None:
            return self.camera
        return self.camera.model_copy(update={"frame_delay_s": true_s})

    def mock_parts(self) -> tuple[PlantTruth, Mocks]:
        """The sections that only mocks and simulation need.

        Raises
        ------
        ConfigError
            If this rig file describes hardware only.
        """
        if self.plant is None or self.mocks is None:
            msg = (
                f"rig {self.name}: sections plant and mocks are missing, so it can be neither mocked "
                "nor simulated; copy them from rigs/fit-mock.toml"
            )
            raise ConfigError(msg)
        return self.plant, self.mocks


def default_rig_path() -> Path:
    """The shipped default rig: beside the package in a checkout, inside it once installed."""
    package = Path(__file__).parent
    installed = package / "rigs" / "fit-mock.toml"
    return installed if installed.exists() else package.parent / "rigs" / "fit-mock.toml"


def load_rig(path: Path, overrides: Sequence[str] = ()) -> Rig:
    """Read and validate a rig file.

    It is laid over the rig file that its ``base`` names, if it names one; then the fragments of its
    ``include`` list are laid over it, in order.

    Parameters
    ----------
    path : Path
        The TOML file.
    overrides : sequence of str
        ``key.path=value`` texts that replace values of the file; the value is read as TOML, or as
        plain text where it is not TOML.

    Raises
    ------
    ConfigError
        One line for each thing that is wrong: file, key, what is allowed.
    """
    document = _read_toml(path, "copy rigs/fit-mock.toml or name another with --rig")
    base = document.pop("base", None)
    if base is not None:
        if not isinstance(base, str):
            msg = f"{path}: base: must be a file name (is {base!r})"
            raise ConfigError(msg)
        under = _read_toml(path.parent / base, f"it is the base of {path}")
        lay_over(under, document)
        document = under
    fragments = document.pop("include", [])
    if not isinstance(fragments, list) or not all(isinstance(name, str) for name in fragments):
        msg = f"{path}: include: must be a list of file names (is {fragments!r})"
        raise ConfigError(msg)
    said_in = dict.fromkeys(_problems(document), str(path))
    for name in fragments:
        fragment = path.parent / name
        lay_over(document, _read_toml(fragment, f"it is in the include list of {path}"))
        # What is wrong from here on, and was not before, is this fragment's.
        said_in = {what: said_in.get(what, str(fragment)) for what in _problems(document)}
    for override in overrides:
        _override(document, override)
    return rig_from_document(document, str(path), said_in)


def _problems(document: Mapping[str, Any]) -> list[tuple[tuple[int | str, ...], str]]:
    """What is wrong with a document: where, and what kind of error."""
    try:
        Rig.model_validate(document)
    except ValidationError as error:
        return [(problem["loc"], problem["type"]) for problem in error.errors()]
    return []


def _read_toml(path: Path, hint: str) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        msg = f"{path}: no such rig file; {hint}"
        raise ConfigError(msg) from None
    except (OSError, UnicodeDecodeError) as error:
        msg = f"{path}: cannot be read: {error}"
        raise ConfigError(msg) from None
    except tomllib.TOMLDecodeError as error:
        msg = f"{path}: not TOML: {error}"
        raise ConfigError(msg) from None


def lay_over(document: dict[str, Any], fragment: Mapping[str, Any]) -> None:
    """Lay a fragment over a document, table by table: what the fragment says holds.

    A table that names another driver is another device: nothing of what it lies on is left.
    """
    for key, value in fragment.items():
        under = document.get(key)
        if isinstance(value, dict) and isinstance(under, dict) and _same_device(value, under):
            lay_over(under, value)
        else:
            document[key] = value


def _same_device(table: dict[str, Any], under: dict[str, Any]) -> bool:
    return "driver" not in table or table["driver"] == under.get("driver")


def rig_from_document(
    document: Mapping[str, Any],
    origin: str,
    said_in: Mapping[tuple[tuple[int | str, ...], str], str] | None = None,
) -> Rig:
    """Validate a rig that is already a dictionary.

    `origin` is what errors call it, but for those that `said_in` knows, by place and kind, from elsewhere.
    """
    known = said_in or {}
    try:
        return Rig.model_validate(document)
    except ValidationError as error:
        lines = [
            _explain(known.get((problem["loc"], problem["type"]), origin), problem)
            for problem in error.errors()
        ]
        raise ConfigError("\n".join(lines)) from None


def _override(document: dict[str, Any], text: str) -> None:
    key, equals, value_text = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        msg = f"--set {text}: expected key.path=value, for example camera.frame_rate_hz=50.0"
        raise ConfigError(msg)
    try:
        value = tomllib.loads(f"value = {value_text}")["value"]
    except tomllib.TOMLDecodeError:
        value = value_text
    table: Any = document
    for depth, part in enumerate(parts[:-1]):
        table = table.setdefault(part, {}) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            msg = f"--set {text}: {'.'.join(parts[: depth + 1])} is not a table"
            raise ConfigError(msg)
    table[parts[-1]] = value


def _explain(origin: str, problem: Any) -> str:
    location = _without_tags([str(part) for part in problem["loc"]])
    if problem["type"] in {"union_tag_not_found", "union_tag_invalid"}:
        location.append("driver")
    key = ".".join(location)
    if problem["type"] == "union_tag_invalid":
        context = problem["ctx"]
        allowed_tags = context["expected_tags"]
        return f"{origin}: {key}: must be one of {allowed_tags} (is {context['tag']!r})"
    if problem["type"] == "extra_forbidden":
        allowed = _allowed_keys([str(part) for part in problem["loc"][:-1]])
        near = difflib.get_close_matches(location[-1], allowed, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        return f"{origin}: {key}: unknown key{hint} (allowed here: {', '.join(allowed)})"
    if problem["type"] in {"missing", "union_tag_not_found"}:
        return f"{origin}: {key}: is missing; rigs/fit-mock.toml shows every key with its unit"
    message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    given = problem.get("input")
    shown = f" (is {given!r})" if isinstance(given, str | int | float | list) else ""
    # What concerns the whole file names its key itself.
    where = f"{origin}: {key}" if key else origin
    return f"{where}: {message}{shown}"


def _without_tags(location: Sequence[str]) -> list[str]:
    """A place in the rig file without what pydantic adds: which kind of `device` it took it for."""
    pairs = zip(["", *location], location, strict=False)
    return [part for before, part in pairs if not (before == "device" and part in _TAGGED)]


def _allowed_keys(location: Sequence[str]) -> list[str]:
    """The keys that the rig file may have at `location`, by walking the settings' own fields."""
    annotation: Any = Rig
    for part in location:
        if part in _TAGGED:
            annotation = _TAGGED[part]
        elif isinstance(annotation, type) and issubclass(annotation, Settings):
            annotation = annotation.model_fields[part].annotation
        elif get_origin(annotation) in {dict, list}:
            annotation = get_args(annotation)[-1]
        annotation = _without_none(annotation)
    is_settings = isinstance(annotation, type) and issubclass(annotation, Settings)
    return sorted(annotation.model_fields) if is_settings else []


def _without_none(annotation: Any) -> Any:
    """``X`` of ``X | None`` and of ``Annotated[X, ...]``."""
    if get_origin(annotation) is Annotated:
        return get_args(annotation)[0]
    options = [option for option in get_args(annotation) if option is not type(None)]
    return options[0] if type(None) in get_args(annotation) else annotation
