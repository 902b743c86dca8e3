"""The step that lays two loops' fringe spots on each other, by the target of one of the loops.

Two spots that lie on each other cannot be measured apart, so the target steps aside first. Each fringe spot is
measured from its own star on the same frame: neither the stars' motion nor the step itself enters.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, WINDOW_PX, Camera, Loop, Rig
from fitctl.config.loops import OtherSpot
from fitctl.controllers.centroid import OtherLight, StarSensor
from fitctl.controllers.visibility import mean_visibility, visibility
from fitctl.identify.slow_mean import SlowMean, slow_mean
from fitctl.logging.records import FrameRecord
from fitctl.messages.commands import SetTarget
from fitctl.messages.modes import Mode
from fitctl.model.optics import scales
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import Behaviour, Calibration, Result, too_far
from fitctl.sequences.behaviours.pointing import stop_visit
from fitctl.sequences.view import Figures, StepFailed, View

Floats = NDArray[np.float64]
AzElPx = tuple[float, float]
FRINGE = "fringe"  # of a loop's other_spots
_PLACES = 5  # aside and aside, the same about what was found, and there
_LEAST_MEASURED = 0.5  # of the frames that telemetry has
_MOST_LEFT = 4.0  # standard deviations


class Pair(NamedTuple):
    """Settings of the loop whose target moves, and of the other one."""

    own: Loop
    other: Loop
    other_name: str


def pair_of(rig: Rig, loop_name: str) -> Pair:
    """Both loops of ``[fringes]``, the one that is named first."""
    if rig.fringes is None:
        msg = f"rig {rig.name} has no section fringes"
        raise ValueError(msg)
    (other_name,) = (name for name in rig.fringes.loops if name != loop_name)
    return Pair(rig.stellar_loops[loop_name], rig.stellar_loops[other_name], other_name)


def fringe_of(loop: Loop) -> OtherSpot | None:
    """The loop's fringe spot in the rig file."""
    return next((spot for spot in loop.other_spots if spot.name == FRINGE), None)


class FringeSensor:
    """Measures the fringe spots of two loops, each from its own star.

    Parameters
    ----------
    camera : Camera
    loops : two Loop
        Each must have a spot of the name :data:`FRINGE` in its ``other_spots``.
    """

    def __init__(self, camera: Camera, loops: tuple[Loop, Loop]) -> None:
        self._spots: list[tuple[StarSensor, OtherSpot, float]] = []
        for loop in loops:
            spot = fringe_of(loop)
            if spot is None:
                msg = f"other_spots has no {FRINGE}"
                raise ValueError(msg)
            as_star = loop.model_copy(update={"star_flux_dn": spot.flux_dn})
            self._spots.append((StarSensor(camera, as_star), spot, loop.spot_diameter_px))

    def offsets_px(
        self, image: NDArray[np.uint16], stars_px: tuple[AzElPx, AzElPx]
    ) -> Floats | None:
        """Each fringe spot from its star, shape (2, 2); None where one is not where it is expected."""
        places = [
            (az + spot.offset_px.az, el + spot.offset_px.el)
            for (az, el), (_, spot, _) in zip(stars_px, self._spots, strict=True)
        ]
        for number in (
            0,
            1,
            0,
            1,
        ):  # twice, so that each is free of the other's light where that truly is
            _, other, diameter_px = self._spots[1 - number]
            sensor = self._spots[number][0]
            sensor.other_light = [OtherLight(*places[1 - number], other.flux_dn, diameter_px)]
            found = sensor.find_at(image, *places[number])
            if found is None:
                return None
            places[number] = (found.az_px, found.el_px)
        return np.array(places) - np.array(stars_px)


