"""Runs steps: check, run, wait until done, stop what failed, try again; all attempts are recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Literal

import msgspec

from fitctl.logging.records import SequenceAttempt
from fitctl.messages.commands import MoveCollector, Release
from fitctl.messages.modes import METROLOGY_MODES, STELLAR_MODES, Mode
from fitctl.sequences.behaviours.behaviour import Behaviour, Calibration, Result
from fitctl.sequences.behaviours.stars import evaluate, star_results, steps_of
from fitctl.sequences.behaviours.table import BEHAVIOURS, loops_of, problems
from fitctl.sequences.contact import MESSAGE_CHARS, Contact, Forgotten, Stopped
from fitctl.sequences.steps import Collector, CollectorScan, Off, Standby, Star, Stars, Step
from fitctl.sequences.view import Figures, SequenceError, StepFailed, View

_RETRY_S = 1.0  # between attempts
# Modes that lead on by themselves, so that a step may wait in them for the one that it needs.
_ON_THE_WAY = frozenset({Mode.ACQUISITION, Mode.COARSE, Mode.EXPERIMENT})

Outcome = Literal["done", "failed", "timed out", "stopped"]


class TimedOut(StepFailed):
    """The step was not done in time."""


class Runner:
    """Runs the steps of one sequence, one at a time, by its contact with the supervisor.

    Parameters
    ----------
    contact : Contact
    motion_goes_on : bool
        A motion of the collector that a step began goes on after the last step, if that was done.
    """

    def __init__(self, contact: Contact, *, motion_goes_on: bool = False) -> None:
        self.attempts: list[SequenceAttempt] = []
        self.calibrations: list[Calibration] = []
        self.contact = contact
        self._link = contact.link
        self._rig = contact.rig
        self._star = ""  # of a list, that the step is for
        self._may_move_collector = False  # a step may have begun a motion that none has ended
        self._moving_since_s = math.inf  # if a motion goes on during the next steps
        self._motion_goes_on = motion_goes_on

    def hold_stages(self) -> None:
        """Stop tracking with every loop that had a step; one that does not track refuses, and may."""
        for name in self.contact.loops:
            with suppress(ConnectionError):
                self._link.send(Release(loop=name))

    def stop_collector(self, *, done: bool) -> None:
        """Stop a motion of the collector that a step may have begun; without an answer, try once more."""
        if not self._may_move_collector or (done and self._motion_goes_on):
            return
        for _ in range(2):
            with suppress(ConnectionError):
                self._link.send(MoveCollector(action="stop"))
                return

    def run(self, step: Step) -> SequenceAttempt:
        """Run one step, as often as it may be tried.

        Raises
        ------
        SequenceError
            If no attempt succeeds.
        Stopped
            If a loop that has had a step is SAFE, or somebody stops the sequence.
        """
        number = self.contact.status.step_number + 1
        wrong = problems(step, self._rig)
        if wrong:
            msg = f"step {number} ({step.step}): {'; '.join(wrong)}"
            raise SequenceError(msg)
        loop_names = loops_of(step, self._rig)
        if step.loop or BEHAVIOURS[step.step].loops != "none" or len(self._rig.loops) == 1:
            self.contact.loops.update(dict.fromkeys(loop_names))
        if isinstance(step, Stars):
            return self._run_stars(step, loop_names[0], number)
        if isinstance(step, Collector | CollectorScan):
            return self._run_collector(step, loop_names[0], number)
        for loop_name in loop_names:
            record = self._try(lambda: step, loop_name, number)
        return record

    def _run_collector(
        self, step: Collector | CollectorScan, loop_name: str, number: int
    ) -> SequenceAttempt:
        """A step that watches the collector itself; a motion that it starts goes on during the next steps."""
        self._may_move_collector, self._moving_since_s = True, math.inf
        record = self._try(lambda: step, loop_name, number)
        goes_on = isinstance(step, Collector) and step.action == "start"
        self._may_move_collector = goes_on
        self._moving_since_s = record.began_s if goes_on else math.inf
        return record

    def _run_stars(self, step: Stars, loop_name: str, number: int) -> SequenceAttempt:
        """Each star's steps, one star after the other; one that fails is skipped, if the step says so."""
        began_s, first = self._link.now_s(), len(self.attempts)
        # Devices that are not ready are no star's fault, and end the step.
        self._try(lambda: Standby(loop=step.loop), loop_name, number)
        placed_s = self._link.now_s()

        def made(star: Star, which: int) -> Step:
            return steps_of(step, star, self._link.now_s() - placed_s)[which]

        for star in step.stars or []:
            try:
                for which in range(len(steps_of(step, star))):
                    self._try(partial(made, star, which), loop_name, number, star.name)
            except SequenceError:
                if step.on_failure == "fail":
                    raise
        self._report(step.step, loop_name, number, 1, "")
        try:
            result = evaluate(step, star_results(self.attempts[first:]))
        except StepFailed as failure:
            record = self._record("failed", str(failure), {}, began_s)
            msg = f"step {number} ({step.step}) failed: {failure}"
            raise SequenceError(msg, record) from None
        return self._record("done", result.message, result.figures, began_s)

    def _report(self, step: str, loop_name: str, number: int, attempt: int, star: str) -> None:
        self._star = star
        self.contact.report(
            state="running", step_number=number, step=step, loop=loop_name, attempt=attempt,
            message=star,
        )  # fmt: skip

    def _try(
        self, make: Callable[[], Step], loop_name: str, number: int, star: str = ""
    ) -> SequenceAttempt:
        """A step, made anew for each attempt: a star of a list may have moved on."""
        attempt, step = 0, make()
        while attempt < step.attempts:
            attempt, step = attempt + 1, make()
            self._report(step.step, loop_name, number, attempt, star)
            record = self._attempt(step, loop_name)
            if record.outcome == "done":
                return record
            if attempt < step.attempts:
                self._rest(loop_name)
        what = f"{step.step}, star {star}" if star else step.step
        msg = f"step {number} ({what}) {record.outcome}: {record.message}"
        raise SequenceError(msg, record)

    # ------------------------------------------------------------ one attempt

    def _attempt(self, step: Step, loop_name: str) -> SequenceAttempt:
        behaviour = BEHAVIOURS[step.step]
        began_s = self._link.now_s()
        view: View | None = None
        try:
            view = self.contact.view_of(loop_name)
            self._wait_while_paused(view)
            self._wait_for_mode(step, behaviour, view)
            result = self._work(step, behaviour, view)
        except StepFailed as failure:
            if view is not None:
                behaviour.stop(step, view)
            outcome: Outcome = "timed out" if isinstance(failure, TimedOut) else "failed"
            return self._record(outcome, str(failure), {}, began_s)
        except Forgotten:
            raise  # the loops may be another sequence's by now
        except ConnectionError:
            if view is not None:
                view.attempt = step.attempts  # no other follows
                with suppress(ConnectionError):
                    behaviour.stop(step, view)
            raise
        except (Stopped, KeyboardInterrupt) as stopped:
            release = not isinstance(stopped, Stopped) or stopped.release
            with suppress(ConnectionError):
                if view is not None and release:
                    behaviour.stop(step, view)
                self._record("stopped", str(stopped) or "interrupted", {}, began_s)
            raise
        if result.calibration is not None:
            self.calibrations.append(result.calibration)
        return self._record("done", result.message, result.figures, began_s)

    def _work(self, step: Step, behaviour: Behaviour, view: View) -> Result:
        limit_s = behaviour.own_s(step, self._rig, view.loop_name) + step.timeout_s
        view.began_s, view.paused_s = self._link.now_s(), 0.0
        view.measurements.clear()
        behaviour.run(step, view)
        while True:
            paused = behaviour.pausable and self.contact.pause_wanted
            self.contact.next(view, paused=paused)
            self._require_motion(step, view)
            if paused or self.contact.show_pause(paused=False):
                continue
            if view.now_s >= view.fresh_s:
                result = behaviour.done(step, view)
                if result is not None:
                    return result
            if view.elapsed_s > limit_s:
                msg = f"not done within {limit_s:g} s; loop {view.loop_name} is in {view.mode.name}"
                raise TimedOut(msg)

    def _require_motion(self, step: Step, view: View) -> None:
        """Refuse to go on with a collector that stands still where a step before has it move."""
        if not isinstance(step, Off):
            if self._moving_since_s < math.inf:
                view.require_motion(self._moving_since_s)
        elif all(loop.mode == Mode.OFF.name for loop in view.telemetry.loops):
            self._moving_since_s = math.inf  # the supervisor stops the collector with the last loop

    def _wait_for_mode(self, step: Step, behaviour: Behaviour, view: View) -> None:
        begun_s = view.now_s
        while view.mode not in behaviour.needs:
            of_kind = METROLOGY_MODES if view.loop.kind == "metrology" else STELLAR_MODES
            needs = " or ".join(mode.name for mode in of_kind if mode in behaviour.needs)
            msg = f"{step.step} needs {needs}; loop {view.loop_name} is in {view.mode.name}"
            if view.mode not in _ON_THE_WAY:
                raise StepFailed(msg)
            if view.now_s - begun_s > step.timeout_s:
                late = f"{msg}, still after {step.timeout_s:g} s"
                raise TimedOut(late)
            self.contact.next(view)

    def _wait_while_paused(self, view: View) -> None:
        while self.contact.pause_wanted:
            self.contact.next(view, paused=True)
        self.contact.show_pause(paused=False)

    def _rest(self, loop_name: str) -> None:
        view = self.contact.view_of(loop_name)
        end_s = view.now_s + _RETRY_S
        while view.now_s < end_s:
            self.contact.next(view)

    def _record(
        self, outcome: Outcome, message: str, figures: Figures, began_s: float
    ) -> SequenceAttempt:
        now_s = self._link.now_s()
        record = SequenceAttempt(
            time_s=now_s,
            sequence_name=self.contact.status.name,
            step_number=self.contact.status.step_number,
            step=self.contact.status.step,
            loop=self.contact.status.loop,
            attempt=self.contact.status.attempt,
            began_s=began_s,
            ended_s=now_s,
            outcome=outcome,
            message=message[:MESSAGE_CHARS],
            figures_json=msgspec.json.encode(figures).decode(),
            star=self._star,
        )
        self.attempts.append(record)
        self.contact.report(last_attempt=record)
        return record


