"""What every design is made for: the numbers of one loop that control design needs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

from pydantic import Field, ValidationError

from fitctl.config import AirPathModel, ConfigError, Rig, Vernier
from fitctl.config.base import NonNegative, Positive, Settings
from fitctl.controllers.centroid import sensor_noise_px
from fitctl.controllers.pair import Design
from fitctl.model.optics import scales

LEAST_GAIN = 0.4
"""Of a mirror: one that moves less, or more than its inverse, has another fault than its calibration."""
MOST_OVERSHOOT = 0.5
"""Of a mirror: with more, or less than its opposite, the delay is not the rig file's."""


@dataclass(frozen=True)
class Line:
    """A vibration: a damped oscillator under white noise.

    Attributes
    ----------
    frequency_hz : float
        Of the oscillator without damping.
    damping : float
        Part of critical damping: its half width at half power is about ``damping * frequency_hz``.
    rms_px : float
        Of one axis.

    Raises
    ------
    ValueError
        If a value is not above zero, or the damping is critical.
    """

    frequency_hz: float
    damping: float
    rms_px: float

    def __post_init__(self) -> None:
        values = dataclasses.astuple(self)
        if not all(math.isfinite(value) and value > 0 for value in values) or self.damping >= 1:
            msg = f"line: expected values above 0, and a damping below 1, got {self}"
            raise ValueError(msg)


@dataclass(frozen=True)
class Basis:
    """One loop, linear, in pixels.

    Attributes
    ----------
    period_s : float
        Frame period; a command is held for as long.
    delay_s : float
        T_fd: mid-exposure to the command made from the frame.
    noise_px : float
        One standard deviation of the star's place on one frame, by the loop's sensor.
    air_path : AirPathModel
        The disturbance, as identified.
    coarse_per_s : float
        Integrator gain of the coarse loop: 0.464 /s on FIT.
    mirror_range_px : float
        phi_max on the focal plane.
    settings : Vernier
        The designs' own parameters.
    lines : tuple of Line
        Vibrations beside the air path. A rig file has none; `fitctl design learn` finds them in a log.
    guard : Line, optional
        Motion that does not exist. A design that expects it amplifies less there, which gives it its
        margins (:mod:`fitctl.controllers.design.margins`).
    mirror_gain : float
        How far the mirror moves the star, in what the rig file says; `fitctl design learn` measures it.
    overshoot : float
        At mid-exposure, how far the mirror is beyond its last step, as a part of it, since its mount still
        rings; `fitctl design learn` measures it.
    fastest_line_hz : float
        No vibration is faster.
    slow_lines_hz : tuple of float
        Lines that are no aliases of faster ones, as another frame rate has shown.
    writes : int
        Of the D/A in a frame period, at equal intervals. Designs that do not predict use one.
    """

    period_s: float
    delay_s: float
    noise_px: float
    air_path: AirPathModel
    coarse_per_s: float
    mirror_range_px: float
    settings: Vernier
    lines: tuple[Line, ...] = ()
    guard: Line | None = None
    mirror_gain: float = 1.0
    overshoot: float = 0.0
    fastest_line_hz: float = math.inf
    slow_lines_hz: tuple[float, ...] = ()
    writes: int = 1


def basis(rig: Rig, loop_name: str) -> Basis:
    """What designs for a rig's loop are made for.

    Raises
    ------
    ConfigError
        If the rig file knows of no disturbance: then there is nothing to design for.
    """
    loop, camera = rig.stellar_loops[loop_name], rig.camera
    if loop.vernier.air_path.gain_px == 0:
        msg = (
            f"rig {rig.name}: loops.{loop_name}.vernier.air_path.gain_px: must be above 0, or there is "
            "nothing to design for; measure it with fitctl identify airpath"
        )
        raise ConfigError(msg)
    scale = scales(rig, loop)
    return Basis(
        period_s=camera.period_s,
        delay_s=camera.frame_delay_s,
        noise_px=sensor_noise_px(camera, loop, loop.star_flux_dn),
        air_path=loop.vernier.air_path,
        coarse_per_s=loop.coarse.gain_rad_per_m * scale.pixel_size_m * scale.motor_px_per_rad,
        mirror_range_px=scale.mirror_px_per_rad * loop.fsm.range_rad,
        settings=loop.vernier,
        fastest_line_hz=loop.fastest_line_hz or math.inf,
        writes=loop.fsm.dac.writes_per_frame,
    )


