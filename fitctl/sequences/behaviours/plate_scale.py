"""Plate scale and rotation: how mirror and siderostat each move the star, as two 2x2 matrices.

Each stage swings along each axis by itself. Over the way back and forth the star follows but for a play's or
a hysteresis loop's half width, whose sign is that of the motion; frames just after a reversal, where the
play is not taken up, are left out. What is slower than the swings (air, drift) is fitted away.

In the fragment, scale, rotation and `axis_gains` of a stage multiply to the measured matrix, whatever the rig
file had before.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Fsm, Loop, Rig
from fitctl.controllers.mirror import Mirror
from fitctl.model.drives import FSM, SIDEROSTAT, Drive, channel_values
from fitctl.model.optics import Scales, gains_of, scales
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import Calibration, Result
from fitctl.sequences.behaviours.open_loop import open_loop, watched
from fitctl.sequences.view import Figures, StepFailed, View
from fitctl.stages.injector import stack_v_per_px

Floats = NDArray[np.float64]
SWING_HZ = 0.8  # above most of the air path, below where a stage lags
PAUSE_S = 1.0
_SLOW_HZ = 0.35
_MODEL_PERIOD_S = 0.02
_TAKEN_UP = 0.4  # of the amplitude, after a reversal
_LEAST_GAIN = 0.2  # of the rig file's: less, and a stage does not move the star along an axis
_LEAST_FRAMES = 200
_SIGMAS = 3.0
_LEAST_DIFFERENCE = 0.02  # of gains: less may be the stacks', whose hysteresis differs


class Swing(NamedTuple):
    """One channel's motion at each frame, shape (n,): in px by the rig file's scale, and its direction.

    The pixels are along the stage's own axes, before rotation and `axis_gains`. The direction is 0 where the
    channel rests, and NaN where a play may not be taken up.
    """

    moved_px: Floats
    direction: Floats


class PlateScaleFit(NamedTuple):
    """What the stages do; rows are the star's az and el, columns the stage's.

    Attributes
    ----------
    mirror, siderostat : array, shape (2, 2)
        Star's motion over what the rig file's scale says. If the rig file is right, this is its rotation times
        its `axis_gains`.
    mirror_sd, siderostat_sd : array, shape (2, 2)
    residual_px : float
        RMS of what is left.
    """

    mirror: Floats
    siderostat: Floats
    mirror_sd: Floats
    siderostat_sd: Floats
    residual_px: float


def plan(step: steps.PlateScale, _rig: Rig, _loop_name: str) -> list[Drive]:
    """Mirror az, mirror el, siderostat az, siderostat el, one after the other."""
    cycles = max(1, round(step.duration_s * SWING_HZ))
    duration_s = cycles / SWING_HZ
    return [
        Drive(
            channel=channel,
            shape="sine",
            amplitude=step.amplitude_px,
            frequency_hz=SWING_HZ,
            start_s=number * (duration_s + PAUSE_S),
            duration_s=duration_s,
        )
        for number, channel in enumerate((*FSM, *SIDEROSTAT))
    ]


def swing_of(drive: Drive, since_s: Floats, moved_px: Floats | None = None) -> Swing:
    """A channel's motion at `since_s` from the experiment's start; `moved_px` where it was measured."""
    phase = 2 * math.pi * drive.frequency_hz * (since_s - drive.start_s)
    inside = (since_s >= drive.start_s) & (since_s < drive.start_s + drive.duration_s)
    part = np.sin(phase)
    direction = np.sign(np.cos(phase))
    # Rising, it comes from -1; falling, from +1. Before the first reversal nobody knows.
    direction[part * direction < _TAKEN_UP - 1] = np.nan
    direction[phase < 2 * math.pi] = np.nan
    wanted_px = np.where(inside, drive.amplitude * part, 0.0)
    moved = wanted_px if moved_px is None else moved_px
    return Swing(moved, np.where(inside, direction, 0.0))


def fit_plate_scale(time_s: Floats, star_px: Floats, swings: list[Swing]) -> PlateScaleFit:
    """Solve for both matrices.

    Parameters
    ----------
    time_s : array, shape (n,)
    star_px : array, shape (n, 2)
    swings : list of Swing
        Mirror az, mirror el, siderostat az, siderostat el.

    Raises
    ------
    StepFailed
        If there are too few frames.
    """
    good = np.isfinite(star_px).all(axis=1)
    for swing in swings:
        good &= np.isfinite(swing.direction)
    if np.count_nonzero(good) < _LEAST_FRAMES:
        msg = (
            f"{np.count_nonzero(good)} frames show the star in full motion; expected at least "
            f"{_LEAST_FRAMES}; use a longer duration_s"
        )
        raise StepFailed(msg)
    part = (time_s[good] - time_s[0]) / (time_s[-1] - time_s[0])
    slow = np.arange(2 * _SLOW_HZ * (time_s[-1] - time_s[0]) + 1)
    design = np.column_stack(
        [
            *(swing.moved_px[good] for swing in swings),
            *(swing.direction[good] for swing in swings),
            np.cos(np.pi * part[:, None] * slow),
        ]
    )
    solution, *_ = np.linalg.lstsq(design, star_px[good], rcond=None)
    left_px = star_px[good] - design @ solution
    # What is left is correlated: it counts once a swing, not once a frame.
    blocks = (time_s[good] * SWING_HZ).astype(int)
    inverse = np.linalg.pinv(design.T @ design)
    deviation = np.empty((len(swings), 2))
    for axis in range(2):
        scores = np.array(
            [
                design[blocks == block].T @ left_px[blocks == block, axis]
                for block in np.unique(blocks)
            ]
        )
        covariance = inverse @ (scores.T @ scores) @ inverse
        deviation[:, axis] = np.sqrt(np.diag(covariance)[: len(swings)])
    matrix = solution[: len(swings)].T.astype(np.float64)
    return PlateScaleFit(
        mirror=matrix[:, :2],
        siderostat=matrix[:, 2:],
        mirror_sd=deviation[:2].T,
        siderostat_sd=deviation[2:].T,
        residual_px=float(np.sqrt(np.mean(left_px**2))),
    )


def refusal(fit: PlateScaleFit, step: steps.PlateScale, scale: Scales) -> str:
    """Why a fit is not believed beside the rig file's `scale`, or nothing."""
    if not fit.residual_px <= step.max_residual_px:
        return f"{fit.residual_px:.3f} px RMS are unexplained; max_residual_px is {step.max_residual_px:g}"
    for name, matrix, deviation, back in (
        ("mirror", fit.mirror, fit.mirror_sd, scale.mirror_back),
        ("siderostat", fit.siderostat, fit.siderostat_sd, scale.siderostat_back),
    ):
        if not deviation.max() <= step.max_error:
            return (
                f"{name}: a scale is uncertain by {deviation.max():.3f}; max_error is {step.max_error:g}; "
                "use a longer duration_s or a larger amplitude_px"
            )
        if np.linalg.svd(matrix, compute_uv=False)[-1] < _LEAST_GAIN:
            return f"{name}: does not move the star along both axes; look at its wiring and its amplifiers"
        turned_deg, mirrored = rotation_deg(back @ matrix), np.linalg.det(matrix) < 0
        if abs(turned_deg) > step.max_rotation_deg or mirrored:
            return (
                f"{name}: turned by {turned_deg:+.1f} deg from the rig file's rotation_deg"
                f"{', and mirrored' if mirrored else ''}; max_rotation_deg is {step.max_rotation_deg:g}; "
                "look at its wiring and the camera's mount"
            )
    return ""


