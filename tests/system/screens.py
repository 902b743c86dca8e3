"""Consoles as people have them, driven by real keys: in a terminal (tmux) and in a browser (Chromium)."""

import asyncio
import base64
import io
import os
import shlex
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console
from rich.terminal_theme import TerminalTheme
from rich.text import Text

from fitctl.tui.inks import INK, PAPER

from .conftest import end, fitctl, free_port

LIMIT_S = 90.0
# tmux forgets the ground of cells that are blank up to the end of a line.
THEME = TerminalTheme(*(bytes.fromhex(colour[1:]) for colour in (PAPER, INK)), [(0, 0, 0)] * 8)
SIZE = (120, 40)


def program(*names):
    """The first of these programs that is installed."""
    for name in names:
        if path := shutil.which(name):
            return path
    return pytest.skip(
        f"{' or '.join(names)} is not installed; as root, `make test-console` does it"
    )


class Screen:
    """Something that shows text and takes keys."""

    def screen(self):
        """What it shows, as text."""
        raise NotImplementedError

    def until(self, *words, limit_s=LIMIT_S):
        """Wait until the screen has all of these words; it is returned."""
        return self.until_true(
            lambda screen: all(word in screen for word in words), f"not all of {words}", limit_s
        )

    def until_gone(self, words, limit_s=LIMIT_S):
        """Wait until the screen has these words no more; it is returned."""
        return self.until_true(lambda screen: words not in screen, f"still {words!r}", limit_s)

    def until_true(self, reached, otherwise, limit_s=LIMIT_S):
        end_s = time.monotonic() + limit_s
        while not reached(screen := self.screen()):
            assert time.monotonic() < end_s, f"{otherwise} after {limit_s} s:\n{screen}"
            time.sleep(0.2)
        return screen


class Terminal(Screen):
    """A tmux session of its own, with one program in it."""

    def __init__(self, name, arguments, size=SIZE):
        self._tmux = [program("tmux"), "-L", name, "-f", os.devnull]
        self._size = size
        command = shlex.join([sys.executable, "-m", "fitctl", *map(str, arguments)])
        columns, rows = map(str, size)
        self._run("new-session", "-d", "-s", "fitctl", "-x", columns, "-y", rows, command)

    def _run(self, *words):
        # pytest's own idea of a terminal's size is not this one's
        env = {
            name: value for name, value in os.environ.items() if name not in {"COLUMNS", "LINES"}
        }
        command = [*self._tmux, *words]
        return subprocess.run(
            command,
            check=True,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            env=env | {"COLORTERM": "truecolor"},
        ).stdout

    def press(self, *keys):
        """Press keys, as tmux names them."""
        self._run("send-keys", "-t", "fitctl", *keys)

    def type(self, words):
        self._run("send-keys", "-l", "-t", "fitctl", words)

    def screen(self):
        return self._run("capture-pane", "-p", "-t", "fitctl")

    def resize(self, size):
        """Give the terminal another size."""
        self._size = size
        columns, rows = map(str, size)
        self._run("resize-window", "-t", "fitctl", "-x", columns, "-y", rows)

    def save(self, path):
        """Write what it shows, with its colours, as SVG; the file."""
        columns, rows = self._size
        console = Console(
            width=columns, height=rows, file=io.StringIO(), record=True,
            force_terminal=True, color_system="truecolor", legacy_windows=False,
        )  # fmt: skip
        shown = self._run("capture-pane", "-e", "-N", "-p", "-t", "fitctl")
        for line in shown.splitlines():
            console.print(Text.from_ansi(line), no_wrap=True, overflow="crop")
        path = Path(path).with_suffix(".svg")
        path.write_text(console.export_svg(title="fitctl", unique_id=path.stem, theme=THEME))
        return path

    def is_open(self):
        listed = subprocess.run([*self._tmux, "list-sessions"], capture_output=True, check=False)
        return listed.returncode == 0

    def close(self):
        subprocess.run([*self._tmux, "kill-server"], capture_output=True, check=False)


