"""The console and its link: stale, unreadable, late or lost telemetry, and commands that nobody answers."""

import asyncio
import threading
import time
from contextlib import closing

import msgspec
import pytest
import zmq

from fitctl.logging.records import Event
from fitctl.messages.client import Client
from fitctl.messages.commands import RecentEvents, Reply, Stop
from fitctl.messages.endpoints import COMMAND_SOCKET, TELEMETRY_SOCKET
from fitctl.tui import app as console_app
from fitctl.tui.app import ConsoleApp
from fitctl.tui.dialogs import events_text
from fitctl.tui.wire import UNDRAWN_MESSAGES
from tests.instruments.fake_supervisor import START_S, FakeSupervisor
from tests.tui.links import FakeLink
from tests.tui.live import DEADLINE_S, Clock, header_text, notifications, run, screen_text, until


def test_stop_does_not_wait_for_commands_without_an_answer():
    answers = threading.Event()

    def answer(command):
        if not isinstance(command, Stop):
            answers.wait(DEADLINE_S)
        return Reply(accepted=True)

    async def scenario(app, pilot, link):
        await pilot.press(*"ahrb" * 5)
        await until(pilot, lambda: len(link.sent) == 20)
        await pilot.press("s")
        await until(pilot, lambda: "STOP confirmed" in notifications(app))
        answers.set()

    assert run(scenario, link=FakeLink(answer)).sent[-1] == Stop()


def test_a_stop_just_before_quitting_is_still_sent():
    async def scenario(app, pilot, link):
        await pilot.press("s", "q")

    link = run(scenario)
    assert Stop() in link.sent
    assert link.closed


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ConnectionError("no answer in 1 s"), "Stop not confirmed"),
        (TypeError("a defect"), "Stop not confirmed: It failed: TypeError: a defect"),
    ],
)
def test_a_stop_that_nobody_answers_or_that_fails_is_told_as_a_danger(error, told):
    def fails(_command):
        raise error

    async def scenario(app, pilot, link):
        await pilot.press("s")
        await until(pilot, lambda: notifications(app))
        assert told in notifications(app)
        assert "may still move" in notifications(app)

    run(scenario, link=FakeLink(fails))


def test_the_danger_is_over_when_a_stop_that_was_not_confirmed_has_been_obeyed():
    supervisor = FakeSupervisor()

    def fails(_command):
        raise ConnectionError("no answer in 1 s")

    async def scenario(app, pilot, link):
        await pilot.press("s")
        await until(pilot, lambda: "may still move" in notifications(app))
        link.deliver([supervisor.message()])
        await pilot.pause(0.3)
        assert "may still move" in notifications(app)
        supervisor.mode = "SAFE"
        link.deliver([supervisor.message()])
        await until(pilot, lambda: "the loops have stopped" in notifications(app))
        assert "may still move" not in notifications(app)

    run(scenario, link=FakeLink(fails), supervisor=supervisor)


def test_the_time_of_a_notice_counts_from_when_it_is_on_the_screen():
    async def scenario(app, pilot, link):
        with app.batch_update():  # nothing is drawn, as when other programs keep the processor busy
            app.notify("all loops go to SAFE", title="STOP confirmed", timeout=0.3)
            await until(pilot, lambda: "STOP confirmed" in notifications(app))
            await asyncio.sleep(0.6)
            assert "STOP confirmed" not in screen_text(app)
        await until(pilot, lambda: "STOP confirmed" in screen_text(app))
        await until(pilot, lambda: "STOP confirmed" not in screen_text(app))
        assert not notifications(app)

    run(scenario)


def test_old_data_are_said_to_be_old_and_new_data_end_it():
    clock = Clock()
    supervisor = FakeSupervisor()

    async def scenario(app, pilot, link):
        clock.now_s += 0.5
        assert "live" in header_text(app)
        clock.now_s += 2.5
        assert "NO DATA for 3 s" in header_text(app)
        assert app.screen.has_class("stale")
        link.deliver([supervisor.message()])
        await until(pilot, lambda: "live" in header_text(app))
        assert not app.screen.has_class("stale")

    run(scenario, clock=clock, supervisor=supervisor)


def test_a_console_without_a_supervisor_says_so():
    clock = Clock()

    async def main():
        app = ConsoleApp(FakeLink(), clock=clock)
        async with app.run_test(size=(80, 24)):
            clock.now_s += 4.0
            assert "connecting" in header_text(app)
            assert "NO DATA for 4 s → the console reconnects by itself" in header_text(app)

    asyncio.run(main())


def test_telemetry_that_cannot_be_read_is_told():
    class Garbled(FakeLink):
        def receive(self, timeout_s):
            if super().receive(timeout_s) is not None:
                raise msgspec.ValidationError("Object missing required field `sky`")

    async def main():
        link = Garbled()
        app = ConsoleApp(link, clock=Clock())
        async with app.run_test(notifications=True) as pilot:
            link.deliver([FakeSupervisor().message()])
            await until(pilot, lambda: "telemetry unreadable" in notifications(app))

    asyncio.run(main())


