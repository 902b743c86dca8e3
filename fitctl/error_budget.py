"""The error budget of a stellar loop: how much of the measured error each cause is responsible for.

The console computes it from telemetry, the report from a log. Both pass in what theory knows of the loop
(:class:`LoopTheory`, from :func:`fitctl.controllers.design.theory.loop_theory`) and its ticks.

Each cause's share is by how much the mean square of the error falls when the cause is removed. The causes are
removed in a fixed order, so the shares add up to the whole; docs/theory.md derives the terms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.model.hysteresis import displacement_series

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Columns = Mapping[str, Any]

SEGMENT_S = 8.0
"""Length of a segment of spectra that are drawn: 0.125 Hz a bin."""
BUDGET_SEGMENT_S = 64.0
"""Of spectra that are only summed, so that they need not be smooth, but include slow motion."""
AFTER_DARK_S = 0.5
"""For so long after a frame without a star the error counts as caused by the missing light."""
LONGEST_GAP_S = 0.5
"""Frames missing for longer end a piece; shorter gaps are bridged, linearly, for spectra alone."""
DIFFERS = 1.5
"""Measured and expected residual differ if their ratio is beyond this."""
CAUSES = (
    "air",
    "delay and hold",
    "camera noise",
    "hysteresis and backlash",
    "missing light",
    "unexplained",
)
_LEAST_FRAMES = 64
_TAPERED = 0.2  # of the segments of a budget: nearly all frames count alike
_OVERLAPPING = 4  # segments at any time
_SEGMENTS_AT_ONCE = 256


class LoopTheory(NamedTuple):
    """What the rig file and the design in use say of one loop.

    Attributes
    ----------
    frequency_hz : array, shape (n,)
        Ascending, up to half the frame rate.
    sensitivity : complex array, shape (n,)
        Error over disturbance, by the linear loop with delay and hold.
    undelayed : array, shape (n,)
        Magnitude of the same for a loop of the same kind without delay and hold.
    disturbance_px2_per_hz : array, shape (n,)
        One-sided power spectral density, on frames, of what is expected to move the star: air path and lines.
    noise_px, flux_dn : float
        One standard deviation of the place of a star of so much light. Less light means more noise, in
        proportion. If `flux_dn` is nan, the noise is the same with any light.
    period_s : float
        Of frames.
    mirror_px_per_rad, motor_px_per_rad : arrays, shape (2, 2)
        From the stages' angles to the star's motion.
    hysteresis_known : bool
        The stacks' hysteresis is identified. Otherwise the mirror counts as where its command puts it.
    backlash_rad : float
        Half width of the play behind the siderostat's encoders, in motor angle; nan where it is not identified.
    link_px_per_rad : array, shape (2, 2)
        The same as `motor_px_per_rad` for the siderostat of the loop's link; zero without a link.
    link_backlash_rad : float
    """

    frequency_hz: Floats
    sensitivity: Complexes
    undelayed: Floats
    disturbance_px2_per_hz: Floats
    noise_px: float
    flux_dn: float
    period_s: float
    mirror_px_per_rad: Floats
    motor_px_per_rad: Floats
    hysteresis_known: bool
    backlash_rad: float
    link_px_per_rad: Floats
    link_backlash_rad: float


def theory_to_plain(theory: LoopTheory) -> dict[str, Any]:
    """A theory as JSON has it."""
    plain = {name: np.asarray(value).tolist() for name, value in theory._asdict().items()}
    plain["sensitivity"] = [theory.sensitivity.real.tolist(), theory.sensitivity.imag.tolist()]
    return plain


def theory_from_plain(plain: Mapping[str, Any]) -> LoopTheory:
    """The theory that :func:`theory_to_plain` wrote; null is nan."""
    real, imaginary = np.array(plain["sensitivity"], dtype=float)
    values: dict[str, Any] = {
        name: np.array(value, dtype=float) if isinstance(value, list) else value
        for name, value in plain.items()
    }
    unknown = {name: math.nan for name, value in plain.items() if value is None}
    values |= unknown | {"sensitivity": real + 1j * imaginary}
    return LoopTheory(**values)


class Motion(NamedTuple):
    """What the ticks of a loop say of its star, each of shape (ticks, 2), in px.

    Attributes
    ----------
    error_px : array
        Star less target; NaN without a star.
    disturbance_px : array
        The error less where the stages had moved the star: the open loop, rebuilt.
    misplaced_px : array
        Where the stages had moved the star, less where they were by their commands and encoders: hysteresis
        and backlash.
    """

    error_px: Floats
    disturbance_px: Floats
    misplaced_px: Floats


def motion(theory: LoopTheory, ticks: Columns, mirror_rad: Floats | None = None) -> Motion:
    """Rebuild the disturbance and the stages' errors from ticks in their order.

    Parameters
    ----------
    theory : LoopTheory
    ticks : mapping of str to array, shape (ticks,)
        Fields of :class:`fitctl.logging.records.Tick`. The backlash depends on what went before, so include
        more ticks than are evaluated.
    mirror_rad : array, shape (ticks, 2), optional
        Where the mirror was at mid-exposure, by the identified hysteresis; by default as the ticks have it.
    """
    error_px = _pair(ticks, "error_{}_px")
    if mirror_rad is None:
        mirror_rad = _pair(ticks, "mirror_{}_rad")
    commanded_rad = _pair(ticks, "fsm_{}_rad")[in_force(ticks)]
    motor_rad = _pair(ticks, "siderostat_{}_rad")
    played_px = (_played(motor_rad, theory.backlash_rad) - motor_rad) @ theory.motor_px_per_rad.T
    stages_px = mirror_rad @ theory.mirror_px_per_rad.T + motor_rad @ theory.motor_px_per_rad.T
    # A motion that is known is no disturbance. From its first value on: a clock's whole time would cost digits.
    sky_rad = _pair(ticks, "sky_{}_rad")
    moved = np.isfinite(sky_rad[:, 0])
    if moved.any():
        stages_px += (
            np.where(moved[:, None], sky_rad - sky_rad[moved][0], 0.0) @ theory.motor_px_per_rad.T
        )
    if theory.link_px_per_rad.any():
        link_rad = _pair(ticks, "link_{}_rad")
        slack_rad = _played(link_rad, theory.link_backlash_rad) - link_rad
        played_px += slack_rad @ theory.link_px_per_rad.T
        stages_px += link_rad @ theory.link_px_per_rad.T
    return Motion(
        error_px,
        error_px - stages_px - played_px,
        (mirror_rad - commanded_rad) @ theory.mirror_px_per_rad.T + played_px,
    )


def in_force(ticks: Columns) -> NDArray[np.intp]:
    """Row of the tick whose command the mirror had at mid-exposure, shape (ticks,); 0 where none is earlier.

    A command acts from its tick's end until the next one's.
    """
    rows = np.searchsorted(ticks["time_s"], ticks["mid_exposure_s"], side="right") - 1
    return np.asarray(np.maximum(rows, 0))


def _pair(ticks: Columns, field: str) -> Floats:
    return np.stack([ticks[field.format(axis)] for axis in ("az", "el")], axis=-1, dtype=float)


def _played(motor_rad: Floats, half_width_rad: float) -> Floats:
    """Output of a play behind each motor, shape (ticks, 2), from the middle of its gap."""
    known = np.isfinite(motor_rad[:, 0] + motor_rad[:, 1])
    if math.isnan(half_width_rad) or not known.any():
        return motor_rad
    first_rad = motor_rad[known][0]
    # A tick without a reading repeats the one before.
    row = np.maximum.accumulate(np.where(known, np.arange(len(known)), np.argmax(known)))
    moved = displacement_series(
        motor_rad[row] - first_rad, np.array([half_width_rad]), np.ones((2, 1))
    )
    return np.where(known[:, None], first_rad + moved, np.nan)


class Spectra(NamedTuple):
    """One-sided power spectral densities, px²/Hz, shape (frequencies, 2) for az and el.

    Attributes
    ----------
    frequency_hz : array, shape (frequencies,)
        Above zero.
    error, disturbance : arrays
        Both hold the camera's noise.
    placed : array
        The error without hysteresis and backlash: less the response of the linear loop to them.
    """

    frequency_hz: Floats
    error: Floats
    disturbance: Floats
    placed: Floats


def spectra(
    found: Motion,
    exposed_s: Floats,
    pieces: Sequence[NDArray[np.intp]],
    period_s: float,
    theory: LoopTheory | None = None,
    *,
    segment_s: float = SEGMENT_S,
    tapered: float = 1.0,
) -> Spectra | None:
    """Spectra by Welch's method: overlapping segments, means removed; None of too few frames.

    Parameters
    ----------
    found : Motion
    exposed_s : array, shape (ticks,)
        Of mid-exposure.
    pieces : sequence of array of int
        Rows of ticks with a star; within a piece, short gaps are bridged by straight lines.
    period_s : float
        Of frames.
    theory : LoopTheory, optional
        Without it, `placed` is the error.
    segment_s : float
        Of a segment; where no piece is as long, the longest piece is one.
    tapered : float
        Part of a segment over which its window rises and falls (Tukey); 1 is a Hann window.
    """
    series = [
        regular(
            exposed_s[rows],
            np.hstack([found.error_px[rows], found.disturbance_px[rows], found.misplaced_px[rows]]),
            period_s,
        )
        for rows in pieces
        if len(rows) >= _LEAST_FRAMES
    ]
    if not series:
        return None
    longest = max(len(values) for values in series)
    length = min(round(segment_s / period_s), longest)
    window = taper(length, tapered)
    frequency_hz = np.asarray(np.fft.rfftfreq(length, period_s)[1:], dtype=float)
    sensitivity = (
        np.zeros((len(frequency_hz), 1))
        if theory is None
        else _at(theory.frequency_hz, theory.sensitivity, frequency_hz)[:, None]
    )
    sums = np.zeros((3, len(frequency_hz), 2))
    segments = 0
    for values in series:
        for transformed in _segments(values, window):
            error, disturbance, misplaced = np.split(transformed, 3, axis=2)
            for number, part in enumerate((error, disturbance, error - sensitivity * misplaced)):
                sums[number] += np.sum(part.real**2 + part.imag**2, axis=0)
            segments += len(transformed)
    return Spectra(frequency_hz, *(2 * period_s / np.sum(window**2) / segments * sums))


def taper(length: int, part: float) -> Floats:
    """A window, shape (length,), that rises and falls over a part of it (Tukey); 1 is a Hann window."""
    from_end = np.minimum(np.arange(length), length - np.arange(length)) / length
    return np.asarray(np.sin(math.pi / 2 * np.minimum(1.0, 2 * from_end / part)) ** 2)


def _segments(values: Floats, window: Floats) -> Any:
    """Transforms of overlapping segments above zero, shape (segments, frequencies, columns), some at a time."""
    if len(values) < len(window):
        return
    views = np.lib.stride_tricks.sliding_window_view(values, len(window), axis=0)
    views = views[:: max(1, len(window) // _OVERLAPPING)]
    for first in range(0, len(views), _SEGMENTS_AT_ONCE):
        part = views[first : first + _SEGMENTS_AT_ONCE]
        part = (part - part.mean(axis=-1, keepdims=True)) * window
        yield np.fft.rfft(part, axis=-1)[..., 1:].swapaxes(1, 2)


def _at(frequency_hz: Floats, values: Any, wanted_hz: NDArray[np.floating]) -> Any:
    return np.interp(np.log(wanted_hz), np.log(frequency_hz), values)


class Budget(NamedTuple):
    """The mean square of the measured error, both axes' mean, by cause.

    Attributes
    ----------
    measured_px2 : float
    shares_px2 : dict of str to float
        By `CAUSES`; their sum is `measured_px2`. A share that is hardly there may come out a little below zero.
    expected_px2 : dict of str to float
        The same as the design and the rig file have them; 0 where theory expects nothing.
    evaluated_s : float
    """

    measured_px2: float
    shares_px2: dict[str, float]
    expected_px2: dict[str, float]
    evaluated_s: float

    @property
    def measured_px(self) -> float:
        """RMS of one axis."""
        return math.sqrt(self.measured_px2)

    @property
    def expected_px(self) -> float:
        """RMS of one axis that theory expects on the camera, its noise included."""
        return math.sqrt(sum(self.expected_px2.values()))

    @property
    def fractions(self) -> dict[str, float]:
        """Parts of the whole; their sum is 1."""
        return {cause: share / self.measured_px2 for cause, share in self.shares_px2.items()}

    @property
    def expected_fractions(self) -> dict[str, float]:
        """The same of what theory expects."""
        whole = sum(self.expected_px2.values())
        return {cause: share / whole for cause, share in self.expected_px2.items()}

    @property
    def percent(self) -> dict[str, int]:
        """The fractions in whole percent, rounded so that their sum is 100."""
        exact = {cause: 100 * part for cause, part in self.fractions.items()}
        rounded = {cause: math.floor(part) for cause, part in exact.items()}
        by_rest = sorted(exact, key=lambda cause: rounded[cause] - exact[cause])
        for cause in by_rest[: 100 - sum(rounded.values())]:
            rounded[cause] += 1
        return rounded

    @property
    def parts(self) -> str:
        """The causes that there are, in whole percent, as a text."""
        return ", ".join(f"{cause} {part} %" for cause, part in self.percent.items() if part)

    @property
    def as_expected(self) -> bool:
        """Measured and expected residual agree within a factor of `DIFFERS`."""
        return 1 / DIFFERS <= self.measured_px / self.expected_px <= DIFFERS

    @property
    def verdict(self) -> str:
        """Measured and expected residual in words, with the cause that explains most of a difference."""
        text = f"{self.measured_px:.3f} px, expected {self.expected_px:.3f}"
        if self.as_expected:
            return f"{text}: as expected"
        excess = {
            cause: share - self.expected_px2[cause] for cause, share in self.shares_px2.items()
        }
        if self.measured_px > self.expected_px:
            return f"{text}: excess mostly {max(excess, key=lambda cause: excess[cause])}"
        return f"{text}: less {min(excess, key=lambda cause: excess[cause])}"


def budget(
    theory: LoopTheory,
    ticks: Columns,
    found: Motion,
    pieces: Sequence[NDArray[np.intp]],
) -> Budget | None:
    """The shares of all causes; None of too few frames, and of an error that is zero throughout.

    Parameters
    ----------
    theory : LoopTheory
    ticks : mapping of str to array, shape (ticks,)
        As :func:`motion` takes them; with ``star_flux_dn``.
    found : Motion
    pieces : sequence of array of int
        Rows of the ticks with a star that are evaluated.
    """
    density = spectra(
        found,
        ticks["mid_exposure_s"],
        pieces,
        theory.period_s,
        theory,
        segment_s=BUDGET_SEGMENT_S,
        tapered=_TAPERED,
    )
    if density is None or not density.error.any():
        return None
    rows = np.concatenate(pieces)
    squares = np.mean(found.error_px[rows] ** 2, axis=1)
    measured = float(squares.mean())
    dark = _after_dark(ticks["mid_exposure_s"], pieces, theory.period_s)
    lit = float(squares[~dark].mean()) if not dark.all() else measured
    step_hz = density.frequency_hz[0]
    error, placed = (
        float(of.mean(axis=1).sum() * step_hz) for of in (density.error, density.placed)
    )
    followed, disturbance = _power(theory, density.frequency_hz), density.disturbance.mean(axis=1)
    linear = float(followed.sensitivity @ disturbance * step_hz)
    # White: the same density at every frequency up to half the frame rate.
    dimmer = np.ones(1)
    if not math.isnan(theory.flux_dn):
        dimmer = theory.flux_dn / np.asarray(ticks["star_flux_dn"], dtype=float)[rows]
    noise_px2 = float(np.mean((theory.noise_px * dimmer) ** 2))
    white = 2 * theory.period_s * noise_px2
    noise = float(followed.sensitivity.sum() * step_hz * white)
    undelayed = float(followed.undelayed @ (disturbance - white) * step_hz)
    shares = {
        "air": undelayed,
        "delay and hold": linear - noise - undelayed,
        "camera noise": noise,
        "hysteresis and backlash": error - placed,
        "missing light": measured - lit,
    }
    shares["unexplained"] = measured - sum(shares.values())
    return Budget(measured, shares, _expected(theory), len(rows) * theory.period_s)


class _Power(NamedTuple):
    """Squared magnitudes of error over disturbance, shape (frequencies,)."""

    sensitivity: Floats
    undelayed: Floats


def _power(theory: LoopTheory, frequency_hz: Floats) -> _Power:
    sensitivity = np.abs(_at(theory.frequency_hz, theory.sensitivity, frequency_hz)) ** 2
    return _Power(sensitivity, _at(theory.frequency_hz, theory.undelayed, frequency_hz) ** 2)


def _expected(theory: LoopTheory) -> dict[str, float]:
    frequency_hz, moving = theory.frequency_hz, theory.disturbance_px2_per_hz
    sensitivity, undelayed = np.abs(theory.sensitivity) ** 2, theory.undelayed**2
    white = 2 * theory.period_s * theory.noise_px**2
    return {
        **dict.fromkeys(CAUSES, 0.0),
        "air": float(np.trapezoid(undelayed * moving, frequency_hz)),
        "delay and hold": float(np.trapezoid((sensitivity - undelayed) * moving, frequency_hz)),
        "camera noise": float(np.trapezoid(sensitivity * white, frequency_hz)),
    }


def predicted(theory: LoopTheory, frequency_hz: Floats) -> Floats:
    """Density of the error that the design leaves of what it expects and the camera's noise, px²/Hz."""
    white = 2 * theory.period_s * theory.noise_px**2
    moving = np.exp(_at(theory.frequency_hz, np.log(theory.disturbance_px2_per_hz), frequency_hz))
    return np.asarray(_power(theory, frequency_hz).sensitivity * (moving + white))


