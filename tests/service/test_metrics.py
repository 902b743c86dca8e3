"""Metrics as Prometheus meets them: a real scrape, read by its own parser."""

import math
import socket
import threading
import time
import urllib.request

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families

from fitctl.config import ConfigError
from fitctl.logging.records import MetrologyTick, Overlap
from fitctl.messages.telemetry import TrippedInterlock
from fitctl.service.metrics import HOST, InstrumentCollector, serve_metrics
from tests.instruments.fake_supervisor import WALL_MINUS_MONOTONIC_S, FakeSupervisor


class Line:
    """A client whose messages the test gives."""

    def __init__(self):
        self.messages = []
        self.empty = threading.Event()

    def receive(self, timeout_s):
        if self.messages:
            message = self.messages.pop(0)
            if isinstance(message, Exception):
                raise message
            return message
        self.empty.set()
        time.sleep(0.002)
        return None


class Served:
    """Metrics on a free port, fed by a :class:`Line`."""

    def __init__(self):
        with socket.socket() as free:
            free.bind((HOST, 0))
            self.port = free.getsockname()[1]
        self.line = Line()
        self.stop = threading.Event()
        self.thread = threading.Thread(
            target=serve_metrics, args=(self.line, self.port, "fit-mock", self.stop)
        )
        self.thread.start()
        assert self.line.empty.wait(10)  # it is asked only once the port is open

    def tell(self, *messages):
        self.line.messages.extend(messages)
        self.line.empty.clear()
        assert self.line.empty.wait(10)

    def scrape(self):
        """Samples by name and labels, the labels as a set of pairs."""
        url = f"http://{HOST}:{self.port}/metrics"
        with urllib.request.urlopen(url, timeout=10) as answer:
            text = answer.read().decode()
        return {
            (sample.name, frozenset(sample.labels.items())): sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
        }

    def close(self):
        self.stop.set()
        self.thread.join(10)
        assert not self.thread.is_alive()


@pytest.fixture
def served():
    served = Served()
    yield served
    served.close()


def of(name, **labels):
    return name, frozenset(labels.items())


def test_nothing_is_shown_of_an_instrument_that_was_never_heard(served):
    assert served.scrape() == {of("fitctl_up"): 0.0}


def test_a_scrape_tells_mode_devices_and_recorder(served):
    message = FakeSupervisor().message()
    served.tell(message)
    seen = served.scrape()

    assert seen[of("fitctl_up")] == seen[of("fitctl_well")] == 1
    assert seen[of("fitctl_mode", loop="right", mode="VERNIER")] == 1
    assert sum(value for (name, _), value in seen.items() if name == "fitctl_mode") == 1
    since_s = message.loops[0].since_s + WALL_MINUS_MONOTONIC_S
    assert seen[of("fitctl_mode_since_timestamp_seconds", loop="right")] == since_s
    for device in message.devices:
        assert seen[of("fitctl_device_state", device=device.device, state=device.state)] == 1
    assert seen[of("fitctl_log_records_total")] == message.recorder.records
    assert seen[of("fitctl_stack_volts", loop="right", stack="2")] == message.piezo[0].stack2_v


def test_the_rms_of_any_time_can_be_had_from_two_counters(served):
    messages = FakeSupervisor(error_px=0.05).messages(100)
    served.tell(*messages)
    seen = served.scrape()

    errors = [tick.error_az_px for message in messages for tick in message.ticks]
    squares = seen[of("fitctl_error_pixels_squared_total", loop="right", axis="az")]
    ticks = seen[of("fitctl_star_ticks_total", loop="right")]
    assert ticks == len(errors)
    rms_px = math.sqrt(sum(error**2 for error in errors) / len(errors))
    assert math.sqrt(squares / ticks) == pytest.approx(rms_px, rel=1e-9)


def test_a_second_of_timing_counts_once_however_often_it_is_sent(served):
    message = FakeSupervisor().message()
    served.tell(message, msgspec.structs.replace(message, sequence=2))

    seen = served.scrape()[of("fitctl_servo_periods_total", loop="right")]

    assert seen == message.timing[0].servo_periods > 0


