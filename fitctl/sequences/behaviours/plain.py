"""Steps that are a command and the mode that it leads to: standby, controller, wait, off."""

from __future__ import annotations

from fitctl.config import Rig
from fitctl.controllers.pair import LEARNT
from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import Off, Release, SetController, Standby
from fitctl.messages.modes import Mode
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import ANY, POWERED, Behaviour, Result, stop_tracking
from fitctl.sequences.view import StepFailed, View

_OFF = ROWS[Off].word


def _run_standby(_step: steps.Standby, view: View) -> None:
    if view.mode is Mode.OFF:
        view.command(Standby(loop=view.loop_name))
    elif view.mode is not Mode.STANDBY:
        view.command(Release(loop=view.loop_name))


def _standby_done(_step: steps.Standby, view: View) -> Result | None:
    view.require_no_failure()
    return Result({}, "") if view.mode is Mode.STANDBY else None


def _run_controller(step: steps.Controller, view: View) -> None:
    if step.name != LEARNT:
        view.command(SetController(loop=view.loop_name, name=step.name))


def _controller_done(step: steps.Controller, view: View) -> Result | None:
    view.require_no_failure()
    if view.loop.controller == step.name:
        return Result({}, step.name)
    return _learnt_done(view) if step.name == LEARNT else None


def _learnt_done(view: View) -> Result | None:
    """Use the learner's next design, or keep the present one if that leaves hardly more."""
    learning, controller = view.loop.learning, view.loop.controller
    report = None if learning is None else learning.report
    if report is None or not report.design_json or view.marks:
        return None
    if not report.worth_it:
        return Result({"learnt_px": report.learnt_px}, f"kept {controller}; {report.text}")
    view.marks.append(view.now_s)
    view.command(SetController(loop=view.loop_name, name=LEARNT))
    return None


def _check_controller(step: steps.Controller, rig: Rig, loop_name: str) -> list[str]:
    if step.name == LEARNT and rig.stellar_loops[loop_name].learn == "off":
        return [f'loops.{loop_name}.learn is "off", so nothing is learnt; set it to "advise"']
    return []


def _wait_done(step: steps.Wait, view: View) -> Result | None:
    view.measurements.clear()  # nothing evaluates them, and a long wait would fill the memory
    return Result({}, "") if view.elapsed_s >= step.duration_s else None


def _off_done(_step: steps.Off, view: View) -> Result | None:
    """The mode is OFF from the start of closing; devices that were not closed cannot be closed again."""
    failure = view.loop.last_failure
    if failure is not None and failure.what == _OFF:
        msg = f"{_OFF} failed: {failure.text}"
        raise StepFailed(msg)
    if view.mode is Mode.STANDBY:
        view.ask(Off(loop=view.loop_name))  # refused while the mirror is on its way to its bias
    closing = any(
        outcome.command == _OFF and outcome.state == "under way" for outcome in view.loop.outcomes
    )
    return Result({}, "") if view.mode is Mode.OFF and not closing else None


def _wait_s(step: steps.Wait, _rig: Rig, _loop_name: str) -> float:
    return step.duration_s


PLAIN = {
    "standby": Behaviour(
        POWERED | {Mode.OFF}, _standby_done, _run_standby, loops="links last", of_beams=True
    ),
    "controller": Behaviour(
        POWERED | {Mode.OFF}, _controller_done, _run_controller, check=_check_controller
    ),
    "wait": Behaviour(ANY, _wait_done, own_s=_wait_s, pausable=True, loops="none", of_beams=True),
    "off": Behaviour(
        POWERED | {Mode.OFF}, _off_done, stop_tracking, loops="links last", of_beams=True
    ),
}
