"""Runs a target until told to stop; options and corpora as libFuzzer has them: see ``-help=1``."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from types import FunctionType

import atheris


def fuzz(one_input: Callable[[bytes], None]) -> None:
    """Coverage-guided, by atheris; of fitctl alone, whose libraries have thirty times as many functions."""
    for function in gc.get_objects():
        if isinstance(function, FunctionType) and (function.__module__ or "").startswith("fitctl"):
            atheris.instrument_func(function)
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
