"""The operator's commands and every other key: one table for keys, footer, mouse, palette and help."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from textual.binding import Binding

from fitctl.messages.command_table import COMMANDS
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.state import ConsoleState

OPERATOR_COMMANDS = tuple(row for row in COMMANDS if row.key)
BY_NAME = {row.name: row for row in OPERATOR_COMMANDS}


class ViewName(NamedTuple):
    """A screen, and the key that leads to it."""

    key: str
    name: str
    label: str
    help: str


VIEWS = (
    ViewName("1", "operate", "Operate", "focal plane, pointing error, stages, health, events"),
    ViewName("2", "devices", "Devices", "every reading beside its limits, links, faults"),
    ViewName("3", "loop", "Loop", "timing, spectrum of the error, margins of the design"),
    ViewName("4", "sequences", "Sequences", "list, edit, rehearse, run, stop"),
    ViewName("5", "logs", "Logs", "list, keep, verify, report, replay"),
    ViewName("6", "help", "Help", "every key, mode and sign"),
)
COMMISSIONING = ViewName(
    "7", "commissioning", "Commissioning", "its steps and results; run, repeat, skip them"
)
SCREENS = (*VIEWS, COMMISSIONING)
"""All screens; the header has those of the night's work, and the last one where it is of use."""


def _always(_state: ConsoleState, _alarms: AlarmBook) -> bool:
    return True


class Key(NamedTuple):
    """A key of the console itself.

    Attributes
    ----------
    keys : str
        As Textual names them, several with commas.
    shown : str
        As people write it.
    label : str
        In the footer.
    action : str
        What Textual calls.
    help : str
    view : str
        The screen that has it; empty for all.
    matters : callable
        Whether it matters now; then the footer has it.
    """

    keys: str
    shown: str
    label: str
    action: str
    help: str
    view: str = ""
    matters: Callable[[ConsoleState, AlarmBook], bool] = _always

    @property
    def always(self) -> bool:
        """It matters at any time."""
        return self.matters is _always

    def binding(self) -> Binding:
        """For Textual."""
        return Binding(self.keys, self.action, self.label, show=False)


def _several_loops(state: ConsoleState, _alarms: AlarmBook) -> bool:
    return len(state.loops) > 1


def _by_hand(state: ConsoleState, _alarms: AlarmBook) -> bool:
    return (state.live and state.mode == "STANDBY") or _has_star(state, _alarms)


def _has_star(state: ConsoleState, _alarms: AlarmBook) -> bool:
    is_stellar = state.loop is not None and state.loop.state.kind == "stellar"
    return is_stellar and _live(state, _alarms) and state.mode in {"COARSE", "VERNIER"}


def _live(state: ConsoleState, _alarms: AlarmBook) -> bool:
    return state.live and not state.stale


def _past(state: ConsoleState, _alarms: AlarmBook) -> bool:
    return not state.live


def _sequence(state: ConsoleState, _alarms: AlarmBook) -> bool:
    return bool(state.live and state.newest and state.newest.running_sequence)


def _unacknowledged(state: ConsoleState, alarms: AlarmBook) -> bool:
    return state.live and alarms.unacknowledged


def _loud(state: ConsoleState, alarms: AlarmBook) -> bool:
    return state.live and alarms.loud


