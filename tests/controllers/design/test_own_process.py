"""A design made by another process is the same design, and says why where there is none."""

import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.controllers.design.choose import DESIGNS, design_for
from fitctl.controllers.design.document import MATRICES, design_from_json, design_json
from fitctl.controllers.design.files import save_design
from fitctl.controllers.design.own_process import design_in_own_process, end_designs

RIG = load_rig(default_rig_path())


def same(one, other):
    for name in MATRICES:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert getattr(one, name).shape == getattr(other, name).shape
    rest = ("name", "period_s", "delay_s", "hysteresis_inverse", "parameters", "file")
    return all(getattr(one, name) == getattr(other, name) for name in rest)


@pytest.mark.long
@pytest.mark.parametrize("controller", DESIGNS)
def test_it_is_the_design_that_this_process_makes_bit_for_bit(controller):
    assert same(
        design_in_own_process(RIG, "right", controller), design_for(RIG, "right", controller)
    )


@pytest.mark.parametrize("controller", DESIGNS)
def test_json_keeps_a_design_bit_for_bit(controller):
    design = design_for(RIG, "right", controller)
    assert same(design_from_json(design_json(design)), design)


@pytest.mark.long
def test_a_saved_design_is_found_from_the_same_folder(tmp_path, monkeypatch):
    save_design(design_for(RIG, "right", "fslq"), tmp_path / "mine.json")
    monkeypatch.chdir(tmp_path)
    made = design_in_own_process(RIG, "right", "mine.json")
    assert made.file == str(tmp_path / "mine.json")
    assert same(made, design_for(RIG, "right", "mine.json"))


@pytest.mark.long
def test_without_a_name_it_is_the_one_of_the_rig_file():
    assert design_in_own_process(RIG, "right").name == RIG.loops["right"].vernier.controller


@pytest.mark.long
def test_what_is_wrong_with_a_controller_is_reported_in_the_same_words():
    with pytest.raises(ConfigError) as here:
        design_for(RIG, "right", "pid")
    with pytest.raises(ConfigError) as there:
        design_in_own_process(RIG, "right", "pid")
    assert str(there.value) == str(here.value)


@pytest.fixture
def another_python(tmp_path, monkeypatch):
    """Puts a shell script in the place of Python."""

    def put(script):
        program = tmp_path / "python"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))

    return put


def test_a_process_that_is_not_ready_in_time_is_killed(another_python, monkeypatch):
    another_python("exec sleep 30")
    started = []
    popen = subprocess.Popen

    def noted(*arguments, **options):
        started.append(popen(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", noted)
    with pytest.raises(ConfigError, match=r"controller eq20: .* not ready within 0\.5 s"):
        design_in_own_process(RIG, "right", "eq20", timeout_s=0.5)
    (process,) = started
    assert process.returncode == -signal.SIGKILL


def test_at_the_end_of_a_supervisor_a_process_that_designs_is_killed(another_python, tmp_path):
    begun = tmp_path / "begun"
    another_python(f"touch {begun}; exec sleep 30")
    with ThreadPoolExecutor(1) as executor:
        design = executor.submit(design_in_own_process, RIG, "right", "eq20")
        end_s = time.monotonic() + 20.0
        while not begun.exists():
            assert time.monotonic() < end_s, "it does not begin"
            time.sleep(0.01)
        end_designs()
        error = design.exception(20.0)

    assert "ended with signal 9" in str(error)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("echo first >&2; echo MemoryError >&2; exit 1", "ended with status 1: MemoryError; "),
        ("kill -9 $$", "ended with signal 9: it left no message; "),
    ],
)
def test_a_process_that_fails_is_reported_with_its_last_line(another_python, script, words):
    another_python(script)
    with pytest.raises(ConfigError, match=words):
        design_in_own_process(RIG, "right", "eq20")


def test_a_python_that_cannot_be_started_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "missing"))
    with pytest.raises(ConfigError, match=r"cannot be started: No such file"):
        design_in_own_process(RIG, "right", "eq20")


@pytest.mark.long
def test_what_asks_for_it_does_not_import_the_libraries_of_design():
    program = (
        "import sys; import fitctl.controllers.design.own_process; "
        "print([name for name in ('scipy', 'control', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert done.stdout.strip() == "[]"
