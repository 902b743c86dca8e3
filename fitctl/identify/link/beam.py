"""The photodiodes' scale and the link's delay, from a beam that the siderostat moves over the photodiodes.

The encoders say where the beam is, but for the siderostat's play. A Gaussian beam on photodiodes at known
places then gives its radius, its power and its place; a sample that was taken later than its time stamp says
appears as a shift along the motion. A play does so too, but by the same distance at every speed; therefore the
beam is moved at two speeds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matmul_toeplitz
from scipy.optimize import least_squares

from fitctl.config import ARCSEC_PER_RAD, AirPathModel, MetrologyLoop, Rig
from fitctl.identify.backlash import behind_play
from fitctl.identify.drawing import new_figure
from fitctl.identify.errors import IdentifyError, require_times
from fitctl.identify.link.ambient import DIODES, SIDES
from fitctl.identify.record import axis_pair
from fitctl.identify.slow_mean import correlation
from fitctl.logging.reading import Columns
from fitctl.logging.records import MOST
from fitctl.model.metrology.photodiodes import diode_volts
from fitctl.model.optics import rotation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
STEP = "beam_scan"
Kind = TypeVar("Kind", bound="BeamResult")
_LEAST_SAMPLES = 1000
_LEAST_SWING_M = 0.5  # of the beam's radius, along each axis
_MOST_EXCESS = 5.0
_WIDEST_SHIFT_S = 0.05
_BIN_S = 0.25  # the air hardly moves meanwhile
_USED = (
    *("time_s", "sampled_s", "encoder_read_s"),
    *(f"{name}_{axis}_rad" for name in ("siderostat", "encoder") for axis in ("az", "el")),
    *(f"diode_{side}_v" for side in SIDES),
)
_DIODE_PLACES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


class Found(NamedTuple):
    """What is fitted, in this order; each with its standard deviation elsewhere in the same form.

    Angles and places are in units that make all of them of the order of 1. The ambient voltages only help the
    fit, and their deviations come out too small: a scan without the beam measures them.
    """

    place_az_mm: float
    place_el_mm: float
    beam_radius_mm: float
    on_axis_v: float
    late_ms: float
    play_az_arcsec: float
    play_el_arcsec: float
    start_az: float
    start_el: float
    ambient_az_plus_v: float
    ambient_az_minus_v: float
    ambient_el_plus_v: float
    ambient_el_minus_v: float


@dataclass(frozen=True)
class BeamResult:
    """What a scan of the beam shows.

    Attributes
    ----------
    loop : str
    found, sd : Found
        Values and standard deviations. `late_ms` is by how much later than stamped a sample was taken; the
        plays are whole widths, and the starts are where in them the beam was at first.
    delay_s, delay_sd_s : float
        From a sample, as truly taken, to the tick that used it: median over ticks, and one standard deviation.
    jitter_s : float
        Standard deviation of a single sample's delay.
    excess : float
        RMS of what neither the model nor a motion of the beam explains, over the photodiodes' noise.
    air_arcsec : float
        RMS of the beam's own motion, beside the siderostat's.
    before : MetrologyLoop
        The rig file's.
    place_mm, volts, left_v : arrays, shape (samples, 2), (samples, 4), (samples, 4)
        The beam, what was measured, and what is left after the fit.
    """

    loop: str
    found: Found
    sd: Found
    delay_s: float
    delay_sd_s: float
    jitter_s: float
    excess: float
    air_arcsec: float
    before: MetrologyLoop
    place_mm: Floats = field(repr=False)
    volts: Floats = field(repr=False)
    left_v: Floats = field(repr=False)

    def _common_lines(self) -> list[str]:
        found, sd = self.found, self.sd
        return [
            f"backlash {found.play_az_arcsec:.2f} +- {sd.play_az_arcsec:.2f} arcsec az, "
            f"{found.play_el_arcsec:.2f} +- {sd.play_el_arcsec:.2f} arcsec el",
            f"the beam moves by {self.air_arcsec:.3f} arcsec RMS of its own; unexplained: {self.excess:.2f} "
            f"times noise_v, {len(self.volts)} samples",
        ]

    def draw(self) -> Figure:
        """Each photodiode's volts, and what is left of them, against the beam's place along its own axis."""
        figure = new_figure(10.0, 7.0)
        panels = figure.subplots(2, 2, sharex="col")
        for number, name in enumerate(DIODES):
            axis = number // 2
            place_mm = self.place_mm[:, axis]
            panels[0, axis].plot(place_mm, self.volts[:, number], ".", ms=2, label=name)
            panels[1, axis].plot(place_mm, 1e3 * self.left_v[:, number], ".", ms=2, label=name)
        for axis, name in enumerate(("az", "el")):
            panels[0, axis].set(title=f"beam's {name}", ylabel="V")
            panels[1, axis].set(
                xlabel=f"beam from the centre in {name}, mm", ylabel="left after the fit, mV"
            )
        for panel in panels.flat:
            panel.grid(alpha=0.3)
            panel.legend(markerscale=4)
        figure.suptitle(f"Photodiodes of loop {self.loop}")
        return figure


class PhotodiodesResult(BeamResult):
    """The scale of the photodiodes."""

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file."""
        sensor = {
            "beam_radius_m": round(1e-3 * self.found.beam_radius_mm, 7),
            "on_axis_v": round(self.found.on_axis_v, 4),
        }
        return {"loops": {self.loop: {"sensor": sensor}}}

    def lines(self) -> list[str]:
        """For an operator."""
        found, sd, sensor = self.found, self.sd, self.before.sensor
        return [
            f"beam radius {found.beam_radius_mm:.3f} +- {sd.beam_radius_mm:.3f} mm (1/e^2; rig file "
            f"{1e3 * sensor.beam_radius_m:g} mm)",
            f"on the centre {found.on_axis_v:.4f} +- {sd.on_axis_v:.4f} V (rig file {sensor.on_axis_v:g} V)",
            *self._common_lines(),
        ]


