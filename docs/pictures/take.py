"""Take the picture of the console: the real one on the real mock instrument, half a minute after the start."""

import asyncio
import time
from pathlib import Path

from photograph import for_everybody

from fitctl import demo
from fitctl.config import default_rig_path
from fitctl.messages.client import Client
from fitctl.tui.app import ConsoleApp

SECONDS = 32.0
SIZE = (120, 40)


async def take(running: demo.Instrument, path: Path) -> None:
    """Attach a console without a terminal, wait, and save what it shows."""
    app = ConsoleApp(Client(running.sockets))
    async with app.run_test(size=SIZE) as pilot:
        end_s = time.monotonic() + SECONDS
        while time.monotonic() < end_s:
            await pilot.pause(0.2)
        path.write_text(for_everybody(app.export_screenshot()), encoding="utf-8")


def main() -> None:
    """Start the instrument, acquire, take the picture."""
    path = Path(__file__).with_name("console.svg")
    with demo.instrument(default_rig_path(), [], seed=2) as running:
        demo.acquire(running)
        asyncio.run(take(running, path))
    print(path.name)


if __name__ == "__main__":
    main()
