"""A sequence on the whole instrument, in real time, steered from another shell."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from fitctl.config import default_rig_path
from fitctl.logging.reading import log_info, read_records
from fitctl.messages.commands import SequenceControl

from .conftest import end, fitctl, running
from .test_console import PATIENT

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


@pytest.fixture
def rig(tmp_path):
    """It is the sequence that is tried here, not how soon the instrument takes a slow machine for a fault."""
    with running(tmp_path, *PATIENT) as rig:
        yield rig


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
    assert sequence(rig, "end").wait(timeout=30) == 0
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


STARS = """
schema_version = 1
name = "three-stars"
description = "Two of them are there; the second is half as bright as the first."

[[steps]]
step = "stars"
duration_s = 2.0
settle_s = 1.0
rms_limit_px = 5.0
search_radius_sky_arcsec = 60.0
stars = [
    { name = "alpha", az_sky_arcsec = 0.0, el_sky_arcsec = 0.0 },
    { name = "nobody", az_sky_arcsec = -700.0, el_sky_arcsec = -600.0 },
    { name = "gamma", az_sky_arcsec = -450.0, el_sky_arcsec = 500.0, star_flux_dn = 14000.0 },
]
"""


@pytest.mark.slow
def test_a_list_of_stars_runs_to_its_end_and_every_attempt_is_in_the_log(tmp_path):
    file = tmp_path / "three-stars.toml"
    file.write_text(STARS)
    field = default_rig_path().with_name("star-field.toml")
    with running(tmp_path, *PATIENT[1:], file=field) as rig:
        told, errors = sequence(rig, "run", file, "--json").communicate(timeout=240)
        log = Path(rig.follow(lambda telemetry: telemetry.recorder is not None)[-1].recorder.path)

    attempts = json.loads(told)["attempts"]
    held = [each for each in attempts if each["step"] == "hold" and each["outcome"] == "done"]
    assert [each["star"] for each in held] == ["alpha", "gamma"], errors
    assert "2 of 3 stars held; skipped nobody" in attempts[-1]["message"]
    found = {each["star"]: each["figures"] for each in attempts if each["step"] == "acquire"}
    assert found["gamma"]["found_flux_dn"] == pytest.approx(14000.0, rel=0.2)

    recorded = [entry.message for entry in read_records(log, ["/fit/sequence/attempts"])]
    assert [(each.step, each.star, each.outcome, each.message) for each in recorded] == [
        (each["step"], each["star"], each["outcome"], each["message"]) for each in attempts
    ]
    assert log_info(log).finished
    report = fitctl("report", log, "--out", tmp_path / "report", stdout=subprocess.PIPE)
    assert report.wait(timeout=120) == 0
    report.stdout.close()
    page = next((tmp_path / "report").glob("*.html")).read_text()
    assert "2 of 3 stars held; skipped nobody" in page
