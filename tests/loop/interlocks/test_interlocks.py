"""The table of interlocks by itself: what trips a row, what it does then, and what ends it."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import QUANTITIES, ConfigError, Interlock, default_rig_path, load_rig
from fitctl.config.interlocks import ModeName
from fitctl.loop.interlocks import Interlocks
from fitctl.messages.modes import Mode
from tests.documents import between
from tests.documents import table as table_of

TICK_S = 0.02
FIRST, SECOND = "fsm_range_fraction", "dac_round_trip_s"


def row(**fields):
    return Interlock(
        **{
            "quantity": FIRST, "high": 1.0, "for_s": 0.1, "modes": ["VERNIER"],
            "action": "warn", "reset": "itself",
        }
        | fields
    )  # fmt: skip


def table(**fields):
    return Interlocks({"it": row(**fields)}, {"mirror": "mirror right"})


class Course:
    """A table that is shown one value after another, a tick each; None measures nothing."""

    def __init__(self, interlocks):
        self.interlocks, self.now_s, self.readings = interlocks, 0.0, {}

    def show(self, values, mode="VERNIER", quantity=FIRST):
        changes = []
        for value in values:
            self.now_s += TICK_S
            if value is not None:
                self.readings[quantity] = (value, self.now_s, "")
            changes += self.interlocks.evaluate(mode, self.now_s, self.readings)
        return changes

    @property
    def tripped(self):
        return [trip.name for trip in self.interlocks.tripped]


def test_rows_are_told_beside_what_is_measured():
    course = Course(table())
    (before,) = course.interlocks.watched(0.0, {})
    assert math.isnan(before.value)
    assert not before.judged

    course.show([0.5])
    (row_,) = course.interlocks.watched(course.now_s + 1.0, course.readings)
    assert (row_.name, row_.quantity, row_.value, row_.low, row_.high) == (
        "it",
        FIRST,
        0.5,
        None,
        1.0,
    )
    assert row_.age_s == pytest.approx(1.0)
    assert row_.judged
    assert row_.action == "warn"


def test_a_row_trips_once_it_was_out_of_range_for_its_time():
    course = Course(table())

    assert not course.show([2.0] * 5)
    (change,) = course.show([2.0] * 5)

    assert not change.over
    assert course.tripped == ["it"]
    assert "mirror right: fsm_range_fraction 2 is above 1 for 0.1 s" in change.trip.reason
    assert change.trip.reason.endswith(QUANTITIES[FIRST].remedy)


@pytest.mark.parametrize(("reset", "holds_in_a_search"), [("itself", False), ("hand", True)])
def test_a_row_that_resets_itself_holds_the_stages_in_its_own_modes_only(reset, holds_in_a_search):
    course = Course(table(action="freeze", reset=reset))
    course.show([2.0] * 10)
    assert course.interlocks.holds

    course.show([None], mode="ACQUISITION")
    assert course.tripped == ["it"]
    assert course.interlocks.holds is holds_in_a_search

    course.show([None])
    assert course.interlocks.holds


def test_a_value_back_in_range_starts_the_time_anew():
    course = Course(table())

    assert not course.show([2.0, 2.0, 2.0, 2.0, 0.5] * 20)


@pytest.mark.parametrize("value", [-2.0, float("nan"), float("-inf")])
def test_too_low_and_not_a_number_are_out_of_range(value):
    course = Course(table(low=-1.0))
    course.show([value] * 10)

    assert course.tripped == ["it"]


def test_what_is_not_a_number_is_told_so():
    (change,) = Course(table()).show([float("nan")] * 10)

    assert "fsm_range_fraction is not a number for 0.1 s" in change.trip.reason


def test_a_value_that_grows_old_is_out_of_range_and_says_so():
    course = Course(table(high=None, stale_s=0.2, for_s=0.0))
    course.show([0.5])

    assert not course.show([None] * 10)
    (change,) = course.show([None])

    assert (
        "no fsm_range_fraction for 0.22 s; check power and link of the mirror" in change.trip.reason
    )


def test_a_star_that_no_frame_shows_is_no_matter_of_a_link():
    rows = {"it": row(quantity="star_flux_fraction", high=None, stale_s=0.2, for_s=0.0)}
    course = Course(Interlocks(rows, {"star": "star of right"}))
    course.show([0.5], quantity="star_flux_fraction")
    (change,) = course.show([None] * 11, quantity="star_flux_fraction")

    assert change.trip.reason.endswith(QUANTITIES["star_flux_fraction"].remedy)


def test_a_value_that_was_never_measured_is_old_after_its_time_and_not_before():
    course = Course(table(high=None, stale_s=0.2, for_s=0.0))
    course.show([None] * 11)
    assert not course.tripped
    course.show([None])

    assert course.tripped == ["it"]


def test_without_stale_s_what_was_never_measured_trips_nothing():
    course = Course(table())

    assert not course.show([None] * 100)


def test_a_row_is_judged_in_its_modes_only_and_anew_in_each():
    course = Course(table())
    assert not course.show([2.0] * 50, mode="STANDBY")
    assert not course.show([None] * 50)  # measured before, so it says nothing
    assert not course.show([2.0] * 4)
    assert not course.show([2.0] * 4, mode="COARSE")
    assert not course.show([2.0] * 4)


def test_a_row_that_resets_itself_is_over_after_its_time_in_range_in_any_mode():
    course = Course(table())
    course.show([2.0] * 10)
    assert not course.show([0.5] * 5, mode="STANDBY")
    (change,) = course.show([0.5], mode="STANDBY")

    assert change.over
    assert not course.tripped


def test_silence_resets_nothing():
    course = Course(table(high=None, stale_s=0.2, for_s=0.0))
    course.show([None] * 20)

    assert not course.show([None] * 100, mode="STANDBY")
    assert course.tripped == ["it"]


def test_a_row_reset_by_hand_waits_for_the_hand():
    course = Course(table(reset="hand"))
    course.show([2.0] * 10)
    assert not course.show([0.5] * 1000)

    assert course.interlocks.reset("it", course.now_s, course.readings) == ""
    assert not course.tripped


def test_a_reset_is_refused_while_the_value_is_out_of_range_and_says_how_far():
    course = Course(table(reset="hand"))
    course.show([2.0] * 10)

    assert "fsm_range_fraction 2 is above 1" in course.interlocks.reset(
        "it", course.now_s, course.readings
    )
    assert course.tripped == ["it"]


@pytest.mark.parametrize(("name", "said"), [("it", "is not tripped"), ("that", "this loop has it")])
def test_what_is_not_tripped_or_not_there_cannot_be_reset(name, said):
    assert said in table().reset(name, 0.0, {})


def test_an_error_of_a_device_is_told_in_its_own_words():
    interlocks = table(for_s=0.0)
    (change,) = interlocks.evaluate(
        "VERNIER", 1.0, {FIRST: (2.0, 1.0, "D/A at x: expected a, got b")}
    )

    assert change.trip.reason == "D/A at x: expected a, got b"


def test_the_strongest_action_of_all_that_is_tripped_is_in_force():
    actions = ["freeze", "safe", "warn", "flatten"]
    rows = {action: row(action=action, for_s=0.0, reset="hand") for action in actions}
    interlocks = Interlocks(rows, {})
    interlocks.evaluate("VERNIER", 1.0, {FIRST: (2.0, 1.0, "")})
    in_force = []
    while interlocks.action:
        in_force.append(interlocks.action)
        interlocks.reset(interlocks.action, 1.0, {})

    assert in_force == ["safe", "flatten", "freeze", "warn"]


values = st.one_of(st.none(), st.floats(-3, 3), st.just(float("nan")))
steps = st.lists(
    st.tuples(values, values, st.sampled_from(["STANDBY", "COARSE", "VERNIER"])), max_size=120
)
rows = st.builds(
    row,
    quantity=st.sampled_from([FIRST, SECOND]),
    low=st.one_of(st.none(), st.floats(-2, 0)),
    high=st.floats(0.1, 2),
    stale_s=st.one_of(st.none(), st.floats(0.03, 0.3)),
    for_s=st.floats(0, 0.2),
    modes=st.lists(st.sampled_from(["STANDBY", "COARSE", "VERNIER"]), min_size=1, unique=True),
    action=st.sampled_from(["warn", "freeze", "flatten", "safe"]),
    reset=st.sampled_from(["hand", "itself"]),
)


@given(st.dictionaries(st.sampled_from("abcd"), rows, min_size=1), steps)
@pytest.mark.long
def test_nothing_acts_untripped_and_nothing_that_needs_a_hand_goes_without(made, course):
    interlocks, readings, now_s = Interlocks(made, {}), {}, 0.0
    tripped: set[str] = set()
    for first, second, mode in course:
        now_s += TICK_S
        for quantity, value in ((FIRST, first), (SECOND, second)):
            if value is not None:
                readings[quantity] = (value, now_s, "")
        changes = interlocks.evaluate(mode, now_s, readings)
        for trip, over in changes:
            assert (trip.name in tripped) == over
            if over:
                its = made[trip.name]
                assert its.reset == "itself"
                value = readings[its.quantity][0]
                assert its.low is None or value >= its.low
                assert value <= its.high
            else:
                assert mode in made[trip.name].modes
        tripped ^= {trip.name for trip, _ in changes}
        assert {trip.name for trip in interlocks.tripped} == tripped
        assert (interlocks.action is None) == (not tripped)
        assert interlocks.action in {None, *(made[name].action for name in tripped)}


@given(st.dictionaries(st.sampled_from("abcd"), rows, min_size=1), steps)
@pytest.mark.long
def test_values_in_range_and_fresh_trip_nothing(made, course):
    interlocks, now_s = Interlocks(made, {}), 0.0
    for _, _, mode in course:
        now_s += TICK_S
        readings = dict.fromkeys((FIRST, SECOND), (0.05, now_s, ""))

        assert not interlocks.evaluate(mode, now_s, readings)


# ---------------------------------------------------------------- the rig file


def test_the_modes_of_a_row_are_the_modes_there_are():
    assert set(ModeName.__args__) == {mode.name for mode in Mode}


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("interlocks.flux_low.quantity=moon", "unknown quantity; available: star_flux_fraction"),
        ("interlocks.flux_low.high=0.5", "interlocks.flux_low.high: must be above 0.75"),
        ("interlocks.flux_low.modes=[]", "interlocks.flux_low.modes"),
        ("interlocks.flux_low.modes=['ON']", "interlocks.flux_low.modes"),
        ("interlocks.flux_low.action=shout", "interlocks.flux_low.action"),
        ("interlocks.flux_low.limit=1.0", "unknown key"),
        ("interlocks.frame_missing.stale_s=0.05", "frame_missing.stale_s: must be above 0.075"),
        (
            "interlocks.new={quantity='clock_step_s', for_s=0.0, modes=['OFF'], action='warn', reset='hand'}",
            "needs low, high or stale_s",
        ),
    ],
)
def test_a_row_that_cannot_be_is_refused_in_one_line(override, said):
    with pytest.raises(ConfigError) as refused:
        load_rig(default_rig_path(), [override])

    assert said in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


# ---------------------------------------------------------------- the document


def limits(shipped):
    parts = {
        "below {:g}": shipped.low,
        "above {:g}": shipped.high,
        "older than {:g} s": shipped.stale_s,
        "for {:g} s": shipped.for_s or None,
    }
    return ", ".join(text.format(value) for text, value in parts.items() if value is not None)


def test_the_document_has_the_table_of_the_rig_file():
    shipped = load_rig(default_rig_path()).interlocks

    rows = [
        [
            f"`{name}`",
            f"`{its.quantity}`",
            limits(its),
            "all" if len(its.modes) == len(Mode) else ", ".join(its.modes),
            its.action,
            its.reset,
        ]
        for name, its in shipped.items()
    ]

    assert between("interlocks.md", "interlocks") == table_of(
        ["interlock", "quantity", "trips when", "in the modes", "action", "reset by"], rows
    )


def test_the_document_has_the_quantities_of_the_code():
    rows = [
        [f"`{name}`", its.part, its.meaning.replace("|", "\\|"), its.remedy]
        for name, its in QUANTITIES.items()
    ]

    assert between("interlocks.md", "quantities") == table_of(
        ["quantity", "of the", "what it is", "what to do when it trips a row"], rows
    )