def test_what_is_tripped_lost_or_missed_is_counted(served):
    supervisor = FakeSupervisor()
    first = supervisor.message()
    supervisor.messages(3)  # that never come
    supervisor.records_lost = 12
    supervisor.interlocks = [
        TrippedInterlock(name="fsm_edge", since_s=0, action="warn", reset="itself", reason="")
    ]
    served.tell(first, supervisor.message())
    seen = served.scrape()

    assert seen[of("fitctl_telemetry_missed_total")] == 3
    assert seen[of("fitctl_records_lost_total")] == 12
    queues = {dict(labels)["queue"] for name, labels in seen if name == "fitctl_unsent_total"}
    assert queues == {"ticks", "events", "mode_changes", "replies"}
    assert seen[of("fitctl_interlocks_tripped", loop="right")] == 1
    assert (
        seen[of("fitctl_interlock_tripped", loop="right", interlock="fsm_edge", action="warn")] == 1
    )
    assert seen[of("fitctl_well")] == 0
    told = {event.severity for event in first.events}
    assert all(seen[of("fitctl_events_total", severity=severity)] for severity in told)


def test_an_instrument_that_falls_silent_is_not_told_as_it_was():
    collector = InstrumentCollector()
    collector.accept(FakeSupervisor().message(), time.monotonic() - 60.0)

    (up,) = collector.collect()

    assert up.samples[0].value == 0


def test_a_message_that_cannot_be_read_ends_nothing(served):
    served.tell(ConnectionError("of another version"), FakeSupervisor().message())

    assert served.scrape()[of("fitctl_up")] == 1


def test_a_taken_port_is_shown_in_one_line():
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"service.metrics_port: {HOST}:{port}: .*another"):
            serve_metrics(Line(), port, "fit-mock", threading.Event())


def answer_to(port, request, limit_s=20.0):
    """All that comes back for some bytes, and after how many seconds the server has hung up."""
    begun_s = time.monotonic()
    with socket.create_connection((HOST, port), limit_s) as line:
        line.sendall(request)
        answer = b""
        while piece := line.recv(65536):
            answer += piece
    return answer, time.monotonic() - begun_s


@pytest.mark.parametrize("host", ["elsewhere.example", "127.0.0.1:1", "127.0.0.1", "\xe9"])
def test_a_page_of_another_site_cannot_read_the_metrics_under_its_own_name(served, host):
    request = f"GET /metrics HTTP/1.0\r\nHost: {host}\r\n\r\n".encode()

    answer, _ = answer_to(served.port, request)

    assert answer.split()[1] == b"403"
    assert b"fitctl_up" not in answer


def test_a_request_without_a_host_is_refused(served):
    assert answer_to(served.port, b"GET /metrics HTTP/1.0\r\n\r\n")[0].split()[1] == b"403"


def test_localhost_is_this_host(served):
    request = f"GET /metrics HTTP/1.0\r\nHost: localhost:{served.port}\r\n\r\n".encode()

    assert b"fitctl_up" in answer_to(served.port, request)[0]


def test_a_request_that_never_ends_is_cut_off(served, monkeypatch):
    monkeypatch.setattr("fitctl.service.metrics._REQUEST_S", 0.5)

    answer, after_s = answer_to(served.port, b"GET /metrics HTTP/1.0\r\nHost: ")

    assert b"fitctl_up" not in answer
    assert after_s < 10.0


def test_a_request_that_trickles_is_cut_off_too(served, monkeypatch):
    """A limit to each read would never be reached."""
    monkeypatch.setattr("fitctl.service.metrics._REQUEST_S", 0.5)
    begun_s = time.monotonic()

    def trickle(line):
        while time.monotonic() < begun_s + 10.0:
            line.sendall(b"x")
            time.sleep(0.05)

    with socket.create_connection((HOST, served.port), 20.0) as line:
        line.sendall(b"GET /metrics HTTP/1.0\r\nX: ")
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            trickle(line)


