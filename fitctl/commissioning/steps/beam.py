"""The metrology beam on its photodiodes, moved by its siderostat and by the hexapod: order, directions."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.commissioning.steps.ending import stopped_early
from fitctl.commissioning.steps.motors import Motors, Servo, powered
from fitctl.commissioning.steps.plate import ROTATION_APART_DEG, similar
from fitctl.config import Collector, MetrologyLoop
from fitctl.controllers.photodiodes import BeamState, PhotodiodeArray
from fitctl.daemon.devices import HEXAPODS, PHOTODIODES
from fitctl.drivers.interface import DeviceError, Hexapod, Photodiodes, Pose
from fitctl.model.metrology.geometry import transverse_axes
from fitctl.model.optics import rotation

Floats = NDArray[np.float64]
STEP_M = 5e-3  # of the beam at the array
MOVE_MM = 3.0
_VELOCITY_MM_S = 1.0
_CENTRED_M = 3e-3
_TRIES = 6
_SAMPLES = 25
_EVERY_S = 0.02
_TIMEOUT_S = 2.0
_UNLIKE = 0.5  # of diode_offset_m; a photodiode so far from its place is at no corner
_SCALE_APART = 0.2
_NAMES = ("az+", "az-", "el+", "el-")


class BeamWatch:
    """The photodiodes and the motors that move the beam over them, used in turn by one thread.

    Parameters
    ----------
    site : Site
    diodes : Photodiodes
        Open.
    motors : Motors
        Powered. They are held while samples are awaited.
    """

    def __init__(self, site: Site, diodes: Photodiodes, motors: Motors) -> None:
        self._site, self._diodes = site, diodes
        self.loop = beam_loop(site)
        self.servo = Servo(site, motors)
        self._clock = site.clock
        siderostat = self.loop.siderostat
        self._m_per_rad = (
            siderostat.sky_rad_per_motor_rad
            * self.loop.sensor.link_length_m
            * rotation(siderostat.rotation_deg)
        )

    def volts(self) -> Floats:
        """Of the four, on average; ambient light is in them.

        Raises
        ------
        StepError
            If no samples come.
        """
        samples: list[Floats] = []
        until_s = self._clock.now_s() + _TIMEOUT_S + _SAMPLES * _EVERY_S
        next_s = self._clock.now_s()
        while len(samples) < _SAMPLES:
            self.servo.hold()
            now_s = self._clock.now_s()
            if now_s >= next_s:
                next_s = now_s + _EVERY_S
                self._diodes.send_request()
            reading = self._diodes.receive()
            if reading is not None:
                samples.append(np.array(reading.volts))
            if now_s > until_s:
                msg = f"{len(samples)} of {_SAMPLES} samples came in time; check the link to the photodiodes"
                raise StepError(msg)
        return np.asarray(np.mean(samples, axis=0))

    def lights_v(self) -> Floats:
        """Above ambient light."""
        return self.volts() - self.loop.sensor.ambient_v

    def move_m(self, way_m: Floats) -> None:
        """Move the beam at the array."""
        way_rad = np.linalg.solve(self._m_per_rad, way_m).astype(np.float64)
        self.servo.turn_to(self.servo.goal_rad + way_rad)


def beam_loop(site: Site) -> MetrologyLoop:
    """The metrology loop."""
    return site.rig.metrology_loops[site.name]


@contextmanager
def watching(site: Site) -> Iterator[BeamWatch]:
    """Photodiodes open, motors powered.

    Raises
    ------
    StepError
        If a device fails.
    """
    device = beam_loop(site).sensor.device
    diodes = PHOTODIODES[device.driver](device)
    try:
        diodes.open()
        with powered(site) as motors:
            yield BeamWatch(site, diodes, motors)
    except DeviceError as error:
        raise StepError(str(error)) from None
    finally:
        diodes.close()


# ---------------------------------------------------------------- the photodiodes
def photodiodes_moves(site: Site) -> str:
    """What the step moves."""
    radius_arcsec = beam_loop(site).acquisition.search_radius_sky_arcsec
    return (
        f"the metrology siderostat, until the beam is on the middle of the photodiodes: up to "
        f"{radius_arcsec:g} arcsec; then by {1e3 * STEP_M:g} mm at the array both ways"
    )


def check_photodiodes(site: Site) -> Outcome:
    """Find where each photodiode is, from how its light changes as the beam moves.

    Raises
    ------
    StepError
        If the beam is not found, or the photodiodes are not at four corners.
    """
    with watching(site) as watch:
        sensor = watch.loop.sensor
        threshold_v = watch.loop.acquisition.detection_sigma * sensor.noise_v
        for _ in range(_TRIES):
            places_m = _places(watch, threshold_v)
            beam_m = -np.nanmean(places_m, axis=0)
            site.report(f"the beam is az {1e3 * beam_m[0]:+.1f}, el {1e3 * beam_m[1]:+.1f} mm off")
            if np.max(np.abs(beam_m)) < _CENTRED_M:
                _refuse_dark(watch, places_m)
                break
            watch.move_m(-beam_m)
        else:
            msg = "the beam does not reach the middle of the photodiodes; check the siderostat's signs and gear"
            raise StepError(msg, {"off_m": float(np.max(np.abs(beam_m)))})
        lights_v = watch.lights_v()
    return _photodiodes_outcome(site, places_m - np.mean(places_m, axis=0), lights_v)


def _refuse_dark(watch: BeamWatch, places_m: Floats) -> None:
    """Raise StepError if a photodiode has no light with the beam in the middle of the others."""
    inputs = watch.loop.sensor.device.inputs
    dark = [f"AIN{inputs[n]}" for n in range(4) if np.isnan(places_m[n]).any()]
    if dark:
        msg = (
            f"{' and '.join(dark)}: no light, though the beam is on the other photodiodes; check its cable and "
            "the photodiode"
        )
        raise StepError(msg)


def _places(watch: BeamWatch, threshold_v: float) -> Floats:
    """Where each photodiode is from the beam, shape (4, 2); NaN of those without light.

    The logarithm of a Gaussian beam's light has the slope 4 x / w^2 at a place x from its middle.
    """
    slopes = np.full((4, 2), math.nan)
    for axis in range(2):
        step_m = STEP_M * np.eye(2)[axis]
        watch.move_m(-step_m)
        low_v = watch.lights_v()
        watch.move_m(2 * step_m)
        high_v = watch.lights_v()
        watch.move_m(-step_m)
        lit = np.minimum(low_v, high_v) > threshold_v
        if not lit.any():
            msg = "no photodiode has light; check laser and shutter, or bring the beam to the array by hand"
            raise StepError(msg)
        slopes[lit, axis] = np.log(high_v[lit] / low_v[lit]) / (2 * STEP_M)
    return slopes * watch.loop.sensor.beam_radius_m**2 / 4


def _photodiodes_outcome(site: Site, places_m: Floats, lights_v: Floats) -> Outcome:
    """What measured places, in the order of the inputs, make of the rig file."""
    sensor = beam_loop(site).sensor
    corners_m = sensor.diode_offset_m * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    order = min(
        itertools.permutations(range(4)),
        key=lambda one: float(np.sum((places_m[list(one)] - corners_m) ** 2)),
    )
    apart_m = np.linalg.norm(places_m[list(order)] - corners_m, axis=1)
    size = float(np.mean(np.linalg.norm(places_m, axis=1)) / sensor.diode_offset_m)
    figures = {"offset_over_expected": size, "furthest_apart_m": float(apart_m.max())}
    figures |= {f"{_NAMES[n]}_v": float(lights_v[order[n]]) for n in range(4)}
    inputs = [sensor.device.inputs[n] for n in order]
    lines = [
        f"AIN{sensor.device.inputs[n]}: az {1e3 * az:+.1f}, el {1e3 * el:+.1f} mm from the middle"
        for n, (az, el) in enumerate(places_m)
    ]
    if apart_m.max() > _UNLIKE * sensor.diode_offset_m:
        msg = (
            f"the photodiodes are not {1e3 * sensor.diode_offset_m:g} mm from the middle on each axis ("
            + "; ".join(lines)
            + "); check that all four are connected and lit, and the array's orientation"
        )
        raise StepError(msg, figures)
    if inputs == list(sensor.device.inputs):
        return Outcome(lines, figures)
    lines.append(f"az+, az-, el+ and el- are on {', '.join(f'AIN{n}' for n in inputs)}")
    return Outcome(lines, figures, site.found(sensor={"device": {"inputs": inputs}}))


# ---------------------------------------------------------------- the hexapod
def collector_moves(site: Site) -> str:
    """What the step moves."""
    collector = _collector(site)
    return (
        "the hexapod: its reference move if it has none, which moves the whole platform; then "
        f"{MOVE_MM:g} mm along link_azimuth and across it, at {_velocity_mm_s(collector):g} mm/s, and back"
    )


def _collector(site: Site) -> Collector:
    collector = site.rig.collector
    if collector is None:
        msg = "the rig has no collector"
        raise StepError(msg)
    return collector


def _velocity_mm_s(collector: Collector) -> float:
    return min(_VELOCITY_MM_S, collector.hexapod.velocity_limit_mm_s)


def check_collector(site: Site) -> Outcome:
    """Which way the beam moves on the photodiodes as the hexapod moves.

    Raises
    ------
    StepError
        If it does not move, or as in a mirror, or reports an error. If it may still move, the text says so.
    """
    collector = _collector(site)
    hexapod = HEXAPODS[collector.hexapod.driver](collector.hexapod)
    try:
        hexapod.open()
        if not hexapod.pose().referenced:
            site.report("the hexapod makes its reference move")
            with _stopped(hexapod):
                hexapod.reference()
        with watching(site) as watch, _stopped(hexapod):
            array = PhotodiodeArray(watch.loop.sensor, watch.loop.acquisition.detection_sigma)
            velocity_mm_s = _velocity_mm_s(collector)
            axes = transverse_axes(collector.geometry)
            seen = np.array(
                [_carried(watch, array, hexapod, axis, velocity_mm_s) for axis in axes]
            ).T
    except DeviceError as error:
        raise StepError(str(error)) from None
    finally:
        hexapod.close()
    return _collector_outcome(collector, -seen)


def _stopped(hexapod: Hexapod) -> AbstractContextManager[None]:
    danger = "the hexapod may still move: press its emergency stop"
    return stopped_early(hexapod.stop, hexapod.open, danger)


def _carried(
    watch: BeamWatch, array: PhotodiodeArray, hexapod: Hexapod, axis: Floats, velocity_mm_s: float
) -> Floats:
    """How far the beam moved on the array, in metres for each metre of the hexapod's along an axis."""
    start = hexapod.pose().pose
    places = []
    for way in (-1.0, 1.0, 0.0):
        x_mm, y_mm, z_mm = np.array(start[:3]) + way * MOVE_MM * axis
        _go(watch, hexapod, start._replace(x_mm=x_mm, y_mm=y_mm, z_mm=z_mm), velocity_mm_s)
        beam = array.beam(tuple(watch.volts()))
        if beam.state is not BeamState.MEASURED:
            msg = "the beam is not on all four photodiodes; repeat the step photodiodes"
            raise StepError(msg)
        places.append(beam.place_m)
    return np.asarray((places[1] - places[0]) / (2e-3 * MOVE_MM))


