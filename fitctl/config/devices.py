"""The rig file's devices as drivers see them: camera, siderostat, mirror."""

from __future__ import annotations

import itertools
import math
import re
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import Field, field_validator, model_validator

from fitctl.config.addresses import (
    BaudRate,
    CanInterface,
    Host,
    Ipv4,
    SerialPort,
    is_host,
    is_serial_port,
)
from fitctl.config.base import (
    ARCSEC_PER_RAD,
    AxisGains,
    AxisPair,
    Count,
    DelayS,
    Finite,
    NonNegative,
    OffsetSkyArcsec,
    Positive,
    Settings,
    TimeoutS,
)
from fitctl.config.conflict import Conflict, Conflicts, Part, at_least, at_most
from fitctl.config.wiring import AmplifierWiring, Channels

HALF_WINDOW_PX = 3  # of Eq. 7's 7x7 window, about its central pixel
WINDOW_PX = 2 * HALF_WINDOW_PX + 1  # its side; a tick names its central pixel
FULL_SCALE_DN = {"Mono8": 255, "Mono12": 4095, "Mono16": 65535}
AIN_RANGES_V = (10.0, 1.0, 0.1, 0.01)  # of a LabJack T7's inputs, either way from zero
PIEZO_LIMITS_V = (75.5, 100.5, 150.5)  # that an MDT693's limit switch reads at 75, 100 and 150 V
LIMIT_TOLERANCE_V = 1.0  # within which the driver compares limits
_LEAST_LIMIT_RAD = 1e-3
_NETWORK_INTERFACE = re.compile(r"[^\s/:]{1,15}")
_SLCAN_CHANNEL = "the adapter's serial port, such as /dev/ttyACM0, or socket://host:port"
_SOCKETCAN_CHANNEL = "a network interface, such as can0"
_OTHER_CHANNELS = "docs/devices/cia402.md lists interfaces and their channels"


class Optics(Settings):
    """Optics that all loops share."""

    compressor_ratio: Annotated[float, Field(ge=0.1, le=100)]
    focal_length_m: Annotated[float, Field(ge=0.01, le=100)]


class GigeDevice(Settings):
    """Where a GigE Vision camera answers."""

    driver: Literal["gige", "aravis"]
    address: Ipv4
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


# Of a pixel that counts to at most 65535.
PixelNoiseDn = Annotated[float, Field(gt=0, le=65_535)]


class Camera(Settings):
    """The focal plane and the camera that reads it.

    ``electrons_per_dn`` gives the noise of the star's own light; without it, light has none.
    """

    width_px: Annotated[int, Field(ge=16, le=4096)]  # below, the search's field would vanish
    height_px: Annotated[int, Field(ge=16, le=4096)]
    pixel_size_m: Annotated[float, Field(ge=1e-6, le=1e-4)]
    frame_rate_hz: Annotated[float, Field(ge=1, le=2000)]
    exposure_s: Positive
    frame_delay_s: DelayS
    bias_dn: NonNegative
    pixel_noise_dn: PixelNoiseDn
    electrons_per_dn: Positive | None = None
    dark_file: str | None = None
    device: GigeDevice

    @property
    def period_s(self) -> float:
        """Time between frames."""
        return 1.0 / self.frame_rate_hz

    @property
    def full_scale_dn(self) -> int:
        """To so many a pixel counts; one that reads this has more light than it can say."""
        return FULL_SCALE_DN[self.device.pixel_format]

    @property
    def largest_window_px(self) -> tuple[int, int]:
        """The last pixel, az and el, about which the window fits; the first is `HALF_WINDOW_PX`."""
        return self.width_px - 1 - HALF_WINDOW_PX, self.height_px - 1 - HALF_WINDOW_PX

    def window_fits(self, az_px: float, el_px: float) -> bool:
        """Whether the whole window about a place is on the frame."""
        az, el = self.largest_window_px
        return HALF_WINDOW_PX <= az_px <= az and HALF_WINDOW_PX <= el_px <= el

    def no_window_text(self, az_px: float, el_px: float) -> str:
        """Where the window fits, for people who want it about another place."""
        az, el = self.largest_window_px
        return (
            f"must lie in {HALF_WINDOW_PX}..{az} px az and {HALF_WINDOW_PX}..{el} px el, "
            f"so that the 7x7 window fits on the frame (is {az_px:g}, {el_px:g})"
        )

    @model_validator(mode="after")
    def _exposure_fits(self) -> Camera:
        if self.exposure_s > self.period_s:
            parts = (
                at_most("exposure_s", self.exposure_s, self.period_s),
                at_most("frame_rate_hz", self.frame_rate_hz, 1 / self.exposure_s),
            )
            raise Conflicts([Conflict("an exposure ends within its frame period", parts)])
        return self


# Full scale of an analogue output: 10 V, and what stations that go a little beyond have.
OutputV = Annotated[float, Field(ge=1e-3, le=12)]


class ServoSettings(Settings):
    """The siderostat's position servo."""

    rate_hz: Annotated[float, Field(ge=50, le=2000)]
    gain_per_s: Annotated[float, Field(ge=1e-3, le=1e4)]
    following_error_limit_rad: Positive
    reading_timeout_s: TimeoutS


