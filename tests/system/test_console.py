"""The real console on a real terminal, driven by keys and read as a person reads it; and in a browser."""

import io
import signal
import time

import matplotlib.image
import pytest

from fitctl.messages.commands import Status

from .bad_night import WHOLE, Night
from .conftest import NEAR, end, running
from .screens import LIMIT_S, browser_of, terminal_of

pytestmark = pytest.mark.terminal
# It is the console that is tried here: a machine that is slow for seconds must not end the acquisition.
PATIENT = (
    NEAR,
    "loops.right.siderostat.servo.reading_timeout_s=5.0",
    "loops.right.siderostat.servo.following_error_limit_rad=100.0",
    "interlocks.frame_missing.stale_s=5.0",
    "interlocks.siderostat_rate.for_s=5.0",
)


@pytest.fixture
def rig(tmp_path):
    with running(tmp_path, *PATIENT) as rig:
        yield rig


@pytest.fixture
def terminal(rig):
    with terminal_of(rig) as terminal:
        yield terminal


@pytest.mark.timeout(400)
def test_a_whole_acquisition_is_driven_by_keys_at_a_terminal(rig, terminal):
    assert "1 Operate" in terminal.until("○ OFF")
    terminal.press("b")
    terminal.until("◐ STANDBY")
    terminal.press("j")
    terminal.until("JOG siderostat", "esc Leave")  # the keys below are drawn last
    terminal.press("Right")
    terminal.press("Escape")
    terminal.until("w Window")  # Escape has arrived: with a key close behind it, it would be Alt
    terminal.press("a")
    screen = terminal.until("◆ VERNIER")
    assert "Pointing error" in screen
    terminal.until("✓")

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
def test_a_bad_night_is_gone_through_by_keys(rig, terminal):
    night = Night(rig, terminal)
    for chapter in WHOLE:
        chapter(night)


@pytest.mark.timeout(400)
def test_several_consoles_come_and_go_and_connect_again_by_themselves(rig, terminal):
    with terminal_of(rig, size=(80, 24)) as other:
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


# ---------------------------------------------------------------- in a browser


def stop_key(png):
    """Where a picture has the colour of the STOP key, shape (rows, columns)."""
    picture = 255 * matplotlib.image.imread(io.BytesIO(png), format="png")[:, :, :3]
    return (abs(picture.round() - (0xFF, 0x6B, 0x4A)) < 8).all(axis=2)


@pytest.mark.timeout(400)
def test_a_browser_shows_the_same_console_and_takes_the_same_keys(rig, tmp_path):
    with browser_of(rig, tmp_path) as browser:
        browser.until("○ OFF", "1 Operate")
        end_s = time.monotonic() + LIMIT_S
        while (red := stop_key(browser.picture())).sum() <= 200:
            assert time.monotonic() < end_s, "the STOP key does not come up in the browser"
            time.sleep(1.0)
        rows, columns = red.nonzero()
        high, wide = red.shape
        assert columns[rows > 0.9 * high].max() < 0.2 * wide, "at the left of the last line"
        assert columns[rows < 0.1 * high].min() > 0.8 * wide, "at the top right"

        browser.press("b")
        browser.until("◐ STANDBY")
        browser.press("Space")
        browser.until("■ SAFE", "stopped by")
        assert rig.client.send(Status()).text == "right SAFE"
