"""Fig. 7: spectra of the centroids with the stages at rest, and the second-order fit."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from fitctl.config import Rig
from fitctl.controllers.centroid import sensor_noise_px
from fitctl.figures.plate import Comparison, Plate, save
from fitctl.identify.air_fit import fit_air_path
from fitctl.identify.airpath import (
    RECOMMENDED_S,
    analyse,
    plan,
)
from fitctl.identify.frames import frames_of_records, track_spots
from fitctl.identify.run import on_simulation
from fitctl.learn.intervals import Interval
from fitctl.model.plant import Plant

_PAPER_GAIN_PX, _PAPER_B1_S2, _PAPER_B2_S, _PAPER_NOISE_PX = 0.45, 0.517, 2.5, 0.01  # Eq. 9


def figure_7(rig: Rig, loop_name: str, seed: int, folder: Path, minutes: int) -> list[Plate]:
    """A minute of frames in open loop, tracked, transformed and fitted.

    `minutes` of the plant's air path, each of another seed, show how often the intervals hold the truth.
    """
    records = on_simulation(
        rig, loop_name, "airpath", plan(rig, loop_name), seed, lambda _part: None
    )
    tracks = track_spots(
        frames_of_records(records, loop_name, rig.camera), rig.camera, rig.stellar_loops[loop_name]
    )
    found = analyse(rig, loop_name, tracks)
    truth, _ = rig.mock_parts()
    air = truth.stellar_loops[loop_name].air_path
    flux_dn = truth.stellar_loops[loop_name].spots[0].flux_dn
    noise_px = sensor_noise_px(rig.camera, rig.stellar_loops[loop_name], flux_dn)
    fit = found.joint
    rows = [
        _row("k, px", _PAPER_GAIN_PX, fit.gain_px, air.gain_px),
        _row("b1, s²", _PAPER_B1_S2, fit.b1_s2, air.b1_s2),
        _row("b2, s", _PAPER_B2_S, fit.b2_s, air.b2_s),
        _row("centroid noise, px", _PAPER_NOISE_PX, fit.noise_px, noise_px),
        *(
            Comparison(
                "relative motion of pointing and fringe spot, px",
                None,
                math.hypot(*moving.rms_px) / math.sqrt(2),
                f"plant: {air.relative_rms_px:g}; the paper: up to about 0.1 in the worst observed cases",
            )
            for moving in found.relative[:1]
        ),
        Comparison(
            "intervals that hold the plant's k, b1, b2, %",
            None,
            100 * coverage(rig, loop_name, seed, minutes),
            f"of {3 * minutes}, in {minutes} other minutes; should be 95",
        ),
    ]
    save(found.draw(), folder, "fig07-airpath")
    caption = (
        f"Power spectral densities of {tracks.px.shape[1]} spots' centroids in both axes, "
        f"{tracks.duration_s:.0f} s of whole frames at {1 / tracks.period_s:g} Hz with the stages at rest, "
        "means removed. Black: Eq. 8 with a white noise floor, fitted to the pointing spot's two axes by "
        "maximum likelihood; dotted, the air path alone. Intervals are of 95 %. In a minute the slow pole "
        "is seen few times, so they are wide."
    )
    return [Plate("fig07-airpath", "Fig. 7: air path", caption, rows)]


def coverage(rig: Rig, loop_name: str, seed: int, minutes: int) -> float:
    """Part of the 95 % intervals that hold the plant's parameters, both axes fitted together."""
    truth, _ = rig.mock_parts()
    air, period_s = truth.stellar_loops[loop_name].air_path, rig.camera.period_s
    loop = rig.stellar_loops[loop_name]
    noise_px = sensor_noise_px(rig.camera, loop, loop.star_flux_dn)
    held = 0
    for number in range(1, minutes + 1):
        whole = Plant(rig, [seed + number], history_s=RECOMMENDED_S + 1.0)
        plant = whole.stellar_loops[loop_name]
        plant.advance(RECOMMENDED_S)
        frame_s = np.arange(1, round(RECOMMENDED_S / period_s)) * period_s
        star_px = np.array([plant.spots_px(time_s)[0, 0] for time_s in frame_s])
        star_px += noise_px * np.random.default_rng(seed + number).standard_normal(star_px.shape)
        fit = fit_air_path(star_px - star_px.mean(axis=0), period_s, loop.vernier.air_path)
        held += fit.gain_px.covers(air.gain_px) + fit.b1_s2.covers(air.b1_s2)
        held += fit.b2_s.covers(air.b2_s)
    return held / (3 * minutes)


def _row(quantity: str, paper: float, found: Interval, truth: float) -> Comparison:
    inside = "inside" if found.covers(truth) else "outside"
    note = f"95 %: {found.low:.4g} to {found.high:.4g}; plant: {truth:.4g}, {inside}"
    return Comparison(quantity, paper, found.value, note)
