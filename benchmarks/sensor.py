"""What it costs to measure a star: the fit beside the centroid, on the same frames, in turns.

The frames are those of a held star: anywhere within 0.3 px of the middle of a pixel. A bad pixel is known from
the dark frame, a hot one is not; both are in the star's window. A spot that is wider than the rig file has it
has several pixels that look hot. An own spot, which the rig file has, reaches into the window.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from fitctl.config import HotPixel, default_rig_path, load_rig
from fitctl.controllers.centroid import StarSensor
from fitctl.model.image.scene import Scene

LOOP = "right"
WIDER = 1.13
FRAMES = 64
BAD_PX, HOT = (18, 21), HotPixel(az_px=22, el_px=19, dn=3000.0)  # row and column
OWN_PX, OWN_DN = (4.0, 0.0), 3000.0
OWN = f'{{name="near", offset_px={{az={OWN_PX[0]}, el={OWN_PX[1]}}}, flux_dn={OWN_DN}}}'
CASES = (
    "",
    "a bad pixel in the window",
    "a hot pixel in the window",
    "a wider spot",
    "an own spot 4 px away",
)
STAR_PX = np.array([20.0, 20.0])
SPREAD_PX = 0.3


def sensors_and_frames(folder: Path) -> dict[str, tuple[StarSensor, list[np.ndarray]]]:
    """By case: who measures, and what."""
    cases = {}
    for sensor in ("centroid", "fit"):
        for case in CASES:
            bad, hot = "bad" in case, "hot" in case
            settings = [f"loops.{LOOP}.sensor={sensor}"]
            if "own" in case:
                settings.append(f"loops.{LOOP}.other_spots=[{OWN}]")
            if "wider" in case:
                settings.append(f"loops.{LOOP}.spot_diameter_px={3.0 / WIDER}")
            rig = load_rig(default_rig_path(), settings)
            if bad:
                dark_dn = np.full((rig.camera.height_px, rig.camera.width_px), rig.camera.bias_dn)
                dark_dn[BAD_PX] = np.nan
                np.save(folder / "dark.npy", dark_dn)
                settings.append(f"camera.dark_file={folder / 'dark.npy'}")
                rig = load_rig(default_rig_path(), settings)
            truth, _ = rig.mock_parts()
            spots, places_px = list(truth.stellar_loops[LOOP].spots[:1]), [(0.0, 0.0)]
            if "own" in case:
                spots.append(spots[0].model_copy(update={"flux_dn": OWN_DN}))
                places_px.append(OWN_PX)
            scene = Scene(rig.camera, spots, [HOT] if hot else [])
            away_px = np.random.default_rng(1).uniform(-SPREAD_PX, SPREAD_PX, (FRAMES, 2))
            cases[f"{sensor}, {case}" if case else sensor] = (
                StarSensor(rig.camera, rig.stellar_loops[LOOP]),
                [
                    scene.frame(STAR_PX + one + np.array(places_px), 1, n)
                    for n, one in enumerate(away_px)
                ],
            )
    return cases


def main() -> None:
    """Measure in turns, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=100)
    rounds = parser.parse_args().rounds
    took_s = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        cases = sensors_and_frames(Path(folder))
    for _ in range(rounds):
        for name, (sensor, frames) in cases.items():
            for frame in frames:
                began_s = time.perf_counter()
                star = sensor.in_window(frame, *STAR_PX)
                took_s[name].append(time.perf_counter() - began_s)
                if star is None:
                    msg = f"{name}: no star on one of the frames"
                    raise RuntimeError(msg)
    print("| µs | median | 99 % | worst |\n| --- | --- | --- | --- |")
    for name, all_s in took_s.items():
        median, late, worst = 1e6 * np.percentile(all_s, [50, 99, 100])
        print(f"| {name} | {median:.1f} | {late:.1f} | {worst:.0f} |")


if __name__ == "__main__":
    main()
