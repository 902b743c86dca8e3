"""Strike, watch, heal, judge: the same for every entry that needs a running instrument."""

import time
from contextlib import suppress
from itertools import pairwise

from stalls import stalls

from .entries.entry import HOLDS, SEARCHES, STAYED, WAITS
from .strikes import goes_on, strike
from .watched import modes_of

STAYING = {STAYED, HOLDS, WAITS}  # ends of other loops
STAYS_S = 2.0  # a mode in which the loop stays is watched for so long, if the entry has the time
SETTLE_S = 0.4  # from entering a mode of rest to standing still
DEAD_SETTLE_S = (
    1.6  # without a supervisor: the drive's heartbeat and the D/A's watchdog, and what they take
)
BESIDE = {
    "recorder",
    "gateway",
    "metrics server",
    "learner",
    "console",
    "command",
    "disk",
    "log folder",
    "clock",
}
"""What stands beside the tick, which goes on whatever becomes of them."""
PROCESSES = {
    "mocks",
    "supervisor",
    "recorder",
    "gateway",
    "metrics server",
    "learner",
    "console",
}
REST = {"OFF", "STANDBY", "SAFE"}
HELD_S = 1.0  # a loop must have held its star for so long before it is struck
HOLDS_WITHIN_S = 20.0
STILL_RAD = 0.02  # of a motor: 0.3 arcsec on the sky
STILL_V = 0.1
BIAS_V = 5.0
FRAMES_PER_S = 50
STALLED_S = 0.1
TRIES = 3  # another only where the machine itself stood still


def run(rig, entry, home):
    """One entry, tried again only if the machine stood still meanwhile; what was measured.

    `home` has the mode to which each loop comes back, by its name.
    """
    for attempt in range(1, TRIES + 1):
        with stalls() as stalled:
            try:
                return attempted(rig, entry, home, stalled) | {
                    "stalled_s": round(stalled.total_s, 3),
                    "attempts": attempt,
                }
            except AssertionError:
                if attempt == TRIES or stalled.total_s + supervisor_stalled_s(rig) < STALLED_S:
                    raise
                rig.reach(home)
    raise AssertionError


def supervisor_stalled_s(rig):
    """How long the supervisor's own threads were woken too late, by its own account."""
    timing = {t.time_s: t for telemetry in rig.telemetry for t in telemetry.timing}.values()
    return sum(t.stalls * t.worst_stall_s for t in timing)


def attempted(rig, entry, home, stalled):
    rig.loop = entry.loop
    rig.reach(home | {entry.loop: entry.mode})
    if entry.struck in PROCESSES:
        # Before the clock runs: a console is opened, a recorder or a gateway may just be starting.
        rig.process(entry.struck)
        goes_on(rig, entry)
    hold_all(rig, entry)
    wait_until_over(rig, entry.says)
    deaf = entry.struck == "supervisor" and entry.how != "slowed"
    del rig.telemetry[:-1], rig.places[:], rig.heard[:]
    struck_s = time.monotonic()
    with strike(rig, entry):
        measured = (rests if deaf else watch)(rig, entry, struck_s, stalled)
        healed_s = time.monotonic()
    if entry.struck in BESIDE:
        ticks_went_on(rig, stalled)
    if deaf:  # what it says once it is awake, or a new one once it has started
        since_s = healed_s if entry.how.startswith("stopped") else time.monotonic()
        measured = watch(rig, entry, since_s, stalled) | measured
    rig.reach(home)
    back_s = time.monotonic() - healed_s
    if entry.ends == SEARCHES:
        came_back_by_itself(rig, entry.loop, struck_s)
    hold_all(rig, entry)  # one that waited may only now find that its star is elsewhere
    measured |= went_on(rig, entry, struck_s)
    if not entry.moves:
        stood_still(rig, entry, struck_s, deaf)
    return measured | {"back_s": round(back_s, 1)}


def hold_all(rig, entry):
    """Wait until all loops hold their stars: one that has just come to VERNIER is far off, or still waits."""
    if not entry.others:
        return
    end_s = time.monotonic() + HOLDS_WITHIN_S
    while away := [name for name in rig.stellar_loops if not holds(rig, name)]:
        assert time.monotonic() < end_s, f"{away} do not hold their stars within {HOLDS_WITHIN_S} s"
        rig.receive(0.1)


def wait_until_over(rig, interlock):
    """Wait until what an earlier entry tripped is over: a row that is still tripped does not trip again."""
    rig.follow(
        lambda t: interlock not in {trip.name for loop in t.loops for trip in loop.interlocks},
        HOLDS_WITHIN_S,
    )


def holds(rig, name):
    """Whether a loop waits for nothing, and its star has been within its requirement."""
    (loop,) = (loop for loop in rig.telemetry[-1].loops if loop.name == name)
    rms_px = rig.residual_px(name, time.monotonic() - HELD_S)
    return not loop.waits_for and rms_px <= loop.requirement_px


def requirement_px(rig, name):
    return next(loop.requirement_px for loop in rig.telemetry[-1].loops if loop.name == name)


