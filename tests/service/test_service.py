"""The supervisor's door: what is answered, what is refused, and to whom it is open."""

import stat
import threading
import time

import msgspec
import pytest
from instruments.served import Served, until

from fitctl.clock import VirtualClock
from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.logging.records import Event, RecorderStatus
from fitctl.messages.client import Client
from fitctl.messages.commands import (
    MAX_COMMAND_BYTES,
    Acquire,
    Experiment,
    RecentEvents,
    RecorderReport,
    SetTarget,
    Standby,
    Status,
    Stop,
    TakeOver,
)
from fitctl.messages.endpoints import make_service_folder, service_folder
from fitctl.model.drives import Drive
from fitctl.service.admission import Sender
from fitctl.service.service import Waiting
from fitctl.service.telemetry_buffer import CountingBuffer


@pytest.fixture
def served(tmp_path):
    served = Served(tmp_path)
    served.start()
    yield served
    served.close()


def test_commands_lead_through_the_modes_and_telemetry_shows_it(served):
    assert served.client.send(Standby(), timeout_s=20.0).accepted  # imports much, once
    assert served.client.send(Acquire()).accepted
    telemetry = served.follow(lambda t: t.loops[0].mode == "VERNIER")

    loop = telemetry.loops[0]
    assert loop.last_change.target == "VERNIER"
    assert loop.usable_commands == ["Release", "Stop"]
    assert telemetry.frame.width_px * telemetry.frame.height_px * 2 == len(telemetry.frame.data)
    assert telemetry.records_lost == 7
    assert {device.device for device in telemetry.devices} == {
        "camera",
        "right siderostat",
        "right D/A",
        "right piezo",
    }


def test_every_tick_reaches_the_console_once(served):
    served.client.send(Standby())
    numbers = []
    served.follow(
        lambda t: numbers.extend(x.number for x in t.ticks if x.number >= 0) or len(numbers) > 100
    )

    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_stop_takes_the_velocity_before_the_loop_even_looks(served):
    served.client.send(Standby())
    served.client.send(Acquire())
    served.ending.set()  # the loop hangs
    served.stepper.join()

    with pytest.raises(ConnectionError, match="no supervisor answers"):
        served.client.send(Stop(), timeout_s=0.3)

    assert served.simulation.supervisor.servos["right"]._stopped


@pytest.mark.parametrize(
    ("payload", "complaint"),
    [
        (b"", "truncated"),
        (b"\xff\xff\xff", "not a command"),
        (b"\x81\xa1x" + 2000 * b"\x91", "not a command"),  # nested deeply
        (b"\x81\xa4type\xa4\xff\xfe\xff\xfe", "not a command"),
        (b"\x82\xa4type\xa4Stop\xa4loop\xa2\xff\xfe", "not a command"),
        (msgspec.msgpack.encode({"type": "Explode"}), "Explode"),
        (msgspec.msgpack.encode({"type": "Stop", "colour": "red"}), "colour"),
        (msgspec.msgpack.encode({"type": "SetTarget", "az_px": "far", "el_px": 1}), "az_px"),
        (msgspec.msgpack.encode({"type": "Stop", "version": 99}), "version"),
    ],
)
def test_what_is_no_command_is_refused_with_the_reason(served, payload, complaint):
    reply = served.raw(b"tag", payload)

    assert not reply.accepted
    assert complaint in reply.text


def test_messages_of_a_wrong_shape_or_size_do_not_disturb_the_service(served):
    assert served.raw(b"only one part") is None
    assert served.raw(b"a", b"b", b"c") is None
    assert served.raw(b"tag", b"x" * 1_000_000) is None

    assert served.client.send(Status()).text == "right OFF"


def test_a_command_of_too_many_parts_is_thrown_away_whole(served):
    assert served.raw(b"tag", *[b"part"] * 1000) is None

    assert served.client.send(Status()).text == "right OFF"


def test_a_command_that_is_too_long_is_refused_before_it_is_sent(served):
    drive = Drive(channel="fsm_az", shape="sine", amplitude=0.5, frequency_hz=1.0, duration_s=2.0)

    reply = served.client.send(Experiment(name="long", drives=[drive] * 100))

    assert not reply.accepted
    assert f"a command may take {MAX_COMMAND_BYTES}" in reply.text


