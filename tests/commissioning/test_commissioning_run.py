"""The course of a commissioning: order, repeats, corrections, what is kept."""

import math
import shutil

import pytest

from fitctl.commissioning import tasks
from fitctl.commissioning.outcome import Outcome, StepError
from fitctl.commissioning.page import changes, page, verdict
from fitctl.commissioning.record import Commissioning, Files, load
from fitctl.commissioning.run import Course, chosen, do, skip
from fitctl.commissioning.tasks import Step, tasks_of
from fitctl.config import ConfigError, default_rig_path, load_rig

pytestmark = pytest.mark.usefixtures("locks_of_its_own")
GEAR = {"loops": {"right": {"siderostat": {"spur_gear_ratio": 26.0}}}}


def step(run, *needs, of="star"):
    return Step("a step", of, lambda _site: "nothing", needs, 1.0, run)


def gear_of(site):
    return site.rig.loops["right"].siderostat.spur_gear_ratio


def corrects_the_gear(site):
    return Outcome(["seen"], {"gear": gear_of(site)}, {} if gear_of(site) == 26.0 else GEAR)


@pytest.fixture
def course(tmp_path):
    path = tmp_path / "rig.toml"
    shutil.copy(default_rig_path(), path)
    return again(path)


def again(path):
    files = Files(path, path.parent)
    return Course(path, (), files, load(files.record, "fit-mock"), lambda _line: None)


@pytest.fixture
def table(monkeypatch):
    def use(**table):
        monkeypatch.setattr(tasks, "STEPS", table)

    return use


def task(course, name):
    return chosen(tasks_of(course.rig()), [name])[0]


def test_a_correction_is_proved_by_a_second_measurement_and_kept(course, table):
    table(gear=step(corrects_the_gear))
    entry = do(course, task(course, "gear"))
    assert (entry.state, entry.figures["gear"]) == ("corrected", 26.0)
    assert entry.found == GEAR
    kept = load_rig(course.files.rig)
    assert kept.loops["right"].siderostat.spur_gear_ratio == 26.0
    original = load_rig(course.rig_path)
    assert original.loops["right"].siderostat.spur_gear_ratio == 25.0
    assert "# The default rig" in course.files.rig.read_text()


def test_a_corrected_step_keeps_what_it_measured_before(course, table):
    table(gear=step(corrects_the_gear))
    assert do(course, task(course, "gear")).figures == {
        "gear": 26.0,
        "gear before correction": 25.0,
    }


@pytest.mark.long
def test_an_estimate_is_taken_without_a_second_measurement(course, table):
    done = []
    table(
        gear=step(lambda site: done.append(site) or Outcome(found=GEAR, estimated=True)),
        later=step(lambda site: Outcome(figures={"gear": gear_of(site)}), "gear"),
    )
    assert do(course, task(course, "gear")).state == "measured"
    assert len(done) == 1
    assert do(course, task(course, "later")).figures == {"gear": 26.0}


@pytest.mark.long
def test_what_was_found_counts_above_what_set_says_also_for_processes_of_a_step(course, table):
    spots = [{"name": "fringe", "offset_px": {"az": 9.0, "el": -1.5}, "flux_dn": 400.0}]
    found = {"loops": {"right": GEAR["loops"]["right"] | {"other_spots": spots}}}
    table(
        gear=step(lambda _site: Outcome(found=found, estimated=True)),
        later=step(
            lambda site: started.append(load_rig(site.rig_path, site.overrides)) or Outcome()
        ),
    )
    started = []
    course = course._replace(
        overrides=("loops.right.siderostat.spur_gear_ratio=24.0", "loops.right.star_flux_dn=999.0")
    )
    for name in ("gear", "later"):
        do(course, task(course, name))
    (rig,) = started

    assert rig.loops["right"].siderostat.spur_gear_ratio == 26.0
    assert rig.loops["right"].other_spots[0].offset_px.el == -1.5
    assert rig.loops["right"].star_flux_dn == 999.0


def test_a_correction_that_helps_nothing_fails(course, table):
    table(gear=step(lambda _site: Outcome(found=GEAR)))
    entry = do(course, task(course, "gear"))
    assert entry.state == "failed"
    assert "still not as expected" in entry.trouble


