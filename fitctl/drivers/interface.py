"""What the supervisor sees of the devices, and the errors that they raise.

One folder a device beside this file. Each driver checks, times out and translates; none decides.
Every call returns or raises a :class:`DeviceError` within the device's time limit. A driver is used by one
thread at a time. Times are seconds of the host's monotonic clock; angles are radians of the motor shaft;
voltages are at the D/A unless said otherwise. Pairs are azimuth, then elevation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

AzEl = tuple[float, float]


class DeviceError(Exception):
    """Something is wrong with a device: which one, where, what was expected, what came, what to do.

    Parameters
    ----------
    device : str
        Its name for people, such as ``"D/A"``.
    endpoint : str
        Where it was spoken to, such as ``"127.0.0.1:502"``.
    expected, got : str
        What should have happened, and what did.
    hint : str
        The next step for the operator.

    Examples
    --------
    >>> raise DeviceTimeout("D/A", "127.0.0.1:502", "an answer within 0.25 s", "none", "check its cable")
    Traceback (most recent call last):
    ...
    fitctl.drivers.interface.DeviceTimeout: D/A at 127.0.0.1:502: expected an answer within 0.25 s, got none; \
check its cable
    """

    def __init__(self, device: str, endpoint: str, expected: str, got: str, hint: str = "") -> None:
        self.device = device
        self.endpoint = endpoint
        self.expected = expected
        self.got = got
        self.hint = hint
        text = f"{device} at {endpoint}: expected {expected}, got {got}"
        super().__init__(f"{text}; {hint}" if hint else text)


class DeviceUnreachable(DeviceError):
    """Nothing answers at the endpoint, or the link broke."""


class DeviceTimeout(DeviceError):
    """The device is there but did not answer in time."""


class DeviceRefused(DeviceError):
    """The device answered that it will not: an exception code, an abort, access denied."""


class DeviceProtocolError(DeviceError):
    """An answer that the protocol does not allow."""


class DeviceFault(DeviceError):
    """The device reports a fault of its own."""


class DeviceMismatch(DeviceError):
    """The device works, but is not set as the rig file says."""


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Who answered."""

    maker: str
    model: str
    serial: str
    firmware: str


class Frame(NamedTuple):
    """One camera frame.

    Attributes
    ----------
    number : int
        Counts exposures; a gap is a lost frame.
    mid_exposure_s : float
        Host's monotonic time of the middle of the exposure.
    received_s : float
        Host's monotonic time at which the frame was complete.
    image : uint16 array, shape (height, width)
    """

    number: int
    mid_exposure_s: float
    received_s: float
    image: NDArray[np.uint16]


class CameraCounts(NamedTuple):
    """Since the stream was started."""

    frames: int
    lost: int
    packets_lost: int


