"""From a name, or a file, to a design."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.linalg import LinAlgWarning

from fitctl.config import ConfigError, Rig
from fitctl.controllers.design.basis import Basis, basis, basis_of, on_its_mirror
from fitctl.controllers.design.eq20 import design_eq20
from fitctl.controllers.design.files import load_design
from fitctl.controllers.design.fslq import design_fslq
from fitctl.controllers.design.linear_loop.sampled import sampled_loop
from fitctl.controllers.design.lqg_ltr import design_lqg_ltr
from fitctl.controllers.design.margins import KEPT, Required, margins
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.design.own import SUFFIX, own_design
from fitctl.controllers.pair import LEARNT, Design

DESIGNS: dict[str, Callable[[Basis], Design]] = {
    "eq20": design_eq20,
    "lqg-ltr": design_lqg_ltr,
    "minimum-variance": design_minimum_variance,
    "fslq": design_fslq,
}


def design_for(
    rig: Rig, loop_name: str, controller: str = "", noise_px: float | None = None
) -> Design:
    """The design that a rig's loop asks for, or another by its name, its file (*.json, *.py) or its parameters.

    With `noise_px`, a shipped design is for that noise of the sensor, not the rig file's.

    Raises
    ------
    ConfigError
        If there is no such design, its file cannot be used with this rig, the rig's values have no
        solution, or the loop would be unstable.
    """
    chosen = controller or rig.stellar_loops[loop_name].vernier.controller
    its_basis = basis(rig, loop_name)
    if chosen.startswith("{"):  # first: whatever parameters end with, they are no file
        design = _learnt(chosen, its_basis)
    elif chosen.endswith(".json"):
        design = load_design(Path(chosen), its_basis, DESIGNS)
    elif chosen.endswith(SUFFIX):
        with solving(f"controller {chosen}", loop_name):
            design = own_design(Path(chosen), its_basis)
    elif chosen in DESIGNS:
        with solving(f"controller {chosen}", loop_name):
            design = DESIGNS[chosen](replace(its_basis, noise_px=noise_px or its_basis.noise_px))
    else:
        msg = (
            f"controller {chosen}: unknown; expected {', '.join(DESIGNS)}, a file (*.json) that "
            "`fitctl design` saved, or a Python file (*.py) of your own"
        )
        raise ConfigError(msg)
    if not sampled_loop(design, on_its_mirror(its_basis, design.parameters)).stable:
        msg = (
            f"controller {chosen}: unstable at {1 / its_basis.period_s:g} Hz with "
            f"{its_basis.delay_s * 1e3:g} ms of delay; choose another, fitctl design compare shows them all"
        )
        raise ConfigError(msg)
    return design


def _learnt(document_json: str, its_basis: Basis) -> Design:
    """From its parameters; it must keep the margins that every learnt design is made with.

    Raises
    ------
    ConfigError
        If these are no parameters of a design, or the design has not the margins.
    """
    advice = "look at what fitctl design learn makes of the log"
    try:
        document = json.loads(document_json)
        if not isinstance(document, dict) or str(document.get("name")) not in DESIGNS:
            msg = f"expected an object with the name of one of {', '.join(DESIGNS)}"
            raise ValueError(msg)
        its_basis = basis_of(document.get("parameters", {}), its_basis)
        design = DESIGNS[document["name"]](its_basis)
    except (ValueError, ArithmeticError, RecursionError) as error:
        why = str(error) if isinstance(error, ValueError) else repr(error)
        msg = f"controller {LEARNT}: its parameters cannot be used: {why}; {advice}"
        raise ConfigError(msg) from None
    required = Required()
    if margins(design, its_basis, required).excess(required) > KEPT:
        msg = f"controller {LEARNT}: its margins are not those that a learnt design must keep; {advice}"
        raise ConfigError(msg)
    return replace(design, learnt=True)


@contextmanager
def solving(
    what: str, loop_name: str, advice: str = "go back to those of rigs/fit-mock.toml one by one"
) -> Iterator[None]:
    """For the mathematics of designs: a problem without a solution is reported as the rig file's error.

    `advice` is what to do about it.

    Raises
    ------
    ConfigError
        One line, where numpy or scipy give up.
    """
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            # What comes of an ill-conditioned problem is judged: by stability and margins.
            warnings.simplefilter("ignore", LinAlgWarning)
            # scipy's own, which errstate does not reach:
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    except (ValueError, ArithmeticError) as error:
        where = f"camera and loops.{loop_name}.vernier"
        msg = f"{what}: no solution for these values of {where} ({error}); {advice}"
        raise ConfigError(msg) from None
