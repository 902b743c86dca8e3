"""The operator console: telemetry in, commands out, one screen for each concern."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, cast

import msgspec
from textual.app import App, SystemCommand
from textual.binding import Binding, BindingType
from textual.notifications import Notification, Notify, SeverityLevel
from textual.screen import Screen
from textual.widgets._toast import Toast

from fitctl.messages.client import Client
from fitctl.messages.command_table import ROWS, WORDS, command_of
from fitctl.messages.commands import (
    CONTROLLER_CHOICES,
    AnyCommand,
    RecentEvents,
    Reply,
    Reset,
    SetController,
    Shutdown,
    Status,
    Stop,
    TakeOver,
)
from fitctl.messages.modes import AT_REST
from fitctl.messages.telemetry import Telemetry
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import BY_NAME, OPERATOR_COMMANDS, SCREENS, keys_of
from fitctl.tui.dialogs import Alarms, Ask, Confirm, Reader, Running, events_text
from fitctl.tui.graphics import Graphics, PictureSender
from fitctl.tui.jobs import Job
from fitctl.tui.look import as_markup
from fitctl.tui.pace import Pace
from fitctl.tui.palette import PlaceProvider
from fitctl.tui.rewind.moment import Recording
from fitctl.tui.rewind.playback import BEFORE_S, Playback
from fitctl.tui.rewind.recent import Recent
from fitctl.tui.state import ConsoleState
from fitctl.tui.terminal import TerminalDriver
from fitctl.tui.views.commissioning import CommissioningView
from fitctl.tui.views.devices import DevicesView
from fitctl.tui.views.help import HelpView
from fitctl.tui.views.logs import LogsView
from fitctl.tui.views.loop import LoopScreen
from fitctl.tui.views.operate import OperateView
from fitctl.tui.views.sequences import SequencesView
from fitctl.tui.views.view import View
from fitctl.tui.widgets.alarmbar import AlarmBar
from fitctl.tui.widgets.keys import StopKey
from fitctl.tui.wire import UNREADABLE_NOTICE_S, NoLink, Wire

BEAT_S = 0.1
"""How often something is drawn, if the machine allows; a panel says at which of these beats."""
_NEVER_S = 1e9  # when Textual would let go of a notice by itself
_UNCONFIRMED_S = 20.0  # a notice of a command that may not have arrived
KEEP_S = 4.0  # a console that is open keeps the lease of its user; less than the shortest lease


class ConsoleApp(App[None]):
    """The operator console.

    Parameters
    ----------
    link : Client or NoLink
        The connection to the supervisor; closed at the end.
    quit_shuts_down : bool
        Quitting ends the instrument too (which the caller does); only the help says so here.
    clock : callable
        Monotonic time in s, the supervisor's own when it runs on this machine.
    rig_arguments : sequence of str
        With which other fitctl commands have the same rig file; None when no file of this rig is known, and
        nothing that needs one may be run.
    remote_arguments : sequence of str
        And with which they reach its instrument, where that is on another machine.
    commissioning : sequence of str, optional
        With which `fitctl commission` does the steps of this rig; None where this console does not do them.
        One that does has a supervisor only while a step runs one.
    log_folder : Path
        Where the rig's logs are; None when that is on another machine.
    start_job : callable
        Starts another fitctl command.
    graphics : Graphics
        How the focal plane is drawn; not `auto`.
    log : Recording, optional
        Shown instead of what the link receives.
    log_name : str
    """

    CSS_PATH = Path(__file__).with_name("console.tcss")
    TITLE = "fitctl"
    ENABLE_COMMAND_PALETTE = True
    COMMANDS = App.COMMANDS | {PlaceProvider}
    MODES: ClassVar[dict[str, str | Callable[[], Screen[Any]]]] = {
        "operate": OperateView,
        "devices": DevicesView,
        "loop": LoopScreen,
        "sequences": SequencesView,
        "logs": LogsView,
        "help": HelpView,
        "commissioning": CommissioningView,
    }
    DEFAULT_MODE = "operate"
    BINDINGS: ClassVar[list[BindingType]] = [
        # A priority binding works over every dialog. A text field keeps "s" and space for itself.
        Binding("s,space,ctrl+s", "command('Stop')", "STOP", priority=True, show=False),
        *(
            Binding(command.key, f"command('{command.name}')", command.label, show=False)
            for command in OPERATOR_COMMANDS
            if command.name != "Stop"
        ),
        *(Binding(view.key, f"view('{view.name}')", view.label, show=False) for view in SCREENS),
        *(key.binding() for key in keys_of("") if key.label != "Palette"),
        # What a shell's user expects, also over a dialog.
        Binding("ctrl+c,ctrl+q", "quit", "Quit", priority=True, show=False),
    ]

    def __init__(
        self,
        link: Client | NoLink,
        *,
        quit_shuts_down: bool = False,
        clock: Callable[[], float] = time.monotonic,
        rig_arguments: Sequence[str] | None = (),
        remote_arguments: Sequence[str] = (),
        commissioning: Sequence[str] | None = None,
        log_folder: Path | None = Path("logs"),
        start_job: Callable[..., Job] = Job,
        graphics: Graphics = Graphics.HALF_BLOCKS,
        log: Recording | None = None,
        log_name: str = "",
    ) -> None:
        # A page in a browser brings a driver of its own.
        super().__init__(None if "TEXTUAL_DRIVER" in os.environ else TerminalDriver)
        self.quit_shuts_down = quit_shuts_down
        self.clock = clock
        self.rig_arguments = rig_arguments
        self.remote_arguments = list(remote_arguments)
        self.commissioning = commissioning
        self.step_job: Job | None = None
        self.view_before = self.DEFAULT_MODE
        self.log_folder = log_folder
        self.start_job = start_job
        self.pictures: PictureSender | None = None
        if graphics is not Graphics.HALF_BLOCKS:
            self.pictures = PictureSender(graphics, self._write_to_terminal)
        self.state = ConsoleState(clock(), waits_for_supervisor=commissioning is None)
        self.alarms = AlarmBook()
        self._recent = Recent(lambda: tuple(self.playback.live.events))
        self.playback = Playback(
            self.state,
            self.alarms,
            log or self._recent,
            log_name,
            from_thread=self.call_later,
            notify=partial(self.notify, timeout=4, markup=False),
            draw=self.draw_all,
        )
        self._beat = 0
        self._notice_s: dict[str, float] = {}  # of those that are not on the screen yet
        self._stop_notice: Notification | None = None  # of a stop that was not confirmed
        self.pace = Pace()
        self._wire = Wire(
            link,
            clock,
            # From the wire's threads to the console's own.
            partial(self.call_later, self._accept),
            partial(self.call_later, self._notify_unreadable),
            partial(self.call_later, self._handle_reply),
        )

    def _write_to_terminal(self, sequence: str) -> None:
        if self._driver is not None:  # Textual has no public way for what is no text
            self._driver.write(sequence)

    def on_mount(self) -> None:
        """Begin to read and to draw."""
        self.set_interval(BEAT_S, self._draw_due)
        self.set_interval(KEEP_S, self._keep)
        if self.playback.log_name:
            self.playback.oldest()
        else:
            self._wire.start()
        if self.commissioning is not None:
            self.action_view("commissioning")

    def on_unmount(self) -> None:
        """Let go of everything."""
        self.playback.close()
        self._wire.close()

    # ------------------------------------------------------------ telemetry

    def _accept(self, telemetry: Telemetry) -> None:
        """Remember; draw at once only what must not wait."""
        self._wire.processed()
        live, now_s = self.playback.live, self.clock()
        before, was_stale = live.mode, live.stale
        known = live.newest
        live.accept(telemetry, now_s)
        self._recent.add(telemetry, now_s)
        if known is None or known.pid != telemetry.pid:
            self._ask_for_events()
        if before != live.mode or was_stale:
            self.draw_all()

    def _notify_unreadable(self, problem: str) -> None:
        """Show that telemetry comes but cannot be used."""
        self.notify(
            problem,
            title="✗ telemetry unreadable",
            severity="error",
            timeout=UNREADABLE_NOTICE_S,
            markup=False,
        )

    @property
    def view(self) -> View | None:
        """The screen under whatever dialogs are open; None before there is one."""
        bottom = self.screen_stack[:1]  # while screens are changed there is none
        return bottom[0] if bottom and isinstance(bottom[0], View) else None

    def notify(
        self,
        message: str,
        *,
        title: str = "",
        severity: SeverityLevel = "information",
        timeout: float | None = None,
        markup: bool = True,
    ) -> None:
        """Show a notice for `timeout` s, which count from when it is on the screen.

        Textual's count from when it is raised. On a busy machine they can be over before it is drawn, and an
        operator would not learn that a STOP is confirmed.
        """
        notice = Notification(message, title, severity, _NEVER_S, markup=markup)
        self._raise_notice(notice, self.NOTIFICATION_TIMEOUT if timeout is None else timeout)

    def _raise_notice(self, notice: Notification, timeout: float) -> None:
        self._notice_s[notice.identity] = timeout
        self.post_message(Notify(notice))

    def _end_stop_notice(self) -> None:
        """A stop was not confirmed in time, but the telemetry shows all loops in SAFE or OFF."""
        live, notice = self.playback.live, self._stop_notice
        if notice is None or live.stale or live.newest is None:
            return
        if {loop.mode for loop in live.newest.loops} <= {mode.name for mode in AT_REST}:
            self._stop_notice = None
            self._notice_s.pop(notice.identity, None)
            self._unnotify(notice)
            self.notify("all loops are in SAFE or OFF", title="■ the loops have stopped", timeout=5)

    def _time_notices(self) -> None:
        """Begin to count the time of those that have come onto the screen."""
        top = self.screen_stack[-1:]  # while screens are changed there is none
        for toast in top[0].query(Toast) if top else ():
            notice = toast._notification  # Textual has no public way to what a toast shows
            if toast.size.area and notice.identity in self._notice_s:
                self.set_timer(self._notice_s.pop(notice.identity), partial(self._unnotify, notice))

    def _draw_due(self) -> None:
        if self._notice_s:  # to look for them takes a walk through all widgets
            self._time_notices()
        if self.pace.due():
            self._beat += 1
            self._draw(self._beat)

    def draw_all(self) -> None:
        """Bring everything on the screen up to date now."""
        self._draw(None)

    def _draw(self, beat: int | None) -> None:
        playback = self.playback
        playback.live.now_s = self.clock()
        if not playback.log_name and playback.live_alarms.update(playback.live):
            self.bell()
        self._end_stop_notice()
        for dialog in self.screen_stack[1:]:  # also those that Textual opens, such as the palette
            if dialog.is_attached and not dialog.query(StopKey):
                dialog.mount(StopKey())
        if self.view is not None:
            with self.batch_update():
                self.view.draw(beat)

    # ------------------------------------------------------------ commands

    def send(self, command: AnyCommand) -> None:
        """Send a command for the shown loop; a stop goes to all loops. In the past only a stop is sent.

        A stop also ends a running step of the commissioning, whose motors have no supervisor at first.
        """
        if isinstance(command, Stop):
            self.end_step()
        why_not = self.playback.why_not(command)
        if why_not:
            title = f"▲ {ROWS[type(command)].title} is not sent"
            self.notify(why_not, title=title, severity="warning", timeout=6, markup=False)
            return
        for_all = isinstance(command, Stop) or ROWS[type(command)].of_rig
        loop = "" if for_all else self.state.shown
        self._wire.send(msgspec.structs.replace(command, loop=loop))

    @property
    def _nothing_runs(self) -> bool:
        """Whether this console does a commissioning, and neither a step nor a supervisor is there."""
        over = self.step_job is None or self.step_job.status is not None
        return self.commissioning is not None and self.state.stale and over

    def end_step(self) -> None:
        """End the running step of the commissioning."""
        if self.step_job is not None and self.step_job.status is None:
            self.step_job.interrupt()
            self.notify(
                "its motors stand, and lose their power", title="■ the step ends", timeout=5
            )

    def _keep(self) -> None:
        """Keep the instrument; hear what was missed."""
        if self.playback.log_name:
            return
        self._wire.send(Status())
        if self.playback.live.events_missing:
            self._ask_for_events()

    def _ask_for_events(self) -> None:
        self.playback.live.events_missing = False
        self._wire.send(RecentEvents())

    def ask(self, title: str, question: str, then: Callable[[], object]) -> None:
        """Do something after the operator has confirmed it."""

        def answered(yes: bool | None) -> None:
            if yes:
                then()

        self.push_screen(Confirm(title, question), answered)

    def _handle_reply(self, command: AnyCommand, reply: Reply | None, problem: str) -> None:
        """Show what became of a command, where that is not plain to see; without a reply, the problem."""
        name, title = type(command).__name__, ROWS[type(command)].title
        if name == "Status":
            return  # which only keeps the instrument; a lost link is in the header
        if name == "RecentEvents":
            self._recall(reply)
            return
        if reply is None:
            if name == "Stop" and self._nothing_runs:
                self.notify("no step and no supervisor runs now", title="■ STOP", timeout=5)
                return
            if name == "Stop":
                problem += "\nThe instrument may still move. Press STOP again, or cut its power."
            notice = Notification(
                problem, f"✗ {title} not confirmed", "error", _NEVER_S, markup=False
            )
            self._raise_notice(notice, _UNCONFIRMED_S)
            if name == "Stop":
                self._stop_notice = notice
        elif not reply.accepted:
            self.notify(
                reply.text or "no reason given",
                title=f"▲ {title} refused",
                severity="warning",
                timeout=8,
                markup=False,
            )
        elif name == "Stop":
            self.notify("all loops go to SAFE", title="■ STOP confirmed", timeout=3)
        elif name == "TakeOver":
            self.notify(reply.text, title="Taken over", timeout=5, markup=False)

    def _recall(self, reply: Reply | None) -> None:
        if reply is None or not reply.accepted:
            self.playback.live.events_missing = True  # they are asked for again
        else:
            self.playback.live.recall(reply.events)
            self.draw_all()

    def action_command(self, name: str) -> None:
        """Give the command of a key, at once or after its question."""
        command = BY_NAME[name]
        send = partial(self.send, command_of(command.word, (), ""))
        if command.question and name in self.state.usable_commands:
            self.ask(command.label, command.question, send)
        else:
            send()

    # ------------------------------------------------------------ screens and dialogs

    def action_view(self, name: str) -> None:
        """Show a screen."""
        if name != self.current_mode:
            self.view_before = self.current_mode
        self.switch_mode(name)
        self.call_after_refresh(self.draw_all)

    def action_next_loop(self) -> None:
        """Show the next loop."""
        self.state.show_next_loop()
        self.draw_all()

    def action_show_loop(self, name: str) -> None:
        """Show a loop."""
        if name in self.state.loops:
            self.state.shown = name
            self.draw_all()

    def action_window(self) -> None:
        """Show the next window of RMS and traces."""
        self.state.next_window()
        self.draw_all()

    def action_acknowledge(self) -> None:
        """The operator has seen the alarms that the screen shows."""
        if self.view is not None and self._is_now("Acknowledge"):
            self.alarms.acknowledge(self.view.query_one(AlarmBar).shown)
            self.draw_all()

    def _is_now(self, what: str) -> bool:
        """Whether the screen shows the present; if not, a notice says what has to wait."""
        if not self.state.live:
            self.notify(f"{what}: the console shows the past; press end first", timeout=4)
        return self.state.live

    def action_rewind(self, by_s: float) -> None:
        """Show the past: back or forward by some seconds."""
        self.playback.step(by_s)

    def action_oldest(self) -> None:
        """Show the oldest moment."""
        self.playback.oldest()

    def action_now(self) -> None:
        """Show what is now again."""
        self.playback.now()

    def action_jump(self, direction: int) -> None:
        """Show the moment before the next or the previous warning or error."""
        self.playback.jump(direction)

    def action_at_time(self) -> None:
        """Show the moment of a time that is typed."""

        def show(value: str | None) -> None:
            time_s = self.playback.time_of(value) if value else None
            if time_s is not None:
                self.playback.to(time_s)

        prompt = "UTC, such as 03:14:07; or before the newest data, such as -2:30"
        self.push_screen(Ask("Show the moment", prompt, "-1:00", self.playback.refused), show)

    def _show_alarm(self, since_s: float | None) -> None:
        if since_s is not None:
            self.playback.to(since_s - BEFORE_S)

    def action_silence(self) -> None:
        """No bell for these alarms."""
        if not self._is_now("Silence"):
            return
        self.alarms.silence()
        self.notify("bell silenced for these alarms; a new alarm rings", timeout=3)

    def action_rehearse(self) -> None:
        """Ask for a command, and show what it would do, computed by a process of its own."""
        rig_arguments = self.rig_arguments
        if not self._is_now("Rehearse"):
            return
        if rig_arguments is None:
            text = "a rehearsal needs the rig file: start the console again with --rig FILE"
            self.notify(text, severity="warning", timeout=8)
            return

        def refused(text: str) -> str:
            word = next(iter(text.split()), "")
            return (
                "" if word in WORDS else f"unknown command {word!r}. Available: {', '.join(WORDS)}"
            )

        def rehearse(text: str | None) -> None:
            if text:
                where = ["--loop", self.state.shown, *rig_arguments, *self.remote_arguments]
                job = self.start_job(["rehearse", *text.split(), *where])
                self.push_screen(Running(f"Rehearse {text}", job))

        prompt = "command to rehearse, with its values, as for fitctl send; nothing is sent"
        words = self.view.to_rehearse() if self.view else ""
        self.push_screen(Ask("Rehearse", prompt, words, refused), rehearse)

    def action_alarms(self) -> None:
        """Open the alarms in full."""
        self.push_screen(Alarms(self.state, self.alarms), self._show_alarm)

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
        take_over = ROWS[TakeOver]
        yield SystemCommand("Take over", take_over.help, partial(self.send, TakeOver()))
        for name in CONTROLLER_CHOICES:
            set_controller = partial(self.send, SetController(name=name))
            about = "In VERNIER, the mirror continues from where it is"
            yield SystemCommand(f"controller {name}", about, set_controller)
        for trip in self.state.loop.state.interlocks if self.state.loop else ():
            reset = partial(self.send, Reset(name=trip.name))
            what, why = as_markup(f"reset {trip.name}"), as_markup(trip.reason)
            yield SystemCommand(what, why, reset)
        for view in SCREENS:
            yield SystemCommand(
                f"Screen: {view.label}", view.help, partial(self.action_view, view.name)
            )
        own = self.view.view_name if self.view else ""
        for key in (*keys_of(own), *keys_of("")):
            if key.action and key.label not in {"Palette", "Help"}:
                run = partial(self._run, key.action)
                yield SystemCommand(key.label, f"{key.help} ({key.shown})", run)
        yield SystemCommand(
            "Shut down the supervisor",
            "SAFE, OFF, then end the supervisor process",
            lambda: self.ask(
                "Shut down",
                "End the supervisor? All loops go to SAFE and OFF, for every console.",
                partial(self.send, Shutdown()),
            ),
        )
        yield SystemCommand(
            "Screenshot",
            "Save the screen as SVG",
            lambda: self.set_timer(0.1, self.deliver_screenshot),
        )

    async def _run(self, action: str) -> None:
        await self.run_action(action, default_namespace=cast("View", self.view))
