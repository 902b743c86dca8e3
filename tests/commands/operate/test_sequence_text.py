"""What `fitctl sequence` prints of its attempts."""

import msgspec

from fitctl.commands.operate.sequence_text import attempts_text
from fitctl.logging.records import SequenceAttempt


def attempt(loop):
    return SequenceAttempt(
        time_s=1.0,
        sequence_name="acquire",
        step_number=1,
        step="acquire",
        loop=loop,
        attempt=1,
        began_s=0.0,
        ended_s=0.6,
        outcome="done",
        message="held",
        figures_json="{}",
    )


def test_attempts_of_several_loops_name_their_loops():
    head, *rows = attempts_text([attempt("metrology"), attempt("left")]).splitlines()

    assert [row.split()[:3] for row in rows] == [
        ["1", "acquire", "metrology"],
        ["1", "acquire", "left"],
    ]
    assert {row.index("done") for row in rows} == {head.index("outcome")}


def test_names_and_reasons_stay_whole_where_a_star_has_no_figures():
    skipped = msgspec.structs.replace(
        attempt("right"), star="Menkalinan", outcome="failed", message="a resonance"
    )
    last = attempts_text([skipped]).splitlines()[-1]

    assert last.split() == ["Menkalinan", "-", "-", "-", "-", "a", "resonance"]


def test_attempts_of_one_loop_do_not():
    assert "right" not in attempts_text([attempt("right")])
