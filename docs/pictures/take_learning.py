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
from fitctl.logging.records import CAMERA
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
JUDGED_S, AFTER_S, LONGEST_S = 40.0, 150.0, 400.0
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


def draw(
    rows: np.ndarray, changes_s: list[float], other_rate_s: list[float], period_s: float
) -> None:
    """Each axis' error on frames over time, and the spectrum of both before and after."""
    changed_s, *_ = changes_s
    figure = new_figure(height_in=6.4)
    az, el, spectrum = figure.subplots(3, 1, height_ratios=(2, 2, 3))
    el.sharex(az)
    el.sharey(az)
    for column, (axis, course) in enumerate((("az", az), ("el", el)), 1):
        course.plot(rows[:, 0] - changed_s, rows[:, column], color=BLUE, linewidth=0.5)
        for at_s in changes_s:
            course.axvline(at_s - changed_s, color=GREEN)
        if other_rate_s:  # it began, and ended
            course.axvspan(*(at_s - changed_s for at_s in other_rate_s), color=GREEN, alpha=0.15)
        course.set(ylabel=f"{axis} (px)")
    az.set(title="error on frames; lines: changes of design; shaded: another frame rate")
    az.tick_params(labelbottom=False)
    el.set(xlabel="time from the first change of design (s)")
    parts = (
        (rows[:, 0] < changed_s, VERMILION, "before"),
        (rows[:, 0] > max(*changes_s, *other_rate_s) + 3, GREEN, "after"),
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
    """Hold the star until the design has changed, and long enough for the change of the frame rate."""
    with demo.instrument(default_rig_path(), NIGHT, seed=3) as running:
        demo.acquire(running)
        rows, changes_s, other_rate_s, begun_s = [], [], [], time.monotonic()
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
            changes = [event for event in telemetry.events if "-> learnt" in event.message]
            rates = [event for event in telemetry.events if event.source == CAMERA]
            texts += [event.message for event in (*changes, *rates)]
            report = telemetry.loops[0].learning.report
            if report is not None and (not texts or texts[-1] != report.text):
                texts.append(report.text)
            other_rate_s += [event.time_s for event in rates]
            if changes and not changes_s:
                at_s = changes[0].time_s
                before_px = true_px(running, at_s - JUDGED_S, at_s - 0.5)
            changes_s += [event.time_s for event in changes]
            if changes_s and telemetry.time_s > changes_s[0] + AFTER_S:
                break
        now_s = rows[-1][0]
        after_px = true_px(running, now_s - JUDGED_S, now_s)
        children = psutil.Process(running.supervisor.pid).children(recursive=True)
        (learner,) = (child for child in children if "learner" in child.cmdline())
        size = learner.memory_info().rss / 1e6
        asyncio.run(console(running))
    table = np.array(rows)
    table = table[table[:, 0] > table[0, 0] + 5.0]
    draw(table, changes_s, other_rate_s, running.rig.camera.period_s)
    print(*texts, sep="\n")
    print(f"changed {changes_s[0] - rows[0][0]:.1f} s after VERNIER; load {os.getloadavg()[0]:.1f}")
    print(f"true px before {before_px}, after {after_px}; learner {size:.0f} MB resident")


if __name__ == "__main__":
    main()