def rotation_deg(matrix: Floats) -> float:
    """By how much a matrix, shape (2, 2), turns from azimuth towards elevation."""
    (az_az, az_el), (el_az, el_el) = matrix.tolist()
    return math.degrees(math.atan2(el_az - az_el, az_az + el_el))


def scale_of(matrix: Floats) -> float:
    """Scale of a matrix, shape (2, 2): the square root of its determinant's magnitude."""
    return math.sqrt(abs(float(np.linalg.det(matrix))))


def axis_gains(
    matrix: Floats, deviation: Floats, scale: float, before: list[list[float]] | None
) -> list[list[float]] | None:
    """What remains of a matrix, shape (2, 2), after its rotation and scale: row by row, or None.

    Parameters
    ----------
    matrix, deviation : array, shape (2, 2)
    scale : float
        The part that the stage's scalar key carries.
    before : list of lists, or None
        The rig file's `axis_gains`. The result replaces them, even by the identity. Without them, the result
        is None if it differs too little from the identity.
    """
    gains = gains_of(matrix / scale, rotation_deg(matrix))
    surely = max(_LEAST_DIFFERENCE, _SIGMAS * float(deviation.max()))
    if before is None and np.abs(np.array(gains) - np.eye(2)).max() < surely:
        return None
    return gains


