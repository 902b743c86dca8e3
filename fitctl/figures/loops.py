"""Fig. 9: the loop shapes of coarse and vernier, and what they leave of a disturbance."""

from __future__ import annotations

import math
from pathlib import Path

from fitctl.config import Rig
from fitctl.controllers.design import lqg_ltr
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.draw import draw_loop_shapes
from fitctl.controllers.design.eq20 import eq20_zpk
from fitctl.controllers.design.linear_loop.loopshape import (
    coarse_response,
    compensator_response,
    delayed,
    loop_shape,
)
from fitctl.figures.plate import Comparison, Plate, save

_HIGHEST_HZ = 50.0


def figure_9(rig: Rig, loop_name: str, _seed: int, folder: Path) -> list[Plate]:
    """Eq. 16 with the printed Eq. 20, its margins, and those of the loop designed anew."""
    its_basis = basis(rig, loop_name)
    vernier = compensator_response(*eq20_zpk())
    shape = loop_shape(delayed(its_basis, coarse_response(its_basis), vernier), _HIGHEST_HZ)
    anew = lqg_ltr.vernier_compensator(its_basis)
    distance_db, distance_deg = lqg_ltr.distance_from_eq20(anew)
    figure = draw_loop_shapes(
        its_basis, vernier, "Loop shapes of coarse and vernier, Eq. 16 and 20"
    )
    save(figure, folder, "fig09-loops")
    rows = [
        Comparison(
            "crossover (not bandwidth), Hz",
            None,
            shape.crossover_hz,
            'from Eq. 16 and 20; the paper\'s text has a bandwidth of "~ 5.0 Hz", without a definition',
        ),
        Comparison(
            "attenuation at 1 Hz",
            10.0,
            shape.attenuation[1.0],
            "the paper's text; ours follows from its own Eq. 16 and 20",
        ),
        Comparison("phase margin, deg", None, shape.phase_margin_deg),
        Comparison("gain margin, dB", None, shape.gain_margin_db),
        Comparison("peak sensitivity", None, shape.peak_sensitivity),
        *(
            Comparison(f"attenuation at {hz:g} Hz", None, shape.attenuation[hz])
            for hz in (0.1, 0.5, 2.0)
        ),
        Comparison(
            "coarse crossover, Hz", None, its_basis.coarse_per_s / (2 * math.pi),
            "from the printed gain, 3227",
        ),
        Comparison("LQG/LTR anew: gain of Eq. 20", 18.3, anew.gain),
        Comparison("LQG/LTR anew: distance from Eq. 20, dB", None, distance_db, "required: 0.5"),
        Comparison("LQG/LTR anew: distance from Eq. 20, deg", None, distance_deg, "required: 2"),
    ]  # fmt: skip
    caption = (
        f"Gain and phase of the coarse integrator, of the vernier compensator as Eq. 20 prints it, and of "
        f"both behind a delay of {its_basis.delay_s * 1e3:g} ms (Eq. 16); below, what the loop leaves of a "
        "disturbance."
    )
    return [Plate("fig09-loops", "Fig. 9: loop shapes", caption, rows)]
