"""The collector bench: what the hexapod can do, and the motion that it is asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fitctl.config.collector import Collector
from fitctl.config.conflict import Conflict, Part, at_least, at_most
from fitctl.config.rig import Rig

_M850 = "M-850"
_M850_TRAVEL = {
    "x_mm": 50,
    "y_mm": 50,
    "z_mm": 25,
    "u_deg": 15,
    "v_deg": 15,
    "w_deg": 30,
}  # each way
_M850_VELOCITY_MM_S = 8.0


def collector_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Of the hexapod with the stage that it drives, and with its motion."""
    if rig.collector is None:
        return
    found = [*_hexapod(rig.collector), *_motion(rig.collector)]
    for conflict in found:
        yield conflict.under("collector")


def _hexapod(collector: Collector) -> Iterator[Conflict]:
    hexapod = collector.hexapod
    if not hexapod.stage.startswith(_M850):
        return
    stage = Part("hexapod.stage", hexapod.stage, "the stage that the controller has")
    for axis, most in _M850_TRAVEL.items():
        ends = getattr(hexapod.travel, axis)
        if max(map(abs, ends)) > most:
            yield Conflict(
                f"an {_M850} goes {most} each way",
                (Part(f"hexapod.travel.{axis}", ends, f"within -{most} and {most}"), stage),
            )
    if hexapod.velocity_limit_mm_s > _M850_VELOCITY_MM_S:
        key = "hexapod.velocity_limit_mm_s"
        yield Conflict(
            f"an {_M850} is not faster",
            (at_most(key, hexapod.velocity_limit_mm_s, _M850_VELOCITY_MM_S), stage),
        )


def _motion(collector: Collector) -> Iterator[Conflict]:
    """The motion as the rig file has it; the supervisor checks each course again before it moves."""
    motion, hexapod = collector.motion, collector.hexapod
    velocity = hexapod.velocity_limit_mm_s
    if motion.kind == "drift" and motion.velocity_mm_s > velocity:
        yield Conflict(
            "the hexapod is not to be faster",
            (
                at_most("motion.velocity_mm_s", motion.velocity_mm_s, velocity),
                at_least("hexapod.velocity_limit_mm_s", velocity, motion.velocity_mm_s),
            ),
        )
    fastest = 2 * math.pi * motion.frequency_hz * motion.amplitude_mm
    if motion.kind == "sine" and fastest > velocity:
        fits = velocity / fastest
        yield Conflict(
            f"the sine is {fastest:.4g} mm/s fast in its middle",
            (
                at_most("motion.amplitude_mm", motion.amplitude_mm, motion.amplitude_mm * fits),
                at_most("motion.frequency_hz", motion.frequency_hz, motion.frequency_hz * fits),
                at_least("hexapod.velocity_limit_mm_s", velocity, fastest),
            ),
        )
    for kinds, key in ((("drift", "random"), "range_mm"), (("sine",), "amplitude_mm")):
        way_mm = getattr(motion, key)
        if motion.kind in kinds and way_mm > (farthest_mm := _farthest_mm(collector)):
            yield Conflict(
                "the hexapod's travel is shorter",
                (at_most(f"motion.{key}", way_mm, farthest_mm),),
            )


def _farthest_mm(collector: Collector) -> float:
    """How far the motion's direction lets the hexapod go to either side, from the middle of its travel."""
    angle = math.radians(collector.motion.direction_deg)
    link, azimuth = collector.geometry.link, collector.geometry.link_azimuth
    elevation = [link[n - 2] * azimuth[n - 1] - link[n - 1] * azimuth[n - 2] for n in range(3)]
    ways_mm = [
        (high - low) / 2 / abs(part)
        for az, el, (low, high) in zip(
            azimuth, elevation, collector.hexapod.travel.ends, strict=False
        )
        if (part := math.cos(angle) * az + math.sin(angle) * el)
    ]
    return min(ways_mm)
