"""What Prometheus may ask: a process of its own, which listens to the telemetry as a console does.

It is no part of the supervisor's process, because a scrape there would hold the interpreter that the
loops need. It serves on 127.0.0.1 only, and takes no command.
"""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any, get_args, get_type_hints
from wsgiref.simple_server import WSGIRequestHandler

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from fitctl.config import ConfigError
from fitctl.logging.records import DeviceHealth, LoopTiming, Overlap, Record, Severity
from fitctl.messages.client import Client
from fitctl.messages.modes import Mode
from fitctl.messages.tally import BeamTally, Tally, add_beam_ticks, add_ticks
from fitctl.messages.telemetry import Telemetry
from fitctl.messages.troubles import troubles

HOST = "127.0.0.1"
STALE_STACKS_S = 62.0  # piezo amplifiers are read once in piezo.poll_s, which is at most a minute
STALE_S = 2.0  # nothing is told of an instrument that has been silent for so long, but that it is
_POLL_S = 0.25
_REQUEST_S = 5.0  # for a whole request and its answer
_MOST_REQUESTS = 16  # at once
STATES = get_args(get_type_hints(DeviceHealth)["state"])
SEVERITIES = get_args(Severity)

# name, help, value of a loop's newest tick
OF_TICK: list[tuple[str, str, str]] = [
    ("fitctl_star_visible", "1 while the star is seen.", "star_visible"),
    ("fitctl_star_flux_dn", "Flux of the star.", "star_flux_dn"),
    ("fitctl_mirror_range_fraction", "Used part of the mirror's range.", "fsm_range_fraction"),
    ("fitctl_frame_age_seconds", "Mid-exposure to use, newest frame.", "frame_age_s"),
]
# name, help, value of a loop's sums
OF_TALLY: list[tuple[str, str, Callable[[Tally], float]]] = [
    ("fitctl_ticks", "Ticks with a frame.", lambda tally: tally.ticks),
    ("fitctl_late_ticks", "Ticks whose command came late.", lambda tally: tally.late_ticks),
    ("fitctl_star_ticks", "Ticks that saw the star.", lambda tally: tally.star_ticks),
    (
        "fitctl_frames_lost",
        "Frames that the camera sent and the supervisor did not receive, since the camera was opened.",
        lambda tally: 0 if tally.newest is None else tally.newest.frames_lost,
    ),
]
# name, help, value of the last second
OF_TIMING: list[tuple[str, str, str]] = [
    ("fitctl_tick_compute_worst_seconds", "Slowest tick of a second.", "compute_worst_s"),
    ("fitctl_servo_late_worst_seconds", "Latest servo wake-up of a second.", "servo_late_worst_s"),
]
# name, help, what of every second is summed
OF_TIMINGS: list[tuple[str, str, str]] = [
    ("fitctl_servo_periods", "Periods of the position servo.", "servo_periods"),
    ("fitctl_servo_missed", "Periods without a reading.", "servo_missed"),
    ("fitctl_servo_skipped", "Periods that were skipped.", "servo_skipped"),
    ("fitctl_stalls", "Times that the machine itself stood still.", "stalls"),
]


class InstrumentCollector(Collector):
    """Turns telemetry into metrics; one thread gives it messages, others ask."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: Telemetry | None = None
        self._received_s = -STALE_S
        self._messages_missed = 0
        self._tallies: dict[str, Tally] = {}
        self._beams: dict[str, BeamTally] = {}
        self._overlap: Overlap | None = None
        self._timings: dict[str, LoopTiming] = {}
        self._timed: Counter[tuple[str, str]] = Counter()
        self._events: Counter[str] = Counter(dict.fromkeys(SEVERITIES, 0))

    def accept(self, telemetry: Telemetry, now_s: float) -> None:
        """Take one message that came at `now_s`."""
        with self._lock:
            before = self._newest
            if before is not None and before.pid == telemetry.pid:
                self._messages_missed += telemetry.sequence - before.sequence - 1
            elif before is not None:  # another supervisor: what the last one measured is over
                self._overlap = None
                self._timings.clear()
                for tally in self._tallies.values():
                    tally.newest = None
            self._newest, self._received_s = telemetry, now_s
            add_ticks(self._tallies, telemetry.ticks)
            add_beam_ticks(self._beams, telemetry.metrology_ticks)
            if telemetry.overlaps:
                self._overlap = telemetry.overlaps[-1]
            for row in telemetry.timing:
                before_it = self._timings.get(row.loop)
                if before_it is None or before_it.time_s != row.time_s:
                    self._timings[row.loop] = row
                    for _, _, field in OF_TIMINGS:
                        self._timed[field, row.loop] += getattr(row, field)
            self._events.update(event.severity for event in telemetry.events)

    def collect(self) -> Iterator[Metric]:
        """All metrics, as of the newest message; of a silent instrument only that it is silent."""
        with self._lock:
            silent = time.monotonic() - self._received_s > STALE_S
            yield GaugeMetricFamily(
                "fitctl_up", "1 while the supervisor sends telemetry.", value=float(not silent)
            )
            if self._newest is None or silent:
                return
            yield from _of_instrument(self._newest)
            yield from _of_loops(self._newest, self._tallies)
            yield from _of_beams(self._beams)
            yield from _of_overlap(self._newest, self._overlap)
            yield from _of_timing(self._newest, self._timings, self._timed)
            yield from _of_devices(self._newest)
            yield _counters(
                "fitctl_events",
                "Events since the metrics began.",
                ["severity"],
                [([severity], count) for severity, count in self._events.items()],
            )
            yield CounterMetricFamily(
                "fitctl_telemetry_missed",
                "Messages of telemetry that did not come; their ticks are in no counter.",
                value=self._messages_missed,
            )


class _Handler(WSGIRequestHandler):
    """Closes a connection whose request and answer take too long, however they trickle; logs nothing."""

    def setup(self) -> None:
        self._cut = threading.Timer(_REQUEST_S, self._shut)
        self._cut.daemon = True
        self._cut.start()
        super().setup()

    def finish(self) -> None:
        self._cut.cancel()
        super().finish()

    def _shut(self) -> None:
        with suppress(OSError):  # it has just ended
            self.connection.shutdown(socket.SHUT_RDWR)

    def log_message(self, format: str, *args: object) -> None:
        pass


class _Server(ThreadingWSGIServer):
    """Answers a bounded number of requests at once; who comes beyond it is turned away."""

    def __init__(self, port: int) -> None:
        self._free = threading.BoundedSemaphore(_MOST_REQUESTS)
        super().__init__((HOST, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that hangs up, or was cut off, is no error of ours."""


