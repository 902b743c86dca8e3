"""Which interlocks might trip in a run: the batch, which has none, refuses a rig that has one of them."""

from __future__ import annotations

import math

from fitctl.config import QUANTITIES, Rig
from fitctl.loop.quantities import metrology_places, stellar_places


def acting_interlocks(rig: Rig, loop_name: str) -> list[str]:
    """Interlocks of a loop that do more than warn, and that a simulated run without them might have tripped."""
    siderostat, camera = rig.loops[loop_name].siderostat, rig.camera
    rate_rad_s = siderostat.velocity_limit_rad_s
    count_rad = siderostat.encoder_count_rad
    truth, _ = rig.mock_parts()
    if loop_name in rig.metrology_loops:
        places = metrology_places(rig, loop_name)
        polled_s = truth.metrology_loops[loop_name].link_round_trip_s
    else:
        places = stellar_places(rig, loop_name)
        polled_s = rig.stellar_loops[loop_name].fsm.piezo.poll_s
    late_s = rig.true_camera.frame_delay_s - camera.frame_delay_s
    # How far each gets while nothing fails; its set-points are limited, and it counts in steps.
    reached = {
        "siderostat_travel_fraction": (0.0, 1 + 3 * count_rad / siderostat.travel_rad),
        "siderostat_rate_fraction": (0.0, 1 + count_rad / camera.period_s / rate_rad_s),
        "frame_late_s": (late_s - 1e-9, late_s + 1e-9),
        "frame_interval_periods": (0.999, 1.001),
        "dac_unwritten_s": (0.0, 2 * camera.period_s),
        "diode_sample_age_s": (0.0, polled_s + 3 * camera.period_s),
        **dict.fromkeys(
            (
                "amplifier_fault", "amplifier_round_trip_periods", "dac_round_trip_s",
                "piezo_fault", "piezo_limit_error_v", "tick_period_fraction",
            ),
            (0.0, 0.0),
        ),
    }  # fmt: skip
    oldest_s = max(camera.frame_delay_s, polled_s) + 2 * camera.period_s
    frames_s = camera.frame_delay_s + 2 * camera.period_s
    acting = []
    for name, row in rig.interlocks.items():
        low, high = reached.get(row.quantity, (-math.inf, math.inf))
        age_s = frames_s if QUANTITIES[row.quantity].every_frame else oldest_s
        in_range = (
            row.quantity in reached
            and (row.low is None or row.low <= low)
            and (row.high is None or row.high >= high)
            and (row.stale_s is None or row.stale_s >= age_s)
        )
        measured = QUANTITIES[row.quantity].part in places
        if measured and row.action != "warn" and not in_range:
            acting.append(name)
    return acting
