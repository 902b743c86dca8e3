"""What a step of a commissioning works on, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fitctl.clock import Clock, MonotonicClock
from fitctl.config import Loop, Rig

State = Literal["passed", "corrected", "measured", "failed", "skipped"]
DONE: frozenset[str] = frozenset({"passed", "corrected", "measured", "skipped"})

BEFORE = " before correction"
"""After the name of a figure that a step measured before it corrected the rig file."""


@dataclass(frozen=True)
class Outcome:
    """What came of a step.

    Attributes
    ----------
    lines : list of str
        What was seen, for people.
    figures : dict
        What was measured, by a name with its unit.
    found : dict
        What the rig file must say instead, as tables of the rig file; empty where it is right.
    trouble : str
        What is wrong that no rig file can put right; empty if nothing.
    estimated : bool
        What was found is an estimate with an interval of its own: the rig file takes it without a second
        measurement.
    """

    lines: list[str] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    found: dict[str, Any] = field(default_factory=dict)
    trouble: str = ""
    estimated: bool = False

    @property
    def state(self) -> State:
        """How the step ended."""
        if self.trouble:
            return "failed"
        if not self.found:
            return "passed"
        return "measured" if self.estimated else "corrected"


class Cable(NamedTuple):
    """A cable that a test takes off.

    Attributes
    ----------
    name : str
        What people call it.
    mock : str
        The mock device on its end, such as ``right.mdt693``.
    """

    name: str
    mock: str


def nobody_there(_cable: Cable, _on: bool) -> None:
    """Nobody can take a cable off.

    Raises
    ------
    StepError
        Always.
    """
    msg = "no person is present to disconnect a cable"
    raise StepError(msg)


class StepError(Exception):
    """A step has stopped before its end; the text names the thing and what to do.

    Parameters
    ----------
    text : str
    figures : mapping, optional
        What was measured until then.
    """

    def __init__(self, text: str, figures: Mapping[str, float] | None = None) -> None:
        super().__init__(text)
        self.figures = dict(figures or {})


@dataclass(frozen=True)
class Site:
    """What a step works on.

    Attributes
    ----------
    rig : Rig
        As the rig file says, with what earlier steps have found.
    name : str
        Of the loop; empty for a step that is of the whole rig.
    report : callable
        Prints a line while the step runs.
    rig_path : Path
    overrides : tuple of str
        With which a process that is started for the step gets the same rig.
    figures : dict
        What earlier steps have measured, by ``task.figure``.
    quick : bool
        A short acceptance.
    cable : callable
        Has somebody take a cable off, or put it on again: its device, and whether it is to be on.
    clock : Clock
    """

    rig: Rig
    name: str
    report: Callable[[str], None]
    rig_path: Path
    overrides: tuple[str, ...]
    figures: Mapping[str, float] = field(default_factory=dict)
    quick: bool = False
    cable: Callable[[Cable, bool], None] = nobody_there
    clock: Clock = field(default_factory=MonotonicClock)

    @property
    def loop(self) -> Loop:
        """The stellar loop."""
        return self.rig.stellar_loops[self.name]

    def found(self, **tables: Any) -> dict[str, Any]:
        """Tables of this loop, as a fragment of a rig file."""
        return {"loops": {self.name: tables}}