def _for_this_host(answer: Callable[..., Any], port: int) -> Callable[..., Any]:
    """Refuse requests to other names: a page of another site may have its name resolved to 127.0.0.1."""
    hosts = {f"{name}:{port}" for name in (HOST, "localhost")}

    def guarded(environ: dict[str, Any], start_response: Callable[..., Any]) -> Any:
        if environ.get("HTTP_HOST", "").lower() in hosts:
            return answer(environ, start_response)
        start_response("403 Forbidden", [("Content-Type", "text/plain")])
        return [f"ask http://{HOST}:{port}/metrics\n".encode()]

    return guarded


def serve_metrics(client: Client, port: int, rig_name: str, stop: threading.Event) -> None:
    """Answer ``http://127.0.0.1:PORT/metrics`` until `stop`.

    Raises
    ------
    ConfigError
        If the port cannot be had.
    """
    registry = CollectorRegistry(auto_describe=False)
    collector = InstrumentCollector()
    registry.register(collector)
    try:
        server = _Server(port)
    except OSError as error:
        msg = (
            f"service.metrics_port: {HOST}:{port}: {error.strerror}; give {rig_name} another, or 0"
        )
        raise ConfigError(msg) from None
    server.set_app(_for_this_host(make_wsgi_app(registry), port))
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    try:
        while not stop.is_set():
            try:
                telemetry = client.receive(_POLL_S)
            except ConnectionError:
                continue  # fitctl_up tells that nothing readable comes
            if telemetry is not None:
                collector.accept(telemetry, time.monotonic())
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _is_fresh(record: Record | None, newest: Telemetry, within_s: float = STALE_S) -> bool:
    """Whether a record tells how it is now, and not how it was."""
    return record is not None and newest.time_s - record.time_s <= within_s


Rows = Iterable[tuple[list[str], float]]
"""Values of labels, and the value."""


def _gauges(name: str, text: str, labels: list[str], rows: Rows) -> Metric:
    return _filled(GaugeMetricFamily(name, text, labels=labels), rows)


def _counters(name: str, text: str, labels: list[str], rows: Rows) -> Metric:
    return _filled(CounterMetricFamily(name, text, labels=labels), rows)


def _filled(family: GaugeMetricFamily | CounterMetricFamily, rows: Rows) -> Metric:
    for labels, value in rows:
        family.add_metric(labels, value)
    return family


def _of_instrument(newest: Telemetry) -> Iterator[Metric]:
    about = {"rig": newest.rig_name, "scheduling": newest.scheduling}
    yield InfoMetricFamily("fitctl_rig", "Which rig this is.", value=about)
    well = not troubles(newest)
    yield GaugeMetricFamily("fitctl_well", "1 while `fitctl status` finds nothing.", value=well)
    lost = newest.records_lost
    yield CounterMetricFamily("fitctl_records_lost", "Records missing from the log.", value=lost)
    unsent = [([queue], count) for queue, count in newest.losses.unsent.items()]
    yield _counters("fitctl_unsent", "Telemetry and replies dropped.", ["queue"], unsent)
    recorder = newest.recorder
    if recorder is not None:
        for name, text, value in (
            ("fitctl_log_records", "Records written to this log.", recorder.records),
            ("fitctl_log_bytes", "Bytes written to this log.", recorder.bytes_written),
        ):
            yield CounterMetricFamily(name, text, value=value)
    running = newest.running_sequence
    under_way = running is not None and running.state in {"running", "paused"}
    text = "1 while a sequence is running or paused."
    yield GaugeMetricFamily("fitctl_sequence_under_way", text, value=under_way)


