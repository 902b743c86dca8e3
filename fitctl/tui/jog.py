"""Moving the stages by hand: what the arrow keys move, by how much, and the command that does it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from fitctl.messages.commands import Jog, SetBiasOffset, SetTarget
from fitctl.tui.state import LoopView

AGAIN_S = 1.0


class Stage(NamedTuple):
    """What can be moved, in which modes, and the steps to choose from, the finest first."""

    name: str
    description: str
    modes: frozenset[str]
    unit: str
    steps: tuple[float, ...]


MODES_WITH_STAR = frozenset({"COARSE", "VERNIER"})
_STANDBY = frozenset({"STANDBY"})
STAGES = (
    Stage("siderostat", "coarse", _STANDBY, "″ on the sky", (0.5, 2.0, 10.0, 50.0)),
    Stage("mirror", "fine, about its bias", _STANDBY, "µrad", (1.0, 5.0, 20.0)),
    Stage("target", "the star follows it", MODES_WITH_STAR, "px", (0.1, 0.5, 2.0)),
)


@dataclass
class JogPad:
    """The operator's choices.

    Presses that follow each other within `AGAIN_S` add up, though telemetry does not show them yet.
    """

    number: int = 0
    step_numbers: list[int] = field(default_factory=lambda: [1] * len(STAGES))
    pressed_s: float = -math.inf
    place: tuple[float, float] = (0.0, 0.0)

    def stages(self, loop: LoopView | None) -> list[Stage]:
        """What the arrow keys can move now; a metrology loop has a siderostat, no mirror and no target."""
        if loop is None:
            return []
        there = [stage for stage in STAGES if loop.state.mode in stage.modes]
        return (
            there if loop.state.kind == "stellar" else [s for s in there if s.name == "siderostat"]
        )

    def stage(self, loop: LoopView | None) -> Stage | None:
        """What the arrow keys move; None where nothing may be moved."""
        there = self.stages(loop)
        return there[self.number % len(there)] if there else None

    def step(self, stage: Stage) -> float:
        """How far one press goes, in the stage's unit."""
        return stage.steps[self.step_numbers[STAGES.index(stage)]]

    def next_stage(self) -> None:
        """Choose the other stage."""
        self.number += 1
        self.begin_anew()

    def begin_anew(self) -> None:
        """The next press is from where telemetry says that it is."""
        self.pressed_s = -math.inf

    def change_step(self, stage: Stage, by: int) -> None:
        """Choose a coarser or finer step."""
        number = STAGES.index(stage)
        self.step_numbers[number] = max(
            0, min(len(stage.steps) - 1, self.step_numbers[number] + by)
        )

    def press(
        self, loop: LoopView, right: int, up: int, now_s: float
    ) -> Jog | SetBiasOffset | SetTarget | None:
        """The command of an arrow key; None where nothing may be moved."""
        stage = self.stage(loop)
        if stage is None:
            return None
        step = self.step(stage)
        az, el = right * step, up * step
        if stage.name == "siderostat":
            return Jog(az_sky_arcsec=az, el_sky_arcsec=el)
        if now_s - self.pressed_s > AGAIN_S:
            self.place = _place(loop, stage)
        self.pressed_s = now_s
        self.place = (round(self.place[0] + az, 6), round(self.place[1] + el, 6))
        if stage.name == "mirror":
            return SetBiasOffset(az_urad=self.place[0], el_urad=self.place[1])
        return SetTarget(az_px=self.place[0], el_px=self.place[1])


def _place(loop: LoopView, stage: Stage) -> tuple[float, float]:
    """Where it is, as telemetry has it."""
    if stage.name == "mirror" or loop.tick is None:
        return loop.state.bias_offset_urad
    return loop.tick.target_az_px, loop.tick.target_el_px
