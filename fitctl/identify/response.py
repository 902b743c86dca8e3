"""The fast steering mirror's frequency response, measured on an optical bench (Figs. 5-6).

Each axis is driven with a chirp and both are read on a position-sensing detector at 12.8 kHz. H1 and
coherence come from Welch's method with segments that suit each stretch of frequencies; the modes from a
fit to the complex response.
"""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import chirp, coherence, csd, welch

from fitctl.config import ARCSEC_PER_RAD, Fsm
from fitctl.files import open_regular
from fitctl.identify.drawing import BLACK, BLUE, VERMILION, new_figure
from fitctl.identify.errors import IdentifyError
from fitctl.identify.modes_fit import ModesFit, fit_modes, modes_response
from fitctl.logging.records import MOST
from fitctl.mocks.detector import DetectorBench
from fitctl.model.detector import DETECTOR_RANGE_V, SAMPLE_RATE_HZ, mirror_angles_seen

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Axis = Literal["az", "el"]

AXES: tuple[Axis, Axis] = ("az", "el")
AMPLITUDE_RAD = 7.2 / ARCSEC_PER_RAD
LOWEST_HZ, HIGHEST_HZ = 0.1, 1000.0
CHIRP_S = 120.0  # 9 s an octave: through each mode far slower than it rings
_PAST_HIGHEST = (
    1.03  # the chirp goes a little farther, so that the last frequencies are driven as the others
)
_LEAD_IN_S = 2.0
_LEAD_IN_HZ = 1.0
# From where to where, and segments how long: long ones where motion is slow, short ones, and so more of
# them, above; both resolve what is there (the modes are 13 Hz wide).
_BANDS = ((LOWEST_HZ, 10.0, 20.0), (10.0, HIGHEST_HZ, 1.25))
_COLUMNS = ("time_s", "drive_v", "detector_az_v", "detector_el_v")
_MOST_SAMPLES = 1 << 25  # 43 minutes at 12.8 kHz
_MOST_BYTES = 8 * _MOST_SAMPLES
_CLIPPED = 0.999
_FLAT_HZ = 100.0  # the paper: no resonance appears below


@dataclass(frozen=True)
class BenchRecord:
    """One axis driven, both read.

    Attributes
    ----------
    axis : str
        The driven one.
    rate_hz : float
    drive_rad : array, shape (n,)
        Wanted mirror angle.
    detector_v : array, shape (n, 2)
    """

    axis: Axis
    rate_hz: float
    drive_rad: Floats
    detector_v: Floats


