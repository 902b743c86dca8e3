"""From a name, or a file, to a design."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fitctl.config import ConfigError, Rig
from fitctl.controllers.design.basis import Basis, basis
from fitctl.controllers.design.eq20 import design_eq20
from fitctl.controllers.design.files import load_design
from fitctl.controllers.design.fslq import design_fslq
from fitctl.controllers.design.lqg_ltr import design_lqg_ltr
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.pair import Design

DESIGNS: dict[str, Callable[[Basis], Design]] = {
    "eq20": design_eq20,
    "lqg-ltr": design_lqg_ltr,
    "minimum-variance": design_minimum_variance,
    "fslq": design_fslq,
}


def design_for(rig: Rig, loop_name: str, controller: str = "") -> Design:
    """The design that a rig's loop asks for, or another by its name or its file (*.json).

    Raises
    ------
    ConfigError
        If there is no such design, or its file cannot be used with this rig.
    """
    chosen = controller or rig.loops[loop_name].vernier.controller
    if chosen.endswith(".json"):
        return load_design(Path(chosen), basis(rig, loop_name), DESIGNS)
    if chosen not in DESIGNS:
        msg = (
            f"controller {chosen}: there are {', '.join(DESIGNS)}, and files (*.json) that "
            "`fitctl design` saved"
        )
        raise ConfigError(msg)
    return DESIGNS[chosen](basis(rig, loop_name))
