"""The loop's delay, from a known mirror motion that the camera observes, to a small part of a frame.

The mirror is moved in slow and quick swings by voltages whose times are known. Hysteresis holds a swing
back by the same angle however quick it is, a delay by more the quicker it is: fitted together, both are
separated. What is found is by how much the frames' time stamps are wrong, and with it the delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.identify.drawing import new_figure
from fitctl.identify.errors import IdentifyError
from fitctl.identify.plays import ELEMENTS, trail
from fitctl.identify.record import ExperimentRecord
from fitctl.identify.whitening import whitener
from fitctl.model.drives import Drive
from fitctl.model.optics import scales

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

SWING_OF_RANGE = 0.4  # of the mirror's range, each axis by itself
SLOWEST_HZ, FASTEST_HZ = 1.0, 8.0
SWEEP_S = 12.0  # whole cycles, so that the mirror ends where it began
SETTLE_S = 1.0
_WIDEST_SHIFT_S = 0.1
_COARSE_STEP_S = 0.001
_FINE_STEP_S = 0.0001
_LEAST_FRAMES = 200
_MOST_LOST = 0.1
_MOST_LEFT = 10.0  # unexplained, in units of the noise, RMS
_AT_ONCE = 50  # shifts
_NARROWEST_PLOT_S = 0.0005


@dataclass(frozen=True)
class DelayResult:
    """What the motion shows.

    Attributes
    ----------
    loop : str
    stamp_error_s, stamp_error_std_s : float
        By how much later than its time stamp a frame was truly exposed. Voltages that take effect later
        than recorded, and a mirror that follows late, count here too, against it.
    delay_s : float
        T_fd: from true mid-exposure to the command made from the frame, median over ticks.
    delay_std_s : float
        Of the median and the time stamps together.
    jitter_s : float
        Standard deviation of a single frame's delay.
    frames : int
    left : float
        RMS of what the motion does not explain, in units of the noise (air path and centroid).
    blurred : bool
        Whether the frames look like averages over the exposure rather than instants.
    shift_s, misfit : arrays, shape (n,)
        What is left over for each time shift that was tried, as `left`.
    delays_s : array, shape (ticks,)
    """

    loop: str
    stamp_error_s: float
    stamp_error_std_s: float
    delay_s: float
    delay_std_s: float
    jitter_s: float
    frames: int
    left: float
    blurred: bool
    shift_s: Floats
    misfit: Floats
    delays_s: Floats

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file."""
        return {"camera": {"frame_delay_s": self.delay_s}}

    def lines(self) -> list[str]:
        """For an operator."""
        return [
            f"loop delay {1e3 * self.delay_s:.2f} +- {1e3 * self.delay_std_s:.2f} ms from mid-exposure to "
            f"command (one frame's: {1e3 * self.jitter_s:.2f} ms RMS), {self.frames} frames",
            f"frames are exposed {1e3 * self.stamp_error_s:+.2f} +- {1e3 * self.stamp_error_std_s:.2f} ms "
            "from their time stamps",
            f"frames show {'averages over the exposure' if self.blurred else 'instants'}; "
            f"unexplained: {self.left:.1f} times the noise",
        ]

    def draw(self) -> Figure:
        """How well each time shift explains the frames, and each tick's delay."""
        figure = new_figure(10.0, 4.2)
        left, right = figure.subplots(1, 2)
        left.semilogy(1e3 * self.shift_s, self.misfit, linewidth=1.0)
        left.axvline(1e3 * self.stamp_error_s, color="k", linestyle="--", linewidth=0.8)
        left.set_xlabel("frames exposed later than stamped (ms)")
        left.set_ylabel("motion not explained (RMS, in units of the noise)")
        half_ms = 1e3 * max(4 * self.jitter_s, _NARROWEST_PLOT_S)
        middle_ms = 1e3 * self.delay_s
        right.hist(1e3 * self.delays_s, bins=60, range=(middle_ms - half_ms, middle_ms + half_ms))
        right.axvline(1e3 * self.delay_s, color="k", linestyle="--", linewidth=0.8)
        right.set_xlabel("mid-exposure to command (ms)")
        right.set_ylabel("ticks")
        right.set_title(f"median {1e3 * self.delay_s:.2f} ms")
        for panel in (left, right):
            panel.grid(alpha=0.3)
        figure.suptitle(f"Loop delay of loop {self.loop}")
        return figure


