"""The air path, from a minute of frames with the stages at rest: Eq. 8 and the noise floor (Fig. 7)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from fitctl.config import AirPathModel, Rig
from fitctl.controllers.design.linear_loop.spectrum import air_of, air_px2_per_hz, white_px2_per_hz
from fitctl.identify.air_fit import AirFit, fit_air_path
from fitctl.identify.drawing import BLACK, BLUE, GREEN, ORANGE, VERMILION, new_figure
from fitctl.identify.errors import IdentifyError
from fitctl.identify.frames import Tracks
from fitctl.learn.goodness_of_fit import FitTest, fit_test
from fitctl.learn.opened import Series, periodograms
from fitctl.model.air_path import rms_px, state_space
from fitctl.model.drives import Drive, standstill

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

AXES = ("az", "el")
RECOMMENDED_S = 60.0
_LEAST_S = 20.0
_SEGMENT_S = 20.48


class RelativeMotion(NamedTuple):
    """How one spot moves against the pointing spot, each shape (2,) for az and el.

    Attributes
    ----------
    spot : int
    correlation : array
        Of the two spots' centroids, noise included.
    measured_px, rms_px : arrays
        RMS of their difference: as measured, and less both spots' fitted white noise.
    """

    spot: int
    correlation: Floats
    measured_px: Floats
    rms_px: Floats


@dataclass(frozen=True)
class AirPathResult:
    """What the frames show.

    Attributes
    ----------
    loop : str
    tracks : Tracks
        Spot 0 is the brightest: the pointing spot.
    joint : AirFit
        One fit of the pointing spot's two axes: what designs use.
    fits : list of (AirFit, AirFit)
        For each spot, az and el by themselves.
    relative : list of RelativeMotion
        For each spot but the first.
    frequency_hz : array, shape (frequencies,)
    psd_px2_per_hz : array, shape (frequencies, spots, 2)
        Welch, one-sided, means removed.
    test : FitTest
        Whether the joint fit explains the pointing spot's spectrum.
    """

    loop: str
    tracks: Tracks
    joint: AirFit
    fits: list[tuple[AirFit, AirFit]]
    relative: list[RelativeMotion]
    frequency_hz: Floats
    psd_px2_per_hz: Floats
    test: FitTest

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file: the air path that designs are made for."""
        air = self.joint.model.model_dump()
        return {"loops": {self.loop: {"vernier": {"air_path": air}}}}

    def lines(self) -> list[str]:
        """For an operator."""
        lines = [
            f"{self.tracks.duration_s:.0f} s of frames, {self.tracks.px.shape[1]} spots, "
            f"{self.tracks.filled:.1%} filled in"
        ]
        if self.tracks.duration_s < RECOMMENDED_S:
            lines.append(f"shorter than {RECOMMENDED_S:.0f} s: the intervals are wide")
        lines.append(f"pointing spot, both axes: {_fit_text(self.joint)}")
        lines.append(f"test of fit: {self.test.text}")
        if not self.test.fits:
            lines.append(
                "Do not use this air path: Eq. 8 does not explain these frames. A vibration looks like strong "
                "air; fitctl design learn separates the two, in a log of the star held in VERNIER"
            )
        for spot, pair in enumerate(self.fits):
            lines += [
                f"spot {spot} ({self.tracks.flux_dn[spot]:.0f} DN) {axis}: {_fit_text(fit)}"
                for axis, fit in zip(AXES, pair, strict=True)
            ]
        lines += [
            f"spot {moving.spot} against spot 0, {axis}: correlation {moving.correlation[i]:.3f}, "
            f"relative motion {moving.rms_px[i]:.4f} px RMS "
            f"({moving.measured_px[i]:.4f} with centroid noise)"
            for moving in self.relative
            for i, axis in enumerate(AXES)
        ]
        return lines

    def draw(self) -> Figure:
        """Fig. 7: spectra of all spots and the joint fit."""
        figure = new_figure()
        axes = figure.add_subplot()
        hz = self.frequency_hz[1:]  # the means are removed
        colors = itertools.cycle((BLUE, VERMILION, GREEN, ORANGE))
        names = ("pointing", "fringe", *(f"spot {n}" for n in range(2, self.tracks.px.shape[1])))
        for name, psd_px2_per_hz in zip(
            names, self.psd_px2_per_hz[1:].swapaxes(0, 1), strict=False
        ):
            for axis, shown in zip(AXES, psd_px2_per_hz.T, strict=True):
                label = f"{name} {axis}"
                axes.loglog(hz, shown, color=next(colors), linewidth=0.8, label=label)
        both = model_psd_px2_per_hz(self.joint, hz, self.tracks.period_s)
        axes.loglog(hz, both, color=BLACK, linewidth=1.8, label="Eq. 8 and noise, fitted")
        floor = 2 * self.tracks.period_s * self.joint.noise_px.value**2
        axes.loglog(hz, np.maximum(both - floor, 1e-12), ":", color=BLACK, label="Eq. 8 alone")
        axes.set(xlabel="frequency (Hz)", ylabel="power spectral density (px²/Hz)", ylim=(1e-7, 3))
        axes.set_title(f"Centroids of loop {self.loop}, {self.tracks.duration_s:.0f} s, open loop")
        axes.grid(which="both", alpha=0.3)
        axes.legend(ncols=2)
        return figure


