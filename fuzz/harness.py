"""Runs a target until told to stop; options and corpora as libFuzzer has them: see ``-help=1``."""

from __future__ import annotations

import sys
from collections.abc import Callable

import atheris


def fuzz(one_input: Callable[[bytes], None]) -> None:
    """Coverage-guided, by atheris."""
    atheris.instrument_all()
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
