"""`fitctl commission` on a terminal: it asks before each step; yes, no, skip, and what the next call does."""

import json
import os
import pty
import select
import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.long
STEPS = """
import os
import sys
import time
from fitctl.cli import main
from fitctl.commissioning import tasks
from fitctl.commissioning.outcome import Cable, Outcome, StepError
from fitctl.daemon import locks
from fitctl.processes import name_held

# No other process takes these locks of devices.
locks.name_held = lambda name: name_held(f"{name} of test {os.getpid()}")

def step(name, *needs, fails=False):
    def run(site):
        print("DONE", name, flush=True)
        if fails:
            raise StepError("the cable is off")
        return Outcome(["seen"])
    return tasks.Step(f"step {name}", "star", lambda _site: f"the {name} motor", needs, 1.0, run)

tasks.STEPS = {"one": step("one"), "two": step("two", "one"), "three": step("three", "two", fails=True)}
def cable(site):
    for on in (False, True):
        site.cable(Cable("the camera's cable", "camera"), on)
    return Outcome(["it came back"])

def moving(_site):
    try:
        print("MOVING", flush=True)
        time.sleep(60)
    finally:
        time.sleep(0.5)
        print("STANDS", flush=True)

nothing = lambda _site: "nothing"
tasks.STEPS["moving"] = tasks.Step("moves", "star", nothing, (), 1.0, moving)
tasks.STEPS["cable"] = tasks.Step("cables", "star", nothing, (), 1.0, cable)
main(["commission", *sys.argv[1:]])
"""
ASKS = "Go? (yes, no, skip)"
REAL = "loops.right.siderostat.device.channel=/dev/ttyACM0"
_TIMEOUT_S = 30.0


class Terminal:
    """A person at a terminal: waits for a text, types an answer."""

    def __init__(self, folder, *arguments):
        self.ours, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-c", STEPS, *arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            cwd=folder,
            env=os.environ | {"COLUMNS": "200"},
        )
        os.close(theirs)
        self.text = ""
        self.read = 0

    def wait_for(self, text):
        end_s = time.monotonic() + _TIMEOUT_S
        while text not in self.text[self.read :]:
            assert time.monotonic() < end_s, self.text
            if not select.select([self.ours], [], [], 0.1)[0]:
                continue
            try:
                self.text += os.read(self.ours, 65536).decode()
            except OSError:  # the other side has ended
                pytest.fail(f"ended without {text!r}: {self.text}")
        self.read = self.text.index(text, self.read) + len(text)

    def answer(self, text, question=ASKS):
        self.wait_for(question)
        os.write(self.ours, f"{text}\n".encode())

    def end(self):
        while True:
            try:
                more = os.read(self.ours, 65536).decode()
            except OSError:
                break
            if not more:
                break
            self.text += more
        return self.process.wait(_TIMEOUT_S)

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.ours)


@pytest.fixture
def at_terminal(tmp_path):
    opened = []

    def run(*arguments):
        opened.append(Terminal(tmp_path, *arguments))
        return opened[-1]

    yield run
    for terminal in opened:
        terminal.close()


def tasks(folder):
    record = json.loads((folder / "fit-mock.commissioning.json").read_text())
    return {name: task["state"] for name, task in record["tasks"].items()}


def test_each_step_says_what_moves_and_asks_once_and_no_ends_it_there(at_terminal, tmp_path):
    first = at_terminal()
    first.wait_for("Moves: the one motor.")
    first.answer("yes")
    first.wait_for("DONE one")
    first.wait_for("Moves: the two motor.")
    first.answer("no")
    assert first.end() == 1
    assert "the next run continues here" in first.text
    assert first.text.count(ASKS) == 2
    assert "DONE two" not in first.text
    assert tasks(tmp_path) == {"right.one": "passed"}

    again = at_terminal()
    again.answer("y")
    again.wait_for("DONE two")
    again.answer("", ASKS)  # the answer that is offered is no
    assert again.end() == 1
    assert "DONE one" not in again.text
    assert tasks(tmp_path) == {"right.one": "passed", "right.two": "passed"}


