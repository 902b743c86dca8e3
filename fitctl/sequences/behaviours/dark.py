"""Dark frames: the camera's bias and noise, pixel by pixel, from frames without light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.logging.records import FrameRecord
from fitctl.messages.modes import Mode
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import Behaviour, Calibration, Result
from fitctl.sequences.view import Figures, StepFailed, View

Floats = NDArray[np.float64]
_BRIGHT_NOISES = 5.0  # above the bias, and a pixel is bright
_MOST_NAMED = 20  # bad pixels that are named
_ROUNDING_DN = 0.29  # what whole numbers have at least: a step over the root of twelve
_NOISE_RANGE = (1 / 3, 3.0)  # of the median: a pixel that is stuck, or restless, is bad


def stack_of(frames: list[FrameRecord]) -> Floats:
    """Frames as an array, shape (n, rows, columns)."""
    return np.array(
        [
            np.frombuffer(frame.data, "<u2").reshape(frame.height_px, frame.width_px)
            for frame in frames
        ],
        dtype=np.float64,
    )


def measure_dark(stack: Floats) -> Figures:
    """Bias and noise of dark frames, shape (n, rows, columns), n at least 2.

    Medians over the pixels, so that a few bright ones do not move them. ``fixed_pattern_dn`` is by how much
    pixels differ from each other beyond what their noise explains.
    """
    mean_dn, noise_dn = stack.mean(axis=0), stack.std(axis=0, ddof=1)
    bias_dn, noise = float(np.median(mean_dn)), float(np.median(noise_dn))
    # 1.4826 times the median of the distances is the standard deviation, of all but the bright pixels.
    spread_dn = 1.4826 * float(np.median(np.abs(mean_dn - bias_dn)))
    return {
        "bias_dn": bias_dn,
        "noise_dn": noise,
        "fixed_pattern_dn": float(np.sqrt(max(0.0, spread_dn**2 - noise**2 / len(stack)))),
        "bright_pixels": float(np.count_nonzero(mean_dn > bias_dn + _BRIGHT_NOISES * noise)),
        "brightest_dn": float(mean_dn.max() - bias_dn),
    }


def dark_frame(stack: Floats) -> Floats:
    """What each pixel reads without light, shape (rows, columns), from dark frames; NaN where it is bad.

    Bad is a pixel with much more noise than the others, or much less, as one that is stuck or saturated. One
    that is only bright is good: what it reads too much is subtracted, which is better than to guess it from
    its neighbours.
    """
    noise_dn = stack.std(axis=0, ddof=1)
    low, high = (part * np.median(noise_dn) for part in _NOISE_RANGE)
    return np.where((noise_dn < low) | (noise_dn > high), np.nan, stack.mean(axis=0))


def _calibration(rig: Rig, figures: Figures, dark_dn: Floats, message: str) -> Calibration:
    name = f"{rig.name}-dark.npy"
    camera = {
        "bias_dn": round(figures["bias_dn"], 2),
        "pixel_noise_dn": max(_ROUNDING_DN, round(figures["noise_dn"], 2)),
        "dark_file": name,
    }
    bad = [f"az {column}, el {row}" for row, column in np.argwhere(np.isnan(dark_dn))]
    more = f"; and {len(bad) - _MOST_NAMED} more" if len(bad) > _MOST_NAMED else ""
    named = "; ".join(bad[:_MOST_NAMED]) or "none"
    lines = [message, f"bad pixels, which are filled in from their neighbours: {named}{more}"]
    return Calibration("dark", lines, {"camera": camera}, {name: dark_dn.astype(np.float32)})


def _done(step: steps.Dark, view: View) -> Result | None:
    view.require_mode(Mode.STANDBY)
    if any(np.isfinite(one.star_az_px) for one in view.measurements):
        msg = "a star is on the frame; close the shutter or point elsewhere, then try again"
        raise StepFailed(msg)
    view.measurements.clear()
    newest = view.telemetry.frame
    if newest is not None and newest.time_s >= view.began_s and newest not in view.frames[-1:]:
        view.frames.append(newest)
    if len(view.frames) < step.frames:
        return None
    stack, camera = stack_of(view.frames), view.rig.camera
    figures = measure_dark(stack)
    message = (
        f"bias {figures['bias_dn']:.1f} DN (rig file {camera.bias_dn:g}), noise {figures['noise_dn']:.1f} DN "
        f"(rig file {camera.pixel_noise_dn:g}), {figures['bright_pixels']:.0f} bright pixels"
    )
    if figures["bright_pixels"] > step.max_bright_pixels:
        msg = f"{message}; max_bright_pixels is {step.max_bright_pixels}: is there light?"
        raise StepFailed(msg)
    return Result(figures, message, _calibration(view.rig, figures, dark_frame(stack), message))


def _own_s(step: steps.Dark, rig: Rig, _loop_name: str) -> float:
    # Telemetry has its newest frame only.
    return step.frames / min(rig.supervisor.telemetry_hz, rig.camera.frame_rate_hz)


DARK = {"dark": Behaviour(frozenset({Mode.STANDBY}), _done, own_s=_own_s)}
