"""A bad night at the console, by keys alone; everything that goes wrong is done to running processes.

The pictures of docs/console.md, on the whole testbed in tmux, and the one in a browser (in ``tests/``):

python -m system.bad_night ../docs/pictures
unshare -u sh -c "hostname observatory; python -m system.bad_night ../docs/pictures --browser"
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from fitctl.config import default_rig_path
from fitctl.messages.commands import Recover

from .conftest import fitctl, running
from .screens import LIMIT_S, SIZE, browser_of, terminal_of

SILENT_S = 7.0
OF_THE_DOCS = {"testbed", "star-lost", "fault", "past", "stale", "stopped"}
# It is the console that is tried here: a machine that is slow for seconds must not end the acquisition.
PATIENT_LOOP = (
    "siderostat.servo.reading_timeout_s=5.0",
    "siderostat.servo.following_error_limit_rad=100.0",
    "siderostat.device.response_timeout_s=10.0",
)
PATIENT = (
    "interlocks.frame_missing.stale_s=5.0",
    "interlocks.siderostat_rate.for_s=5.0",
    "interlocks.servo_overrun.for_s=60.0",
)
HOLDING = {"stellar": "VERNIER", "metrology": "LOCKED"}


class Night:
    """An operator's hands and eyes, and those who make the trouble.

    `keep` is called with the name of each moment that is worth a picture.
    """

    def __init__(self, rig, screen, keep=lambda name: None):
        self.rig = rig
        self.screen = screen
        self.keep = keep

    def fault(self, *words):
        """``fitctl fault WORDS`` on the running mocks."""
        process = fitctl("fault", *words, *self.rig.common, stdout=subprocess.DEVNULL)
        assert process.wait(30.0) == 0

    def loops(self):
        """The loops, from the next message."""
        return self._follow(lambda loops: True)

    def reach(self, mode, *names):
        """Wait until some loops are in a mode."""
        self._follow(lambda loops: all(loop.mode == mode for loop in loops if loop.name in names))

    def _follow(self, reached):
        while self.rig.receive(0.0) is not None:
            pass  # what came meanwhile is of the past
        return self.rig.follow(lambda telemetry: reached(telemetry.loops), LIMIT_S)[-1].loops


def power_up_and_acquire(night):
    """Every loop from OFF to where it holds, the chosen loop first."""
    screen, loops = night.screen, night.loops()
    screen.until("OFF")
    for key, mode in (("b", "STANDBY"), ("a", None)):
        for loop in loops:
            screen.press(key)
            night.reach(mode or HOLDING[loop.kind], loop.name)
            if len(loops) > 1:
                screen.press("l")
    screen.until("◆ VERNIER")
    if len(loops) > 1:
        time.sleep(20.0)  # of all that is on the screen, nothing is from before
    night.keep("testbed")


def lose_the_star(night):
    """A cloud over the right star; it goes, and the loop finds the star by itself."""
    screen = night.screen
    night.fault("set", "camera", "dark_half", "--part", "right")
    shown = screen.until("star lost", "searches again", "check shutter and clouds")
    assert "s STOP" in shown
    screen.press("u")
    time.sleep(3.0)
    night.keep("star-lost")
    night.fault("clear", "camera")
    night.reach("VERNIER", "right")
    screen.until_gone("star lost")


def fail_the_drive(night):
    """A drive's fault: read, acknowledged, looked at from five seconds before it, and recovered from."""
    screen = night.screen
    night.fault("set", "right.drive", "following_error", "--part", "az", "--for", "1")
    screen.until("✗ SAFE", "following error", "▸ remove", "then recover", "k Acknowledge")
    time.sleep(2.0)
    night.keep("fault")
    screen.press("2")
    screen.until("interlock ")
    night.keep("fault-devices")
    screen.press("1")

    screen.press("v")
    screen.until("not acknowledged", "to do")
    night.keep("fault-alarms")
    screen.press("Enter")
    screen.until("◀◀ PAST", " ago", "NOW ✗")
    night.keep("past")
    screen.press("r")
    screen.until("Recover is not sent")
    screen.press("End")
    screen.until_gone("PAST")

    screen.press("k")
    screen.until_gone("k Acknowledge")
    night.keep("acknowledged")
    screen.press("r")
    night.reach("STANDBY", "right")
    screen.until_gone("▸ remove")  # the alarm; its words stay among the events
    screen.press("a")
    night.reach("VERNIER", "right")
    screen.until("◆ VERNIER")


