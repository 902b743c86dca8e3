"""Measure the night with a line at 6 Hz before and after the loop has learnt it, over wires; draw both.

python docs/pictures/take_learning.py
"""

import asyncio
import io
import os
import time
from pathlib import Path

import numpy as np
import psutil
from photograph import for_everybody
from scipy.signal import welch

from fitctl import demo
from fitctl.config import default_rig_path
from fitctl.identify.drawing import BLUE, GREEN, VERMILION, for_dark_pages, new_figure
from fitctl.messages.client import Client
from fitctl.mocks.bench import Residual, ResidualQuestion, ask_bench
from fitctl.tui.app import ConsoleApp

LOOP = "right"
NIGHT = (
    f"loops.{LOOP}.learn=on",
    f"loops.{LOOP}.vernier.controller=minimum-variance",
    f"plant.loops.{LOOP}.lines=[{{frequency_hz=6.0,rms_px=0.0707,direction_deg=45.0,damping=0.005,"
    "drift_hz_per_min=0.0}]",
)
JUDGED_S, AFTER_S, LONGEST_S = 40.0, 60.0, 300.0
SIZE = (120, 40)
HERE = Path(__file__).parent


async def console(running: demo.Instrument) -> None:
    """Save what a console shows of the loop."""
    app = ConsoleApp(Client(running.sockets))
    async with app.run_test(size=SIZE) as pilot:
        await pilot.press("3")
        end_s = time.monotonic() + 10.0
        while time.monotonic() < end_s:
            await pilot.pause(0.2)
        shown = for_everybody(app.export_screenshot())
        (HERE / "console-learnt.svg").write_text(shown, encoding="utf-8")


def true_px(running: demo.Instrument, start_s: float, end_s: float) -> tuple[float, float]:
    """RMS of the star's true distance from its target, az and el."""
    target = running.rig.stellar_loops[LOOP].target_px
    question = ResidualQuestion(LOOP, start_s, end_s, target.az, target.el)
    found = ask_bench(running.bench_port, question, Residual)
    return found.az_rms_px, found.el_rms_px


def draw(rows: np.ndarray, changed_s: float, period_s: float) -> None:
    """Each axis' error on frames over time, and the spectrum of both before and after."""
    figure = new_figure(height_in=6.4)
    az, el, spectrum = figure.subplots(3, 1, height_ratios=(2, 2, 3))
    el.sharex(az)
    el.sharey(az)
    for column, (axis, course) in enumerate((("az", az), ("el", el)), 1):
        course.plot(rows[:, 0] - changed_s, rows[:, column], color=BLUE, linewidth=0.5)
        course.axvline(0.0, color=GREEN)
        course.set(ylabel=f"{axis} (px)")
    az.set(title="error on frames")
    az.tick_params(labelbottom=False)
    el.set(xlabel="time from the change of design (s)")
    parts = (
        (rows[:, 0] < changed_s, VERMILION, "before"),
        (rows[:, 0] > changed_s + 3, GREEN, "after"),
    )
    for part, colour, name in parts:
        hz, psd = welch(rows[part][:, 1:], 1 / period_s, nperseg=512, axis=0)
        spectrum.loglog(hz[1:], psd[1:].mean(axis=1), color=colour, label=name)
    spectrum.set(xlabel="frequency (Hz)", ylabel="error on frames (px²/Hz)")
    spectrum.legend()
    svg = io.StringIO()
    figure.savefig(svg, format="svg")
    (HERE / "learning-6hz.svg").write_text(for_dark_pages(svg.getvalue()), encoding="utf-8")


def main() -> None:
    """Hold the star until the design has changed, and a minute longer."""
    with demo.instrument(default_rig_path(), NIGHT, seed=3) as running:
        demo.acquire(running)
        rows, changed_s, begun_s = [], 0.0, time.monotonic()
        before_px = (np.nan, np.nan)
        texts = []
        while time.monotonic() < begun_s + LONGEST_S:
            telemetry = running.client.receive(1.0)
            if telemetry is None:
                continue
            rows += [
                (tick.time_s, tick.error_az_px, tick.error_el_px)
                for tick in telemetry.ticks
                if tick.mode == "VERNIER" and tick.star_visible
            ]
            texts += [event.message for event in telemetry.events if "learnt" in event.message]
            if not changed_s and telemetry.loops[0].controller == "learnt":
                changed_s = telemetry.time_s
                before_px = true_px(running, changed_s - JUDGED_S, changed_s - 0.5)
            if changed_s and telemetry.time_s > changed_s + AFTER_S:
                break
        now_s = rows[-1][0]
        after_px = true_px(running, now_s - JUDGED_S, now_s)
        children = psutil.Process(running.supervisor.pid).children(recursive=True)
        (learner,) = (child for child in children if "learner" in child.cmdline())
        size = learner.memory_info().rss / 1e6
        asyncio.run(console(running))
    table = np.array(rows)
    draw(table[table[:, 0] > table[0, 0] + 5.0], changed_s, running.rig.camera.period_s)
    print(*texts, sep="\n")
    print(f"changed {changed_s - rows[0][0]:.1f} s after VERNIER; load {os.getloadavg()[0]:.1f}")
    print(f"true px before {before_px}, after {after_px}; learner {size:.0f} MB resident")


if __name__ == "__main__":
    main()