def design_parameters(basis: Basis, *sections: str) -> dict[str, Any]:
    """What a design was made from, plain enough for a file: the loop, and sections of the settings."""
    parameters: dict[str, Any] = {
        "noise_px": basis.noise_px,
        "air_path": basis.air_path.model_dump(),
        "coarse_per_s": basis.coarse_per_s,
        "settings": {
            section: getattr(basis.settings, section).model_dump() for section in sections
        },
    }
    if basis.lines:
        parameters["lines"] = [dataclasses.asdict(line) for line in basis.lines]
    if basis.guard is not None:
        parameters["guard"] = dataclasses.asdict(basis.guard)
    if basis.mirror_gain != 1.0:
        parameters["mirror_gain"] = basis.mirror_gain
    if basis.overshoot != 0.0:
        parameters["overshoot"] = basis.overshoot
    if basis.writes != 1:
        parameters["writes_per_frame"] = basis.writes
    return parameters


def on_its_mirror(basis: Basis, parameters: Mapping[str, Any]) -> Basis:
    """A rig's basis, but with the mirror's gain and overshoot for which a design was made."""
    return replace(
        basis,
        mirror_gain=float(parameters.get("mirror_gain", 1.0)),
        overshoot=float(parameters.get("overshoot", 0.0)),
    )


def with_plants_air(own: Basis, rig: Rig, loop_name: str) -> Basis:
    """With the air path of the rig file's plant in place of the loop's model.

    Raises
    ------
    ConfigError
        If the rig file has no plant.
    """
    plant = rig.mock_parts()[0].stellar_loops[loop_name].air_path
    true_air = {name: getattr(plant, name) for name in ("gain_px", "b1_s2", "b2_s")}
    return replace(own, air_path=own.air_path.model_copy(update=true_air))


def night_of(design: Design, rig_basis: Basis) -> Basis:
    """The night that a design expects: the one it was made for if it is learnt, otherwise the rig file's."""
    if not design.learnt:
        return on_its_mirror(rig_basis, design.parameters)
    return replace(basis_of(design.parameters, rig_basis), guard=None)


_QUOTED = 60  # characters of a value that cannot be
# A design for 100 lines took six seconds, one for 300 more than a minute. The learner finds eight at most.
_MOST_LINES = 32


class _Line(Settings):
    frequency_hz: Positive
    damping: Annotated[float, Field(gt=0, lt=1)]
    rms_px: Positive


class _Parameters(Settings):
    """As :func:`design_parameters` writes them."""

    noise_px: NonNegative
    air_path: AirPathModel
    coarse_per_s: NonNegative
    settings: dict[str, dict[str, Any]]
    lines: Annotated[list[_Line], Field(default_factory=list, max_length=_MOST_LINES)]
    guard: _Line | None = None
    mirror_gain: Annotated[float, Field(ge=LEAST_GAIN, le=1 / LEAST_GAIN)] = 1.0
    overshoot: Annotated[float, Field(ge=-MOST_OVERSHOOT, le=MOST_OVERSHOOT)] = 0.0
    writes_per_frame: Annotated[float, Field(ge=1, multiple_of=1)] = 1


def basis_of(parameters: Mapping[str, Any], rig_basis: Basis) -> Basis:
    """The basis that a design with these parameters was made for; the rest is the rig's.

    Raises
    ------
    ValueError
        If these are no :func:`design_parameters`; with one line that names what is wrong.
    """
    settings = rig_basis.settings
    try:
        given = _Parameters.model_validate(parameters)
        sections = {
            name: type(getattr(settings, name)).model_validate(values)
            for name, values in given.settings.items()
            if isinstance(getattr(settings, name, None), Settings)
        }
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"]))
        got = repr(problem["input"])[:_QUOTED]
        msg = (
            f"{where}: {problem['msg']}, got {got}" if where else "expected an object of parameters"
        )
        raise ValueError(msg) from None
    if given.writes_per_frame > rig_basis.writes:
        msg = (
            f"writes_per_frame {given.writes_per_frame:g}, but the rig file's fsm.dac allows "
            f"{rig_basis.writes}"
        )
        raise ValueError(msg)
    return replace(
        rig_basis,
        noise_px=given.noise_px,
        air_path=given.air_path,
        coarse_per_s=given.coarse_per_s,
        settings=settings.model_copy(update=sections),
        lines=tuple(Line(**line.model_dump()) for line in given.lines),
        guard=None if given.guard is None else Line(**given.guard.model_dump()),
        mirror_gain=given.mirror_gain,
        overshoot=given.overshoot,
        writes=int(given.writes_per_frame),
    )