class Cia402Device(Settings):
    """A two-axis CANopen CiA 402 drive."""

    driver: Literal["cia402"]
    interface: CanInterface
    channel: str
    bitrate: Literal[10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000, 1000000]
    node_id: Annotated[int, Field(ge=1, le=127)]
    response_timeout_s: TimeoutS
    drive_heartbeat_s: Annotated[float, Field(ge=0.01, le=10)]
    master_heartbeat_timeout_s: Annotated[float, Field(ge=0.02, le=10)]
    position_limit_rad: NonNegative

    @field_validator("position_limit_rad")
    @classmethod
    def _is_none_or_a_real_one(cls, rad: float) -> float:
        if 0 < rad < _LEAST_LIMIT_RAD:
            msg = f"must be 0, which is no limit, or at least {_LEAST_LIMIT_RAD:g}"
            raise ValueError(msg)
        return rad

    @model_validator(mode="after")
    def _channel_is_of_the_interface(self) -> Cia402Device:
        if self.interface == "slcan":
            problem = None if is_serial_port(self.channel.split("@")[0]) else _SLCAN_CHANNEL
        elif self.interface == "socketcan":
            problem = None if _NETWORK_INTERFACE.fullmatch(self.channel) else _SOCKETCAN_CHANNEL
        else:
            problem = (
                None if self.channel else f"what python-can calls a channel of {self.interface}"
            )
        if problem is not None:
            raise Conflicts([Conflict(_OTHER_CHANNELS, (Part("channel", self.channel, problem),))])
        return self

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
    port: SerialPort
    baud_rate: BaudRate
    axes: Annotated[list[Annotated[int, Field(ge=0, le=9)]], Field(min_length=2, max_length=2)]
    response_timeout_s: TimeoutS
    software_limits_verified: bool

    @field_validator("axes")
    @classmethod
    def _two_axes(cls, axes: list[int]) -> list[int]:
        if axes[0] == axes[1]:
            msg = "must be two different axes, az and el, such as [0, 1]"
            raise ValueError(msg)
        return axes

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
    host: Host
    port: Annotated[int, Field(ge=1, le=65535)]
    device_id: Annotated[int, Field(ge=0, le=255)]
    first_output_register: Annotated[int, Field(ge=0, le=65533)]
    first_input_register: Annotated[int, Field(ge=0, le=65533)]
    full_scale_counts: Annotated[int, Field(ge=100, le=32767)]
    full_scale_v: OutputV
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
DEVICE_TABLES = frozenset({"device", "dac", "piezo", "hexapod"})
"""Tables of the rig file whose `driver` says which device they are of."""
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

    encoder_counts_per_rev: Annotated[int, Field(ge=16, le=2**26)]
    spur_gear_ratio: Annotated[float, Field(ge=0.01, le=1e4)]
    ball_screw_m_per_rad: Annotated[float, Field(ge=1e-6, le=0.02)]
    lever_arm_m: Annotated[float, Field(ge=1e-3, le=10)]
    rotation_deg: RotationDeg
    axis_gains: AxisGains | None = None
    travel_sky_arcsec: Annotated[float, Field(gt=0, le=72_000)]
    velocity_limit_rad_s: Annotated[float, Field(gt=0, le=3000)]
    acceleration_limit_rad_s2: Annotated[float, Field(gt=0, le=1e7)]
    servo: ServoSettings
    device: AmplifierDevice
    wiring: AmplifierWiring | None = None
    backlash_sky_arcsec: OffsetSkyArcsec | None = None

    @property
    def encoder_count_rad(self) -> float:
        """Motor angle of one encoder count."""
        return 2 * math.pi / self.encoder_counts_per_rev

    @property
    def sky_rad_per_motor_rad(self) -> float:
        """Beam angle on the sky by motor angle, 2 p / (GR_spur r_arm); a mirror turns its beam twice as far."""
        return 2 * self.ball_screw_m_per_rad / self.spur_gear_ratio / self.lever_arm_m

    @property
    def sky_arcsec_per_motor_rad(self) -> float:
        """The same in arcsec."""
        return self.sky_rad_per_motor_rad * ARCSEC_PER_RAD

    @property
    def travel_rad(self) -> float:
        """Travel of the motors, either way from the encoders' zero."""
        return self.travel_sky_arcsec / self.sky_arcsec_per_motor_rad


AnySiderostat = Siderostat[SiderostatDevice]


MOST_WRITES = 10
"""Of a D/A in a frame period."""


