"""Scenarios on a console whose telemetry is recorded and whose clock stands still."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

from textual.events import Key
from textual.pilot import Pilot

from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.fixed import FixedApp, settle

Scenario = Callable[[FixedApp, Pilot], Awaitable[None]]


def run(
    scenario: Scenario,
    mode: str = "VERNIER",
    *,
    supervisor: FakeSupervisor | None = None,
    size: tuple[int, int] = (120, 40),
    log_folder: Path = Path("logs"),
) -> FixedApp:
    """A console that has heard 21 s of telemetry, and a scenario on it."""
    app = FixedApp(supervisor or FakeSupervisor(mode), log_folder=log_folder)
    run_app(app, lambda pilot: scenario(app, pilot), size=size)
    return app


def run_app(
    app: FixedApp, scenario: Callable[[Pilot], Awaitable[None]], size: tuple[int, int] = (120, 40)
) -> None:
    """A scenario on a console that has just been made."""

    async def main() -> None:
        async with app.run_test(size=size, notifications=True) as pilot:
            app.feed()
            await pilot.pause()
            await scenario(pilot)

    asyncio.run(main())


def sent(app: FixedApp):
    """What went out, once all threads that send are done."""
    return app._wire._link.sent


async def pressed(app: FixedApp, pilot: Pilot, *keys: str) -> None:
    await pilot.press(*keys)
    await settle(app, pilot)


async def typed_at_once(app: FixedApp, pilot: Pilot, *keys: str) -> None:
    """Keys that a busy console finds all together in its terminal."""
    for key in keys:
        app.post_message(Key(key, None))
    await settle(app, pilot)
