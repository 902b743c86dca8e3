"""A console on recorded telemetry whose clock stands still, with other commands answered by heart."""

import functools
import json
import os
from pathlib import Path

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.theory import loop_theory
from fitctl.error_budget import LoopTheory, theory_to_plain
from fitctl.tui.app import ConsoleApp
from fitctl.tui.rewind.player import Player
from tests.instruments.fake_supervisor import START_S, FakeSupervisor
from tests.tui.links import FakeLink


@functools.cache
def theory_of(controller: str) -> LoopTheory:
    """What `fitctl design` knows of the shipped rig with a controller."""
    rig = load_rig(default_rig_path())
    return loop_theory(rig, "right", design_for(rig, "right", controller))


MESSAGES = 420
LOG_TIME_S = 1796021000.0
DESIGN = {
    "stable": True,
    "crossover_hz": 3.9,
    "phase_margin_deg": 40.7,
    "gain_margin_db": 7.1,
    "peak_sensitivity": 1.89,
    "attenuation_0.1hz": 88.9,
    "attenuation_0.5hz": 18.7,
    "attenuation_1hz": 6.1,
    "attenuation_2hz": 1.8,
    "residual_px": 0.0131,
    "theory": theory_to_plain(theory_of("minimum-variance")),
}
SEQUENCES = [
    {
        "file": "acquire.toml",
        "schema_version": 1,
        "name": "acquire",
        "description": "Power up, search for the star, hold it.",
        "steps": [{"step": "acquire", "loop": "", "timeout_s": 120.0, "attempts": 2}],
    },
    {
        "file": "jog.toml",
        "schema_version": 1,
        "name": "dither",
        "description": "Jogs of the star by one pixel, both axes, and its steady RMS (Fig. 12).",
        "steps": [
            {"step": "acquire", "loop": "", "timeout_s": 120.0, "attempts": 2},
            {
                "step": "dither",
                "loop": "",
                "dither_px": 1.0,
                "dwell_s": 20.0,
                "steady_after_s": 10.0,
            },
        ],
    },
]


def step(name, title, moves, takes_s, entry=None, missing=()):
    done = entry is not None and entry["state"] != "failed"
    return {
        "name": name,
        "title": title,
        "moves": moves,
        "takes_s": takes_s,
        "missing": list(missing),
        "done": done,
        "entry": entry,
    }


def ended(state, took_s, *lines, found=(), trouble="", tries=1):
    return {
        "state": state,
        "at": "2026-11-23T17:00:35Z",
        "took_s": took_s,
        "lines": list(lines),
        "figures": {},
        "found": dict(found),
        "trouble": trouble,
        "tries": tries,
    }


TURNED = {"loops": {"right": {"siderostat": {"wiring": {"velocity_signs": [-1, 1]}}}}}
STEPS = [
    step("devices", "Every device answers", "nothing", 5.0, ended("passed", 2.1, "camera: here")),
    step("camera", "Dark, noise and delay", "nothing", 8.0, ended("skipped", 0.0, trouble="day")),
    step(
        "right.amplifiers",
        "Each motor turns on command, and its encoder counts it",
        "each motor by 0.03 rad and back",
        5.0,
        ended("corrected", 4.9, "azimuth: counted -1.00 rad", found=TURNED, tries=2),
    ),
    step(
        "right.stacks",
        "Each D/A channel moves its stack",
        "each stack by 0.3 V",
        12.0,
        ended("failed", 8.4, trouble="stack 2: check the cable"),
    ),
    step("right.star", "The star is on the camera", "both motors, up to 13 rad", 60.0),
    step("right.mirror", "How the star moves", "each stack", 20.0, missing=["right.star"]),
]
COMMISSIONING = {
    "rig": "fit-mock",
    "verdict": "not commissioned: right.stacks failed",
    "tasks": STEPS,
}


class FakeJob:
    """Answers at once what a command would print."""

    started: list["FakeJob"]

    def __init__(self, arguments, *, outlives=False, asks=False):
        self.arguments = list(arguments)
        self.command_line = " ".join(["fitctl", *arguments])
        self.outlives, self.asks = outlives, asks
        self.moves = outlives or asks
        self.status = None if asks else 0
        self.printed = ""
        self.answers = []
        self.interrupted = self.ended = False

    def question(self):
        return self.printed.rpartition("\n")[2]

    def answer(self, text):
        self.answers.append(text)

    def interrupt(self):
        self.interrupted = True

    def text(self, _most_bytes=0):
        if self.asks:
            return self.printed
        if self.arguments[:2] == ["commission", "--list"]:
            return json.dumps(COMMISSIONING)
        if self.arguments[0] == "design":
            return json.dumps(DESIGN)
        if self.arguments[:2] == ["sequence", "list"]:
            return json.dumps(SEQUENCES)
        return "first line\nlast line\n"

    def end(self):
        self.ended = True


def make_logs(folder: Path) -> Path:
    """Three logs of known size and time; one is kept."""
    folder.mkdir(exist_ok=True)
    for number, size in enumerate((1_500_000, 42_000_000, 9_000)):
        path = folder / f"fit-mock_2026113{number}T031500Z.mcap"
        path.touch()
        os.truncate(path, size)
        os.utime(path, (LOG_TIME_S + number, LOG_TIME_S + number))
    (folder / "fit-mock_20261131T031500Z.mcap.keep").touch()
    return folder


class PromptPlayer(Player):
    """Makes each moment at once, on the caller's thread."""

    def seek(self, time_s):
        self._on_state(time_s, self._make(time_s))


class FixedApp(ConsoleApp):
    """A console on recorded telemetry whose clock stands still after the last message."""

    def __init__(
        self, supervisor: FakeSupervisor, silent_s: float = 0.02, log_folder=Path("logs"), **options
    ):
        self.recorded = supervisor.messages(MESSAGES)
        self.fixed_s = START_S
        self.jobs: list[FakeJob] = []
        super().__init__(
            FakeLink(),
            clock=lambda: self.fixed_s,
            log_folder=log_folder,
            start_job=self.start_fake,
            **options,
        )
        self.silent_s = silent_s
        self.playback._player.__class__ = PromptPlayer

    def start_fake(self, arguments, **options):
        self.jobs.append(FakeJob(arguments, **options))
        return self.jobs[-1]

    def feed(self) -> None:
        """All telemetry, each message at its own time."""
        for message in self.recorded:
            self.fixed_s = message.time_s
            self.state.accept(message, message.time_s)
            self._recent.add(message, message.time_s)
        self.fixed_s += self.silent_s
        self.draw_all()


async def settle(app: ConsoleApp, pilot) -> None:
    """Wait until everything that is drawn in its own time has been drawn."""
    await pilot.pause()
    app.draw_all()  # children are asked for
    app.draw_all()  # and have answered
    await pilot.pause()
    app.draw_all()
    await pilot.pause()