def pieces_of(at_s: Floats, usable: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Rows of usable ticks, in pieces of which none lacks anything for longer than `LONGEST_GAP_S`."""
    rows = np.flatnonzero(usable)
    pieces = np.split(rows, np.flatnonzero(ends_piece(at_s[rows])) + 1)
    return [piece for piece in pieces if len(piece) > 1]


def ends_piece(at_s: Floats) -> NDArray[np.bool_]:
    """Whether a piece ends between each time and the next: frames are missing for long, or times go back."""
    step_s = np.diff(at_s)
    return (step_s > LONGEST_GAP_S) | (step_s < 0)


def _after_dark(
    exposed_s: Floats, pieces: Sequence[NDArray[np.intp]], period_s: float
) -> NDArray[np.bool_]:
    """Which rows of all pieces are of frames soon after one without a star."""
    marked = []
    for rows in pieces:
        at_s = exposed_s[rows]
        missing = np.diff(at_s, prepend=at_s[0]) > 1.5 * period_s
        last = np.where(missing, at_s, -np.inf)
        marked.append(at_s - np.maximum.accumulate(last) < AFTER_DARK_S)
    return np.concatenate(marked)


def regular(time_s: Floats, values: NDArray[np.floating], period_s: float) -> Floats:
    """Values, shape (frames, n), once a period: what is missing is bridged by straight lines."""
    frames = 1 + round((time_s[-1] - time_s[0]) / period_s)
    if frames == len(time_s):
        return np.asarray(values, dtype=float)
    grid_s = np.linspace(time_s[0], time_s[-1], frames)
    return np.column_stack([np.interp(grid_s, time_s, column) for column in values.T])
