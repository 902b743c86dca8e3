"""The recorded telemetry of the snapshots is as the simulated supervisor's in the same mode."""

import math

import msgspec
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import Acquire, Standby, Stop
from fitctl.messages.modes import Mode
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.simulation.simulation import Simulation
from tests.instruments.fake_supervisor import FakeSupervisor

MODES = ["STANDBY", "ACQUISITION", "COARSE", "VERNIER", "SAFE"]
STAR_OFFSET_PX = (30.0, 20.0)  # out of the field: the search takes a while


@pytest.fixture(scope="module")
def simulated():
    """The last telemetry of the simulated supervisor in each mode."""
    buffer, state = TelemetryBuffer(), ServiceState(1, 0.0, "", lambda: 0, lambda: 0)
    rig = load_rig(default_rig_path())
    simulation = Simulation(rig, 0, star_offset_px=STAR_OFFSET_PX, record=buffer.add, history_s=5.0)
    supervisor, found = simulation.supervisor, {}
    loop = supervisor.loops["right"]

    def telemetry():
        return buffer.telemetry(supervisor, state, simulation.clock.now_s())

    def reached(mode):
        while loop.mode is not mode:
            simulation.run(0.05)
        telemetry()
        simulation.run(0.3)
        found[mode.name] = telemetry()

    simulation.run(0.3)
    found["OFF"] = telemetry()
    for command, modes in (
        (Standby(), [Mode.STANDBY]),
        (Acquire(), [Mode.ACQUISITION, Mode.COARSE, Mode.VERNIER]),
        (Stop(), [Mode.SAFE]),
    ):
        simulation.command(command)
        for mode in modes:
            reached(mode)
    return found


def missing(tick):
    """Fields that are NaN, of those that a console draws."""
    drawn = msgspec.structs.asdict(FakeSupervisor("VERNIER").message().ticks[-1])
    return {
        name
        for name, value in msgspec.structs.asdict(tick).items()
        if isinstance(value, float) and math.isnan(value) and name in with_values(drawn)
    }


def with_values(drawn):
    """Fields that the recorded telemetry fills in at all, and that of a search."""
    filled = {name for name, v in drawn.items() if not (isinstance(v, float) and math.isnan(v))}
    return filled | {"search_progress"}


@pytest.mark.parametrize("mode", MODES)
def test_the_same_values_are_missing(simulated, mode):
    real, fake = simulated[mode], FakeSupervisor(mode).message()
    assert missing(fake.ticks[-1]) == missing(real.ticks[-1])
    assert fake.ticks[-1].star_visible == real.ticks[-1].star_visible


def test_before_the_first_standby_there_is_neither_tick_nor_frame_nor_device(simulated):
    for telemetry in (simulated["OFF"], FakeSupervisor("OFF").message()):
        assert telemetry.ticks == []
        assert telemetry.frame is None
        assert telemetry.devices == []


@pytest.mark.parametrize("mode", ["OFF", *MODES])
def test_the_same_commands_can_be_used(simulated, mode):
    (real,), (fake,) = simulated[mode].loops, FakeSupervisor(mode).message().loops
    assert set(fake.usable_commands) == set(real.usable_commands)


@pytest.mark.parametrize("mode", MODES)
def test_the_same_change_led_to_the_mode(simulated, mode):
    (real,), (fake,) = simulated[mode].loops, FakeSupervisor(mode).message().loops
    for field in ("source", "target", "target_number", "trigger"):
        assert getattr(fake.last_change, field) == getattr(real.last_change, field)
    assert (fake.search_centre_sky_arcsec is None) == (real.search_centre_sky_arcsec is None)


@pytest.mark.parametrize("mode", ["OFF", *MODES])
def test_the_same_interlocks_are_evaluated(simulated, mode):
    (real,), (fake,) = simulated[mode].loops, FakeSupervisor(mode).message().loops
    evaluated = {row.name: row.judged for row in real.watched}
    assert {row.name: row.judged for row in fake.watched} == {
        row.name: evaluated[row.name] for row in fake.watched
    }