def direction_of(step: steps.Overlap, rig: Rig, loop_name: str) -> Floats | None:
    """The step aside, shape (2,): along elevation, or along azimuth where there is no room; None without any.

    To either side, all four spots are on the frame, and a window apart.
    """
    pair, (az, el) = pair_of(rig, loop_name), np.eye(2)
    return next(
        (
            direction * step.separation_px
            for direction in (el, az)
            if all(_has_room(rig, pair, sign * direction * step.separation_px) for sign in (-1, 1))
        ),
        None,
    )


def _has_room(rig: Rig, pair: Pair, aside_px: Floats) -> bool:
    places = [
        place + aside
        for loop, aside in ((pair.own, aside_px), (pair.other, np.zeros(2)))
        for place in (_target_px(loop), _target_px(loop) + _fringe_offset_px(loop))
    ]
    return all(rig.camera.window_fits(*place) for place in places) and all(
        np.abs(one - another).max() >= WINDOW_PX
        for one, another in itertools.combinations(places, 2)
    )


def _target_px(loop: Loop) -> Floats:
    return np.array([loop.target_px.az, loop.target_px.el])


def _fringe_offset_px(loop: Loop) -> Floats:
    spot = fringe_of(loop)
    return np.full(2, np.nan) if spot is None else np.array([spot.offset_px.az, spot.offset_px.el])


def _check(step: steps.Overlap, rig: Rig, loop_name: str) -> list[str]:
    if rig.fringes is None:
        return [f"rig {rig.name} has no section fringes, which names the two stars"]
    if loop_name not in rig.fringes.loops:
        return [f"loop {loop_name!r} is not in fringes.loops: {', '.join(rig.fringes.loops)}"]
    without = [name for name in rig.fringes.loops if fringe_of(rig.stellar_loops[name]) is None]
    if without:
        return [f"loops.{name}.other_spots has no spot of the name {FRINGE}" for name in without]
    problems = too_far(step, rig, loop_name, step.separation_px)
    if direction_of(step, rig, loop_name) is None:
        problems.append(
            f"no room to step aside by {step.separation_px:g} px: both stars and both fringe spots must be on "
            f"the frame, {WINDOW_PX} px apart; move the targets or lower separation_px"
        )
    if step.steady_after_s >= step.dwell_s:
        problems.append(f"steady_after_s must be below dwell_s, {step.dwell_s:g} s")
    return problems


def _own_s(step: steps.Overlap, _rig: Rig, _loop_name: str) -> float:
    return _PLACES * step.dwell_s


# ---------------------------------------------------------------- from place to place


def _run(step: steps.Overlap, view: View) -> None:
    _go(step, view)


def _go(step: steps.Overlap, view: View) -> None:
    """To the next place, by what has been measured at those before it."""
    number, aside_px = len(view.marks), direction_of(step, view.rig, view.loop_name)
    assert aside_px is not None  # noqa: S101  # the step was checked
    found_px = np.zeros(2) if number < 2 else _found(step, view, 0).mean
    sign = (1, -1, 1, -1, 0)[number]
    offset_px = found_px + sign * aside_px
    problems = too_far(step, view.rig, view.loop_name, math.hypot(*offset_px))
    if problems:
        msg = f"the fringe spots are {found_px[0]:+.2f}, {found_px[1]:+.2f} px apart; {problems[0]}"
        raise StepFailed(msg)
    az_px, el_px = (_target_px(view.settings) + offset_px).tolist()
    view.command(SetTarget(loop=view.loop_name, az_px=az_px, el_px=el_px))
    view.marks.append(view.fresh_s)


def _done(step: steps.Overlap, view: View) -> Result | None:
    pair = pair_of(view.rig, view.loop_name)
    view.require_mode(Mode.VERNIER, Mode.COARSE)  # a long way leads through COARSE
    other = next(loop for loop in view.telemetry.loops if loop.name == pair.other_name)
    if other.mode not in {Mode.VERNIER.name, Mode.COARSE.name}:
        msg = f"loop {other.name} is in {other.mode}; both stars must be held"
        raise StepFailed(msg)
    view.measurements.clear()  # the rows have what is needed of both loops
    _record(step, view, pair)
    if view.now_s - view.marks[-1] < step.dwell_s:
        return None
    if len(view.marks) < _PLACES:
        _go(step, view)
        return None
    return _evaluate(step, view)


