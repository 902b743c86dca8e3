"""The steps of the whole testbed: the collector's motion, and the tilt and visibility of two stars."""

from __future__ import annotations

from typing import Any

import numpy as np

from fitctl.config import ConfigError, Rig
from fitctl.messages.commands import MoveCollector
from fitctl.messages.modes import AT_REST, Mode
from fitctl.model.collector_motion import beyond, course_of
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import ANY, Behaviour, Result, frames_due
from fitctl.sequences.view import StepFailed, View

_LEAST_HELD = 0.9  # of the frames that were due


def command_of(step: steps.Collector) -> MoveCollector:
    """The command that the step gives."""
    motion: dict[str, Any] = step.motion
    return MoveCollector(action=step.action, **motion)


def _check_collector(step: steps.Collector, rig: Rig, _loop_name: str) -> list[str]:
    if rig.collector is None:
        return [f"rig {rig.name} has no collector that moves"]
    if step.motion and step.action != "start":
        return [f"{', '.join(step.motion)}: only allowed with action start"]
    if step.action != "start":
        return []
    try:
        course = course_of(rig.collector.motion.changed(step.motion), seed=0)
    except ConfigError as error:
        return [str(error)]
    return beyond(course, rig.collector)


def _collector_s(step: steps.Collector, rig: Rig, _loop_name: str) -> float:
    if rig.collector is None or step.action != "reference":
        return 0.0
    return rig.collector.hexapod.reference_timeout_s


def _run_collector(step: steps.Collector, view: View) -> None:
    state = view.telemetry.collector
    if state is not None and state.motion:
        view.marks.append(view.now_s)  # it moves, so that an error from now on is the stop's
    view.command(command_of(step))


def _done_collector(step: steps.Collector, view: View) -> Result | None:
    state = view.telemetry.collector
    if state is None:
        msg = (
            "the supervisor has no collector; start it with the rig file that this sequence is for"
        )
        raise StepFailed(msg)
    if state.busy:
        return None
    if state.error and (step.action != "stop" or view.marks):
        raise StepFailed(state.error)
    match step.action:
        case "reference":
            return Result({}, "all axes are at zero")
        case "start":
            if not state.motion:
                msg = "the collector was stopped before its motion began"
                raise StepFailed(msg)
            return Result({}, f"{state.motion} begins")
        case "stop":
            return None if state.motion else Result({}, "the collector stands still")


def _stop_collector(step: steps.Collector, view: View) -> None:
    if step.action != "stop":
        view.ask(MoveCollector(action="stop"))


def _done_visibility(step: steps.Visibility, view: View) -> Result | None:
    fringes = view.rig.fringes
    for loop in view.telemetry.loops:
        if fringes and loop.name in fringes.loops and Mode[loop.mode] in AT_REST | {Mode.STANDBY}:
            both = " and ".join(fringes.loops)
            msg = f"visibility needs the stars of {both}; loop {loop.name} is in {loop.mode}"
            raise StepFailed(msg)
    view.measurements.clear()  # those of one star, which nothing evaluates here
    if view.elapsed_s > step.settle_s:
        due = frames_due(step.duration_s, view.rig) - view.squares.frames
        newest = [one for one in view.telemetry.overlaps if one.time_s >= view.began_s][:due]
        tilts_arcsec = [(one.tilt_az_arcsec, one.tilt_el_arcsec) for one in newest]
        view.squares.add(np.reshape(tilts_arcsec, (-1, 2)))
        view.marks += [one.visibility for one in newest]
    if view.elapsed_s < step.settle_s + step.duration_s:
        return None
    due = frames_due(step.duration_s, view.rig)
    visibility = np.array(view.marks)
    visibility = visibility[np.isfinite(visibility)]
    if visibility.size < _LEAST_HELD * due:
        msg = (
            f"both stars were held on {visibility.size} of {due} frames; expected at least "
            f"{100 * _LEAST_HELD:g} %"
        )
        raise StepFailed(msg)
    az_arcsec, el_arcsec = view.squares.rms_px.tolist()  # of what was added: angles
    mean = float(visibility.mean())
    message = f"visibility {mean:.4f}; tilt az {az_arcsec:.4f}, el {el_arcsec:.4f} arcsec RMS"
    if step.least_visibility is not None and mean < step.least_visibility:
        msg = f"{message}; least_visibility is {step.least_visibility:g}"
        raise StepFailed(msg)
    figures = {
        "visibility": mean,
        "visibility_5_percent": float(np.percentile(visibility, 5)),
        "tilt_rms_az_arcsec": az_arcsec,
        "tilt_rms_el_arcsec": el_arcsec,
        "frames_held": float(visibility.size),
    }
    return Result(figures, message)


def _check_visibility(_step: steps.Visibility, rig: Rig, _loop_name: str) -> list[str]:
    if rig.fringes is None:
        return [f"rig {rig.name} has no section fringes, which names the two stars"]
    return []


def _visibility_s(step: steps.Visibility, _rig: Rig, _loop_name: str) -> float:
    return step.settle_s + step.duration_s


TESTBED = {
    "collector": Behaviour(
        ANY,
        _done_collector,
        _run_collector,
        _stop_collector,
        _check_collector,
        _collector_s,
        loops="none",
        of_beams=True,
    ),
    "visibility": Behaviour(
        ANY,
        _done_visibility,
        check=_check_visibility,
        own_s=_visibility_s,
        pausable=True,
        loops="none",
        of_beams=True,
    ),
}
