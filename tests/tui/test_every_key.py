"""Every key of every screen and dialog: what it changes, and that it changes nothing else."""

import asyncio
from typing import Any, NamedTuple

import pytest
from textual.screen import Screen

from fitctl.logging.records import Event
from fitctl.messages.commands import (
    Acquire,
    Off,
    RecentEvents,
    Recover,
    Release,
    Reset,
    SequenceControl,
    SetBiasOffset,
    SetTarget,
    Standby,
    Status,
    Stop,
)
from fitctl.tui.app import ConsoleApp
from fitctl.tui.commands import KEYS, OPERATOR_COMMANDS
from fitctl.tui.commands import SCREENS as ALL_SCREENS
from fitctl.tui.dialogs import Alarms, Ask, Confirm, Reader, Running
from fitctl.tui.jog import JogPad
from fitctl.tui.state import WINDOWS
from fitctl.tui.views.operate import OperateView
from fitctl.tui.widgets.choice import Choice
from fitctl.tui.widgets.focalplane import FocalPlane
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.fixed import FixedApp, make_logs

SCREENS = [ConsoleApp.MODES[view.name] for view in ALL_SCREENS]
BOUND = (ConsoleApp, Choice, *SCREENS, Reader, Alarms, Running, Confirm, Ask)
OF_ITS_OWN_ACCORD = (["sequence", "list"], ["log", "summary"], ["commission", "--list"])
LOG = "fit-mock_20261132T031500Z.mcap"
STAR = {"hand": "aim", "cursor_px": (24.0, 19.5)}
CLOSED = {"dialog": ""}


class Row(NamedTuple):
    """What has the key, the key as Textual names it, what was pressed before, and what it changes."""

    on: type
    key: str
    before: str
    does: dict[str, Any]


def lines(on, table):
    return [Row(on, *line) for line in table]


