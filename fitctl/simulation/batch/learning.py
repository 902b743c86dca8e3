"""Batched runs whose loops learn: the live loop's learner and its decisions, on the frames of a compiled run.

A run is the same until a design or the camera's frame rate changes, and costs less than one of the learner's
reports. So it is made again from its beginning with each change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import VirtualClock
from fitctl.config import ConfigError, Rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.pair import LEAST_EXCESS_PX, Design, Measurement
from fitctl.learn.learner import Learner, Shown
from fitctl.loop.learning import Learning, refused_report
from fitctl.loop.pointing import Pointing
from fitctl.loop.sky import sky_rad_s
from fitctl.messages.commands import LearnerReport
from fitctl.messages.modes import Mode
from fitctl.model.optics import scales
from fitctl.simulation.batch.settings import design_settings
from fitctl.simulation.devices import InlineExecutor
from fitctl.stages.journal import Journal
from fitctl.supervisor.frame_rate import FrameRateChange

Records = NDArray[np.void]
_NAMES = {int(mode): mode.name for mode in Mode}
# Of mirror, fsm, siderostat and link, in the order of Shown.
_FIELDS = ("exposed_mirror_rad", "mirror_command_rad", "motor_rad", "link_motor_rad")
_LINK = slice(6, 8)


class Change(NamedTuple):
    """A change of design that a loop makes by itself.

    Attributes
    ----------
    loop : str
    time_s : float
    design : Design
    settings : structured array of DESIGN, shape ()
    """

    loop: str
    time_s: float
    design: Design
    settings: Records


class RateChange(NamedTuple):
    """Another frame rate of the camera, after so many frames: the fields of RATE."""

    frames: int
    period_s: float


class Changes(NamedTuple):
    """What loops of a run change by themselves, in its order."""

    designs: tuple[Change, ...]
    rates: tuple[RateChange, ...]


NO_CHANGES = Changes((), ())


class _Frame(NamedTuple):
    """A tick on a frame; `beam_rad` is as :class:`fitctl.loop.observation.Observation` has it, shape (2,)."""

    shown: Shown
    beam_rad: NDArray[np.float64]


def changes_of(rig: Rig, run: Callable[[Changes], dict[str, Records]]) -> Changes:
    """All that the loops of a run change by themselves.

    Parameters
    ----------
    rig : Rig
    run : callable
        Makes the run with such changes, and returns the states after each frame by stellar loop; none if the
        run met what the batch does not model.
    """
    loops = [
        _Loop(rig, index, name)
        for index, (name, loop) in enumerate(rig.stellar_loops.items())
        if loop.learn == "on"
    ]
    camera = _Camera(rig)
    changes = NO_CHANGES
    ticks = run(changes)
    number = 0
    while ticks and number < min(map(len, ticks.values())):
        designs = tuple(
            change for loop in loops for change in loop.decide(ticks[loop.name], number)
        )
        rates = camera.decide(loops, ticks[loops[0].name]["now_s"][number], number + 1)
        if designs or rates:
            changes = Changes(changes.designs + designs, changes.rates + rates)
            ticks = run(changes)
        for loop in loops if ticks else ():
            loop.finish(ticks[loop.name], number)
        number += 1
    return changes


class _Camera:
    """What the supervisor does with the camera's frame rate."""

    def __init__(self, rig: Rig) -> None:
        self._clock = VirtualClock()
        self._rates: list[RateChange] = []
        self._frames = 0
        self._looked_s = 0.0
        self._change = FrameRateChange(
            rig,
            self,
            lambda: 1,
            InlineExecutor(),
            Journal(self._clock, lambda _: None),
            lambda _: None,
        )

    def decide(self, loops: list[_Loop], now_s: float, frames: int) -> tuple[RateChange, ...]:
        """Which rate follows a frame, if it is another: for a learner, or the rig file's again."""
        self._rates.clear()
        self._frames = frames
        self._clock.sleep_until(now_s)
        self._change.check()
        if now_s - self._looked_s >= 1.0:  # it looks once a second whether a learner wants one
            self._looked_s = now_s
            for loop in loops:
                if loop.learning.may_act(now_s):
                    self._change.for_learner(*loop.asked)
        return tuple(self._rates)

    def set_frame_rate(self, rate_hz: float) -> None:
        """From the next frame on."""
        self._rates.append(RateChange(self._frames, 1 / rate_hz))


