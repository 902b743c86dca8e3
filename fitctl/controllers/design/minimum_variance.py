"""The pair that comes closest to the bound: the mirror undoes what is expected, on the mean of its hold.

Literature: Kulcsar, Raynaud et al., Optics Express 14, 7464 (2006), minimum variance for tip-tilt;
Marquis et al., JOSA A (2024), fractional loop delays.
"""

from __future__ import annotations

import numpy as np

from fitctl.controllers.design.basis import Basis, design_parameters
from fitctl.controllers.design.linear_loop.disturbance import disturbance, hold, holds
from fitctl.controllers.design.predictor import Gains, predicting_design, star_filter
from fitctl.controllers.pair import Design


def design_minimum_variance(basis: Basis) -> Design:
    """Kalman filter, prediction to the mean over the hold, and a siderostat that relieves the mirror.

    The mirror u brings to zero, on the mean of the hold, what is expected of the star and of the
    siderostat, which is then half-way through its step s. The siderostat takes over what the mirror
    holds, s = offload T u. With more writes than one, each does so on the mean of its part of the hold.
    """
    settings = basis.settings.minimum_variance
    moving, writes = disturbance(basis), basis.writes
    acts = hold(moving, basis.period_s, basis.delay_s)
    expected = np.append(acts.weight @ acts.star, 1.0)
    part = settings.offload_per_s * basis.period_s
    # u + (star + motor + s / 2) = 0 and s = part u, for the mean of the hold.
    outputs = np.array([1.0, part]) / (1.0 + part / 2)
    star, motor = -np.outer(outputs, expected), -outputs
    if writes > 1:
        # Each write for the mean of its own part of the hold, where the siderostat has walked so far.
        parts = holds(moving, writes, basis.period_s, basis.delay_s)
        own = np.array([np.append(one.weight @ one.star, 1.0) for one in parts])
        walked = (np.arange(writes) + 0.5) / writes - 0.5
        each_star = star[0] - (own - expected) - np.outer(walked, star[1])
        each_motor = motor[0] - walked * motor[1]
        star = np.vstack([each_star[0], star[1], each_star[1:]])
        motor = np.concatenate([[each_motor[0], motor[1]], each_motor[1:]])
    gains = Gains(
        star=star,
        motor=motor,
        memory=np.zeros((len(star), 0)),
        keep=np.zeros((0, 0)),
        drive=np.zeros((0, 2)),
    )
    return predicting_design(
        "minimum-variance",
        basis,
        star_filter(basis, settings.drift_px_per_sqrt_s),
        gains,
        design_parameters(basis, "minimum_variance"),
    )
