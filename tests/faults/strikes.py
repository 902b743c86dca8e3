"""How things are struck: each begins something, and heals it when it is left."""

import re
import subprocess
import threading
import time
from contextlib import contextmanager, suppress

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import Jog, MoveCollector, Reset, Shutdown, Stop
from fitctl.mocks.bench import ClearFaults, SetFault

from .entries.commands import ALONE, BATCH, FASTER, FLOOD, FLOODED, SENT, answers

SLOW_S = 0.015  # stopped for so long, then running for so long: half of its time
ENDS_WITHIN_S = 10.0
DRAWS_WITHIN_S = 10.0
RECORDER_BACK_S = 60.0  # its supervisor waits longer from try to try
RIG = load_rig(default_rig_path())
JOG_SKY_ARCSEC = 90.0  # nearly as far as one jog goes
JOG_RAD = JOG_SKY_ARCSEC / RIG.loops["right"].siderostat.sky_arcsec_per_motor_rad
MOVED_RAD = 0.1  # of a motor
BEGINS_S = 2.0  # a jog
COLLECTOR_S = 10.0  # until the hexapod is referenced and moves
FAULT = re.compile(
    r"(?P<kind>\w+)( (?P<part>[a-zA-Z]\w*))??( (?P<value>-?[\d.]+))?( for (?P<for_s>[\d.]+) s)?"
)


@contextmanager
def device(rig, entry):
    """A fault of the mocks: its kind, then its part, its value, and how long it lasts, where they are given."""
    given = FAULT.fullmatch(entry.how)
    fault = SetFault(
        entry.struck,
        given["kind"],
        part=given["part"] or "",
        value=None if given["value"] is None else float(given["value"]),
        for_s=None if given["for_s"] is None else float(given["for_s"]),
    )
    ends_s = time.monotonic() + (fault.for_s or 0.0)
    rig.tell(fault)
    try:
        yield
        while time.monotonic() < ends_s:
            rig.receive(0.1)
    finally:
        rig.tell(ClearFaults(entry.struck, fault.kind))


# ---------------------------------------------------------------- processes


@contextmanager
def killed(rig, entry):
    """SIGKILL; then started again by whoever started it, what is beside the supervisor by that."""
    rig.process(entry.struck).kill()
    if entry.struck == "mocks":
        rig.bench_answers = False
        rig.mocks.wait()
    if entry.struck == "supervisor":
        rig.supervisor.wait()
        rig.note_death()
    try:
        yield
    finally:
        if entry.struck == "mocks":
            rig.restart_mocks()
        if entry.struck == "supervisor":
            rig.start_supervisor()
    if entry.struck in {"gateway", "metrics server", "learner"}:
        goes_on(rig, entry)


@contextmanager
def stopped(rig, entry):
    """SIGSTOP, then SIGCONT."""
    process = rig.process(entry.struck)
    rig.bench_answers = entry.struck != "mocks"
    process.suspend()
    try:
        yield
    finally:
        process.resume()
        rig.bench_answers = True
    goes_on(rig, entry)


def on_its_way(strike_supervisor):
    """Strike while the siderostat jogs: it must have moved, and not have come where it was sent."""

    @contextmanager
    def struck(rig, entry):
        before_rad = rig.place().motor_rad[0]
        assert rig.client.send(Jog(az_sky_arcsec=JOG_SKY_ARCSEC, el_sky_arcsec=0.0)).accepted
        end_s = time.monotonic() + BEGINS_S
        while rig.place().motor_rad[0] - before_rad < 2 * MOVED_RAD and time.monotonic() < end_s:
            time.sleep(0.005)
        with strike_supervisor(rig, entry):
            yield
            # Short of where it was sent or, if the drive missed its commands late, beyond.
            went_rad = rig.places[-1].motor_rad[0] - before_rad
            assert went_rad > MOVED_RAD, "it had not begun to jog"
            assert abs(went_rad - JOG_RAD) > MOVED_RAD, "it had ended its jog"

    return struck


@contextmanager
def stuck(rig, entry):
    """The recorder is stopped until its queue is full."""
    lost_before = lost_so_far(rig)
    with stopped(rig, entry):
        yield
    writes_again(rig, lost_before)