def watch(rig, entry, since_s, stalled):
    """Follow until it has ended as it should; the mode in which it was then, and how long that took."""
    stays = entry.mode in entry.modes
    before = modes_of(rig.telemetry[-1])
    stays_s = min(STAYS_S, entry.within_s)
    modes, texts, done_s = [], [], []

    def over(telemetry):
        if telemetry.time_s < since_s:  # it was on its way when we struck
            return False
        now_s = time.monotonic()
        modes.append(modes_of(telemetry)[entry.loop])
        texts.extend(said(telemetry, since_s))
        so_far = " ".join([*rig.heard, *texts])
        ended = (stays or modes[-1] in entry.modes) and others_ended(telemetry, entry, before)
        if not done_s and ended and entry.says in so_far:
            done_s.append(now_s)
        return bool(done_s) and (not stays or now_s > since_s + stays_s)

    limit_s = max(entry.within_s, STAYS_S) + 1.0 + stalled.total_s
    with suppress(AssertionError):
        rig.follow(over, limit_s)
    seen = f"{entry.name}: {sorted(set(modes))}, {list(dict.fromkeys(texts))}"
    assert done_s, f"not {entry.modes} and {entry.says!r} within {limit_s:.1f} s; {seen}"
    if stays:
        assert set(modes) <= entry.modes, seen
    took_s = done_s[0] - since_s
    assert took_s <= entry.within_s + stalled.total_s, f"{took_s:.2f} s; {seen}"
    return {"took_s": round(took_s, 3), "ended": modes[-1]}


def others_ended(telemetry, entry, before):
    """Whether the other loops are as the entry says; `before` has their modes when it was struck."""
    loops = {loop.name: loop for loop in telemetry.loops}
    return all(
        loops[name].mode == (before[name] if end in STAYING else end)
        and (end != WAITS or loops[name].waits_for)
        for name, end in entry.others
    )


def went_on(rig, entry, struck_s):
    """The other loops that stay have stayed all the time; how far the stars were that are held, RMS in px."""
    for name, end in entry.others:
        changes = [
            change
            for telemetry in rig.telemetry
            for change in telemetry.mode_changes
            if change.loop == name and change.time_s > struck_s
        ]
        assert end not in STAYING or not changes, f"{name}: {changes}"
    held_px = {
        name: round(rig.residual_px(name, struck_s), 4)
        for name, end in entry.others
        if end == HOLDS
    }
    assert all(rms_px <= requirement_px(rig, name) for name, rms_px in held_px.items()), held_px
    return {"held_px": held_px} if held_px else {}


def said(telemetry, since_s):
    """All that a message tells people of what has happened since."""
    yield from (event.message for event in telemetry.events if event.time_s >= since_s)
    yield from (change.reason for change in telemetry.mode_changes if change.time_s >= since_s)
    yield from (
        trip.name for loop in telemetry.loops for trip in loop.interlocks if trip.since_s >= since_s
    )


def ticks_went_on(rig, stalled):
    """No frame is without its tick, but for those of a stall and those counted as skipped for a newer one."""
    ticks = [tick for t in rig.telemetry for tick in t.ticks if tick.number >= 0]
    missing = 0
    if ticks:
        # The count begins anew when the camera is opened again.
        skipped = sum(max(0, b.frames_skipped - a.frames_skipped) for a, b in pairwise(ticks))
        missing = ticks[-1].number - ticks[0].number + 1 - len(ticks) - skipped
    excused = FRAMES_PER_S * (stalled.total_s + supervisor_stalled_s(rig))
    assert missing <= 1 + excused, f"{missing} frames without a tick"


def rests(rig, _entry, since_s, stalled):
    """Without a supervisor the stages come to rest by themselves; how long that took."""
    end_s = time.monotonic() + DEAD_SETTLE_S + SETTLE_S
    while time.monotonic() < end_s + stalled.total_s:
        time.sleep(0.02)
        rig.look()
    last = rig.places[-1]
    assert all(abs(v - BIAS_V) < STILL_V for v in last.stack_v), last
    moving = [place.time_s for place in rig.places if not near(place, last)]
    took_s = max(moving, default=since_s) - since_s
    assert took_s <= DEAD_SETTLE_S + stalled.total_s, took_s
    return {"took_s": round(took_s, 3)}


def came_back_by_itself(rig, loop, since_s):
    """A loop that lost its star gave the search up neither while the star was away nor afterwards."""
    changes = [
        c for t in rig.telemetry for c in t.mode_changes if c.time_s > since_s and c.loop == loop
    ]
    assert not {c.target for c in changes} & REST, changes


def near(place, other):
    return all(
        abs(a - b) < most
        for mine, theirs, most in (
            (place.motor_rad, other.motor_rad, STILL_RAD),
            (place.stack_v, other.stack_v, STILL_V),
        )
        for a, b in zip(mine, theirs, strict=True)
    )


def stood_still(rig, entry, struck_s, deaf):
    """Nothing moved in a mode of rest but the mirror, towards its bias."""
    changes = {
        c.time_s: c.target for t in rig.telemetry for c in t.mode_changes if c.loop == entry.loop
    }
    course = [(struck_s, entry.mode), *sorted(changes.items()), (time.monotonic(), "")]
    if deaf:
        course = [
            (struck_s + DEAD_SETTLE_S, "SAFE"),
            *[c for c in course if c[0] > struck_s + DEAD_SETTLE_S],
        ]
    for (since_s, mode), (until_s, _) in pairwise(course):
        places = [p for p in rig.places if since_s + SETTLE_S < p.time_s < until_s]
        if mode in REST and places:
            check_still(places)


def check_still(places):
    first = places[0]
    for place in places:
        for was_rad, is_rad in zip(first.motor_rad, place.motor_rad, strict=True):
            assert abs(is_rad - was_rad) < STILL_RAD, (first, place)
        for was_v, is_v in zip(first.stack_v, place.stack_v, strict=True):
            low_v, high_v = sorted((was_v, BIAS_V))
            assert low_v - STILL_V < is_v < high_v + STILL_V, (first, place)