class CameraDriver(Protocol):
    """A camera that streams frames."""

    def open(self) -> DeviceIdentity:
        """Take control and check that the device fits the rig file."""
        ...

    def start(self) -> None:
        """Start the stream."""
        ...

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next complete frame, oldest first.

        Parameters
        ----------
        timeout_s : float
            Longest wait.

        Returns
        -------
        Frame or None
            None if no frame was complete in time.
        """
        ...

    def set_frame_rate(self, rate_hz: float) -> None:
        """Take frames at another rate from now on; also while another thread waits for one.

        The rate of the rig file is in force again once the camera is opened anew. After DeviceRefused, the
        camera keeps the rate that it has; after any other error, the rate is not known for sure.
        """
        ...

    def counts(self) -> CameraCounts:
        """Frames and losses so far; may be called from any thread."""
        ...

    def stop(self) -> None:
        """Stop the stream."""
        ...

    def close(self) -> None:
        """Give up control; safe to call twice and after a failure."""
        ...


class ServoReading(NamedTuple):
    """What the two amplifiers said in one servo period.

    Attributes
    ----------
    time_s : float
        Host's monotonic time at which the encoders were read.
    position_rad : pair of float
        Motor angles, azimuth and elevation.
    enabled : bool
        Both axes follow velocity commands.
    fault : str
        Empty, or what the amplifiers report.
    """

    time_s: float
    position_rad: AzEl
    enabled: bool
    fault: str


NO_READING = ServoReading(math.nan, (math.nan, math.nan), enabled=False, fault="")


class ServoAmplifiers(Protocol):
    """Both axes' amplifiers in velocity mode, with their encoders.

    Angles and velocities are plain floats: 500 times a second, arrays of two cost more than the work.
    """

    def open(self) -> DeviceIdentity:
        """Connect and configure; nothing moves."""
        ...

    def enable(self) -> None:
        """Power both axes at zero velocity. Raises DeviceFault when an axis refuses."""
        ...

    def disable(self) -> None:
        """Take power from both axes."""
        ...

    def reset_fault(self) -> None:
        """Clear a latched fault. Raises DeviceFault if it stays."""
        ...

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period: command both motors, read both encoders.

        Once enabled it must be called every period: it is also what keeps the master's heartbeat, without
        which a drive stops by itself.

        Parameters
        ----------
        velocity_rad_s : pair of float
            Of the motor shafts, azimuth and elevation.

        Returns
        -------
        ServoReading or None
            None if no reading came within the period. A fault of an axis is in the reading.

        Raises
        ------
        DeviceError
            If the link or the drive is lost.
        """
        ...

    def close(self) -> None:
        """Disable if possible and disconnect; safe to call twice and after a failure."""
        ...


class BusAmplifiers(ServoAmplifiers, Protocol):
    """Amplifiers on a :class:`ServoBus`."""

    def stage(self, velocity_rad_s: AzEl) -> None:
        """Begin a servo period that :meth:`exchange` ends: have the command ready for the bus."""
        ...


class ServoBus(Protocol):
    """A bus with the amplifiers of one or several loops; one thread servoes the loops of all buses.

    Attributes
    ----------
    meanwhile : callable or None
        Called again and again while amplifiers wait for an answer, as during their opening. Without it,
        amplifiers put off what may wait long until a later period.
    """

    meanwhile: Callable[[], None] | None

    def synchronize(self) -> None:
        """Send all commands that are ready; all amplifiers act, and read their encoders, at once."""
        ...


class MirrorDac(Protocol):
    """The three D/A channels behind the fast steering mirror."""

    def open(self) -> DeviceIdentity:
        """Connect; outputs stay as they are."""
        ...

    def send_v(self, volts: NDArray[np.float64]) -> None:
        """Send the command that sets all three channels at once; returns as soon as it is on its way.

        A command that is not yet confirmed is confirmed first.

        Parameters
        ----------
        volts : array, shape (3,)
            Stack 1 first.

        Raises
        ------
        DeviceError
            As :meth:`confirm`, of the command before.
        """
        ...

    def confirm(self) -> None:
        """Wait until the device confirms the last :meth:`send_v`; returns at once if it has.

        Raises
        ------
        DeviceError
            If no confirmation comes within the device's time limit, or a refusal.
        """
        ...

    def read_v(self) -> NDArray[np.float64]:
        """Read what the channels are set to; shape (3,)."""
        ...

    def close(self) -> None:
        """Disconnect; outputs stay as they are. Safe to call twice and after a failure."""
        ...


class PiezoAmplifier(Protocol):
    """The high-voltage amplifier between D/A and stacks; slow, never inside the tick."""

    def open(self) -> DeviceIdentity:
        """Connect and check the voltage limit against the rig file. Raises DeviceMismatch."""
        ...

    def stack_volts(self) -> NDArray[np.float64]:
        """Measured output, shape (3,), stack 1 first, at the stack."""
        ...

    def limit_v(self) -> float:
        """The voltage-limit switch as the device reports it. Raises DeviceMismatch if it was moved."""
        ...

    def close(self) -> None:
        """Disconnect; safe to call twice and after a failure."""
        ...


