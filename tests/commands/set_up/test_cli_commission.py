"""`fitctl commission` on the command line: when it asks, what it refuses, what it lists."""

import json
import os

import pytest

from fitctl.cli import main
from fitctl.commissioning import tasks
from fitctl.commissioning.outcome import Outcome
from fitctl.commissioning.tasks import STEPS, Step
from fitctl.config import default_rig_path
from fitctl.processes import name_held

REAL = "loops.right.siderostat.device.channel=/dev/ttyACM0"


@pytest.fixture
def commission(capsys, tmp_path, monkeypatch, locks_of_its_own):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["commission", *arguments])
        captured = capsys.readouterr()
        return end.value.code or 0, captured.out + captured.err

    return run


@pytest.fixture
def two_steps(monkeypatch):
    """Two steps that move nothing; how often each was done."""
    done = []

    def step(name, *needs):
        def run(_site):
            done.append(name)
            return Outcome(figures={"x": float(len(done))})

        return Step(f"step {name}", "star", lambda _site: "nothing", needs, 1.0, run)

    monkeypatch.setattr(tasks, "STEPS", {"one": step("one"), "two": step("two", "one")})
    return done


def test_real_devices_are_never_commissioned_without_asking(commission):
    status, text = commission("--yes", "--set", REAL)
    assert status == 2
    assert "--yes is for mocks; these devices are real: right siderostat" in text


def test_without_a_terminal_it_asks_nobody(commission):
    status, text = commission()
    assert status == 2
    assert "needs a terminal" in text


def test_the_list_has_every_step_and_what_it_moves(commission, tmp_path):
    testbed = default_rig_path().with_name("fit-testbed.toml")
    status, text = commission("--list", "--rig", str(testbed), "--folder", str(tmp_path))
    assert status == 0
    for name in STEPS:
        assert name in text
    assert "each motor by 0.03 rad and back" in text


@pytest.mark.parametrize("words", [("--skip", "one=by hand"), ("--compare", "other.json")])
def test_the_list_refuses_options_of_a_run(commission, words):
    status, text = commission("--list", *words)
    assert status == 2
    assert "--list only lists the steps; leave out --skip and --compare" in text


def test_the_list_for_programs_has_what_each_step_needs_and_what_came_of_it(commission, two_steps):
    commission("--yes", "--until", "one")
    status, text = commission("--list", "--json")
    assert status == 0
    listed = json.loads(text)
    one, two = listed["tasks"]
    assert (one["name"], one["done"], one["entry"]["state"]) == ("right.one", True, "passed")
    assert (two["done"], two["entry"], two["missing"]) == (False, None, [])
    assert two["moves"] == "nothing"
    assert "1 of 2 steps to do" in listed["verdict"]


def test_a_console_needs_a_terminal(commission):
    status, text = commission("--console")
    assert status == 2
    assert "needs a terminal" in text


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--only", "nonsense"), "unknown step 'nonsense'. Available: devices"),
        (("--skip", "star"), "expected STEP=REASON"),
        (("--compare", "missing.json"), "missing.json"),
        (
            ("--folder", "/nowhere"),
            "/nowhere: no such folder; make it, or choose another with --folder",
        ),
        (("--folder", 300 * "x"), "no such folder"),
        (
            ("--only", "camera", "--until", "devices"),
            "--only camera comes after --until devices; leave one of them out",
        ),
        (("--console", "--only", "camera"), "leave out --only"),
    ],
)
def test_a_wrong_option_is_named(commission, arguments, named):
    status, text = commission("--yes", *arguments)
    assert status == 2
    assert named in text


@pytest.mark.long
def test_the_next_call_goes_on_where_the_last_one_ended(commission, two_steps):
    status, text = commission("--yes", "--until", "one")
    assert (status, two_steps) == (0, ["one"])
    assert "to do" in text
    status, text = commission("--yes")
    assert (status, two_steps) == (0, ["one", "two"])
    assert "fit-mock: commissioned" in text
    commission("--yes", "--only", "one")
    assert two_steps == ["one", "two", "one"]


