"""Fig. 3: a stack's hysteresis loops, and the model of Eq. 6 that was read from one ramp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lti, step

from fitctl.config import Rig
from fitctl.figures.plate import Comparison, Plate, save
from fitctl.identify.drawing import BLACK, GREEN, ORANGE, new_figure
from fitctl.identify.plays import ELEMENTS, model_from_ramp, trail
from fitctl.model.hysteresis import (
    half_widths_v,
    hysteresis_output,
    stack_gains,
    swept_loop_width,
    swept_stroke,
)

Floats = NDArray[np.float64]
SAMPLE_HZ = 5.0  # of the paper's readings
RESOLUTION_M = 10e-9  # of its interferometer
_RAMP_S = 100.0
# The paper's step is not described but for its being underdamped; these leave a dozen shrinking loops.
_STEP_HZ, _STEP_DAMPING, _STEP_S = 0.05, 0.03, 180.0


def underdamped_step_v(time_s: Floats, full_scale_v: float) -> Floats:
    """Second-order step response to mid scale, shape as `time_s`; it overshoots nearly to full scale."""
    omega = 2 * np.pi * _STEP_HZ
    system = lti([omega**2], [1.0, 2 * _STEP_DAMPING * omega, omega**2])
    _, response = step(system, T=time_s)
    return np.asarray(response * full_scale_v / 2)


def interferometer_m(displacement_m: Floats) -> Floats:
    """What the interferometer reads: whole steps of its resolution."""
    return np.rint(displacement_m / RESOLUTION_M) * RESOLUTION_M


def figure_3(rig: Rig, loop_name: str, _seed: int, folder: Path) -> list[Plate]:
    """Read one ramp of a stack, make the model, and meet an underdamped step with both."""
    truth, _ = rig.mock_parts()
    fsm, settings = rig.stellar_loops[loop_name].fsm, truth.stellar_loops[loop_name].hysteresis
    full_scale_v = fsm.dac.full_scale_v
    half_v, gains = half_widths_v(settings), stack_gains(settings, fsm)

    def read_m(volts: Floats) -> Floats:
        plays_v = trail(volts[:, None], half_v)[:, 0]
        return interferometer_m(hysteresis_output(plays_v, gains))

    ramp_v = np.linspace(0.0, full_scale_v, round(_RAMP_S * SAMPLE_HZ) + 1)
    model_half_v, model_gains = model_from_ramp(ramp_v, read_m(ramp_v))
    time_s = np.arange(round(_STEP_S * SAMPLE_HZ)) / SAMPLE_HZ
    volts = underdamped_step_v(time_s, full_scale_v)
    measured_m = read_m(volts)
    plays_v = trail(volts[:, None], model_half_v)[:, 0]
    modelled_m = hysteresis_output(plays_v, model_gains)
    stroke_m = swept_stroke(half_v, gains, full_scale_v)
    width_m = swept_loop_width(half_v, gains, full_scale_v)
    error = float(np.sqrt(np.mean((modelled_m - measured_m) ** 2))) / stroke_m
    _draw(time_s, volts, measured_m, modelled_m, folder)
    caption = (
        f"One stack under the step response of an underdamped second-order system, read "
        f"{SAMPLE_HZ:g} times a second to {RESOLUTION_M * 1e9:g} nm. Points: the plant's stack. Line: "
        f"{ELEMENTS} parallel plays by Eq. 6, from one full-scale ramp of the relaxed stack and from "
        f"nothing else. The loops shrink and flatten as the swing decays. Below: what the model leaves."
    )
    rows = [
        Comparison("elements of the model", 13, ELEMENTS),
        Comparison(
            "stroke of a full sweep, um",
            8.0,
            stroke_m * 1e6,
            "the paper's is nominal; ours is the maker's full stroke, so that the slope at the bias is "
            "near SF_PZT",
        ),
        Comparison("loop width, % of stroke", None, 100 * width_m / stroke_m),
        Comparison(
            "RMS model error, % of stroke",
            None,
            100 * error,
            'in words: "accurately reproduce"; required of ours: 0.5',
        ),
    ]
    return [Plate("fig03-hysteresis", "Fig. 3: hysteresis of a stack", caption, rows)]


def _draw(
    time_s: Floats, volts: Floats, measured_m: Floats, modelled_m: Floats, folder: Path
) -> None:
    figure = new_figure(7.0, 6.4)
    loops, command, left = figure.subplot_mosaic(
        [["loops", "loops"], ["command", "left"]], height_ratios=[2.2, 1.0]
    ).values()
    loops.plot(
        volts, measured_m * 1e6, ".", color=ORANGE, markersize=3.5, label="stack, 5 Hz readings"
    )
    loops.plot(volts, modelled_m * 1e6, color=BLACK, linewidth=0.8, label="13 plays, Eq. 6")
    loops.set(xlabel="D/A voltage (V)", ylabel="displacement (µm)")
    loops.legend(loc="upper left", markerscale=2)
    command.plot(time_s, volts, color=BLACK, linewidth=0.8)
    command.set(xlabel="time (s)", ylabel="D/A voltage (V)")
    left.plot(time_s, (modelled_m - measured_m) * 1e9, color=GREEN, linewidth=0.7)
    left.set(xlabel="time (s)", ylabel="model less stack (nm)")
    for axes in (loops, command, left):
        axes.grid(alpha=0.3)
    save(figure, folder, "fig03-hysteresis")
