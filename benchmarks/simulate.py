"""How fast a rig is simulated: the batch, the interactive simulation, and what randomness alone costs.

One core. Each line has the median, the slowest percent and the slowest of its pieces, as times real time;
first by the clock, then by what the core itself says it spent, which others on the machine disturb less.
Compare lines of one run only: another run has another machine load.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.model.air_path import NODE_S
from fitctl.model.compiled import compilable, compiled
from fitctl.model.image.pixel_noise import mix, quantiles
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.simulation import Simulation

RUN_S = 120.0
PIECE_S = 2.0  # of the interactive simulation


def speeds(piece: Callable[[int], object], pieces: int, piece_s: float) -> np.ndarray:
    """Times real time of each piece, by the clock and by the core: shape (pieces, 2)."""
    rows = []
    for index in range(pieces):
        clock, core = time.perf_counter(), time.thread_time()
        piece(index)
        rows.append(
            (piece_s / (time.perf_counter() - clock), piece_s / (time.thread_time() - core))
        )
    return np.array(rows)


def line(title: str, rows: np.ndarray) -> str:
    """Median, slowest percent and slowest, by the clock and by the core."""
    cells = []
    for column in rows.T:
        cells += [np.median(column), np.percentile(column, 1), column.min()]
    return f"{title:34}" + "".join(f"{cell:10.0f}" for cell in cells)


@compilable()
def draw_normals(
    random: np.random.Generator, air: int, key: int, pixels: int, table: np.ndarray
) -> float:
    """As many normal deviates for the air and for pixels as given, compiled as the batch is."""
    total = 0.0
    for _ in range(air):
        total += random.standard_normal()
    for pixel in range(pixels):
        total += table[mix(np.uint64(key) + np.uint64(pixel)) >> np.uint64(48)]
    return total


def normals_alone(rig: Rig) -> Callable[[int], object]:
    """Every normal deviate that a run of the batch uses, and nothing else."""
    air = 4 * round(RUN_S / NODE_S)
    pixels = 49 * round(RUN_S * rig.camera.frame_rate_hz)
    draw = compiled(draw_normals)
    return lambda seed: draw(np.random.default_rng(seed), air, seed, pixels, quantiles())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200, help="of the batch, 120 s each")
    parser.add_argument("--pieces", type=int, default=30, help="of the simulation, 2 s each")
    arguments = parser.parse_args()
    rig = load_rig(default_rig_path())
    batch = Batch(rig)
    batch.run(0, 1.0)  # compiles
    normals_alone(rig)(0)
    simulation = Simulation(rig, 0)
    simulation.acquire()
    simulation.run(15.0)  # VERNIER from here on
    print(f"{'times real time, one core':34}{'clock':>10}{'1 %':>10}{'worst':>10}", end="")
    print(f"{'core':>10}{'1 %':>10}{'worst':>10}")
    floor = speeds(normals_alone(rig), arguments.runs // 4, RUN_S)
    print(line("normal deviates alone", floor))
    for name in ("eq20", "minimum-variance"):
        vernier = [f"loops.{loop}.vernier.controller={name}" for loop in rig.loops]
        one = Batch(load_rig(default_rig_path(), vernier))
        rows = speeds(partial(one.run, duration_s=RUN_S), arguments.runs, RUN_S)
        print(line(f"batch, {name}", rows), flush=True)
    rows = speeds(lambda _: simulation.run(PIECE_S), arguments.pieces, PIECE_S)
    print(line("interactive simulation, VERNIER", rows))


if __name__ == "__main__":
    main()
