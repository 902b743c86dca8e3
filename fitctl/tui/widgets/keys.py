"""The bottom line: every key, with those of no use now set back."""

from __future__ import annotations

from fitctl.tui.commands import OPERATOR_COMMANDS
from fitctl.tui.look import INK, PAPER, RED, SKY, Line, text, width
from fitctl.tui.widgets.panel import Panel


class Keys(Panel):
    """Key caps and labels. A command of no use now loses its cap; stop always has one."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """One line; labels that do not fit are left to the help screen."""
        loop = self.state.loop
        usable = set(loop.state.usable_commands) if loop and not self.state.stale else set()
        line: Line = []
        for command in OPERATOR_COMMANDS:
            if command.name == "Stop":
                line += [
                    text(f" {command.key} {command.label} ", PAPER, on=RED, bold=True),
                    text(" "),
                ]
            else:
                line += _cap(command.key, command.label, usable=command.name in usable)
        others = [("l", "Loop")] if len(self.state.loops) > 1 else []
        others += [("?", "Help"), ("q", "Quit"), ("e", "Events"), ("^p", "Palette")]
        for key, label in others:
            cap = _cap(key, label, usable=True)
            if width(line) + width(cap) <= columns + 1:
                line += cap
        return [line]


def _cap(key: str, label: str, *, usable: bool) -> Line:
    if usable:
        return [text(key, PAPER, on=SKY, bold=True), text(f" {label} ", INK)]
    return [text(f"{key} {label} ", "#5a6675")]