class _Loop:
    """What a live loop has for learning."""

    def __init__(self, rig: Rig, index: int, name: str) -> None:
        target_px = rig.stellar_loops[name].target_px
        self.name = name
        self._rig = rig
        self._index = index
        loop = rig.stellar_loops[name]
        self._linked = loop.link is not None
        self._sky_rad_s = sky_rad_s(loop.star_rate_sky_arcsec_s, scales(rig, loop))
        self._learner = Learner(rig, name)
        self.learning = Learning(rig, name)
        self.asked = (0.0, -math.inf)  # for which frame rate, Hz, and when
        self._pointing = Pointing(
            rig, name, np.array([target_px.az, target_px.el]), design_for(rig, name)
        )
        self._report: LearnerReport | None = None
        self._held = self._saturated = False
        self._ticks: Records | None = None
        self._frames: list[_Frame] = []
        self._first = 0

    def decide(self, ticks: Records, number: int) -> list[Change]:
        """Change the design before the loop acts on a frame: to a learnt one, or back to the one before."""
        frame, learning = self._frame(ticks, number), self.learning
        shown, made = frame.shown, []
        report, self._report = self._report, None
        if report is not None and not refused_report(report):
            learning.accept(report)
            self.asked = (report.classifying_rate_hz, shown.time_s)
            if learning.wants_change(shown.time_s):
                made += self._designed(number, shown.time_s, report)
        holds = shown.mode == Mode.VERNIER.name and not shown.held
        if holds and not self._held:
            self._pointing.forget()
            self._saturated = False
        self._held = holds
        why_back = learning.observe(
            shown.time_s,
            shown.mid_exposure_s,
            (shown.error_az_px, shown.error_el_px) if shown.star_visible else None,
            (shown.target_az_px, shown.target_el_px),
            (np.array([shown.mirror_az_rad, shown.mirror_el_rad]), frame.beam_rad),
            saturated=self._saturated,
            hindered=not holds,
        )
        if why_back and learning.before is not None:
            learning.fell_back(why_back, shown.time_s)
            made.append(self._use(number, shown.time_s, learning.before, None))
        return made

    def finish(self, ticks: Records, number: int) -> None:
        """The loop has acted on a frame."""
        frame, pointing = self._frame(ticks, number), self._pointing
        shown = frame.shown
        if self._held and shown.star_visible:
            pointing.remember(
                Measurement(
                    (shown.error_az_px, shown.error_el_px),
                    (shown.target_az_px, shown.target_el_px),
                    np.array([shown.mirror_az_rad, shown.mirror_el_rad]),
                    frame.beam_rad,
                )
            )
        elif self._held:
            pointing.forget()
        self._saturated = shown.fsm_saturated
        self._learner.add(shown)
        self._learner.watch(self.learning.design_json or pointing.design.title, shown.time_s)
        if self._learner.due:
            frames = self._learner.begin_report()
            self._report = self._learner.report(pointing.design, frames)

    def _designed(self, number: int, now_s: float, report: LearnerReport) -> list[Change]:
        """As the supervisor has it made and used; none if it is rejected."""
        try:
            design = design_for(self._rig, self.name, report.design_json)
        except ConfigError:
            return []
        return [self._use(number, now_s, design, report)]

    def _use(
        self, number: int, now_s: float, design: Design, report: LearnerReport | None
    ) -> Change:
        pointing = self._pointing
        self.learning.changed(pointing.design, design, report, pointing.recent, by_itself=True)
        pointing.use(design)
        knows = pointing.start_knowing()
        if not knows:
            pointing.forget()
        self._saturated = False
        settings = design_settings(self._index, number + 1, pointing.pair, knows=knows)
        return Change(self.name, now_s, design, settings)

    def _frame(self, ticks: Records, number: int) -> _Frame:
        if ticks is not self._ticks:
            self._ticks, self._first = ticks, number
            self._frames = _frames(ticks[number:], self._sky_rad_s, linked=self._linked)
        return self._frames[number - self._first]


def _frames(ticks: Records, sky_rad_s: NDArray[np.float64], *, linked: bool) -> list[_Frame]:
    """The ticks of one loop, as its records have them."""
    saturated = np.abs(ticks["excess_px"]).max(axis=1, initial=0.0) > LEAST_EXCESS_PX
    holds = ticks["mode"] == Mode.VERNIER
    stages = np.hstack([ticks[name] for name in _FIELDS])
    if not linked:
        stages[:, _LINK] = np.nan
    columns = np.column_stack(
        [
            ticks["command_px"],
            ticks["now_s"],
            ticks["exposed_s"],
            ticks["star_px"] - ticks["command_px"],
            stages,
            ticks["exposed_s"][:, None] * sky_rad_s,
        ]
    )
    return [
        _Frame(
            Shown(number, _NAMES[mode], is_saturated, waits == 1, visible == 1, *values), beam_rad
        )
        for number, mode, is_saturated, visible, values, waits, beam_rad in zip(
            ticks["frames"].tolist(),
            ticks["mode"].tolist(),
            (saturated & holds).tolist(),
            ticks["star_visible"].tolist(),
            columns.tolist(),
            ticks["waits"].tolist(),
            ticks["beam_rad"],
            strict=True,
        )
    ]
