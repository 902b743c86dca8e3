"""A sequence on the whole instrument, in real time, steered from another shell."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from fitctl.logging.reading import read_records
from fitctl.supervisor.messages import SequenceControl

from .conftest import end, fitctl

pytestmark = pytest.mark.timeout(300)

SEQUENCE = """
schema_version = 1
name = "held"
description = "Acquire, then hold for longer than anybody waits."
steps = [
    { step = "acquire" },
    { step = "hold", duration_s = 1.0, settle_s = 1.0, rms_limit_px = 5.0 },
    { step = "hold", duration_s = 600.0 },
]
"""

WAITING = """
schema_version = 1
name = "waiting"
description = "Nothing, for longer than anybody waits."
steps = [{ step = "wait", duration_s = 600.0 }]
"""


def sequence(rig, *arguments):
    return fitctl(
        "sequence", *arguments, *rig.common, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def reaches(rig, state, step_number):
    def reached(telemetry):
        told = telemetry.running_sequence
        return told is not None and (told.state, told.step_number) == (state, step_number)

    return rig.follow(reached)[-1]


def test_a_sequence_is_paused_resumed_and_ended_from_its_own_shell_and_others(rig, tmp_path):
    file = tmp_path / "held.toml"
    file.write_text(SEQUENCE)
    first = sequence(rig, "run", file, "--json")
    reaches(rig, "running", 3)

    assert rig.client.send(SequenceControl(action="pause")).accepted
    reaches(rig, "paused", 3)
    second = sequence(rig, "run", file)
    _, refused = second.communicate(timeout=30)
    assert second.returncode == 1
    assert "held is under way (step 3 of 3)" in refused
    assert rig.client.send(SequenceControl(action="resume")).accepted
    reaches(rig, "running", 3)

    assert end(first, signal.SIGINT) == 130
    attempts = json.loads(first.communicate()[0])["attempts"]
    assert [each["outcome"] for each in attempts[:2]] == ["done", "done"]
    assert attempts[1]["figures"]["rms_az_px"] < 5.0
    rig.follow_to("STANDBY")  # the stages are held

    file.write_text(WAITING)
    waiting = sequence(rig, "run", file)
    reaches(rig, "running", 1)
    assert sequence(rig, "stop").wait(timeout=30) == 0
    _, err = waiting.communicate(timeout=30)
    assert waiting.returncode == 1
    assert "stopped by the operator" in err

    log = Path(rig.follow(lambda telemetry: telemetry.recorder is not None)[-1].recorder.path)
    rig.close()
    recorded = [found.message for found in read_records(log, ["/fit/sequence/attempts"])]
    assert [(attempt.sequence_name, attempt.outcome) for attempt in recorded] == [
        *(("held", each["outcome"]) for each in attempts),
        ("waiting", "stopped"),
    ]
