"""How a design stands in its loop, beside others and beside the bound."""

from __future__ import annotations

import math
from typing import NamedTuple

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.loopshape import LoopShape, loop_shape, sampled_response
from fitctl.controllers.pair import Design


class Standing(NamedTuple):
    """One design in its loop.

    Attributes
    ----------
    name : str
    order : int
        States of one axis.
    shape : LoopShape
        Sampled, with hold and delay.
    residual_px : float
        RMS left of the air path, linear, in continuous time; infinite if unstable.
    ratio_to_bound : float
    """

    name: str
    order: int
    shape: LoopShape
    residual_px: float
    ratio_to_bound: float


def standing(design: Design, basis: Basis) -> Standing:
    """How a design stands."""
    residual_px = linear_residual(design, basis)
    return Standing(
        name=design.name,
        order=len(design.a),
        shape=loop_shape(
            sampled_response(design, basis),
            0.5 / basis.period_s,
            stable=math.isfinite(residual_px),
        ),
        residual_px=residual_px,
        ratio_to_bound=residual_px / bound(basis).residual_px,
    )
