"""Interlocks of a real supervisor: the computer is measured, consoles are told, a reset comes back."""

import pytest

from fitctl.messages.commands import Reset

from .conftest import Rig, absent_devices


@pytest.fixture
def supervisor(tmp_path):
    """One that asks for more room on the disk than there is; it needs no devices to say so."""
    rig = Rig(tmp_path)
    rig.settings.append("interlocks.disk_space.low=1e15")
    rig.endpoints = absent_devices()
    try:
        rig.start_supervisor()
        yield rig
    finally:
        rig.close()


def test_too_little_room_is_told_and_no_reset_makes_it_go_away(supervisor):
    events = []

    def told(telemetry):  # state and event may come in two messages
        events.extend(event.message for event in telemetry.events)
        tripped = telemetry.loops[0].interlocks
        return tripped and any(tripped[0].reason in message for message in events)

    seen = supervisor.follow(told, 20.0)

    (trip,) = seen[-1].loops[0].interlocks
    assert (trip.name, trip.action) == ("disk_space", "warn")
    assert trip.reason.endswith("make room, or choose another logging.folder")
    reply = supervisor.client.send(Reset(name="disk_space"))
    assert not reply.accepted
    assert "it would trip again" in reply.text
