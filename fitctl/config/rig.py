"""A whole rig, and what its parts must agree on."""

from __future__ import annotations

from collections.abc import Iterator
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
from fitctl.config.devices import (
    Camera,
    Cia402Device,
    Optics,
)
from fitctl.config.interlocks import Interlock
from fitctl.config.loops import Logging, Loop, Service, Supervisor
from fitctl.config.metrology import MetrologyLoop
from fitctl.config.mocks import Mocks
from fitctl.config.plant import PlantTruth

SCHEMA_VERSION = 2
"""Of rig files that this fitctl reads; raise it when a key is removed, renamed or newly required."""

AnyLoop = Annotated[
    Annotated[Loop, Tag(STELLAR)] | Annotated[MetrologyLoop, Tag(METROLOGY)], BY_KIND
]


RIG_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,40}$"
"""A pattern: rigs' names become parts of file names."""


class Rig(Settings):
    """A whole rig file. ``plant`` and ``mocks`` are for mock rigs; a rig of real hardware leaves them out."""

    schema_version: Literal[2]  # SCHEMA_VERSION
    name: Annotated[str, Field(pattern=RIG_NAME)]
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
    def can_buses(self) -> list[dict[Name, Cia402Device]]:
        """The drives on each CAN bus of the rig, by the loops whose siderostats they turn."""
        buses: dict[tuple[str, str], dict[Name, Cia402Device]] = {}
        for name, loop in self.loops.items():
            device = loop.siderostat.device
            if isinstance(device, Cia402Device):
                buses.setdefault((device.interface, device.channel), {})[name] = device
        return list(buses.values())

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
    yield from _collector(rig)
    yield from _plant_and_mocks(rig)


def _loops(rig: Rig) -> Iterator[str]:
    if not rig.stellar_loops:
        yield "loops: at least one must be of kind stellar; the camera looks at a star"


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


def _plant_and_mocks(rig: Rig) -> Iterator[str]:
    for pixel in rig.plant.hot_pixels if rig.plant else []:
        if pixel.az_px >= rig.camera.width_px or pixel.el_px >= rig.camera.height_px:
            yield f"plant.hot_pixels: az {pixel.az_px}, el {pixel.el_px} px is not on the frame"
    delay_s, half_s = rig.true_camera.frame_delay_s, rig.camera.exposure_s / 2
    if rig.plant is not None and rig.plant.exposure_instants > 1 and delay_s < half_s:
        yield (
            f"plant.exposure_instants: a frame of several instants is there when its exposure has ended; "
            f"its frame_delay_s must be at least {half_s:g}, half of camera.exposure_s (is {delay_s:g})"
        )
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