def test_a_nonsense_target_is_refused(served):
    assert not served.client.send(SetTarget(az_px=float("nan"), el_px=10.0)).accepted
    assert not served.client.send(SetTarget(az_px=1e9, el_px=10.0)).accepted


def test_the_recorders_report_is_shown(served):
    status = RecorderStatus(time_s=1.0, path="x.mcap", records=5, lost=2, bytes_written=9)

    assert served.client.send(RecorderReport(status=status)).accepted

    assert served.follow(lambda t: t.recorder is not None).recorder == status


def test_sockets_are_in_a_folder_of_the_owner_alone(served):
    assert stat.S_IMODE(served.folder.stat().st_mode) == 0o700


def test_a_folder_open_to_others_is_refused(tmp_path):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o755)
    rig = load_rig(default_rig_path(), [f"service.folder={tmp_path / 'open'}"])

    with pytest.raises(ConfigError, match="mode 0700"):
        make_service_folder(rig)


def test_a_folder_too_deep_for_a_socket_is_refused(tmp_path):
    rig = load_rig(default_rig_path(), [f"service.folder={tmp_path / ('x' * 120)}"])

    with pytest.raises(ConfigError, match="too long"):
        make_service_folder(rig)


@pytest.mark.parametrize("folder", ["~no-such-user/x", "x\\u0000y", "é" * 60])
def test_a_folder_that_cannot_be_one_is_refused(folder):
    rig = load_rig(default_rig_path(), [f'service.folder="{folder}"'])

    with pytest.raises(ConfigError, match=r"service\.folder"):
        service_folder(rig)


def test_two_rigs_of_one_user_have_two_folders():
    first = load_rig(default_rig_path())
    second = load_rig(default_rig_path(), ["name=other"])

    assert service_folder(first) != service_folder(second)


def test_without_a_supervisor_a_command_says_so_in_time(tmp_path):
    client = Client(tmp_path)
    with pytest.raises(ConnectionError, match="fitctl run"):
        client.send(Status(), timeout_s=0.2)
    client.close()


def test_what_telemetry_has_no_room_for_goes_oldest_first_and_is_counted():
    buffer = CountingBuffer(3)
    for item in range(5):
        buffer.put(item)

    assert (buffer.drain(), buffer.lost) == ([2, 3, 4], 2)
    buffer.put(5)
    assert (buffer.drain(), buffer.drain(), buffer.lost) == ([5], [], 2)


def test_a_buffer_filled_and_drained_at_once_loses_nothing_uncounted():
    buffer, taken, ending = CountingBuffer(4), [], threading.Event()

    def drain():
        while not ending.is_set():
            taken.extend(buffer.drain())

    drainer = threading.Thread(target=drain)
    drainer.start()
    for item in range(100_000):
        buffer.put(item)
    ending.set()
    drainer.join()
    taken += buffer.drain()

    assert taken == sorted(set(taken))
    assert len(taken) + buffer.lost == 100_000


def test_what_the_service_was_too_slow_for_is_in_the_telemetry(served):
    event = Event(time_s=0.0, severity="info", source="test", message="")
    for _ in range(20_000):  # far more than fits between two messages
        served.buffer.add(event)

    losses = served.follow(lambda telemetry: telemetry.losses.events_unsent > 0).losses
    assert (losses.records_offered, losses.records_lost) == (1000, 7)
    assert (losses.ticks_unsent, losses.mode_changes_unsent) == (0, 0)


def test_who_comes_late_is_told_what_has_happened(served):
    heard = []
    served.client.send(Standby(), timeout_s=20.0)
    served.client.send(Acquire(), timeout_s=20.0)
    served.follow(lambda t: heard.extend(t.events) or t.loops[0].mode == "VERNIER")

    told = served.client_of(served.folder).send(RecentEvents(), timeout_s=20.0).events

    assert any("STANDBY -> ACQUISITION" in event.message for event in told)
    assert told[-len(heard) :] == heard


