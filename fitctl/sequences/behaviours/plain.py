"""Steps that are a command and the mode that it leads to: standby, controller, wait, off."""

from __future__ import annotations

from fitctl.config import Rig
from fitctl.messages.commands import Hold, Off, SetController, Standby
from fitctl.messages.modes import Mode
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import POWERED, Behaviour, Result, stop_tracking
from fitctl.sequences.view import View


def _run_standby(_step: steps.Standby, view: View) -> None:
    if view.mode is Mode.OFF:
        view.command(Standby(loop=view.loop_name))
    elif view.mode is not Mode.STANDBY:
        view.command(Hold(loop=view.loop_name))


def _standby_done(_step: steps.Standby, view: View) -> Result | None:
    view.require_no_failure()
    return Result({}, "") if view.mode is Mode.STANDBY else None


def _run_controller(step: steps.Controller, view: View) -> None:
    view.command(SetController(loop=view.loop_name, name=step.name))


def _controller_done(step: steps.Controller, view: View) -> Result | None:
    view.require_no_failure()
    return Result({}, step.name) if view.loop.controller == step.name else None


def _wait_done(step: steps.Wait, view: View) -> Result | None:
    view.measurements.clear()  # nothing evaluates them, and a long wait would fill the memory
    return Result({}, "") if view.elapsed_s >= step.duration_s else None


def _off_done(_step: steps.Off, view: View) -> Result | None:
    if view.mode is Mode.STANDBY:
        view.ask(Off(loop=view.loop_name))  # refused while the mirror is on its way to its bias
    return Result({}, "") if view.mode is Mode.OFF else None


def _wait_s(step: steps.Wait, _rig: Rig, _loop_name: str) -> float:
    return step.duration_s


PLAIN = {
    "standby": Behaviour(
        POWERED | {Mode.OFF}, _standby_done, _run_standby, loops="links last", of_beams=True
    ),
    "controller": Behaviour(POWERED | {Mode.OFF}, _controller_done, _run_controller),
    "wait": Behaviour(
        POWERED | {Mode.OFF}, _wait_done, own_s=_wait_s, pausable=True, loops="none", of_beams=True
    ),
    "off": Behaviour(
        POWERED | {Mode.OFF}, _off_done, stop_tracking, loops="links last", of_beams=True
    ),
}
