"""Compiling by numba, where it is installed (extra ``fast``); without it everything runs on NumPy."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

_COMPILED_FROM = (
    "config/*.py",
    "model/*.py",
    "controllers/*.py",
    "simulation/batch/*.py",
    "messages/modes.py",
)


@functools.cache
def kernels() -> ModuleType | None:
    """The compiled kernels of the model, or None without numba; each compiles at its first call."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return None
    from fitctl.model import kernels as compiled

    return compiled


@functools.cache
def _cache_folder() -> str:
    """Where compiled code is kept: named by what all files say that kernels take code or constants from.

    Numba takes kept code for good as long as the outermost function's own file is unchanged, but
    kernels here call kernels of other files, and have the constants of others compiled in.
    """
    package = Path(__file__).parent.parent
    files = sorted(path for part in _COMPILED_FROM for path in package.glob(part))
    sources = b"".join(path.read_bytes() for path in files)
    return str(package / "__pycache__" / f"kernels-{hashlib.sha256(sources).hexdigest()[:12]}")


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel at its first call, and keep the result for other processes where that can be."""
    return _compiled(function)


def jit_inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """As :func:`jit`, and put into every kernel that calls it: for what a run calls most."""
    return _compiled(function, forceinline=True)


def jit_fused(function: Callable[..., Any]) -> Callable[..., Any]:
    """As :func:`jit_inlined`, but products may go into sums without rounding in between: not for times."""
    return _compiled(function, forceinline=True, fastmath={"contract"})


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    from numba import njit
    from numba.core import config as module

    config: Any = module  # its options are made when it is imported

    options |= {"nogil": True, "error_model": "numpy"}
    given, config.CACHE_DIR = config.CACHE_DIR, _cache_folder()
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # nowhere to write: it compiles anew in each process
        return njit(**options)(function)
    finally:
        config.CACHE_DIR = given
