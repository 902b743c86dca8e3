"""The step `cables`: whatever ends it, a cable that is off is put on again."""

from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import pytest
from commissioning.motor_bench import site_of

from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.steps import acceptance
from fitctl.commissioning.steps.acceptance import cables_of, check_cables


@pytest.fixture
def cables(monkeypatch):
    """Runs the step with a loop whose wait for SAFE is as given: gives what was done, in its order."""
    monkeypatch.setattr(acceptance, "SETTLED_S", 0.0)
    monkeypatch.setattr(acceptance, "_PAUSE_S", 0.0)

    def run(wait_for):
        done = []

        @contextmanager
        def supervised(_site):
            client = SimpleNamespace(send=lambda _command: None)
            try:
                yield SimpleNamespace(
                    acquire=lambda: None,
                    wait_for=wait_for,
                    client=client,
                    command=lambda _command: None,
                )
            finally:
                done.append("ended")

        monkeypatch.setattr(acceptance, "supervised", supervised)
        site = replace(site_of(), cable=lambda cable, on: done.append((cable.mock, on)))
        try:
            check_cables(site)
        except (KeyboardInterrupt, StepError) as error:
            return done, error
        return done, None

    return run


def test_each_cable_is_disconnected_and_connected_again(cables):
    done, error = cables(lambda _mode, _timeout_s: 0.1)
    assert error is None
    each = [(cable.mock, on) for cable in cables_of(site_of()) for on in (False, True)]
    assert done == [*each, "ended"]


@pytest.mark.parametrize(
    "ending", [KeyboardInterrupt(), StepError("the supervisor does not answer")]
)
def test_what_ends_the_step_leaves_no_cable_off(cables, ending):
    def ends(_mode, _timeout_s):
        raise ending

    done, error = cables(ends)
    assert error is ending
    assert done == [("camera", False), "ended", ("camera", True)]