def rotation_sd_deg(matrix: Floats, deviation: Floats) -> float:
    """Standard deviation of :func:`rotation_deg`, from those of the matrix's elements."""
    (az_az, az_el), (el_az, el_el) = matrix.tolist()
    cos, sin = az_az + el_el, el_az - az_el
    (sd_az_az, sd_az_el), (sd_el_az, sd_el_el) = deviation.tolist()
    across = math.hypot(cos * sd_az_el, cos * sd_el_az, sin * sd_az_az, sin * sd_el_el)
    return math.degrees(across / (cos**2 + sin**2))


def modelled_px(fsm: Fsm, drives: list[Drive], since_s: Floats, px_per_rad: float) -> Floats:
    """Motion of a mirror of known hysteresis along its axes, shape (n, 2), `since_s` from the start.

    Eq. 1 alone would make the scale depend on the amplitude: on the mocks, 0.87 at 1 px and 1.12 at 5 px.
    """
    mirror = Mirror(fsm)
    v_per_px = stack_v_per_px(fsm.stack_radius_m, fsm.stack_scale_m_per_v, px_per_rad)
    end_s = max(drive.start_s + drive.duration_s for drive in drives if drive.channel in FSM)
    times_s = np.arange(0.0, end_s + 2 * _MODEL_PERIOD_S, _MODEL_PERIOD_S)
    moved_px = np.empty((len(times_s), 2))
    for row, time_s in enumerate(times_s.tolist()):
        volts = fsm.bias_v + v_per_px @ channel_values(drives, FSM, time_s)
        mirror.written(np.clip(volts, 0.0, fsm.dac.full_scale_v))
        moved_px[row] = px_per_rad * mirror.angles_rad
    return np.column_stack([np.interp(since_s, times_s, axis_px) for axis_px in moved_px.T])