def plan(rig: Rig, loop_name: str) -> list[Drive]:
    """One axis after the other, from slow to quick swings, within the mirror's diamond."""
    loop = rig.stellar_loops[loop_name]
    swing_px = SWING_OF_RANGE * loop.fsm.range_rad * scales(rig, loop).mirror_px_per_rad
    return [
        Drive(
            channel="fsm_az" if axis == 0 else "fsm_el",
            shape="sine",
            amplitude=swing_px,
            frequency_hz=SLOWEST_HZ,
            end_frequency_hz=FASTEST_HZ,
            start_s=axis * (SWEEP_S + SETTLE_S),
            duration_s=SWEEP_S,
        )
        for axis in range(2)
    ]


def analyse(rig: Rig, record: ExperimentRecord) -> DelayResult:
    """Time stamps' error and loop delay from an experiment on :func:`plan`.

    Raises
    ------
    IdentifyError
        If the star was lost too often, or the frames do not show the motion.
    """
    hypotheses = [_Motion(record, rig), _Motion(record, rig, rig.camera.exposure_s)]
    shifts_s = np.arange(-_WIDEST_SHIFT_S, _WIDEST_SHIFT_S, _COARSE_STEP_S)
    misfits = [motion.misfits(shifts_s) for motion in hypotheses]
    blurred = bool(misfits[1].min() < misfits[0].min())
    motion, misfit = hypotheses[blurred], misfits[blurred]
    stamp_error_s, std_s, left = _lowest(motion, float(shifts_s[np.argmin(misfit)]))
    if left > _MOST_LEFT**2 or abs(stamp_error_s) > _WIDEST_SHIFT_S - motion.hold_s:
        msg = (
            f"delay: the frames do not show the mirror's motion (unexplained: {np.sqrt(left):.1f} times "
            f"the noise, at {1e3 * stamp_error_s:+.1f} ms); expected below {_MOST_LEFT:g} times, within "
            f"+-{1e3 * _WIDEST_SHIFT_S:.0f} ms; check that the siderostat is held and the piezo amplifier on"
        )
        raise IdentifyError(msg)
    delays_s = record.tick["time_s"] - record.tick["mid_exposure_s"] - stamp_error_s
    delays_s = delays_s[np.isfinite(delays_s)]
    jitter_s = float(np.std(delays_s))
    median_std_s = np.sqrt(np.pi / 2 / len(delays_s)) * jitter_s
    return DelayResult(
        loop=record.loop,
        stamp_error_s=stamp_error_s,
        stamp_error_std_s=std_s,
        delay_s=float(np.median(delays_s)),
        delay_std_s=float(np.hypot(std_s, median_std_s)),
        jitter_s=jitter_s,
        frames=motion.frames,
        left=float(np.sqrt(left)),
        blurred=blurred,
        shift_s=shifts_s,
        misfit=np.sqrt(misfit),
        delays_s=delays_s,
    )


