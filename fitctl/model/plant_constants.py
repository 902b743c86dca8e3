"""Numbers of one loop's plant, from its rig file: what a step needs."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, AirPath, ConfigError, Rig
from fitctl.model import air_path, hysteresis, structure
from fitctl.model.compiled import record
from fitctl.model.optics import scales

Floats = NDArray[np.float64]
_SIZED_BY_RIG = {"play_half_v", "play_gain_m_per_v", "air", "spot_origin_px"}


class AirConstants(NamedTuple):
    """Numbers of the air path: from node to node, and between two.

    Attributes
    ----------
    transition, noise_gain : arrays, shape (2, 2)
    weights : array, shape (steps, 4)
    initial : array, shape (2, 2)
        A root of the stationary covariance.
    relative : float
        Motion that a spot has of its own, over the motion that all share.
    """

    transition: Floats
    noise_gain: Floats
    weights: Floats
    initial: Floats
    relative: float


@dataclass(frozen=True)
class PlantConstants:
    """Numbers of one step."""

    step_s: float
    amplifier_decay: float
    amplifier_lag_s: float
    backlash_half_rad: float
    play_half_v: Floats
    play_gain_m_per_v: Floats
    bias_v: float
    mid_stroke_m: float
    stack_radius_m: float
    mode_shape: Floats
    mode_transition: Floats
    mode_gain: Floats
    participation: float
    air: AirConstants
    sky_px_per_rad: float
    motor_px_per_rad: float
    mirror_px_per_rad: float
    siderostat_turn: Floats
    mirror_turn: Floats
    spot_origin_px: Floats = field(repr=False)

    @functools.cached_property
    def packed(self) -> NDArray[np.void]:
        """All of it but the arrays whose size depends on the rig, for compiled code; shape (1,)."""
        values = vars(self).items()
        return record({name: value for name, value in values if name not in _SIZED_BY_RIG})[None]


def plant_constants(rig: Rig, loop_name: str, star_offset_px: Floats) -> PlantConstants:
    """Numbers of one step of a rig's loop; `star_offset_px` has shape (runs, 2).

    Raises
    ------
    ConfigError
        If no stack has the hysteresis that the rig asks for.
    """
    truth, _ = rig.mock_parts()
    loop, plant = rig.stellar_loops[loop_name], truth.stellar_loops[loop_name]
    scale = scales(rig, loop)
    lag_s = 1 / (2 * np.pi * plant.amplifier_bandwidth_hz)
    try:
        gains = hysteresis.stack_gains(plant.hysteresis, loop.fsm)
    except ValueError as error:
        msg = f"plant.loops.{loop_name}.hysteresis: {error}"
        raise ConfigError(msg) from None
    half_v = hysteresis.half_widths_v(plant.hysteresis)
    transition, gain = structure.mode_matrices(plant.structure, truth.step_s)
    target = np.array([loop.target_px.az, loop.target_px.el])
    spot_offset = np.array([[spot.offset_px.az, spot.offset_px.el] for spot in plant.spots])
    backlash_rad = plant.backlash_sky_arcsec / ARCSEC_PER_RAD / scale.motor_sky_rad_per_rad
    return PlantConstants(
        step_s=truth.step_s,
        amplifier_decay=float(np.exp(-truth.step_s / lag_s)),
        amplifier_lag_s=lag_s,
        backlash_half_rad=backlash_rad / 2,
        play_half_v=half_v,
        play_gain_m_per_v=gains,
        bias_v=loop.fsm.bias_v,
        # Where a stack rests that came up from zero to its bias: the mirror's zero.
        mid_stroke_m=float(hysteresis.raised_displacement(loop.fsm.bias_v, half_v, gains)),
        stack_radius_m=loop.fsm.stack_radius_m,
        mode_shape=structure.mode_shapes(plant.structure),
        mode_transition=transition,
        mode_gain=gain,
        participation=plant.structure.participation,
        air=air_constants(plant.air_path, truth.step_s),
        sky_px_per_rad=scale.sky_px_per_rad,
        motor_px_per_rad=scale.motor_px_per_rad,
        mirror_px_per_rad=scale.mirror_px_per_rad,
        siderostat_turn=scale.siderostat_turn,
        mirror_turn=scale.mirror_turn,
        spot_origin_px=target + star_offset_px[:, None, :] + spot_offset,
    )


def air_constants(air: AirPath, step_s: float) -> AirConstants:
    """Numbers of the air path on a grid of `step_s`."""
    steps = air_path.steps_per_node(step_s)
    transition, noise_gain = air_path.step_matrices(air, steps * step_s)
    rms_px = air_path.rms_px(air)
    return AirConstants(
        transition=transition,
        noise_gain=noise_gain,
        weights=air_path.bridge_weights(steps, step_s),
        # The least that lets still air, whose covariance is zero, through.
        initial=np.asarray(
            np.linalg.cholesky(air_path.stationary_covariance(air) + 1e-300 * np.eye(2))
        ),
        relative=air.relative_rms_px / rms_px if rms_px > 0 else 0.0,
    )