@pytest.mark.parametrize(
    "error",
    [
        ConnectionError("unreadable"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    ],
)
def test_unreadable_messages_are_told_once_and_do_not_hold_up_the_good_ones(error):
    class Garbled(FakeLink):
        unreadable = 5

        def receive(self, timeout_s):
            if self.unreadable:
                self.unreadable -= 1
                raise error
            return super().receive(timeout_s)

    async def scenario(app, pilot, link):
        assert len(app._notifications) == 1

    run(scenario, link=Garbled())


@pytest.mark.parametrize(
    "payload", [b"\xc1", msgspec.msgpack.encode({"a": 1}), b"\x81\xa1\xff\x01"]
)
def test_a_supervisor_of_another_version_is_a_connection_error(tmp_path, payload):
    def answer():
        client, tag, _command = commands.recv_multipart()
        commands.send_multipart([client, tag, payload])

    with closing(Client(tmp_path)) as client, zmq.Context() as context:
        commands, telemetry = context.socket(zmq.ROUTER), context.socket(zmq.XPUB)
        commands.bind(f"ipc://{tmp_path}/{COMMAND_SOCKET}")
        telemetry.bind(f"ipc://{tmp_path}/{TELEMETRY_SOCKET}")
        answering = threading.Thread(target=answer, daemon=True)
        answering.start()
        with commands, telemetry:
            with pytest.raises(
                ConnectionError, match=r"reply to Stop .* another version of fitctl"
            ):
                client.send(Stop(), timeout_s=DEADLINE_S)
            answering.join()
            assert telemetry.poll(1000 * DEADLINE_S)  # the client has subscribed
            telemetry.send(payload)
            with pytest.raises(ConnectionError, match=r"telemetry .* another version of fitctl"):
                client.receive(DEADLINE_S)


@pytest.mark.long
def test_quitting_leaves_no_thread_and_closes_the_link():
    async def scenario(app, pilot, link):
        await pilot.press("h")
        await pilot.press("q")

    assert run(scenario).closed
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("console-")]


def test_a_screen_that_is_held_up_leaves_telemetry_in_the_link():
    """Where it is bounded; in the console's own memory it would grow for as long as the terminal waits."""

    async def scenario(console, pilot, link):
        link.deliver(FakeSupervisor().messages(300)[2:])
        waiting, since_s = link.incoming.qsize(), time.monotonic()
        while time.monotonic() < since_s + 0.5:  # the loop that draws stands still meanwhile
            time.sleep(0.01)
            if link.incoming.qsize() < waiting:
                waiting, since_s = link.incoming.qsize(), time.monotonic()
        assert waiting >= 298 - UNDRAWN_MESSAGES

        await until(pilot, lambda: console.state.newest.sequence == 300)
        assert console.state.missed == 0

    run(scenario)


def test_an_open_console_keeps_the_instrument_and_never_complains_of_it(monkeypatch):
    monkeypatch.setattr(console_app, "KEEP_S", 0.05)

    async def scenario(app, pilot, link):
        await until(pilot, lambda: link.kept > 2)
        assert notifications(app) == ""

    assert not run(scenario, link=FakeLink(lambda _: Reply(accepted=False, text="no"))).sent


EARLIER = Event(time_s=START_S - 500.0, severity="error", source="right", message="it was cloudy")


class RememberingLink(FakeLink):
    """Answers with events of the past, the first time only after some failures."""

    def __init__(self, failures: int = 0) -> None:
        super().__init__()
        self.failures = failures

    def send(self, command):
        reply = super().send(command)
        if not isinstance(command, RecentEvents):
            return reply
        if self.asked_for_events <= self.failures:
            raise ConnectionError("nobody is there")
        return Reply(accepted=True, events=[EARLIER, *FakeSupervisor().message().events])


def test_events_from_before_the_console_came_are_shown_once():
    async def scenario(app, pilot, link):
        await until(pilot, lambda: EARLIER in app.state.events)
        heard = FakeSupervisor().message().events
        assert list(app.state.events) == [*reversed(heard), EARLIER]
        assert "it was cloudy" in events_text(app.state, 100).plain

    assert run(scenario, link=RememberingLink()).asked_for_events == 1


def test_events_of_before_are_asked_for_until_they_come(monkeypatch):
    monkeypatch.setattr(console_app, "KEEP_S", 0.05)

    async def scenario(app, pilot, link):
        await until(pilot, lambda: EARLIER in app.state.events)
        assert notifications(app) == ""

    assert run(scenario, link=RememberingLink(failures=3)).asked_for_events == 4


def test_events_that_a_slow_link_swallowed_are_asked_for(monkeypatch):
    monkeypatch.setattr(console_app, "KEEP_S", 0.05)

    async def scenario(app, pilot, link):
        await until(pilot, lambda: link.asked_for_events == 1)
        link.deliver(FakeSupervisor().messages(9)[-1:])
        await until(pilot, lambda: link.asked_for_events == 2)
        assert app.state.missed == 6

    run(scenario)