def _of_loops(newest: Telemetry, tallies: dict[str, Tally]) -> Iterator[Metric]:
    yield _gauges(
        "fitctl_mode",
        "1 for the mode that the loop is in.",
        ["loop", "mode"],
        [([at.name, mode.name], at.mode == mode.name) for at in newest.loops for mode in Mode],
    )
    yield _gauges(
        "fitctl_mode_since_timestamp_seconds",
        "When the mode began, Unix time.",
        ["loop"],
        [([loop.name], loop.since_s + newest.wall_minus_monotonic_s) for loop in newest.loops],
    )
    yield _gauges(
        "fitctl_interlocks_tripped",
        "How many interlocks are in force.",
        ["loop"],
        [([loop.name], len(loop.interlocks)) for loop in newest.loops],
    )
    yield _gauges(
        "fitctl_interlock_tripped",
        "1 for each interlock that is in force.",
        ["loop", "interlock", "action"],
        [([at.name, row.name, row.action], 1) for at in newest.loops for row in at.interlocks],
    )
    yield _gauges(
        "fitctl_loop_waits",
        "1 while the loop holds its stages and waits, such as for its link.",
        ["loop"],
        [([loop.name], bool(loop.waits_for)) for loop in newest.loops],
    )
    ticks = {
        loop: tally.newest for loop, tally in tallies.items() if _is_fresh(tally.newest, newest)
    }
    for name, text, field in OF_TICK:
        rows = [([loop], getattr(tick, field)) for loop, tick in ticks.items()]
        yield _gauges(name, text, ["loop"], rows)
    for name, text, total in OF_TALLY:
        yield _counters(name, text, ["loop"], [([at], total(one)) for at, one in tallies.items()])
    yield _counters(
        "fitctl_error_pixels_squared",
        "Squared pointing error, summed over fitctl_star_ticks.",
        ["loop", "axis"],
        [
            ([loop, axis], value)
            for loop, tally in tallies.items()
            for axis, value in (("az", tally.az_px2), ("el", tally.el_px2))
        ],
    )


def _of_beams(tallies: dict[str, BeamTally]) -> Iterator[Metric]:
    yield _counters(
        "fitctl_beam_samples",
        "Samples of the photodiodes that measured the metrology beam.",
        ["loop"],
        [([loop], tally.samples) for loop, tally in tallies.items()],
    )
    yield _counters(
        "fitctl_beam_error_arcseconds_squared",
        "Squared error of the metrology beam, summed over fitctl_beam_samples.",
        ["loop", "axis"],
        [
            ([loop, axis], value)
            for loop, tally in tallies.items()
            for axis, value in (("az", tally.az_arcsec2), ("el", tally.el_arcsec2))
        ],
    )


def _of_overlap(newest: Telemetry, overlap: Overlap | None) -> Iterator[Metric]:
    rows = [overlap] if overlap is not None and _is_fresh(overlap, newest) else []
    yield _gauges(
        "fitctl_tilt_arcseconds",
        "Tilt between two loops' stars on the newest frame.",
        ["loop", "other_loop", "axis"],
        [
            ([row.loop, row.other_loop, axis], value)
            for row in rows
            for axis, value in (("az", row.tilt_az_arcsec), ("el", row.tilt_el_arcsec))
        ],
    )
    yield _gauges(
        "fitctl_visibility",
        "Fringe visibility that this tilt leaves.",
        ["loop", "other_loop"],
        [([row.loop, row.other_loop], row.visibility) for row in rows],
    )


def _of_timing(
    newest: Telemetry, timings: dict[str, LoopTiming], sums: Counter[tuple[str, str]]
) -> Iterator[Metric]:
    for name, text, field in OF_TIMING:
        rows = [
            ([at], getattr(row, field)) for at, row in timings.items() if _is_fresh(row, newest)
        ]
        yield _gauges(name, text, ["loop"], rows)
    for name, text, field in OF_TIMINGS:
        totals = [([loop], total) for (of, loop), total in sums.items() if of == field]
        yield _counters(name, text, ["loop"], totals)


def _of_devices(newest: Telemetry) -> Iterator[Metric]:
    yield _gauges(
        "fitctl_device_state",
        "1 for the state that the device is in.",
        ["device", "state"],
        [([of.device, state], of.state == state) for of in newest.devices for state in STATES],
    )
    yield _gauges(
        "fitctl_stack_volts",
        "Measured at the stack in the last minute.",
        ["loop", "stack"],
        [
            ([row.loop, str(stack)], value)
            for row in newest.piezo
            if _is_fresh(row, newest, STALE_STACKS_S)
            for stack, value in enumerate((row.stack1_v, row.stack2_v, row.stack3_v), start=1)
        ],
    )
