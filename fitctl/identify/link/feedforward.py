"""The feedforward's matrix: how the own siderostat must turn when the link's does, from a moving collector.

While the collector swings along one axis of the link and then along the other, the link's siderostat follows
it and the loop holds its star. What the own siderostat and the mirror did, and what they left of the star's
motion, is together what the link's siderostat did to the star.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Fsm, Rig
from fitctl.identify.backlash import behind_play
from fitctl.identify.drawing import new_figure
from fitctl.identify.errors import IdentifyError, require_star, require_times
from fitctl.identify.record import axis_pair
from fitctl.identify.whitening import whitener
from fitctl.logging.reading import Columns
from fitctl.model.hysteresis import displacement_series
from fitctl.model.optics import mirror_from_stacks, scales

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
AXES = ("az", "el")
STEP = "collector_scan"
_LEAST_SWING_ARCSEC = 10.0  # of the link's beam, along each axis
_LEAST_FRAMES = 500
_SMOOTH_S = 0.3  # the hold's own motion is faster
_MOVES = 0.3  # of the largest rate: slower, and the plays may not be taken up
_FAR = 0.3  # of an axis' whole swing: an axis that rests may take up its play as fast, but not go as far
_MOST_EXCESS = 3.0
# How well the mirror's way is known, which makes up for what the rig file's matrix is wrong by (choice): by its
# hysteresis, whose state before the scan is unknown, or by its commands alone.
_MIRROR_KNOWN, _MIRROR_COMMANDED = 0.1, 0.2
_OUTLIER = 4.0  # standard deviations
_SD_PER_MEDIAN = 1.4826  # of the absolute value of a normal variable
_MOST_FITS = 10
_BLOCKS = 8  # of the scan, each about half a swing
_WORTH_ANOTHER = 0.01  # a change after which another scan knows the matrix better


@dataclass(frozen=True)
class FeedforwardResult:
    """The matrix, and how well it explains the star.

    Attributes
    ----------
    loop : str
    matrix, matrix_sd : array, shape (2, 2)
        From the beam of the link's siderostat to that of the own one, on the sky; one standard deviation, with
        what the mirror's scale may be wrong by.
    before : array, shape (2, 2)
        The rig file's matrix, times its gain.
    px_per_mm : float
        What the largest standard deviation of an element leaves of the star's motion, for a millimetre of the
        collector's.
    excess : float
        RMS of what is left, over what the rig file's air path and the sensor's noise explain.
    frames : int
    left_out : float
        The fraction of them that the fit leaves out as outliers.
    late : float
        The fraction of ticks that were late: a stage that is commanded late leaves the star behind.
    link_arcsec, turned_arcsec, left_arcsec : arrays, shape (frames, 2)
        The link's beam, what the own stages undid of it, and what is left after the fit.
    """

    loop: str
    matrix: Floats
    matrix_sd: Floats
    before: Floats
    px_per_mm: float
    excess: float
    frames: int
    left_out: float
    late: float
    link_arcsec: Floats = field(repr=False)
    turned_arcsec: Floats = field(repr=False)
    left_arcsec: Floats = field(repr=False)

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file: the whole table, with a gain of 1."""
        section = {"gain": 1.0, "matrix": self.matrix.round(5).tolist()}
        return {"loops": {self.loop: {"feedforward": section}}}

    def lines(self) -> list[str]:
        """For an operator."""
        rows = [
            f"{own} = "
            + ", ".join(
                f"({self.matrix[row, column]:+.4f} +- {self.matrix_sd[row, column]:.4f}) {link}"
                for column, link in enumerate(AXES)
            )
            + " of the link's beam (one standard deviation)"
            for row, own in enumerate(AXES)
        ]
        change = np.abs(self.matrix - self.before).max()
        again = "; run it again with this matrix" if change > _WORTH_ANOTHER else ""
        return [
            *rows,
            f"largest change from the rig file's gain times matrix: {change:.4f}{again}",
            f"an error of one standard deviation leaves {self.px_per_mm:.4f} px for each millimetre of the "
            "collector's motion",
            f"unexplained: {self.excess:.2f} times what the rig file's air path explains, {self.frames} "
            f"frames, {self.left_out:.1%} of them left out as outliers; {self.late:.1%} of the ticks were late",
        ]

    def draw(self) -> Figure:
        """What the own stages undid against the link's beam, and what is left."""
        figure = new_figure(10.0, 7.0)
        panels = figure.subplots(2, 2, sharex="col")
        for axis, name in enumerate(AXES):
            link = self.link_arcsec[:, axis]
            panels[0, axis].plot(link, self.turned_arcsec[:, axis], ".", ms=2)
            panels[1, axis].plot(link, self.left_arcsec[:, axis], ".", ms=2)
            panels[0, axis].set(title=name, ylabel="undone by the own stages, arcsec")
            panels[1, axis].set(
                xlabel="link's siderostat, arcsec", ylabel="left after the fit, arcsec"
            )
        for panel in panels.flat:
            panel.grid(alpha=0.3)
        figure.suptitle(f"Feedforward of loop {self.loop}")
        return figure