class LinkDelayResult(BeamResult):
    """The delay of the link."""

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file."""
        return {"loops": {self.loop: {"sensor": {"link_delay_s": round(self.delay_s, 5)}}}}

    def lines(self) -> list[str]:
        """For an operator."""
        return [
            f"link delay {1e3 * self.delay_s:.2f} +- {1e3 * self.delay_sd_s:.2f} ms from a sample to the tick "
            f"that uses it (one sample's: {1e3 * self.jitter_s:.2f} ms RMS; rig file "
            f"{1e3 * self.before.sensor.link_delay_s:g} ms)",
            f"samples are taken {self.found.late_ms:+.2f} +- {self.sd.late_ms:.2f} ms from their time stamps",
            *self._common_lines(),
        ]


class _Scan:
    """Samples of a scan, and what the model makes of them."""

    def __init__(self, rig: Rig, loop_name: str, ticks: Columns) -> None:
        loop = rig.metrology_loops[loop_name]
        sensor = loop.sensor
        usable = np.all([np.abs(ticks[name]) < MOST for name in _USED], axis=0)  # NaN is not
        usable &= ticks["mode"] == "STANDBY"
        ticks = {name: column[usable] for name, column in ticks.items()}
        self.volts = np.stack([ticks[f"diode_{side}_v"] for side in SIDES], axis=-1)
        if len(self.volts) < _LEAST_SAMPLES:
            msg = (
                f"the photodiodes gave {len(self.volts)} samples during the scan, expected at least "
                f"{_LEAST_SAMPLES}; run the step {STEP} with more cycles"
            )
            raise IdentifyError(msg)
        require_times(ticks["sampled_s"], rig.camera.period_s, "samples")
        self.sensor = sensor
        self.sampled_s = ticks["sampled_s"]
        self.delays_s = ticks["time_s"] - self.sampled_s
        self._turn_mm = 1e3 * sensor.link_length_m * rotation(loop.siderostat.rotation_deg).T
        self._arcsec_rad = loop.siderostat.sky_arcsec_per_motor_rad
        counts_per_rev = loop.siderostat.encoder_counts_per_rev
        self.counted_arcsec = self._arcsec_rad * 2 * np.pi / counts_per_rev / np.sqrt(6)
        # The encoders as the samples were taken, and as the ticks read them: a motor that passes its set-point
        # takes the play along, however soon it comes back.
        times_s = np.concatenate([self.sampled_s, ticks["encoder_read_s"]])
        motor_rad = np.concatenate(
            [axis_pair(ticks, "siderostat_{}_rad"), axis_pair(ticks, "encoder_{}_rad")]
        )
        times_s, first = np.unique(times_s, return_index=True)
        self._rows = np.searchsorted(times_s, self.sampled_s)
        self.beam_arcsec = motor_rad[first] * self._arcsec_rad
        self.beam_arcsec -= self.beam_arcsec[0]
        self.rate_arcsec_s = np.gradient(self.beam_arcsec, times_s, axis=0)
        # A saturated photodiode has no volts to compare.
        self.counts = self.volts < sensor.saturated_v

    def place_mm(self, found: Found) -> Floats:
        """The beam from the centre of the photodiodes, shape (samples, 2)."""
        moved = self.beam_arcsec + 1e-3 * found.late_ms * self.rate_arcsec_s
        plays = (found.play_az_arcsec, found.play_el_arcsec)
        starts = np.sin([found.start_az, found.start_el])  # of half the play, to either side
        shown = np.stack(
            [
                behind_play(np.append(start * play / 2, moved[:, axis]), abs(play) / 2)[1:]
                for axis, (play, start) in enumerate(zip(plays, starts, strict=True))
            ],
            axis=-1,
        )
        return shown[self._rows].dot(self._turn_mm) / ARCSEC_PER_RAD + (
            found.place_az_mm,
            found.place_el_mm,
        )

    def modelled_v(self, found: Found) -> Floats:
        """What the photodiodes read, shape (samples, 4)."""
        sensor = self.sensor.model_copy(
            update={
                "beam_radius_m": 1e-3 * found.beam_radius_mm,
                "on_axis_v": found.on_axis_v,
                "ambient_v": list(found[-4:]),
            }
        )
        return diode_volts(sensor, 1e-3 * self.place_mm(found))

    def left_v(self, values: Floats) -> Floats:
        """What the model leaves, shape (samples, 4); zero where a photodiode is saturated."""
        return np.where(self.counts, self.volts - self.modelled_v(Found(*values)), 0.0)

    def volts_per_mm(self, found: Found) -> Floats:
        """How the photodiodes answer to a motion of the beam, shape (samples, 4, 2)."""
        light_v = self.modelled_v(found) - np.array(found[-4:])
        diodes_mm = 1e3 * self.sensor.diode_offset_m * _DIODE_PLACES
        away_mm = self.place_mm(found)[:, None, :] - diodes_mm
        return np.where(
            self.counts[..., None],
            -4.0 * light_v[..., None] * away_mm / found.beam_radius_mm**2,
            0.0,
        )

    def start(self) -> Found:
        """Where the search begins: the rig file's sensor, and the beam as the first samples have it."""
        sensor, ambient = self.sensor, self.volts.min(axis=0)
        light = np.maximum(self.volts[:20].mean(axis=0) - ambient, sensor.noise_v)
        per_log_mm = 1e3 * sensor.beam_radius_m**2 / (8 * sensor.diode_offset_m)
        return Found(
            per_log_mm * float(np.log(light[0] / light[1])),
            per_log_mm * float(np.log(light[2] / light[3])),
            1e3 * sensor.beam_radius_m,
            sensor.on_axis_v,
            0.0,
            0.5,
            0.5,
            0.0,
            0.0,
            *ambient.tolist(),
        )