def kill_the_recorder(night):
    """The recorder dies and is started again."""
    recorder = night.rig.recorder()
    recorder.kill()
    night.screen.until("the recorder was killed by signal 9")
    night.keep("recorder")
    assert night.rig.recorder().pid != recorder.pid


def lose_the_link(night):
    """The supervisor says nothing for some seconds; STOP is not confirmed, and comes late."""
    screen, supervisor = night.screen, night.rig.supervisor
    supervisor.send_signal(signal.SIGSTOP)
    try:
        screen.until("✗ link lost", "NO DATA for", "STOP may not reach it", " ago")
        time.sleep(SILENT_S - 2.0)
        night.keep("stale")
    finally:
        supervisor.send_signal(signal.SIGCONT)
    screen.until("● live")
    # The drives and the camera missed the supervisor, too: a STOP leaves this fault as the reason.
    loops = tuple(loop.name for loop in night.loops())
    night.reach("SAFE", *loops)
    screen.until("✗ SAFE")
    screen.press("Space")
    screen.until("STOP confirmed")
    screen.until("✗ SAFE")
    assert night.rig.client.send(Recover()).accepted
    night.reach("STANDBY", *loops)


def stop(night):
    """STOP for all loops, by the space bar."""
    screen = night.screen
    time.sleep(3.0)  # the devices that are shown are those after recover
    screen.press("Space")
    screen.until("■ SAFE")
    night.reach("SAFE", *(loop.name for loop in night.loops()))
    time.sleep(1.5)
    night.keep("stopped")


WHOLE = (
    power_up_and_acquire,
    lose_the_star,
    fail_the_drive,
    kill_the_recorder,
    lose_the_link,
    stop,
)


@contextmanager
def testbed(folder):
    """The whole testbed, as patient as this machine needs it."""
    loops = ("right", "metrology", "left")
    patient = [f"loops.{loop}.{setting}" for loop in loops for setting in PATIENT_LOOP]
    rig_file = default_rig_path().with_name("fit-testbed.toml")
    with running(folder, *patient, *PATIENT, file=rig_file) as rig:
        yield rig


def main():
    """A whole night on the testbed, with pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", default="x".join(map(str, SIZE)), help="of the terminal")
    parser.add_argument("--browser", action="store_true", help="in Chromium instead of tmux")
    parser.add_argument(
        "--all", action="store_true", help="pictures of all moments that are looked at"
    )
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "pictures"))
    from photograph import for_everybody

    size = tuple(map(int, options.size.split("x")))
    with tempfile.TemporaryDirectory() as work, testbed(Path(work) / "logs") as rig:
        console = browser_of(rig, work) if options.browser else terminal_of(rig, size)
        prefix, wanted = ("browser-", {"fault"}) if options.browser else ("", OF_THE_DOCS)
        with console as screen:

            def keep(name):
                if options.all or name in wanted:
                    path = screen.save(options.folder / f"console-{prefix}{name}")
                    if path.suffix == ".svg":
                        path.write_text(for_everybody(path.read_text()))
                print(f"{name}\n{screen.screen()}", flush=True)

            night = Night(rig, screen, keep)
            for chapter in WHOLE:
                print(f"# {chapter.__name__}", flush=True)
                chapter(night)


if __name__ == "__main__":
    main()