# The page keeps its terminal to itself; its text is nowhere in the document.
FIND_TERMINAL = """
Object.defineProperty(Object.prototype, "fitAddon", {set(addon) {
    window.page = this;
    Object.defineProperty(this, "fitAddon", {value: addon, writable: true});
}});
"""
READ_TERMINAL = """
(() => {
    const buffer = window.page?.terminal?.buffer?.active;
    const rows = buffer ? [...Array(window.page.terminal.rows).keys()] : [];
    return rows.map(row => buffer.getLine(row)?.translateToString() ?? "").join("\\n");
})()
"""
NAMED_KEYS = {"Escape": 27, "Enter": 13, "End": 35, "Up": 38, "Down": 40}


@contextmanager
def terminal_of(rig, size=SIZE):
    """A console of a rig in a terminal of its own."""
    terminal = Terminal(
        f"fitctl-{os.getpid()}-{time.monotonic_ns()}", ["console", *rig.common], size
    )
    try:
        yield terminal
    finally:
        terminal.close()


@contextmanager
def browser_of(rig, folder):
    """A console of a rig in a browser, which keeps what it keeps in a folder."""
    pytest.importorskip("textual_serve")
    port = free_port()
    server = fitctl("console", *rig.common, "--web", "--port", port, stdout=subprocess.PIPE)
    try:
        browser = Browser(server.stdout.readline().split()[1], folder)
        try:
            yield browser
        finally:
            browser.close()
    finally:
        end(server, timeout_s=30.0)
        server.stdout.close()


class Browser(Screen):
    """A page in a Chromium without a window."""

    def __init__(self, address, folder, size=(1280, 800)):
        import aiohttp

        flags = ["--headless=new", "--disable-gpu", f"--window-size={size[0]},{size[1]}"]
        # Chromium refuses to run as root, as CI does, with its sandbox. The page is our own console.
        flags += ["--no-sandbox"] if os.geteuid() == 0 else []
        flags += [f"--user-data-dir={folder}", "--remote-debugging-port=0"]
        self._process = subprocess.Popen(
            [program("chromium", "google-chrome"), *flags, "about:blank"],
            stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        self._runner = asyncio.Runner()
        self._asked = 0
        try:
            line = next(line for line in self._process.stderr if "DevTools listening on" in line)
            port = line.partition("127.0.0.1:")[2].partition("/")[0]
            self._session, self._wire = self._runner.run(self._connect(aiohttp, port))
            self._ask("Page.enable")
            self._ask("Page.addScriptToEvaluateOnNewDocument", source=FIND_TERMINAL)
            self._ask("Page.navigate", url=address)
        except BaseException:
            self.close()
            raise

    async def _connect(self, aiohttp, port):
        session = aiohttp.ClientSession()
        listed = await (await session.get(f"http://127.0.0.1:{port}/json/list")).json()
        page = next(each for each in listed if each["type"] == "page")
        return session, await session.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0)

    def _ask(self, method, **values):
        return self._runner.run(self._answer(method, values))

    async def _answer(self, method, values):
        self._asked += 1
        await self._wire.send_json({"id": self._asked, "method": method, "params": values})
        while (answer := await self._wire.receive_json(timeout=LIMIT_S)).get("id") != self._asked:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    def press(self, *keys):
        """Press keys: characters, or as tmux names them."""
        for name in keys:
            key = " " if name == "Space" else name
            event = {"key": key}
            if key in NAMED_KEYS:
                event["windowsVirtualKeyCode"] = NAMED_KEYS[key]
            else:
                event["text"] = key
            self._ask("Input.dispatchKeyEvent", type="keyDown", **event)
            event.pop("text", None)
            self._ask("Input.dispatchKeyEvent", type="keyUp", **event)

    def screen(self):
        return self._ask("Runtime.evaluate", expression=READ_TERMINAL)["result"].get("value", "")

    def picture(self):
        """The page as a PNG."""
        return base64.b64decode(self._ask("Page.captureScreenshot")["data"])

    def save(self, path):
        """Write the page as PNG; the file."""
        path = Path(path).with_suffix(".png")
        path.write_bytes(self.picture())
        return path

    def close(self):
        with self._runner as runner:
            if session := getattr(self, "_session", None):
                runner.run(session.close())
        end(self._process)
        self._process.stderr.close()
