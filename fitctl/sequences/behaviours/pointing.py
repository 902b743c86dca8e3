"""Steps that hold the star and measure how well: hold, and target, jog and raster, which lead it about."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.figures.settling import settling
from fitctl.messages.commands import SetTarget
from fitctl.messages.modes import HOLDING, Mode
from fitctl.model.optics import scales
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import Behaviour, Result, frames_due, too_far
from fitctl.sequences.view import Figures, Squares, StepFailed, View, columns

Floats = NDArray[np.float64]
AXES = ("az", "el")
_LEAST_SEEN = 0.9  # of the frames that were due
_LEAST_SAMPLED = 0.25  # of the frames: a converter may take longer than a frame for its answer
_NEEDS = frozenset({Mode.VERNIER})


class Offset(NamedTuple):
    """A place of the star, from the rig file's target."""

    az_px: float
    el_px: float


# ---------------------------------------------------------------- hold


def _hold_done(step: steps.Hold, view: View) -> Result | None:
    of_beam = view.loop_name in view.rig.metrology_loops
    if view.mode not in HOLDING or view.loop.since_s > view.began_s:
        msg = f"the {'beam' if of_beam else 'star'} was not held all the time: {view.loop.why}"
        raise StepFailed(msg)
    if of_beam:
        return _beam_held(step, view)
    due = frames_due(step.duration_s, view.rig)
    if view.elapsed_s > step.settle_s:
        view.squares.add(columns(view.measurements)[: due - view.squares.frames, 3:5])
    view.measurements.clear()  # hours of them would fill the memory
    if view.elapsed_s < step.settle_s + step.duration_s:
        return None
    return _evaluate(step, view, view.squares, due)


def _beam_held(step: steps.Hold, view: View) -> Result | None:
    """As for a star; a tick without a new sample of the photodiodes has no beam, and does not count."""
    if view.elapsed_s > step.settle_s:
        angles_arcsec = [
            (tick.beam_az_arcsec, tick.beam_el_arcsec)
            for tick in view.telemetry.metrology_ticks
            if tick.loop == view.loop_name and tick.sampled_s >= view.began_s
        ]
        view.squares.add(np.reshape(angles_arcsec, (-1, 2)))
    if view.elapsed_s < step.settle_s + step.duration_s:
        return None
    samples = view.squares.with_star
    if samples < max(1.0, _LEAST_SAMPLED * step.duration_s * view.rig.camera.frame_rate_hz):
        msg = f"the photodiodes gave {samples} samples in {step.duration_s:g} s; see fitctl status"
        raise StepFailed(msg)
    limit_arcsec = view.rig.metrology_loops[view.loop_name].requirement_arcsec
    az_arcsec, el_arcsec = view.squares.rms_px.tolist()  # of what was added: angles
    message = f"az {az_arcsec:.3f}, el {el_arcsec:.3f} arcsec RMS; required {limit_arcsec:g} arcsec"
    if max(az_arcsec, el_arcsec) > limit_arcsec:
        raise StepFailed(message)
    figures = {
        "rms_az_arcsec": az_arcsec,
        "rms_el_arcsec": el_arcsec,
        "limit_arcsec": limit_arcsec,
        "samples": float(samples),
    }
    return Result(figures, message)


def _check_hold(step: steps.Hold, rig: Rig, loop_name: str) -> list[str]:
    if loop_name in rig.metrology_loops and step.rms_limit_px is not None:
        return [
            f"rms_limit_px is for stars; {loop_name} holds a metrology beam, to its requirement_arcsec"
        ]
    return []


def _evaluate(step: steps.Hold | steps.Visiting, view: View, squares: Squares, due: int) -> Result:
    """RMS of each axis against what is required; of `due` frames."""
    if squares.with_star < _LEAST_SEEN * due:
        msg = (
            f"the star was seen on {squares.with_star} of {due} frames; expected at least "
            f"{100 * _LEAST_SEEN:g} %"
        )
        raise StepFailed(msg)
    per_px = scales(view.rig, view.settings).sky_arcsec_per_px
    rms_px = squares.rms_px
    limit_px = step.rms_limit_px or view.settings.requirement_px
    figures: Figures = {}
    for axis, value_px in zip(AXES, rms_px.tolist(), strict=True):
        figures[f"rms_{axis}_px"] = value_px
        figures[f"rms_{axis}_sky_arcsec"] = value_px * per_px
    figures["limit_px"] = limit_px
    figures["frames_seen"] = float(squares.with_star)
    message = f"az {rms_px[0]:.4f}, el {rms_px[1]:.4f} px RMS; required {limit_px:g} px"
    if rms_px.max() > limit_px:
        raise StepFailed(message)
    return Result(figures, message)


def _hold_s(step: steps.Hold, _rig: Rig, _loop_name: str) -> float:
    return step.settle_s + step.duration_s


