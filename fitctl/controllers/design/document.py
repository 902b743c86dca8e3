"""A design as JSON, with everything needed to make it again: in files, in logs, between processes."""

from __future__ import annotations

import importlib.metadata
import json

import numpy as np

from fitctl.controllers.pair import INPUTS, OUTPUTS, Design

FORMAT = "fitctl design 1"
MATRICES = ("a", "b", "c", "d")


def matrix_shapes(states: int, writes: int = 1) -> dict[str, tuple[int, int]]:
    """Of the matrices of a design with so many states and writes of the D/A in a frame."""
    outputs = len(outputs_of(writes))
    return {
        "a": (states, states),
        "b": (states, len(INPUTS)),
        "c": (outputs, states),
        "d": (outputs, len(INPUTS)),
    }


def outputs_of(writes: int) -> list[str]:
    """What the outputs of a design with so many writes are."""
    return [*OUTPUTS, *(f"mirror_px of write {write}" for write in range(2, writes + 1))]


def design_json(design: Design) -> str:
    """A design with everything needed to make it again, as its file has it."""
    document = {
        "format": FORMAT,
        "fitctl": importlib.metadata.version("fitctl"),
        "name": design.name,
        "period_s": design.period_s,
        "delay_s": design.delay_s,
        "inputs": list(INPUTS),
        "outputs": outputs_of(design.writes),
        "hysteresis_inverse": design.hysteresis_inverse,
        "parameters": design.parameters,
        **({"learnt": True} if design.learnt else {}),
        **({"own": True} if design.own else {}),
        **{name: getattr(design, name).tolist() for name in MATRICES},
    }
    return json.dumps(document, indent=1) + "\n"


def parameters_json(design: Design) -> str:
    """Name and parameters of a design, as short as they can be: enough to make it again."""
    document = {"name": design.name, "parameters": design.parameters}
    return json.dumps(document, separators=(",", ":"))


def design_from_json(text: str) -> Design:
    """The design that :func:`design_json` wrote, bit for bit; for text of this process's own making.

    Nothing is compared with a rig: for files there is :func:`fitctl.controllers.design.files.load_design`.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the text is not one of :func:`design_json`.
    """
    document = json.loads(text)
    # A law without states has matrices of no rows, whose columns JSON does not keep.
    shapes = matrix_shapes(len(document["a"]), len(document["d"]) - 1)
    a, b, c, d = (np.array(document[name], dtype=float).reshape(shapes[name]) for name in MATRICES)
    return Design(
        document["name"],
        document["period_s"],
        document["delay_s"],
        a,
        b,
        c,
        d,
        document["hysteresis_inverse"],
        document["parameters"],
        learnt=document.get("learnt", False),
        own=document.get("own", False),
    )