def test_a_step_is_not_done_before_what_it_needs(commission, two_steps):
    status, text = commission("--yes", "--only", "two")
    assert status == 1
    assert two_steps == []
    assert "right.two: not before right.one" in text


def test_a_reason_stays_in_the_record(commission, two_steps):
    status, text = commission("--yes", "--json", "--skip", "one=no lamp tonight")
    assert (status, two_steps) == (0, ["two"])
    result = json.loads(text)
    assert result["tasks"]["right.one"]["state"] == "skipped"
    assert result["tasks"]["right.one"]["trouble"] == "no lamp tonight"
    assert result["verdict"].startswith("commissioned, except for what was skipped")


def test_what_is_skipped_is_not_done_even_by_its_name(commission, two_steps):
    status, _ = commission("--yes", "--skip", "one=no lamp tonight", "--only", "one")
    assert (status, two_steps) == (0, [])


def test_a_second_commissioning_of_the_same_record_is_refused(commission, two_steps, tmp_path):
    record = tmp_path.resolve() / "fit-mock.commissioning.json"
    with name_held(f"fitctl-commissioning:{record}"):
        status, text = commission("--yes", "--until", "one")
        assert commission("--list")[0] == 0

    assert (status, two_steps) == (2, [])
    assert f"another commissioning (process {os.getpid()}" in text
    assert not record.exists()


@pytest.mark.parametrize("name", ["commissioned.toml", "found.toml", "commissioning.html"])
def test_a_file_that_no_commissioning_wrote_is_not_overwritten(
    commission, two_steps, tmp_path, name
):
    path = tmp_path / f"fit-mock.{name}"
    path.write_text("precious")
    status, text = commission("--yes", "--until", "one")

    assert (status, two_steps) == (2, [])
    assert f"{path.name}: exists, and `fitctl commission` has not written it" in text
    assert path.read_text() == "precious"


def test_without_its_record_a_commissioning_begins_anew_over_its_own_files(
    commission, two_steps, tmp_path
):
    assert commission("--yes", "--until", "one")[0] == 0
    (tmp_path / "fit-mock.commissioning.json").unlink()

    assert commission("--yes", "--until", "one")[0] == 0
    assert two_steps == ["one", "one"]


def test_what_was_found_and_contradicts_the_rig_file_now_is_named_by_its_record(
    commission, two_steps, tmp_path
):
    commission("--yes", "--until", "one")
    record = tmp_path / "fit-mock.commissioning.json"
    document = json.loads(record.read_text())
    document["tasks"]["right.one"]["found"] = {"camera": {"frame_delay_s": 0.105}}
    record.write_text(json.dumps(document))
    status, text = commission("--list", "--set", "camera.frame_rate_hz=30.0")

    assert status == 2
    assert text.startswith(f"{record}: camera.frame_delay_s: must be below 0.08333 (is 0.105)")
    assert "repeat the step that found it with --only" in text


def test_a_name_that_no_rig_file_can_hold_is_refused_in_one_line(commission, two_steps, tmp_path):
    odd = tmp_path / os.fsdecode(b"bad\xff.toml")
    odd.write_bytes(default_rig_path().read_bytes())
    status, text = commission("--yes", "--rig", str(odd), "--until", "one")

    assert (status, two_steps) == (2, [])
    assert "its name is not UTF-8" in text
    assert text.count("\n") == 1
    assert list(tmp_path.iterdir()) == [odd]


@pytest.mark.long
def test_two_commissionings_are_compared(commission, two_steps, tmp_path):
    commission("--yes", "--until", "one")
    earlier = tmp_path / "earlier.json"
    (tmp_path / "fit-mock.commissioning.json").rename(earlier)
    status, text = commission("--yes", "--until", "one", "--compare", str(earlier))
    assert status == 0
    assert "+100.0%" in text
    assert "+100.0%" in (tmp_path / "fit-mock.commissioning.html").read_text()
    assert ["figure", "now", "earlier", "change"] in [line.split() for line in text.splitlines()]
    _, text = commission("--yes", "--json", "--until", "one", "--compare", str(earlier))
    (one, *_) = json.loads(text)["compared"]
    assert one["now"] == 2 * one["earlier"]
