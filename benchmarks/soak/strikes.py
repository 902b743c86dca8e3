"""What strikes in a soak: every fault of every mock device, and what befalls processes and operators."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import psutil

from benchmarks.soak.consoles import Console
from fitctl.commands.shared.fault_kinds import kinds
from fitctl.demo import Instrument
from fitctl.messages.commands import Off, Stop
from fitctl.mocks.bench import ClearFaults, FaultsNow, SetFault, ask_bench
from fitctl.mocks.faults import WIRE_FAULTS

_LOOP = "right"
_DEVICES = {  # the default rig's, and which table of kinds is theirs
    "camera": "camera",
    f"{_LOOP}.drive": "drive",
    f"{_LOOP}.dac": "dac",
    f"{_LOOP}.mdt693": "mdt693",
}
_LONGEST_FAULT_S = 8.0
_LONGEST_STOPPED_S = 60.0  # some of these fill the queue, which is then to count
_PROBABILITIES = (1.0, 0.3, 0.03)  # of a fault of the wire, message by message
_OFF_WITHIN_S = 10.0


@dataclass(frozen=True)
class Bench:
    """What strikes are made upon."""

    running: Instrument
    console: Console
    new_console: Callable[[], Console]

    @property
    def recorder(self) -> psutil.Process | None:
        """The recorder process, if there is one just now."""
        children = psutil.Process(self.running.supervisor.pid).children()
        return next((child for child in children if "record" in child.cmdline()), None)


@dataclass(frozen=True)
class Strike:
    """One thing that goes wrong, and for how long at the most; `begin` returns what ends it."""

    name: str
    longest_s: float
    begin: Callable[[Bench, random.Random], Callable[[], None]]


def shuffled(chance: random.Random) -> Iterator[Strike]:
    """All strikes in a random order, then all in another, without end."""
    while True:
        deck = list(STRIKES)
        chance.shuffle(deck)
        yield from deck


# ---------------------------------------------------------------- devices


def _device_fault(
    device: str, kind: str, parts: tuple[str, ...], bench: Bench, chance: random.Random
) -> Callable[[], None]:
    port = bench.running.bench_port
    fault = SetFault(
        device,
        kind,
        part=chance.choice(parts) if parts else "",
        probability=chance.choice(_PROBABILITIES) if kind in WIRE_FAULTS else 1.0,
    )
    answer = ask_bench(port, fault, FaultsNow)
    if answer.error:
        raise ValueError(answer.error)

    def heal() -> None:
        ask_bench(port, ClearFaults(), FaultsNow)

    return heal


# ---------------------------------------------------------------- processes


def _stopped(process: psutil.Process) -> Callable[[], None]:
    process.send_signal(signal.SIGSTOP)
    return partial(process.send_signal, signal.SIGCONT)


def _recorder_killed(bench: Bench, _: random.Random) -> Callable[[], None]:
    if bench.recorder is not None:
        bench.recorder.kill()
    return _nothing


def _recorder_stopped(bench: Bench, _: random.Random) -> Callable[[], None]:
    return _nothing if bench.recorder is None else _stopped(bench.recorder)


def _console_stopped(bench: Bench, _: random.Random) -> Callable[[], None]:
    return _stopped(psutil.Process(bench.console.pid))


def _console_comes_and_is_killed(bench: Bench, _: random.Random) -> Callable[[], None]:
    return bench.new_console().kill


# ---------------------------------------------------------------- people


def _operator_stops(bench: Bench, _: random.Random) -> Callable[[], None]:
    bench.running.client.send(Stop())
    return _nothing


def _operator_turns_off(bench: Bench, _: random.Random) -> Callable[[], None]:
    send = bench.running.client.send
    send(Stop())
    deadline_s = time.monotonic() + _OFF_WITHIN_S
    while not send(Off()).accepted and time.monotonic() < deadline_s:  # the mirror goes to its bias
        time.sleep(0.1)
    return _nothing


def _nothing() -> None:
    pass


STRIKES = (
    *(
        Strike(
            f"{device} {name}", _LONGEST_FAULT_S, partial(_device_fault, device, name, kind.parts)
        )
        for device, table in _DEVICES.items()
        for name, kind in kinds()[table].items()
    ),
    Strike("recorder killed", _LONGEST_FAULT_S, _recorder_killed),
    Strike("recorder stopped", _LONGEST_STOPPED_S, _recorder_stopped),
    Strike("console stopped", _LONGEST_STOPPED_S, _console_stopped),
    Strike("console comes and is killed", _LONGEST_FAULT_S, _console_comes_and_is_killed),
    Strike("operator stops", _LONGEST_FAULT_S, _operator_stops),
    Strike("operator turns off", _LONGEST_FAULT_S, _operator_turns_off),
)
