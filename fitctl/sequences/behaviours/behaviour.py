"""What every kind of step gives the runner."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.messages.commands import Release
from fitctl.messages.modes import AT_REST, Mode
from fitctl.model.optics import scales
from fitctl.sequences.steps import Moving
from fitctl.sequences.view import Figures, View


class Calibration(NamedTuple):
    """What a step has measured that a rig file can say.

    Attributes
    ----------
    name : str
        What it is, as a part of file names.
    lines : list of str
        For people.
    fragment : dict
        What to lay over the rig file.
    arrays : dict
        Arrays that the fragment names, by their file names.
    """

    name: str
    lines: list[str]
    fragment: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


class Result(NamedTuple):
    """What a step that is done has measured, that in words, and what of it is for the rig file."""

    figures: Figures
    message: str
    calibration: Calibration | None = None


class Behaviour(NamedTuple):
    """How one kind of step works; each function takes the step's data first.

    Attributes
    ----------
    needs : frozenset of Mode
        Modes in which it can begin; those that lead there by themselves are waited for.
    check : callable
        What is wrong with the step for a rig and a loop, without the instrument: one text each.
    own_s : callable
        How long it takes when all goes well, for the rig's loop of that name; time-outs count from there.
    run : callable
        Gives the first command.
    done : callable
        Asked at every telemetry message: the result, or None while it is under way. Raises StepFailed.
    stop : callable
        After an attempt that failed or was stopped: ends what the step began.
    pausable : bool
        Whether a pause can begin inside the step.
    loops : str
        Which loops it is for where none is named: "one" must be named unless it is the only one, "none" needs
        no loop, and all of them come one after the other with "links first" or "links last".
    of_beams : bool
        Whether it works for a metrology loop.
    """

    needs: frozenset[Mode]
    done: Callable[[Any, View], Result | None]
    run: Callable[[Any, View], None] = lambda _step, _view: None
    stop: Callable[[Any, View], None] = lambda _step, _view: None
    check: Callable[[Any, Rig, str], list[str]] = lambda _step, _rig, _loop: []
    own_s: Callable[[Any, Rig, str], float] = lambda _step, _rig, _loop: 0.0
    pausable: bool = False
    loops: Literal["one", "none", "links first", "links last"] = "one"
    of_beams: bool = False


ANY = frozenset(Mode)
"""For a step without a loop: the loop of its view is only the rig's first one."""

POWERED = ANY - AT_REST


def frames_due(duration_s: float, rig: Rig) -> int:
    """How many frames come in this time; at least one, or nothing would be measured."""
    return max(1, round(duration_s * rig.camera.frame_rate_hz))


def too_far(step: Moving, rig: Rig, loop_name: str, offset_px: float) -> list[str]:
    """What is wrong with moving the star by so much."""
    sky_arcsec = offset_px * scales(rig, rig.stellar_loops[loop_name]).sky_arcsec_per_px
    problems = []
    if offset_px > step.max_offset_px:
        problems.append(
            f"the star would go {offset_px:.2f} px from its target; max_offset_px is {step.max_offset_px:g}"
        )
    if sky_arcsec > (step.max_offset_sky_arcsec or math.inf):
        problems.append(
            f"the star would go {sky_arcsec:.2f} arcsec on the sky from its target; "
            f"max_offset_sky_arcsec is {step.max_offset_sky_arcsec:g}"
        )
    return problems


def stop_tracking(_step: object, view: View) -> None:
    """Stop tracking where the stages are."""
    if view.tracking:
        view.ask(Release(loop=view.loop_name))
