"""Nothing from a file or a socket is ever unpickled, or run as a program in another way."""

import ast
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import fitctl
from fitctl.config import default_rig_path, load_rig
from fitctl.identify.errors import IdentifyError
from fitctl.identify.response import read_bench

PACKAGE = Path(fitctl.__file__).parent
UNPICKLING = {"pickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
CALLS = {"recv_pyobj", "send_pyobj", "read_pickle", "to_pickle", "eval", "exec", "unsafe_load"}


def breaches(tree):
    """What in a module could run what it reads."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            names = []
        yield from UNPICKLING.intersection(name.partition(".")[0] for name in names)
        if isinstance(node, ast.Call):
            # `m.eval()` of somebody's object is another thing than the built-in one.
            called = getattr(node.func, "attr", None) or getattr(node.func, "id", "")
            if called in CALLS and (
                isinstance(node.func, ast.Name) or called not in {"eval", "exec"}
            ):
                yield called
            yield from (
                "allow_pickle"
                for keyword in node.keywords
                if keyword.arg == "allow_pickle"
                and not (isinstance(keyword.value, ast.Constant) and keyword.value.value is False)
            )


def test_no_module_of_fitctl_unpickles_or_evaluates():
    named = re.compile("|".join({*UNPICKLING, *CALLS, "allow_pickle"}))
    modules = {path: path.read_text() for path in PACKAGE.rglob("*.py")}
    found = {
        f"{path.relative_to(PACKAGE)}: {what}"
        for path, text in modules.items()
        if named.search(text)  # parsing all takes seconds
        for what in breaches(ast.parse(text))
    }
    assert found == set()


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from joblib import load",
        "np.load(path, allow_pickle=True)",
        "np.load(path, allow_pickle=given)",
        "socket.recv_pyobj()",
        "eval(text)",
    ],
)
def test_a_breach_would_be_found(line):
    assert list(breaches(ast.parse(line)))


class Program:
    def __reduce__(self):
        return pytest.fail, ("it was run",)


def objects(path):
    columns = ("time_s", "drive_v", "detector_az_v", "detector_el_v")
    np.savez(path, **{name: [Program()] for name in columns})


def bare(path):
    path.write_bytes(pickle.dumps(Program()))


@pytest.mark.parametrize("write", [objects, bare])
def test_a_bench_record_that_is_a_pickle_is_refused(write, tmp_path):
    path = tmp_path / "bench.npz"
    write(path)
    with pytest.raises(IdentifyError, match="not a bench record"):
        read_bench(path, load_rig(default_rig_path()).loops["right"].fsm)
