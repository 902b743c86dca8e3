"""Fast steering mirrors: D/A, piezo amplifier and stacks."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fitctl.config.addresses import BAUD_RATES
from fitctl.config.conflict import Conflict, Part, at_least, at_most
from fitctl.config.devices import Fsm
from fitctl.config.rig import Rig

_RTU_BITS = (23 + 7) * 11  # of a write of three registers, its answer, and the silences around them
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
    """Over RTU, the three registers must be written within a frame period."""
    dac, rate_hz = fsm.dac, rig.camera.frame_rate_hz
    needed = _RTU_BITS * rate_hz
    if dac.transport == "rtu" and dac.baud_rate < needed:
        enough = min((one for one in BAUD_RATES if one >= needed), default=0)
        yield Conflict(
            f"a write over RTU takes {_RTU_BITS / dac.baud_rate:.3g} s, longer than a frame period",
            (
                Part(f"{key}.baud_rate", dac.baud_rate, f"at least {enough}" if enough else ""),
                at_most("camera.frame_rate_hz", rate_hz, dac.baud_rate / _RTU_BITS),
                Part(f"{key}.transport", dac.transport, "tcp"),
            ),
        )
