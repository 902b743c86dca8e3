"""What may happen in one run, and the plan of a run."""

from __future__ import annotations

import msgspec

from fitctl.messages.commands import AnyCommand

RESTARTS = ("reset", "power cut")
AT_ONCE = frozenset({*RESTARTS, "trip"})
"""Faults without a duration. A drive that has tripped stays so until it is opened again."""


def kind_of(device: str) -> str:
    """A device's name without its loop."""
    return device.rpartition(" ")[2]


class _Happening(msgspec.Struct, frozen=True, kw_only=True):
    at_s: float

    @property
    def kind(self) -> str:
        """The name used in the statistics."""
        return str(self.__struct_config__.tag)


class Order(_Happening, frozen=True, kw_only=True, tag="order"):
    """An operator sends a command; ``None`` is whichever one brings the first loop closer to its star."""

    who: str
    command: AnyCommand | None = None

    @property
    def kind(self) -> str:
        """The name used in the statistics."""
        return "onwards" if self.command is None else type(self.command).__name__


class Strike(_Happening, frozen=True, kw_only=True, tag="strike"):
    """A fault of one device, and how long it lasts; what happens at once has no duration.

    `part` is the fraction of the calls that it meets; with a `number` it meets only that call, counted from 1.
    """

    device: str
    fault: str
    lasts_s: float = 0.0
    size: float = 0.0
    part: float = 1.0
    number: int = 0

    @property
    def kind(self) -> str:
        """The name used in the statistics."""
        which = " once" if self.number else " at times" if self.part < 1.0 else ""
        return f"{kind_of(self.device)} {self.fault}{which}"


class Stall(_Happening, frozen=True, kw_only=True, tag="stall"):
    """The whole machine stalls for a time, or the supervisor's process `alone`."""

    lasts_s: float
    alone: bool = False

    @property
    def kind(self) -> str:
        """The name used in the statistics."""
        return "stall of the supervisor" if self.alone else "stall"


class Kill(_Happening, frozen=True, kw_only=True, tag="kill"):
    """The supervisor's process is killed, and a new one starts ``back_after_s`` later."""

    back_after_s: float


class Cloud(_Happening, frozen=True, kw_only=True, tag="cloud"):
    """All stars dim to ``part`` of their light for a time."""

    lasts_s: float
    part: float


class RecorderDeath(_Happening, frozen=True, kw_only=True, tag="recorder death"):
    """The recorder is killed; the supervisor starts a new one."""


class RecorderStuck(_Happening, frozen=True, kw_only=True, tag="recorder stuck"):
    """The recorder neither receives nor writes for a time."""

    lasts_s: float


class FullDisk(_Happening, frozen=True, kw_only=True, tag="full disk"):
    """The log's disk is full for a time."""

    lasts_s: float


class ClockStep(_Happening, frozen=True, kw_only=True, tag="clock step"):
    """The computer's wall clock is set forward or back."""

    by_s: float


class Sequence(_Happening, frozen=True, kw_only=True, tag="sequence"):
    """An operator starts a sequence of steps from `benchmarks.swarm.clients.STEPS`, for a loop or all."""

    who: str
    steps: list[str]
    loop: str = ""


Happening = (
    Order
    | Strike
    | Stall
    | Kill
    | Cloud
    | RecorderDeath
    | RecorderStuck
    | FullDisk
    | ClockStep
    | Sequence
)


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """One run.

    Attributes
    ----------
    seed : int
        Seed of everything else that is random, such as the plant's noise and each delay.
    rig : str
        A file in ``rigs/``.
    settings : list of str
        ``key.path=value`` texts that replace values of the rig file.
    duration_s : float
        Until all faults end and the healing begins.
    happenings : list
        In order of time.
    console_loss : float
        Fraction of the messages that the console misses.
    remote_consoles : int
        Consoles that receive encoded telemetry by the real client, each over a link with little room.
    """

    seed: int
    rig: str
    settings: list[str]
    duration_s: float
    happenings: list[Happening]
    console_loss: float = 0.0
    remote_consoles: int = 0