def _record(step: steps.Overlap, view: View, pair: Pair) -> None:
    """Add what the newest message has to the rows of this place."""
    since_s = view.marks[-1] + step.steady_after_s
    place = f"place {len(view.marks) - 1}"
    view.rows["tilt"] += [
        (one.tilt_az_arcsec, one.tilt_el_arcsec)
        for one in view.telemetry.overlaps
        if len(view.marks) == _PLACES and one.time_s >= since_s
    ]
    frame = view.telemetry.frame
    if frame is None or frame.time_s < since_s:
        return
    if view.rows[place] and frame.time_s <= view.rows[place][-1][0]:
        return
    stars_px = {
        tick.loop: (tick.star_az_px, tick.star_el_px)
        for tick in view.telemetry.ticks
        if tick.number == frame.number and tick.star_visible
    }
    if not {view.loop_name, pair.other_name} <= stars_px.keys():
        return
    sensor = FringeSensor(view.rig.camera, (pair.own, pair.other))
    offsets_px = sensor.offsets_px(
        _image(frame), (stars_px[view.loop_name], stars_px[pair.other_name])
    )
    apart_px = np.full(2, np.nan) if offsets_px is None else offsets_px[1] - offsets_px[0]
    view.rows[place].append((frame.time_s, *apart_px.tolist()))


def _image(frame: FrameRecord) -> NDArray[np.uint16]:
    return np.frombuffer(frame.data, "<u2").reshape(frame.height_px, frame.width_px)


# ---------------------------------------------------------------- what was found


def _found(step: steps.Overlap, view: View, first: int) -> SlowMean:
    """By how much the rig file's target must move, from the rows of two places.

    Raises
    ------
    StepFailed
        If they have too few frames with both fringe spots.
    """
    name, pair = f"found from place {first}", pair_of(view.rig, view.loop_name)
    if view.rows[name]:
        return SlowMean(*np.array(view.rows[name]))
    table = np.array(view.rows[f"place {first}"] + view.rows[f"place {first + 1}"]).reshape(-1, 3)
    measured = table[np.isfinite(table[:, 1])]
    due = 2 * (step.dwell_s - step.steady_after_s) * _frames_hz(view.rig)
    if len(measured) < _LEAST_MEASURED * due:
        msg = (
            f"both fringe spots were measured on {len(measured)} frames, expected at least "
            f"{_LEAST_MEASURED * due:.0f}; compare the frame with loops.{view.loop_name}.other_spots and "
            f"loops.{pair.other_name}.other_spots"
        )
        raise StepFailed(msg)
    mean = slow_mean(measured[:, 0], measured[:, 1:], pair.own.vernier.air_path)
    if not mean.sd.max() <= step.max_error_px:
        msg = (
            f"the offset is uncertain by {mean.sd.max():.3f} px; max_error_px is {step.max_error_px:g}; "
            "use a longer dwell_s"
        )
        raise StepFailed(msg)
    offset_px = mean.mean + _target_px(pair.other) - _target_px(pair.own)
    view.rows[name] = [tuple(offset_px.tolist()), tuple(mean.sd.tolist())]
    return SlowMean(offset_px, mean.sd)


def _frames_hz(rig: Rig) -> float:
    """Telemetry has its newest frame only."""
    return min(rig.supervisor.telemetry_hz, rig.camera.frame_rate_hz)


