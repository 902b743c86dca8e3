"""Sequence files: every mistake is one line that says where."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.config.conflict import short
from fitctl.sequences.behaviours.table import BEHAVIOURS
from fitctl.sequences.files import find_sequence, parse_yaml, shipped_sequences
from fitctl.sequences.reading import (
    STEPS,
    load_sequence,
    make_step,
    read_sequence,
    sequence_from_document,
)

RIG = load_rig(default_rig_path())
HEAD = 'schema_version = 1\nname = "tried"\ndescription = "Of a test."\n'


def mistakes(tmp_path, text, rig=RIG):
    path = tmp_path / "a.toml"
    path.write_text(HEAD + text)
    with pytest.raises(ConfigError) as caught:
        load_sequence(path, rig)
    return [line.removeprefix(f"{path}: ") for line in str(caught.value).splitlines()]


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ('step = "hold"', "step 1 (hold): duration_s: is missing"),
        ('step = "jog"', "step 'jog' is now 'dither'"),
        ('step = "target"', "step 'target' is now 'offset'"),
        ('step = "dither", jog_px = 1.0', "jog_px: unknown key; it is now dither_px"),
        ('step = "stars", on_failure = "stop"', "stop is now fail"),
        ('step = "hold", duration_s = -1.0', "step 1 (hold): duration_s: must be greater than 0"),
        ('step = "hold", duration_s = "long"', "step 1 (hold): duration_s: must be a valid number"),
        (
            'step = "wait", duration_s = 1.0, timeout = 1.0',
            "timeout: unknown key; did you mean timeout_s?",
        ),
        ('step = "hodl"', "unknown step 'hodl'. Available: standby, acquire, hold"),
        ("duration_s = 1.0", "step 1: step is missing"),
        ('step = "acquire", attempts = 0', "attempts: must be greater than or equal to 1"),
        ('step = "acquire", timeout_s = inf', "timeout_s: must be"),
        (
            'step = "acquire", loop = "left"',
            "step 1 (acquire): loop 'left': rig fit-mock has right",
        ),
        (
            'step = "acquire", field_overlap = 0.7',
            "field_overlap: must be less than or equal to 0.6",
        ),
        ('step = "acquire", search_radius_sky_arcsec = 1300.0', "would reach 1300 arcsec"),
        ('step = "acquire", expected_az_sky_arcsec = 3.0', "belong together"),
        (
            'step = "acquire", max_offset_sky_arcsec = 9.0, search_radius_sky_arcsec = 10.0',
            "search_radius_sky_arcsec passes max_offset_sky_arcsec, 9",
        ),
        (
            'step = "dither", dither_px = 4.0',
            "would go 5.66 px from its target; max_offset_px is 5",
        ),
        ('step = "dither", max_offset_sky_arcsec = 1.0', "max_offset_sky_arcsec is 1"),
        ('step = "dither", dither_px = 30.0, max_offset_px = 100.0', "a place is off the frame"),
        ('step = "dither", dwell_s = 5.0', "steady_after_s must be below dwell_s, 5 s"),
        ('step = "controller", name = "../a.json"', "name: must be"),
        ('step = "experiment", what = "response"', "what: must be"),
        ('step = "experiment", what = "hysteresis"', "max_offset_px is 5"),
        ('step = "chirp", channel = "stack1"', "channel: must be"),
        ('step = "chirp", channel = "fsm_az", to_hz = 1000.0', "frequencies must lie in"),
        ('step = "chirp", channel = "fsm_az", duration_s = 601.0', "duration_s: must be less"),
        ('step = "plate_scale", amplitude_px = 6.0', "max_offset_px is 5"),
    ],
)
def test_a_mistake_is_one_line_that_says_where(tmp_path, step, said):
    if step.endswith('"hysteresis"'):
        step += ", max_offset_px = 0.5"
        said = said.replace("is 5", "is 0.5")

    found = mistakes(tmp_path, f"steps = [{{ {step} }}]\n")

    assert len(found) == 1
    assert said in found[0]


def test_every_mistake_is_told(tmp_path):
    found = mistakes(
        tmp_path,
        'stpes = 1\nsteps = [{ step = "hold" }, { step = "wait", duration_s = 0 }, { step = "of" }]',
    )

    assert len(found) == 4


@pytest.mark.parametrize(
    ("text", "said"), [("", "steps: is missing"), ("steps = []", "steps: "), ("a = [", "not TOML")]
)
def test_what_is_no_sequence_is_refused(tmp_path, text, said):
    assert any(said in line for line in mistakes(tmp_path, text))


YAML_HEAD = "schema_version: 1\nname: tried\ndescription: Of a test.\n"
WRITTEN = {
    ".toml": HEAD + 'steps = [{ step = "wait", duration_s = 5.0 }]',
    ".yaml": YAML_HEAD + "steps:\n  - step: wait\n    duration_s: 5.0\n",
    ".yml": YAML_HEAD + "steps: [{step: wait, duration_s: 5}]",
}


@pytest.mark.parametrize("suffix", WRITTEN)
def test_toml_and_yaml_say_the_same(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text(WRITTEN[suffix])

    (step,) = load_sequence(path, RIG).steps

    assert (step.step, step.duration_s) == ("wait", 5.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "steps: [{step: wait\n",
            "not YAML: expected ',' or '}', but got '<stream end>' (at line 5",
        ),
        ("steps: 1\nsteps: 2\n", 'found duplicate key "steps" with value "2"'),
        ("steps:\n\t- step: off\n", "not YAML: found character '\\t'"),
        (
            "steps: [{step: off, loop: !!python/object:os.system x}]",
            "not YAML: could not determine",
        ),
        pytest.param(
            "steps: " + "[" * 5000, "not YAML: ", id="5000 brackets", marks=pytest.mark.long
        ),
        ("steps: [{step: off, loop: no}]", "loop 'no': rig fit-mock has right"),
        ("steps: [{step: wait, duration_s: 12:30}]", "must be a valid number (is '12:30')"),
        ("steps: [{step: wait, duration_s: yes}]", "must be a valid number (is 'yes')"),
        ("steps: [{step: off, 1: 2}]", "step 1"),
        ("steps: &a [*a]", "step 1"),
        ("steps: \x01", "not YAML: "),
    ],
)
def test_a_mistake_in_yaml_is_one_line_that_says_where(tmp_path, text, said):
    path = tmp_path / "a.yaml"
    path.write_text(YAML_HEAD + text)

    with pytest.raises(ConfigError) as caught:
        load_sequence(path, RIG)

    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{path}: ")
    assert said in line


@pytest.mark.parametrize("suffix", WRITTEN)
def test_a_byte_order_mark_is_no_part_of_a_sequence(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text(WRITTEN[suffix], encoding="utf-8-sig")

    assert load_sequence(path, RIG).steps[0].duration_s == 5.0


HUGE = "0x" + 4000 * "F"  # Python writes no number of more than 4300 digits
LONG = 4000 * "y"
SHORT = f"'{65 * 'y'}...{30 * 'y'}'"


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("step: wait, duration_s: HUGE", "duration_s: must be a valid number (is a number of"),
        ("step: HUGE", "unknown step 'a number of thousands of digits'"),
        ("step: off, ? HUGE : 1", "Keys should be strings"),
        ("step: LONG", f"unknown step {SHORT}. Available: standby"),
        ("step: off, loop: LONG", f"loop {SHORT}: rig fit-mock has right"),
        ("step: off, loop: [LONG]", "loop: must be a valid string"),
        ("step: wait, duration_s: LONG", f"must be a valid number (is {SHORT})"),
        ("step: off, ? LONG : 1", f"{short(LONG)}: unknown key"),
    ],
)
def test_a_long_value_is_shown_shortened(tmp_path, capfd, step, said):
    path = tmp_path / "a.yaml"
    step = step.replace("HUGE", HUGE).replace("LONG", LONG)
    path.write_text(YAML_HEAD + f"steps: [{{{step}}}]")

    with pytest.raises(ConfigError) as caught:
        load_sequence(path, RIG)

    assert said in str(caught.value)
    assert len(str(caught.value).removeprefix(str(path))) < 450
    assert capfd.readouterr().err == ""  # pydantic cannot show every number either


def test_steps_that_are_one_in_yaml_are_read_and_changed_each_alone(tmp_path):
    (tmp_path / "b.csv").write_text("name,az_sky_arcsec,el_sky_arcsec\nalpha,0,0\n")
    path = tmp_path / "a.yaml"
    path.write_text(YAML_HEAD + "steps:\n- &a {step: stars, file: b.csv}\n- *a\n")

    steps = load_sequence(path, RIG, ["steps.2.duration_s=60.0"]).steps

    assert [step.duration_s for step in steps] == [30.0, 60.0]
    assert steps[0].stars == steps[1].stars


@pytest.mark.parametrize("text", ["", "- 1", "no", "42"])
def test_yaml_without_keys_is_no_sequence(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)

    with pytest.raises(ConfigError, match="must have keys, such as schema_version: 1"):
        load_sequence(path, RIG)


@given(st.text(max_size=40))
def test_any_text_is_yaml_or_one_line(text):
    said = "a.yaml: not YAML: nothing"
    try:
        parse_yaml(text, Path("a.yaml"))
    except ConfigError as error:
        said = str(error)

    assert said.startswith("a.yaml: not YAML: ")
    assert len(said.splitlines()) == 1


def changed(tmp_path, *overrides):
    path = tmp_path / "a.toml"
    path.write_text(
        HEAD + 'steps = [{ step = "acquire" }, { step = "hold", duration_s = 5.0 },'
        ' { step = "hold", duration_s = 6.0 }]'
    )
    return load_sequence(path, RIG, overrides)


@pytest.mark.parametrize(
    ("override", "durations"),
    [
        ("steps.2.duration_s=60", [60.0, 6.0]),
        ("steps.3.duration_s=60.0", [5.0, 60.0]),
        ("steps.hold.duration_s=60.0", [60.0, 60.0]),
    ],
)
def test_a_steps_keys_are_set_by_its_number_or_its_name(tmp_path, override, durations):
    assert [step.duration_s for step in changed(tmp_path, override).steps[1:]] == durations


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("steps.4.duration_s=1.0", "there are 1 (acquire), 2 (hold), 3 (hold)"),
        ("steps.dither.dither_px=1.0", "expected steps.NUMBER.key=value or steps.NAME.key=value"),
        ("steps.2=1.0", "expected steps.NUMBER.key=value"),
        ("steps.2.duration=1.0", "duration: unknown key; did you mean duration_s?"),
        ("steps.2.duration_s", "expected key.path=value, for example steps.2.duration_s=60.0"),
    ],
)
def test_a_step_that_is_not_there_cannot_be_changed(tmp_path, override, said):
    with pytest.raises(ConfigError) as caught:
        changed(tmp_path, override)

    assert said in str(caught.value)


def test_where_a_rig_has_two_loops_each_step_names_its_own(tmp_path):
    document = tomllib.loads(default_rig_path().read_text())
    two = RIG.model_copy(update={"loops": {"left": RIG.loops["right"], **RIG.loops}})

    assert list(document["loops"]) == ["right"]
    assert mistakes(tmp_path, 'steps = [{ step = "hold", duration_s = 1.0 }]', two) == [
        "step 1 (hold): loop is missing: rig fit-mock has left, right"
    ]


@pytest.mark.parametrize(
    "rig", sorted(default_rig_path().parent.glob("*.toml")), ids=lambda p: p.stem
)
def test_shipped_sequences_are_well_for_every_shipped_rig(rig):
    settings = load_rig(rig)
    # With several loops, the steps of the others would have to name one.
    for path in shipped_sequences():
        suits = {
            "overlap": settings.fringes is not None,
            **dict.fromkeys(
                ("ambient", "feedforward", "photodiodes", "testbed"), settings.collector is not None
            ),
        }.get(path.stem, len(settings.loops) == 1)
        if suits:
            assert load_sequence(path, settings).name == path.stem


@pytest.mark.parametrize("path", shipped_sequences(), ids=lambda path: path.stem)
def test_a_sequence_that_was_read_is_a_sequence_in_any_folder(path):
    sequence = read_sequence(path)
    document = sequence.model_dump(exclude_none=True)

    assert sequence_from_document(document, "again.toml") == sequence
    for step in document["steps"]:
        assert make_step(STEPS[step["step"]], step).model_dump(exclude_none=True) == step


def test_every_step_has_a_behaviour():
    assert set(STEPS) == set(BEHAVIOURS)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=6,
)
keys = st.sampled_from(sorted({key for kind in STEPS.values() for key in kind.model_fields}))
documents = st.fixed_dictionaries(
    {"schema_version": st.just(1), "name": st.just("a"), "description": st.just("b")},
    optional={
        "steps": st.lists(
            st.dictionaries(keys | st.text(max_size=4), values)
            | st.builds(
                lambda step, rest: {**rest, "step": step},
                st.sampled_from(sorted(STEPS)),
                st.dictionaries(keys, values, max_size=4),
            )
            | values,
            max_size=3,
        )
    },
)


@pytest.mark.long
@given(documents)
def test_any_document_is_a_sequence_or_a_list_of_mistakes(document):
    mistakes_told, sequence = [], None
    try:
        sequence = sequence_from_document(document, "any.toml")
    except ConfigError as error:
        mistakes_told = str(error).split("\n")

    assert (sequence is None) == bool(mistakes_told)
    assert all(line.startswith("any.toml: ") for line in mistakes_told)
    if sequence is not None:
        assert sequence_from_document(sequence.model_dump(), "again.toml") == sequence


def test_a_folder_or_a_name_too_long_for_a_file_hides_no_shipped_sequence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dark").mkdir()

    assert find_sequence(Path("dark")).is_file()
    assert find_sequence(Path("a" * 300)) == Path("a" * 300)
