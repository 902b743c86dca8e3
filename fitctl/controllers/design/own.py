"""A controller of one's own: a Python file with a function that makes its design.

The file runs with the rights of whoever starts fitctl. So its name comes from a rig file or a command line
alone, never from a log, telemetry or a command: there, the design's matrices stand for it.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from fitctl.config import CONTROLLERS, ConfigError, is_name
from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.document import MATRICES, matrix_shapes
from fitctl.controllers.pair import INPUTS, LEARNT, OUTPUTS, Design
from fitctl.text import plain

SUFFIX = ".py"
FUNCTION = "design"


def own_design(path: Path, its_basis: Basis) -> Design:
    """Run a file, and make its design.

    Parameters
    ----------
    path : Path
        A Python file with a function ``design(basis)`` that returns a :class:`~fitctl.controllers.pair.Design`.
        The design is called by the file's name.
    its_basis : Basis
        Of the loop that it shall drive.

    Raises
    ------
    ConfigError
        One line: the file, what is wrong, what was expected.
    """
    name = path.stem.replace("_", "-").lower()
    if not is_name(name) or name in {*CONTROLLERS, LEARNT}:
        msg = (
            f"controller {path}: the file's name is the controller's: expected 1 to 32 letters, digits and _, "
            f"and none of {', '.join((*CONTROLLERS, LEARNT))}"
        )
        raise ConfigError(msg)
    make = _function(path)
    try:
        made = make(its_basis)
    except (Exception, SystemExit) as error:  # whatever the file does
        msg = f"controller {path}: {FUNCTION}(basis) raised {type(error).__name__}: {plain(str(error))}"
        raise ConfigError(msg) from error
    if not isinstance(made, Design):
        msg = (
            f"controller {path}: {FUNCTION}(basis) must return a fitctl.controllers.pair.Design, "
            f"returned {type(made).__name__}"
        )
        raise ConfigError(msg)
    try:
        json.dumps(made.parameters)
    except (TypeError, ValueError, RecursionError) as error:
        msg = (
            f"controller {path}: parameters must be numbers, texts, lists and dicts, which logs can hold: "
            f"{plain(str(error))}; of an array, use .tolist()"
        )
        raise ConfigError(msg) from None
    if not isinstance(made.parameters, dict):
        msg = f"controller {path}: parameters must be a dict, is {type(made.parameters).__name__}"
        raise ConfigError(msg)
    design = dataclasses.replace(made, name=name, own=True, file=str(path.absolute()))
    return checked(design, its_basis, str(path))


def _function(path: Path) -> Any:
    if not os.path.isfile(path):  # also where it cannot be examined
        msg = f"controller {path}: no such file; expected a Python file with a function {FUNCTION}(basis)"
        raise ConfigError(msg)
    spec = importlib.util.spec_from_file_location(f"fitctl_own_{path.stem}", path)
    if spec is None or spec.loader is None:
        msg = f"controller {path}: cannot be read as Python"
        raise ConfigError(msg)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        msg = f"controller {path}: cannot be run: {type(error).__name__}: {plain(str(error))}"
        raise ConfigError(msg) from error
    make = getattr(module, FUNCTION, None)
    if not callable(make):
        msg = f"controller {path}: has no function {FUNCTION}(basis)"
        raise ConfigError(msg)
    return make


def checked(design: Design, its_basis: Basis, origin: str) -> Design:
    """A design whose matrices are of the shapes that a pair needs, and numbers.

    Raises
    ------
    ConfigError
        If not, or it is for another frame rate or delay; errors begin with `origin`.
    """
    try:
        matrices: dict[str, Any] = {
            key: np.array(getattr(design, key), dtype=float) for key in MATRICES
        }
    except (TypeError, ValueError) as error:
        msg = f"controller {origin}: a, b, c, d must be matrices of numbers: {error}"
        raise ConfigError(msg) from None
    for key, shape in matrix_shapes(len(np.atleast_1d(matrices["a"]))).items():
        if matrices[key].size == 0 == np.prod(shape):
            matrices[key] = matrices[key].reshape(shape)
        if matrices[key].shape != shape:
            msg = (
                f"controller {origin}: {key} must be a matrix of shape {shape}, with the inputs "
                f"{', '.join(INPUTS)} and the outputs {', '.join(OUTPUTS)}; its shape is {matrices[key].shape}"
            )
            raise ConfigError(msg)
        if not (finite := np.isfinite(matrices[key])).all():
            row, column = np.argwhere(~finite)[0]
            msg = (
                f"controller {origin}: {key} must have finite numbers only; {key}[{row}, {column}] is "
                f"{matrices[key][row, column]}"
            )
            raise ConfigError(msg)
    if (design.period_s, design.delay_s) != (its_basis.period_s, its_basis.delay_s):
        msg = f"controller {origin}: period_s and delay_s must be those of the basis"
        raise ConfigError(msg)
    return dataclasses.replace(design, **matrices)
