import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.controllers.design.basis import basis, basis_of
from fitctl.controllers.design.choose import DESIGNS, design_for
from fitctl.controllers.design.files import load_design, save_design


@pytest.fixture
def saved(tmp_path, fit):
    path = tmp_path / "pair.json"
    save_design(DESIGNS["minimum-variance"](fit), path)
    return path


def refusal(path, rig_basis):
    with pytest.raises(ConfigError) as refused:
        load_design(path, rig_basis, DESIGNS)
    text = str(refused.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text


def change(path, **values):
    document = json.loads(path.read_text()) | values
    path.write_text(json.dumps(document))


@pytest.mark.parametrize("name", DESIGNS)
def test_a_design_comes_back_as_it_was_saved(name, tmp_path, fit):
    design = DESIGNS[name](fit)
    save_design(design, tmp_path / "pair.json")
    back = load_design(tmp_path / "pair.json", fit, DESIGNS)
    assert (back.name, back.period_s, back.delay_s) == (name, fit.period_s, fit.delay_s)
    assert back.hysteresis_inverse == design.hysteresis_inverse
    for key in "abcd":
        assert getattr(back, key) == pytest.approx(getattr(design, key), rel=1e-9, abs=1e-12)


def test_a_file_says_what_it_is_and_in_which_units(saved):
    document = json.loads(saved.read_text())
    assert document["fitctl"]
    assert document["inputs"][0] == "error_px"
    assert document["outputs"] == ["mirror_px", "motor_step_px"]
    assert document["parameters"]["settings"]["minimum_variance"]["offload_per_s"] > 0


def test_a_design_for_several_writes_is_refused_where_the_rig_has_fewer(tmp_path, fit):
    several = dataclasses.replace(fit, writes=5)
    design = DESIGNS["minimum-variance"](several)
    path = tmp_path / "several.json"
    save_design(design, path)

    assert load_design(path, several, DESIGNS).writes == 5
    assert json.loads(path.read_text())["outputs"][-1] == "mirror_px of write 5"
    assert "got writes_per_frame 5, but the rig file's fsm.dac allows 1" in refusal(path, fit)


def test_a_design_for_one_write_serves_a_rig_that_could_have_more(saved, fit):
    several = dataclasses.replace(fit, writes=5)
    assert load_design(saved, several, DESIGNS).writes == 1


def test_it_brings_its_own_parameters_to_a_rig_that_has_others(tmp_path, fit, changed):
    stormy = DESIGNS["minimum-variance"](changed(fit, gain=3.0))
    save_design(stormy, tmp_path / "stormy.json")
    back = load_design(tmp_path / "stormy.json", fit, DESIGNS)
    assert back.c == pytest.approx(stormy.c)
    assert back.d != pytest.approx(DESIGNS["minimum-variance"](fit).d)


def test_another_rate_is_refused(saved, flight):
    text = refusal(saved, flight)
    assert "period_s" in text
    assert "0.002" in text
    assert "0.02" in text
    assert "design it again" in text


def test_another_delay_is_refused(saved, fit):
    text = refusal(saved, dataclasses.replace(fit, delay_s=0.038))
    assert "delay_s" in text
    assert "0.038" in text


def test_other_units_are_refused(saved, fit):
    inputs = ["error_m", "excess_px", "mirror_px", "motor_px", "target_px"]
    change(saved, inputs=inputs)
    assert "error_m" in refusal(saved, fit)


@settings(max_examples=12)
@given(data=st.data())
def test_a_matrix_that_does_not_follow_from_its_parameters_is_refused(tmp_path_factory, fit, data):
    path = tmp_path_factory.mktemp("designs") / "pair.json"
    save_design(DESIGNS["minimum-variance"](fit), path)
    document = json.loads(path.read_text())
    key = data.draw(st.sampled_from("abcd"))
    row = data.draw(st.sampled_from(document[key]))
    row[data.draw(st.integers(0, len(row) - 1))] += data.draw(st.sampled_from([1e-4, -1.0, 1e9]))
    path.write_text(json.dumps(document))
    assert f": {key}: " in refusal(path, fit)


@pytest.mark.parametrize(
    "values",
    [
        {"a": "nothing"},
        {"a": [[1.0], [2.0, 3.0]]},
        {"c": None},
        {"name": "best"},
        {"name": ["eq20"]},
        {"format": "fitctl design 0"},
        {"parameters": {}},
        {"parameters": None},
        {"parameters": {"noise_px": "much", "air_path": {}, "coarse_per_s": 1, "settings": {}}},
        {"hysteresis_inverse": False},
        {"period_s": "fast"},
        {"delay_s": float("nan")},
    ],
    ids=str,
)
def test_what_no_fitctl_saved_is_refused(saved, fit, values):
    change(saved, **values)
    refusal(saved, fit)


@given(content=st.binary(max_size=40))
def test_any_other_file_is_refused(tmp_path_factory, fit, content):
    path = tmp_path_factory.mktemp("designs") / "pair.json"
    path.write_bytes(content)
    refusal(path, fit)


def test_a_file_that_is_not_there_is_told_with_how_to_make_one(tmp_path, fit):
    assert "fitctl design" in refusal(tmp_path / "none.json", fit)


def test_a_place_where_nothing_can_be_written_is_told(tmp_path, fit):
    with pytest.raises(ConfigError, match="cannot be written"):
        save_design(DESIGNS["eq20"](fit), tmp_path / "no" / "such" / "folder.json")


# ---------------------------------------------------------------- chosen by name or file


@pytest.mark.parametrize("name", DESIGNS)
def test_a_rig_chooses_its_design_by_name(name):
    rig = load_rig(default_rig_path(), [f"loops.right.vernier.controller={name}"])
    assert design_for(rig, "right").name == name


def test_a_rig_chooses_its_design_by_file(saved):
    rig = load_rig(default_rig_path(), [f"loops.right.vernier.controller={saved}"])
    assert design_for(rig, "right").name == "minimum-variance"


def test_a_name_given_beside_the_rig_comes_first(rig):
    assert design_for(rig, "right", "fslq").name == "fslq"


def test_a_name_that_is_none_is_told_with_those_there_are(rig):
    with pytest.raises(ConfigError, match="eq20, lqg-ltr, minimum-variance, fslq"):
        design_for(rig, "right", "best")


def test_a_design_that_would_swing_is_refused():
    late = load_rig(default_rig_path(), ["camera.frame_delay_s=0.055"])
    design_for(late, "right", "minimum-variance")
    with pytest.raises(ConfigError, match="controller eq20: unstable at 50 Hz with 55 ms of delay"):
        design_for(late, "right", "eq20")


def test_a_file_too_large_for_a_design_is_refused(tmp_path, fit):
    path = tmp_path / "pair.json"
    path.write_text("[" + "1," * 600_000 + "1]")
    assert "more than 1 MiB" in refusal(path, fit)


def test_a_learnt_design_of_more_lines_than_anybody_finds_is_refused(fit):
    line = {"frequency_hz": 6.0, "damping": 0.01, "rms_px": 0.01}
    air = {"gain_px": 0.45, "b1_s2": 0.517, "b2_s": 2.5}
    night = {"noise_px": 0.01, "air_path": air, "coarse_per_s": 0.46, "settings": {}}

    with pytest.raises(ValueError, match="lines: List should have at most 32 items"):
        basis_of(night | {"lines": [line] * 300}, fit)


def test_what_is_no_section_of_settings_in_a_learnt_design_is_left_out(fit):
    air = {"gain_px": 0.45, "b1_s2": 0.517, "b2_s": 2.5}
    night = {"noise_px": 0.01, "air_path": air, "coarse_per_s": 0.46}

    of_night = basis_of(night | {"settings": {"controller": {}, "nothing": {}}}, fit)

    assert of_night.settings == fit.settings


def test_designs_are_the_same_each_time(rig):
    for make in DESIGNS.values():
        assert np.array_equal(make(basis(rig, "right")).a, make(basis(rig, "right")).a)
