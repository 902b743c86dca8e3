"""Consoles far away."""

import msgspec
import pytest

from benchmarks.swarm.happenings import Kill
from benchmarks.swarm.run import run_plan
from benchmarks.swarm.telemetry_wire import RemoteConsole
from fitctl.messages import client
from fitctl.tui.state import ConsoleState
from tests.benchmarks.plans import gives, plan

REMOTE = msgspec.structs.replace(
    plan(
        *[gives(at_s, None) for at_s in (0.1, 1.0, 2.0)],
        Kill(at_s=20.0, back_after_s=0.5),
        *[gives(at_s, None) for at_s in (22.0, 24.0)],
        duration_s=40.0,
    ),
    remote_consoles=2,
)


@pytest.mark.long
def test_consoles_far_away_receive_what_was_sent_and_change_nothing(monkeypatch):
    missed, take = [], RemoteConsole._take

    def noted(self, message):
        take(self, message)
        missed.append(self._state.missed)

    monkeypatch.setattr(RemoteConsole, "_take", noted)
    result = run_plan(REMOTE)

    assert result.violations == []
    assert len(missed) > 100
    assert max(missed) > 0  # their links have little room
    assert result.digest == run_plan(msgspec.structs.replace(REMOTE, remote_consoles=0)).digest


@pytest.mark.long
@pytest.mark.parametrize(
    ("owner", "name", "mistake"),
    [
        (client, "plain_message", lambda message: msgspec.structs.replace(message, events=[])),
        (ConsoleState, "missed", property(lambda _: 0, lambda _, missed: None)),
    ],
)
def test_a_console_far_away_that_decodes_or_counts_wrongly_is_noticed(
    monkeypatch, owner, name, mistake
):
    monkeypatch.setattr(owner, name, mistake, raising=False)
    violated = {one.invariant for one in run_plan(REMOTE).violations}

    assert "a console far away shows what was" in violated
