"""What the arrow keys move, where it is, and by how much."""

from __future__ import annotations

from typing import ClassVar

from fitctl.tui.inks import DIM, INK, PAPER, WHITE, YELLOW
from fitctl.tui.jog import JogPad
from fitctl.tui.look import Line, number, text
from fitctl.tui.state import ConsoleState, LoopView
from fitctl.tui.widgets.panel import Panel


class Hand(Panel):
    """Shown in the place of the events while a stage is moved by hand."""

    every: ClassVar[int] = 1

    def __init__(self, state: ConsoleState, pad: JogPad) -> None:
        super().__init__(state, "By hand")
        self._pad = pad

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Stage and step, where it is, the steps to choose from."""
        loop = self.state.loop
        stage = self._pad.stage(self.state.loop)
        if loop is None or stage is None:
            return []
        step = self._pad.step(stage)
        steps: Line = [text("steps ", DIM)]
        for each in stage.steps:
            here = each == step
            steps.append(text(f" {each:g} ", WHITE if here else DIM, bold=here))
        return [
            [
                text(f" JOG {stage.name} ", PAPER, on=YELLOW, bold=True),
                text(f"  ±{step:g} {stage.unit}", INK, bold=True),
                text(f"  {stage.description}", DIM),
            ],
            [text("at    ", DIM), text(_place(loop, stage.name), INK)],
            steps,
        ]


def _place(loop: LoopView, stage: str) -> str:
    tick, beam = loop.tick, loop.beam
    siderostat = beam or tick
    if stage == "siderostat" and siderostat is not None:
        az, el = siderostat.siderostat_az_sky_arcsec, siderostat.siderostat_el_sky_arcsec
        return f"az {number(az, '+.1f')}″ el {number(el, '+.1f')}″"
    if stage == "mirror" or tick is None:
        az, el = loop.state.bias_offset_urad
        return f"offset az {number(az, '+.1f')} el {number(el, '+.1f')} µrad"
    return f"az {number(tick.target_az_px, '.2f')} el {number(tick.target_el_px, '.2f')} px"