@contextmanager
def _ending(runner: Runner) -> Iterator[None]:
    """Tell how it ended, whatever happens inside; a stop becomes a SequenceError."""
    try:
        yield
    except Stopped as stopped:
        if stopped.release:
            runner.hold_stages()
        runner.stop_collector(done=False)
        runner.contact.end("stopped", str(stopped))
        raise SequenceError(
            str(stopped), runner.attempts[-1] if runner.attempts else None
        ) from None
    except (SequenceError, ConnectionError) as error:
        runner.stop_collector(done=False)
        runner.contact.end("failed", str(error))
        raise
    except KeyboardInterrupt:
        runner.hold_stages()
        runner.stop_collector(done=False)
        runner.contact.end("stopped", "interrupted")
        raise
    except Exception as error:
        runner.stop_collector(done=False)
        runner.contact.end("failed", repr(error))
        raise
    runner.stop_collector(done=True)
    runner.contact.end("done")


def run_steps(runner: Runner, steps: Iterable[Step]) -> list[SequenceAttempt]:
    """Begin, run these steps, end; the records of all attempts.

    Raises
    ------
    SequenceError
        If another sequence is under way, a step fails or the sequence is stopped; the text says which.
    ConnectionError
        If the supervisor does not answer or falls silent.
    """
    runner.contact.begin()
    with _ending(runner):
        for step in steps:
            runner.run(step)
    return runner.attempts