class DiodeReading(NamedTuple):
    """One sample of the four photodiodes.

    Attributes
    ----------
    time_s : float
        Host's monotonic time of sampling: midway between the request and its answer's arrival, so wrong by
        at most half the round trip. The device converts its inputs one after the other within that time.
    volts : tuple of four floats
        Of the photodiodes az+, az-, el+ and el-, as measured: ambient light and noise are in them.
    """

    time_s: float
    volts: tuple[float, float, float, float]


class Photodiodes(Protocol):
    """The metrology sensor's four photodiodes behind their A/D converter."""

    def open(self) -> DeviceIdentity:
        """Connect, check who answers, write the converter's settings and read them back.

        Raises DeviceMismatch where they are not as the rig file says.
        """
        ...

    def send_request(self) -> None:
        """Ask for one sample of all four; returns as soon as the request is on its way."""
        ...

    def receive(self) -> DiodeReading | None:
        """The newest sample that has arrived, without waiting; None: none since the last call.

        Samples that arrived before it are dropped, and so is one that is older than the last returned.
        Raises DeviceTimeout when a request has gone without an answer for the device's time limit.
        """
        ...

    def close(self) -> None:
        """Disconnect; safe to call twice and after a failure."""
        ...


class Pose(NamedTuple):
    """Where a hexapod's platform is: its pivot point in mm, its rotations in degrees."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 0.0
    u_deg: float = 0.0
    v_deg: float = 0.0
    w_deg: float = 0.0


def beyond_travel(
    pose: Pose, ends: Iterable[tuple[float, float]]
) -> Iterator[tuple[str, float, float, float]]:
    """Each part of a pose that is beyond its travel: its name, its value and the travel's two ends."""
    for name, value, (low, high) in zip(Pose._fields, pose, ends, strict=True):
        if not low <= value <= high:
            yield name, value, low, high


class HexapodReading(NamedTuple):
    """What the hexapod's controller reports.

    Attributes
    ----------
    time_s : float
        Host's monotonic time at which the pose was read: midway between question and answer.
    pose : Pose
        Measured; of no meaning while the hexapod is not referenced.
    moving, referenced, servos_on : bool
        Some axis moves; all axes know where they are; the servos of all axes are on.
    error : str
        Empty, or the error that the controller had latched, which reading it has cleared.
    """

    time_s: float
    pose: Pose
    moving: bool
    referenced: bool
    servos_on: bool
    error: str


class Hexapod(Protocol):
    """The hexapod under the collector bench; slow, never inside the tick."""

    def open(self) -> DeviceIdentity:
        """Connect and check the device and its travel against the rig file; nothing moves."""
        ...

    def reference(self, is_wanted: Callable[[], bool] = lambda: True) -> None:
        """Start a reference move and wait until it has ended; the platform moves.

        It is stopped as soon as `is_wanted` is false, for a stop that came just before the move began.
        """
        ...

    def move_to(self, pose: Pose, velocity_mm_s: float) -> None:
        """Start a move, or give a running one a new target; returns when the controller has accepted it.

        The velocity can change only while the platform stands still. Raises DeviceRefused where the pose
        is out of reach or the hexapod is not referenced; a move that runs goes on then.
        """
        ...

    def pose(self) -> HexapodReading:
        """Where it is, and how it fares."""
        ...

    def stop(self) -> None:
        """Stop every motion at once, where it is; may be called from any thread, also during another call."""
        ...

    def close(self) -> None:
        """Disconnect; a move that runs goes on. Safe to call twice and after a failure."""
        ...


@dataclass(frozen=True)
class LoopDevices:
    """What one loop senses and acts through.

    A loop without a mirror has neither D/A nor piezo amplifier; a metrology loop alone has photodiodes. With a
    ``bus``, the amplifiers are :class:`BusAmplifiers`, and share a thread with those of other loops.
    """

    amplifiers: ServoAmplifiers
    dac: MirrorDac | None = None
    piezo: PiezoAmplifier | None = None
    photodiodes: Photodiodes | None = None
    bus: ServoBus | None = None


@dataclass(frozen=True)
class Devices:
    """Everything that a rig has; the hexapod only where a collector moves."""

    camera: CameraDriver
    loops: dict[str, LoopDevices]
    hexapod: Hexapod | None = None
