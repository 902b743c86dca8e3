"""The whole screen as it looks, at the sizes that people use. ``pytest --snapshot-update`` accepts a change."""

import asyncio

import pytest
from pytest_textual_snapshot import SVGImageExtension
from textual.pilot import Pilot

from fitctl.tui.commands import VIEWS
from tests.fake_supervisor import MODE_NUMBERS, FakeSupervisor
from tests.tui.fixed import FixedApp, make_logs, settle

SIZES = [(80, 24), (120, 40), (200, 60)]


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """A folder of logs that has the same name in every run."""
    make_logs(tmp_path / "logs")
    monkeypatch.chdir(tmp_path)


def looking(*keys: str):
    async def run_before(pilot: Pilot) -> None:
        app = pilot.app
        assert isinstance(app, FixedApp)
        app.feed()
        await pilot.press(*keys)
        await settle(app, pilot)

    return run_before


@pytest.mark.usefixtures("logs")
@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("mode", MODE_NUMBERS)
def test_every_screen_in_every_mode(snapshot, mode, size):
    picture = snapshot.use_extension(SVGImageExtension)

    async def look() -> list[str]:
        app = FixedApp(FakeSupervisor(mode))
        changed = []
        async with app.run_test(size=size) as pilot:
            app.feed()
            for view in VIEWS:
                await pilot.press(view.key)
                await settle(app, pilot)
                if app.export_screenshot() != picture(name=view.name):
                    changed.append(view.name)
        return changed

    assert asyncio.run(look()) == []


@pytest.mark.parametrize(
    "keys", ["e", "v", "o", "t", "j"], ids=["events", "alarms", "off", "target", "jog"]
)
def test_dialog(snap_compare, keys):
    app = FixedApp(FakeSupervisor("VERNIER" if keys in "tje" else "STANDBY"))
    assert snap_compare(app, terminal_size=(80, 24), run_before=looking(*keys))


def safe_with_a_fault() -> FakeSupervisor:
    supervisor = FakeSupervisor("SAFE")
    told = "siderostat right at socket://127.0.0.1:29536: expected no fault, got axis 2: following error"
    supervisor.trigger, supervisor.reason = "FAULT", f"{told}; remove its cause, then recover"
    supervisor.faulty = {"right siderostat": supervisor.reason}
    supervisor.records_lost = 1234
    return supervisor


@pytest.mark.parametrize("size", SIZES[:2])
def test_safe_with_a_fault_and_lost_records(snap_compare, size):
    app = FixedApp(safe_with_a_fault())
    assert snap_compare(app, terminal_size=size, run_before=looking())


def test_alarms_of_a_fault(snap_compare):
    app = FixedApp(safe_with_a_fault())
    assert snap_compare(app, terminal_size=(80, 24), run_before=looking("v"))


def test_stale(snap_compare):
    app = FixedApp(FakeSupervisor(), silent_s=7.2)
    assert snap_compare(app, terminal_size=(80, 24), run_before=looking())


def test_without_colour(snap_compare, monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    app = FixedApp(FakeSupervisor())
    assert snap_compare(app, terminal_size=(80, 24), run_before=looking())


def test_two_loops_on_a_wide_and_low_terminal(snap_compare):
    app = FixedApp(FakeSupervisor(loops=("right", "left")))
    assert snap_compare(app, terminal_size=(120, 24), run_before=looking("l"))
