"""Figs. 5 and 6: the fast steering mirror's frequency response, as the detector bench measures it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.figures.plate import Comparison, Plate, save
from fitctl.identify.drawing import new_figure
from fitctl.identify.plays import trail
from fitctl.identify.response import AMPLITUDE_RAD, AXES, ResponseResult, analyse, measure
from fitctl.mocks.detector import DetectorBench
from fitctl.model import structure
from fitctl.model.hysteresis import half_widths_v, hysteresis_output, stack_gains
from fitctl.model.optics import mirror_from_stacks, stack_volts

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
FLAT_HZ = 100.0  # the paper sees no resonance below
_FIGURE = {"el": 5, "az": 6}
_IN_WORDS = {"el": "elevation (tip)", "az": "azimuth (tilt)"}


def hysteresis_gain(rig: Rig, loop_name: str, axis: int) -> complex:
    """The plant's stacks under a sine of the bench's amplitude: fundamental of mirror over command."""
    truth, _ = rig.mock_parts()
    fsm, settings = rig.stellar_loops[loop_name].fsm, truth.stellar_loops[loop_name].hysteresis
    half_v, gains = half_widths_v(settings), stack_gains(settings, fsm)
    samples = 4000
    phase = 2 * np.pi * np.arange(2 * samples) / samples
    wanted_rad = np.zeros((len(phase), 2))
    wanted_rad[:, axis] = AMPLITUDE_RAD * np.sin(phase)
    volts = stack_volts(wanted_rad, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v)
    # They came up to the bias from zero; the first swing closes the loop, the second counts.
    from_zero_v = np.vstack([np.full((1, 3), fsm.bias_v), volts])
    displacement_m = hysteresis_output(trail(from_zero_v, half_v), gains)[1 + samples :]
    mirror_rad = mirror_from_stacks(displacement_m, fsm.stack_radius_m)[:, axis]
    fundamental = 2j * np.mean(mirror_rad * np.exp(-1j * phase[samples:]))
    return complex(fundamental / AMPLITUDE_RAD)


def plant_response(rig: Rig, loop_name: str, frequency_hz: Floats) -> Complexes:
    """The plant's own response at the bench's amplitude, shape (n, 2, 2); columns are driven axes."""
    truth, _ = rig.mock_parts()
    modes = structure.frequency_response(truth.stellar_loops[loop_name].structure, frequency_hz)
    return np.asarray(modes * [hysteresis_gain(rig, loop_name, axis) for axis in range(2)])


def figures_5_and_6(rig: Rig, loop_name: str, seed: int, folder: Path) -> list[Plate]:
    """Chirp both axes on the mock bench and compare with the plant."""
    found = analyse(measure(DetectorBench(rig, loop_name, seed)), loop_name)
    truth = plant_response(rig, loop_name, found.frequency_hz)
    return [_plate(rig, loop_name, found, truth, axis, folder) for axis in (1, 0)]


def _plate(
    rig: Rig, loop_name: str, found: ResponseResult, truth: Complexes, axis: int, folder: Path
) -> Plate:
    name = AXES[axis]
    number = _FIGURE[name]
    below = found.frequency_hz <= FLAT_HZ
    excited = np.abs(found.response[:, axis, axis])
    distance_db = 20 * np.log10(excited / np.abs(truth[:, axis, axis]))[below]
    plant, _ = rig.mock_parts()
    true_hz = plant.stellar_loops[loop_name].structure.mode_hz
    rows = [
        Comparison(
            f"largest distance from the plant to {FLAT_HZ:g} Hz, dB",
            None,
            float(np.abs(distance_db).max()),
            "required: 1",
        ),
        Comparison(
            "gain below the modes, dB",
            None,
            float(20 * np.log10(found.fit.gain[axis].value)),
            'in words: "some attenuation", by hysteresis',
        ),
        Comparison(
            f"largest cross-axis motion to {FLAT_HZ:g} Hz, dB",
            None,
            float(20 * np.log10(np.abs(found.response[below, 1 - axis, axis]).max())),
        ),
        Comparison(
            f"least coherence to {FLAT_HZ:g} Hz",
            None,
            float(found.coherence[below, axis, axis].min()),
        ),
        *(
            Comparison(
                f"resonance {i}, Hz",
                None,
                mode.frequency_hz.value,
                f"plant: {hz:g}; {100 * (mode.frequency_hz.value / hz - 1):+.3f} %, required: 1 %; the "
                f"paper: none below {FLAT_HZ:g} Hz",
            )
            for i, (mode, hz) in enumerate(zip(found.fit.modes, true_hz, strict=False), start=1)
        ),
    ]
    stem = f"fig{number:02d}-response-{name}"
    figure = new_figure(7.0, 6.4)
    panels = figure.subplots(3, 1, sharex=True, height_ratios=[2.0, 1.0, 1.0])
    found.draw_axis(panels, axis, truth[:, :, axis], "plant")
    save(figure, folder, stem)
    caption = (
        f"Mirror driven in {_IN_WORDS[name]} by a chirp of ±7.2 arcsec from 0.1 Hz to 1 kHz, both axes "
        f"read on a position-sensing detector at 12.8 kHz. H1 and coherence by Welch's method. Dashed: "
        f"the plant's own response at this amplitude. Flat to {FLAT_HZ:g} Hz, a little attenuated by "
        f"hysteresis; above, two lightly damped modes couple the axes."
    )
    return Plate(stem, f"Fig. {number}: mirror response, {_IN_WORDS[name]}", caption, rows)