@dataclass(frozen=True)
class ResponseResult:
    """The response of one axis or both.

    Attributes
    ----------
    loop : str
    frequency_hz : array, shape (n,)
    response : array, shape (n, 2, driven), complex
        H1: mirror motion over wanted motion, for each driven axis.
    coherence : array, shape (n, 2, driven)
    fit : ModesFit
    """

    loop: str
    frequency_hz: Floats
    response: Complexes
    coherence: Floats
    fit: ModesFit

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file: what is known of the mirror's mount.

        Raises
        ------
        IdentifyError
            If there are not the two modes that the rig file can describe.
        """
        modes = self.fit.modes
        if len(modes) != 2:
            msg = f"response: {len(modes)} modes found; a rig file describes two; see the plot"
            raise IdentifyError(msg)
        structure = {
            "mode_hz": [mode.frequency_hz.value for mode in modes],
            "damping": float(np.mean([mode.damping.value for mode in modes])),
            "cross_axis": float(abs(np.tan(modes[0].angle_rad.value))),
            "participation": float(np.mean([mode.participation.value for mode in modes])),
        }
        return {"loops": {self.loop: {"fsm": {"structure": structure}}}}

    def lines(self) -> list[str]:
        """For an operator."""
        fit = self.fit
        below = self.frequency_hz < _FLAT_HZ
        lines = []
        for column, axis in enumerate(fit.driven):
            gain_db = 20 * np.log10(fit.gain[column].value)
            excited_db = 20 * np.log10(np.abs(self.response[below, axis, column]))
            lines.append(
                f"{AXES[axis]}: gain below the modes {gain_db:+.2f} dB, flat within "
                f"{np.max(np.abs(excited_db - gain_db)):.2f} dB to {_FLAT_HZ:g} Hz"
            )
        return [
            *lines,
            f"hysteresis lag {np.degrees(fit.lag_rad.value):.2f} deg, bench delay "
            f"{1e6 * fit.delay_s.value:.1f} us",
            *(f"mode {number}: {mode}" for number, mode in enumerate(fit.modes, start=1)),
            f"fit within {fit.misfit:.1%} RMS of the response",
        ]

    def draw(self) -> Figure:
        """Figs. 5-6: magnitude, phase and coherence, excited and cross axis, with the fitted modes."""
        figure = new_figure(11.0, 7.5)
        panels = figure.subplots(3, len(self.fit.driven), sharex=True, sharey="row", squeeze=False)
        fitted = modes_response(self.fit, self.frequency_hz)
        for column, axis in enumerate(self.fit.driven):
            self.draw_axis(panels[:, column], column, fitted[:, :, column], "fit")
            panels[0, column].set_title(f"{AXES[axis]} driven, loop {self.loop}")
        for panel in panels[:, 1:].flat:
            panel.set_ylabel("")
        return figure

    def draw_axis(self, panels: NDArray[Any], column: int, beside: Complexes, label: str) -> None:
        """Gain, phase and coherence of one driven axis on three axes; dashed another response, (n, 2)."""
        gain, phase, coherence = panels
        hz, driven = self.frequency_hz, self.fit.driven[column]
        for row, color, word in ((driven, BLUE, "excited"), (1 - driven, VERMILION, "cross")):
            gain_db = 20 * np.log10(np.abs(self.response[:, row, column]))
            gain.semilogx(hz, gain_db, color=color, linewidth=0.9, label=f"{AXES[row]}, {word}")
            # Axes that are exactly uncoupled at rest have no cross motion to show below.
            beside_db = 20 * np.log10(np.maximum(np.abs(beside[:, row]), 1e-6))
            label_once = label if row == driven else None
            gain.semilogx(hz, beside_db, "--", color=BLACK, linewidth=0.7, label=label_once)
            coherence.semilogx(hz, self.coherence[:, row, column], color=color, linewidth=0.8)
        phase_deg = np.degrees(np.unwrap(np.angle(self.response[:, driven, column])))
        phase.semilogx(hz, phase_deg, color=BLUE, linewidth=0.9)
        gain.set(ylabel="mirror / command (dB)", ylim=(-80, 25))
        gain.legend(loc="lower left")
        phase.set(ylabel="phase, excited (deg)")
        coherence.set(ylabel="coherence", xlabel="frequency (Hz)", ylim=(0, 1.05))
        for panel in panels:
            panel.grid(which="both", alpha=0.3)


def drive() -> Floats:
    """The paper's chirp, +-7.2 arcsec from 0.1 Hz to 1 kHz, by equal times an octave, shape (n,)."""
    time_s = np.arange(round(CHIRP_S * SAMPLE_RATE_HZ)) / SAMPLE_RATE_HZ
    return AMPLITUDE_RAD * chirp(
        time_s, LOWEST_HZ, CHIRP_S, HIGHEST_HZ * _PAST_HIGHEST, method="logarithmic", phi=-90
    )


def measure(
    bench: DetectorBench, on_axis: Callable[[Axis], None] = lambda _axis: None
) -> list[BenchRecord]:
    """Drive each axis of a bench; `on_axis` hears which one comes next.

    Two full swings come first and are left out: stacks that never moved so far, or moved farther, close
    their hysteresis loop only then.
    """
    time_s = np.arange(round(_LEAD_IN_S * SAMPLE_RATE_HZ)) / SAMPLE_RATE_HZ
    lead_in_rad = AMPLITUDE_RAD * np.sin(2 * np.pi * _LEAD_IN_HZ * time_s)
    drive_rad = drive()
    records = []
    for axis in AXES:
        on_axis(axis)
        detector_v = bench.measure(axis, np.concatenate([lead_in_rad, drive_rad]))
        records.append(BenchRecord(axis, SAMPLE_RATE_HZ, drive_rad, detector_v[len(lead_in_rad) :]))
    return records


