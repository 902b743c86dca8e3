"""The swarm's computer, as fitctl measures it."""

import pytest

from benchmarks.swarm.computer import Computer, installed
from benchmarks.swarm.threads import installed as threads_installed
from fitctl.daemon.machine import Machine


class Supervisor:
    """Keeps the quantities that are reported to it."""

    def __init__(self):
        self.quantities = {}
        self.violated = []

    def report_quantity(self, name, value):
        self.quantities[name] = value

    def report_event(self, *_):
        pass


@pytest.fixture
def supervisor():
    return Supervisor()


@pytest.fixture
def measures(time, supervisor):
    """Does something to the computer and measures it twice; returns the quantities of each time."""
    computer = Computer()

    def measures(does):
        found = []

        def main():
            machine = computer.machine_of(
                supervisor, lambda: 0.5, lambda *violated: supervisor.violated.append(violated)
            )
            does(computer)
            for _ in range(2):
                machine.look()
                time.sleep(1.0)
                found.append(dict(supervisor.quantities))

        time.spawn(main, "main")
        time.run_until(time.now_s() + 5.0)
        assert not time.escaped
        return found

    with threads_installed(time), installed(time, computer):
        yield measures


def test_a_step_of_the_clock_is_measured_once(supervisor, measures):
    first, second = measures(lambda computer: setattr(computer, "wall_s", -1.5))

    assert first["clock_step_s"] == pytest.approx(-1.5)
    assert second["clock_step_s"] == pytest.approx(0.0)
    assert supervisor.violated == []


def test_a_step_of_the_clock_that_is_not_measured_is_noticed(monkeypatch, supervisor, measures):
    monkeypatch.setattr(Machine, "look", lambda self: self._measured("clock_step_s", 0.0))
    measures(lambda computer: setattr(computer, "wall_s", -1.5))

    assert supervisor.violated[0] == (
        "steps of the clock are measured",
        "0.000 s in all, not -1.500 s",
    )


def test_a_full_disk_has_no_room(measures):
    before, _ = measures(lambda _: None)
    assert before["disk_free_bytes"] > 1e9

    full, _ = measures(lambda computer: setattr(computer, "disk_is_full", True))
    assert full["disk_free_bytes"] == 0.0
