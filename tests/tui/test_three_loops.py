"""A console of the whole testbed: a metrology loop among the stellar ones breaks no screen."""

import pytest

from fitctl.messages.telemetry import Telemetry
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.tui.commands import VIEWS
from tests.loop.test_link import Testbed
from tests.tui.piloted import pressed, run


class Recorded:
    """Telemetry of the simulated testbed, twenty messages a second, until all loops hold."""

    def __init__(self):
        buffer, testbed = TelemetryBuffer(), Testbed()
        state = ServiceState(1, 0.0, "", lambda: 0, lambda: 0)
        self._messages: list[Telemetry] = []
        testbed.simulation._on_record = buffer.add
        testbed.simulation.acquire()
        while testbed.clock.now_s() < 20.0:
            testbed.run(0.05)
            state.sequence += 1
            now_s = testbed.clock.now_s()
            self._messages.append(buffer.telemetry(testbed.supervisor, state, now_s))

    def messages(self, _number):
        return self._messages


@pytest.fixture(scope="module")
def recorded():
    return Recorded()


def test_the_telemetry_carries_the_ticks_of_metrology_and_the_overlap(recorded):
    newest = recorded.messages(0)[-1]
    assert {loop.name: loop.kind for loop in newest.loops} == {
        "right": "stellar",
        "metrology": "metrology",
        "left": "stellar",
    }
    assert {tick.loop for tick in newest.ticks} == {"right", "left"}
    assert {tick.loop for tick in newest.metrology_ticks} == {"metrology"}
    assert newest.overlaps[-1].visibility > 0.8


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.label)
def test_every_screen_shows_every_loop(recorded, view):
    shown = []

    async def scenario(app, pilot):
        await pressed(app, pilot, view.key)
        for _ in range(3):
            shown.append(app.state.loop.state.name)
            await pressed(app, pilot, "l")

    run(scenario, supervisor=recorded)
    assert sorted(shown) == ["left", "metrology", "right"]
