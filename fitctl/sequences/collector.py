"""The step that references the hexapod under the collector, and begins and ends the collector's motion."""

from __future__ import annotations

from typing import Any

from fitctl.config import ConfigError, Rig
from fitctl.messages.commands import MoveCollector
from fitctl.messages.modes import Mode
from fitctl.model.collector_motion import course_of
from fitctl.sequences import steps
from fitctl.sequences.behaviour import POWERED, Behaviour, Result
from fitctl.sequences.view import StepFailed, View


def command_of(step: steps.Collector) -> MoveCollector:
    """The command that the step gives."""
    motion: dict[str, Any] = step.motion
    return MoveCollector(action=step.action, **motion)


def _check(step: steps.Collector, rig: Rig, _loop_name: str) -> list[str]:
    if rig.collector is None:
        return [f"rig {rig.name} has no collector that moves"]
    if step.motion and step.action != "start":
        return [f"{', '.join(step.motion)}: only a motion that begins has them: action start"]
    if step.action != "start":
        return []
    try:
        course = course_of(rig.collector.motion.changed(step.motion), seed=0)
    except ConfigError as error:
        return [str(error)]
    limit_mm_s = rig.collector.hexapod.velocity_limit_mm_s
    if course.velocity_mm_s > limit_mm_s:
        return [
            f"the motion reaches {course.velocity_mm_s:.3g} mm/s; "
            f"collector.hexapod.velocity_limit_mm_s is {limit_mm_s:g}"
        ]
    return []


def _own_s(step: steps.Collector, rig: Rig, _loop_name: str) -> float:
    if rig.collector is None or step.action != "reference":
        return 0.0
    return rig.collector.hexapod.reference_timeout_s


def _run(step: steps.Collector, view: View) -> None:
    state = view.telemetry.collector
    if state is not None and state.motion:
        view.marks.append(view.now_s)  # it moves, so that an error from now on is the stop's
    view.command(command_of(step))


def _done(step: steps.Collector, view: View) -> Result | None:
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


def _stop(step: steps.Collector, view: View) -> None:
    if step.action != "stop":
        view.ask(MoveCollector(action="stop"))


COLLECTOR = {
    "collector": Behaviour(
        POWERED | {Mode.OFF}, _done, _run, _stop, _check, _own_s, loops="none", of_beams=True
    )
}
