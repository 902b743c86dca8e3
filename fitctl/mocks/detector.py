"""The optical bench of Figs. 5-6: signal generator on the D/A, mirror, position-sensing detector.

Known limitations
-----------------
- Data in, data out: no wire, no real time. A measurement of any length returns at once.
- Stacks are static (hysteresis only), as in the plant; their own resonances, at several kHz, are left out.
- The detector is linear to its ends and as quick as it is sampled; laser and room are still.

Invented constants
------------------
The detector's noise, 1 mV RMS a sample; 16 bits over its +-10 V; samples taken half-way between two
updates of the D/A.
"""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, ss2tf

from fitctl.config import Rig
from fitctl.model import hysteresis, structure
from fitctl.model.detector import DETECTOR_RANGE_V, SAMPLE_RATE_HZ, detector_volts
from fitctl.model.optics import mirror_from_stacks, stack_volts

Floats = NDArray[np.float64]

NOISE_V = 1e-3
ADC_BITS = 16


class DetectorBench:
    """One loop's mirror on the bench.

    Parameters
    ----------
    rig : Rig
        Must have its ``plant`` section.
    loop_name : str
    seed : int
        Of the detector's noise.
    """

    def __init__(self, rig: Rig, loop_name: str, seed: int = 0) -> None:
        truth, _ = rig.mock_parts()
        self._fsm = rig.stellar_loops[loop_name].fsm
        self._plant = truth.stellar_loops[loop_name]
        self._gains = hysteresis.stack_gains(self._plant.hysteresis, self._fsm)
        self._half_v = hysteresis.half_widths_v(self._plant.hysteresis)
        # The stacks came up from zero to their bias, as the plant's.
        self._plays_v = hysteresis.play(
            np.zeros((3, len(self._half_v))), np.array(self._fsm.bias_v), self._half_v
        )
        self._rest_m = self._plays_v[0] @ self._gains
        self._random = np.random.default_rng(seed)

    def measure(self, axis: Literal["az", "el"], drive_rad: Floats) -> Floats:
        """Inject a motion of one axis and read the detector.

        Parameters
        ----------
        axis : str
        drive_rad : array, shape (n,)
            Wanted mirror angles at 12.8 kHz, sent to the stacks by Eq. 1.

        Returns
        -------
        array, shape (n, 2)
            Detector volts (az, el) at the same rate.
        """
        wanted_rad = np.zeros((len(drive_rad), 2))
        wanted_rad[:, ("az", "el").index(axis)] = drive_rad
        displacement_m = self._displacements_m(self._dac_volts(wanted_rad))
        mirror_rad = mirror_from_stacks(displacement_m - self._rest_m, self._fsm.stack_radius_m)
        volts = detector_volts(self._shaken(mirror_rad))
        volts += NOISE_V * self._random.standard_normal(volts.shape)
        step_v = 2 * DETECTOR_RANGE_V / 2**ADC_BITS
        return np.clip(np.rint(volts / step_v) * step_v, -DETECTOR_RANGE_V, DETECTOR_RANGE_V)

    def _dac_volts(self, wanted_rad: Floats) -> Floats:
        fsm = self._fsm
        volts = stack_volts(wanted_rad, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v)
        step_v = fsm.dac.full_scale_v / 2**fsm.dac.bits
        return np.clip(np.rint(volts / step_v) * step_v, 0.0, fsm.dac.full_scale_v)

    def _displacements_m(self, volts: Floats) -> Floats:
        """Stacks through their hysteresis, shape (n, 3).

        One stretch at a time in which a stack only rises or only falls: a play then needs to know no
        more than where it was when the stretch began.
        """
        displacement_m = np.empty_like(volts)
        for stack in range(3):
            plays_v = self._plays_v[stack]
            for stretch in _monotone_stretches(volts[:, stack]):
                followed = hysteresis.play(plays_v, volts[stretch, stack, None], self._half_v)
                displacement_m[stretch, stack] = hysteresis.hysteresis_output(followed, self._gains)
                plays_v = followed[-1]
            self._plays_v[stack] = plays_v
        return displacement_m

    def _shaken(self, mirror_rad: Floats) -> Floats:
        """Mirror through its mount's modes, shape (n, 2), seen half-way between commands."""
        settings = self._plant.structure
        transitions, gains = structure.mode_matrices(settings, 0.5 / SAMPLE_RATE_HZ)
        moving_rad = (1 - settings.participation) * mirror_rad
        for shape, transition, gain in zip(
            structure.mode_shapes(settings), transitions, gains, strict=True
        ):
            numerator, denominator = ss2tf(transition, gain[:, None], [[1.0, 0.0]], [[0.0]])
            held = np.repeat(mirror_rad @ shape, 2)
            # The state after the first half of each period: one half step after its command began.
            position = lfilter(numerator[0, 1:], denominator, held)[::2]
            moving_rad = moving_rad + settings.participation * position[:, None] * shape
        return moving_rad


def _monotone_stretches(volts: Floats) -> list[slice]:
    """Cuts after the first sample, which may come from anywhere, and wherever the signal turns back.

    A standstill goes on as the motion before it.
    """
    direction = np.sign(np.diff(volts))
    moving = np.flatnonzero(direction)
    turns = moving[1:][np.diff(direction[moving]) != 0]
    edges = [0, 1, *(turns + 1).tolist(), len(volts)]
    return [slice(start, end) for start, end in itertools.pairwise(edges) if start < end]