# ---------------------------------------------------------------- from place to place


def places(step: steps.Visiting) -> list[Offset]:
    """Where the star is led, in order."""
    match step:
        case steps.Offset():
            return [Offset(step.offset_az_px, step.offset_el_px)]
        case steps.Dither():
            there = step.dither_px
            return [Offset(there, there), Offset(-there, -there), Offset(0.0, 0.0)]
        case steps.Raster():
            return [*_grid(step), Offset(0.0, 0.0)]
    msg = f"{step.step} leads the star nowhere"
    raise TypeError(msg)


def _grid(step: steps.Raster) -> list[Offset]:
    az_px = [(column - (step.columns - 1) / 2) * step.spacing_px for column in range(step.columns)]
    el_px = [(row - (step.rows - 1) / 2) * step.spacing_px for row in range(step.rows)]
    return [
        Offset(az, el)
        for row, el in enumerate(el_px)
        for az in (az_px if row % 2 == 0 else reversed(az_px))
    ]


def _check_visit(step: steps.Visiting, rig: Rig, loop_name: str) -> list[str]:
    target, offsets = rig.stellar_loops[loop_name].target_px, places(step)
    problems = too_far(step, rig, loop_name, max(math.hypot(*offset) for offset in offsets))
    places_px = [(target.az + offset.az_px, target.el + offset.el_px) for offset in offsets]
    off_px = next((place for place in places_px if not rig.camera.window_fits(*place)), None)
    if off_px is not None:
        problems.append(f"a place is off the frame: the star {rig.camera.no_window_text(*off_px)}")
    if step.steady_after_s >= step.dwell_s:
        problems.append(f"steady_after_s must be below dwell_s, {step.dwell_s:g} s")
    return problems


def _visit_s(step: steps.Visiting, _rig: Rig, _loop_name: str) -> float:
    return step.dwell_s * len(places(step))


def _go(view: View, offset: Offset) -> None:
    target = view.settings.target_px
    view.command(
        SetTarget(
            loop=view.loop_name, az_px=target.az + offset.az_px, el_px=target.el + offset.el_px
        )
    )
    view.marks.append(view.fresh_s)


def _run_visit(step: steps.Visiting, view: View) -> None:
    _go(view, places(step)[0])


def _visit_done(step: steps.Visiting, view: View) -> Result | None:
    view.require_mode(Mode.VERNIER, Mode.COARSE)  # a long way leads through COARSE
    if view.now_s - view.marks[-1] < step.dwell_s:
        return None
    offsets = places(step)
    if len(view.marks) < len(offsets):
        _go(view, offsets[len(view.marks)])
        return None
    return _evaluate_visits(step, view, offsets)


def _evaluate_visits(step: steps.Visiting, view: View, offsets: list[Offset]) -> Result:
    """Settling after each move; RMS about the places where each has died away."""
    table, target = columns(view.measurements), view.settings.target_px
    time_s, star_px = table[:, 0], table[:, 1:3]
    limit_px = step.rms_limit_px or view.settings.requirement_px
    settled_s, overshoot_px, steady = [0.0], [0.0], []
    due_each = frames_due(step.dwell_s - step.steady_after_s, view.rig)
    for came_s, offset in zip(view.marks, offsets, strict=True):
        there = (time_s >= came_s) & (time_s < came_s + step.dwell_s)
        away_px = star_px[there] - (target.az + offset.az_px, target.el + offset.el_px)
        for axis in range(2):
            # Three times the RMS that is required: a single frame may be farther off than that.
            found = settling(time_s[there], away_px[:, axis], came_s, 3 * limit_px)
            settled_s.append(found.settled_s)
            overshoot_px.append(found.overshoot_px)
        steady.append(away_px[time_s[there] >= came_s + step.steady_after_s])
    view.squares.add(np.concatenate(steady))
    held = _evaluate(step, view, view.squares, due_each * len(offsets))
    figures = held.figures | {
        "settled_s": float(np.max(settled_s)),
        "overshoot_px": float(np.max(overshoot_px)),
    }
    return Result(figures, f"settled in {figures['settled_s']:.1f} s; {held.message}")


def stop_visit(_step: steps.Step, view: View) -> None:
    """Send the star back to the rig file's target."""
    target = view.settings.target_px
    view.ask(SetTarget(loop=view.loop_name, az_px=target.az, el_px=target.el))


_VISIT = Behaviour(_NEEDS, _visit_done, _run_visit, stop_visit, _check_visit, _visit_s)
POINTING = {
    "hold": Behaviour(
        HOLDING, _hold_done, check=_check_hold, own_s=_hold_s, pausable=True, of_beams=True
    ),
    "offset": _VISIT,
    "dither": _VISIT,
    "raster": _VISIT,
}
