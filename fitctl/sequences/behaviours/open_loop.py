"""Steps that move the stages open loop while the camera watches: experiment, chirp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import EXPERIMENTS
from fitctl.messages.commands import Experiment
from fitctl.messages.modes import Mode, Trigger
from fitctl.model.drives import FSM, SIDEROSTAT, STACKS, Drive, channel_values, experiment_s
from fitctl.model.optics import scales
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import Behaviour, Result, stop_tracking, too_far
from fitctl.sequences.view import Figures, StepFailed, View, columns
from fitctl.stages.drives import refused_drives
from fitctl.stages.injector import stack_v_per_px

Floats = NDArray[np.float64]
Plan = Callable[[Any, Rig, str], list[Drive]]
_LEAST_SEEN = 0.5  # of the frames, on which the star was: less, and nothing was watched
_SAMPLED_HZ = 100.0


def motions_px(rig: Rig, loop_name: str, drives: list[Drive]) -> Floats:
    """Where the motions put the star about its place, by the rig file's scales, shape (n, 2)."""
    loop = rig.stellar_loops[loop_name]
    scale = scales(rig, loop)
    per_px = stack_v_per_px(
        loop.fsm.stack_radius_m, loop.fsm.stack_scale_m_per_v, scale.mirror_px_per_rad
    )
    px_per_v = np.linalg.pinv(per_px)
    times_s = np.arange(0.0, experiment_s(drives), 1 / _SAMPLED_HZ).tolist()
    moved_px = [
        scale.siderostat_turn @ channel_values(drives, SIDEROSTAT, time_s)
        + scale.mirror_turn
        @ (channel_values(drives, FSM, time_s) + px_per_v @ channel_values(drives, STACKS, time_s))
        for time_s in times_s
    ]
    return np.array(moved_px).reshape(-1, 2)


def checked(plan: Plan) -> Callable[[Any, Rig, str], list[str]]:
    """The check of a step whose motions `plan` makes."""

    def check(step: steps.Moving, rig: Rig, loop_name: str) -> list[str]:
        try:
            drives = plan(step, rig, loop_name)
        except IdentifyError as error:
            return [str(error)]
        why_not = refused_drives(rig, loop_name, drives)
        if why_not:
            return [why_not]
        farthest_px = float(np.hypot(*motions_px(rig, loop_name, drives).T).max(initial=0.0))
        return too_far(step, rig, loop_name, farthest_px)

    return check


def open_loop(plan: Plan, name: Callable[[Any], str], evaluate: Callable[..., Result]) -> Behaviour:
    """The behaviour of a step whose motions `plan` makes; `evaluate` is given step, view and motions."""

    def run(step: steps.Moving, view: View) -> None:
        drives = plan(step, view.rig, view.loop_name)
        view.command(Experiment(loop=view.loop_name, name=name(step), drives=drives))

    def done(step: steps.Moving, view: View) -> Result | None:
        if view.mode is Mode.EXPERIMENT:
            view.marks = [view.loop.since_s]  # when the motions began
            return None
        change = view.loop.last_change
        ended_well = view.mode in {Mode.COARSE, Mode.VERNIER}
        drives = plan(step, view.rig, view.loop_name)
        whole = view.elapsed_s >= experiment_s(drives)
        if not (ended_well and whole):
            trigger = Trigger[change.trigger].name.lower().replace("_", " ") if change else ""
            msg = f"the motions ended early, in {view.mode.name}, by {trigger}: {view.loop.why}"
            raise StepFailed(msg)
        return evaluate(step, view, drives)

    def own_s(step: steps.Moving, rig: Rig, loop_name: str) -> float:
        return experiment_s(plan(step, rig, loop_name))

    needs = frozenset({Mode.VERNIER})
    return Behaviour(needs, done, run, _end_motions, checked(plan), own_s)


def _end_motions(step: steps.Moving, view: View) -> None:
    """A loop that searches for the star that it lost may go on; the next attempt waits for it."""
    if view.mode is Mode.EXPERIMENT:
        stop_tracking(step, view)


def watched(view: View, drives: list[Drive]) -> tuple[Floats, Figures]:
    """The frames with a star while the stages moved, as :func:`columns`, and figures of all.

    Raises
    ------
    StepFailed
        If the star was on few of them.
    """
    table = columns(view.measurements)
    during = table[table[:, 0] < view.began_s + experiment_s(drives)]
    with_star = during[np.isfinite(during[:, 1])]
    if (
        len(with_star) == 0
        or len(with_star) < _LEAST_SEEN * experiment_s(drives) * view.rig.camera.frame_rate_hz
    ):
        msg = f"the star was on {len(with_star)} of {len(during)} frames; look at the flux, then try again"
        raise StepFailed(msg)
    swing_px = np.ptp(with_star[:, 1:3], axis=0)
    figures = {
        "seen_fraction": len(with_star) / len(during),
        "swing_az_px": float(swing_px[0]),
        "swing_el_px": float(swing_px[1]),
    }
    return with_star, figures


def _evaluate_motion(
    step: steps.Experiment | steps.Chirp, view: View, drives: list[Drive]
) -> Result:
    _, figures = watched(view, drives)
    recorder = view.telemetry.recorder
    log = ""
    if recorder is not None:
        learn = f"fitctl identify {step.what} --log " if isinstance(step, steps.Experiment) else ""
        log = f"; {learn}{recorder.path}"
    message = (
        f"star swung {figures['swing_az_px']:.2f} px az, {figures['swing_el_px']:.2f} px el{log}"
    )
    return Result(figures, message)


def _experiment_plan(step: steps.Experiment, rig: Rig, loop_name: str) -> list[Drive]:
    plan = EXPERIMENTS[step.what].plan
    assert plan is not None  # noqa: S101  # the step names only those that move the stages
    return plan(rig, loop_name)


def _chirp_plan(step: steps.Chirp, _rig: Rig, _loop_name: str) -> list[Drive]:
    return [
        Drive(
            channel=step.channel,
            shape="sine",
            amplitude=step.amplitude_px,
            frequency_hz=step.from_hz,
            end_frequency_hz=step.to_hz,
            duration_s=step.duration_s,
        )
    ]


OPEN_LOOP = {
    "experiment": open_loop(_experiment_plan, lambda step: step.what, _evaluate_motion),
    "chirp": open_loop(_chirp_plan, lambda _step: "chirp", _evaluate_motion),
}