def _evaluate(step: steps.PlateScale, view: View, drives: list[Drive]) -> Result:
    frames, figures = watched(view, drives)
    scale = scales(view.rig, view.settings)
    since_s = frames[:, 0] - view.marks[0]
    # Along the siderostat's own axes: what they are on the frame is what is asked.
    motor_px = (frames[:, 5:7] - np.median(frames[:, 5:7], axis=0)) * scale.motor_px_per_rad
    mirror_px: list[Floats | None] = [None, None]
    if view.settings.fsm.hysteresis is not None:
        mirror_px = [*modelled_px(view.settings.fsm, drives, since_s, scale.mirror_px_per_rad).T]
    swings = [
        swing_of(drive, since_s, moved_px)
        for drive, moved_px in zip(drives, [*mirror_px, *motor_px.T], strict=True)
    ]
    fit = fit_plate_scale(frames[:, 0], frames[:, 1:3], swings)
    why_not = refusal(fit, step, scale)
    if why_not:
        raise StepFailed(why_not)
    stages = (
        ("fsm", fit.mirror, fit.mirror_sd, scale.mirror_px_per_rad, scale.mirror_turn),
        (
            "siderostat",
            fit.siderostat,
            fit.siderostat_sd,
            scale.motor_px_per_rad,
            scale.siderostat_turn,
        ),
    )
    found_lines = []
    for name, matrix, deviation, px_per_rad, expected in stages:
        found = _in_figures(name, matrix, deviation, px_per_rad, expected)
        figures |= found
        found_lines.append(
            f"{name} {found[f'{name}_scale']:.3f} of the rig file's, turned by "
            f"{found[f'{name}_rotation_deg']:+.2f} +- {found[f'{name}_rotation_sd_deg']:.2f} deg"
        )
    figures["residual_px"] = fit.residual_px
    tables, scale_lines = corrections(view.settings, fit)
    found_lines += [
        f"{name}: axis_gains {table['axis_gains']}"
        for name, table in tables.items()
        if "axis_gains" in table
    ]
    fragment = {"loops": {view.loop_name: tables}}
    lines = [*found_lines, *scale_lines]
    calibration = Calibration(f"{view.loop_name}-plate-scale", lines, fragment, {})
    return Result(figures, "; ".join(found_lines), calibration)


def corrections(loop: Loop, fit: PlateScaleFit) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Tables of both stages that give the rig file the fit's matrices, and lines on their scales."""
    fsm, siderostat = loop.fsm, loop.siderostat
    mirror_scale, siderostat_scale = scale_of(fit.mirror), scale_of(fit.siderostat)
    found: dict[str, dict[str, Any]] = {"siderostat": {}, "fsm": {}}
    found["siderostat"]["ball_screw_m_per_rad"] = siderostat.ball_screw_m_per_rad * siderostat_scale
    lines = ["ball_screw_m_per_rad includes the siderostat's scale"]
    if fsm.hysteresis is None:
        found["fsm"]["beam_per_mirror"] = fsm.beam_per_mirror * mirror_scale
        lines.append("beam_per_mirror includes the mirror's scale")
    else:
        mirror_scale = 1.0  # of beam_per_mirror
    for name, matrix, deviation, scale, before in (
        ("siderostat", fit.siderostat, fit.siderostat_sd, siderostat_scale, siderostat.axis_gains),
        ("fsm", fit.mirror, fit.mirror_sd, mirror_scale, fsm.axis_gains),
    ):
        found[name]["rotation_deg"] = round(rotation_deg(matrix), 3)
        gains = axis_gains(matrix, deviation, scale, before)
        if gains is not None:
            found[name]["axis_gains"] = gains
    if fsm.hysteresis is not None:
        lines.append(
            "the mirror's axis_gains include its scale; beam_per_mirror is unchanged"
            if "axis_gains" in found["fsm"]
            else "the mirror's scale agrees with fsm.hysteresis; beam_per_mirror is unchanged"
        )
    return found, lines


def _in_figures(
    name: str, matrix: Floats, deviation: Floats, px_per_rad: float, expected: Floats
) -> Figures:
    (az_az, az_el), (el_az, el_el) = (matrix * px_per_rad).tolist()
    return {
        f"{name}_az_px_per_az_rad": az_az,
        f"{name}_az_px_per_el_rad": az_el,
        f"{name}_el_px_per_az_rad": el_az,
        f"{name}_el_px_per_el_rad": el_el,
        f"{name}_scale": scale_of(matrix) / scale_of(expected),
        f"{name}_scale_sd": float(deviation.max()),
        f"{name}_rotation_deg": rotation_deg(matrix),
        f"{name}_rotation_sd_deg": rotation_sd_deg(matrix, deviation),
    }


PLATE_SCALE = {"plate_scale": open_loop(plan, lambda _step: "plate_scale", _evaluate)}
