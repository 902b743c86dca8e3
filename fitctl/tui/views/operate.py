"""Operate: what an operator watches and does while a star is sought and held."""

from __future__ import annotations

from typing import ClassVar, Literal

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Container

from fitctl.messages.commands import Look, SetBiasOffset, SetTarget
from fitctl.tui.commands import Key, keys_of
from fitctl.tui.jog import MODES_WITH_STAR, JogPad
from fitctl.tui.state import LoopView
from fitctl.tui.views.view import View
from fitctl.tui.widgets.events import Events
from fitctl.tui.widgets.focalplane import FocalPlane
from fitctl.tui.widgets.hand import Hand
from fitctl.tui.widgets.health import Devices, Timing
from fitctl.tui.widgets.stages import Stages
from fitctl.tui.widgets.traces import Traces

AIM_STEP_PX = 0.5
_AIM_KEYS = [
    Key("", "↑↓←→", "Move", "screen.nudge", ""),
    Key("enter", "enter", "Set target", "screen.set_target", ""),
    Key("i", "i", "Look here", "screen.look", ""),
    Key("escape", "esc", "Leave", "screen.leave", ""),
]
_JOG_KEYS = [
    Key("", "↑↓←→", "Jog", "screen.nudge", ""),
    Key("", "[ ]", "Step", "screen.step", ""),
]
_STAGE_KEY = Key("tab", "tab", "Stage", "screen.next_stage", "")
_ZERO_KEY = Key("0", "0", "Zero offset", "screen.zero", "")
_LEAVE_KEY = Key("escape", "esc", "Leave", "screen.leave", "")


def has_target(loop: LoopView | None) -> bool:
    """Whether the loop follows a star, so that its target and window can be moved."""
    return loop is not None and loop.state.kind == "stellar" and loop.state.mode in MODES_WITH_STAR