@pytest.mark.parametrize("before", [{}, GEAR])
def test_a_correction_that_no_second_measurement_confirms_is_not_kept(course, table, before):
    measured = iter([26.0, 27.0])

    def corrects_once(_site):
        if (gear := next(measured, None)) is None:
            msg = "the star has left the field"
            raise StepError(msg)
        return Outcome(found={"loops": {"right": {"siderostat": {"spur_gear_ratio": gear}}}})

    if before:
        table(gear=step(corrects_the_gear))
        do(course, task(course, "gear"))
    table(gear=step(corrects_once))
    entry = do(course, task(course, "gear"))
    assert (entry.state, entry.trouble) == ("failed", "the star has left the field")
    assert entry.found == before
    gear = (before and 26.0) or 25.0
    assert load_rig(course.files.rig).loops["right"].siderostat.spur_gear_ratio == gear


def test_a_correction_that_the_rig_file_contradicts_is_named_and_not_written(course, table):
    far = {"loops": {"right": {"siderostat": {"spur_gear_ratio": 40.0}}}}
    table(gear=step(lambda _site: Outcome(found=far)))
    entry = do(course, task(course, "gear"))
    assert entry.state == "failed"
    assert "travel_sky_arcsec" in entry.trouble
    assert load_rig(course.files.rig).loops["right"].siderostat.spur_gear_ratio == 25.0


@pytest.mark.long
def test_a_later_step_works_with_what_earlier_ones_found_and_a_repeat_without_its_own(
    course, table
):
    seen = []
    table(
        gear=step(corrects_the_gear),
        later=step(lambda site: seen.append(gear_of(site)) or Outcome(), "gear"),
    )
    do(course, task(course, "gear"))
    do(course, task(course, "later"))
    assert seen == [26.0]
    first = []
    table(gear=step(lambda site: first.append(gear_of(site)) or Outcome()))
    do(course, task(course, "gear"))
    assert first == [25.0]


@pytest.mark.long
def test_another_result_of_a_repeat_makes_what_depends_on_it_to_do_again(course, table):
    well = step(lambda _site: Outcome(), "gear")
    table(gear=step(corrects_the_gear), later=well, aside=step(lambda _site: Outcome()))
    for name in ("gear", "later", "aside"):
        do(course, task(course, name))
    do(course, task(course, "gear"))
    assert course.record.done("right.later")  # the same was found
    table(gear=step(lambda _site: Outcome()), later=well, aside=well)
    do(course, task(course, "gear"))
    assert not course.record.done("right.later")
    assert "right.later" not in course.record.tasks


def test_the_record_goes_on_where_it_ended(course, table):
    table(one=step(lambda _site: Outcome()), two=step(lambda _site: Outcome(), "one"))
    assert course.missing(task(course, "two")) == ["right.one"]
    do(course, task(course, "one"))
    resumed = again(course.rig_path)
    assert resumed.missing(task(resumed, "two")) == []
    assert resumed.record == course.record


def test_a_step_that_stops_keeps_its_reason_and_its_figures(course, table):
    def stops(_site):
        raise StepError("the cable", {"furthest_rad": 0.01})

    table(one=step(stops))
    entry = do(course, task(course, "one"))
    assert (entry.state, entry.trouble, entry.figures) == (
        "failed",
        "the cable",
        {"furthest_rad": 0.01},
    )
    assert verdict(course.record, ["right.one"]) == "not commissioned: right.one failed"


def test_what_is_skipped_counts_as_done_with_its_reason(course, table):
    table(one=step(lambda _site: Outcome()))
    skip(course, task(course, "one"), "cloudy")
    assert course.record.done("right.one")
    assert course.record.tasks["right.one"].trouble == "cloudy"
    assert "skipped: right.one" in verdict(course.record, ["right.one"])


def test_a_rig_file_with_base_and_includes_keeps_them(tmp_path, table):
    shutil.copy(default_rig_path(), tmp_path / "under.toml")
    (tmp_path / "part.toml").write_text("camera = { bias_dn = 990.0 }\n")
    rig = tmp_path / "rig.toml"
    rig.write_text('base = "under.toml"\ninclude = ["part.toml"]\nname = "fit-mock"\n')
    course = again(rig)
    table(gear=step(corrects_the_gear))
    do(course, task(course, "gear"))
    kept = load_rig(course.files.rig)
    assert kept.camera.bias_dn == 990.0
    assert kept.loops["right"].siderostat.spur_gear_ratio == 26.0


@pytest.mark.parametrize("nearby", [True, False], ids=["beside the rig file", "elsewhere"])
def test_an_include_list_of_a_base_elsewhere_leads_to_the_same_files(tmp_path, table, nearby):
    """The rig files begin with the byte-order mark that some editors write."""
    table(one=step(lambda _site: Outcome()))
    under, out = tmp_path / "under", tmp_path if nearby else tmp_path / "out"
    for folder in {under, out} - {tmp_path}:
        folder.mkdir()
    whole = default_rig_path().read_text()
    (under / "whole.toml").write_text(f'include = ["part.toml"]\n{whole}', encoding="utf-8-sig")
    (under / "part.toml").write_text("[camera]\nframe_rate_hz = 40.0\n")
    rig = tmp_path / "rig.toml"
    rig.write_text('base = "under/whole.toml"\nname = "fit-mock"\n', encoding="utf-8-sig")
    files = Files(rig, out)
    course = Course(rig, (), files, load(files.record, "fit-mock"), lambda _line: None)
    do(course, task(course, "one"))

    assert load_rig(files.rig).camera.frame_rate_hz == 40.0


