"""What telemetry says besides the records themselves: who stopped the loops, and which stars interfere."""

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.command_table import command_record
from fitctl.messages.commands import Release, Reply, Stop
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.simulation.simulation import Simulation


def telemetry_of(buffer, rig_name="fit-mock.toml"):
    rig = load_rig(default_rig_path().with_name(rig_name))
    supervisor = Simulation(rig, 0, record=buffer.add, history_s=1.0).supervisor
    return buffer.telemetry(supervisor, ServiceState(1, 0.0, "", lambda: 0, lambda: 0), 0.0)


def recorded(command, sender, *, accepted=True):
    return command_record(command, Reply(accepted=accepted), sender, "", 1.0)


@pytest.mark.parametrize(
    ("records", "stopped_by"),
    [
        ([], ""),
        ([recorded(Stop(), "anna")], "anna"),
        ([recorded(Stop(), "anna"), recorded(Stop(), "bert")], "bert"),
        ([recorded(Stop(), "anna"), recorded(Release(), "bert")], "anna"),
        ([recorded(Stop(), "anna"), recorded(Stop(), "bert", accepted=False)], "anna"),
    ],
)
def test_telemetry_names_who_sent_the_last_stop(records, stopped_by):
    buffer = TelemetryBuffer()
    for record in records:
        buffer.add(record)
    assert telemetry_of(buffer).stopped_by == stopped_by


def test_telemetry_has_the_optics_of_the_fringes_where_the_rig_has_some():
    assert telemetry_of(TelemetryBuffer()).fringes is None
    optics = telemetry_of(TelemetryBuffer(), "fit-testbed.toml").fringes
    assert optics.loops == ("left", "right")
    assert (optics.aperture_m, optics.wavelength_m) == (0.15, 700e-9)
