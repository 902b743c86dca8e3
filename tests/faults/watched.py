"""A rig whose whole course is kept, and that can be brought to any mode."""

import time
from contextlib import suppress
from typing import NamedTuple
from urllib.request import urlopen

import psutil
from stalls import BUSY
from system.conftest import Rig

from fitctl.config import load_rig
from fitctl.messages.client import Client
from fitctl.messages.commands import (
    Acquire,
    Experiment,
    Off,
    Recover,
    Release,
    Standby,
    Status,
    Stop,
)
from fitctl.messages.keys import new_key
from fitctl.mocks.bench import (
    ClearFaults,
    FaultsNow,
    Residual,
    ResidualQuestion,
    SetFault,
    StagesNow,
    StagesQuestion,
    ask_bench,
)
from fitctl.model.drives import Drive

from .console import Console

LOOK_S = 0.1  # between two looks at where the stages truly are
REACH_S = 60.0
ANSWER_S = 5.0  # to a command that is accepted
OPENING_S = 20.0
CALM_S = 10.0
MAY_BE_LOST_S = 1.5  # before a kill: what the recorder has not yet received, and a stall
HIDDEN = {
    "right": SetFault("camera", "star_fading", value=0.001),
    "metrology": SetFault("metrology.labjack", "laser_dim", value=0.0),
}
"""Keeps a loop in ACQUISITION."""
TRACKING = ("ACQUISITION", "COARSE", "VERNIER", "LOCKED", "EXPERIMENT")


def experiment(loop):
    """Both stages move for longer than any entry takes, the siderostat without a rest."""
    drives = [
        Drive(channel="fsm_az", shape="sine", amplitude=0.5, frequency_hz=0.5, duration_s=120.0),
        Drive(
            channel="siderostat_el",
            shape="triangle",
            amplitude=3.0,
            frequency_hz=0.5,
            duration_s=120.0,
        ),
    ]
    return Experiment(loop=loop, name="fault catalogue", drives=drives)


_UP = {"OFF": Standby, "SAFE": Recover, "STANDBY": Acquire}
TOWARDS = {
    "OFF": {"STANDBY": Off, "SAFE": Off} | dict.fromkeys(TRACKING, Release),
    "SAFE": dict.fromkeys(("OFF", "STANDBY", *TRACKING), Stop),
    "STANDBY": {"OFF": Standby, "SAFE": Recover} | dict.fromkeys(TRACKING, Release),
    # By a first search, which moves at once; the one for a lost star begins with a pause.
    "ACQUISITION": _UP | dict.fromkeys(("COARSE", "VERNIER", "LOCKED", "EXPERIMENT"), Release),
    "COARSE": _UP | {"EXPERIMENT": Release},
    "VERNIER": _UP | {"EXPERIMENT": Release},
    "LOCKED": _UP,
    "EXPERIMENT": _UP | {"VERNIER": experiment},
}
"""The command that leads towards a mode, by the mode of the loop; without one it gets there by itself."""


class Place(NamedTuple):
    """Where the stages truly were, by the mocks' bench: motors in rad, stacks in volts at the D/A."""

    time_s: float
    motor_rad: list[float]
    stack_v: list[float]


