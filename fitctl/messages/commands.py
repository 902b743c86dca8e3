"""Commands that clients send to a supervisor, and its replies.

:mod:`fitctl.messages.command_table` lists how people write each command and who may send it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import msgspec

from fitctl.config import CONTROLLERS, ControllerName, Motion
from fitctl.logging.records import Event, RecorderStatus, SequenceAttempt
from fitctl.model.drives import Drive
from fitctl.text import UNDECODABLE

PROTOCOL_VERSION = 1
ControllerChoice = ControllerName | Literal["learnt"]
CONTROLLER_CHOICES: tuple[ControllerChoice, ...] = (*CONTROLLERS, "learnt")
MAX_COMMAND_BYTES = 4096  # what is longer never reaches the supervisor


class Command(msgspec.Struct, frozen=True, kw_only=True, tag=True, forbid_unknown_fields=True):
    """The common base of commands; ``loop`` is empty for all loops.

    ``sent_s`` is when it was sent, by the supervisor's clock, where that matters and the sender knows it.
    """

    version: int = PROTOCOL_VERSION
    loop: str = ""
    sent_s: float | msgspec.UnsetType = msgspec.UNSET


class Standby(Command, frozen=True, kw_only=True):
    """From OFF: connect and enable all devices."""


class Acquire(Command, frozen=True, kw_only=True):
    """Search for the star, pull it in, hold it.

    What is given stands in place of the rig file's, this once.

    Attributes
    ----------
    search_radius_sky_arcsec, field_overlap : float, optional
        As the rig file's.
    expected_az_sky_arcsec, expected_el_sky_arcsec : float, optional
        Where the star is, from where the encoders read zero; without it, on the target or where it was last.
    star_flux_dn : float, optional
        As the rig file's, until the next time that one is searched for by command.
    rate_az_sky_arcsec_s, rate_el_sky_arcsec_s : float, optional
        How fast the star moves with the stages at rest, likewise.
    """

    search_radius_sky_arcsec: float | None = None
    field_overlap: float | None = None
    expected_az_sky_arcsec: float | None = None
    expected_el_sky_arcsec: float | None = None
    star_flux_dn: float | None = None
    rate_az_sky_arcsec_s: float | None = None
    rate_el_sky_arcsec_s: float | None = None


class Release(Command, frozen=True, kw_only=True):
    """Stop tracking the star; the stages stay where they are: STANDBY."""


class Stop(Command, frozen=True, kw_only=True):
    """SAFE, at once, from every mode."""


class Recover(Command, frozen=True, kw_only=True):
    """From SAFE: reconnect, reset faults, then STANDBY."""


class Off(Command, frozen=True, kw_only=True):
    """From STANDBY or SAFE: disable amplifiers, close devices."""


class SetTarget(Command, frozen=True, kw_only=True):
    """Move the point where the loop holds the star, through the prefilter."""

    az_px: float
    el_px: float


class Look(Command, frozen=True, kw_only=True):
    """In COARSE and VERNIER: move the window, and follow the star there from now on."""

    az_px: float
    el_px: float


class Jog(Command, frozen=True, kw_only=True):
    """In STANDBY: move the siderostat by angles on the sky."""

    az_sky_arcsec: float
    el_sky_arcsec: float


class SetBiasOffset(Command, frozen=True, kw_only=True):
    """In STANDBY: offset the mirror from its bias, until SAFE or the next power-up."""

    az_urad: float
    el_urad: float


class SetController(Command, frozen=True, kw_only=True):
    """Switch to another design, by name; in VERNIER the mirror continues from where it is.

    "learnt" is the newest design learnt from the frames of the loop.
    """

    name: ControllerChoice


class Reset(Command, frozen=True, kw_only=True):
    """Reset a tripped interlock, by its name in the rig file."""

    name: str


class MoveCollector(Command, frozen=True, kw_only=True):
    """Reference the hexapod (reference), or start or stop the collector's motion (start, stop).

    What is given of a motion that begins stands in place of the rig file's ``collector.motion``, this once.
    Files cannot be named here: ``kind`` "file" is the rig file's.
    """

    action: Literal["reference", "start", "stop"]
    kind: Motion | None = None
    direction_deg: float | None = None
    range_mm: float | None = None
    velocity_mm_s: float | None = None
    amplitude_mm: float | None = None
    frequency_hz: float | None = None
    rms_mm_s: float | None = None
    correlation_s: float | None = None

    @property
    def motion(self) -> dict[str, Any]:
        """What is given of the motion."""
        common = {*Command.__struct_fields__, "action"}
        given = msgspec.structs.asdict(self)
        return {name: v for name, v in given.items() if name not in common and v is not None}


class FrameRate(Command, frozen=True, kw_only=True):
    """Run the camera slower for a while, to distinguish vibrations from aliases.

    Then it runs as the rig file says again.
    """

    rate_hz: float
    duration_s: float = 15.0


class Experiment(Command, frozen=True, kw_only=True):
    """From COARSE or VERNIER: make motions with one loop's stages, open loop, then return to COARSE."""

    name: str
    drives: list[Drive]