def analyse(rig: Rig, loop_name: str, ticks: Columns, kind: type[Kind]) -> Kind:
    """What a scan of the beam shows, from the ticks of a :data:`STEP`.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    ticks : dict of str to array
    kind : type
        Of the result: :class:`PhotodiodesResult` or :class:`LinkDelayResult`.

    Raises
    ------
    IdentifyError
        If the loop is no metrology loop, the times cannot be of one run, the beam did not move enough or was
        not on the photodiodes, or the fit leaves too much unexplained.
    """
    loop = rig.metrology_loops.get(loop_name)
    if loop is None:
        names = ", ".join(rig.metrology_loops) or "none"
        msg = f"loop {loop_name} has no photodiodes; name a metrology loop with --loop (there is {names})"
        raise IdentifyError(msg)
    scan = _Scan(rig, loop_name, ticks)
    swing_m = np.ptp(scan.beam_arcsec, axis=0) / ARCSEC_PER_RAD * loop.sensor.link_length_m
    if not swing_m.min() >= _LEAST_SWING_M * loop.sensor.beam_radius_m:
        msg = (
            f"the beam moved by {1e3 * swing_m[0]:.1f} mm in az and {1e3 * swing_m[1]:.1f} mm in el, expected "
            f"at least half of its radius; run the step {STEP} with a larger span_sky_arcsec"
        )
        raise IdentifyError(msg)
    fit = least_squares(
        lambda values: scan.left_v(values).ravel(), np.array(scan.start()), x_scale="jac"
    )
    found = Found(*fit.x.tolist())
    left_v = scan.left_v(fit.x)
    covariance, excess, air_mm = _uncertainty(
        scan, found, left_v, fit.jac.reshape(*left_v.shape, -1), _air_of(rig)
    )
    if not (excess <= _MOST_EXCESS and abs(found.late_ms) <= 1e3 * _WIDEST_SHIFT_S):
        msg = (
            f"the model leaves {excess:.1f} times the noise unexplained, with samples {found.late_ms:+.1f} ms "
            f"from their time stamps; expected at most {_MOST_EXCESS:g} times and {1e3 * _WIDEST_SHIFT_S:g} "
            "ms; is the beam Gaussian, and does the collector stand still?"
        )
        raise IdentifyError(msg)
    sd = _with_counts(scan, Found(*np.sqrt(np.diag(covariance)).tolist()))
    delays_s = scan.delays_s - 1e-3 * found.late_ms
    jitter_s = float(np.std(delays_s))
    median_sd_s = np.sqrt(np.pi / 2 / len(delays_s)) * jitter_s
    return kind(
        loop=loop_name,
        found=found,
        sd=sd,
        delay_s=float(np.median(delays_s)),
        delay_sd_s=float(np.hypot(1e-3 * sd.late_ms, median_sd_s)),
        jitter_s=jitter_s,
        excess=excess,
        air_arcsec=1e-3 * air_mm / loop.sensor.link_length_m * ARCSEC_PER_RAD,
        before=loop,
        place_mm=scan.place_mm(found),
        volts=scan.volts,
        left_v=left_v,
    )