STANDBY = [
    *lines(
        ConsoleApp,
        [
            ("s", "", {"given": [Stop()]}),
            ("space", "", {"given": [Stop()]}),
            ("ctrl+s", "", {"given": [Stop()]}),
            ("b", "", {"given": [Standby(loop="right")]}),
            ("a", "", {"given": [Acquire(loop="right")]}),
            ("h", "", {"given": [Release(loop="right")]}),
            ("r", "", {"given": [Recover(loop="right")]}),
            ("o", "", {"dialog": "Confirm"}),
        ],
    ),
    *lines(
        OperateView,
        [
            ("left_square_bracket", "j", {"step": 0.5}),
            ("right_square_bracket", "j", {"step": 10.0}),
            ("tab", "j", {"stage": "mirror", "step": 5.0}),
            ("0", "j tab", {"given": [SetBiasOffset(loop="right", az_urad=0.0, el_urad=0.0)]}),
        ],
    ),
    *lines(
        Confirm,
        [
            ("y", "o", {"dialog": "", "given": [Off(loop="right")]}),
            *((key, "o", CLOSED) for key in ("n", "escape", "q")),
        ],
    ),
]
# Of 21 s of telemetry; the oldest alarm of the fake supervisor is older.
PAST = [
    ("comma", "", {"ago_s": 1}),
    ("full_stop", "less_than_sign", {"ago_s": 9}),
    ("less_than_sign", "", {"ago_s": 10}),
    ("greater_than_sign", "less_than_sign comma", {"ago_s": 1}),
    ("left_curly_bracket", "", {"ago_s": 21}),
    ("right_curly_bracket", "less_than_sign", {"ago_s": 0}),
    ("home", "comma", {"ago_s": 21}),
    ("end", "comma", {"ago_s": 0}),
    ("left_parenthesis", "comma", {"ago_s": 12}),
    ("right_parenthesis", "home", {"ago_s": 12}),
    ("at", "", {"dialog": "Ask"}),
]
EVERYWHERE = lines(
    ConsoleApp,
    [
        ("1", "2", {"view": "operate"}),
        *((view.key, "", {"view": view.name}) for view in ALL_SCREENS[1:]),
        ("question_mark", "", {"view": "help"}),
        ("f1", "", {"view": "help"}),
        ("k", "", {"unseen": False, "loud": False}),
        ("u", "", {"loud": False}),
        ("v", "", {"dialog": "Alarms"}),
        ("e", "", {"dialog": "Reader"}),
        ("l", "", {"loop": "left"}),
        ("ctrl+p", "", {"dialog": "CommandPalette"}),
        *PAST,
        ("q", "", {"left": True}),
        ("ctrl+c", "v", {"left": True}),
        ("ctrl+q", "v", {"left": True}),
    ],
)
OPERATE = lines(
    OperateView,
    [
        ("t", "", STAR),
        ("i", "", STAR),
        ("j", "", {"hand": "jog"}),
        ("d", "", {"dialog": "Ask"}),
        ("w", "", {"window_s": 60.0}),
        ("x", "", {"stretch": "sqrt"}),
        ("c", "", {"colours": "viridis"}),
        ("up", "t", {"cursor_px": (24.0, 20.0)}),
        ("down", "t", {"cursor_px": (24.0, 19.0)}),
        ("right", "t", {"cursor_px": (24.5, 19.5)}),
        ("left", "t", {"cursor_px": (23.5, 19.5)}),
        (
            "enter",
            "t",
            {
                "hand": "",
                "cursor_px": None,
                "given": [SetTarget(loop="right", az_px=24.0, el_px=19.5)],
            },
        ),
        ("escape", "t", {"hand": "", "cursor_px": None}),
    ],
)
LISTS = [
    *lines(
        Choice,
        [
            ("down", "2", {"chosen": 1}),
            ("up", "2 down down", {"chosen": 1}),
            ("pagedown", "2 tab", {"chosen": 7}),
            ("pageup", "2 tab pagedown", {"chosen": 0}),
        ],
    ),
    *lines(Screen, [(key, "2", {"list": "readings"}) for key in ("tab", "shift+tab")]),
    *lines(
        ConsoleApp.MODES["devices"],
        [
            ("enter", "2", {"dialog": "Reader"}),
            ("n", "2 tab", {"given": [Reset(loop="right", name="fsm_edge")]}),
        ],
    ),
    *lines(ConsoleApp.MODES["loop"], [("w", "3", {"window_s": 60.0})]),
    *lines(
        ConsoleApp.MODES["help"],
        [
            ("slash", "6", {"finds": True}),
            ("escape", "6 slash", {"finds": False}),
            ("question_mark", "2 6", {"view": "devices"}),
        ],
    ),
    *lines(
        ConsoleApp.MODES["sequences"],
        [
            ("tab", "4", {"list": "parameters"}),
            ("enter", "4 tab down", {"dialog": "Ask"}),
            ("d", "4", {"started": ["sequence dry-run acquire.toml --present"]}),
            ("g", "4", {"dialog": "Confirm"}),
            ("p", "4", {"given": [SequenceControl(loop="right", action="pause")]}),
            ("z", "4", {"given": [SequenceControl(loop="right", action="end")]}),
            ("f", "4", {"dialog": "Ask"}),
        ],
    ),
    # A console of a supervisor only shows the steps: tests/tui/views/test_commissioning.py does them.
    *lines(ConsoleApp.MODES["commissioning"], [(key, "7", {}) for key in ("g", "d", "n", "z")]),
    *lines(
        ConsoleApp.MODES["logs"],
        [
            ("enter", "5", {"started": [f"log info {LOG}"]}),
            ("m", "5", {"kept": 2}),
            ("f", "5", {"started": [f"log verify {LOG}"]}),
            ("t", "5", {"started": [f"report {LOG}"]}),
            ("y", "5", {"started": [f"replay {LOG}"]}),
        ],
    ),
]
DIALOGS = [
    *lines(
        Reader, [(key, "e", CLOSED) for key in ("escape", "q", "question_mark", "e", "v", "enter")]
    ),
    *lines(
        Alarms,
        [
            *((key, "v", CLOSED) for key in ("escape", "q", "v")),
            ("enter", "v", {"dialog": "", "ago_s": 5}),
            ("down", "v", {}),
            ("up", "v", {}),
            ("k", "v", {"unseen": False, "loud": False}),
            ("u", "v", {"loud": False}),
        ],
    ),
    *lines(Running, [(key, "d enter", CLOSED) for key in ("escape", "q", "enter")]),
    *lines(Ask, [("escape", "4 f", CLOSED)]),
]
# Each part is tried on one console, from the first row to the last.
PARTS = {
    "standby": ("STANDBY", STANDBY),
    "everywhere": ("VERNIER", EVERYWHERE),
    "operate": ("VERNIER", OPERATE),
    "lists": ("VERNIER", LISTS),
    "dialogs": ("VERNIER", DIALOGS),
}


