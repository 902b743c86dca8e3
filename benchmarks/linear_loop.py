"""A night that is known exactly, held by a design on stages that do exactly as commanded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.disturbance import disturbance
from fitctl.controllers.design.linear_loop.sampled import sampled_loop, timing
from fitctl.controllers.pair import Design
from fitctl.learn.opened import Series

Floats = NDArray[np.float64]
AXES = 2


def course_px(truth: Basis, frames: int, seed: int) -> Floats:
    """The star's own motion, shape (frames, axes), stationary from the first frame."""
    random = np.random.default_rng(seed)
    moving = disturbance(truth)
    transition, covariance = moving.over(truth.period_s)
    states = random.standard_normal((AXES, len(transition))) @ _root(moving.covariance).T
    new = random.standard_normal((frames, AXES, len(transition))) @ _root(covariance).T
    px = np.empty((frames, AXES))
    for frame in range(frames):
        px[frame] = states @ moving.seen
        states = states @ transition.T + new[frame]
    return px


def _root(covariance: Floats) -> Floats:
    """A matrix R with R R' = covariance, which may be singular."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def held(
    truth: Basis,
    design: Design,
    seconds: float,
    seed: int,
    *,
    mirror_gain: float = 1.0,
    overshoot: float = 0.0,
    star_px: Floats | None = None,
) -> tuple[Floats, Series]:
    """Error on frames, shape (frames, axes), and the loop as its own records open it.

    The mirror moves by `mirror_gain` times what the loop believes; it is beyond its last step by `overshoot` of
    that step.
    """
    random = np.random.default_rng([seed, 1])
    if star_px is None:
        star_px = course_px(truth, round(seconds / truth.period_s), seed)
    seen_px = star_px + truth.noise_px * random.standard_normal(star_px.shape)
    loop, (behind, walked) = sampled_loop(design, truth), timing(truth.period_s, truth.delay_s)
    mirror, motor = np.zeros(len(loop.a)), np.zeros(len(loop.a))
    mirror[behind - 1] = 1.0
    motor[2 * behind], motor[2 * behind - 1] = 1.0 - walked, walked
    states = np.zeros((len(loop.a), AXES))
    error_px, mirror_px, motor_px = (np.empty_like(star_px) for _ in range(3))
    for frame, seen in enumerate(seen_px):
        mirror_px[frame], motor_px[frame] = mirror @ states, motor @ states
        step_px = mirror_px[frame] - mirror_px[max(frame - 1, 0)]
        moved_px = mirror_gain * mirror_px[frame] + overshoot * step_px
        error_px[frame] = seen + moved_px + motor_px[frame]
        states = loop.a @ states + np.outer(loop.b, error_px[frame])
    return error_px, Series(error_px - mirror_px - motor_px, mirror_px)