def _evaluate(step: steps.Overlap, view: View) -> Result:
    first, second = _found(step, view, 0), _found(step, view, 2)
    left_px = first.mean - second.mean  # of the own fringe spot, from the other one
    limit_px = _MOST_LEFT * np.hypot(first.sd, second.sd)
    if not np.all(np.abs(left_px) <= limit_px):
        msg = (
            f"measured again, the fringe spots are {left_px[0]:+.3f}, {left_px[1]:+.3f} px apart; expected at "
            f"most {limit_px.max():.3f} px; is something drifting? Try again"
        )
        raise StepFailed(msg)
    per_px = scales(view.rig, view.settings).sky_arcsec_per_px
    figures = {
        **_axes("offset_{}_px", first.mean),
        **_axes("offset_sd_{}_px", first.sd),
        **_axes("tilt_before_{}_arcsec", -per_px * first.mean),
        **_axes("tilt_after_{}_arcsec", per_px * left_px),
        **_axes("tilt_after_sd_{}_arcsec", per_px * second.sd),
        **_visibilities(view, per_px * first.mean, per_px * second.mean),
    }
    lines = [
        f"offset {first.mean[0]:+.3f} +- {first.sd[0]:.3f} px az, {first.mean[1]:+.3f} +- "
        f"{first.sd[1]:.3f} px el (one standard deviation)",
        f"tilt of the fringes {_length(per_px * first.mean):.3f} arcsec before, "
        f"{_length(per_px * left_px):.3f} +- {_length(per_px * second.sd):.3f} arcsec after",
        f"visibility {figures['visibility_before']:.4f} before; after, expected "
        f"{figures['visibility_expected']:.4f}, measured {figures['visibility_measured']:.4f}",
    ]
    az_px, el_px = (_target_px(view.settings) + first.mean).round(3).tolist()
    fragment = {"loops": {view.loop_name: {"target_px": {"az": az_px, "el": el_px}}}}
    calibration = Calibration(f"{view.loop_name}-overlap", lines, fragment, {})
    return Result(figures, "; ".join(lines), calibration)


def _visibilities(view: View, before_arcsec: Floats, truly_arcsec: Floats) -> Figures:
    """Before, expected and measured, from the tilt of the stars at the last place.

    Their tilt is counted from the rig file's targets; where it is `truly_arcsec`, shape (2,), by the second
    measurement, the fringe spots lie on each other.
    """
    fringes = view.rig.fringes
    assert fringes is not None  # noqa: S101  # the step was checked
    sign = 1.0 if fringes.loops[0] == view.loop_name else -1.0
    tilt_arcsec = sign * np.array(view.rows["tilt"]).reshape(-1, 2)
    tilt_arcsec = tilt_arcsec[np.isfinite(tilt_arcsec).all(axis=1)]
    due = (step_s := view.now_s - view.marks[-1]) * view.rig.camera.frame_rate_hz
    if len(tilt_arcsec) < _LEAST_MEASURED * due:
        msg = f"both stars were held on {len(tilt_arcsec)} frames of the last {step_s:.0f} s; try again"
        raise StepFailed(msg)
    rms_rad = tilt_arcsec.std(axis=0) / ARCSEC_PER_RAD
    aperture_m, wavelength_m = fringes.aperture_m, fringes.wavelength_m
    tilts_rad = np.hypot(*(tilt_arcsec - truly_arcsec).T) / ARCSEC_PER_RAD
    before_rad = before_arcsec / ARCSEC_PER_RAD
    return {
        "visibility_before": mean_visibility(before_rad, rms_rad, aperture_m, wavelength_m),
        "visibility_expected": mean_visibility(np.zeros(2), rms_rad, aperture_m, wavelength_m),
        "visibility_measured": float(
            np.mean([visibility(tilt, aperture_m, wavelength_m) for tilt in tilts_rad.tolist()])
        ),
    }


def _axes(name: str, values: Floats) -> Figures:
    return {
        name.format(axis): value for axis, value in zip(("az", "el"), values.tolist(), strict=True)
    }


def _length(values: Floats) -> float:
    return math.hypot(*values.tolist())


OVERLAP = {"overlap": Behaviour(frozenset({Mode.VERNIER}), _done, _run, stop_visit, _check, _own_s)}
