"""The whole screen as it looks, at the sizes that people use. ``pytest --snapshot-update`` accepts a change."""

import asyncio

import pytest
from textual.pilot import Pilot

from fitctl.tui.app import ConsoleApp
from tests.tui.fake import START_S, FakeLink, FakeSupervisor

MESSAGES = 420


class FixedApp(ConsoleApp):
    """A console on recorded telemetry whose clock stands still after the last message."""

    def __init__(self, supervisor: FakeSupervisor, silent_s: float = 0.02) -> None:
        self.recorded = supervisor.messages(MESSAGES)
        self.fixed_s = START_S
        super().__init__(FakeLink(), clock=lambda: self.fixed_s)
        self.silent_s = silent_s

    def feed(self) -> None:
        """All telemetry, each message at its own time."""
        for message in self.recorded:
            self.fixed_s = message.time_s
            self.state.accept(message, message.time_s)
        self.fixed_s += self.silent_s
        self.draw_all()


def looking(*keys: str):
    async def run_before(pilot: Pilot) -> None:
        app = pilot.app
        assert isinstance(app, FixedApp)
        app.feed()
        await pilot.press(*keys)
        await pilot.pause()
        await asyncio.sleep(0.3)  # every timed redraw has happened; the clock stands still
        await pilot.pause()

    return run_before


@pytest.mark.parametrize("size", [(80, 24), (120, 40), (200, 60)])
def test_vernier(snap_compare, size):
    assert snap_compare(FixedApp(FakeSupervisor()), terminal_size=size, run_before=looking())


def test_acquisition(snap_compare):
    app = FixedApp(FakeSupervisor("ACQUISITION"))
    assert snap_compare(app, terminal_size=(80, 24), run_before=looking())


def test_safe_with_a_fault_and_lost_records(snap_compare):
    supervisor = FakeSupervisor("SAFE")
    supervisor.faulty = {
        "right siderostat": "axis 2: following error; clear the cause, then Recover"
    }
    supervisor.records_lost = 1234
    assert snap_compare(FixedApp(supervisor), terminal_size=(120, 40), run_before=looking())


def test_stale(snap_compare):
    app = FixedApp(FakeSupervisor(), silent_s=7.2)
    assert snap_compare(app, terminal_size=(80, 24), run_before=looking())


def test_help(snap_compare):
    app = FixedApp(FakeSupervisor())
    assert snap_compare(app, terminal_size=(80, 24), run_before=looking("question_mark"))


def test_two_loops_on_a_wide_and_low_terminal(snap_compare):
    app = FixedApp(FakeSupervisor(loops=("right", "left")))
    assert snap_compare(app, terminal_size=(120, 24), run_before=looking("l"))
