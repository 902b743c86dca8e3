"""A controller of one's own: a Python file that the user names, and that nothing else can name."""

import json
from pathlib import Path

import numpy as np
import pytest
from documents import blocks

from fitctl.config import ConfigError, default_rig_path, load_rig, rig_from_log
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.files import save_design
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.controllers.design.own_process import design_in_own_process
from fitctl.controllers.design.standing import standing
from fitctl.messages.command_table import command_of
from fitctl.report.findings import find
from fitctl.report.run import find_run
from tests.samples.logged_simulation import LoggedSimulation

(EXAMPLE,) = (block.text for block in blocks("python") if "def design" in block.text)
RAN = "import pathlib; pathlib.Path(__file__).with_suffix('.ran').touch()\n"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "my_integrator.py"
    path.write_text(RAN + EXAMPLE)
    return path


def ran(file):
    """Whether the file has been run since this was asked last."""
    mark = file.with_suffix(".ran")
    found = mark.exists()
    mark.unlink(missing_ok=True)
    return found


def rig_with(file):
    return load_rig(default_rig_path(), [f"loops.right.vernier.controller={file}"])


@pytest.mark.long
def test_the_example_is_a_controller_between_the_bound_and_eq20(file):
    rig = rig_with(file)
    its_basis = basis(rig, "right")
    mine = standing(design_for(rig, "right"), its_basis)

    assert mine.name == "my-integrator"
    eq20 = standing(design_for(rig, "right", "eq20"), its_basis)
    assert bound(its_basis).residual_px < mine.residual_px < eq20.residual_px


@pytest.mark.long
def test_it_holds_a_star(file, tmp_path):
    simulation = LoggedSimulation(rig_with(file), tmp_path / "run.mcap")
    simulation.acquire()
    simulation.run(20.0)

    errors = [tick.error_az_px for tick in simulation.ticks[-500:]]
    assert simulation.ticks[-1].mode == "VERNIER"
    assert np.sqrt(np.mean(np.square(errors))) < 0.04


@pytest.mark.long
def test_another_process_makes_the_same_design(file):
    rig = rig_with(file)
    here, there = design_for(rig, "right"), design_in_own_process(rig, "right")

    assert there.file == here.file == str(file)
    assert there.own
    for key in "abcd":
        np.testing.assert_array_equal(getattr(here, key), getattr(there, key))


def test_saved_as_matrices_it_needs_no_python(file, tmp_path):
    rig, saved = rig_with(file), tmp_path / "mine.json"
    design = design_for(rig, "right")
    save_design(design, saved)
    assert ran(file)

    again = design_for(rig, "right", str(saved))
    assert not ran(file)
    for key in "abcd":
        np.testing.assert_array_equal(getattr(design, key), getattr(again, key))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("def design(basis", "cannot be run: SyntaxError"),
        ("raise OSError('no')", "cannot be run: OSError: no"),
        ("raise OSError('one\\ntwo')", r"cannot be run: OSError: one\\ntwo"),
        ("import sys\nsys.exit(0)", "cannot be run: SystemExit: 0"),
        ("def design(basis):\n    raise SystemExit", "raised SystemExit"),
        ("x = 1", "has no function design"),
        ("def design(basis):\n    return 1 / 0", "raised ZeroDivisionError"),
        ("def design(basis):\n    return None", "returned NoneType"),
        (
            EXAMPLE.replace("c=np.array([[1.0], [part]])", "c=np.eye(3)"),
            "c must be a matrix of shape",
        ),
        (
            EXAMPLE.replace("a=np.array([[1.0 - part]])", "a=1.0 - part"),
            r"a must be a matrix of shape \(1, 1\), .*; its shape is \(\)",
        ),
        (
            EXAMPLE.replace("c=np.array([[1.0], [part]])", "c=1.0"),
            r"c must be a matrix of shape \(2, 1\), .*; its shape is \(\)",
        ),
        (
            EXAMPLE.replace('{"gain": gain}', '{"gain": mirror}'),
            "parameters must be numbers, .*: Object of type ndarray .*; of an array, use .tolist()",
        ),
        (EXAMPLE.replace('{"gain": gain}', "[gain]"), "parameters must be a dict, is list"),
        (
            EXAMPLE.replace("0.8 *", "float('nan') *"),
            r"b must have finite numbers only; b\[0, \d\] is nan",
        ),
        (
            EXAMPLE.replace("delay_s=basis.delay_s", "delay_s=1.0"),
            "period_s and delay_s must be those",
        ),
        (EXAMPLE.replace("0.8 *", "8.0 *"), "unstable at 50 Hz"),
    ],
)
def test_a_file_that_makes_no_controller_is_one_line(file, text, said):
    file.write_text(text)

    with pytest.raises(ConfigError, match=said) as caught:
        design_for(rig_with(file), "right")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["eq20.py", "learnt.py", "a b.py", "x" * 40 + ".py"])
def test_a_file_has_a_name_of_its_own(file, name):
    other = file.with_name(name)
    file.rename(other)

    with pytest.raises(ConfigError, match="the file's name is the controller's"):
        design_for(rig_with(other), "right")


def test_a_file_that_is_not_there_is_named(file):
    with pytest.raises(ConfigError, match="no such file"):
        design_for(rig_with(file.with_name("other.py")), "right")


# ---------------------------------------------------------------- a log names files that nobody trusts


@pytest.fixture
def log(file, tmp_path):
    """A run with that controller; since then the file does something else."""
    path = tmp_path / "run.mcap"
    simulation = LoggedSimulation(rig_with(file), path)
    simulation.acquire()
    simulation.run(42.0)
    simulation.writer.close()
    assert ran(file)
    return path


@pytest.mark.long
@pytest.mark.parametrize("arguments", [[], ["--set", "loops.right.requirement_px=0.05"]])
def test_a_replay_uses_the_logged_matrices_and_never_runs_the_file(
    fitctl_main, file, log, arguments
):
    status, out = fitctl_main("replay", log, *arguments)

    assert status == 0
    assert out.splitlines()[-1] == "the same, to the last bit"
    assert not ran(file)


@pytest.mark.long
def test_a_report_never_runs_the_file(file, log):
    loop = find(find_run([log])).loops["right"]

    assert [held.controller for held in loop.held_by_controller] == ["my-integrator"]
    assert loop.rejections[0].predicted is not None
    assert not ran(file)


@pytest.mark.long
def test_the_user_may_name_the_file_for_a_replay(fitctl_main, file, log):
    status, out = fitctl_main("replay", log, "--controller", file)

    assert status == 0
    assert "expected on the same night with my-integrator" in out
    assert ran(file)


@pytest.mark.parametrize("name", ["my_integrator.py", "../x.py", "x.json", "x.PY", "pid", "{}"])
def test_no_text_of_a_log_becomes_a_controller(name, tmp_path):
    document = json.loads(load_rig(default_rig_path()).model_dump_json())
    document["loops"]["right"]["vernier"]["controller"] = name

    with pytest.raises(ConfigError, match="controller: is missing"):
        rig_from_log(json.dumps(document), "a log")


def test_no_command_names_a_file(file):
    with pytest.raises(ConfigError):
        command_of("controller", [str(file)], "right")
    assert not ran(file)


@pytest.fixture
def fitctl_main(capsys):
    from fitctl.cli import main

    def run(*words):
        with pytest.raises(SystemExit) as end:
            main(list(map(str, words)))
        return end.value.code or 0, capsys.readouterr().out

    return run


def test_the_example_is_the_documented_one():
    assert "my_integrator.py" in Path(__file__).parents[3].joinpath("docs/designing.md").read_text()