class ModbusDacDevice(Settings):
    """A Modbus D/A converter: consecutive holding registers, one a channel.

    ``channels`` names the channels of stack 1 to 3, from 1 to 3; without it, they are in this order.
    ``writes_per_frame`` is how often designs that predict may write it in a frame period.
    """

    driver: Literal["modbus_dac"]
    transport: Literal["tcp", "rtu"]
    host: str
    port: Annotated[int, Field(ge=1, le=65535)]
    serial_port: str
    baud_rate: BaudRate
    serial_format: Literal["8E1", "8O1", "8N1", "8N2"]
    device_id: Annotated[int, Field(ge=0, le=255)]
    first_register: Annotated[int, Field(ge=0, le=65533)]
    full_scale_v: OutputV
    bits: Annotated[int, Field(ge=8, le=16)]
    response_timeout_s: TimeoutS
    writes_per_frame: Annotated[int, Field(ge=1, le=MOST_WRITES)] = 1
    channels: Channels | None = None

    @model_validator(mode="after")
    def _can_be_reached(self) -> ModbusDacDevice:
        if self.transport == "rtu" and not is_serial_port(self.serial_port):
            demand = "a serial port, such as /dev/ttyUSB0, or socket://host:port"
            parts = (
                Part("serial_port", self.serial_port, demand),
                Part("transport", self.transport, "tcp"),
            )
            raise Conflicts([Conflict("rtu goes over a serial line", parts)])
        if self.transport == "tcp" and not is_host(self.host):
            demand = "an address such as 192.168.1.31, or a host name"
            parts = (Part("host", self.host, demand), Part("transport", self.transport, "rtu"))
            raise Conflicts([Conflict("tcp goes to a host", parts)])
        if self.transport == "rtu" and not 1 <= self.device_id <= 247:
            parts = (
                Part("device_id", self.device_id, "from 1 to 247"),
                Part("transport", self.transport, "tcp"),
            )
            raise Conflicts([Conflict("over rtu, no other station answers", parts)])
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
    """A Thorlabs MDT693A or MDT693B.

    ``channels`` names the channels of stack 1 to 3, x as 1, y as 2 and z as 3; without it, they are x, y, z.
    """

    driver: Literal["mdt693"]
    port: SerialPort
    baud_rate: BaudRate
    response_timeout_s: TimeoutS
    gain: Annotated[float, Field(ge=1, le=50)]
    limit_v: float
    poll_s: Annotated[float, Field(ge=0.2, le=60)]
    follow_tolerance_v: Positive
    channels: Channels | None = None

    @field_validator("limit_v")
    @classmethod
    def _is_of_the_switch(cls, limit_v: float) -> float:
        if not any(abs(limit_v - one) <= LIMIT_TOLERANCE_V for one in PIEZO_LIMITS_V):
            msg = (
                "must be 75.5, 100.5 or 150.5, which the amplifier reads with its limit switch at 75, 100 or "
                "150 V; choose it by the stacks' data sheet"
            )
            raise ValueError(msg)
        return limit_v


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
    host: Host
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
    port: SerialPort
    baud_rate: BaudRate
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

    mode_hz: Annotated[
        list[Annotated[float, Field(gt=0, le=1e5)]], Field(min_length=2, max_length=2)
    ]
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

    stack_scale_m_per_v: Annotated[float, Field(ge=1e-9, le=2e-5)]
    stack_radius_m: Annotated[float, Field(ge=1e-3, le=0.5)]
    beam_per_mirror: Annotated[float, Field(ge=0.1, le=4)]  # one reflection turns a beam by 2
    rotation_deg: RotationDeg
    axis_gains: AxisGains | None = None
    bias_v: OutputV
    range_rad: Annotated[float, Field(ge=1e-9, le=1)]
    slew_v_per_s: Positive
    dac: ModbusDacDevice
    piezo: Mdt693Device
    hysteresis: StackHysteresis | None = None
    structure: Structure | None = None

    @property
    def swing_v(self) -> float:
        """Voltage at the D/A, either way from the bias, that tilts the mirror by its range."""
        return self.stack_radius_m * self.range_rad / self.stack_scale_m_per_v

    @model_validator(mode="after")
    def _range_fits_the_dac(self) -> Fsm:
        swing_v, full_v = self.swing_v, self.dac.full_scale_v
        low_v, high_v = self.bias_v - swing_v, self.bias_v + swing_v
        if low_v >= 0 and high_v <= full_v:
            return self
        fits = min(self.bias_v, full_v - self.bias_v) / swing_v
        middle = f"from {swing_v:.4g} to {full_v - swing_v:.4g}" if 2 * swing_v <= full_v else ""
        range_part = at_most("range_rad", self.range_rad, self.range_rad * fits)
        if fits <= 0:
            most = at_most("", 0.0, self.range_rad * full_v / 2 / swing_v).must_be
            range_part = Part("range_rad", self.range_rad, f"{most}, with bias_v {full_v / 2:g}")
        parts = [
            range_part,
            Part("bias_v", self.bias_v, middle),
            at_most("stack_radius_m", self.stack_radius_m, self.stack_radius_m * fits),
        ]
        if fits > 0:
            scale = self.stack_scale_m_per_v
            parts.append(at_least("stack_scale_m_per_v", scale, scale / fits))
        if low_v >= 0:
            parts.append(at_least("dac.full_scale_v", full_v, high_v))
        why = f"the range needs {low_v:.3f} to {high_v:.3f} V, and the D/A gives 0 to {full_v:g} V"
        raise Conflicts([Conflict(why, tuple(parts))])