def _with_counts(scan: _Scan, sd: Found) -> Found:
    """Where a motor turned back, or paused, is known to a count of its encoder: more samples do not help."""
    speed_arcsec_s = float(np.sqrt(np.mean(scan.rate_arcsec_s**2) * 2))  # one axis moves at a time
    return sd._replace(
        late_ms=float(np.hypot(sd.late_ms, 1e3 * scan.counted_arcsec / speed_arcsec_s)),
        play_az_arcsec=float(np.hypot(sd.play_az_arcsec, 2 * scan.counted_arcsec)),
        play_el_arcsec=float(np.hypot(sd.play_el_arcsec, 2 * scan.counted_arcsec)),
    )


def _air_of(rig: Rig) -> AirPathModel:
    """The star's spectrum stands for the link's: of its time constants nothing else is known."""
    return next(iter(rig.stellar_loops.values())).vernier.air_path


def _uncertainty(
    scan: _Scan, found: Found, left_v: Floats, jacobian: Floats, air: AirPathModel
) -> tuple[Floats, float, float]:
    """Covariance of the fit, the excess of its residual, and the RMS of the air in mm.

    The air moves the beam slowly: what it does to the parameters does not average out from sample to sample.
    """
    noise_v, answer = scan.sensor.noise_v, scan.volts_per_mm(found)
    # Where the beam must have been for each sample's volts, beside the model.
    normal = np.einsum("ndi,ndj->nij", answer, answer)
    clear = np.linalg.eigvalsh(normal)[:, 0] > (noise_v / 1e-3) ** 2 * 1e-4
    if not clear.any():
        msg = (
            f"the light is too weak to show where the beam is: the fit finds {1e3 * found.on_axis_v:.3g} mV on "
            f"the centre, with {1e3 * noise_v:.3g} mV of noise in a sample; expected the beam on the "
            f"photodiodes; look at the laser, then run the step {STEP} again"
        )
        raise IdentifyError(msg)
    beside_mm = np.linalg.solve(
        normal[clear], np.einsum("ndi,nd->ni", answer[clear], left_v[clear])[..., None]
    )[..., 0]
    white_mm2 = noise_v**2 * np.linalg.inv(normal[clear]).diagonal(axis1=1, axis2=2)
    weight = 1.0 / (white_mm2 + np.median(white_mm2))
    air_mm2 = max(0.0, float(np.sum(weight * (beside_mm**2 - white_mm2)) / np.sum(weight)))
    # Beside that motion, two of four photodiodes show the noise alone.
    explained = np.einsum("ndi,ni->nd", answer[clear], beside_mm)
    degrees = 2 * len(beside_mm)
    excess = float(np.sqrt(np.sum((left_v[clear] - explained) ** 2) / degrees)) / noise_v
    # What the samples do not show, such as a play's start that the first motion took up, has no part in it.
    inverse = np.linalg.pinv(np.einsum("ndp,ndq->pq", jacobian, jacobian), hermitian=True)
    score = np.einsum("ndp,ndi->npi", jacobian, answer)
    bins = ((scan.sampled_s - scan.sampled_s.min()) / _BIN_S).astype(int)
    binned = np.zeros((bins.max() + 1, *score.shape[1:]))
    np.add.at(binned, bins, score)
    correlations = correlation(_BIN_S * np.arange(len(binned), dtype=np.float64), air)
    spread = matmul_toeplitz(correlations, binned.reshape(len(binned), -1)).reshape(binned.shape)
    slow = air_mm2 * np.einsum("mpi,mqi->pq", binned, spread)
    white = (noise_v * max(1.0, excess)) ** 2 * np.einsum("ndp,ndq->pq", jacobian, jacobian)
    return inverse @ (slow + white) @ inverse, excess, float(np.sqrt(air_mm2))