def analyse(rig: Rig, loop_name: str, ticks: Columns) -> FeedforwardResult:
    """The matrix from the ticks of a :data:`STEP`, by generalized least squares against the moving air.

    Raises
    ------
    IdentifyError
        If the loop has no link, the star was lost, the link's siderostat did not swing along both axes, the
        times cannot be of one run, or the fit leaves too much unexplained.
    """
    loop = rig.stellar_loops.get(loop_name)
    if loop is None or loop.link is None:
        msg = f"feedforward: loop {loop_name} has no link; name a loop that has one with --loop"
        raise IdentifyError(msg)
    scale = scales(rig, loop)
    times_s, star_px = ticks["mid_exposure_s"], axis_pair(ticks, "star_{}_px")
    link_sky_rad = rig.metrology_loops[loop.link].siderostat.sky_rad_per_motor_rad
    link_px = axis_pair(ticks, "link_{}_rad") * link_sky_rad * scale.sky_px_per_rad
    own_px = axis_pair(ticks, "siderostat_{}_rad") * scale.motor_px_per_rad
    mirror_px = scale.mirror_px(_mirror_rad(loop.fsm, ticks))
    # Along the own siderostat's axes, as the matrix is.
    unturned_px = (star_px - mirror_px).dot(scale.siderostat_back.T)
    framed = np.isfinite(times_s) & (ticks["mode"] == "VERNIER")
    usable = framed & np.isfinite(unturned_px).all(axis=1) & np.isfinite(link_px).all(axis=1)
    require_star(
        int(np.count_nonzero(usable)), int(np.count_nonzero(framed)), "frames", _LEAST_FRAMES
    )
    times_s, link_px, own_px, unturned_px = (
        column[usable] for column in (times_s, link_px, own_px, unturned_px)
    )
    require_times(times_s, rig.camera.period_s, f"frames of loop {loop_name}")
    swing_arcsec = np.ptp(link_px, axis=0) * scale.sky_arcsec_per_px
    if not swing_arcsec.min() >= _LEAST_SWING_ARCSEC:
        az, el = swing_arcsec.tolist()
        msg = (
            f"feedforward: the link's beam swung by {az:.1f} arcsec in az and {el:.1f} arcsec in el, expected "
            f"at least {_LEAST_SWING_ARCSEC:g} along each; run the step {STEP} with a larger amplitude_mm"
        )
        raise IdentifyError(msg)
    direction = _direction(times_s, link_px)
    per_px = scale.sky_arcsec_per_px
    # The plays that the rig file knows; by how much they are wrong goes with the direction.
    undone_px = unturned_px - _behind_play(own_px, loop.siderostat.backlash_sky_arcsec, per_px)
    link_siderostat = rig.metrology_loops[loop.link].siderostat
    link_px = _behind_play(link_px, link_siderostat.backlash_sky_arcsec, per_px)
    known = np.isfinite(direction).all(axis=1)
    # Of an axis that has not swung yet, the play's place is unknown: each axis' scan has a constant of its own.
    second = times_s > float(
        np.mean([times_s[direction[:, 0] != 0][-1], times_s[direction[:, 1] != 0][0]])
    )
    design = np.column_stack([link_px, direction, second, ~second])[known]
    times_s, link_px, undone_px = times_s[known], link_px[known], undone_px[known]
    whiten = whitener(rig, loop_name, times_s, least_noise_px=0.0)
    white, wanted = whiten(design), whiten(undone_px)
    solution, kept = _solve_without_outliers(white, wanted)
    white, wanted = white[kept], wanted[kept]
    left = wanted - white @ solution
    variance = np.sum(left**2, axis=0) / (len(white) - len(solution))
    inverse = np.diag(np.linalg.inv(white.T @ white))
    sd = np.maximum(np.sqrt(np.outer(inverse, variance)), _sd_by_blocks(white, wanted))
    given = loop.feedforward
    before = np.zeros((2, 2)) if given is None else given.gain * np.array(given.matrix)
    mirror_error = _MIRROR_COMMANDED if loop.fsm.hysteresis is None else _MIRROR_KNOWN
    matrix = solution[:2].T
    matrix_sd = np.hypot(sd[:2].T, mirror_error * (matrix - before))
    excess = float(np.sqrt(variance.mean()))
    if excess > _MOST_EXCESS:
        msg = (
            f"feedforward: {excess:.1f} times what the rig file's air path explains is left unexplained, "
            f"expected at most {_MOST_EXCESS:g}; identify the air path first, then run the step {STEP} again"
        )
        raise IdentifyError(msg)
    mm_px = 1e-3 / rig.metrology_loops[loop.link].sensor.link_length_m * scale.sky_px_per_rad
    return FeedforwardResult(
        loop=loop_name,
        matrix=matrix,
        matrix_sd=matrix_sd,
        before=before,
        px_per_mm=float(matrix_sd.max() * mm_px),
        excess=excess,
        frames=len(times_s),
        left_out=float(np.mean(~kept)),
        late=float(np.mean(ticks["late"])),
        link_arcsec=link_px * per_px,
        turned_arcsec=undone_px * per_px,
        left_arcsec=(undone_px - design @ solution) * per_px,
    )


