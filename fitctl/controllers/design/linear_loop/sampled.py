"""One axis of the loop from frame to frame, linear and exact: what a design meets.

A frame exposed at k T leads to a command at k T + delay; the mirror holds it for one period T, or holds each of
several writes for its part of T, and the siderostat walks there in a straight line (its 45 Hz servo is left
out: it lags a walk of at most a few hundredths of a pixel per second). The delay may be any fraction of a
period.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.pair import Design, mirror_outputs

Floats = NDArray[np.float64]
_ROUNDING = 1e-9


class Timing(NamedTuple):
    """How a delay falls into frames.

    Attributes
    ----------
    frames : int
        At mid-exposure of frame k the mirror holds what came of frame k - frames: 2 on FIT.
    walked : float
        And the siderostat has walked this part of what came of the same frame: 0.25 on FIT.
    """

    frames: int
    walked: float


def timing(period_s: float, delay_s: float) -> Timing:
    """How `delay_s` falls into frames."""
    frames = max(1, math.ceil(delay_s / period_s - _ROUNDING))
    return Timing(frames, frames - delay_s / period_s)


def write_at_exposure(design: Design, walked: float) -> int:
    """Which of a design's outputs the mirror holds at mid-exposure; the siderostat has then `walked` so far."""
    write = max(0, math.ceil(walked * design.writes - _ROUNDING) - 1)
    return mirror_outputs(design.writes)[write]


class SampledLoop(NamedTuple):
    """A design on its stages, opened at the camera: x+ = a x + b error.

    Attributes
    ----------
    a, b : arrays, shapes (n, n), (n,)
    star : array, shape (n,)
        The star's motion by both stages at mid-exposure is ``star @ x``.
    command, command_error : arrays, shapes (outputs, n), (outputs,)
        The pair's outputs are ``command @ x + command_error * error``.
    motor_held : array, shape (n,)
        Where the siderostat is when that command begins.
    """

    a: Floats
    b: Floats
    star: Floats
    command: Floats
    command_error: Floats
    motor_held: Floats

    @property
    def stable(self) -> bool:
        """Closed at the camera, every course of it dies away."""
        closed = self.a + np.outer(self.b, self.star)
        return bool(np.abs(np.linalg.eigvals(closed)).max() < 1.0)


def sampled_loop(design: Design, basis: Basis) -> SampledLoop:
    """A design, which may have been made for another delay, on the stages of a loop."""
    frames, walked = timing(basis.period_s, basis.delay_s)
    # The stages' memory: mirror commands 1 to `frames` frames old, siderostat positions 0 to `frames`, and the
    # mirror's command before its last.
    size = 2 * frames + 2
    newest_motor = frames
    advance = np.zeros((size, size))
    advance[1:frames, : frames - 1] = np.eye(frames - 1)
    advance[newest_motor, newest_motor] = 1.0
    advance[newest_motor + 1 : -1, newest_motor:-2] = np.eye(frames)
    advance[-1, frames - 1] = 1.0
    drive = np.zeros((size, len(design.d)))
    drive[0, write_at_exposure(design, walked)] = drive[newest_motor, 1] = 1.0
    mirror, motor = np.zeros(size), np.zeros(size)
    mirror[frames - 1] = 1.0
    motor[-2], motor[-3] = 1.0 - walked, walked
    moved = (basis.mirror_gain + basis.overshoot) * mirror
    moved[-1] = -basis.overshoot
    # Within the design: its inputs are the error, and what the stages had done (see `Design`).
    from_stages = np.zeros((5, size))
    from_stages[2], from_stages[3] = mirror, motor
    command = np.hstack([design.d @ from_stages, design.c])
    command_error = design.d[:, 0]
    n = len(design.a)
    a = np.zeros((size + n, size + n))  # by numpy alone: a supervisor imports no scipy
    a[:size, :size], a[size:, size:] = advance, design.a
    a[:size] += drive @ command
    a[size:, :size] = design.b @ from_stages
    return SampledLoop(
        a=a,
        b=np.concatenate([drive @ command_error, design.b[:, 0]]),
        star=np.concatenate([moved + motor, np.zeros(n)]),
        command=command,
        command_error=command_error,
        motor_held=np.eye(size + n)[newest_motor],
    )
