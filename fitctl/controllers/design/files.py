"""Designs in files (JSON): with everything needed to make them again, and refused where they do not fit."""

from __future__ import annotations

import dataclasses
import json
import math
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fitctl.config import ConfigError, is_name
from fitctl.controllers.design.basis import Basis, basis_of
from fitctl.controllers.design.document import FORMAT, MATRICES, design_json, outputs_of
from fitctl.controllers.design.own import checked
from fitctl.controllers.pair import INPUTS, Design
from fitctl.files import read_regular

_MOST_BYTES = 1 << 20  # a hundred times a design's
# Matrices are written with all their digits; made again on another machine they differ by rounding, and
# by what a Riccati solution makes of that.
_ROUNDING = 1e-6


def save_design(design: Design, path: Path) -> None:
    """Write a design.

    Raises
    ------
    ConfigError
        If the file cannot be written.
    """
    try:
        path.write_text(design_json(design), encoding="utf-8")
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror}"
        raise ConfigError(msg) from None


def load_design(
    path: Path, rig_basis: Basis, makers: Mapping[str, Callable[[Basis], Design]]
) -> Design:
    """Read a design for a loop.

    Parameters
    ----------
    rig_basis : Basis
        Of the loop that it shall drive: rate and delay must be this loop's.
    makers : mapping
        By which a design is made again from its parameters, by name.

    Raises
    ------
    ConfigError
        One line: the file, what differs, what was expected, and what to do.
    """
    design = design_of(_document(path), path, rig_basis, makers)
    return dataclasses.replace(design, file=str(path.absolute()))


def design_of(
    document: Mapping[str, Any],
    path: Path,
    rig_basis: Basis,
    makers: Mapping[str, Callable[[Basis], Design]],
) -> Design:
    """A design from what a file of `path` has of it; as :func:`load_design`, also in what it raises."""
    wanted: dict[str, Any] = {
        "format": FORMAT,
        "inputs": list(INPUTS),
        "period_s": rig_basis.period_s,
        "delay_s": rig_basis.delay_s,
    }
    for key, expected in wanted.items():
        got = document.get(key)
        if not _same(got, expected):
            hint = "design it again for this rig: fitctl design ... --out FILE"
            raise _refusal(path, key, f"{_shown(expected)} for this rig", _shown(got), hint)
    name = str(document.get("name"))
    if document.get("own") is True and name not in makers and is_name(name):
        return _as_given(document, name, path, rig_basis)
    if name not in makers:
        hint = "use a file that this fitctl saved"
        raise _refusal(path, "name", f"one of {', '.join(makers)}", _shown(name), hint)
    try:
        again = makers[name](basis_of(document.get("parameters", {}), rig_basis))
    except (ValueError, ArithmeticError) as error:
        hint = "use a file that this fitctl saved for this rig"
        got = str(error) if isinstance(error, ValueError) else repr(error)
        raise _refusal(path, "parameters", f"those of {name}", got, hint) from None
    _check_outputs(document, path, again.writes)
    for key in MATRICES:
        if not _follows(document.get(key), getattr(again, key)):
            hint = "the file was changed, or made by another fitctl; design it again"
            expected = "the matrix that follows from its parameters"
            raise _refusal(path, key, expected, "another", hint)
    if document.get("hysteresis_inverse") is not again.hysteresis_inverse:
        got, hint = _shown(document.get("hysteresis_inverse")), "design it again"
        raise _refusal(path, "hysteresis_inverse", str(again.hysteresis_inverse), got, hint)
    return again


def _check_outputs(document: Mapping[str, Any], path: Path, writes: int) -> None:
    expected, got = outputs_of(writes), document.get("outputs")
    if got != expected:
        hint = "design it again for this rig: fitctl design ... --out FILE"
        raise _refusal(path, "outputs", f"{_shown(expected)} for this rig", _shown(got), hint)


def _as_given(document: Mapping[str, Any], name: str, path: Path, rig_basis: Basis) -> Design:
    """A design of the user's own making: there is nothing to make it from again but its matrices."""
    _check_outputs(document, path, 1)
    matrices: dict[str, Any] = {key: document.get(key) for key in MATRICES}
    given = Design(
        name=name,
        period_s=rig_basis.period_s,
        delay_s=rig_basis.delay_s,
        hysteresis_inverse=document.get("hysteresis_inverse") is True,
        parameters={},
        own=True,
        **matrices,
    )
    return checked(given, rig_basis, str(path))


def _document(path: Path) -> dict[str, Any]:
    try:
        # As floats, since an integer of hundreds of digits fits into nothing else.
        document = json.loads(read_regular(path, _MOST_BYTES), parse_int=float)
    except FileNotFoundError:
        msg = f"{path}: no such design file; make one with fitctl design ... --out FILE"
        raise ConfigError(msg) from None
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        msg = f"{path}: cannot be read as a design: {error}; make one with fitctl design ... --out FILE"
        raise ConfigError(msg) from None
    if not isinstance(document, dict):
        hint = "make one with fitctl design ... --out FILE"
        raise _refusal(path, "format", FORMAT, "no JSON object", hint)
    return document


def _same(got: object, expected: object) -> bool:
    if isinstance(expected, float):
        return isinstance(got, int | float) and math.isclose(got, expected, rel_tol=1e-9)
    return got == expected


def _follows(given: object, made: np.ndarray) -> bool:
    try:
        matrix = np.array(given, dtype=float)
    except (TypeError, ValueError):
        return False
    if matrix.shape != made.shape:
        return False
    return bool(np.allclose(matrix, made, rtol=_ROUNDING, atol=_ROUNDING))


def _shown(value: object) -> str:
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _refusal(path: Path, key: str, expected: str, got: str, hint: str) -> ConfigError:
    # Whatever the file held, one line reports it.
    return ConfigError(
        f"{path}: {key}: expected {expected}, got {textwrap.shorten(got, 120)}; {hint}"
    )