def read_bench(path: Path, fsm: Fsm) -> BenchRecord:
    """A record of a real bench: NPZ, or CSV with a header line.

    Its columns are time_s, drive_v, detector_az_v and detector_el_v. ``drive_v`` is the D/A's voltage on
    the driven axis's stacks (Eq. 1: SF_PZT / r radians a volt); an offset is left out. The driven axis is
    the one that moved more.

    Raises
    ------
    IdentifyError
        If the file cannot be read as such, or is not evenly sampled.
    """
    try:
        columns = _read_columns(path)
    except Exception as error:  # a damaged file can raise any of a dozen kinds
        plain = isinstance(error, OSError | ValueError)
        why = str(error) if plain else f"{type(error).__name__}: {error}"
        msg = f"not a bench record ({why}); expected NPZ or CSV with {', '.join(_COLUMNS)}"
        raise IdentifyError(msg) from error
    time_s, drive_v, *detector = columns
    steps_s = np.diff(time_s)
    if len(steps_s) == 0 or np.ptp(steps_s) > 0.1 * abs(steps_s.mean()) or steps_s.mean() <= 0:
        msg = "time_s does not rise evenly; expected samples at a constant rate"
        raise IdentifyError(msg)
    detector_v = np.column_stack(detector)
    return BenchRecord(
        axis=AXES[int(np.argmax(np.std(detector_v, axis=0)))],
        rate_hz=float(1 / steps_s.mean()),
        drive_rad=(drive_v - drive_v.mean()) * fsm.stack_scale_m_per_v / fsm.stack_radius_m,
        detector_v=detector_v,
    )


def _read_columns(path: Path) -> list[Floats]:
    if path.suffix == ".npz":
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            columns = [_unpacked(archive, name) for name in _COLUMNS]
    else:
        with io.TextIOWrapper(open_regular(path), encoding="utf-8-sig") as stream:
            header = [name.strip() for name in stream.readline().split(",")]
            missing = [name for name in _COLUMNS if name not in header]
            if missing:
                msg = f"its first line does not name {', '.join(missing)}"
                raise ValueError(msg)
            places = [header.index(name) for name in _COLUMNS]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of a file without samples
                columns = list(
                    np.loadtxt(stream, delimiter=",", usecols=places, unpack=True, ndmin=2)
                )
    if len({column.shape for column in columns}) != 1 or columns[0].ndim != 1:
        msg = "columns of unequal length"
        raise ValueError(msg)
    if not all(np.all(np.abs(column) < MOST) for column in columns):  # NaN is not
        msg = "a value is missing, not a number or beyond all that an instrument has"
        raise ValueError(msg)
    return columns


def _unpacked(archive: zipfile.ZipFile, name: str) -> Floats:
    """A column of an NPZ file; whatever its headers promise, no more than is allowed is kept in memory."""
    member = archive.getinfo(f"{name}.npy")
    # Of other methods, the standard library unpacks all that there is at once.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        msg = f"{name} is packed as numpy.savez and numpy.savez_compressed do not pack"
        raise ValueError(msg)
    if member.file_size > _MOST_BYTES:
        msg = f"{name} has {member.file_size} bytes once unpacked; expected at most {_MOST_BYTES}"
        raise ValueError(msg)
    with archive.open(member) as packed:  # one byte more, for its checksum to be compared
        column = np.lib.format.read_array(io.BytesIO(packed.read(member.file_size + 1)))
    if column.size > _MOST_SAMPLES:
        msg = f"{name} has {column.size} samples; expected at most {_MOST_SAMPLES}"
        raise ValueError(msg)
    return np.asarray(column, dtype=np.float64)