def test_with_json_too_each_step_says_what_moves_before_it_asks(at_terminal):
    terminal = at_terminal("--json")
    terminal.wait_for("Moves: the one motor.")
    terminal.answer("no")
    assert terminal.end() == 1
    assert json.loads(terminal.text.splitlines()[-1])["verdict"].startswith("not commissioned")


def test_a_step_is_skipped_with_a_reason_and_what_needs_it_may_be_done(at_terminal, tmp_path):
    terminal = at_terminal("--until", "two")
    terminal.answer("skip")
    terminal.answer("no lamp tonight", "Reason")
    terminal.answer("yes")
    assert terminal.end() == 0
    assert tasks(tmp_path) == {"right.one": "skipped", "right.two": "passed"}
    record = json.loads((tmp_path / "fit-mock.commissioning.json").read_text())
    assert record["tasks"]["right.one"]["trouble"] == "no lamp tonight"


def test_a_failed_step_is_repeated_by_the_next_call_and_another_one_by_its_name(
    at_terminal, tmp_path
):
    first = at_terminal("--skip", "one=done by hand", "--skip", "two=done by hand")
    first.answer("yes")
    assert first.end() == 1
    assert "the cable is off" in first.text
    again = at_terminal()
    again.answer("yes")
    assert again.end() == 1
    assert "DONE three" in again.text
    by_name = at_terminal("--only", "one")
    by_name.answer("yes")
    assert by_name.end() == 0
    assert tasks(tmp_path) == {
        "right.one": "passed",
        "right.two": "skipped",
        "right.three": "failed",
    }


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_step_whose_motors_then_stand(at_terminal, tmp_path, number):
    terminal = at_terminal("--only", "moving")
    terminal.answer("yes")
    terminal.wait_for("MOVING")
    os.kill(terminal.process.pid, number)
    os.kill(terminal.process.pid, number)  # which must not keep the motors from standing
    assert terminal.end() == 130
    assert "STANDS" in terminal.text
    assert "nothing is recorded of the step that was running" in terminal.text
    assert not (tmp_path / "fit-mock.commissioning.json").exists()


def test_a_cable_is_taken_off_and_put_on_again_by_a_person(at_terminal, tmp_path):
    terminal = at_terminal("--only", "cable")
    terminal.answer("yes")
    terminal.answer("", "Disconnect the camera's cable, then press Enter")
    terminal.answer("", "Reconnect the camera's cable, then press Enter")
    assert terminal.end() == 0
    assert "it came back" in terminal.text
    assert tasks(tmp_path) == {"right.cable": "passed"}


def test_a_console_answers_through_the_standard_input(tmp_path):
    job = asking(tmp_path, "--until", "two", parent_pid=os.getpid())
    text, _ = job.communicate(b"yes\nno\n", timeout=_TIMEOUT_S)
    assert job.returncode == 1
    assert b"Moves: the one motor." in text
    assert f"{ASKS} [no]: yes\n".encode() in text
    assert b"the next run continues here" in text
    assert tasks(tmp_path) == {"right.one": "passed"}


def test_a_step_ends_with_its_console_and_real_devices_are_asked_about_there_too(tmp_path):
    job = asking(tmp_path, "--only", "moving", "--set", REAL, parent_pid=os.getpid())
    job.stdin.write(b"yes\n")
    job.stdin.flush()
    text = b""
    while b"MOVING" not in text:
        text += job.stdout.read1()
    job.terminate()  # as fitctl.processes.end_with_parent does once the console has gone
    text += job.stdout.read()
    assert job.wait(_TIMEOUT_S) == 130
    assert b"STANDS" in text


def test_without_its_console_no_step_begins(tmp_path):
    job = asking(tmp_path, parent_pid=1)  # this process is not
    job.wait(_TIMEOUT_S)
    assert b"DONE" not in job.stdout.read()
    assert not (tmp_path / "fit-mock.commissioning.json").exists()


def asking(folder, *arguments, parent_pid):
    command = [sys.executable, "-c", STEPS, "--console-pid", str(parent_pid), *arguments]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder
    )
