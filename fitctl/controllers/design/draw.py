"""Fig. 9: loop shapes of coarse and vernier, and what they leave of a disturbance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.loopshape import Response, coarse_response, delayed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FREQUENCY_HZ = np.geomspace(1e-3, 25.0, 1500)


def draw_loop_shapes(basis: Basis, vernier: Response, title: str) -> Figure:
    """Gain, phase and sensitivity of the loop of Eq. 16, over frequency."""
    from matplotlib.figure import Figure

    omega = 2 * math.pi * _FREQUENCY_HZ
    loops = {
        "coarse": delayed(basis, coarse_response(basis))(omega),
        "vernier": delayed(basis, vernier)(omega),
        "both": delayed(basis, coarse_response(basis), vernier)(omega),
    }
    figure = Figure(figsize=(7, 8), layout="constrained")
    gain, phase, left = figure.subplots(3, 1, sharex=True)
    styles = {"coarse": "--", "vernier": "-.", "both": "-"}
    for name, loop in loops.items():
        gain.semilogx(_FREQUENCY_HZ, 20 * np.log10(np.abs(loop)), styles[name], label=name)
        degrees = np.degrees(np.unwrap(np.angle(loop)))
        phase.semilogx(_FREQUENCY_HZ, degrees, styles[name], label=name)
    gain.axhline(0.0, color="0.5", linewidth=0.8)
    phase.axhline(-180.0, color="0.5", linewidth=0.8)
    left.semilogx(_FREQUENCY_HZ, -20 * np.log10(np.abs(1 + loops["both"])), "C2", label="both")
    left.axhline(0.0, color="0.5", linewidth=0.8)
    gain.set(ylabel="loop gain (dB)", title=title, ylim=(-40, 60))
    phase.set(ylabel="loop phase (deg)", ylim=(-540, 45), yticks=range(-540, 1, 90))
    left.set(ylabel="error / disturbance (dB)", xlabel="frequency (Hz)", ylim=(-50, 15))
    for axes in (gain, phase, left):
        axes.grid(visible=True, which="both", alpha=0.3)
        axes.legend(loc="lower left")
    return figure