class _Motion:
    """How well the frames show the motion that was injected, if they were exposed later than stamped.

    Each stack's displacement is a sum of plays of its voltage, with gains to be fitted: a model of any
    hysteresis that does not depend on the rate. What the air does is whitened.
    """

    def __init__(self, record: ExperimentRecord, rig: Rig, exposure_s: float = 0.0) -> None:
        self._record = record
        self._exposure_s = exposure_s
        self._plays_v = _plays(record.injected_v)
        # Integrals, so that an exposure's mean is a difference.
        lasted_s = np.diff(record.injected_s, append=record.injected_s[-1])[:, None]
        self._integral_vs = np.cumsum(self._plays_v * lasted_s, axis=0) - self._plays_v * lasted_s
        self.hold_s = float(np.median(lasted_s[:-1]))
        exposed_s = record.tick["mid_exposure_s"]
        stamped = np.isfinite(exposed_s)
        with_star = stamped & np.isfinite(record.star_px).all(axis=1)
        self.frames, lost = (
            int(np.count_nonzero(with_star)),
            int(np.count_nonzero(stamped & ~with_star)),
        )
        if self.frames < _LEAST_FRAMES or lost > _MOST_LOST * self.frames:
            msg = (
                f"delay: {self.frames} frames with the star and {lost} without; expected at least "
                f"{_LEAST_FRAMES}, and at most {_MOST_LOST:.0%} without; swing less or centre the star"
            )
            raise IdentifyError(msg)
        self._exposed_s = exposed_s[with_star]
        self._whiten = whitener(rig, record.loop, self._exposed_s)
        # Until the first full swing is over, the plays' beginnings are not known.
        self._used = self._exposed_s > record.injected_s[0] + 1.5 / SLOWEST_HZ
        used = int(np.count_nonzero(self._used))
        if used < _LEAST_FRAMES:
            msg = (
                f"delay: {used} frames after the first {1.5 / SLOWEST_HZ:g} s of the motion; expected at least "
                f"{_LEAST_FRAMES}; let the experiment run to its end"
            )
            raise IdentifyError(msg)
        self._wanted = self._whiten(record.star_px[with_star])[self._used]

    def misfits(self, shifts_s: Floats) -> Floats:
        """Mean square of what is left over for each shift, in units of the noise, both axes."""
        return np.concatenate(
            [
                self._misfits(some)
                for some in np.array_split(shifts_s, len(shifts_s) // _AT_ONCE + 1)
            ]
        )

    def _misfits(self, shifts_s: Floats) -> Floats:
        columns = np.stack([self._plays_at(self._exposed_s + shift) for shift in shifts_s], axis=1)
        white = self._whiten(columns.reshape(self.frames, -1)).reshape(columns.shape)
        left = []
        for by in np.moveaxis(white[self._used], 1, 0):
            gains, *_ = np.linalg.lstsq(by, self._wanted, rcond=1e-9)
            left.append(np.mean((self._wanted - by @ gains) ** 2))
        return np.array(left)

    def _plays_at(self, time_s: Floats) -> Floats:
        if self._exposure_s == 0.0:
            return self._plays_v[self._record.row_at(time_s)]
        half_s = self._exposure_s / 2
        moved_vs = self._integral_at(time_s + half_s) - self._integral_at(time_s - half_s)
        return moved_vs / self._exposure_s

    def _integral_at(self, time_s: Floats) -> Floats:
        row = self._record.row_at(time_s)
        since_s = (time_s - self._record.injected_s[row])[:, None]
        return self._integral_vs[row] + self._plays_v[row] * since_s


def _plays(volts: Floats) -> Floats:
    """Plays of each stack's voltages, shape (n, 3 x elements), denser where loops bend more."""
    about_v = volts - volts[:1]
    if not np.any(about_v):
        msg = (
            "delay: the mirror was not moved; expected injected voltages; run the experiment again"
        )
        raise IdentifyError(msg)
    half_widths_v = np.abs(about_v).max() * (np.arange(ELEMENTS) / ELEMENTS) ** 1.5
    return trail(about_v, half_widths_v).reshape(len(volts), -1)


def _lowest(motion: _Motion, near_s: float) -> tuple[float, float, float]:
    """The shift of least misfit, its standard deviation, and that misfit.

    Voltages are held, so the misfit goes in small steps; a parabola over one hold sees past them.
    """
    half_s = float(np.clip(motion.hold_s / 2, 10 * _FINE_STEP_S, _WIDEST_SHIFT_S))
    shifts_s = np.arange(-half_s, half_s + _FINE_STEP_S / 2, _FINE_STEP_S)
    for _ in range(2):  # about the coarse search's lowest, and then about the lowest itself
        misfits = motion.misfits(near_s + shifts_s)
        curve, slope, _ = np.polyfit(shifts_s, misfits, 2)
        if curve <= 0:
            msg = (
                "delay: no time shift explains the frames better than its neighbours; expected the "
                "mirror's swings in the frames; check the piezo amplifier, swing more"
            )
            raise IdentifyError(msg)
        near_s += float(np.clip(-slope / (2 * curve), -half_s, half_s))
    lowest = float(misfits.min())
    # Twice as many numbers as frames, each of the variance that is left: one standard deviation of the
    # shift raises their sum of squares by that variance.
    return near_s, float(np.sqrt(lowest / (curve * 2 * motion.frames))), lowest