def _solve_without_outliers(design: Floats, wanted: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """The least-squares solution, shape (columns, axes), and the frames that it keeps, shape (frames,).

    On a busy computer a reading of an encoder comes late, and counts as taken later than it was. While the
    collector moves, that is wrong by many times the noise, and always makes the matrix too small.
    """
    kept = np.ones(len(design), dtype=bool)
    for _ in range(_MOST_FITS):
        solution = np.linalg.lstsq(design[kept], wanted[kept], rcond=None)[0]
        left = np.abs(wanted - design @ solution)
        before, kept = (
            kept,
            np.all(left < _OUTLIER * _SD_PER_MEDIAN * np.median(left, axis=0), axis=1),
        )
        if np.array_equal(kept, before):
            break
    return np.asarray(solution, dtype=np.float64), kept


def _sd_by_blocks(design: Floats, wanted: Floats) -> Floats:
    """Standard deviation of a least-squares solution, shape (columns, axes), by leaving out parts of the scan.

    What a busy computer does to the readings comes in bursts, and is not noise from frame to frame. This is the
    delete-a-group jackknife (Shao and Tu, The Jackknife and Bootstrap, Springer 1995).
    """
    block = np.arange(len(design)) * _BLOCKS // len(design)
    without = np.array(
        [
            np.linalg.lstsq(design[block != left_out], wanted[block != left_out], rcond=None)[0]
            for left_out in range(_BLOCKS)
        ]
    )
    return np.asarray(np.sqrt(_BLOCKS - 1) * without.std(axis=0), dtype=np.float64)


def _mirror_rad(fsm: Fsm, ticks: Columns) -> Floats:
    """Where the mirror was as each frame was exposed, shape (ticks, 2), by its hysteresis if that is known.

    Where the loops begin is not known; what is wrong for that reason is soon a constant.
    """
    if fsm.hysteresis is None:
        return axis_pair(ticks, "fsm_{}_rad")
    volts = np.stack([ticks[f"stack{number}_v"] for number in (1, 2, 3)], axis=-1)
    widths_v, gains = np.array(fsm.hysteresis.half_widths_v), np.array(fsm.hysteresis.gains_m_per_v)
    displacement_m = displacement_series(volts - volts[0], widths_v, gains)
    mirror_rad = mirror_from_stacks(displacement_m, fsm.stack_radius_m)
    row = np.searchsorted(ticks["fsm_written_s"], ticks["mid_exposure_s"], side="right") - 1
    return np.where(row[:, None] >= 0, mirror_rad[row], np.nan)


def _behind_play(motor_px: Floats, width_arcsec: float | None, arcsec_per_px: float) -> Floats:
    """A siderostat's beam, shape (frames, 2), where its motors are; a play that is not known counts as none."""
    half_px = (width_arcsec or 0.0) / arcsec_per_px / 2
    return np.stack([behind_play(motor_px[:, axis], half_px) for axis in range(2)], axis=-1)


def _direction(times_s: Floats, link_px: Floats) -> Floats:
    """Which way each axis of the link's siderostat moves, shape (frames, 2): -1, 1, or 0 where it rests.

    NaN where it turns back: the plays may then not be taken up.

    Raises
    ------
    IdentifyError
        If an axis does not swing.
    """
    half = max(1, round(_SMOOTH_S / 2 / float(np.median(np.diff(times_s)))))
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    directions = []
    for axis, name in enumerate(AXES):
        padded = np.pad(link_px[:, axis], half, mode="edge")
        rate = np.gradient(np.convolve(padded, kernel, mode="valid"), times_s)
        fast = _MOVES * np.quantile(np.abs(rate), 0.95)
        swings = _swings(times_s, np.abs(rate) > fast, link_px[:, axis])
        if not swings.any():
            msg = (
                f"feedforward: the link's beam moves in {name} only by short jerks; expected a motion over at "
                f"least {_FAR:.0%} of its whole swing without a stop; see that the link's loop follows the "
                f"collector, then run the step {STEP} again"
            )
            raise IdentifyError(msg)
        moved = np.where(np.abs(rate) > fast, np.sign(rate), np.nan)
        directions.append(np.where(swings, moved, 0.0))
    return np.stack(directions, axis=-1)


def _swings(times_s: Floats, fast: NDArray[np.bool_], place_px: Floats) -> NDArray[np.bool_]:
    """From the first to the last frame on which an axis moves fast and far."""
    changes = np.flatnonzero(np.diff(fast, prepend=False, append=False))
    begins, ends = changes[::2], changes[1::2] - 1
    far = np.abs(place_px[ends] - place_px[begins]) >= _FAR * np.ptp(place_px)
    if not far.any():
        return np.zeros(len(times_s), dtype=bool)
    return (times_s >= times_s[begins[far][0]]) & (times_s <= times_s[ends[far][-1]])
