"""A whole rig, and what its parts must agree on."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, Tag, model_validator

from fitctl.config.base import (
    BY_KIND,
    METROLOGY,
    STELLAR,
    ConfigError,
    Name,
    Settings,
    of_kind,
)
from fitctl.config.collector import Collector, Fringes
from fitctl.config.devices import HALF_WINDOW_PX, Camera, Optics
from fitctl.config.interlocks import QUANTITIES, Interlock
from fitctl.config.loops import Logging, Loop, Service, Supervisor
from fitctl.config.metrology import MetrologyLoop
from fitctl.config.mocks import Mocks
from fitctl.config.plant import PlantTruth

_LARGEST_SERVO_STEP = 0.4  # part of an error that one servo period may take back, with its latency
_WINDOW_PX = 2 * HALF_WINDOW_PX + 1
_FULL_SCALE_DN = {"Mono8": 255, "Mono12": 4095, "Mono16": 65535}
AnyLoop = Annotated[
    Annotated[Loop, Tag(STELLAR)] | Annotated[MetrologyLoop, Tag(METROLOGY)], BY_KIND
]


class Rig(Settings):
    """A whole rig file. ``plant`` and ``mocks`` are for mock rigs; a rig of real hardware leaves them out."""

    schema_version: Literal[1]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,40}$")]
    description: str
    optics: Optics
    camera: Camera
    loops: Annotated[dict[Name, AnyLoop], Field(min_length=1)]
    supervisor: Supervisor
    interlocks: dict[Name, Interlock]
    service: Service
    logging: Logging
    plant: PlantTruth | None = None
    mocks: Mocks | None = None
    collector: Collector | None = None
    fringes: Fringes | None = None

    @model_validator(mode="after")
    def _parts_agree(self) -> Rig:
        disagreement = next(_disagreements(self), None)
        if disagreement is not None:
            raise ValueError(disagreement)
        return self

    @property
    def stellar_loops(self) -> dict[Name, Loop]:
        """The loops that point a star."""
        return of_kind(self.loops, Loop)

    @property
    def metrology_loops(self) -> dict[Name, MetrologyLoop]:
        """The loops that hold a laser beam on photodiodes."""
        return of_kind(self.loops, MetrologyLoop)

    @property
    def true_camera(self) -> Camera:
        """The camera as mocks and simulation have it: delayed as the plant says."""
        true_s = None if self.plant is None else self.plant.frame_delay_s
        if true_s is None:
            return self.camera
        return self.camera.model_copy(update={"frame_delay_s": true_s})

    def mock_parts(self) -> tuple[PlantTruth, Mocks]:
        """The sections that only mocks and simulation need.

        Raises
        ------
        ConfigError
            If this rig file describes hardware only.
        """
        if self.plant is None or self.mocks is None:
            msg = (
                f"rig {self.name}: sections plant and mocks are missing, so it can be neither mocked "
                "nor simulated; copy them from rigs/fit-mock.toml"
            )
            raise ConfigError(msg)
        return self.plant, self.mocks


def _disagreements(rig: Rig) -> Iterator[str]:
    """Everything on which the parts of a rig do not agree."""
    yield from _loops(rig)
    yield from _links(rig)
    yield from _one_focal_plane(rig)
    yield from _collector(rig)
    yield from _interlocks(rig)
    yield from _plant_and_mocks(rig)


def _loops(rig: Rig) -> Iterator[str]:
    if not rig.stellar_loops:
        yield "loops: at least one must be of kind stellar; the camera looks at a star"
    for name, star in rig.stellar_loops.items():
        if not rig.camera.window_fits(star.target_px.az, star.target_px.el):
            yield f"loops.{name}.target_px {rig.camera.window_range_text}"
    for name, loop in rig.loops.items():
        servo = loop.siderostat.servo
        if servo.gain_per_s / servo.rate_hz > _LARGEST_SERVO_STEP:
            yield (
                f"loops.{name}.siderostat.servo: gain_per_s may be at most "
                f"{_LARGEST_SERVO_STEP * servo.rate_hz:g} at {servo.rate_hz:g} Hz, "
                "or the servo would swing"
            )


def _links(rig: Rig) -> Iterator[str]:
    before: set[str] = set()
    for name, loop in rig.loops.items():
        link = getattr(loop, "link", None)
        if link is not None and link not in rig.metrology_loops:
            there_are = ", ".join(rig.metrology_loops) or "none"
            yield f"loops.{name}.link: must name a loop of kind metrology ({there_are}), is {link!r}"
        elif link is not None and link not in before:
            yield (
                f"loops.{name}.link: loops.{link} must come before loops.{name} in the rig file, "
                "because a tick evaluates loops in that order"
            )
        before.add(name)


def _one_focal_plane(rig: Rig) -> Iterator[str]:
    """Two loops on one camera: their windows stay apart, and no sum of their spots looks like a star."""
    for (one, first), (other, second) in itertools.combinations(rig.stellar_loops.items(), 2):
        apart_px = max(
            abs(first.target_px.az - second.target_px.az),
            abs(first.target_px.el - second.target_px.el),
        )
        reach_px = max(_mirror_reach_px(rig, first), _mirror_reach_px(rig, second))
        if apart_px < _WINDOW_PX + reach_px:
            yield (
                f"loops.{other}.target_px: {apart_px:g} px from loops.{one}.target_px; must be at least "
                f"{_WINDOW_PX + reach_px:.2f} px, a window and the reach of a mirror, or one loop's star "
                "could enter the other's window"
            )
    yield from _overlapping_spots(rig)


def _mirror_reach_px(rig: Rig, loop: Loop) -> float:
    fsm = loop.fsm
    return fsm.range_rad * fsm.beam_per_mirror * rig.optics.focal_length_m / rig.camera.pixel_size_m


def _overlapping_spots(rig: Rig) -> Iterator[str]:
    """Other spots of two loops that lie on each other interfere: amplitudes add, not light."""
    spots = [
        (name, spot, loop.target_px.az + spot.offset_px.az, loop.target_px.el + spot.offset_px.el)
        for name, loop in rig.stellar_loops.items()
        for spot in loop.other_spots
    ]
    full_dn = _FULL_SCALE_DN[rig.camera.device.pixel_format] - rig.camera.bias_dn
    for (one, first, az, el), (other, second, az2, el2) in itertools.combinations(spots, 2):
        if one == other or max(abs(az - az2), abs(el - el2)) > HALF_WINDOW_PX:
            continue
        together_dn = (math.sqrt(first.flux_dn) + math.sqrt(second.flux_dn)) ** 2
        here = f"loops.{other}.other_spots: {second.name} lies on {first.name} of loop {one}; "
        if together_dn > full_dn:
            yield f"{here}both reach {together_dn:g} DN, beyond the camera's {full_dn:g}; lower flux_dn"
        for name, loop in rig.stellar_loops.items():
            low_dn, high_dn = loop.flux_range_dn
            if low_dn <= together_dn <= high_dn:
                yield (
                    f"{here}both reach {together_dn:g} DN and would be taken for the star of loop "
                    f"{name}, which may have {low_dn:g} to {high_dn:g}; narrow flux_range"
                )


def _collector(rig: Rig) -> Iterator[str]:
    if rig.collector is not None and len(rig.metrology_loops) != 1:
        yield (
            "collector: needs one loop of kind metrology, which follows it; loops has "
            f"{len(rig.metrology_loops)}"
        )
    if rig.fringes is not None:
        one, other = rig.fringes.loops
        if one == other or not {one, other} <= set(rig.stellar_loops):
            yield (
                f"fringes.loops: must name two loops of kind stellar ({', '.join(rig.stellar_loops)}), "
                f"is {one}, {other}"
            )


def _interlocks(rig: Rig) -> Iterator[str]:
    oldest_s = rig.camera.frame_delay_s + 2 * rig.camera.period_s
    for name, row in rig.interlocks.items():
        of_frames = QUANTITIES[row.quantity].every_frame
        if of_frames and row.stale_s is not None and row.stale_s <= oldest_s:
            yield (
                f"interlocks.{name}.stale_s must be above {oldest_s:g} s, "
                "the camera's delay and two frames"
            )


def _plant_and_mocks(rig: Rig) -> Iterator[str]:
    for pixel in rig.plant.hot_pixels if rig.plant else []:
        if pixel.az_px >= rig.camera.width_px or pixel.el_px >= rig.camera.height_px:
            yield f"plant.hot_pixels: az {pixel.az_px}, el {pixel.el_px} px is not on the frame"
    for section, part in (("plant", rig.plant), ("mocks", rig.mocks)):
        if part is None:
            continue
        if set(part.loops) != set(rig.loops):
            yield f"{section}.loops must name the same loops as loops: {', '.join(rig.loops)}"
            continue
        for name, settings in part.loops.items():
            if settings.kind != rig.loops[name].kind:
                yield (
                    f"{section}.loops.{name}.kind: must be {rig.loops[name].kind}, as loops.{name}.kind "
                    f"(is {settings.kind})"
                )
    if rig.mocks is None:
        return
    for name, mocks in rig.mocks.loops.items():
        driver = rig.loops[name].siderostat.device.driver if name in rig.loops else ""
        if driver in {"ensemble", "bal_analog"} and getattr(mocks, driver) is None:
            yield f"mocks.loops.{name}.{driver} is missing: siderostat.device.driver is {driver}"
    if rig.collector is not None and rig.mocks.hexapod is None:
        yield "mocks.hexapod is missing: the rig has a collector"


def default_rig_path() -> Path:
    """The shipped default rig: beside the package in a checkout, inside it once installed."""
    package = Path(__file__).parent.parent
    installed = package / "rigs" / "fit-mock.toml"
    return installed if installed.exists() else package.parent / "rigs" / "fit-mock.toml"
