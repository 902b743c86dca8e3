"""The step `devices`: what a device reports of itself fails the step, but for what a later step puts right."""

import pytest
from commissioning.motor_bench import site_of

from fitctl.commissioning.asking import Finding
from fitctl.commissioning.steps import devices
from fitctl.drivers.interface import DeviceIdentity

KNOWN = DeviceIdentity("maker", "model", "1", "1.0")


@pytest.mark.parametrize(
    ("driver", "identity", "state"),
    [("c887", KNOWN, "passed"), ("c887", None, "failed"), ("gige", KNOWN, "failed")],
)
def test_only_a_hexapod_that_answers_may_still_be_unreferenced(
    monkeypatch, driver, identity, state
):
    finding = Finding("device", driver, True, identity, 1.0, ["is not referenced"])
    monkeypatch.setattr(devices, "examine_all", lambda _rig: [finding])
    outcome = devices.check_devices(site_of())
    assert outcome.state == state
    assert "device: is not referenced" in [*outcome.lines, outcome.trouble]


def test_mocks_that_are_not_started_are_one_trouble_that_names_the_command(monkeypatch):
    findings = [
        Finding(name, "gige", False, None, None, ["connection refused"])
        for name in ("camera", "right D/A")
    ]
    monkeypatch.setattr(devices, "examine_all", lambda _rig: findings)
    outcome = devices.check_devices(site_of())
    assert outcome.trouble == (
        "camera, right D/A: simulated, and the mocks are not started: run `fitctl mocks` with this rig, "
        "then the step again"
    )