def plan(_rig: Rig, _loop_name: str) -> list[Drive]:
    """Nothing moves, for a little longer than a minute."""
    return standstill(RECOMMENDED_S + 4)


def analyse(rig: Rig, loop_name: str, tracks: Tracks) -> AirPathResult:
    """Fit the air path of one loop to its spots' tracks, stages at rest.

    Raises
    ------
    IdentifyError
        If there is too little of it, or it does not look like Eq. 8.
    """
    if tracks.duration_s < _LEAST_S:
        msg = (
            f"air path: {tracks.duration_s:.1f} s of frames; expected at least {_LEAST_S:.0f} s, better "
            f"{RECOMMENDED_S:.0f} s, with the stages at rest; take a longer record"
        )
        raise IdentifyError(msg)
    start = rig.stellar_loops[loop_name].vernier.air_path
    period_s, px = tracks.period_s, tracks.px
    fits = []
    for spot in range(px.shape[1]):
        az, el = (fit_air_path(px[:, spot, [axis]], period_s, start) for axis in range(2))
        fits.append((az, el))
    frequency_hz, psd = welch(
        px,
        fs=1 / period_s,
        nperseg=min(len(px), round(_SEGMENT_S / period_s)),
        detrend="constant",
        axis=0,
    )
    joint = fit_air_path(px[:, 0], period_s, start)
    return AirPathResult(
        loop=loop_name,
        tracks=tracks,
        joint=joint,
        fits=fits,
        relative=[_relative(px, fits, spot) for spot in range(1, px.shape[1])],
        frequency_hz=frequency_hz,
        psd_px2_per_hz=psd,
        test=_test(joint, px[:, 0], period_s),
    )


def _test(joint: AirFit, star_px: Floats, period_s: float) -> FitTest:
    """Of a fit, on the series that it was made of, shape (frames, 2)."""
    opened = periodograms([Series(star_px, np.zeros_like(star_px))], period_s)
    if opened is None:
        msg = "air path: too few frames in a row for a test of fit; take a longer record"
        raise IdentifyError(msg)
    density = air_px2_per_hz(air_of(joint.model), opened.frequency_hz, period_s)
    density = density + white_px2_per_hz(joint.noise_px.value, period_s)
    return fit_test(opened, np.broadcast_to(density[:, None], opened.disturbance.shape), 1.0, 0.0)


def model_psd_px2_per_hz(fit: AirFit, frequency_hz: Floats, period_s: float) -> Floats:
    """One-sided spectrum of Eq. 8 and the noise floor, shape as `frequency_hz`.

    Unit intensity is 1 per Hz two-sided, hence 2 one-sided; sampled noise spreads over half the rate.
    """
    a, b, c = state_space(fit.model)
    s = 2j * np.pi * np.asarray(frequency_hz)[:, None, None]
    response = (c @ np.linalg.solve(s * np.eye(2) - a, b))[:, 0, 0]
    return 2 * np.abs(response) ** 2 + 2 * period_s * fit.noise_px.value**2


def _relative(px: Floats, fits: list[tuple[AirFit, AirFit]], spot: int) -> RelativeMotion:
    measured_px = np.std(px[:, spot] - px[:, 0], axis=0)
    noise_px2 = np.array(
        [sum(fits[k][axis].noise_px.value ** 2 for k in (0, spot)) for axis in range(2)]
    )
    return RelativeMotion(
        spot=spot,
        correlation=np.array(
            [np.corrcoef(px[:, 0, axis], px[:, spot, axis])[0, 1] for axis in range(2)]
        ),
        measured_px=measured_px,
        rms_px=np.sqrt(np.maximum(measured_px**2 - noise_px2, 0.0)),
    )


def _fit_text(fit: AirFit) -> str:
    model: AirPathModel = fit.model
    return (
        f"gain {fit.gain_px} px, b1 {fit.b1_s2} s², b2 {fit.b2_s} s, noise {fit.noise_px} px, "
        f"motion {rms_px(model):.3f} px RMS"
    )
