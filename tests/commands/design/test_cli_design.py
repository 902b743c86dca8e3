"""`fitctl design` as a stranger meets it."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from samples.learner_reports import LINE, PAPER
from samples.log_samples import filled

from fitctl.cli import main
from fitctl.config import load_rig
from fitctl.controllers.design.files import save_design
from fitctl.controllers.design.margins import design_with_margins
from fitctl.daemon.run import run_info
from fitctl.logging.records import Tick
from fitctl.logging.writer import LogWriter

FLIGHT = [
    *("--set", "camera.frame_rate_hz=500.0"),
    *("--set", "camera.exposure_s=0.001"),
    *("--set", "camera.frame_delay_s=0.0035"),
]
LATE = ["--set", "camera.frame_delay_s=0.055"]


@pytest.fixture
def design(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["design", *map(str, arguments)])
        printed = capsys.readouterr()
        return end.value.code or 0, printed.out, printed.err

    return run


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["own/{}.py"], "expected 1 to 32 letters"),
        (["{}/own.py"], "no such file"),
        (["learn", "{}.mcap"], "File name too long"),
        (["vernier", "--out", "{}.json"], "File name too long"),
    ],
)
def test_a_name_that_no_file_can_have_is_one_line(design, arguments, why):
    status, _, error = design(*(argument.format(300 * "x") for argument in arguments))

    assert status == 2
    assert why in error
    assert error.count("\n") == 1


@pytest.mark.long
def test_a_design_that_is_there_is_overwritten_only_if_asked_to(design, tmp_path):
    path = tmp_path / "mine.json"
    path.write_text("precious")

    status, _, err = design("eq20", "--out", path)
    assert (status, err) == (
        2,
        f"design eq20: --out {path}: exists already; give another name, or pass --overwrite\n",
    )
    assert path.read_text() == "precious"
    assert design("eq20", "--out", path, "--overwrite")[0] == 0
    assert json.loads(path.read_text())["name"] == "eq20"


@pytest.mark.long
def test_the_vernier_in_json_has_what_the_paper_prints(design):
    status, out, _ = design("vernier", "--json")
    found = json.loads(out)
    assert status == 0
    assert len(found["poles"]) == 8
    assert len(found["zeros"]) == 7
    assert all(len(root) == 2 for root in found["poles"] + found["zeros"])
    assert found["order_removed"] == 2
    assert found["gain"] == pytest.approx(18.3, abs=0.2)
    assert found["distance_from_eq20_db"] < 0.5
    assert found["distance_from_eq20_deg"] < 2.0
    for hz in ("0.1", "0.5", "1", "2"):
        assert found[f"attenuation_{hz}hz"] > 1
    for key in ("crossover_hz", "phase_margin_deg", "gain_margin_db", "peak_sensitivity"):
        assert found[key] > 0


@pytest.mark.long
@pytest.mark.parametrize(("name", "magic"), [("fig9.png", b"\x89PNG"), ("fig9.svg", b"<?xml")])
def test_the_vernier_is_drawn(design, tmp_path, name, magic):
    status, _, _ = design("vernier", "--plot", tmp_path / name)
    assert status == 0
    assert (tmp_path / name).read_bytes().startswith(magic)


def test_the_bound_of_any_rig(design):
    assert json.loads(design("bound", "--json")[1])["residual_px"] == pytest.approx(
        0.0130, abs=5e-5
    )
    flight = json.loads(design("bound", "--json", *FLIGHT)[1])
    assert flight["rate_hz"] == pytest.approx(500)
    assert flight["residual_px"] < 0.004


@pytest.mark.parametrize(
    ("night", "residual_px"),
    [
        ("air_path.b1_s2=0.1", 0.0250),
        (
            "lines=[{frequency_hz=6.0, rms_px=0.05, direction_deg=90.0, damping=0.005, drift_hz_per_min=0.0}]",
            0.0245,
        ),
    ],
)
def test_the_bound_of_the_plants_night(design, night, residual_px):
    night = f"plant.loops.right.{night}"
    found = json.loads(design("bound", "--json", "--set", night)[1])
    assert found["residual_px"] == pytest.approx(0.0130, abs=5e-5)
    assert found["plant_residual_px"] == pytest.approx(residual_px, abs=5e-5)
    assert (
        f"plant.loops.right, worst axis: {residual_px:.4f} px" in design("bound", "--set", night)[1]
    )


def test_the_bound_says_which_part_of_a_night_that_changes_it_is_of(design):
    timeline = "plant.timeline=[{at_s=60.0, loops={right={loop_width_fraction=0.02}}}]"
    assert "before 60 s of plant.timeline" in design("bound", "--set", timeline)[1]


@pytest.mark.long
def test_the_coarse_loop_and_what_its_play_does(design):
    found = json.loads(design("coarse", "--json")[1])
    assert found["crossover_hz"] == pytest.approx(0.074, abs=1e-3)
    assert found["limit_cycle_alone"]["gain_hz"] > found["limit_cycle_beside_vernier"]["gain_hz"]
    assert all(part["bounded"] for part in found["deadzone"].values())


@pytest.mark.long
def test_all_designs_beside_the_bound(design):
    status, out, _ = design("compare")
    assert status == 0
    lines = out.splitlines()
    assert [line.split()[0] for line in lines] == [
        "design",
        "eq20",
        "lqg-ltr",
        "minimum-variance",
        "fslq",
        "bound",
    ]
    found = json.loads(design("compare", "--json")[1])
    ratios = {one["name"]: one["ratio_to_bound"] for one in found["designs"]}
    assert ratios["minimum-variance"] < 1.03 < ratios["eq20"]


@pytest.mark.long
def test_a_design_is_saved_and_can_be_chosen_by_its_file(design, tmp_path, capsys):
    path = tmp_path / "mine.json"
    status, out, _ = design("minimum-variance", "--out", path)
    assert status == 0
    assert f"written: {path} (name it in loops.right.vernier.controller)" in out
    assert "of the bound" in out
    with pytest.raises(SystemExit):
        main(
            [
                *("simulate", "--duration", "2", "--json"),
                *("--set", f"loops.right.vernier.controller={path}"),
            ]
        )
    assert json.loads(capsys.readouterr().out)["frames"] > 0


@pytest.mark.long
def test_a_saved_learnt_design_says_of_which_night_its_figures_are(design, tmp_path):
    path = tmp_path / "mine.json"
    night = dataclasses.replace(PAPER, lines=(LINE,))
    save_design(design_with_margins(night), path)

    assert "of the rig file's night" in design(path)[1]
    assert [line.split()[0] for line in design("compare", path)[1].splitlines()][-2] == "mine.json"


@pytest.mark.long
def test_a_saved_design_is_judged_as_it_was_saved_not_made_anew(design, tmp_path):
    path = tmp_path / "mine.json"
    other = ["--set", "loops.right.vernier.fslq.crossover_hz=2"]
    saved = json.loads(design("fslq", "--json", "--out", path, *other)[1])
    anew = json.loads(design("fslq", "--json")[1])
    status, out, _ = design(path, "--json")
    assert status == 0
    again = json.loads(out)
    theory, saved_theory = again.pop("theory"), saved.pop("theory")
    assert again == pytest.approx(saved)
    assert np.array(theory["sensitivity"]) == pytest.approx(np.array(saved_theory["sensitivity"]))
    assert anew["crossover_hz"] != pytest.approx(saved["crossover_hz"], rel=0.01)
    assert f"fslq of {path}" in design(path)[1]


@pytest.mark.long
@pytest.mark.parametrize("what", ["eq20", "coarse", "compare"])
def test_an_unstable_design_is_said_to_be_so(design, what):
    """Eq. 20 turns too far with two frames and three quarters of delay."""
    status, out, _ = design(what, *LATE)
    assert status == 0
    assert "unstable" in out
    assert "inf of" not in out


@pytest.mark.long
@pytest.mark.parametrize("what", ["vernier", "coarse", "bound", "fslq", "eq20", "lqg-ltr"])
def test_people_get_text_that_fits_their_terminal(design, what):
    status, out, err = design(what)
    assert (status, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 118


BAD_INPUT = {
    "something that is no design": (["everything"], "Available: vernier, coarse, bound"),
    "a file that is none": (["none.json"], "none.json: no such design file"),
    "a file of what was saved": (["none.json", "--out", "x.json"], "--out is for a design"),
    "a loop that is none": (["bound", "--loop", "left"], "has right"),
    "a plot of another kind": (
        ["vernier", "--plot", "fig9.bmp", "--out", "nowhere/x.json"],  # found before anything is written
        "--plot fig9.bmp: expected a name that ends in .png or .svg",
    ),
    "a plot of what has none": (["bound", "--plot", "bound.png"], "use it with vernier"),
    "a file of what is no pair": (["compare", "--out", "all.json"], "--out is for a design"),
    "a file that cannot be": (["eq20", "--out", "/dev/null/x.json"], "/dev/null/x.json"),
    "a file that no rig could name": (["eq20", "--out", "eq20.txt"], "must end in .json"),
    "a design for no disturbance": (
        ["bound", "--set", "loops.right.vernier.air_path.gain_px=0"], "air_path.gain_px",
    ),
    "values without a solution": (
        ["vernier", "--set", "loops.right.vernier.lqg_ltr.measurement_noise=1e-300"], "no solution",
    ),
    "an unstable design to be saved": (["eq20", *LATE, "--out", "eq20.json"], "unstable"),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "said"), BAD_INPUT.values(), ids=BAD_INPUT.keys())
def test_what_cannot_be_is_one_line_and_status_2(design, arguments, said):
    status, _, err = design(*arguments)
    assert status == 2
    assert len(err.splitlines()) == 1
    assert said in err


# ---------------------------------------------------------------- learn; test_docs.py learns from a whole log


def test_learning_with_a_replaced_value_has_the_rest_of_the_logs_rig(design, tmp_path):
    """The loops of the shipped rig are others: with that rig, there would be no loop "left"."""
    rig = load_rig(Path("rigs/fit-testbed.toml"))
    with LogWriter(tmp_path / "night.mcap", rig.logging) as log:
        log.write(run_info(rig, "", 0.0, designs={}), 1000.0)
        log.write(filled(Tick, loop="left"), 1000.0)

    status, _, err = design(
        *("learn", tmp_path / "night.mcap", "--loop", "left"),
        *("--set", "loops.left.requirement_px=0.2"),
    )

    assert status == 2
    assert "learn: the longest piece in VERNIER at 50 Hz is 0 s" in err


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["learn"], "expected a LOG; name one"),
        (["compare", "--latest"], "only fitctl design learn --latest does"),
        (["learn", "missing.mcap"], "missing.mcap"),
        (["learn", "night.mcap", "--out", "learnt.toml"], "must end in .json"),
        (["learn", "night.mcap", "--plot", "x.png"], "--plot draws Fig. 9: use it with vernier"),
        (["bound", "night.mcap"], "reads no log, got night.mcap"),
    ],
)
def test_learning_without_what_it_needs_is_one_line(design, arguments, why):
    status, out, printed = design(*arguments)

    assert status == 2
    assert not out
    assert why in printed
    assert len(printed.splitlines()) == 1
