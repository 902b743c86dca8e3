"""Interlocks: limits that the sound rig would trip by itself, and limits that nothing could ever trip."""

from __future__ import annotations

from collections.abc import Iterator

from fitctl.config.conflict import Conflict, Part, above, at_least, below
from fitctl.config.interlocks import QUANTITIES, Interlock
from fitctl.config.rig import Rig

_Rows = dict[str, Interlock]


def interlock_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Of each row with what it watches; of several, the tightest comes first."""
    for check in (_age_of_frames, _age_of_piezo, _writes, _samples, _fractions, _following):
        yield from check(rig)


def _rows(rig: Rig, quantity: str) -> _Rows:
    return {name: row for name, row in rig.interlocks.items() if row.quantity == quantity}


def _age_of_frames(rig: Rig) -> Iterator[Conflict]:
    camera = rig.camera
    oldest_s = camera.frame_delay_s + 2 * camera.period_s
    rows = [
        (row.stale_s, name)
        for name, row in rig.interlocks.items()
        if QUANTITIES[row.quantity].every_frame
        and row.stale_s is not None
        and row.stale_s <= oldest_s
    ]
    for stale_s, name in sorted(rows):
        delay_s = stale_s - 2 * camera.period_s
        frames_s = stale_s - camera.frame_delay_s
        yield Conflict(
            "a frame is as old as its delay and two frame periods before the next one can replace it",
            (
                above(f"interlocks.{name}.stale_s", stale_s, oldest_s),
                below("camera.frame_delay_s", camera.frame_delay_s, delay_s),
                Part(
                    "camera.frame_rate_hz",
                    camera.frame_rate_hz,
                    above("", 0.0, 2 / frames_s).must_be if frames_s > 0 else "",
                ),
            ),
        )


def _age_of_piezo(rig: Rig) -> Iterator[Conflict]:
    for name, row in _rows(rig, "piezo_limit_error_v").items():
        for loop, settings in rig.stellar_loops.items():
            poll_s = settings.fsm.piezo.poll_s
            if row.stale_s is not None and row.stale_s <= poll_s:
                yield Conflict(
                    "the switch is read every poll_s, so the interlock would trip between two readings",
                    (
                        above(f"interlocks.{name}.stale_s", row.stale_s, poll_s),
                        below(f"loops.{loop}.fsm.piezo.poll_s", poll_s, row.stale_s),
                    ),
                )


def _writes(rig: Rig) -> Iterator[Conflict]:
    period_s = rig.camera.period_s
    for name, row in _rows(rig, "dac_unwritten_s").items():
        if row.high is not None and row.high <= period_s:
            yield Conflict(
                "the D/A is written once a frame, so the interlock would trip at every frame",
                (
                    above(f"interlocks.{name}.high", row.high, period_s),
                    Part(
                        "camera.frame_rate_hz",
                        rig.camera.frame_rate_hz,
                        above("", 0.0, 1 / row.high).must_be if row.high > 0 else "",
                    ),
                ),
            )


def _samples(rig: Rig) -> Iterator[Conflict]:
    for name, row in _rows(rig, "diode_sample_age_s").items():
        for loop, settings in rig.metrology_loops.items():
            delay_s = settings.sensor.link_delay_s
            if row.high is not None and row.high <= delay_s:
                yield Conflict(
                    "a sample is as old as that when it is used",
                    (
                        above(f"interlocks.{name}.high", row.high, delay_s),
                        below(f"loops.{loop}.sensor.link_delay_s", delay_s, row.high),
                    ),
                )


# (quantity, side): above or below 1, and what 1 is
_ABOUT_ONE = {
    ("star_flux_fraction", "low"): "below 1, the star itself",
    ("star_flux_fraction", "high"): "above 1, the star itself",
    ("beam_light_fraction", "low"): "below 1, the beam itself",
    ("beam_light_fraction", "high"): "above 1, the beam itself",
    ("frame_interval_periods", "low"): "below 1, one period",
    ("frame_interval_periods", "high"): "above 1, one period",
    ("fsm_range_fraction", "high"): "below 1, the end of the range",
    ("servo_skipped_fraction", "high"): "below 1, all periods",
    ("recorder_backlog_fraction", "high"): "below 1, the whole queue",
    ("amplifier_fault", "high"): "below 1, a fault",
    ("piezo_fault", "high"): "below 1, a fault",
    ("diode_saturated", "high"): "below 1, a saturated photodiode",
}


def _fractions(rig: Rig) -> Iterator[Conflict]:
    for (quantity, side), demand in _ABOUT_ONE.items():
        for name, row in _rows(rig, quantity).items():
            limit = getattr(row, side)
            if limit is None:
                continue
            holds = limit > 1 if demand.startswith("above") else limit < 1
            if not holds:
                part = Part(f"interlocks.{name}.{side}", limit, demand)
                yield Conflict("otherwise the interlock would trip always, or never", (part,))


def _following(rig: Rig) -> Iterator[Conflict]:
    """A limit above the servo's own is never reached: the servo has stopped before."""
    servos = {name: loop.siderostat.servo for name, loop in rig.loops.items()}
    loop = max(servos, key=lambda name: servos[name].following_error_limit_rad)
    limit_rad = servos[loop].following_error_limit_rad
    for name, row in _rows(rig, "following_error_rad").items():
        if row.high is not None and row.high > limit_rad:
            yield Conflict(
                "the servo stops at its own limit, so the interlock could never trip",
                (
                    below(f"interlocks.{name}.high", row.high, limit_rad),
                    at_least(
                        f"loops.{loop}.siderostat.servo.following_error_limit_rad",
                        limit_rad,
                        row.high,
                    ),
                ),
            )