class KeyApp(FixedApp):
    """A console that keeps what it would have sent, and only notes that it was left."""

    def __init__(self, supervisor, log_folder):
        super().__init__(supervisor, log_folder=log_folder)
        self.given = []
        self.left = False
        self._wire.send = self._keep_command

    def _keep_command(self, command):
        if not isinstance(command, Status | RecentEvents):
            self.given.append(command)

    def _draw_due(self):
        """How things look is tried elsewhere, and drawing takes most of the time."""

    def exit(self, *_arguments, **_options):
        self.left = True

    def observed(self):
        """What a key may change; a screen's own things are there while it is shown."""
        view = self.view
        seen = {
            "given": [*self.given],
            "left": self.left,
            "view": view.view_name,
            "dialog": type(self.screen).__name__ if self.screen.is_modal else "",
            "loop": self.state.shown,
            "finds": bool(view.query("#filter")) and view.query_one("#filter").has_focus,
            "window_s": self.state.window.rms_s,
            "ago_s": round(self.playback.live.received_s - self.playback.position_s),
            "unseen": self.alarms.unacknowledged,
            "loud": self.alarms.loud,
            "kept": len(list(self.log_folder.glob("*.keep"))),
            "started": [
                " ".join(job.arguments).replace(f"{self.log_folder}/", "")
                for job in self.jobs
                if job.arguments[0] != "design" and job.arguments[:2] not in OF_ITS_OWN_ACCORD
            ],
        }
        if isinstance(view.focused, Choice):
            seen |= {"list": view.focused.id, "chosen": view.focused.chosen}
        if isinstance(view, OperateView):
            plane, stage = view.query_one(FocalPlane), view.pad.stage(self.state.loop)
            seen |= {
                "hand": view.hand,
                "stage": stage.name,
                "step": view.pad.step(stage),
                "cursor_px": plane.cursor_px,
                "colours": plane.colours,
                "stretch": plane.stretch,
            }
        return seen

    async def begin_anew(self, pilot):
        """As it was at the start: no dialog, no choice, Operate."""
        while self.screen.is_modal:
            await self.pop_screen()
        for choice in reversed(self.view.query(Choice)):
            choice.chosen = 0
            choice.focus()
        if not isinstance(self.view, OperateView):
            self.action_view("operate")
            await pilot.pause()
        self.view.action_leave()
        self.playback.now()
        vars(self.view.pad).update(vars(JogPad()))
        self.state.window, self.state.shown = WINDOWS[0], "right"
        for alarm in self.alarms.alarms.values():
            alarm.acknowledged = alarm.silenced = False
        self.given.clear()
        self.jobs.clear()
        self.left = False


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS)
def test_every_key_does_what_its_row_says_and_nothing_else(part, tmp_path):
    mode, rows = PARTS[part]
    supervisor = FakeSupervisor(mode, loops=("right", "left"))
    supervisor.records_lost = 3
    app = KeyApp(supervisor, make_logs(tmp_path / "logs"))

    async def changed_by(pilot, row):
        await app.begin_anew(pilot)
        await pilot.press(*row.before.split())
        app.draw_all()
        before = app.observed()
        await pilot.press(row.key)
        after = app.observed()
        shared = before.keys() & after.keys()
        return {name: after[name] for name in shared if after[name] != before[name]}

    async def main():
        wrong = []
        async with app.run_test(size=(80, 24)) as pilot:
            app.feed()
            app.state.events.appendleft(
                Event(time_s=app.fixed_s - 7, severity="warning", source="camera", message="late")
            )
            await pilot.pause()
            for row in rows:
                changed = await changed_by(pilot, row)
                if changed != row.does:
                    wrong.append((row.on.__name__, row.before, row.key, changed))
        return wrong

    assert asyncio.run(main()) == []


def keys_bound(owner):
    """Keys of a class itself, without those that it inherits."""
    return {key for row in vars(owner).get("BINDINGS", ()) for key in row.key.split(",")}


def test_every_key_has_its_row():
    tried = {(row.on, row.key) for _, rows in PARTS.values() for row in rows}
    bound = {(owner, key) for owner in BOUND for key in keys_bound(owner)}
    textual = {
        (ConsoleApp, ConsoleApp.COMMAND_PALETTE_BINDING),
        (Screen, "tab"),
        (Screen, "shift+tab"),
    }
    assert tried == bound | textual


def test_every_key_that_is_told_to_people_is_bound():
    everywhere = keys_bound(ConsoleApp) | {ConsoleApp.COMMAND_PALETTE_BINDING}
    told = {row.key for row in (*OPERATOR_COMMANDS, *ALL_SCREENS)}
    told |= {key for row in KEYS if not row.view for key in row.keys.split(",")}
    assert told <= everywhere
    for row in KEYS:
        if row.view:
            screen = ConsoleApp.MODES[row.view]
            owners = {owner for owner in BOUND if issubclass(screen, owner)} | {Choice}
            own = {key for owner in owners for key in keys_bound(owner)}
            assert set(row.keys.split(",")) <= own, row