def analyse(records: Sequence[BenchRecord], loop_name: str) -> ResponseResult:
    """Response and modes from a record of one axis, or better of each.

    Raises
    ------
    IdentifyError
        If two records do not go together, the detector was driven out of its range, a record is too
        short, or no resonance is found.
    """
    ordered = sorted(records, key=lambda record: AXES.index(record.axis))
    driven = tuple(AXES.index(record.axis) for record in ordered)
    if len(set(driven)) != len(ordered) or not ordered:
        given = ", ".join(record.axis for record in ordered) or "none"
        msg = f"response: records of {given}; expected one of az, of el, or one of each"
        raise IdentifyError(msg)
    spectra = [_spectra(record) for record in ordered]
    frequency_hz = spectra[0][0]
    if not all(np.array_equal(other, frequency_hz) for other, _, _ in spectra):
        msg = "response: the two records differ in their rate; record both alike"
        raise IdentifyError(msg)
    response = np.stack([h for _, h, _ in spectra], axis=-1)
    coherences = np.stack([c for _, _, c in spectra], axis=-1)
    fit = fit_modes(frequency_hz, response, driven)
    return ResponseResult(loop_name, frequency_hz, response, coherences, fit)


def _spectra(record: BenchRecord) -> tuple[Floats, Complexes, Floats]:
    """Frequencies (n,), H1 and coherence (n, 2) of one record, stretch by stretch."""
    if np.any(np.abs(record.detector_v) >= _CLIPPED * DETECTOR_RANGE_V):
        msg = (
            f"response, {record.axis}: the detector reached its +-{DETECTOR_RANGE_V:g} V; "
            "expected less; drive with a smaller amplitude or centre the spot"
        )
        raise IdentifyError(msg)
    mirror_rad = mirror_angles_seen(record.detector_v).T
    still = [
        name
        for name, values in (("drive_v", record.drive_rad), ("the detector", mirror_rad))
        if not np.ptp(values, axis=-1).any()
    ]
    if still:
        msg = (
            f"response, {record.axis}: {still[0]} does not change; expected a mirror that is driven over the "
            "whole band, and the spot on the detector; record it again"
        )
        raise IdentifyError(msg)
    longest_s = max(segment_s for _, _, segment_s in _BANDS)
    if len(record.drive_rad) < 2 * longest_s * record.rate_hz:
        msg = (
            f"response, {record.axis}: {len(record.drive_rad) / record.rate_hz:.1f} s; "
            f"expected at least {2 * longest_s:g} s; take a longer record"
        )
        raise IdentifyError(msg)
    if record.rate_hz < 2.5 * HIGHEST_HZ:
        msg = (
            f"response: sampled at {record.rate_hz:g} Hz; expected {2.5 * HIGHEST_HZ:g} Hz or more"
        )
        raise IdentifyError(msg)
    drive_rad = record.drive_rad
    parts = []
    for low_hz, high_hz, segment_s in _BANDS:
        welch_of: dict[str, Any] = {
            "fs": record.rate_hz,
            "nperseg": round(segment_s * record.rate_hz),
        }
        frequency_hz, driven = welch(drive_rad, **welch_of)
        _, cross = csd(drive_rad, mirror_rad, **welch_of)
        with np.errstate(invalid="ignore"):  # with an axis that stands still, it is not defined
            _, coherent = coherence(drive_rad, mirror_rad, **welch_of)
        # A stretch has its lower end and leaves its upper end to the next.
        inside = (frequency_hz > low_hz - 1e-9) & (frequency_hz < high_hz - 1e-9)
        parts.append((frequency_hz[inside], (cross / driven)[:, inside].T, coherent[:, inside].T))
    frequencies, responses, coherences = zip(*parts, strict=True)
    return np.concatenate(frequencies), np.concatenate(responses), np.concatenate(coherences)