def _go(watch: BeamWatch, hexapod: Hexapod, pose: Pose, velocity_mm_s: float) -> None:
    """Move there and wait, with the motors held."""
    hexapod.move_to(pose, velocity_mm_s)
    until_s = time.monotonic() + 2 * MOVE_MM / velocity_mm_s + 10.0
    look_s = time.monotonic() + 0.3
    while True:
        watch.servo.hold()
        if time.monotonic() < look_s:
            continue
        look_s = time.monotonic() + 0.1
        reading = hexapod.pose()
        if reading.error or not reading.servos_on:
            msg = (
                f"the hexapod did not get to its pose: {reading.error or 'a servo is off'}; remove the cause, "
                "reference the hexapod if a servo is off, and repeat the step"
            )
            raise StepError(msg)
        if not reading.moving:
            return
        if time.monotonic() > until_s:
            msg = "the hexapod is still moving; check its controller"
            raise StepError(msg)


def _collector_outcome(collector: Collector, seen: Floats) -> Outcome:
    """What the array's motion as the beam shows it, for motions along link_azimuth and across, makes of it."""
    figures = {"az_by_azimuth": float(seen[0, 0]), "el_by_azimuth": float(seen[1, 0])}
    figures |= {"az_by_elevation": float(seen[0, 1]), "el_by_elevation": float(seen[1, 1])}
    if np.linalg.det(seen) < 0.1:
        what = "is mirrored" if np.linalg.det(seen) < -0.1 else "does not move as it should"
        msg = (
            f"as the hexapod moves, the beam on the photodiodes {what}; check collector.geometry.link and the "
            "axes of the hexapod's controller (its coordinate system, KEN?)"
        )
        raise StepError(msg, figures)
    now = similar(seen)
    figures |= {"scale": now.scale, "turned_deg": now.rotation_deg}
    lines = [
        f"a millimetre of the hexapod moves the array by {now.scale:.3f} mm under the beam, turned by "
        f"{now.rotation_deg:+.1f} degrees"
    ]
    if abs(now.scale - 1) > _SCALE_APART:
        msg = f"{lines[0]}; check sensor.beam_radius_m and diode_offset_m, and the hexapod's units"
        raise StepError(msg, figures)
    if abs(now.rotation_deg) <= ROTATION_APART_DEG:
        return Outcome(lines, figures)
    azimuth = np.linalg.inv(rotation(now.rotation_deg))[:, 0] @ transverse_axes(collector.geometry)
    exact = azimuth / np.linalg.norm(azimuth)
    found: dict[str, Any] = {
        "collector": {"geometry": {"link_azimuth": [round(float(one), 7) for one in exact]}}
    }
    return Outcome(lines, figures, found)
