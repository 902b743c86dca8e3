"""Designs that are made beside the ticks: by command, learnt from a loop's frames, or for its star's light."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from fitctl.clock import Clock
from fitctl.config import ConfigError, Rig
from fitctl.controllers.pair import LEARNT, Designer
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import LearnerReport, Reply, SetController
from fitctl.messages.modes import OPERATOR
from fitctl.stages.journal import Journal, error_text
from fitctl.supervisor.device_jobs import Ended, Job
from fitctl.supervisor.outcomes import Outcomes
from fitctl.supervisor.starlight import Starlight


class DesignJobs:
    """Makes designs of stellar loops, which takes longer than a tick, and has the loops use them.

    Parameters
    ----------
    rig : Rig
    loops : mapping of str to StellarLoop
    clock : Clock
    executor : Executor
        Runs one design after the other.
    journal : Journal
    outcomes : Outcomes
        Hears how commands end.
    design : Designer
    """

    def __init__(
        self,
        rig: Rig,
        loops: Mapping[str, StellarLoop],
        clock: Clock,
        executor: Executor,
        journal: Journal,
        outcomes: Outcomes,
        design: Designer,
    ) -> None:
        self._rig = rig
        self._loops = loops
        self._clock = clock
        self._executor = executor
        self._journal = journal
        self._outcomes = outcomes
        self._design = design
        self._jobs: deque[Job] = deque()
        self._wanted: dict[str, Future] = {}  # of each loop, by its last `controller` command
        self._learning: dict[str, Future] = {}  # of each loop, by its learner's last report
        self._starlight = [Starlight(rig, loop, journal) for loop in loops.values()]

    @property
    def busy(self) -> bool:
        """Designs are being made."""
        return bool(self._jobs)

    def finish(self) -> None:
        """Have the loops use the designs that are ready, in the order of the requests."""
        while self._jobs and self._jobs[0].future.done():
            job = self._jobs.popleft()
            job.done(job.future)

    # ------------------------------------------------------------ by command

    def begin(self, command: SetController, names: Iterable[str]) -> Reply:
        """Make the design that a command asks for, in each of these loops."""
        names = [name for name in names if name in self._loops]
        if not names:
            why_not = f"loop {command.loop} holds a metrology beam and has no design"
            return Reply(accepted=False, text=why_not)
        learnt: dict[str, LearnerReport] = {}
        if command.name == LEARNT:
            for name in names:
                report = self._loops[name].learning.report
                if report is None or not report.design_json:
                    return Reply(accepted=False, text=_nothing_learnt(name, report))
                learnt[name] = report
        number = self._outcomes.begin(command, names)
        for name in names:
            asked_for = learnt.get(name)
            chosen = command.name if asked_for is None else asked_for.design_json
            if name in self._wanted:
                # The command before asked for another design, which would delay this one.
                self._wanted[name].cancel()
            ended = partial(self._outcomes.end, number, [name])
            done = partial(self._designed, name, command.name, asked_for, ended)
            self._wanted[name] = self._make(done, name, chosen)
        self.finish()
        text = "designing; fitctl status shows the controller in force"
        return Reply(accepted=True, number=number, text=text)

    def _make(self, done: Callable[[Future], None], *wanted: Any) -> Future:
        """Have a design made: of a loop, by its name or parameters, perhaps for a noise of the sensor."""
        future = self._executor.submit(self._design, self._rig, *wanted)
        self._jobs.append(Job(future, done))
        return future

    def _designed(
        self,
        name: str,
        controller: str,
        report: LearnerReport | None,
        ended: Ended,
        future: Future,
    ) -> None:
        if self._wanted[name] is not future:
            return  # another command replaced it
        error = future.exception()
        if error is None:
            loop = self._loops[name]
            reason = OPERATOR
            if report is not None:
                gains = loop.learning.what_is_gained(report) if report.worth_it else report.text
                reason = f"{OPERATOR}; {gains}"
            loop.use(future.result(), reason, report=report)
            ended(f"controller {controller} is in force", failed=False)
        else:
            why = error_text(error, ConfigError)
            self._journal.event("error", name, f"no design {controller}: {why}")
            ended(f"no design {controller}: {why}", failed=True)

    # ------------------------------------------------------------ by itself

    def learn(self, loop: StellarLoop, report: LearnerReport) -> None:
        """Keep a learner's report, and make its design where the loop wants it."""
        news = loop.learning.accept(report)
        if news:
            self._journal.event("info", loop.name, news)
        if loop.learning.wants_change(self._clock.now_s()):
            before = self._learning.get(loop.name)
            if before is not None:
                before.cancel()  # if it has not begun: a newer report counts more
            done = partial(self._learnt, loop, report)
            self._learning[loop.name] = self._make(done, loop.name, report.design_json)
            self.finish()

    def _learnt(self, loop: StellarLoop, report: LearnerReport, future: Future) -> None:
        """Use a learnt design, if the loop is still calm; the learner's next report comes soon."""
        if future.cancelled():
            return
        error = future.exception()
        if error is not None:
            self._journal.event(
                "warning", loop.name, f"no learnt design: {error_text(error, ConfigError)}"
            )
        elif loop.learning.wants_change(self._clock.now_s()):
            reason = loop.learning.what_is_gained(report)
            loop.use(future.result(), reason, report=report, by_itself=True)

    def observe_light(self) -> None:
        """Have designs made for the light of their stars, where that has become another; once a frame."""
        for light in self._starlight:
            noise_px = light.observe()
            if noise_px is not None:
                name, controller = light.loop.name, light.loop.pointing.design.name
                self._make(partial(light.designed, noise_px), name, controller, noise_px)


def _nothing_learnt(name: str, report: LearnerReport | None) -> str:
    if report is None:
        return (
            f"nothing is learnt of loop {name} yet; it takes a minute in VERNIER, and loops.{name}.learn must "
            'not be "off"'
        )
    return f"nothing is learnt of loop {name}: {report.text}"