class Status(Command, frozen=True, kw_only=True):
    """Show the mode of every loop; renews the lease of the commander."""


class RecentEvents(Command, frozen=True, kw_only=True):
    """Show the last events, also those from before you connected."""


class TakeOver(Command, frozen=True, kw_only=True):
    """Take the instrument over from the present commander."""


class Shutdown(Command, frozen=True, kw_only=True):
    """SAFE, OFF, then end the supervisor process."""


class RecorderReport(Command, frozen=True, kw_only=True):
    """The recorder reports what it has written."""

    status: RecorderStatus


class LearnerReport(Command, frozen=True, kw_only=True):
    """What the learner found in a loop's frames.

    Attributes
    ----------
    design_json : str
        Name and parameters of the learnt design; empty if there is none, and ``text`` says why.
    text : str
        The night, for people.
    evaluated_s : float
        Of frames.
    present_px, learnt_px, bound_px : float
        True residual that the design in force, the learnt one and the theoretical minimum leave of this night.
        These and the following are 0 where they are not known.
    learnt_camera_px : float
        RMS of the error on frames that the learnt design is expected to leave, noise included.
    measured_px : float
        The same, measured with the design in force; of the worst axis.
    noise_px : float
        One standard deviation of the noise on a frame, as estimated.
    worth_it : bool
        The learnt design leaves clearly less; much less where the model does not fit the frames.
    fits : bool
        The model fits the frames.
    classifying_rate_hz : float
        The frame rate that distinguishes lines from aliases, where that is worth it.
    """

    design_json: str
    text: str
    evaluated_s: float
    present_px: float = 0.0
    learnt_px: float = 0.0
    bound_px: float = 0.0
    learnt_camera_px: float = 0.0
    measured_px: float = 0.0
    noise_px: float = 0.0
    worth_it: bool = False
    fits: bool = True
    classifying_rate_hz: float = 0.0


class SequenceStatus(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a sequence is; ``run`` identifies a run, ``wanted`` is the newest order to it."""

    run: str
    name: str
    state: Literal["running", "paused", "done", "failed", "stopped"]
    steps: int
    step_number: int = 0
    step: str = ""
    loop: str = ""
    attempt: int = 0
    message: str = ""
    last_attempt: SequenceAttempt | None = None
    wanted: Literal["run", "pause", "end"] = "run"


class SequenceReport(Command, frozen=True, kw_only=True):
    """A sequence reports where it is, at least once a second."""

    status: SequenceStatus


class SequenceControl(Command, frozen=True, kw_only=True):
    """Pause, resume or end the sequence that is running, wherever it runs."""

    action: Literal["pause", "resume", "end"]


AnyCommand = (
    Standby
    | Acquire
    | Release
    | Stop
    | Recover
    | Off
    | SetTarget
    | Look
    | Jog
    | SetBiasOffset
    | SetController
    | Reset
    | MoveCollector
    | FrameRate
    | Experiment
    | Status
    | RecentEvents
    | TakeOver
    | Shutdown
    | RecorderReport
    | LearnerReport
    | SequenceReport
    | SequenceControl
)


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to every command; ``text`` says why not, and what to do.

    ``events`` are those that were asked for, oldest first. ``number`` is that of an accepted command that takes
    time; telemetry has its outcome in each loop (:class:`fitctl.messages.telemetry.CommandOutcome`).
    """

    accepted: bool
    text: str = ""
    time_s: float = 0.0  # the supervisor's monotonic clock, for a client on another machine
    events: list[Event] = []
    number: int = 0


def decode_command(payload: bytes) -> AnyCommand | Reply:
    """A command as it came, or a refusal with the reason."""
    try:
        command = _decode(payload)
    except UNDECODABLE as error:
        return Reply(accepted=False, text=f"not a command: {str(error)[:_QUOTED]}")
    if command.version != PROTOCOL_VERSION:
        text = f"this supervisor speaks version {PROTOCOL_VERSION}, not {command.version}"
        return Reply(accepted=False, text=text)
    return command


_QUOTED = 200  # characters of an error, which may quote what came
_decode: Callable[[bytes], AnyCommand] = msgspec.msgpack.Decoder(AnyCommand).decode
