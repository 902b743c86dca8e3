"""The photodiodes' voltages without the beam, from samples that were taken while the laser was blocked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from fitctl.config import MetrologyLoop, Rig
from fitctl.controllers.photodiodes import ambient_of
from fitctl.identify.drawing import new_figure
from fitctl.identify.errors import IdentifyError
from fitctl.logging.reading import Columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
STEP = "ambient"
DIODES = ("az+", "az-", "el+", "el-")
SIDES = ("az_plus", "az_minus", "el_plus", "el_minus")
_LEAST_SAMPLES = 100
_BLOCKS = 10
_MOST_NOISE = 3.0  # times noise_v: the light changes, or the beam is not blocked
_MOST_CHANGE = 0.1  # of on_axis_v, from the rig file's


@dataclass(frozen=True)
class AmbientResult:
    """Voltages without the beam.

    Attributes
    ----------
    loop : str
    ambient_v, sd_v : arrays, shape (4,)
        Means and their standard deviations: az+, az-, el+, el-.
    noise_v : float
        One standard deviation of one sample, of all four photodiodes.
    before : MetrologyLoop
        The rig file's.
    time_s, volts : arrays, shape (samples,) and (samples, 4)
    """

    loop: str
    ambient_v: Floats
    sd_v: Floats
    noise_v: float
    before: MetrologyLoop
    time_s: Floats = field(repr=False)
    volts: Floats = field(repr=False)

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file."""
        # Below zero there is only an offset of the converter's that the rig file cannot say.
        ambient_v = np.maximum(self.ambient_v, 0.0).round(5).tolist()
        return {"loops": {self.loop: {"sensor": {"ambient_v": ambient_v}}}}

    def lines(self) -> list[str]:
        """For an operator."""
        sensor = self.before.sensor
        return [
            *(
                f"{name}: {value:.5f} +- {sd:.5f} V without the beam (rig file {given:g} V)"
                for name, value, sd, given in zip(
                    DIODES,
                    self.ambient_v.tolist(),
                    self.sd_v.tolist(),
                    sensor.ambient_v,
                    strict=True,
                )
            ),
            f"noise {1e3 * self.noise_v:.3f} mV RMS of one sample (rig file {1e3 * sensor.noise_v:g} mV), "
            f"{len(self.volts)} samples",
        ]

    def draw(self) -> Figure:
        """The samples over time."""
        figure = new_figure(9.0, 4.5)
        panel = figure.subplots()
        for number, name in enumerate(DIODES):
            panel.plot(
                self.time_s - self.time_s[0], 1e3 * self.volts[:, number], lw=0.6, label=name
            )
        panel.set(
            xlabel="s", ylabel="mV without the beam", title=f"Photodiodes of loop {self.loop}"
        )
        panel.grid(alpha=0.3)
        panel.legend()
        return figure


def analyse(rig: Rig, loop_name: str, ticks: Columns) -> AmbientResult:
    """Means of the samples of a :data:`STEP`.

    Raises
    ------
    IdentifyError
        If the loop is no metrology loop, there are too few samples, or they look like those of a beam.
    """
    loop = rig.metrology_loops.get(loop_name)
    if loop is None:
        msg = f"ambient: loop {loop_name} has no photodiodes; name a metrology loop with --loop"
        raise IdentifyError(msg)
    sampled = np.isfinite(ticks["sampled_s"])
    volts = np.stack([ticks[f"diode_{side}_v"][sampled] for side in SIDES], axis=-1)
    if len(volts) < _LEAST_SAMPLES:
        msg = (
            f"ambient: {len(volts)} samples, expected at least {_LEAST_SAMPLES}; run the step {STEP} with a "
            "longer duration_s"
        )
        raise IdentifyError(msg)
    ambient_v, _ = ambient_of(volts)
    # Over blocks, so that light that flickers slowly counts as what it is.
    blocks_v = np.array([block.mean(axis=0) for block in np.array_split(volts, _BLOCKS)])
    _, sd_v = ambient_of(blocks_v)
    # Of so few blocks the spread is itself uncertain.
    sd_v = sd_v * float(student.ppf(0.975, _BLOCKS - 1)) / 1.96
    noise_v = float(np.sqrt(np.mean(np.var(volts, axis=0, ddof=1))))
    change_v = float(np.abs(ambient_v - loop.sensor.ambient_v).max())
    if not (  # NaN is not
        noise_v <= _MOST_NOISE * loop.sensor.noise_v
        and change_v <= _MOST_CHANGE * loop.sensor.on_axis_v
    ):
        msg = (
            f"ambient: {1e3 * noise_v:.2f} mV RMS of noise and up to {1e3 * change_v:.1f} mV from the rig "
            f"file's ambient_v, expected at most {1e3 * _MOST_NOISE * loop.sensor.noise_v:.2f} and "
            f"{1e3 * _MOST_CHANGE * loop.sensor.on_axis_v:.0f} mV; is the laser blocked?"
        )
        raise IdentifyError(msg)
    return AmbientResult(
        loop_name, ambient_v, sd_v, noise_v, loop, ticks["sampled_s"][sampled], volts
    )