class OperateView(View):
    """Focal plane, pointing error or search, stages, health and events."""

    view_name = "operate"
    BINDINGS: ClassVar[list[BindingType]] = [
        *(key.binding() for key in keys_of("operate")),
        Binding("up", "nudge(0, 1)", show=False),
        Binding("down", "nudge(0, -1)", show=False),
        Binding("right", "nudge(1, 0)", show=False),
        Binding("left", "nudge(-1, 0)", show=False),
        Binding("left_square_bracket", "step(-1)", show=False),
        Binding("right_square_bracket", "step(1)", show=False),
        Binding("tab", "next_stage", show=False),
        Binding("0", "zero", show=False),
        Binding("enter", "set_target", show=False),
        Binding("escape", "leave", show=False),
    ]

    def __init__(self) -> None:
        super().__init__()
        self.hand: Literal["", "aim", "jog"] = ""
        self.pad = JogPad()

    def parts(self) -> ComposeResult:
        """All panels, in reading order; the stylesheet places them."""
        yield FocalPlane(self.state, "Focal plane", self.console.pictures)
        yield Traces(self.state, "Pointing error")
        yield Stages(self.state, "Mirror and siderostat")
        with Container(id="health"):
            yield Devices(self.state, "Devices")
            yield Timing(self.state, "Timing and log")
        yield Events(self.state, "Events")
        yield Hand(self.state, self.pad)

    def on_screen_suspend(self) -> None:
        """A picture would lie over what is shown next; characters show through a dialog."""
        self._plane.redraw()

    def keys_now(self) -> list[Key]:
        """What the arrow keys are for."""
        if self.hand != "jog":
            return _AIM_KEYS if self.hand == "aim" else []
        stages = self.pad.stages(self.state.loop)
        stage = self.pad.stage(self.state.loop)
        keys = [*_JOG_KEYS, _STAGE_KEY] if len(stages) > 1 else [*_JOG_KEYS]
        is_mirror = stage is not None and stage.name == "mirror"
        return [*keys, _ZERO_KEY, _LEAVE_KEY] if is_mirror else [*keys, _LEAVE_KEY]

    def before_drawing(self) -> None:
        """A mode in which nothing can be moved ends it."""
        loop = self.state.loop
        idle = {"aim": not has_target(loop), "jog": self.pad.stage(loop) is None}
        if idle.get(self.hand):
            self._set_hand("")

    def to_rehearse(self) -> str:
        """The target at the cursor, if there is one."""
        cursor = self._plane.cursor_px
        return super().to_rehearse() if cursor is None else f"target {cursor[0]:g} {cursor[1]:g}"

    @property
    def _plane(self) -> FocalPlane:
        return self.query_one(FocalPlane)

    def _set_hand(self, hand: Literal["", "aim", "jog"]) -> None:
        self.hand = hand
        if hand != "aim":
            self._plane.cursor_px = None
        self.set_class(hand == "jog", "jogging")  # the stylesheet puts the hand where events are
        self.call_after_refresh(self.console.draw_all)

    # ------------------------------------------------------------ target and window

    def action_aim(self) -> None:
        """Put a cursor on the target."""
        tick = self.state.loop.tick if self.state.loop else None
        if tick is not None:
            self._aim_at(tick.target_az_px, tick.target_el_px)

    def action_look(self) -> None:
        """Put the window where the cursor is; without one, put a cursor."""
        cursor = self._plane.cursor_px
        if self.hand == "aim" and cursor is not None:
            self.console.send(Look(az_px=round(cursor[0], 3), el_px=round(cursor[1], 3)))
            self._set_hand("")
        else:
            self.action_aim()

    def on_focal_plane_picked(self, event: FocalPlane.Picked) -> None:
        """Put the cursor where the mouse was; what it is for is then chosen by a key."""
        self._aim_at(event.az_px, event.el_px)

    def _aim_at(self, az_px: float, el_px: float) -> None:
        if not has_target(self.state.loop):
            self.notify("target and window can move only while the loop holds a star", timeout=3)
            return
        frame = self.state.newest.frame if self.state.newest else None
        if frame is not None:
            az_px = min(max(az_px, 0.0), frame.width_px - 1.0)
            el_px = min(max(el_px, 0.0), frame.height_px - 1.0)
        self._plane.cursor_px = (az_px, el_px)
        self._set_hand("aim")

    def action_set_target(self) -> None:
        """Move the target to the cursor."""
        cursor = self._plane.cursor_px
        if self.hand == "aim" and cursor is not None:
            self.console.send(SetTarget(az_px=round(cursor[0], 3), el_px=round(cursor[1], 3)))
            self._set_hand("")

    # ------------------------------------------------------------ jog

    def action_jog(self) -> None:
        """Let the arrow keys move a stage, or no more."""
        if self.hand == "jog":
            self._set_hand("")
        elif self.pad.stage(self.state.loop) is None:
            self.notify(
                "you can move stages in STANDBY, and the target while the loop holds a star",
                timeout=4,
            )
        else:
            self._set_hand("jog")

    def action_nudge(self, right: int, up: int) -> None:
        """An arrow key: the cursor, or a stage; without either, nothing moves."""
        cursor, loop = self._plane.cursor_px, self.state.loop
        if self.hand == "aim" and cursor is not None:
            self._aim_at(cursor[0] + right * AIM_STEP_PX, cursor[1] + up * AIM_STEP_PX)
        elif self.hand == "jog" and loop is not None and not self.state.stale:
            command = self.pad.press(loop, right, up, self.console.clock())
            if command is not None:
                self.console.send(command)

    def action_step(self, by: int) -> None:
        """A finer or a coarser step."""
        stage = self.pad.stage(self.state.loop)
        if self.hand == "jog" and stage is not None:
            self.pad.change_step(stage, by)
            self.console.draw_all()

    def action_next_stage(self) -> None:
        """The other stage."""
        if self.hand == "jog":
            self.pad.next_stage()
            self.console.draw_all()

    def action_zero(self) -> None:
        """The mirror back to its bias."""
        stage = self.pad.stage(self.state.loop)
        if self.hand == "jog" and stage is not None and stage.name == "mirror":
            self.pad.begin_anew()
            self.console.send(SetBiasOffset(az_urad=0.0, el_urad=0.0))

    def action_leave(self) -> None:
        """The arrow keys move nothing any more."""
        self._set_hand("")

    # ------------------------------------------------------------ picture

    def action_colours(self) -> None:
        """The next colour map."""
        self._plane.next_colours()
        self._show_choice()

    def action_stretch(self) -> None:
        """The next stretch."""
        self._plane.next_stretch()
        self._show_choice()

    def _show_choice(self) -> None:
        plane = self._plane
        plane.border_title = f"Focal plane · {plane.colours} · {plane.stretch}"
        self.console.draw_all()
