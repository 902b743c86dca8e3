"""`fitctl rehearse` shows what a command would do to a running supervisor, and gives it no command."""

import json

import pytest

from fitctl.cli import main
from fitctl.messages.commands import Acquire, Standby
from fitctl.messages.modes import Mode


def in_vernier(served):
    for command in (Standby(), Acquire()):
        assert served.client.send(command).accepted
    served.follow(lambda _: served.simulation.supervisor.loops["right"].mode is Mode.VERNIER)


@pytest.mark.long
def test_where_the_stages_end_is_printed_and_nothing_is_sent(served, fitctl):
    in_vernier(served)
    status, out, _ = fitctl("rehearse", "target", "22", "21")
    assert status == 0
    assert "nothing was sent" in out
    assert "siderostat  " in out
    assert "of its range" in out
    assert "✓ no interlock would trip" in out
    assert served.commands("SetTarget") == []


@pytest.mark.long
def test_a_refusal_is_foreseen(served, fitctl):
    in_vernier(served)
    status, out, _ = fitctl("rehearse", "recover", "--json")
    assert status == 1
    result = json.loads(out)
    assert not result["accepted"]
    assert "recover" in result["refused"]
    assert served.commands("Recover") == []


def test_a_mistake_is_named_before_anything_is_simulated(fitctl):
    status, _, err = fitctl("rehearse", "target", "22")
    assert status == 2
    assert "target takes AZ_PX EL_PX" in err


def test_an_instrument_elsewhere_is_rehearsed_with_its_own_rig_file_only(capsys):
    with pytest.raises(SystemExit) as end:
        main(["rehearse", "stop", "--remote", "key.toml"])
    assert end.value.code == 2
    assert (
        "with --remote, name the rig file of that instrument with --rig" in capsys.readouterr().err
    )


@pytest.mark.parametrize("word", ["shutdown", "status", "events", "take-over"])
def test_what_a_simulation_cannot_follow_is_refused_with_what_it_can(fitctl, word):
    status, out, err = fitctl("rehearse", word)
    assert (status, out) == (2, "")
    (line,) = err.splitlines()
    assert f"rehearse: {word} is for the supervisor's process, which is not simulated" in line
    available = line.partition("Available: ")[2].split(", ")
    assert {"stop", "target", "frame-rate"} < set(available)
    assert word not in available


@pytest.mark.long
def test_a_sequence_begins_where_the_stages_are(served, fitctl):
    in_vernier(served)
    status, out, _ = fitctl("sequence", "dry-run", "acquire", "--present")
    assert status == 0
    assert "done" in out