def test_what_is_told_of_the_past_fits_one_answer(served):
    for number in range(400):
        text = f"{number} " + 1000 * "x"
        served.buffer.add(Event(time_s=number, severity="info", source="test", message=text))
    served.follow(lambda t: any(event.message.startswith("399 ") for event in t.events))

    told = served.client.send(RecentEvents()).events

    numbers = [int(event.time_s) for event in told]
    assert numbers == list(range(400 - len(told), 400))
    assert 60_000 < len(msgspec.msgpack.encode(told)) <= 64 * 1024 + 16


def test_a_reply_to_somebody_who_has_gone_is_counted(served):
    served.ending.set()  # the loop stands still, and answers once they have gone
    served.stepper.join()
    for _ in range(5):  # until the socket knows of their going
        with pytest.raises(ConnectionError, match="no supervisor answers"):
            served.client.send(Stop(), timeout_s=0.1)
        served.simulation.supervisor.step()
        seen = [served.follow(lambda _: True) for _ in range(3)]
        if seen[-1].losses.replies_unsent:
            return
    raise AssertionError("never counted")


@pytest.fixture
def slow_clock(tmp_path):
    """At most five commands a second, and a second that the test itself makes pass."""
    served = Served(tmp_path, "service.commands_per_s=5.0", clock=VirtualClock())
    served.start()
    yield served
    served.close()


def test_who_sends_too_much_is_told_so_and_counted(slow_clock):
    replies = [slow_clock.client.send(Status()) for _ in range(20)]

    assert [reply.accepted for reply in replies] == [True] * 5 + [False] * 15
    assert all("more than 5 commands a second" in reply.text for reply in replies[5:])
    slow_clock.service._clock.sleep_until(10.0)
    until(lambda: any("15 messages, over the rate limit" in e for e in slow_clock.events()))
    assert slow_clock.client.send(Status()).accepted


def test_a_stop_is_never_one_too_many(slow_clock):
    while slow_clock.client.send(Status()).accepted:
        pass

    stops = [slow_clock.client.send(Stop()) for _ in range(20)]

    assert all(reply.accepted for reply in stops)
    assert slow_clock.simulation.supervisor.loops["right"].mode.name == "SAFE"


def test_a_command_that_arrives_long_after_it_was_sent_is_not_carried_out_but_a_stop_is(tmp_path):
    clock = VirtualClock()
    served = Served(tmp_path, clock=clock)
    served.start()
    clock.sleep_until(14.2)
    try:
        replies = [
            served.raw(b"tag", msgspec.msgpack.encode(kind(sent_s=sent_s)))
            for kind, sent_s in ((TakeOver, 10.0), (Standby, 10.0), (Stop, 10.0), (TakeOver, 14.0))
        ]
    finally:
        served.close()

    assert [reply.accepted for reply in replies] == [False, False, True, True]
    assert replies[1].text.startswith(
        "Standby was sent 4.2 s ago; what arrives after 1.75 s is not"
    )
    assert [accepted for _, accepted in served.commands("Standby")] == [False]


def test_a_client_says_when_it_sent_a_command(served, monkeypatch):
    posted, post = [], served.simulation.supervisor.post
    monkeypatch.setattr(
        served.simulation.supervisor,
        "post",
        lambda command, *rest: posted.append(command) or post(command, *rest),
    )
    before_s = time.monotonic()
    for command in (Standby(), Stop()):
        assert served.client.send(command).accepted

    standby, stop = posted
    assert before_s <= standby.sent_s <= time.monotonic()
    assert stop.sent_s is msgspec.UNSET  # a supervisor of an older fitctl obeys it too


def test_a_stop_of_too_many_joins_none_that_was_obeyed_already(slow_clock):
    """A `recover` may have been obeyed in between."""
    service, supervisor = slow_clock.service, slow_clock.simulation.supervisor
    slow_clock.ending.set()  # this test makes the steps
    slow_clock.stepper.join()
    anna = Sender("anna", "here", "commander", is_local=True)

    def send_stop():
        waiting = Waiting(service._local, b"anna", b"tag", anna)
        service._receive(waiting, msgspec.msgpack.encode(Stop()))
        return len(supervisor._commands)

    assert [send_stop() for _ in range(6)] == [1, 2, 3, 4, 5, 5]  # the last joins those before
    supervisor.step()
    assert send_stop() == 1
