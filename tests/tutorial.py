"""docs/tutorial.md, typed as it stands: the demo on a terminal, everything else in a shell beside it."""

import contextlib
import os
import subprocess
import threading
import time

from documents import blocks, commands
from stalls import BUSY

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.client import Client
from fitctl.messages.endpoints import service_folder

PATIENCE_S = 180.0
# What a reader is told to wait for before he types on.
AWAITED = {
    ("send", "stop"): "VERNIER",
    ("send", "acquire"): "STANDBY",
    ("sequence", "check"): "VERNIER",
}


def of_tutorial(found):
    return [each for each in found if each.document.name == "tutorial.md"]


def environment_of(programs, rig):
    """What the reader's shell has: a folder of programs, and the name of the rig: other supervisors may run."""
    return os.environ | {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "FITCTL_RIG": str(rig),
        "TERM": "xterm-256color",
        "COLUMNS": "120",
        "LINES": "40",
    }


class Demo:
    """`fitctl demo` on a terminal of its own; the last of its output is kept."""

    def __init__(self, folder, environment):
        self.terminal, theirs = os.openpty()
        self.process = subprocess.Popen(
            ["fitctl", "demo"],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            cwd=folder,
            env=environment,
            start_new_session=True,
        )
        os.close(theirs)
        self.seen = b""
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        with contextlib.suppress(OSError):
            while piece := os.read(self.terminal, 65536):
                self.seen = piece

    def press(self, key):
        os.write(self.terminal, key)

    def close(self):
        self.process.terminate()
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self.terminal)


def wait_for(mode, demo):
    client = Client(service_folder(load_rig(default_rig_path())))
    try:
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            telemetry = client.receive(0.5)
            if telemetry is not None and telemetry.loops[0].mode == mode:
                return
    finally:
        client.close()
    raise AssertionError(f"no {mode} within {PATIENCE_S} s: {demo.seen!r}")


def troubles(lines):
    """What ``fitctl status`` reports as not well."""
    return {line for line in lines if line.startswith("  ! ")}


def alarms_of_a_busy_computer(found):
    """Of these troubles, the ones that the tutorial tells its reader to wait for."""
    return {
        line for line in found if line.startswith(tuple(f"  ! interlock {name}: " for name in BUSY))
    }


def walk_through(folder, programs, rig):
    """Type every command of the tutorial in an empty folder, with the `fitctl` of a folder of programs."""
    environment = environment_of(programs, rig)
    (sequence,) = of_tutorial(blocks("TOML"))
    (folder / "first.toml").write_text(sequence.text)
    typed = [each for each in of_tutorial(commands()) if each.words[0] == "fitctl"]
    assert typed.pop(0).words == ("fitctl", "demo")
    demo = Demo(folder, environment)
    try:
        wait_for("VERNIER", demo)
        for command in typed:
            arguments = command.words[1:]
            if arguments[0] == "log" and demo.process.poll() is None:
                demo.press(b"q")
                assert demo.process.wait(PATIENCE_S) == 0
            if arguments[:2] in AWAITED:
                wait_for(AWAITED[arguments[:2]], demo)
            done = subprocess.run(
                ["bash", "-c", " ".join(command.words)],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=180,
                check=False,
            )
            found = troubles(done.stdout.splitlines())
            assert done.returncode == int(bool(found)), (command, done.stdout, done.stderr)
            assert found - alarms_of_a_busy_computer(found) == troubles(command.output)
            for line in command.output:
                assert line in done.stdout
    finally:
        demo.close()
