"""Take the README's moving picture: the real console, from the command `acquire` until the star is held.

    make moving-picture

The console saves what it shows several times a second, Chromium draws it, Pillow makes a GIF.
Needs Chromium.
"""

import asyncio
import re
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from photograph import for_everybody, photograph
from PIL import Image

from fitctl import demo
from fitctl.config import default_rig_path
from fitctl.messages.client import Client
from fitctl.messages.commands import Acquire, Standby
from fitctl.messages.modes import Mode
from fitctl.tui.app import ConsoleApp
from fitctl.tui.pace import Pace

SEED = 7  # the search takes some seconds
PERIOD_S = 0.25
STANDBY_S = 1.5
HELD_S = 14.0  # so that the RMS over 10 s is of VERNIER alone
LIMIT_S = 60.0  # for each of the three
PAUSE_S = 3.0
SIZE = (120, 40)
WIDTH_PX = 1000
MOST_BYTES = 3_000_000
STYLE = "body{margin:0} svg{display:block; width:100%; height:auto}"
PAGE = f"<meta charset=utf-8><style>{STYLE}</style>"
FRAMES_A_PAGE = 8  # Chromium draws no page that is very high
COLOURS = 128


async def recorded(running: demo.Instrument) -> tuple[list[str], list[float]]:
    """What a console shows as SVG, and for how many seconds each: from STANDBY until the star has been held."""
    app = ConsoleApp(Client(running.sockets))
    # A console draws less while its process is busy, here with saving what it shows.
    app.pace = Pace(processor=lambda: 0.0)
    shown: list[str] = []
    times_s: list[float] = []

    async def show(until: Callable[[], bool]) -> None:
        end_s = time.monotonic() + LIMIT_S
        while not until() and time.monotonic() < end_s:
            times_s.append(time.monotonic())
            shown.append(app.export_screenshot())
            await pilot.pause(PERIOD_S)

    async with app.run_test(size=SIZE) as pilot:
        running.client.send(Standby())
        while app.state.mode != Mode.STANDBY.name:
            await pilot.pause(PERIOD_S)
        await show(_after(STANDBY_S))
        running.client.send(Acquire())
        await show(lambda: app.state.mode == Mode.VERNIER.name)
        await show(_after(HELD_S))
    lasting_s = [later - earlier for earlier, later in pairwise(times_s)]
    return shown, [*lasting_s, PAUSE_S]


def _after(wait_s: float) -> Callable[[], bool]:
    end_s = time.monotonic() + wait_s
    return lambda: time.monotonic() > end_s


def drawn(shown: list[str], folder: Path) -> list[Image.Image]:
    """SVG drawn by Chromium, all in one size."""
    frames: list[Image.Image] = []
    for svgs in (shown[n : n + FRAMES_A_PAGE] for n in range(0, len(shown), FRAMES_A_PAGE)):
        page = folder / "page.html"
        page.write_text(PAGE + "".join(map(for_everybody, svgs)), encoding="utf-8")
        height_px = height(svgs[0])
        picture = folder / "page.png"
        photograph(page, picture, WIDTH_PX, height_px * len(svgs))
        with Image.open(picture) as whole:
            frames += [
                whole.crop((0, top, WIDTH_PX, top + height_px)).convert("RGB")
                for top in range(0, height_px * len(svgs), height_px)
            ]
    return frames


def height(svg: str) -> int:
    """Height in pixels of an SVG that is drawn as wide as the picture."""
    found = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
    if not found:
        msg = "the console's picture has no size"
        raise ValueError(msg)
    return round(float(found[2]) * WIDTH_PX / float(found[1]))


def write_moving(frames: list[Image.Image], lasting_s: list[float], path: Path) -> None:
    """Frames as one GIF, which begins again at its end."""
    # One palette for all: of frames side by side, so that no frame's colours are left out.
    some = frames[:: max(1, len(frames) // 12)]
    strip = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for number, frame in enumerate(some):
        strip.paste(frame, (0, number * frame.height))
    palette = strip.quantize(COLOURS)
    reduced = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    reduced[0].save(
        path,
        save_all=True,
        append_images=reduced[1:],
        duration=[10 * round(100 * each_s) for each_s in lasting_s],  # GIF counts in 10 ms
        loop=0,
        optimize=True,
    )


def main() -> None:
    """Record the console, draw it, and write the picture beside this script."""
    path = Path(__file__).with_name("console-moving.gif")
    with demo.instrument(default_rig_path(), [], seed=SEED) as running:
        shown, lasting_s = asyncio.run(recorded(running))
    with tempfile.TemporaryDirectory() as folder:
        write_moving(drawn(shown, Path(folder)), lasting_s, path)
    size = path.stat().st_size
    print(f"{path.name}: {len(shown)} frames, {size} bytes")
    if size > MOST_BYTES:
        raise SystemExit(f"more than {MOST_BYTES} bytes: take fewer frames")


if __name__ == "__main__":
    main()