@contextmanager
def slowed(rig, entry):
    """SIGSTOP and SIGCONT in turn: it has half of its time, in pieces."""
    process = rig.process(entry.struck)
    with repeated(lambda: (process.suspend(), time.sleep(SLOW_S), process.resume()), SLOW_S):
        yield
    goes_on(rig, entry)


@contextmanager
def repeated(action, every_s):
    """Do something again and again, meanwhile."""
    ending = threading.Event()

    def go_on():
        while not ending.wait(every_s):
            action()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


def goes_on(rig, entry):
    """A console draws again; who is elsewhere is answered again, metrics come again; a learner runs."""
    if entry.struck == "gateway":
        rig.is_reached_from_elsewhere()
    if entry.struck == "metrics server":
        rig.is_measured()
    if entry.struck == "learner":
        rig.process("learner")
    if entry.struck == "console":
        drawn, end_s = rig.console.drawn, time.monotonic() + DRAWS_WITHIN_S
        while rig.console.drawn == drawn:
            assert time.monotonic() < end_s, "the console draws no more"
            rig.receive(0.05)


@contextmanager
def told_to_end(rig, _entry):
    """The supervisor is asked to end while its recorder cannot; a new one is started."""
    rig.recorder().suspend()
    rig.client.send(Shutdown())
    rig.supervisor.wait(ENDS_WITHIN_S)
    rig.heard.append(rig.complaints())
    told = re.findall(r"did not confirm the last (\d+)", rig.complaints())
    rig.lost_of["told at the end"] = sum(map(int, told))
    try:
        yield
    finally:
        rig.start_supervisor()


# ---------------------------------------------------------------- consoles


@contextmanager
def not_read(rig, entry):
    """Nobody takes what the console draws, as a terminal does that hangs."""
    rig.process("console")
    rig.console.reads.clear()
    try:
        yield
    finally:
        rig.console.reads.set()
        goes_on(rig, entry)


@contextmanager
def many_events(rig, entry):
    """Each STOP in SAFE is an event."""
    rig.process("console")
    with repeated(lambda: rig.client.send(Stop()), 0.001):
        yield
    goes_on(rig, entry)


@contextmanager
def many_messages(rig, entry):
    """As many as the rig's telemetry_hz."""
    rig.process("console")
    try:
        yield
    finally:
        goes_on(rig, entry)


# ---------------------------------------------------------------- the collector and several loops


@contextmanager
def moving(rig, entry):
    """The collector moves when it is struck, and moves again once it is healed."""
    move_collector(rig)
    with STRIKES_ON_THE_WAY.get(entry.how, device)(rig, entry):
        yield
    move_collector(rig)
    assert rig.client.send(MoveCollector(action="stop")).accepted


def move_collector(rig):
    """Start the collector's motion unless it goes on, referenced first where the hexapod asks for that."""
    end_s = time.monotonic() + COLLECTOR_S
    while True:
        since_s = time.monotonic()
        assert since_s < end_s, f"the collector does not move within {COLLECTOR_S:g} s"
        reply = rig.client.send(MoveCollector(action="start"))
        if "the collector moves" in reply.text:
            return
        if not reply.accepted:
            rig.receive(0.1)
            continue
        answer = hexapod_event(rig, since_s)
        if "begins to move" in answer:
            return
        if "reference it first" in answer:
            rig.client.send(MoveCollector(action="reference"))
            hexapod_event(rig, time.monotonic())


def hexapod_event(rig, since_s):
    """The next event about the hexapod."""
    events = []

    def reported(telemetry):
        events.extend(
            event.message
            for event in telemetry.events
            if event.source == "hexapod" and event.time_s >= since_s
        )
        return events

    with suppress(AssertionError):
        rig.follow(reported, COLLECTOR_S)
    return " ".join(events)


@contextmanager
def stopped_by_operator(rig, entry):
    """STOP for all loops."""
    assert rig.client.send(Stop()).accepted
    yield


@contextmanager
def turned_off(rig, entry):
    """The operator turns one loop off."""
    rig.turn_off(entry.loop)
    yield