# In the footer these come before a screen's own keys.
ALARM_KEYS = (
    Key(
        "k",
        "k",
        "Acknowledge",
        "app.acknowledge",
        "acknowledge the alarms shown",
        "",
        _unacknowledged,
    ),
    Key("u", "u", "Silence", "app.silence", "silence the bell for these alarms", "", _loud),
    Key(
        "v",
        "v",
        "Alarms",
        "app.alarms",
        "alarms in full: what, since when, what to do",
        "",
        _unacknowledged,
    ),
)
# The console's past. Where they mean something else on a screen, the screen has them.
TIME_KEYS = (
    Key(
        "end", "end", "Now", "app.now", "follow the instrument again; of a log, its end", "", _past
    ),
    Key("comma", ",", "Back 1 s", "app.rewind(-1)", "the console as it was 1 s earlier"),
    Key("full_stop", ".", "Forward 1 s", "app.rewind(1)", "1 s later", "", _past),
    Key("less_than_sign", "<", "Back 10 s", "app.rewind(-10)", "10 s earlier", "", _past),
    Key("greater_than_sign", ">", "Forward 10 s", "app.rewind(10)", "10 s later", "", _past),
    Key("left_curly_bracket", "{", "Back 1 min", "app.rewind(-60)", "1 min earlier", "", _past),
    Key("right_curly_bracket", "}", "Forward 1 min", "app.rewind(60)", "1 min later", "", _past),
    Key(
        "left_parenthesis",
        "(",
        "Alarm before",
        "app.jump(-1)",
        "5 s before the previous warning or error",
        "",
        _past,
    ),
    Key(
        "right_parenthesis",
        ")",
        "Alarm after",
        "app.jump(1)",
        "5 s before the next warning or error",
        "",
        _past,
    ),
    Key("at", "@", "Time", "app.at_time", "the console as it was at a time", "", _past),
    Key("home", "home", "Oldest", "app.oldest", "the oldest moment that is kept", "", _past),
)
KEYS = (
    Key("t", "t", "Target", "screen.aim", "put a cursor on the focal plane", "operate", _has_star),
    Key("i", "i", "Look", "screen.look", "follow the star at the cursor", "operate", _has_star),
    Key("j", "j", "Jog", "screen.jog", "move a stage with the arrow keys", "operate", _by_hand),
    Key(
        "d",
        "d",
        "Rehearse",
        "app.rehearse",
        "what a command would do, without sending it",
        "operate",
        _live,
    ),
    Key("w", "w", "Window", "app.window", "RMS and traces over 10, 60 or 1 s", "operate"),
    Key("x", "x", "Stretch", "screen.stretch", "grey scale: asinh, square root, linear", "operate"),
    Key("c", "c", "Colours", "screen.colours", "colour map of the focal plane", "operate"),
    Key("up,down", "↑↓", "Choose", "", "choose a reading", "devices"),
    Key(
        "enter",
        "enter",
        "More",
        "screen.more",
        "details of the chosen device or reading",
        "devices",
    ),
    Key("n", "n", "Reset", "screen.reset", "reset the chosen interlock", "devices"),
    Key("w", "w", "Window", "app.window", "over 10, 60 or 1 s", "loop"),
    Key("up,down", "↑↓", "Choose", "", "choose a sequence or a parameter", "sequences"),
    Key("tab", "tab", "Other list", "app.focus_next", "sequences or parameters", "sequences"),
    Key("enter", "enter", "Edit", "screen.edit", "change the chosen parameter", "sequences"),
    Key("d", "d", "Dry run", "screen.dry_run", "run it on a virtual clock", "sequences"),
    Key("g", "g", "Go", "screen.go", "run it on the instrument", "sequences"),
    Key("p", "p", "Pause", "screen.pause", "pause or continue it", "sequences", _sequence),
    Key(
        "z",
        "z",
        "End it",
        "screen.end",
        "end it; its loops release their stars",
        "sequences",
        _sequence,
    ),
    Key("f", "f", "File", "screen.file", "open a sequence file of your own", "sequences"),
    Key("up,down", "↑↓", "Choose", "", "choose a log", "logs"),
    Key("enter", "enter", "Info", "screen.tool('info')", "contents of the chosen log", "logs"),
    Key("m", "m", "Keep", "screen.keep", "protect it from deletion, or undo that", "logs"),
    Key("f", "f", "Verify", "screen.tool('verify')", "verify that it is complete", "logs"),
    Key("t", "t", "Report", "screen.tool('report')", "make a report of it", "logs"),
    Key("y", "y", "Replay", "screen.tool('replay')", "run its frames through today's code", "logs"),
    Key("up,down", "↑↓", "Choose", "", "choose a step", "commissioning"),
    Key("g", "g", "Go on", "screen.go", "do the steps that are left to do", "commissioning"),
    Key("d", "d", "Do", "screen.do", "do the chosen step, also again", "commissioning"),
    Key("n", "n", "Skip", "screen.skip", "leave it out, with a reason", "commissioning"),
    Key("z", "z", "End it", "screen.end", "end the running step", "commissioning"),
    Key(
        "slash", "/", "Find", "screen.filter", "show only rows with the words that you type", "help"
    ),
    Key(
        "escape", "esc", "Leave", "screen.leave", "every row again; then the screen before", "help"
    ),
    *ALARM_KEYS,
    *TIME_KEYS,
    Key("e", "e", "Events", "app.events", "all events at full length"),
    Key("l", "l", "Loop", "app.next_loop", "show the next loop", "", _several_loops),
    Key("ctrl+p", "^p", "Palette", "app.command_palette", "every command by its name"),
    Key("question_mark,f1", "?", "Help", "app.view('help')", "this help"),
    Key("q", "q", "Quit", "app.quit", "leave the console"),
)


def keys_of(view: str) -> list[Key]:
    """The keys of one screen; an empty name stands for the keys of all screens."""
    return [key for key in KEYS if key.view == view]