class WatchedRig(Rig):
    """Keeps all telemetry but the frames, and where the stages truly were."""

    def __init__(self, folder, file=None):
        super().__init__(folder, file)
        self.telemetry = []
        self.places = []
        self.bench_answers = True
        self.loop = "right"  # whose stages are looked at
        self._looked_s = 0.0
        self.logs = folder
        self.errors = (folder / "errors.txt").open("a")
        self.console = None
        self.elsewhere = None  # a client by TCP
        self.heard = []  # what was answered to strange commands
        self.shown = set()  # times of all ticks in telemetry
        self.lost_of = {}  # records lost, by each supervisor's own count
        self.lost_s = []  # from when until when, what supervisors still had when they were killed
        self.started_s = 0.0  # when this supervisor was started
        self.recorded = False  # whether its recorder has reported

    def receive(self, timeout_s):
        telemetry = super().receive(min(timeout_s, LOOK_S))
        if telemetry is not None:
            self.telemetry.append(telemetry)
            self.shown.update(tick.time_s for tick in telemetry.ticks)
            self.lost_of[telemetry.pid] = telemetry.losses.records_lost
            self.recorded = self.recorded or telemetry.recorder is not None
        self.look()
        return telemetry

    def look(self):
        now_s = time.monotonic()
        if self.bench_answers and now_s >= self._looked_s + LOOK_S:
            self._looked_s = now_s
            self.places.append(self.place())

    def place(self):
        """Where the stages truly are."""
        question = StagesQuestion(self.loop)
        stages = ask_bench(self.endpoints["mocks.bench_port"], question, StagesNow)
        return Place(time.monotonic(), stages.motor_rad, stages.stack_v)

    def start_supervisor(self):
        if self.client is not None:
            self.client.close()
            self.supervisor.stdout.close()
        self.started_s, self.recorded = time.monotonic(), False
        super().start_supervisor()

    def note_death(self):
        """Note what a killed supervisor lost uncounted: what its recorder had not received, or everything."""
        dead_s = time.monotonic()
        self.lost_s.append((dead_s - MAY_BE_LOST_S if self.recorded else self.started_s, dead_s))

    def restart_mocks(self):
        self.mocks.stdout.close()
        super().restart_mocks()
        self.bench_answers = True

    def tell(self, question):
        answer = ask_bench(self.endpoints["mocks.bench_port"], question, FaultsNow)
        assert not answer.error, answer.error

    def residual_px(self, loop, since_s):
        """RMS of a loop's star from its target since then, in truth, on its worse axis."""
        target_px = load_rig(self.file, self.settings).loops[loop].target_px
        question = ResidualQuestion(loop, since_s, time.monotonic(), target_px.az, target_px.el)
        residual = ask_bench(self.endpoints["mocks.bench_port"], question, Residual)
        return max(residual.az_rms_px, residual.el_rms_px)

    @property
    def stellar_loops(self):
        """Their names."""
        return list(load_rig(self.file, self.settings).stellar_loops)

    def modes(self):
        """Of each loop, now."""
        return modes_of(self.follow(lambda _: True)[-1])

    def turn_off(self, loop):
        """As an operator does: hold, then off, which the mirror's way to its bias delays."""
        end_s = time.monotonic() + ANSWER_S
        assert self.client.send(Release(loop=loop)).accepted
        while not self.client.send(Off(loop=loop)).accepted:
            assert time.monotonic() < end_s, f"{loop} is not turned off within {ANSWER_S:g} s"
            self.receive(LOOK_S)

    def process(self, name):
        """The process of a name, once it is there."""
        if name == "console":
            return self._open_console()
        if name == "recorder":
            return self.recorder()
        if name in {"learner", "gateway"}:
            return self.child(name)
        if name == "metrics server":
            return self.child("metrics")
        return psutil.Process({"supervisor": self.supervisor, "mocks": self.mocks}[name].pid)

    def is_reached_from_elsewhere(self):
        """Somebody with a key, who was there all the time, sees telemetry and is answered."""
        if self.elsewhere is None:
            rig, file = load_rig(self.file, self.settings), self.folder / "anna.key.toml"
            self.elsewhere = Client(new_key(rig, "anna", "commander", "", file))
        while self.elsewhere.receive(0.0) is not None:
            pass  # what came before
        answered = seen = False
        end_s = time.monotonic() + REACH_S
        while not (answered and seen):
            assert time.monotonic() < end_s, f"by TCP: answered {answered}, seen {seen}"
            with suppress(ConnectionError):
                answered = answered or self.elsewhere.send(Status()).accepted
            seen = seen or self.elsewhere.receive(LOOK_S) is not None
            self.receive(LOOK_S)

    def is_measured(self):
        """Whoever asks for metrics is told that the supervisor speaks."""
        end_s = time.monotonic() + REACH_S
        while b"fitctl_up 1.0" not in self._metrics():
            assert time.monotonic() < end_s, "no metrics, or none of a supervisor that speaks"
            self.receive(LOOK_S)

    def _metrics(self):
        port = load_rig(self.file, self.settings).service.metrics_port
        with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/metrics", timeout=1.0) as page:
            return page.read()
        return b""

    def _open_console(self):
        """The console's process, once it has drawn something."""
        if self.console is not None and self.console.process.poll() is not None:
            self.console.close()
            self.console = None
        if self.console is None:
            self.console = Console(self.common)
            self.follow(lambda _: self.console.drawn, REACH_S)
        return psutil.Process(self.console.process.pid)

    def close(self):
        if self.console is not None:
            self.console.close()
        if self.elsewhere is not None:
            self.elsewhere.close()
        super().close()
        self.errors.close()

    def complaints(self):
        """All that mocks and supervisors wrote to their error output."""
        return (self.folder / "errors.txt").read_text()

    def reach(self, wanted, limit_s=REACH_S):
        """Bring loops to modes, whatever they are in; every fault is ended first.

        Where the machine has no time for a loop just now, a better moment is waited for.

        Parameters
        ----------
        wanted : mapping of str to str
            The mode of each loop by its name.
        """
        self.tell(ClearFaults())
        for name, mode in wanted.items():
            if mode == "ACQUISITION":
                self.tell(HIDDEN[name])
        end_s, calm_s = time.monotonic() + limit_s, time.monotonic() + CALM_S
        while (elsewhere := self._elsewhere(wanted)) or (
            self.is_busy() and time.monotonic() < calm_s
        ):
            assert time.monotonic() < end_s, f"{elsewhere} instead of {wanted} after {limit_s} s"
            if elsewhere:
                self._go_towards(wanted, elsewhere)

    def _elsewhere(self, wanted):
        """The loops that are in other modes than wanted, and in which."""
        modes = self.modes()
        return {name: modes[name] for name, mode in wanted.items() if modes[name] != mode}

    def _go_towards(self, wanted, elsewhere):
        """Give the commands that lead there, where there are any, and wait for what comes of them."""
        made = {name: TOWARDS[wanted[name]].get(mode) for name, mode in elsewhere.items()}
        accepted = [
            make is None or self.client.send(make(loop=name)).accepted
            for name, make in made.items()
        ]
        opening = not {Standby, Recover}.isdisjoint(made.values())
        with suppress(AssertionError):
            self.follow(
                lambda t: (
                    (modes_of(t).items() & elsewhere.items() != elsewhere.items()) or failed(t)
                ),
                (OPENING_S if opening else ANSWER_S) if any(accepted) else 0.2,
            )

    def is_busy(self):
        """The machine has no time for a loop just now."""
        loops = self.telemetry[-1].loops
        return any({trip.name for trip in loop.interlocks} & BUSY for loop in loops)


def modes_of(telemetry):
    """The mode of each loop by its name."""
    return {loop.name: loop.mode for loop in telemetry.loops}


def failed(telemetry):
    """Whether devices could not be opened."""
    return any("failed: " in event.message for event in telemetry.events)
