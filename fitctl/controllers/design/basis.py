"""What every design is made for: the numbers of one loop that control design needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from fitctl.config import AirPathModel, ConfigError, Rig, Vernier
from fitctl.model.optics import scales
from fitctl.model.scene import centroid_noise_px


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
        One standard deviation of one frame's centroid, Eq. 7.
    air_path : AirPathModel
        The disturbance, as identified.
    coarse_per_s : float
        Integrator gain of the coarse loop: 0.464 /s on FIT.
    mirror_range_px : float
        phi_max on the focal plane.
    settings : Vernier
        The designs' own parameters.
    """

    period_s: float
    delay_s: float
    noise_px: float
    air_path: AirPathModel
    coarse_per_s: float
    mirror_range_px: float
    settings: Vernier


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
        noise_px=centroid_noise_px(camera, loop.star_flux_dn, 7),
        air_path=loop.vernier.air_path,
        coarse_per_s=loop.coarse.gain_rad_per_m * scale.pixel_size_m * scale.motor_px_per_rad,
        mirror_range_px=scale.mirror_px_per_rad * loop.fsm.range_rad,
        settings=loop.vernier,
    )


def design_parameters(basis: Basis, *sections: str) -> dict[str, Any]:
    """What a design was made from, plain enough for a file: the loop, and sections of the settings."""
    return {
        "noise_px": basis.noise_px,
        "air_path": basis.air_path.model_dump(),
        "coarse_per_s": basis.coarse_per_s,
        "settings": {
            section: getattr(basis.settings, section).model_dump() for section in sections
        },
    }


def basis_of(parameters: Mapping[str, Any], rig_basis: Basis) -> Basis:
    """The basis that a design with these parameters was made for; the rest is the rig's.

    Raises
    ------
    KeyError, TypeError, ValueError
        If these are no :func:`design_parameters`.
    """
    settings = rig_basis.settings
    sections = {
        name: type(getattr(settings, name)).model_validate(values)
        for name, values in parameters["settings"].items()
        if name in type(settings).model_fields
    }
    return replace(
        rig_basis,
        noise_px=float(parameters["noise_px"]),
        air_path=AirPathModel.model_validate(parameters["air_path"]),
        coarse_per_s=float(parameters["coarse_per_s"]),
        settings=settings.model_copy(update=sections),
    )
