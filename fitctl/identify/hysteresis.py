"""The three stacks' hysteresis, measured by the camera: each stack swept, the star watched."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.identify.drawing import new_figure
from fitctl.identify.errors import IdentifyError, require_room, require_star
from fitctl.identify.plays import (
    ELEMENTS,
    Fit,
    block_rows,
    fit_gains,
    place_breakpoints,
    smoothness,
    trail,
)
from fitctl.identify.record import ExperimentRecord
from fitctl.identify.whitening import whitener
from fitctl.model.drives import STACKS, Drive
from fitctl.model.hysteresis import hysteresis_output, swept_loop_width, swept_stroke
from fitctl.model.optics import mirror_from_stacks, scales

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
SLOW_HZ, FAST_HZ = 0.5, 1.0
_WIPES = 2  # sweeps of all together; one would do if the machine never stood still
FULL_S, MINOR_S = 12.0, 20.0
_LEAST_SWING = 0.5  # of the D/A's full scale
_LEAST_FRAMES = 500
_AT_END = 0.02  # of the swing
_UNSURE_S = 0.001  # so near to a change of voltage, a frame may have seen either side
_LATE_S = np.linspace(-0.010, 0.010, 81)  # tried


def plan(rig: Rig, loop_name: str) -> list[Drive]:
    """All stacks once together, which wipes their memory and moves no star; then each by itself.

    Raises
    ------
    IdentifyError
        If the star would leave the frame.
    """
    fsm = rig.stellar_loops[loop_name].fsm
    amplitude_v = min(fsm.bias_v, fsm.dac.full_scale_v - fsm.bias_v)
    _check_star_stays(rig, loop_name, amplitude_v)
    sweep = partial(Drive, shape="triangle", amplitude=amplitude_v)
    wipe_s = _WIPES / SLOW_HZ
    drives = [sweep(channel=stack, frequency_hz=SLOW_HZ, duration_s=wipe_s) for stack in STACKS]
    for number, stack in enumerate(STACKS):
        start_s = wipe_s + number * (FULL_S + MINOR_S)
        minor_s = start_s + FULL_S
        drives += [
            sweep(channel=stack, frequency_hz=SLOW_HZ, start_s=start_s, duration_s=FULL_S),
            sweep(
                channel=stack,
                end_amplitude=0.0,
                frequency_hz=FAST_HZ,
                start_s=minor_s,
                duration_s=MINOR_S,
            ),
        ]
    return drives


def _check_star_stays(rig: Rig, loop_name: str, amplitude_v: float) -> None:
    loop = rig.stellar_loops[loop_name]
    per_stack_rad = loop.fsm.stack_scale_m_per_v / (2 * loop.fsm.stack_radius_m)
    swing_rad = 1.2 * amplitude_v * per_stack_rad
    scale = scales(rig, loop)
    # The second stack moves both of the mirror's axes, and what that is on the frame, its rotation decides.
    az_px, el_px = (
        swing_rad * scale.mirror_px_per_rad * np.abs(scale.mirror_turn).sum(axis=1)
    ).tolist()
    require_room(rig, loop_name, "a full swing of one stack", az_px, el_px)


@dataclass(frozen=True)
class HysteresisResult:
    """The three stacks as parallel plays.

    Attributes
    ----------
    loop : str
    full_scale_v : float
        Of the D/A.
    half_widths_v : array, shape (n,)
    gains_m_per_v : array, shape (3, n)
        The elements' gains.
    output_sd : array, shape (3,)
        One standard deviation of the model's output, RMS over the record, as a part of the stroke.
    late_s : float
        By how much the exposures were later than the record says, beside the voltages; corrected for.
    excess : float
        RMS of what the model leaves, over what the rig file's air path and centroid noise explain.
    volts, modelled_m, measured_m : arrays, shape (frames, 3)
        For each frame and stack; not measured, NaN, while another stack moves.
    """

    loop: str
    full_scale_v: float
    half_widths_v: Floats
    gains_m_per_v: Floats
    output_sd: Floats
    late_s: float
    excess: float
    volts: Floats = field(repr=False)
    modelled_m: Floats = field(repr=False)
    measured_m: Floats = field(repr=False)

    def fragment(self) -> dict[str, Any]:
        """What a rig file shall know, nested as there."""
        section = {
            "half_widths_v": self.half_widths_v.tolist(),
            "gains_m_per_v": self.gains_m_per_v.tolist(),
        }
        return {"loops": {self.loop: {"fsm": {"hysteresis": section}}}}

    def lines(self) -> list[str]:
        """What an operator reads."""
        lines = []
        for stack, gains in enumerate(self.gains_m_per_v):
            stroke_m = swept_stroke(self.half_widths_v, gains, self.full_scale_v)
            width_m = swept_loop_width(self.half_widths_v, gains, self.full_scale_v)
            lines.append(
                f"stack {stack + 1}: stroke {stroke_m * 1e6:.3f} um over {self.full_scale_v:g} V, loop "
                f"{100 * width_m / stroke_m:.1f} % wide; model within {100 * self.output_sd[stack]:.2f} % "
                "of stroke RMS (one standard deviation)"
            )
        lines.append(
            f"frames are {self.late_s * 1e3:+.2f} ms late on the voltages; "
            f"what is left is {self.excess:.2f} times what the rig file's air path explains"
        )
        return lines

    def draw(self) -> Figure:
        """Each stack's loops: what the camera saw, air path included, and the model."""
        figure = new_figure(12, 4.5)
        for stack, axes in enumerate(figure.subplots(1, 3, sharex=True, sharey=True)):
            own = np.isfinite(self.measured_m[:, stack])
            volts, model_um = self.volts[own, stack], self.modelled_m[own, stack] * 1e6
            axes.plot(
                volts, self.measured_m[own, stack] * 1e6, ".", ms=2, color="0.6", label="seen"
            )
            axes.plot(volts, model_um, lw=0.7, color="tab:blue", label="model")
            axes.set(title=f"{self.loop}: stack {stack + 1}", xlabel="D/A voltage, V")
            axes.grid(alpha=0.3)
        figure.axes[0].set_ylabel("displacement, µm")
        figure.axes[0].legend(markerscale=5)
        return figure