@pytest.mark.long
def test_many_who_never_ask_leave_few_threads_and_a_scrape_comes_through_after_them(
    served, monkeypatch
):
    monkeypatch.setattr("fitctl.service.metrics._REQUEST_S", 1.0)
    before = threading.active_count()
    silent = [socket.create_connection((HOST, served.port), 20.0) for _ in range(100)]
    try:
        time.sleep(0.3)
        # A request has its own thread and that of its time limit.
        assert threading.active_count() - before <= 2 * 16
        end_s = time.monotonic() + 20.0
        scraped = {}
        while not scraped and time.monotonic() < end_s:
            try:
                scraped = served.scrape()
            except OSError:
                time.sleep(0.1)
        assert scraped
    finally:
        for line in silent:
            line.close()


def test_the_beam_and_the_overlap_of_the_testbed_are_served():
    collector = InstrumentCollector()
    beam = dict.fromkeys(("beam_az_arcsec", "beam_el_arcsec"), 0.5)
    tick = metrology_tick(beam_state="MEASURED", **beam)
    dark = metrology_tick(beam_state="", beam_az_arcsec=math.nan, beam_el_arcsec=math.nan)
    message = FakeSupervisor().message()
    message = msgspec.structs.replace(
        message, metrology_ticks=[tick, dark, tick], overlaps=[overlap_at(message.time_s)]
    )
    collector.accept(message, time.monotonic())
    values = {
        (sample.name, tuple(sample.labels.values())): sample.value
        for family in collector.collect()
        for sample in family.samples
    }
    assert values["fitctl_beam_samples_total", ("metrology",)] == 2
    assert values["fitctl_beam_error_arcseconds_squared_total", ("metrology", "az")] == 0.5
    assert values["fitctl_visibility", ("left", "right")] == 0.97
    assert values["fitctl_tilt_arcseconds", ("left", "right", "el")] == -0.2
    assert values["fitctl_loop_waits", ("right",)] == 0


def metrology_tick(**fields):
    nothing = {"int": 0, "float": 0.0, "str": "", "bool": False}
    values = {name: nothing[kind] for name, kind in MetrologyTick.__annotations__.items()}
    return MetrologyTick(time_s=0.0, **values | {"loop": "metrology"} | fields)


def overlap_at(time_s):
    return Overlap(
        time_s=time_s,
        loop="left",
        other_loop="right",
        number=1,
        tilt_az_arcsec=0.1,
        tilt_el_arcsec=-0.2,
        visibility=0.97,
    )


def gauges_and_counters(collector):
    """Names of all that has a value now."""
    return {sample.name for family in collector.collect() for sample in family.samples}


NEWEST = {
    "fitctl_visibility",
    "fitctl_tilt_arcseconds",
    "fitctl_star_visible",
    "fitctl_tick_compute_worst_seconds",
}
SUMS = {"fitctl_ticks_total", "fitctl_servo_periods_total"}


@pytest.mark.parametrize(("pid", "later_s"), [(4242, 5.0), (4243, 0.1)], ids=["stop", "restart"])
def test_what_was_measured_before_a_stop_or_a_restart_is_not_told_as_newest(pid, later_s):
    collector, message = InstrumentCollector(), FakeSupervisor().message()
    before = msgspec.structs.replace(message, overlaps=[overlap_at(message.time_s)])
    collector.accept(before, time.monotonic())
    assert gauges_and_counters(collector) >= NEWEST | SUMS

    stopped = {"ticks": [], "timing": [], "overlaps": []}
    after = msgspec.structs.replace(
        message, pid=pid, sequence=2, time_s=message.time_s + later_s, **stopped
    )
    collector.accept(after, time.monotonic())

    told = gauges_and_counters(collector)
    assert not told & NEWEST
    assert told >= SUMS


@pytest.mark.parametrize(("later_s", "is_shown"), [(30.0, True), (70.0, False)])
def test_stack_voltages_of_an_amplifier_that_is_not_read_any_more_are_left_out(later_s, is_shown):
    collector, message = InstrumentCollector(), FakeSupervisor().message()
    (reading, *_) = message.piezo
    later = msgspec.structs.replace(message, time_s=reading.time_s + later_s)
    collector.accept(later, time.monotonic())

    assert ("fitctl_stack_volts" in gauges_and_counters(collector)) is is_shown
