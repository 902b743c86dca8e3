"""Numbers of one loop's plant, from its rig file: what a step needs."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, AirPath, AirPathModel, ConfigError, Fsm, Rig
from fitctl.config.plant import Hysteresis, LoopPlant
from fitctl.model import air_path, hysteresis, structure
from fitctl.model.compiled import record
from fitctl.model.lines import line_table
from fitctl.model.optics import scales, stage_turn, star_rate_px_s

Floats = NDArray[np.float64]
CREEP_TIMES_S = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Creep grows with the logarithm of time from the first of these to the last."""
_SIZED_BY_RIG = {"play_half_v", "play_gain_m_per_v", "air", "epochs", "spot_origin_px"}


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


class Epoch(NamedTuple):
    """What of a loop's plant the rig file's timeline may change, from a node of the air path on.

    Attributes
    ----------
    from_node : int
    air : AirConstants
        Its `initial` and `relative` are for the first epoch only: a spot's own motion changes in proportion.
    lines : array, shape (lines, FIELDS)
        :func:`fitctl.model.lines.line_table`.
    play_gain_m_per_v : array, shape (elements,)
    """

    from_node: int
    air: AirConstants
    lines: Floats
    play_gain_m_per_v: Floats


@dataclass(frozen=True)
class PlantConstants:
    """Numbers of one step; `air` and `play_gain_m_per_v` are those of the first epoch."""

    step_s: float
    amplifier_decay: float
    amplifier_lag_s: float
    backlash_half_rad: float
    play_half_v: Floats
    play_gain_m_per_v: Floats
    bias_v: float
    mid_stroke_m: float
    creep_per_decade: float
    creep_steps: int
    creep_kept: Floats
    stack_radius_m: float
    mode_shape: Floats
    mode_transition: Floats
    mode_gain: Floats
    participation: float
    air: AirConstants
    epochs: tuple[Epoch, ...]
    star_rate_px_s: Floats
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

    @property
    def beginning_lines(self) -> Floats:
        """All lines of all epochs as they begin, shape (lines, FIELDS)."""
        most = max((epoch.lines for epoch in self.epochs), key=len)
        begins = [
            next(epoch.lines[line] for epoch in self.epochs if len(epoch.lines) > line)
            for line in range(len(most))
        ]
        return np.array(begins).reshape(most.shape)


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
    epochs = _epochs(rig, loop_name)
    gains = epochs[0].play_gain_m_per_v
    half_v = hysteresis.half_widths_v(plant.hysteresis)
    transition, gain = structure.mode_matrices(plant.structure, truth.step_s)
    target = np.array([loop.target_px.az, loop.target_px.el])
    spot_offset = np.array([[spot.offset_px.az, spot.offset_px.el] for spot in plant.spots])
    backlash_rad = (
        plant.backlash_sky_arcsec / ARCSEC_PER_RAD / loop.siderostat.sky_rad_per_motor_rad
    )
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
        creep_per_decade=plant.hysteresis.creep_per_decade,
        creep_steps=len(epochs[0].air.weights),
        creep_kept=np.exp(-truth.step_s / np.array(CREEP_TIMES_S)),
        stack_radius_m=loop.fsm.stack_radius_m,
        mode_shape=structure.mode_shapes(plant.structure),
        mode_transition=transition,
        mode_gain=gain,
        participation=plant.structure.participation,
        air=epochs[0].air,
        epochs=epochs,
        star_rate_px_s=star_rate_px_s(plant.star_rate_sky_arcsec_s, scale),
        sky_px_per_rad=scale.sky_px_per_rad,
        motor_px_per_rad=scale.motor_px_per_rad,
        mirror_px_per_rad=scale.mirror_px_per_rad,
        siderostat_turn=stage_turn(
            loop.siderostat.rotation_deg, plant.siderostat_axis_gains or loop.siderostat.axis_gains
        ),
        mirror_turn=stage_turn(loop.fsm.rotation_deg, plant.fsm_axis_gains or loop.fsm.axis_gains),
        spot_origin_px=target + star_offset_px[:, None, :] + spot_offset,
    )


def _epochs(rig: Rig, loop_name: str) -> tuple[Epoch, ...]:
    """What a loop's plant is at the start, and after each change of the timeline."""
    truth, _ = rig.mock_parts()
    plant, fsm = truth.stellar_loops[loop_name], rig.stellar_loops[loop_name].fsm
    epochs = [_epoch(0, f"plant.loops.{loop_name}", plant, fsm, truth.step_s)]
    node_s = truth.step_s * air_path.steps_per_node(truth.step_s)
    for at_s, change in truth.changes(loop_name):
        # An empty list of lines is a change, too.
        plant = plant.model_copy(
            update={
                name: value
                for name, value in (
                    ("air_path", _changed_air(plant.air_path, change.air_path)),
                    ("hysteresis", _changed_loop(plant.hysteresis, change.loop_width_fraction)),
                    ("lines", change.lines),
                )
                if value is not None
            }
        )
        place = f"plant.timeline at {at_s:g} s: loops.{loop_name}"
        epochs.append(_epoch(round(at_s / node_s), place, plant, fsm, truth.step_s))
    return tuple(epochs)


def _changed_air(air: AirPath, change: AirPathModel | None) -> AirPath | None:
    return None if change is None else air.model_copy(update=change.model_dump())


def _changed_loop(stack: Hysteresis, width: float | None) -> Hysteresis | None:
    return None if width is None else stack.model_copy(update={"loop_width_fraction": width})


def _epoch(from_node: int, place: str, plant: LoopPlant, fsm: Fsm, step_s: float) -> Epoch:
    try:
        gains = hysteresis.stack_gains(plant.hysteresis, fsm)
    except ValueError as error:
        msg = f"{place}.hysteresis: {error}"
        raise ConfigError(msg) from None
    return Epoch(from_node, air_constants(plant.air_path, step_s), line_table(plant.lines), gains)


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
            np.linalg.cholesky(air_path.stationary_covariance(air) + 1e-300 * np.eye(2)), float
        ),
        relative=air.relative_rms_px / rms_px if rms_px > 0 else 0.0,
    )
