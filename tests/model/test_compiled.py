"""Machine code is kept for other processes, and made anew when any source of it changes."""

import fcntl
import subprocess
import sys
from pathlib import Path

import pytest

import fitctl
from fitctl.model.compiled import numba_installed, sources_of

KERNEL = """
from fitctl.model.compiled import compilable, compiled
from fitctl.controllers.trial_rule import gained

@compilable()
def doubled(value):
    return 2 * gained(value)


kernel = compiled(doubled)
print(kernel(1.0), sum(kernel.stats.cache_hits.values()))
"""
RULE = """
from fitctl.loop.trial_gain import GAIN
from fitctl.model.compiled import compilable

@compilable()
def gained(value):
    return GAIN * value
"""


@pytest.fixture
def package(tmp_path):
    """A package with the real `compiled.py` and functions in three rooms."""
    copy = tmp_path / "fitctl"
    for name, source in {
        "__init__.py": "",
        "model/__init__.py": "",
        "model/compiled.py": Path(fitctl.__file__).parent.joinpath("model/compiled.py").read_text(),
        "controllers/__init__.py": "",
        "controllers/trial_rule.py": RULE,
        "loop/__init__.py": "",
        "loop/trial_gain.py": "GAIN = 3.0\n",
        "simulation/__init__.py": "",
        "simulation/trial_kernel.py": KERNEL,
        "tui/__init__.py": "",
    }.items():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_text(source)
    return copy


def run_kernel(package):
    """Value, and how many compilations were found in the cache, of a new process."""
    done = subprocess.run(
        [sys.executable, "-c", "import fitctl.simulation.trial_kernel"],
        cwd=package.parent, capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    value, hits = done.stdout.split()
    return float(value), int(hits)


@pytest.mark.long
@pytest.mark.skipif(not numba_installed(), reason="numba is not installed (extra `fast`)")
def test_machine_code_is_kept_until_a_constant_in_any_imported_module_changes(package):
    assert run_kernel(package) == (6.0, 0)
    (package / "tui" / "look.py").write_text("COLOUR = 1\n")  # which no kernel imports
    assert run_kernel(package) == (6.0, 1)

    (package / "loop" / "trial_gain.py").write_text("GAIN = 5.0\n")

    assert run_kernel(package) == (10.0, 0)


# Between looking for a name and saving under it, another process has time to do the same.
MEETING = """
import time
from numba.core.caching import IndexDataCacheFile
import numpy as np
load = IndexDataCacheFile._load_index
def slow_load(self):
    found = load(self)
    time.sleep(0.5)
    return found
IndexDataCacheFile._load_index = slow_load
from fitctl.simulation.trial_kernel import kernel
print([float(kernel(one)) for one in {arguments}], sum(kernel.stats.cache_hits.values()))
"""


@pytest.mark.long
@pytest.mark.skipif(not numba_installed(), reason="numba is not installed (extra `fast`)")
def test_processes_that_save_code_for_different_arguments_at_once_keep_their_own(package):
    def started(arguments):
        program = MEETING.format(arguments=arguments)
        return subprocess.Popen(
            [sys.executable, "-c", program], cwd=package.parent, stdout=subprocess.PIPE, text=True
        )

    run_kernel(package)
    both = [started("[1]"), started("[np.float32(1.0)]")]
    for one in both:
        assert one.communicate(timeout=60)[0].splitlines()[-1].startswith("[6.0]")
    third = started("[1.0, 1, np.float32(1.0)]").communicate(timeout=60)[0]

    assert third.splitlines()[-1] == "[6.0, 6.0, 6.0] 3"


@pytest.mark.long
@pytest.mark.skipif(not numba_installed(), reason="numba is not installed (extra `fast`)")
def test_of_processes_that_need_the_same_code_one_compiles_and_the_other_loads_it(package):
    program = "from fitctl.simulation.trial_kernel import kernel"
    both = [
        subprocess.Popen(
            [sys.executable, "-c", program], cwd=package.parent, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]

    assert sorted(one.communicate(timeout=60)[0] for one in both) == ["6.0 0\n", "6.0 1\n"]


@pytest.mark.long
@pytest.mark.skipif(not numba_installed(), reason="numba is not installed (extra `fast`)")
@pytest.mark.parametrize(("stands_still", "saved"), [("[0-9a-f]*.lock", 1), ("saving.lock", 0)])
def test_a_process_that_stands_still_while_it_compiles_or_saves_holds_up_no_other_for_long(
    package, stands_still, saved
):
    source = package / "model" / "compiled.py"
    text = source.read_text()
    for limit in ("_COMPILES_S = 300.0", "_SAVES_S = 10.0"):
        assert limit in text
        text = text.replace(limit, limit.partition(" = ")[0] + " = 0.5")
    source.write_text(text)
    assert run_kernel(package) == (6.0, 0)
    (folder,) = (package / "__pycache__").glob("compiled-*")
    for code in folder.rglob("*.nb?"):
        code.unlink()

    (lock,) = folder.glob(stands_still)
    with lock.open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert run_kernel(package) == (6.0, 0)
        assert run_kernel(package) == (6.0, saved)


NAMED = """
from fitctl.model.compiled import compilable, compiled, record

@compilable()
def kernel(values):
    return values.second

made = compiled(kernel)
made(record({fields}))
print(*(one.fndesc.mangled_name for one in made.overloads.values()))
"""


@pytest.mark.long
@pytest.mark.skipif(not numba_installed(), reason="numba is not installed (extra `fast`)")
def test_code_for_different_records_has_different_names_in_all_processes():
    """As it was found: loaded into one process, the code of two rigs ended it (segmentation fault)."""
    one, other, again = (
        subprocess.run(
            [sys.executable, "-c", NAMED.format(fields=fields)],
            capture_output=True, text=True, check=True, timeout=60,
        ).stdout
        for fields in (
            {"first": 1.0, "second": 2.0},
            {"second": 2.0, "first": 1.0},
            {"first": 3.0, "second": 4.0},
        )
    )  # fmt: skip

    assert one != other
    assert one == again


@pytest.mark.long
def test_the_source_read_is_that_of_every_module_that_the_batchs_imports_load():
    program = (
        "import sys, fitctl.simulation.batch.run\n"
        "print(*(name for name in sys.modules if name.startswith('fitctl')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    root = Path(fitctl.__file__).parents[1]

    sources = sources_of("fitctl.simulation.batch.run")

    read = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        for path in sources
    }
    assert read >= set(done.stdout.split())
