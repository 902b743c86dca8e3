"""A console on a link that a test feeds, in real time, and what it says."""

import asyncio
import time
from collections.abc import Awaitable, Callable

from textual.pilot import Pilot

from fitctl.tui.app import ConsoleApp
from fitctl.tui.widgets.alarmbar import AlarmBar
from fitctl.tui.widgets.header import Header
from tests.instruments.fake_supervisor import START_S, FakeSupervisor
from tests.tui.links import FakeLink

DEADLINE_S = 10.0


class Clock:
    def __init__(self) -> None:
        self.now_s = START_S

    def __call__(self) -> float:
        return self.now_s


async def until(pilot: Pilot, condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come true in time"
        await asyncio.sleep(0.01)
        await pilot.pause()


def run(
    scenario: Callable[[ConsoleApp, Pilot, FakeLink], Awaitable[None]],
    *,
    link: FakeLink | None = None,
    supervisor: FakeSupervisor | None = None,
    clock: Clock | None = None,
) -> FakeLink:
    """Run a console with two messages of telemetry already on the screen, and a scenario on it."""
    link = link or FakeLink()

    async def main() -> None:
        app = ConsoleApp(link, clock=clock or Clock())
        async with app.run_test(size=(100, 30), notifications=True) as pilot:
            link.deliver((supervisor or FakeSupervisor()).messages(2))
            await until(pilot, lambda: app.state.newest and app.state.newest.sequence == 2)
            await scenario(app, pilot, link)

    asyncio.run(main())
    return link


def header_text(app: ConsoleApp) -> str:
    app.draw_all()
    panels = (app.view.query_one(Header), app.view.query_one(AlarmBar))
    return "\n".join(
        panel.render_line(y).text for panel in panels for y in range(panel.size.height)
    )


def screen_text(app: ConsoleApp) -> str:
    """What is on the screen now, line by line."""
    strips = app.screen._compositor.render_strips()
    return "\n".join("".join(segment.text for segment in strip) for strip in strips)


def notifications(app: ConsoleApp) -> str:
    return "\n".join(f"{note.title}: {note.message}" for note in app._notifications)
