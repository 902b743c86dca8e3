"""The siderostat's backlash, measured by the camera: a there-and-back scan with many reversals."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fitctl.config import Rig
from fitctl.identify.drawing import new_figure
from fitctl.identify.errors import IdentifyError, require_room, require_star
from fitctl.identify.record import ExperimentRecord
from fitctl.identify.whitening import whitener
from fitctl.model.drives import SIDEROSTAT, Drive
from fitctl.model.optics import scales

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
AXES = ("az", "el")
AMPLITUDE_PX, END_AMPLITUDE_PX = 2.0, 1.0
FREQUENCY_HZ, END_FREQUENCY_HZ = 0.6, 1.4  # two rates: a late frame looks like backlash at one only
SCAN_S = 25.0
_LEAST_SWING_PX = 1.0
_LEAST_FRAMES = 250
_FIRST_WIDTHS = np.linspace(0.0, 0.6, 13)  # of the swing, tried before the search


def plan(rig: Rig, loop_name: str) -> list[Drive]:
    """One axis after the other, there and back by a few pixels, ever faster.

    Raises
    ------
    IdentifyError
        If the star would leave the frame.
    """
    reach_px = AMPLITUDE_PX + 1.0
    require_room(rig, loop_name, "the scan", reach_px, reach_px)
    return [
        Drive(
            channel=channel,
            shape="sine",
            amplitude=AMPLITUDE_PX,
            end_amplitude=END_AMPLITUDE_PX,
            frequency_hz=FREQUENCY_HZ,
            end_frequency_hz=END_FREQUENCY_HZ,
            start_s=axis * SCAN_S,
            duration_s=SCAN_S,
        )
        for axis, channel in enumerate(SIDEROSTAT)
    ]


@dataclass(frozen=True)
class AxisBacklash:
    """One axis of the siderostat.

    Attributes
    ----------
    width_px, width_sd_px : float
        Total width of the play on the focal plane, and one standard deviation.
    px_per_motor_rad, px_per_motor_rad_sd : float
        Plate scale.
    late_s, late_sd_s : float
        By how much the exposures were later than the encoders' times say.
    excess : float
        RMS of what is left, over what the rig file's air path and centroid noise explain.
    motor_px, measured_px, modelled_px : arrays, shape (frames,)
        Motor by the plate scale, star, and model, each about its mean.
    """

    width_px: float
    width_sd_px: float
    px_per_motor_rad: float
    px_per_motor_rad_sd: float
    late_s: float
    late_sd_s: float
    excess: float
    motor_px: Floats = field(repr=False)
    measured_px: Floats = field(repr=False)
    modelled_px: Floats = field(repr=False)


@dataclass(frozen=True)
class BacklashResult:
    """Both axes, and the one width that stands for them.

    Attributes
    ----------
    loop : str
    axes : dict of str to AxisBacklash
        By axis, az and el.
    width_px, width_sd_px : float
        Mean of the axes, each weighted by its certainty.
    sky_arcsec_per_px : float
        From the rig file's optics.
    nominal_px_per_rad : float
        Plate scale by the rig file's gears.
    """

    loop: str
    axes: dict[str, AxisBacklash]
    width_px: float
    width_sd_px: float
    sky_arcsec_per_px: float
    nominal_px_per_rad: float

    @property
    def width_sky_arcsec(self) -> float:
        """Total width in beam angle on the sky."""
        return self.width_px * self.sky_arcsec_per_px

    def fragment(self) -> dict[str, Any]:
        """What a rig file shall know, nested as there."""
        section = {"backlash_sky_arcsec": self.width_sky_arcsec}
        return {"loops": {self.loop: {"siderostat": section}}}

    def lines(self) -> list[str]:
        """What an operator reads."""
        lines = [
            f"{name}: {axis.width_px:.3f} +- {axis.width_sd_px:.3f} px wide; "
            f"{axis.px_per_motor_rad:.4f} +- {axis.px_per_motor_rad_sd:.4f} px a motor radian, "
            f"{axis.px_per_motor_rad / self.nominal_px_per_rad:.4f} times nominal; frames "
            f"{axis.late_s * 1e3:+.1f} +- {axis.late_sd_s * 1e3:.1f} ms late on the encoders; what is "
            f"left is {axis.excess:.2f} times what the rig file's air path explains"
            for name, axis in self.axes.items()
        ]
        sd_arcsec = self.width_sd_px * self.sky_arcsec_per_px
        lines.append(
            f"backlash {self.width_px:.3f} +- {self.width_sd_px:.3f} px = {self.width_sky_arcsec:.3f} "
            f"+- {sd_arcsec:.3f} arcsec on the sky (one standard deviation)"
        )
        return lines

    def draw(self) -> Figure:
        """The loop of each axis: what the camera saw, air path included, and the model."""
        figure = new_figure(10, 5)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for panel, (name, axis) in zip(panels, self.axes.items(), strict=True):
            panel.plot(axis.motor_px, axis.measured_px, ".", ms=3, color="0.6", label="seen")
            panel.plot(axis.motor_px, axis.modelled_px, ".", ms=2, color="tab:blue", label="model")
            panel.set(
                title=f"{self.loop} {name}: {axis.width_px:.3f} ± {axis.width_sd_px:.3f} px",
                xlabel="siderostat motor, px",
                ylabel="star, px",
            )
            panel.grid(alpha=0.3)
        panels[0].legend(markerscale=4)
        return figure


def analyse(rig: Rig, record: ExperimentRecord) -> BacklashResult:
    """Width and plate scale of both axes, by generalized least squares against the moving air.

    Raises
    ------
    IdentifyError
        If an axis did not move enough, or the star was lost.
    """
    scale = scales(rig, rig.stellar_loops[record.loop])
    axes = {name: _analyse_axis(rig, record, axis) for axis, name in enumerate(AXES)}
    widths_px = np.array([axis.width_px for axis in axes.values()])
    weights = np.array([axis.width_sd_px for axis in axes.values()]) ** -2
    return BacklashResult(
        loop=record.loop,
        axes=axes,
        width_px=float(weights @ widths_px / weights.sum()),
        # What encoder counts do is alike in both axes: averaging does not help much.
        width_sd_px=float(weights @ weights**-0.5 / weights.sum()),
        sky_arcsec_per_px=scale.sky_arcsec_per_px,
        nominal_px_per_rad=scale.motor_px_per_rad,
    )


def _analyse_axis(rig: Rig, record: ExperimentRecord, axis: int) -> AxisBacklash:
    scale = scales(rig, rig.stellar_loops[record.loop])
    nominal = scale.motor_px_per_rad
    star_px = record.star_px.dot(scale.siderostat_back.T)[:, axis]  # along the siderostat's axis
    motor_px = record.motor_rad[:, axis] * nominal
    motor_px -= motor_px.mean()
    frames = _usable_frames(AXES[axis], motor_px, star_px)
    times_s = record.tick["mid_exposure_s"]
    measured_px = star_px[frames]
    whiten = whitener(rig, record.loop, times_s[frames])
    whitened = whiten(measured_px[:, None])[:, 0]
    # Not by interpolation: it would smooth the encoders' counts, and be preferred for that.
    rate_px_s = np.gradient(motor_px, times_s)

    def modelled_px(values: Floats) -> Floats:
        ratio, width_px, late_s = values
        # The play passes every frame, also those without a star.
        return ratio * behind_play(motor_px + late_s * rate_px_s, width_px / 2)[frames]

    def left_over(values: Floats) -> Floats:
        return np.asarray(whitened - whiten(modelled_px(values)[:, None])[:, 0])

    swing_px = float(np.ptp(motor_px))
    starts = [np.array([1.0, width_px, 0.0]) for width_px in swing_px * _FIRST_WIDTHS]
    found = least_squares(
        left_over,
        min(starts, key=lambda values: float(np.sum(left_over(values) ** 2))),
        bounds=([0.1, 0.0, -rig.camera.period_s], [10.0, swing_px, rig.camera.period_s]),
        x_scale=[1.0, 0.1, 1e-3],
    )
    variance = 2 * found.cost / (len(frames) - len(found.x))
    ratio_sd, width_sd_px, late_sd_s = np.sqrt(
        variance * np.diag(np.linalg.inv(found.jac.T @ found.jac))
    )
    ratio, width_px, late_s = found.x
    model_px = modelled_px(found.x)
    # Where the motor turned back is known to a count, at either end; more frames do not help.
    counts_per_rev = rig.stellar_loops[record.loop].siderostat.encoder_counts_per_rev
    counted_px = nominal * 2 * np.pi / counts_per_rev / np.sqrt(6)
    return AxisBacklash(
        # The play stands in motor angle; what the star shows is its width by the true plate scale.
        width_px=float(ratio * width_px),
        width_sd_px=float(
            np.sqrt((ratio * width_sd_px) ** 2 + (width_px * ratio_sd) ** 2 + counted_px**2)
        ),
        px_per_motor_rad=float(ratio * nominal),
        px_per_motor_rad_sd=float(ratio_sd * nominal),
        late_s=float(late_s),
        late_sd_s=float(late_sd_s),
        excess=float(np.sqrt(variance)),
        motor_px=motor_px[frames],
        measured_px=measured_px - measured_px.mean(),
        modelled_px=model_px - model_px.mean(),
    )


def _usable_frames(axis: str, motor_px: Floats, star_px: Floats) -> NDArray[np.intp]:
    """Frames with a star, from when the motor has been far to both sides: the play is then known."""
    swing_px = float(np.ptp(motor_px))
    if not swing_px >= _LEAST_SWING_PX:
        msg = (
            f"the siderostat moved by {swing_px:.2f} px in {axis}, expected at least "
            f"{_LEAST_SWING_PX:g} px; run the experiment of `fitctl identify backlash`"
        )
        raise IdentifyError(msg)
    far = [motor_px <= motor_px.min() + swing_px / 4, motor_px >= motor_px.max() - swing_px / 4]
    first = max(int(side.argmax()) for side in far)
    frames = first + np.flatnonzero(np.isfinite(star_px[first:]))
    require_star(len(frames), len(star_px) - first, f"frames of {axis}", _LEAST_FRAMES)
    return frames


def behind_play(value: Floats, half_width: float) -> Floats:
    """A series, shape (m,), behind a play that begins in its middle.

    As :func:`fitctl.model.hysteresis.play`, in plain floats: a search calls it a hundred times.
    """
    output = float(value[0])
    outputs = np.empty(len(value))
    for row, now in enumerate(value.tolist()):
        output = max(now - half_width, min(now + half_width, output))
        outputs[row] = output
    return outputs
