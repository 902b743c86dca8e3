"""The step that measures the tilt between two stars, and the fringe visibility that it leaves."""

from __future__ import annotations

import numpy as np

from fitctl.config import Rig
from fitctl.messages.modes import Mode
from fitctl.sequences import steps
from fitctl.sequences.behaviour import POWERED, Behaviour, Result
from fitctl.sequences.view import StepFailed, View

_LEAST_HELD = 0.9  # of the frames that were due


def _done(step: steps.Visibility, view: View) -> Result | None:
    view.measurements.clear()  # those of one star, which nothing evaluates here
    if view.elapsed_s > step.settle_s:
        due = round(step.duration_s * view.rig.camera.frame_rate_hz) - view.squares.frames
        newest = [one for one in view.telemetry.overlaps if one.time_s >= view.began_s][:due]
        tilts_arcsec = [(one.tilt_az_arcsec, one.tilt_el_arcsec) for one in newest]
        view.squares.add(np.reshape(tilts_arcsec, (-1, 2)))
        view.marks += [one.visibility for one in newest]
    if view.elapsed_s < step.settle_s + step.duration_s:
        return None
    due = round(step.duration_s * view.rig.camera.frame_rate_hz)
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


def _check(_step: steps.Visibility, rig: Rig, _loop_name: str) -> list[str]:
    if rig.fringes is None:
        return [f"rig {rig.name} has no section fringes, which names the two stars"]
    return []


def _own_s(step: steps.Visibility, _rig: Rig, _loop_name: str) -> float:
    return step.settle_s + step.duration_s


VISIBILITY = {
    "visibility": Behaviour(
        POWERED - {Mode.STANDBY},
        _done,
        check=_check,
        own_s=_own_s,
        pausable=True,
        loops="none",
        of_beams=True,
    )
}
