"""The rig file's devices as drivers see them: camera, siderostat, mirror."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import Field, model_validator

from fitctl.config.base import AxisPair, Count, Finite, NonNegative, Positive, Settings, TimeoutS

HALF_WINDOW_PX = 3  # of Eq. 7's 7x7 window, about its central pixel
AIN_RANGES_V = (10.0, 1.0, 0.1, 0.01)  # of a LabJack T7's inputs, either way from zero


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

    @property
    def endpoint(self) -> str:
        """Where it is, for people."""
        return f"{self.address}:{self.gvcp_port}"


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
    dark_file: str | None = None
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
    """An Aerotech Ensemble with two axes, spoken to in its ASCII commands.

    Attributes
    ----------
    software_limits_verified : bool
        Someone has driven both axes of this controller into both software limits, not homed, and they
        stopped: neither homing nor the fault masks are checked.
    """

    driver: Literal["ensemble"]
    port: str
    baud_rate: Count
    axes: Annotated[list[Annotated[int, Field(ge=0, le=9)]], Field(min_length=2, max_length=2)]
    response_timeout_s: TimeoutS
    software_limits_verified: bool

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
DEVICE_BY_TAG: dict[str, type[Settings]] = {
    "cia402": Cia402Device,
    "ensemble": EnsembleDevice,
    "bal_analog": BalAnalogDevice,
}
AmplifierDevice = TypeVar("AmplifierDevice", bound=Settings)


# Of a stage's axes about the line of sight, from the camera's, azimuth towards elevation.
RotationDeg = Annotated[float, Field(ge=-180, le=180)]


class Siderostat(Settings, Generic[AmplifierDevice]):
    """The coarse stage: geometry, limits, servo, amplifiers; generic in what its amplifiers are."""

    encoder_counts_per_rev: Count
    spur_gear_ratio: Positive
    ball_screw_m_per_rad: Positive
    lever_arm_m: Positive
    rotation_deg: RotationDeg
    travel_sky_arcsec: Positive
    velocity_limit_rad_s: Positive
    acceleration_limit_rad_s2: Positive
    servo: ServoSettings
    device: AmplifierDevice
    backlash_sky_arcsec: NonNegative | None = None

    @property
    def encoder_count_rad(self) -> float:
        """Motor angle of one encoder count."""
        return 2 * math.pi / self.encoder_counts_per_rev


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
    def step_v(self) -> float:
        """Voltage of one step of the converter."""
        return self.full_scale_v / (2**self.bits - 1)

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
    follow_tolerance_v: Positive


class LabJackT7Device(Settings):
    """A LabJack T7 that reads four photodiodes on its inputs AIN0 to AIN3, single-ended.

    Attributes
    ----------
    serial_number : int, optional
        Absent: any T7 that answers is the right one.
    inputs : list of int
        Which AIN reads which photodiode, in the order az+, az-, el+, el-.
    range_v : float
        Either way from zero; see `AIN_RANGES_V`.
    resolution_index : int
        A larger one gives less noise and takes longer; 0 is the device's default. From 9 on, a T7-Pro.
    settling_us : float
        Between choosing an input and converting it; 0 is the device's own choice.
    """

    driver: Literal["labjack_t7"]
    host: str
    port: Annotated[int, Field(ge=1, le=65535)]
    serial_number: Count | None = None
    inputs: Annotated[list[Annotated[int, Field(ge=0, le=3)]], Field(min_length=4, max_length=4)]
    range_v: Positive
    resolution_index: Annotated[int, Field(ge=0, le=12)]
    settling_us: Annotated[float, Field(ge=0, le=50_000)]
    response_timeout_s: TimeoutS

    @model_validator(mode="after")
    def _is_a_setting_of_a_t7(self) -> LabJackT7Device:
        if self.range_v not in AIN_RANGES_V:
            msg = f"range_v must be one of {', '.join(f'{one:g}' for one in AIN_RANGES_V)}"
            raise ValueError(msg)
        if len(set(self.inputs)) != len(self.inputs):
            msg = "inputs must name each of 0 to 3 once"
            raise ValueError(msg)
        return self

    @property
    def endpoint(self) -> str:
        """Where it is, for people."""
        return f"{self.host}:{self.port}"


Ends = Annotated[list[Finite], Field(min_length=2, max_length=2)]


class HexapodTravel(Settings):
    """How far a hexapod's axes may go: low and high end of each, zero between them."""

    x_mm: Ends
    y_mm: Ends
    z_mm: Ends
    u_deg: Ends
    v_deg: Ends
    w_deg: Ends

    @property
    def ends(self) -> list[tuple[float, float]]:
        """Low and high end of X, Y, Z, U, V and W."""
        each = (self.x_mm, self.y_mm, self.z_mm, self.u_deg, self.v_deg, self.w_deg)
        return [(low, high) for low, high in each]

    @model_validator(mode="after")
    def _includes_zero(self) -> HexapodTravel:
        for name, (low, high) in zip(type(self).model_fields, self.ends, strict=True):
            if not low < 0 < high:
                msg = f"{name} must be a negative end and a positive one, such as [-10.0, 10.0]"
                raise ValueError(msg)
        return self


class C887Device(Settings):
    """A PI C-887 controller with a hexapod, spoken to in GCS 2.0.

    Attributes
    ----------
    port : str
        A serial port, or ``socket://host:50000``.
    baud_rate : int
        Of a serial port.
    stage : str
        What the controller's answer to ``CST?`` must contain, such as ``M-850``; empty: anything.
    travel : HexapodTravel
        Where the rig may send the platform, within what the controller allows.
    velocity_limit_mm_s : float
        Of the platform.
    response_timeout_s, reference_timeout_s : float
        For one answer, and for a whole reference move.
    """

    driver: Literal["c887"]
    port: str
    baud_rate: Count
    stage: str
    travel: HexapodTravel
    velocity_limit_mm_s: Positive
    response_timeout_s: TimeoutS
    reference_timeout_s: Annotated[float, Field(gt=0, le=600)]

    @property
    def endpoint(self) -> str:
        """Where it is, for people."""
        return self.port


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
    rotation_deg: RotationDeg
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