def test_a_rig_file_over_two_bases_keeps_the_include_list_of_the_lower_one(tmp_path, table):
    whole = default_rig_path().read_text()
    (tmp_path / "lowest.toml").write_text(f'include = ["part.toml"]\n{whole}')
    (tmp_path / "under.toml").write_text('base = "lowest.toml"\nname = "under"\n')
    (tmp_path / "part.toml").write_text("camera = { bias_dn = 990.0 }\n")
    rig = tmp_path / "rig.toml"
    rig.write_text('base = "under.toml"\nname = "fit-mock"\n')
    course = again(rig)
    table(gear=step(corrects_the_gear))
    do(course, task(course, "gear"))
    kept = load_rig(course.files.rig)
    assert kept.camera.bias_dn == 990.0
    assert kept.loops["right"].siderostat.spur_gear_ratio == 26.0


def test_another_rigs_record_is_refused(course, table):
    table(one=step(lambda _site: Outcome()))
    do(course, task(course, "one"))
    with pytest.raises(ConfigError, match="is of rig fit-mock"):
        load(course.files.record, "other")


def test_the_page_has_every_step_and_compares_figures(course, table):
    table(one=step(lambda _site: Outcome(["<i>"], {"x": 2.0})))
    do(course, task(course, "one"))
    earlier = Commissioning("fit-mock")
    earlier.enter("right.one", Outcome(figures={"x": 1.0}), 1.0)
    (change,) = changes(course.record, earlier)
    assert (change.now, change.then, change.relative) == (2.0, 1.0, 1.0)
    text = page(course.record, {"right.one": "a step", "right.two": "another"}, earlier)
    assert "&lt;i&gt;" in text
    assert "<i>" not in text
    assert "+100.0%" in text
    assert "to do" in text


def test_the_shipped_table_needs_only_steps_that_come_before(rig):
    before = set()
    for one in tasks_of(rig):
        assert set(one.needs()) <= before
        before.add(one.name)


@pytest.mark.long
def test_an_interrupted_repeat_leaves_the_commissioned_rig_file_whole(course, table):
    table(gear=step(corrects_the_gear))
    do(course, task(course, "gear"))

    def interrupted(_site):
        raise KeyboardInterrupt

    table(gear=step(interrupted))
    with pytest.raises(KeyboardInterrupt):
        do(course, task(course, "gear"))

    assert load_rig(course.files.rig).loops["right"].siderostat.spur_gear_ratio == 26.0


@pytest.mark.long
def test_a_repeat_that_fails_or_is_skipped_keeps_what_was_found_and_what_depends_on_it(
    course, table
):
    def fails(_site):
        msg = "the cable is off"
        raise StepError(msg)

    table(gear=step(corrects_the_gear), later=step(lambda _site: Outcome(), "gear"))
    do(course, task(course, "gear"))
    do(course, task(course, "later"))
    table(gear=step(fails), later=step(lambda _site: Outcome(), "gear"))
    failed = do(course, task(course, "gear"))
    skipped = skip(course, task(course, "gear"), "no cable")

    assert (failed.state, failed.found) == ("failed", GEAR)
    assert (skipped.state, skipped.found) == ("skipped", GEAR)
    assert course.record.done("right.later")
    assert load_rig(course.files.rig).loops["right"].siderostat.spur_gear_ratio == 26.0


def test_a_figure_without_a_limit_is_left_out_of_the_record(course, table):
    table(gear=step(lambda _site: Outcome(figures={"margin": math.inf, "gear": 25.0})))
    do(course, task(course, "gear"))

    assert again(course.rig_path).record.tasks["right.gear"].figures == {"gear": 25.0}


def test_files_elsewhere_name_the_same_dark_frame(tmp_path, table):
    (tmp_path / "there").mkdir()
    path = tmp_path / "rig.toml"
    path.write_text(f'base = "{default_rig_path()}"\n[camera]\ndark_file = "dark.npy"\n')
    files = Files(path, tmp_path / "there")
    files.write_rig({})

    assert load_rig(files.rig).camera.dark_file == str(tmp_path / "dark.npy")