def analyse(rig: Rig, record: ExperimentRecord) -> HysteresisResult:
    """Identify all three stacks from one record of any rich motion.

    Frames count from when every stack has been at both ends of its motion: from there on its memory
    is known, whatever came before. Breakpoints are placed by the curvature that a first look with
    evenly spread ones finds.

    Raises
    ------
    IdentifyError
        If there are too few frames with a star, or too little motion.

    Notes
    -----
    A star does not show where the mirror stood before its stacks were first swept: the model's output is
    known but for a constant, which depends on the widest elements, that a full swing moves last.
    """
    end_v = float(np.ptp(record.injected_v, axis=0).min()) / 2
    look_v = np.arange(ELEMENTS // 2 + 1) * end_v / (ELEMENTS // 2 + 1)
    freely = np.empty((0, 3, len(look_v)))
    stamped = _Evidence(rig, record)
    late_s = stamped.late_s(look_v, stamped.fit(look_v, freely).gains)
    evidence = _Evidence(rig, record, late_s, _UNSURE_S)
    bend = np.abs(evidence.fit(look_v, freely).gains)
    half_widths_v = place_breakpoints(look_v, bend.mean(axis=0), end_v)
    mean_bend = bend[:, 1:].sum(axis=1) / end_v
    prior = block_rows([smoothness(half_widths_v, end_v, one) for one in mean_bend])
    return _result(evidence, half_widths_v, evidence.fit(half_widths_v, prior), late_s)


def _usable_frames(
    record: ExperimentRecord, exposed_s: Floats, unsure_s: float, full_scale_v: float
) -> NDArray[np.intp]:
    """Frames with a star, after every stack's memory was wiped, that surely saw one voltage."""
    volts = record.injected_v
    low_v, high_v = volts.min(axis=0), volts.max(axis=0)
    smallest = float((high_v - low_v).min())
    if smallest < _LEAST_SWING * full_scale_v:
        msg = (
            f"a stack moved by {smallest:.2f} V only, expected at least {_LEAST_SWING * full_scale_v:g} V; "
            "run the experiment of `fitctl identify hysteresis`"
        )
        raise IdentifyError(msg)
    margin_v = _AT_END * (high_v - low_v)
    at_ends = np.stack([volts <= low_v + margin_v, volts >= high_v - margin_v])
    wiped_s = record.injected_s[at_ends.argmax(axis=1).max()]
    after = exposed_s > wiped_s
    with_star = np.isfinite(record.star_px).all(axis=1)
    frames = np.flatnonzero(after & with_star)
    require_star(len(frames), int(np.count_nonzero(after)), "frames", _LEAST_FRAMES)
    changed_s = record.injected_s[1:][np.diff(volts, axis=0).any(axis=1)]
    return frames[_distance(changed_s, exposed_s[frames]) >= unsure_s]


def _distance(events_s: Floats, times_s: Floats) -> Floats:
    """From each time to the nearest event."""
    after = np.clip(np.searchsorted(events_s, times_s), 1, len(events_s) - 1)
    return np.minimum(np.abs(times_s - events_s[after - 1]), np.abs(times_s - events_s[after]))


class _Evidence:
    """The frames' information about the stacks, whitened; both axes' rows below each other."""

    def __init__(
        self, rig: Rig, record: ExperimentRecord, late_s: float = 0.0, unsure_s: float = 0.0
    ) -> None:
        loop = rig.stellar_loops[record.loop]
        exposed_s = record.tick["mid_exposure_s"] + late_s
        frames = _usable_frames(record, exposed_s, unsure_s, loop.fsm.dac.full_scale_v)
        self.record = record
        self.full_scale_v = loop.fsm.dac.full_scale_v
        self.exposed_s = exposed_s[frames]
        self.star_px = record.star_px[frames]
        # By how much one metre of each stack moves the star, shape (stacks, axes).
        self.px_per_m = scales(rig, loop).mirror_px(
            mirror_from_stacks(np.eye(3), loop.fsm.stack_radius_m)
        )
        self._whiten = whitener(rig, record.loop, self.exposed_s)
        self._white_star = self._whitened(self.star_px.T[..., None])

    def plays_v(self, half_widths_v: Floats) -> Floats:
        """Plays at the frames, shape (frames, stacks, n)."""
        return trail(self.record.injected_v, half_widths_v)[self.record.row_at(self.exposed_s)]

    def fit(self, half_widths_v: Floats, prior: Floats) -> Fit:
        """Gains from all frames and both axes at once."""
        plays_v = self.plays_v(half_widths_v)
        moved_px = self.px_per_m.T[:, None, :, None] * plays_v
        plays = self._whitened(moved_px.reshape(2, len(plays_v), -1)).reshape(
            -1, *plays_v.shape[1:]
        )
        return fit_gains(plays, self._white_star[:, 0], prior)

    def late_s(self, half_widths_v: Floats, gains: Floats) -> float:
        """By how much exposures are later than their times: as what a model explains most.

        Voltages go in steps, so a frame with a wrong time often has a wrong voltage too.
        """
        moved_m = hysteresis_output(trail(self.record.injected_v, half_widths_v), gains)
        rows = self.record.row_at(self.exposed_s[:, None] + _LATE_S)
        modelled_px = np.einsum("fls,sa->afl", moved_m[rows], self.px_per_m)
        left_over = self._white_star - self._whitened(modelled_px)
        return float(_LATE_S[np.argmin((left_over**2).sum(axis=0))])

    def _whitened(self, columns: Floats) -> Floats:
        """From (axes, frames, m) to (axes * frames, m)."""
        return np.concatenate([self._whiten(axis) for axis in columns])


def _result(
    evidence: _Evidence, half_widths_v: Floats, fit: Fit, late_s: float
) -> HysteresisResult:
    n, full_scale_v = len(half_widths_v), evidence.full_scale_v
    plays_v = evidence.plays_v(half_widths_v)
    modelled_m = hysteresis_output(plays_v, fit.gains)
    left_over_px = evidence.star_px - modelled_m @ evidence.px_per_m
    left_over_px -= left_over_px.mean(axis=0)
    volts = evidence.record.injected_v[evidence.record.row_at(evidence.exposed_s)]
    stacks = range(modelled_m.shape[1])
    output_sd = []
    for stack in stacks:
        centred_v = plays_v[:, stack] - plays_v[:, stack].mean(axis=0)
        block = slice(stack * n, (stack + 1) * n)
        variance = np.einsum("fi,ij,fj->f", centred_v, fit.covariance[block, block], centred_v)
        moving = np.abs(np.gradient(volts[:, stack])) > 0
        stroke_m = swept_stroke(half_widths_v, fit.gains[stack], full_scale_v)
        output_sd.append(np.sqrt(variance[moving].mean()) / stroke_m)
    moving = np.abs(np.gradient(volts, axis=0)) > 0
    alone = moving & (moving.sum(axis=1, keepdims=True) == 1)
    back = evidence.px_per_m.T / (evidence.px_per_m**2).sum(axis=1)
    measured_m = np.where(alone, modelled_m + left_over_px @ back, np.nan)
    return HysteresisResult(
        loop=evidence.record.loop,
        full_scale_v=full_scale_v,
        half_widths_v=half_widths_v,
        gains_m_per_v=fit.gains,
        output_sd=np.array(output_sd),
        late_s=late_s,
        excess=fit.excess,
        volts=volts,
        modelled_m=modelled_m,
        measured_m=measured_m,
    )
