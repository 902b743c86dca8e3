"""Fast steering mirrors: D/A, piezo amplifier and stacks."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fitctl.config.addresses import BAUD_RATES
from fitctl.config.conflict import Conflict, Part, at_least, at_most
from fitctl.config.devices import MOST_WRITES, Fsm
from fitctl.config.rig import Rig

_RTU_BITS = (23 + 7) * 11  # of a write of three registers, its answer, and the silences around them
_LEAST_WRITE_S = 1e-3
_CLEAR_OF_EXPOSURE_S = 5e-4  # writes arrive up to so late
_MOST_SCALE_RATIO = (
    4.0  # between the stacks' identified stroke and the scale that fitctl moves them by
)


def mirror_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Of each loop's mirror."""
    for name, loop in rig.stellar_loops.items():
        found = [*_amplifier(loop.fsm), *_stacks(loop.fsm)]
        for conflict in found:
            yield conflict.under(f"loops.{name}.fsm")
        yield from _serial_line(rig, f"loops.{name}.fsm.dac", loop.fsm)
        yield from _writes(rig, f"loops.{name}.fsm.dac.writes_per_frame", loop.fsm)


def _amplifier(fsm: Fsm) -> Iterator[Conflict]:
    piezo = fsm.piezo
    high_v = fsm.bias_v + fsm.swing_v
    if high_v * piezo.gain > piezo.limit_v:
        most_v = piezo.limit_v / piezo.gain
        middle_v = math.floor(most_v / 2 * 100) / 100
        both = at_most("range_rad", fsm.range_rad, fsm.range_rad * middle_v / fsm.swing_v).must_be
        fits = (most_v - fsm.bias_v) / fsm.swing_v
        yield Conflict(
            f"{high_v:.4g} V at the D/A would be {high_v * piezo.gain:.4g} V at a stack; raise limit_v only if "
            "the stacks' data sheet allows it",
            (
                at_most("range_rad", fsm.range_rad, fsm.range_rad * fits),
                Part("bias_v", fsm.bias_v, f"{middle_v:g}, with range_rad {both}"),
                at_most("piezo.gain", piezo.gain, piezo.limit_v / high_v),
                at_least("piezo.limit_v", piezo.limit_v, high_v * piezo.gain),
            ),
        )
    if piezo.follow_tolerance_v >= piezo.limit_v / 2:
        yield Conflict(
            "a stack that does not follow would go unnoticed",
            (
                Part(
                    "piezo.follow_tolerance_v",
                    piezo.follow_tolerance_v,
                    f"below {piezo.limit_v / 2:g}, half of piezo.limit_v",
                ),
            ),
        )


def _stacks(fsm: Fsm) -> Iterator[Conflict]:
    if fsm.hysteresis is None:
        return
    scale = fsm.stack_scale_m_per_v
    for stack, gains in enumerate(fsm.hysteresis.gains_m_per_v, start=1):
        stroke = math.fsum(gains)
        if scale / _MOST_SCALE_RATIO <= stroke <= scale * _MOST_SCALE_RATIO:
            continue
        sums = f"gains with a sum {_about(scale)}"
        yield Conflict(
            f"stack {stack} moves {stroke:.4g} m/V by its identified gains; both must be of one mirror",
            (
                Part("stack_scale_m_per_v", scale, _about(stroke)),
                Part("hysteresis.gains_m_per_v", stroke, sums),
            ),
        )
        return


def _about(scale: float) -> str:
    return f"from {scale / _MOST_SCALE_RATIO:.3g} to {scale * _MOST_SCALE_RATIO:.3g}"


def _serial_line(rig: Rig, key: str, fsm: Fsm) -> Iterator[Conflict]:
    """Over RTU, the three registers must be written in the time that there is for a write."""
    dac, rate_hz = fsm.dac, rig.camera.frame_rate_hz * fsm.dac.writes_per_frame
    needed = _RTU_BITS * rate_hz
    if dac.transport == "rtu" and dac.baud_rate < needed:
        enough = min((one for one in BAUD_RATES if one >= needed), default=0)
        yield Conflict(
            f"a write over RTU takes {_RTU_BITS / dac.baud_rate:.3g} s, and the next is due after "
            f"{1 / rate_hz:.3g} s",
            (
                Part(f"{key}.baud_rate", dac.baud_rate, f"at least {enough}" if enough else ""),
                at_most(
                    "camera.frame_rate_hz",
                    rig.camera.frame_rate_hz,
                    dac.baud_rate / _RTU_BITS / dac.writes_per_frame,
                ),
                Part(f"{key}.transport", dac.transport, "tcp"),
            ),
        )


def _writes(rig: Rig, key: str, fsm: Fsm) -> Iterator[Conflict]:
    """Between two frames there must be time for each write, and none may come just as a frame is exposed."""
    writes, camera = fsm.dac.writes_per_frame, rig.camera
    if writes == 1:
        return
    every_s = camera.period_s / writes
    if every_s < _LEAST_WRITE_S:
        most = max(1, math.floor(camera.period_s / _LEAST_WRITE_S))
        yield Conflict(
            f"a write of the D/A every {every_s * 1e3:.3g} ms leaves the supervisor no time for the tick",
            (
                at_most(key, writes, most),
                at_most("camera.frame_rate_hz", camera.frame_rate_hz, 1 / writes / _LEAST_WRITE_S),
            ),
        )
    if _clear_s(camera.frame_delay_s, every_s) < _CLEAR_OF_EXPOSURE_S:
        free = [
            other
            for other in range(2, MOST_WRITES + 1)
            if camera.period_s / other >= _LEAST_WRITE_S
            and _clear_s(camera.frame_delay_s, camera.period_s / other) >= _CLEAR_OF_EXPOSURE_S
        ]
        yield Conflict(
            "a write of the D/A would come at mid-exposure, and the loop could not know what the frame shows",
            (
                Part(key, writes, f"one of {', '.join(map(str, [1, *free]))}"),
                at_most(
                    "camera.frame_delay_s",
                    camera.frame_delay_s,
                    round(camera.frame_delay_s / every_s) * every_s - _CLEAR_OF_EXPOSURE_S,
                ),
            ),
        )


def _clear_s(delay_s: float, every_s: float) -> float:
    """How far the nearest write is from a mid-exposure."""
    after_s = -delay_s % every_s
    return min(after_s, every_s - after_s)
