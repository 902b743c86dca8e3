"""What the stages did: range, piston, offload, and the hysteresis that their commands show."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.figures.attenuation import stacks_m
from fitctl.identify.record import axis_pair
from fitctl.logging.reading import Columns
from fitctl.model.hysteresis import half_widths_v, stack_gains
from fitctl.model.optics import piston_m, scales
from fitctl.report.selection import Selection

Floats = NDArray[np.float64]
_SAME_PLACE_PX = 0.02  # of the target
_PIECE = 100_000


class Stacks(NamedTuple):
    """The three stacks as a model has them for the logged voltages.

    Attributes
    ----------
    source : str
        Whose model.
    displacement_m : array, shape (ticks, 3)
        About where they rest at the bias.
    piston_m : array, shape (ticks,)
        Of the mirror, Eq. 4.
    """

    source: str
    displacement_m: Floats
    piston_m: Floats


class Dwell(NamedTuple):
    """A time during which the target stood still.

    Attributes
    ----------
    target_px, command_px : float
        Where it stood, and the mean of what both stages were commanded, as star motion.
    direction : int
        From where the target had come: 1 from below, -1 from above, 0 if this axis did not move.
    """

    target_px: float
    command_px: float
    direction: int


class Gap(NamedTuple):
    """Difference of the commands at one place of the target, come from below or from above: their hysteresis.

    Attributes
    ----------
    px, error_px : float
        Mean over all places that the target came to from both sides, and its standard error, which is mostly
        the air; nan without such places.
    dwells : list of Dwell
        All there were.
    """

    px: float
    error_px: float
    dwells: list[Dwell]


class Stages(NamedTuple):
    """One loop's stages in the frames that count, px of star motion where the name says so.

    Attributes
    ----------
    range_mean, range_worst : float
        Of the mirror's diamond.
    saturated_fraction : float
        Of the frames.
    piston_rms_m : float
        About its mean; nan without a model of the stacks.
    motor_moved_px : array, shape (2,)
        How far the siderostat's set-point came from first to last.
    gaps : list of Gap
        Of both axes.
    """

    range_mean: float
    range_worst: float
    saturated_fraction: float
    piston_rms_m: float
    motor_moved_px: Floats
    gaps: list[Gap]


def stacks(rig: Rig, loop_name: str, ticks: Columns) -> Stacks | None:
    """Displacements and piston by the rig's identified hysteresis, or a mock's own; None without either.

    Ideal stacks under Eq. 1 have no piston, so that without a model nothing is known.
    """
    fsm = rig.stellar_loops[loop_name].fsm
    if fsm.hysteresis is not None:
        source = f"the hysteresis in the rig file (loops.{loop_name}.fsm.hysteresis)"
        half_v = np.asarray(fsm.hysteresis.half_widths_v)
        gains = np.asarray(fsm.hysteresis.gains_m_per_v)
    elif rig.plant is not None:
        source = f"the mock's own hysteresis (plant.loops.{loop_name}.hysteresis)"
        settings = rig.plant.stellar_loops[loop_name].hysteresis
        half_v = half_widths_v(settings)
        gains = np.tile(stack_gains(settings, fsm), (3, 1))
    else:
        return None
    displacement_m = stacks_m(ticks, fsm, half_v, gains)
    # Piece by piece: its vectors would take ten times the room of what comes of them.
    pieces = np.array_split(displacement_m, 1 + len(displacement_m) // _PIECE)
    piston = np.concatenate([piston_m(piece, fsm.stack_radius_m) for piece in pieces])
    return Stacks(source, displacement_m, piston)


def motion_px(rig: Rig, loop_name: str, ticks: Columns) -> tuple[Floats, Floats, Floats]:
    """Mirror as commanded, siderostat measured and its set-point, as star motion, shape (ticks, 2) each.

    The siderostat's are from where its encoders were first.
    """
    scale = scales(rig, rig.stellar_loops[loop_name])
    mirror_rad, motor_rad, setpoint_rad = (
        axis_pair(ticks, name)
        for name in ("fsm_{}_rad", "siderostat_{}_rad", "siderostat_setpoint_{}_rad")
    )
    known = motor_rad[~np.isnan(motor_rad).any(axis=1)]
    zero_rad = known[0] if len(known) else np.zeros(2)
    return (
        scale.mirror_px(mirror_rad),
        scale.motor_px(motor_rad - zero_rad),
        scale.motor_px(setpoint_rad - zero_rad),
    )


def stages(
    rig: Rig, loop_name: str, ticks: Columns, selection: Selection, found: Stacks | None
) -> Stages:
    """The figures of the frames that are evaluated; nan without any."""
    mirror_px, _, setpoint_px = motion_px(rig, loop_name, ticks)
    rows, pieces = selection.rows, selection.pieces
    if len(rows) == 0:
        return Stages(math.nan, math.nan, math.nan, math.nan, np.full(2, math.nan), [])
    command_px = mirror_px + setpoint_px
    target_px = axis_pair(ticks, "target_{}_px")
    fraction = ticks["fsm_range_fraction"][rows]
    return Stages(
        range_mean=float(fraction.mean()),
        range_worst=float(fraction.max()),
        saturated_fraction=float(ticks["fsm_saturated"][rows].mean()),
        piston_rms_m=math.nan if found is None else float(found.piston_m[rows].std()),
        motor_moved_px=setpoint_px[rows[-1]] - setpoint_px[rows[0]],
        gaps=[_gap(_dwells(target_px[:, axis], command_px[:, axis], pieces)) for axis in range(2)],
    )


def _dwells(target_px: Floats, command_px: Floats, pieces: list[NDArray[np.intp]]) -> list[Dwell]:
    """Pieces end where the target moves (see :func:`fitctl.report.selection.select_frames`)."""
    found: list[Dwell] = []
    for piece in pieces:
        at_px = float(target_px[piece[-1]])
        came_px = at_px - found[-1].target_px if found else 0.0
        direction = 0 if abs(came_px) < _SAME_PLACE_PX else int(math.copysign(1, came_px))
        found.append(Dwell(at_px, float(command_px[piece].mean()), direction))
    return found


def _gap(dwells: list[Dwell]) -> Gap:
    places: dict[int, dict[int, list[float]]] = {}
    for dwell in dwells:
        if dwell.direction:
            place = places.setdefault(round(dwell.target_px / _SAME_PLACE_PX), {})
            place.setdefault(dwell.direction, []).append(dwell.command_px)
    both = [place for place in places.values() if len(place) == 2]
    if not both:
        return Gap(math.nan, math.nan, dwells)
    gaps_px = [float(np.mean(place[1]) - np.mean(place[-1])) for place in both]
    scatter = [np.array(its) - np.mean(its) for place in both for its in place.values()]
    spare = sum(len(its) - 1 for its in scatter)
    variance_px2 = float(np.sum(np.concatenate(scatter) ** 2)) / spare if spare else math.nan
    # Each gap is a difference of two means.
    share = sum(1 / len(its) for place in both for its in place.values())
    error_px = math.sqrt(variance_px2 * share) / len(both)
    return Gap(float(np.mean(gaps_px)), error_px, dwells)