# ---------------------------------------------------------------- commands, disk and clock


@contextmanager
def command(rig, entry):
    """What is no command; what comes back is heard."""
    if entry.how in SENT:
        rig.heard += answers(rig.sockets, SENT[entry.how][0])
    else:
        rig.heard.append(flooded(rig.sockets))
    yield


def flooded(sockets):
    """How many answers a flood got, and how fast, beside commands that each wait for the one before."""
    each_s = []
    for times, ahead in ((ALONE, 1), (FLOOD, BATCH)):
        started_s = time.monotonic()
        count = sum(1 for _ in answers(sockets, FLOODED, times, ahead))
        each_s.append((time.monotonic() - started_s) / max(count, 1))
    faster = each_s[0] / each_s[1]
    speed = f"at least {FASTER}" if faster >= FASTER else f"only {faster:.1f}"
    return f"{count} answers, {speed} times as fast as one by one"


@contextmanager
def full(rig, _entry):
    """A file takes all the room that there is."""
    filler, lost_before = rig.logs / "filler", lost_so_far(rig)
    try:
        with suppress(OSError), filler.open("wb", buffering=0) as file:
            while file.write(bytes(65536)):
                pass
        yield
    finally:
        filler.unlink()
        writes_again(rig, lost_before)


def writes_again(rig, lost_before):
    """A recorder is at work again, and has noticed all that was lost since it was struck."""
    healed_s, lost = time.monotonic(), lost_so_far(rig) - lost_before
    rig.follow(
        lambda t: (
            t.recorder is not None and t.recorder.time_s > healed_s and t.recorder.lost >= lost
        ),
        RECORDER_BACK_S,
    )


def lost_so_far(rig):
    """By the supervisor's count."""
    return rig.telemetry[-1].losses.records_lost


@contextmanager
def read_only(rig, _entry):
    """Mounted once more over itself, for reading: what is open stays so, the next file cannot begin."""
    folder, lost_before = str(rig.folder), lost_so_far(rig)
    subprocess.run([*rig.before, "mount", "--bind", folder, folder], check=True)
    subprocess.run([*rig.before, "mount", "-o", "remount,bind,ro", folder], check=True)
    try:
        yield
    finally:
        subprocess.run([*rig.before, "umount", folder], check=True)
        writes_again(rig, lost_before)


@contextmanager
def not_told(rig, _entry):
    """Whoever asks the disk for its room waits; meanwhile a new recorder comes, and devices are opened."""
    silent = rig.folder / "silent"
    silent.touch()
    try:
        yield
        killed = rig.recorder()
        killed.kill()
        rig.follow(lambda _: rig.recorder().pid != killed.pid)
        rig.reach({"right": "OFF"})
        rig.reach({"right": "STANDBY"})
    finally:
        silent.unlink()
    rig.follow(lambda t: any("free space again" in event.message for event in t.events))


@contextmanager
def clock(rig, entry):
    """Wall time is so many seconds later, then as before."""
    step = rig.folder / "step"
    step.write_text(entry.how)
    try:
        yield
    finally:
        step.unlink()
        time.sleep(2.0)  # it is looked at once a second
        rig.client.send(Reset(name="clock_step"))


STRIKES = {
    "killed": killed,
    "killed while it jogs": on_its_way(killed),
    "stopped": stopped,
    "stopped while it jogs": on_its_way(stopped),
    "stuck": stuck,
    "slowed": slowed,
    "told to end while its recorder is stopped": told_to_end,
    "not read by its terminal": not_read,
    "flooded with events": many_events,
    "sent 100 messages a second": many_messages,
    "full": full,
    "read-only": read_only,
    "is not told": not_told,
    "command": command,
    "clock": clock,
    "hexapod": moving,
    "turned off by the operator": turned_off,
}
"""By what is struck, or how; everything else is a fault of a mock device."""


STRIKES_ON_THE_WAY = {"all loops are stopped": stopped_by_operator}
"""What else can become of a collector that moves, by how."""


def strike(rig, entry):
    """The entry's strike, as a context."""
    return (STRIKES.get(entry.struck) or STRIKES.get(entry.how) or device)(rig, entry)
