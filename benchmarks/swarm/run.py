"""One run: a plan on a rig, what happened, and what must not have."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from time import process_time

import msgspec
import numpy as np

from benchmarks.swarm.commands import MOST_RATE_S
from benchmarks.swarm.computer import Computer
from benchmarks.swarm.computer import installed as computer_installed
from benchmarks.swarm.happenings import Plan
from benchmarks.swarm.instrument import RIGS, Instrument
from benchmarks.swarm.invariants import NO_EXCEPTION, Violation
from benchmarks.swarm.recorder import installed as recorder_installed
from benchmarks.swarm.service import installed as service_installed
from benchmarks.swarm.telemetry_wire import drawn_subscribers
from benchmarks.swarm.telemetry_wire import installed as client_installed
from benchmarks.swarm.threads import VirtualTime, installed
from fitctl.config import load_rig
from fitctl.logging.records import AnyRecord
from fitctl.messages.command_table import COMMANDS
from fitctl.messages.commands import MoveCollector, SetTarget, Stop, TakeOver
from fitctl.messages.modes import HOLDING

HEAL_S = 60.0  # within which a loop must hold its star again
_BACK_S = 15.0  # after a kill or a shutdown, and what was waited for when all was healed
_STAY_S = 5.0  # for so long a star that is held must stay so
_STAYS_PX = 0.5  # mean over a second,
_RMS_PX = 0.06  # about it, where nothing vibrates: more than twice the most that was measured


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """What became of a run.

    Attributes
    ----------
    digest : str
        Of all records: the same for the same plan.
    lasted_s : float
        Of virtual time.
    modes : dict of str to int
        How often each mode was entered.
    """

    digest: str
    lasted_s: float
    modes: dict[str, int]
    violations: list[Violation]
    cpu_s: float


def run_plan(plan: Plan, on_record: Callable[[AnyRecord], None] = lambda _: None) -> Result:
    """Run a plan, then heal everything, and require the stars to be held.

    An exception of the run itself is a violation too.
    """
    began_s = process_time()
    try:
        return _run(plan, on_record, began_s)
    except Exception as error:
        return failed_run(error, process_time() - began_s)


def failed_run(error: Exception, cpu_s: float = 0.0) -> Result:
    """The result of a run that ended in an exception."""
    violation = Violation(NO_EXCEPTION, 0.0, f"the run: {_told(error)}")
    return Result(digest="", lasted_s=0.0, modes={}, violations=[violation], cpu_s=cpu_s)


def _run(plan: Plan, on_record: Callable[[AnyRecord], None], began_s: float) -> Result:
    rig = load_rig(RIGS / plan.rig, plan.settings)
    time = VirtualTime()
    random = Random(f"{plan.seed} subscribers")  # noqa: S311 - a repeatable draw
    computer = Computer()
    subscribers = drawn_subscribers(time, random, plan.remote_consoles)
    with (
        installed(time),
        recorder_installed(time),
        client_installed(time, subscribers),
        computer_installed(time, computer),
        service_installed(time, Random(f"{plan.seed} service")),  # noqa: S311
    ):
        try:
            instrument = Instrument(rig, plan, time, subscribers, computer, on_record)
            for happening in plan.happenings:
                time.call_at(happening.at_s, partial(instrument.happen, happening))
            end_s = 0.0
            while end_s < plan.duration_s:
                end_s += 1.0
                time.run_until(end_s)
                instrument.answers_due()
            _recover(instrument)
            instrument.account_for_records()
        finally:
            time.end()
    violations = instrument.invariants.violations
    violations += [
        Violation(NO_EXCEPTION, 0.0, f"{name}: {_told(error)}") for name, error in time.escaped
    ]
    return Result(
        digest=instrument.digest,
        lasted_s=time.now_s(),
        modes=instrument.modes,
        violations=violations,
        cpu_s=process_time() - began_s,
    )


def _told(error: Exception) -> str:
    """What an exception says, and where it was raised: a replay may not show it again."""
    at = traceback.extract_tb(error.__traceback__)[-4:]
    where = ", ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in at)
    return f"{type(error).__name__}: {error} ({where})"


def _stay(instrument: Instrument) -> None:
    """Stars that are held stay where they are wanted, and the recorder writes what was recorded before."""
    time, violated = instrument.time, instrument.invariants.violated
    offered = instrument.records_offered
    time.run_until(time.now_s() + _STAY_S)
    instrument.records_written(offered, _STAY_S)
    for name, loop in instrument.supervisor.loops.items():
        if loop.mode not in HOLDING:
            violated("a star that is held stays so", f"{name}: {loop.mode.name}")
    truth, _ = instrument.rig.mock_parts()
    for name, star in instrument.supervisor.stellar_loops.items():
        if star.mode not in HOLDING:
            continue
        seen_px = instrument.plant.stellar_loops[name].history_px(time.now_s() - 1.0, time.now_s())
        error_px = seen_px[:, 0, 0] - star.target_px
        away_px, rms_px = np.abs(error_px.mean(axis=0)).max(), error_px.std(axis=0).max()
        if not away_px <= _STAYS_PX:
            violated("a star that is held stays so", f"{name}: {away_px:.2f} px from its target")
        if not (truth.stellar_loops[name].lines or rms_px <= _RMS_PX):
            violated("a star that is held stays so", f"{name}: {rms_px:.3f} px RMS")


def _recover(instrument: Instrument) -> None:
    """Nothing fails any more: `recover` and `acquire` must hold every star within `HEAL_S`."""
    time = instrument.time
    instrument.heal()
    time.run_until(time.now_s() + _BACK_S)
    instrument.end_sequences()
    instrument.give("ada", TakeOver())
    instrument.give("ada", Stop())
    for (
        name,
        loop,
    ) in instrument.rig.stellar_loops.items():  # two stars may have been sent to one place
        target_px = loop.target_px
        instrument.give("ada", SetTarget(loop=name, az_px=target_px.az, el_px=target_px.el))
    end_s = time.now_s() + HEAL_S
    # Where a star or a beam was never found, jogs and searches lead away; its operator knows where it is.
    from_zero_s = time.now_s() + HEAL_S / 3
    # A collector that moved while its beam was not held moved the star by more than a search covers.
    is_away = instrument.rig.collector is not None
    while time.now_s() < end_s:
        time.run_until(time.now_s() + 1.0)
        instrument.answers_due()
        loops = instrument.supervisor.loops
        if all(loop.mode in HOLDING for loop in loops.values()):
            break
        if is_away and time.now_s() > from_zero_s:
            instrument.give("ada", MoveCollector(action="reference"))
            is_away = False
        instrument.lead_on("ada", from_zero=time.now_s() > from_zero_s)
    else:
        modes = ", ".join(f"{name} {loop.mode.name}" for name, loop in loops.items())
        instrument.invariants.violated(f"healed, every star is held within {HEAL_S:g} s", modes)
        return
    _stay(instrument)
    if instrument.camera.at_other_rate:
        time.run_until(time.now_s() + MOST_RATE_S + 1.0)
        if instrument.camera.at_other_rate:
            instrument.invariants.violated(
                "the camera runs as the rig file says again", "it does not"
            )
    now_s = time.now_s()
    for each in instrument.supervisor.loops.values():
        for outcome in instrument.supervisor.outcomes.add_to(each.state(now_s)).outcomes:
            longest_s = next(row.wait_s for row in COMMANDS if row.word == outcome.command)
            if outcome.state == "under way" and now_s - outcome.began_s > longest_s:
                instrument.invariants.violated(
                    "what takes time ends", f"{outcome.command} of {outcome.began_s:.2f} s"
                )
