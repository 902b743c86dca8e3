"""What the console's Sequences and Logs screens set to work, on the running instrument and for real."""

import pytest

from fitctl.messages.commands import Shutdown, Status

from .conftest import running
from .screens import LIMIT_S
from .test_console import PATIENT, terminal

__all__ = ["terminal"]  # a fixture
pytestmark = [pytest.mark.terminal, pytest.mark.timeout(900)]

SEQUENCE = """
schema_version = 1
name = "short"
description = "Acquire, hold for a moment, then wait for longer than anybody does."
steps = [
    { step = "acquire" },
    { step = "hold", duration_s = 0.5, settle_s = 0.5, rms_limit_px = 5.0, attempts = 20 },
    { step = "wait", duration_s = 600.0 },
]
"""

# A rehearsal beside it takes a processor away: the drive, too, must have patience.
MORE_PATIENT = (
    *PATIENT,
    "loops.right.siderostat.servo.reading_timeout_s=30.0",
    "loops.right.siderostat.device.response_timeout_s=10.0",
    "loops.right.fsm.dac.response_timeout_s=10.0",
    "loops.right.siderostat.device.drive_heartbeat_s=2.0",
    "loops.right.siderostat.device.master_heartbeat_timeout_s=10.0",
)


@pytest.fixture
def rig(tmp_path):
    with running(tmp_path, *MORE_PATIENT) as rig:
        yield rig


@pytest.fixture
def sequences(terminal, tmp_path):
    """The Sequences screen, with a sequence of the operator's own chosen."""
    file = tmp_path / "short.toml"
    file.write_text(SEQUENCE)
    terminal.until("○ OFF")
    terminal.press("4")
    terminal.until("acquire-wide")  # the shipped ones are listed
    terminal.press("f")
    terminal.until("a sequence file")
    terminal.type(str(file))
    terminal.press("Enter")
    terminal.until("3 wait")  # its parameters
    return terminal


def run(sequences):
    sequences.press("g")
    sequences.until("y  yes")
    sequences.press("y")
    sequences.until("▶ short running", limit_s=2 * LIMIT_S)


def test_a_sequence_is_run_steered_edited_and_rehearsed_and_its_log_reported_and_replayed(
    sequences, rig
):
    run(sequences)
    sequences.until("step 3/3", limit_s=2 * LIMIT_S)
    sequences.press("p")
    sequences.until("⏸ short paused")
    sequences.press("p")
    sequences.until("▶ short running")
    sequences.press("z")
    assert "stopped by the operator" in sequences.until("  status 1")
    sequences.until("◐ STANDBY")

    sequences.press("Tab", "PageDown", "PageDown")  # to the last parameter, how long is waited
    sequences.press("Enter")
    sequences.until("duration_s (is 600.0)")
    sequences.type("1.0")
    sequences.press("Enter")
    sequences.until("well; 3 steps")
    sequences.press("d")
    rehearsed = sequences.until("s of virtual time", limit_s=2 * LIMIT_S)
    assert "px RMS; required 5 px" in rehearsed
    assert rig.client.send(Status()).text == "right STANDBY", "a rehearsal moves nothing"

    run(sequences)
    assert "3  wait           1  done" in sequences.until("  done", limit_s=2 * LIMIT_S)

    logs = sequences
    logs.press("5")
    logs.until("recording")
    logs.press("m")
    logs.until("mcap kept")
    rig.client.send(Shutdown())
    assert rig.supervisor.wait(LIMIT_S) == 0
    logs.until("the supervisor shut down")
    logs.press("t")
    logs.until("report.html", limit_s=2 * LIMIT_S)
    logs.press("y")
    logs.until("replayed at", limit_s=2 * LIMIT_S)
