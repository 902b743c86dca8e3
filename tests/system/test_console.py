"""The real console on a real terminal, driven by keys and read as a person reads it; and in a browser."""

import asyncio
import base64
import io
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest

from tests.system.conftest import NEAR, end, fitctl, running

pytestmark = pytest.mark.terminal
LIMIT_S = 90.0
# It is the console that is tried here: a machine that is slow for seconds must not end the acquisition.
PATIENT = (
    NEAR,
    "loops.right.siderostat.servo.reading_timeout_s=5.0",
    "loops.right.siderostat.servo.following_error_limit_rad=100.0",
    "interlocks.frame_missing.stale_s=5.0",
    "interlocks.siderostat_rate.for_s=5.0",
)


def program(*names):
    """The first of these programs that is installed."""
    for name in names:
        if path := shutil.which(name):
            return path
    return pytest.skip(
        f"{' or '.join(names)} is not installed; as root, `make test-console` does it"
    )


class Terminal:
    """A tmux session of its own, with one program in it."""

    def __init__(self, name, arguments, size=(120, 40)):
        self._tmux = ["tmux", "-L", name, "-f", os.devnull]
        program = shlex.join([sys.executable, "-m", "fitctl", *map(str, arguments)])
        columns, rows = map(str, size)
        self._run("new-session", "-d", "-s", "fitctl", "-x", columns, "-y", rows, program)

    def _run(self, *words):
        # pytest's own idea of a terminal's size is not this one's
        env = {
            name: value for name, value in os.environ.items() if name not in {"COLUMNS", "LINES"}
        }
        command = [*self._tmux, *words]
        return subprocess.run(
            command, check=True, capture_output=True, text=True, timeout=LIMIT_S, env=env
        ).stdout

    def press(self, *keys):
        self._run("send-keys", "-t", "fitctl", *keys)

    def type(self, words):
        self._run("send-keys", "-l", "-t", "fitctl", words)

    def screen(self):
        return self._run("capture-pane", "-p", "-t", "fitctl")

    def until(self, words, limit_s=LIMIT_S):
        """Wait until the screen has these words; it is returned."""
        end_s = time.monotonic() + limit_s
        while words not in (screen := self.screen()):
            assert time.monotonic() < end_s, f"no {words!r} within {limit_s} s:\n{screen}"
            time.sleep(0.2)
        return screen

    def is_open(self):
        listed = subprocess.run([*self._tmux, "list-sessions"], capture_output=True, check=False)
        return listed.returncode == 0

    def close(self):
        subprocess.run([*self._tmux, "kill-server"], capture_output=True, check=False)


@pytest.fixture
def rig(tmp_path):
    with running(tmp_path, *PATIENT) as rig:
        yield rig


@pytest.fixture
def terminal(rig):
    program("tmux")
    terminal = Terminal(f"fitctl-test-{os.getpid()}", ["console", *rig.common])
    try:
        yield terminal
    finally:
        terminal.close()


@pytest.mark.timeout(400)
def test_a_whole_acquisition_is_driven_by_keys_at_a_terminal(rig, terminal):
    assert "1 Operate" in terminal.until("○ OFF")
    terminal.press("b")
    terminal.until("◐ STANDBY")
    terminal.press("j")
    terminal.until("JOG siderostat")
    terminal.press("Right")
    terminal.press("Escape")
    terminal.until("w Window")  # Escape has arrived: with a key close behind it, it would be Alt
    terminal.press("a")
    screen = terminal.until("◆ VERNIER")
    assert "Pointing error" in screen
    terminal.until("✓", LIMIT_S)

    for key, words in (
        ("2", "interlock "),
        ("3", "Spectrum of the pointing error"),
        ("4", "On the instrument"),
        ("5", "recording"),
        ("6", "Commands, on every screen"),
        ("1", "Focal plane"),
    ):
        terminal.press(key)
        assert "s STOP" in terminal.until(words)

    terminal.press("t")
    terminal.until("look here?")
    terminal.press("Right", "Right", "Enter")
    moved = rig.follow(lambda t: t.ticks and abs(t.ticks[-1].target_az_px - 25.0) < 0.05)
    assert moved[-1].loops[0].mode == "VERNIER"

    terminal.press("s")
    terminal.until("■ SAFE")
    terminal.press("r")
    terminal.until("◐ STANDBY")
    terminal.press("o")
    terminal.until("y  yes")
    terminal.press("y")
    terminal.until("○ OFF")

    terminal.press("q")
    end_s = time.monotonic() + LIMIT_S
    while terminal.is_open():
        assert time.monotonic() < end_s
        time.sleep(0.2)
    assert rig.supervisor.poll() is None, "leaving a console must leave the instrument running"


