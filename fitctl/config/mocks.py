"""The rig file's mock devices, and the faults that they start with."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from fitctl.config.base import (
    BY_KIND,
    METROLOGY,
    STELLAR,
    Count,
    Finite,
    Fraction,
    NonNegative,
    Port,
    Positive,
    Settings,
    of_kind,
)
from fitctl.config.devices import HexapodTravel


class DacMock(Settings):
    """Settings of the mock D/A.

    Attributes
    ----------
    true_full_scale_v : float, optional
        Where its outputs have another range than ``fsm.dac.full_scale_v`` says.
    bytes_swapped : bool
        It takes the low byte of a register for the high one.
    """

    watchdog_s: Positive
    watchdog_latches: bool
    safe_v: NonNegative
    unknown_unit: Literal["refuse", "ignore", "serve"]
    true_full_scale_v: Positive | None = None
    bytes_swapped: bool = False


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
    true_gains : list of float, optional
        Of the channels, where they are not as ``fsm.piezo.gain`` says; 0 is an input with nothing plugged in.
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
    true_gains: Annotated[list[NonNegative], Field(min_length=3, max_length=3)] | None = None


class GigeMock(Settings):
    """Settings of the mock camera.

    Attributes
    ----------
    true_frame_rate_hz : float, optional
        Where it runs at another rate than it is set to.
    quarter_turns : int
        By how many right angles its picture is turned, azimuth towards elevation; for a square sensor.
    mirrored : bool
        Its picture is mirrored along azimuth, before it is turned.
    mono8_only : bool
        It has no other pixel format.
    offset_at_start_px : int
        Along both axes, of the region that the last program left it with, which ends at the sensor's edges.
    """

    description: Literal["xml", "zip"]
    resends: bool
    clock: bool
    true_frame_rate_hz: Positive | None = None
    quarter_turns: Annotated[int, Field(ge=0, le=3)] = 0
    mirrored: bool = False
    mono8_only: bool = False
    offset_at_start_px: Annotated[int, Field(ge=0, le=16)] = 0


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
    homed : bool
        Whether its axes are homed after power-up; before they are, no software limit acts.
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
    homed: bool
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


class LabJackMock(Settings):
    """Settings of the mock LabJack T7.

    Attributes
    ----------
    modbus_port : int
    serial_number : int
    firmware : float
        What the device reports as its version.
    pro : bool
        It has the high-resolution converter, resolution indices 9 to 12.
    overhead_s : float
        From a request to its answer, beside the time that conversions take.
    """

    modbus_port: Port
    serial_number: Count
    firmware: Positive
    pro: bool
    overhead_s: NonNegative


class C887Mock(Settings):
    """Settings of the mock hexapod controller.

    Attributes
    ----------
    tcp_port : int
    baud_rate : int
        Of the pty; a client with another one is not understood.
    stage, serial_number, firmware : str
        What it reports.
    travel : HexapodTravel
        Of each axis while all others are at zero.
    velocity_limit_mm_s, velocity_limit_deg_s : float
        Of the platform; ``VLS`` lowers both in proportion.
    acceleration_mm_s2, acceleration_deg_s2 : float
    referenced : bool
        Whether it has been referenced before fitctl connects.
    reference_s : float
        How long a reference move takes.
    reply_s : float
        From a command to its answer.
    """

    tcp_port: Port
    baud_rate: Count
    stage: str
    serial_number: str
    firmware: str
    travel: HexapodTravel
    velocity_limit_mm_s: Positive
    velocity_limit_deg_s: Positive
    acceleration_mm_s2: Positive
    acceleration_deg_s2: Positive
    referenced: bool
    reference_s: NonNegative
    reply_s: NonNegative


class SiderostatMocks(Settings):
    """Where the mock amplifiers of one siderostat listen, and how they are.

    Attributes
    ----------
    velocity_gains : list of float, optional
        How many times faster than commanded each axis of the amplifiers turns its motor.
    motor_ends_rad : list of float, optional
        How far each axis's motor turns, either way from where it was at power-up, before something stops it.
    """

    slcan_port: Port
    drive_command_timeout_s: Positive
    velocity_gains: Annotated[list[Finite], Field(min_length=2, max_length=2)] | None = None
    motor_ends_rad: Annotated[list[Positive], Field(min_length=2, max_length=2)] | None = None
    ensemble: EnsembleMock | None = None  # where siderostat.device is one
    bal_analog: BalAnalogMock | None = None  # likewise


class LoopMocks(SiderostatMocks):
    """Where the mock devices of one stellar loop listen, and how they are."""

    kind: Literal["stellar"] = "stellar"
    modbus_port: Port
    mdt693_port: Port
    dac: DacMock
    mdt693: Mdt693Mock


class MetrologyMocks(SiderostatMocks):
    """Where the mock devices of one metrology loop listen, and how they are."""

    kind: Literal["metrology"]
    labjack: LabJackMock


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
    loops: Annotated[
        dict[
            str,
            Annotated[
                Annotated[LoopMocks, Tag(STELLAR)] | Annotated[MetrologyMocks, Tag(METROLOGY)],
                BY_KIND,
            ],
        ],
        Field(min_length=1),
    ]
    hexapod: C887Mock | None = None  # where the rig has a collector
    faults: list[Fault] = Field(default_factory=list)

    @property
    def stellar_loops(self) -> dict[str, LoopMocks]:
        """Those of kind stellar."""
        return of_kind(self.loops, LoopMocks)

    @property
    def metrology_loops(self) -> dict[str, MetrologyMocks]:
        """Those of kind metrology."""
        return of_kind(self.loops, MetrologyMocks)
