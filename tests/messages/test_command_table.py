"""One schema of commands: nothing is missing from the table, nothing is there twice."""

import math
from typing import get_args

import msgspec
import pytest

from fitctl.cli import main
from fitctl.config import ConfigError
from fitctl.messages.client import REPLY_TIMEOUT_S
from fitctl.messages.command_table import (
    COMMANDS,
    MOST_WAIT_S,
    ROWS,
    WORDS,
    as_command,
    command_of,
    why_too_late,
)
from fitctl.messages.commands import (
    Acquire,
    AnyCommand,
    MoveCollector,
    Reply,
    Reset,
    SetTarget,
    Standby,
    Status,
    Stop,
)


def test_every_command_is_in_the_table_once():
    assert sorted(row.name for row in COMMANDS) == sorted(c.__name__ for c in get_args(AnyCommand))


def test_words_and_keys_are_not_ambiguous():
    words = [row.word for row in COMMANDS if row.word]
    keys = [row.key for row in COMMANDS if row.key]

    assert len(words) == len(set(words)) == len(WORDS)
    assert len(keys) == len(set(keys))


def test_what_needs_no_values_can_be_on_a_key():
    assert all(not row.values and row.word for row in COMMANDS if row.key)


@pytest.mark.parametrize("row", COMMANDS, ids=lambda row: row.name)
def test_every_command_says_what_it_does(row):
    assert row.help
    assert not row.help.endswith(".")


def test_values_come_in_the_order_of_the_struct():
    assert ROWS[SetTarget].usage == "target AZ_PX EL_PX"
    assert command_of("target", ["22.5", "19"], "right") == SetTarget(
        az_px=22.5, el_px=19.0, loop="right"
    )


def test_a_name_that_looks_like_a_number_stays_a_name():
    assert command_of("reset", ["7"], "") == Reset(name="7")


def test_a_word_alone_is_a_command():
    assert command_of("stop", [], "") == Stop()


def test_what_may_be_left_out_is_given_by_its_name():
    assert command_of("acquire", [], "") == Acquire()
    assert command_of("acquire", ["field_overlap=0.3"], "right") == Acquire(
        field_overlap=0.3, loop="right"
    )


def test_a_value_below_zero_is_no_option(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["send", "jog", "-1.5", "0", "--set", f"service.folder={tmp_path}"])

    assert end.value.code == 1
    assert "no supervisor answers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "values", "complaint"),
    [
        ("acquire", ["wide"], "takes no values, and may have search_radius_sky_arcsec="),
        ("acquire", ["field_overlap"], "takes no values"),
        ("acquire", ["field_overlap=much"], "field_overlap must be a number, got 'much'"),
        ("explode", [], "unknown command 'explode'. Available: stop, "),
        ("target", ["1"], "takes AZ_PX EL_PX; got 1"),
        ("target", ["far", "1"], "target far 1"),
        ("stop", ["now"], "takes no values"),
        ("hold", [], "hold is now release"),
        (
            "controller",
            ["best"],
            "controller best: unknown name 'best'. Available: eq20, lqg-ltr, minimum-variance, fslq, learnt",
        ),
        ("jog", ["1", "b"], "jog 1 b: el_sky_arcsec must be a number, got 'b'"),
        (
            "collector",
            ["start", "kind=fast"],
            "collector start kind=fast: unknown kind 'fast'. Available: ",
        ),
    ],
)
def test_what_cannot_be_a_command_is_refused_in_one_line(word, values, complaint):
    with pytest.raises(ConfigError) as refused:
        command_of(word, values, "")

    assert complaint in str(refused.value)
    assert "\n" not in str(refused.value)


def test_words_of_python_are_those_of_the_shell():
    assert as_command("target 22.5 19", "right") == SetTarget(loop="right", az_px=22.5, el_px=19.0)
    assert as_command("stop") == Stop()
    assert as_command(Stop()) == Stop()


@pytest.mark.parametrize("given", ["", "  ", "halt", "target 1", "stop now", "hold"])
def test_words_that_are_no_command_raise(given):
    with pytest.raises(ConfigError, match=r"^send: "):
        as_command(given)


@pytest.mark.parametrize("given", [None, 3, b"stop", Stop, Reply(accepted=True)])
def test_what_is_no_command_at_all_raises(given):
    with pytest.raises(TypeError, match="expected words such as"):
        as_command(given)


def test_a_message_has_its_own_loop():
    with pytest.raises(TypeError):
        as_command(Stop(), "right")


# ---------------------------------------------------------------- commands that come too late


@pytest.mark.parametrize(("ago_s", "is_refused"), [(1.7, False), (1.8, True)])
def test_a_command_whose_sender_has_given_up_is_refused(ago_s, is_refused):
    why_not = why_too_late(Standby(sent_s=10.0), 10.0 + ago_s)

    assert bool(why_not) == is_refused
    if is_refused:
        assert why_not.startswith(
            "Standby was sent 1.8 s ago; what arrives after 1.75 s is not carried out"
        )
        assert why_not.endswith("send it again")


@pytest.mark.parametrize(
    "command", [Stop(sent_s=0.0), MoveCollector(action="stop", sent_s=0.0), Status(sent_s=0.0)]
)
def test_what_stops_something_never_comes_too_late_nor_does_a_question(command):
    assert why_too_late(command, 1000.0) == ""


@pytest.mark.parametrize("sent_s", [msgspec.UNSET, math.nan, math.inf, 2000.0])
def test_a_command_of_a_program_without_the_supervisors_clock_is_never_too_late(sent_s):
    assert why_too_late(Standby(sent_s=sent_s), 1000.0) == ""


def test_what_waits_is_refused_before_its_sender_gives_up():
    assert MOST_WAIT_S < REPLY_TIMEOUT_S
