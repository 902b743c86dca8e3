"""Compiling plain functions with numba, where it is installed (extra ``fast``).

Physics and control laws that simulations call most are plain scalar functions, marked with
:func:`compilable`. The live loop, and everything without numba, calls them as they are; :func:`compiled`
gives the machine code of one of them, into which the marked functions that it calls are compiled too.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_Function = TypeVar("_Function", bound=Callable[..., Any])
_PACKAGES = Path(__file__).parents[2]
_IMPORT = re.compile(rb"^(?:from|import) (fitctl[\w.]*)(?: import (\([^)]*\)|.*))?", re.M)
_options: dict[Callable[..., Any], dict[str, Any]] = {}  # of all marked functions
_registered: set[Callable[..., Any]] = set()  # with numba
_COMPILES_S = 300.0  # the longest takes a slow computer half of that
_SAVES_S = 10.0


def compilable(*, inline: bool = False, fused: bool = False) -> Callable[[_Function], _Function]:
    """Mark a plain function that compiled code may call.

    Parameters
    ----------
    inline : bool
        Put its code into every compiled function that calls it: for what a run calls most.
    fused : bool
        Products may go into sums without rounding in between: not for times.
    """

    def mark(function: _Function) -> _Function:
        options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "forceinline": inline}
        _options[function] = options | ({"fastmath": {"contract"}} if fused else {})
        return function

    return mark


@functools.cache
def numba_installed() -> bool:
    """Whether :func:`compiled` compiles."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True


@functools.cache
def compiled(function: _Function) -> _Function:
    """A marked function, compiled at its first call; the function itself without numba.

    The machine code of the package's own functions is kept for other processes, if its folder can be written.
    """
    if not numba_installed():
        return function
    from numba import njit
    from numba.core import config as module
    from numba.core import types
    from numba.extending import register_jitable

    config: Any = module  # its options are made when it is imported
    kinds: Any = types
    kinds.Record.mangling_args = property(_of_its_layout)
    for marked in _options.keys() - _registered:
        register_jitable(**_options[marked])(marked)
    _registered.update(_options)
    options = _options[function]
    if not function.__module__.startswith("fitctl."):
        return njit(**options)(function)
    folder = cache_folder(function.__module__)
    given, config.CACHE_DIR = config.CACHE_DIR, str(folder)
    try:
        return _compiled_once(njit(cache=True, **options)(function), folder)
    except RuntimeError:  # the folder cannot be written: each process compiles anew
        return njit(**options)(function)
    finally:
        config.CACHE_DIR = given


def _of_its_layout(kind: Any) -> tuple[str, tuple[int]]:
    """What the names of compiled functions have of a record that they take.

    By itself numba numbers records as they come in a process. Code of two processes for different records would
    have the same names, and a third process that loads both would run one for the other.
    """
    return "Record", (int.from_bytes(hashlib.sha256(kind.name.encode()).digest()[:7]),)


def _compiled_once(made: Any, folder: Path) -> Any:
    """Of processes that need the same code one compiles it, and the others load it; one saves at a time.

    Numba names files by number: the first that its index lacks. Two processes that save code for different
    arguments at once would give both one name, and then run each other's code.
    """
    compile_overload, save_overload = made.compile, made._cache.save_overload

    def compile_once(signature: Any) -> Any:
        arguments = hashlib.sha256(str(signature).encode()).hexdigest()[:12]
        with (folder / f"{arguments}.lock").open("a") as held:  # until the file is closed
            _locked(held, _COMPILES_S)  # in vain: the other stands still, and this one compiles too
            return compile_overload(signature)

    def save_alone(signature: Any, data: Any) -> None:
        with (folder / "saving.lock").open("a") as held:
            if _locked(held, _SAVES_S):
                save_overload(signature, data)

    made.compile, made._cache.save_overload = compile_once, save_alone
    return made


def _locked(file: IO[str], within_s: float) -> bool:
    """Whether a lock could be had in time."""
    until_s = time.monotonic() + within_s
    while time.monotonic() < until_s:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.05)
        else:
            return True
    return False


def record(values: Mapping[str, Any]) -> NDArray[np.void]:
    """Values by name as one record, shape (), which compiled code receives as one argument."""
    arrays = {name: np.asarray(value) for name, value in values.items()}
    made = np.zeros((), [(name, array.dtype, array.shape) for name, array in arrays.items()])
    for name, array in arrays.items():
        made[name] = array
    return made


def cache_folder(module: str) -> Path:
    """Folder of machine code from a module, named by a hash of all source that may be compiled into it.

    Numba itself compiles anew only when the file of the outermost function changes, but functions of
    other files, and their constants, are compiled in: those of every module imported, directly or not.
    """
    sources = sources_of(module)
    digest = hashlib.sha256(b"".join(sources[path] for path in sorted(sources))).hexdigest()
    return _PACKAGES / "fitctl" / "__pycache__" / f"compiled-{digest[:12]}"


def sources_of(module: str) -> dict[Path, bytes]:
    """Source of a module of the package, of its parents and of all that they import, by file."""
    sources: dict[Path, bytes] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        path = _PACKAGES.joinpath(*name.split("."))
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if path in sources or not path.is_file():  # no file: a name imported from a module
            continue
        sources[path] = path.read_bytes()
        waiting.append(name.rpartition(".")[0] or name)
        for imported, names in _IMPORT.findall(sources[path]):
            origin = imported.decode()
            waiting.append(origin)
            waiting += [f"{origin}.{part}" for part in re.findall(r"\w+", names.decode())]
    return sources