@pytest.mark.timeout(400)
def test_several_consoles_come_and_go_and_connect_again_by_themselves(rig, terminal):
    other = Terminal(f"fitctl-other-{os.getpid()}", ["console", *rig.common], size=(80, 24))
    try:
        terminal.until("○ OFF")
        other.until("○ OFF")
        end(rig.supervisor, signal.SIGKILL)
        terminal.until("NO DATA")
        other.until("NO DATA")
        rig.supervisor.stdout.close()
        rig.client.close()
        rig.start_supervisor()
        terminal.until("● live")
        other.until("● live")
        other.press("q")
        terminal.press("b")
        terminal.until("◐ STANDBY")
    finally:
        other.close()


# ---------------------------------------------------------------- in a browser


@pytest.fixture
def page(rig):
    """The address of a console in a browser."""
    pytest.importorskip("textual_serve")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = fitctl("console", *rig.common, "--web", "--port", port, stdout=subprocess.PIPE)
    try:
        yield server.stdout.readline().split()[1]
    finally:
        end(server, timeout_s=30.0)
        server.stdout.close()


async def seen_by_chromium(address, folder, good, limit_s):
    """Pictures of the page, shape (rows, columns, 3), until one is good; it is returned."""
    import aiohttp
    import matplotlib.image

    chromium = program("chromium", "google-chrome")
    flags = ["--headless=new", "--disable-gpu", "--window-size=1280,800"]
    # Chromium refuses to run as root, as CI does, with its sandbox. The page is our own console.
    flags += ["--no-sandbox"] if os.geteuid() == 0 else []
    flags += [f"--user-data-dir={folder}", "--remote-debugging-port=0"]
    browser = subprocess.Popen(
        [chromium, *flags, address], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    try:
        line = next(line for line in browser.stderr if "DevTools listening on" in line)
        port = line.partition("127.0.0.1:")[2].partition("/")[0]
        end_s = time.monotonic() + limit_s
        async with aiohttp.ClientSession() as session:
            listed = await (await session.get(f"http://127.0.0.1:{port}/json/list")).json()
            page = next(each for each in listed if each["type"] == "page")
            async with session.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0) as wire:
                while True:
                    await wire.send_json({"id": 1, "method": "Page.captureScreenshot"})
                    while (answer := await wire.receive_json(timeout=limit_s)).get("id") != 1:
                        pass
                    png = base64.b64decode(answer["result"]["data"])
                    picture = matplotlib.image.imread(io.BytesIO(png), format="png")
                    picture = (255 * picture[:, :, :3]).round()
                    if good(picture):
                        return picture
                    assert time.monotonic() < end_s, "the STOP key does not come up in the browser"
                    await asyncio.sleep(1.0)
    finally:
        end(browser)
        browser.stderr.close()


def stop_key(picture):
    """Where a picture has the colour of the STOP key."""
    return (abs(picture - (0xFF, 0x6B, 0x4A)) < 8).all(axis=2)


@pytest.mark.timeout(400)
def test_a_browser_shows_the_same_console(page, tmp_path):
    picture = asyncio.run(
        seen_by_chromium(page, tmp_path, lambda seen: stop_key(seen).sum() > 200, 2 * LIMIT_S)
    )
    red = stop_key(picture)
    rows, columns = red.nonzero()
    assert rows.min() > 0.9 * picture.shape[0], "STOP is in the last line"
    assert columns.max() < 0.2 * picture.shape[1]
