"""The closed loops of a commissioning: which loops are commanded, and how a beam is held."""

import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from fitctl.commissioning.outcome import Site, StepError
from fitctl.commissioning.steps import closed, link
from fitctl.commissioning.steps.closed import Loop, supervised
from fitctl.commissioning.tasks import tasks_of
from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.daemon.locks import only_supervisor
from fitctl.messages.commands import Acquire, Recover, Reply, SetTarget, Standby
from fitctl.messages.endpoints import make_service_folder

TESTBED = load_rig(default_rig_path().with_name("fit-testbed.toml"))
BEAM_ARCSEC = 0.3


class FakeClient:
    """A supervisor whose loops are in the given modes; a command is done at once."""

    def __init__(self, beam_arcsec=BEAM_ARCSEC, **modes):
        self.modes = {"right": "STANDBY", "left": "STANDBY", "metrology": "STANDBY"} | modes
        self.beam_arcsec = beam_arcsec
        self.sent = []
        self.then = []

    def receive(self, _timeout_s):
        time.sleep(0.002)
        loops = [
            SimpleNamespace(name=name, mode=mode, last_change=SimpleNamespace(reason="no light"))
            for name, mode in self.modes.items()
        ]
        self.beam_arcsec = -self.beam_arcsec
        tick = SimpleNamespace(
            loop="metrology",
            time_s=time.monotonic(),
            mode=self.modes["metrology"],
            beam_az_arcsec=self.beam_arcsec,
            beam_el_arcsec=0.5 * self.beam_arcsec,
        )
        if self.then:
            self.modes |= self.then.pop(0)
        return SimpleNamespace(
            time_s=time.monotonic(), loops=loops, ticks=(), metrology_ticks=[tick]
        )

    def send(self, command):
        self.sent.append((type(command).__name__, command.loop))
        return Reply(accepted=True)


def site_of(name):
    return Site(TESTBED, name, lambda _line: None, Path("rig.toml"), ())


def commanded(name, command, **modes):
    client = FakeClient(**modes)
    Loop(site_of(name), client).command(command)
    return client.sent


@pytest.mark.parametrize("command", [Standby(), Acquire(), Recover()])
def test_a_step_of_one_loop_commands_no_other_one(command):
    assert commanded("right", command) == [(type(command).__name__, "right")]


@pytest.mark.parametrize(
    ("command", "mode"), [(Standby(), "OFF"), (Acquire(), "STANDBY"), (Recover(), "SAFE")]
)
def test_where_a_star_comes_over_a_link_the_link_comes_first(command, mode):
    name = type(command).__name__
    assert commanded("left", command, metrology=mode) == [(name, "metrology"), (name, "left")]
    assert commanded("left", command, metrology="LOCKED") == [(name, "left")]


def test_what_concerns_the_star_is_for_its_loop_alone():
    assert commanded("left", SetTarget(az_px=12.0, el_px=20.0)) == [("SetTarget", "left")]


def test_a_stellar_loop_is_closed_over_a_link_that_was_held():
    needs = {task.name: list(task.needs()) for task in tasks_of(TESTBED)}
    assert "metrology.link" in needs["left.gentle"]
    assert "metrology.link" not in needs["right.gentle"]
    assert "metrology.photodiodes" in needs["left.star"]


@pytest.fixture
def held(monkeypatch):
    """What the step makes of a supervisor, without the waiting."""
    monkeypatch.setattr(link, "HELD_S", 0.2)
    monkeypatch.setattr(link, "SETTLED_S", 0.0)
    monkeypatch.setattr(link, "ACQUIRE_S", 0.3)
    monkeypatch.setattr(Loop, "stop", lambda _loop: 0.1)

    def check(client):
        @contextmanager
        def supervised(site):
            yield Loop(site, client)

        monkeypatch.setattr(link, "supervised", supervised)
        return link.check_link(site_of("metrology"))

    return check


def test_a_beam_is_held_to_the_requirement(held):
    client = FakeClient(metrology="LOCKED")
    outcome = held(client)
    assert client.sent == [("Acquire", "metrology")]
    assert outcome.figures["rms_az_arcsec"] == pytest.approx(BEAM_ARCSEC)
    assert outcome.figures["rms_el_arcsec"] == pytest.approx(BEAM_ARCSEC / 2)
    assert outcome.figures["worst_arcsec"] == pytest.approx(BEAM_ARCSEC)
    assert not outcome.trouble


def test_a_beam_that_wanders_is_named_with_the_requirement(held):
    with pytest.raises(StepError, match=r"held to 3\.00 arcsec RMS; the requirement is 1 arcsec"):
        held(FakeClient(beam_arcsec=3.0, metrology="LOCKED"))


def test_a_beam_that_is_not_found_is_named_with_the_mode(held):
    with pytest.raises(StepError, match=r"not held after .* in ACQUISITION: no light"):
        held(FakeClient(metrology="ACQUISITION"))


def test_a_beam_that_is_lost_on_the_way_ends_the_step(held):
    client = FakeClient(metrology="LOCKED")
    client.then = [{}] * 20 + [{"metrology": "COARSE"}]
    with pytest.raises(StepError, match="left LOCKED for COARSE"):
        held(client)


@pytest.mark.usefixtures("locks_of_its_own")
def test_a_supervisor_that_runs_already_is_not_commanded(monkeypatch):
    site = site_of("right")
    started = []
    monkeypatch.setattr(closed, "start_process", lambda *_, **__: started.append(True))

    with (
        only_supervisor(make_service_folder(site.rig)),
        pytest.raises(ConfigError, match="another supervisor"),
        supervised(site),
    ):
        pass
    assert started == []
