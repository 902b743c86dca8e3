"""What the rig file and a design predict for a loop's error, for its error budget."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from fitctl.config import Rig
from fitctl.controllers.design.basis import Basis, basis, basis_of, night_of
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.linear_loop.loopshape import sampled_response
from fitctl.controllers.design.linear_loop.spectrum import framed_px2_per_hz
from fitctl.controllers.design.margins import frequencies_hz
from fitctl.controllers.feedforward import link_matrix
from fitctl.controllers.pair import Design
from fitctl.error_budget import LoopTheory
from fitctl.model.optics import scales

_QUICKER = 20
"""So many times the frame rate stands for a loop without hold."""


def loop_theory(rig: Rig, loop_name: str, design: Design) -> LoopTheory:
    """Sensitivity, disturbance and scales of a rig's loop with a design.

    A learnt design expects the night that it was made for, every other design that of the rig file.

    Raises
    ------
    ConfigError
        If the rig file knows of no disturbance.
    """
    loop = rig.stellar_loops[loop_name]
    its_basis = night_of(design, basis(rig, loop_name))
    scale = scales(rig, loop)
    frequency_hz = frequencies_hz(its_basis)
    omega_rad_s = 2 * math.pi * frequency_hz
    quick = _without_delay_and_hold(its_basis)
    motor_px_per_rad = scale.motor_px(np.eye(2)).T
    link_px_per_rad, link_backlash_rad = np.zeros((2, 2)), math.nan
    if loop.link is not None:
        link = rig.loops[loop.link].siderostat
        matrix = np.eye(2) if loop.feedforward is None else loop.feedforward.matrix
        link_px_per_rad = motor_px_per_rad @ link_matrix(
            1.0, matrix, link.sky_rad_per_motor_rad, loop.siderostat.sky_rad_per_motor_rad
        )
        link_backlash_rad = _half_width_rad(link.backlash_sky_arcsec, link.sky_arcsec_per_motor_rad)
    sensitivity = 1 / (1 + sampled_response(design, its_basis)(omega_rad_s))
    undelayed = np.abs(sensitivity)
    if not design.own:  # of matrices without a maker, what delay and hold cost counts as air
        quick_basis = basis_of(design.parameters, quick)
        quick_design = DESIGNS[design.name](
            dataclasses.replace(quick_basis, noise_px=quick.noise_px)
        )
        undelayed = 1 / np.abs(1 + sampled_response(quick_design, quick)(omega_rad_s))
    return LoopTheory(
        frequency_hz=frequency_hz,
        sensitivity=sensitivity,
        undelayed=undelayed,
        disturbance_px2_per_hz=framed_px2_per_hz(its_basis, frequency_hz),
        noise_px=its_basis.noise_px,
        flux_dn=math.nan if design.learnt else loop.star_flux_dn,
        period_s=its_basis.period_s,
        mirror_px_per_rad=scale.mirror_px(np.eye(2)).T,
        motor_px_per_rad=motor_px_per_rad,
        hysteresis_known=loop.fsm.hysteresis is not None,
        backlash_rad=_half_width_rad(
            loop.siderostat.backlash_sky_arcsec, loop.siderostat.sky_arcsec_per_motor_rad
        ),
        link_px_per_rad=link_px_per_rad,
        link_backlash_rad=link_backlash_rad,
    )


def _without_delay_and_hold(its_basis: Basis) -> Basis:
    """The same star under a camera many times as fast, whose frames are used at once.

    A frame has less light then, and a centroid more noise, so that the noise in a second is the same.
    """
    return dataclasses.replace(
        its_basis,
        period_s=its_basis.period_s / _QUICKER,
        delay_s=0.0,
        noise_px=its_basis.noise_px * math.sqrt(_QUICKER),
    )


def _half_width_rad(backlash_sky_arcsec: float | None, sky_arcsec_per_rad: float) -> float:
    return math.nan if backlash_sky_arcsec is None else backlash_sky_arcsec / 2 / sky_arcsec_per_rad
