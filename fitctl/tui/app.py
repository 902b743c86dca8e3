"""The operator console: telemetry in, commands out, one screen."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import ClassVar

import msgspec
from textual.app import App, ComposeResult, SystemCommand
from textual.binding import Binding, BindingType
from textual.containers import Container
from textual.events import Resize
from textual.message import Message
from textual.screen import Screen

from fitctl.supervisor.command_table import ROWS, command_of
from fitctl.supervisor.messages import (
    AnyCommand,
    Reply,
    Shutdown,
    Status,
    Stop,
    TakeOver,
    Telemetry,
)
from fitctl.tui.commands import BY_NAME, OPERATOR_COMMANDS
from fitctl.tui.link import Link
from fitctl.tui.palette import ControllerProvider, ResetProvider, TargetProvider
from fitctl.tui.screens import Reader, events_text, help_text
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.events import Events
from fitctl.tui.widgets.focalplane import FocalPlane
from fitctl.tui.widgets.header import Header
from fitctl.tui.widgets.health import Devices, Timing
from fitctl.tui.widgets.keys import Keys
from fitctl.tui.widgets.panel import Panel
from fitctl.tui.widgets.stages import Stages
from fitctl.tui.widgets.traces import Traces

RECEIVE_TIMEOUT_S = 0.2
UNDRAWN_MESSAGES = (
    20  # a terminal that takes nothing holds the screen up; more telemetry then waits in the link
)
EXIT_WAIT_S = 2.5
KEEP_S = 4.0  # a console that is open keeps the lease of its user; less than the shortest lease
UNREADABLE_NOTICE_S = 10.0  # at most one notice in this time
UNREADABLE_PAUSE_S = 0.01  # a link that fails at once must not keep a processor busy
DRAW_PERIODS_S: dict[type[Panel], float] = {
    FocalPlane: 0.1,
    Header: 0.1,
    Stages: 0.2,
    Traces: 0.2,
    Events: 0.2,
    Keys: 0.2,
    Devices: 0.5,
    Timing: 0.5,
}


class Received(Message):
    """Telemetry came."""

    def __init__(self, telemetry: Telemetry) -> None:
        super().__init__()
        self.telemetry = telemetry


class Unreadable(Message):
    """Something came that is not telemetry as this console knows it."""

    def __init__(self, problem: str) -> None:
        super().__init__()
        self.problem = problem


class Answered(Message):
    """A command was answered, or it was not: then `reply` is None and `problem` says why."""

    def __init__(self, command: AnyCommand, reply: Reply | None, problem: str = "") -> None:
        super().__init__()
        self.command = command
        self.reply = reply
        self.problem = problem


class ConsoleApp(App[None]):
    """The operator console.

    Parameters
    ----------
    link : Link
        The connection to the supervisor; closed at the end.
    quit_shuts_down : bool
        Quitting ends the instrument too (which the caller does); only the help says so here.
    clock : callable
        Monotonic time in s, the supervisor's own when it runs on this machine.
    """

    CSS_PATH = Path(__file__).with_name("console.tcss")
    TITLE = "fitctl"
    ENABLE_COMMAND_PALETTE = True
    COMMANDS = App.COMMANDS | {TargetProvider, ControllerProvider, ResetProvider}
    BINDINGS: ClassVar[list[BindingType]] = [
        # A priority binding works over every dialog. A text field keeps "s" and space for itself.
        Binding("s,space,ctrl+s", "command('Stop')", "STOP", priority=True, show=False),
        *(
            Binding(command.key, f"command('{command.name}')", command.label, show=False)
            for command in OPERATOR_COMMANDS
            if command.name != "Stop"
        ),
        Binding("l", "next_loop", "Loop", show=False),
        Binding("e", "events", "Events", show=False),
        Binding("question_mark", "help", "Help", show=False),
        Binding("q", "quit", "Quit", show=False),
        # What a shell's user expects, also over a dialog.
        Binding("ctrl+c,ctrl+q", "quit", "Quit", priority=True, show=False),
    ]

    def __init__(
        self,
        link: Link,
        *,
        quit_shuts_down: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self.link = link
        self.quit_shuts_down = quit_shuts_down
        self.clock = clock
        self.state = ConsoleState(clock())
        self._ended = threading.Event()
        self._room = threading.Semaphore(UNDRAWN_MESSAGES)
        self._reader = threading.Thread(target=self._read, name="console-reader", daemon=True)
        self._senders: set[threading.Thread] = set()

    def compose(self) -> ComposeResult:
        """All panels, in reading order; the stylesheet places them."""
        yield Header(self.state)
        with Container(id="body"):
            yield FocalPlane(self.state, "Focal plane")
            yield Traces(self.state, "Pointing error")
            yield Stages(self.state, "Mirror and siderostat")
            with Container(id="health"):
                yield Devices(self.state, "Devices")
                yield Timing(self.state, "Timing and log")
            yield Events(self.state, "Events")
        yield Keys(self.state)

    def on_mount(self) -> None:
        """Begin to read and to draw."""
        self._panels = list(self.query(Panel))
        self._arrange(self.size.width, self.size.height)
        for period_s in sorted(set(DRAW_PERIODS_S.values())):
            self.set_interval(period_s, partial(self._draw, period_s))
        self.set_interval(KEEP_S, partial(self.give, Status()))
        self._reader.start()

    def on_unmount(self) -> None:
        """Let commands that are on their way arrive (a stop above all), then let go of the link."""
        self._ended.set()
        deadline_s = time.monotonic() + EXIT_WAIT_S
        for thread in (*self._senders, self._reader):
            if thread.is_alive():
                thread.join(max(0.0, deadline_s - time.monotonic()))
        self.link.close()

    def on_resize(self, event: Resize) -> None:
        """Choose the layout that fits."""
        self._arrange(event.size.width, event.size.height)

    def _arrange(self, columns: int, rows: int) -> None:
        tall = rows >= 36
        zoom = 3 if columns >= 220 and rows >= 82 else 2 if columns >= 150 and rows >= 58 else 1
        screen = self.screen_stack[0]
        screen.set_class(not tall, "short")
        screen.set_class(tall, "tall")
        screen.set_class(tall and columns >= 40 * zoom + 76, "wide")
        screen.set_class(tall and zoom == 2, "zoom2")
        screen.set_class(tall and zoom == 3, "zoom3")

    # ------------------------------------------------------------ telemetry

    def _read(self) -> None:
        notice_due_s = -math.inf
        while not self._ended.is_set():
            if not self._room.acquire(timeout=RECEIVE_TIMEOUT_S):
                continue
            telemetry = None
            try:
                telemetry = self.link.receive(RECEIVE_TIMEOUT_S)
            except (ConnectionError, msgspec.MsgspecError, UnicodeDecodeError) as error:
                if self.clock() >= notice_due_s:
                    notice_due_s = self.clock() + UNREADABLE_NOTICE_S
                    self.post_message(Unreadable(str(error)))
                self._ended.wait(UNREADABLE_PAUSE_S)
            if telemetry is None:
                self._room.release()
            elif not self._ended.is_set():
                self.post_message(Received(telemetry))

    def on_received(self, message: Received) -> None:
        """Remember; draw at once only what must not wait."""
        self._room.release()
        before = self.state.loop.state.mode if self.state.loop else ""
        was_stale = self.state.stale
        self.state.accept(message.telemetry, self.clock())
        after = self.state.loop.state.mode if self.state.loop else ""
        if before != after or was_stale:
            self.draw_all()

    def on_unreadable(self, message: Unreadable) -> None:
        """Say that telemetry comes but cannot be used."""
        self.notify(
            message.problem,
            title="✗ telemetry unreadable",
            severity="error",
            timeout=UNREADABLE_NOTICE_S,
            markup=False,
        )

    def _draw(self, period_s: float) -> None:
        self.state.now_s = self.clock()
        self.screen_stack[0].set_class(self.state.stale, "stale")
        with self.batch_update():
            for panel in self._panels:
                if DRAW_PERIODS_S[type(panel)] == period_s:
                    panel.redraw()

    def draw_all(self) -> None:
        """Bring every panel up to date now."""
        for period_s in set(DRAW_PERIODS_S.values()):
            self._draw(period_s)

    # ------------------------------------------------------------ commands

    def give(self, command: AnyCommand) -> None:
        """Send a command for the shown loop on a thread of its own, so that none waits for another.

        A stop goes to all loops.
        """
        loop = "" if isinstance(command, Stop | Shutdown) else self.state.shown
        thread = threading.Thread(
            target=self._send,
            args=(msgspec.structs.replace(command, loop=loop),),
            name=f"console-{type(command).__name__}",
            daemon=True,
        )
        self._senders = {sender for sender in self._senders if sender.is_alive()} | {thread}
        thread.start()

    def _send(self, command: AnyCommand) -> None:
        try:
            answer = Answered(command, self.link.send(command))
        except (ConnectionError, TimeoutError) as error:
            answer = Answered(command, None, str(error))
        except Exception as error:  # a defect, but STOP must never fail in silence
            answer = Answered(command, None, f"It failed: {type(error).__name__}: {error}")
        if not self._ended.is_set():
            self.post_message(answer)

    def on_answered(self, message: Answered) -> None:
        """Say what became of a command, where that is not plain to see."""
        name = type(message.command).__name__
        if name == "Status":
            return  # that nobody answers is plain to see: telemetry is missing too
        if message.reply is None:
            text = message.problem
            if name == "Stop":
                text += "\nThe instrument may still move. Press STOP again, or cut its power."
            self.notify(
                text, title=f"✗ {name} not confirmed", severity="error", timeout=20, markup=False
            )
        elif not message.reply.accepted:
            self.notify(
                message.reply.text or "no reason given",
                title=f"▲ {name} refused",
                severity="warning",
                timeout=8,
                markup=False,
            )
        elif name == "Stop":
            self.notify("all loops go to SAFE", title="■ STOP confirmed", timeout=3)
        elif name == "TakeOver":
            self.notify(message.reply.text, title="Taken over", timeout=5, markup=False)

    def action_command(self, name: str) -> None:
        """Give the command of a key."""
        self.give(command_of(BY_NAME[name].word, (), ""))

    def action_next_loop(self) -> None:
        """Show the next loop."""
        self.state.show_next_loop()
        self.draw_all()

    def action_help(self) -> None:
        """Open the help."""
        self.push_screen(Reader("Help", help_text(quit_shuts_down=self.quit_shuts_down)))

    def action_events(self) -> None:
        """Open the events at full length."""
        columns = min(100, int(0.9 * self.size.width)) - 6
        self.push_screen(Reader("Events", events_text(self.state, columns)))

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        """Every command, for the palette."""
        for command in OPERATOR_COMMANDS:
            yield SystemCommand(
                command.label, command.help, partial(self.action_command, command.name)
            )
        yield SystemCommand("Events", "All events at full length", self.action_events)
        yield SystemCommand("Next loop", "Show the next loop", self.action_next_loop)
        yield SystemCommand("Help", "Keys, modes and signs", self.action_help)
        yield SystemCommand(
            "Take over",
            f"{ROWS[TakeOver].help}, to command in their stead",
            partial(self.give, TakeOver()),
        )
        yield SystemCommand(
            "Shut down the supervisor",
            "SAFE, OFF, then end the supervisor process",
            partial(self.give, Shutdown()),
        )
        yield SystemCommand(
            "Screenshot",
            "Save the screen as SVG",
            lambda: self.set_timer(0.1, self.deliver_screenshot),
        )
        yield SystemCommand("Quit", "Leave the console", self.action_quit)
