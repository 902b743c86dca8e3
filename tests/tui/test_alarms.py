"""Alarms: what is wrong comes up once, says what to do, and goes when it should."""

import re

import msgspec
import pytest

from fitctl.messages.telemetry import LoopFailure, TrippedInterlock
from fitctl.tui.alarms import BELL_EVERY_S, AlarmBook
from fitctl.tui.dialogs import Alarms, alarms_text
from fitctl.tui.inks import ORANGE, RED
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.alarmbar import AlarmBar
from tests.instruments.fake_supervisor import STAR_LOST, START_S, FakeSupervisor
from tests.tui.wrong import ALARMS, FAULT, stopped_testbed


def tripped(name="flux_low", **fields):
    told = {"action": "warn", "reset": "itself", "reason": f"interlock {name}: low; look at it"}
    return TrippedInterlock(name=name, since_s=START_S, **(told | fields))


class Watch:
    """A console's state and alarms, fed message by message."""

    def __init__(self, supervisor):
        self.supervisor = supervisor
        self.state = ConsoleState(START_S)
        self.book = AlarmBook()
        self.bells = 0

    def hear(self, count=1):
        for message in self.supervisor.messages(count):
            self.state.accept(message, message.time_s)
            self.state.now_s = message.time_s
            self.bells += self.book.update(self.state)
        return self.book.in_order

    def bar(self, columns=200):
        bar = AlarmBar(self.state, self.book)
        return bar, ["".join(segment.text for segment in line) for line in bar.draw(columns, 9)]

    def row(self, columns=200):
        return self.bar(columns)[1]

    def acknowledge(self):
        """What the bar shows."""
        self.book.acknowledge(self.bar()[0].shown)


def test_there_is_nothing_when_all_is_well():
    watch = Watch(FakeSupervisor())
    assert watch.hear(50) == []
    assert watch.row() == []
    assert watch.bells == 0


def test_a_warning_comes_says_what_to_do_and_goes_by_itself():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped()]
    (alarm,) = watch.hear()
    assert (alarm.what, alarm.todo) == ("interlock flux_low: low", "look at it")
    assert alarm.did == "nothing was changed"
    assert not alarm.error
    watch.supervisor.interlocks = []
    assert watch.hear() == []


def test_a_lost_star_is_an_alarm_until_it_is_found():
    watch = Watch(FakeSupervisor("ACQUISITION"))
    watch.supervisor.search_again = STAR_LOST
    watch.supervisor.interlocks = [tripped("star_lost")]

    (alarm,) = watch.hear()

    assert alarm.error
    assert alarm.what == "right: star lost 133 s ago"
    assert "searches again, round 2, within 108 arcsec" in alarm.did
    assert "check shutter and clouds" in alarm.todo
    assert watch.bells == 1
    watch.supervisor.search_again, watch.supervisor.interlocks = None, []
    assert watch.hear() == []


def test_what_is_reset_by_hand_says_so():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped(reset="hand")]
    (alarm,) = watch.hear()
    assert alarm.todo == "look at it; then reset flux_low"


@pytest.mark.parametrize(
    ("action", "did"),
    [
        ("freeze", "the stages wait where they are"),
        ("flatten", "the mirror goes to its bias, the siderostat waits"),
        ("safe", "the loop went to SAFE"),
    ],
)
def test_what_was_done_is_said_and_an_error_stays_until_it_is_seen(action, did):
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped(action=action)]
    (alarm,) = watch.hear()
    assert alarm.did == did
    watch.supervisor.interlocks = []
    (alarm,) = watch.hear()
    assert alarm.over_s is not None
    assert "(over " in watch.row()[0]
    watch.acknowledge()
    assert watch.hear() == []


def failed():
    supervisor = FakeSupervisor("SAFE")
    supervisor.trigger, supervisor.reason = "FAULT", FAULT
    supervisor.faulty = {"right siderostat": FAULT}
    return supervisor


def test_a_fault_is_told_once_though_loop_and_device_both_tell_it():
    (alarm,) = Watch(failed()).hear()
    assert alarm.did == "right went to SAFE"
    assert alarm.todo == "remove its cause, then recover"


def test_a_fault_that_the_device_tells_a_message_before_its_loop_is_one_alarm():
    watch = Watch(FakeSupervisor())
    watch.supervisor.faulty = {"right siderostat": FAULT}
    (alarm,) = watch.hear()
    assert alarm.what == FAULT.partition(";")[0]
    watch.supervisor.mode, watch.supervisor.trigger, watch.supervisor.reason = (
        "SAFE",
        "FAULT",
        FAULT,
    )

    (alarm,) = watch.hear()

    assert alarm.did == "right went to SAFE"
    assert watch.bells == 1


def test_what_a_device_told_before_the_recovery_is_no_new_alarm():
    watch = Watch(failed())
    watch.hear()
    watch.acknowledge()
    message = watch.supervisor.message()
    loops = [
        msgspec.structs.replace(loop, mode="STANDBY", since_s=message.time_s + 0.05)
        for loop in message.loops
    ]
    watch.state.accept(msgspec.structs.replace(message, loops=loops), message.time_s)
    watch.book.update(watch.state)
    assert watch.book.in_order == []


def test_a_recovery_that_fails_alarms_again_though_its_cause_was_acknowledged():
    watch = Watch(failed())
    watch.hear()
    watch.acknowledge()
    watch.supervisor.last_failure = LoopFailure(
        what="recover", time_s=START_S + 9.0, text=FAULT + "."
    )
    bells = watch.bells

    (alarm,) = watch.hear()

    assert alarm.what.startswith("right: recover failed: siderostat right at")
    assert not alarm.acknowledged
    assert watch.bells == bells + 1


def test_stop_by_the_operator_is_no_alarm():
    supervisor = FakeSupervisor("SAFE")
    supervisor.trigger, supervisor.reason = "STOP", "operator"
    assert Watch(supervisor).hear() == []


def test_lost_records_alarm_again_when_more_are_lost():
    watch = Watch(FakeSupervisor())
    watch.supervisor.records_lost = 5
    watch.hear()
    watch.acknowledge()
    assert watch.hear()[0].acknowledged
    watch.supervisor.records_lost = 6
    (alarm,) = watch.hear()
    assert not alarm.acknowledged
    assert alarm.what == "6 records are missing from the log of this run"


def test_silence_of_the_supervisor_is_an_alarm_that_ends_with_it():
    watch = Watch(FakeSupervisor())
    watch.hear()
    watch.state.now_s += 7.0
    watch.book.update(watch.state)
    (alarm,) = watch.book.in_order
    assert alarm.what == "NO DATA for 7 s; what you see is old"
    assert "STOP may not reach it" in alarm.todo
    assert watch.hear() == []


def test_a_supervisor_that_shut_down_is_no_danger():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped(action="freeze")]
    watch.hear()
    watch.supervisor = FakeSupervisor("SAFE")
    (message,) = watch.supervisor.messages(1)
    last = msgspec.structs.replace(message, shutting_down=True)
    watch.state.accept(last, last.time_s)
    watch.state.now_s = last.time_s + 7.0
    watch.book.update(watch.state)

    alarm, over = watch.book.in_order

    assert over.over_s is not None
    assert alarm.what == "the supervisor shut down; it was last heard 7 s ago"
    assert not alarm.error


def test_the_bell_rings_until_it_is_silenced_and_again_for_something_new():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped()]
    watch.hear(round(2.5 * BELL_EVERY_S / 0.05))
    assert watch.bells == 3
    watch.book.silence()
    watch.hear(round(2.5 * BELL_EVERY_S / 0.05))
    assert watch.bells == 3
    watch.supervisor.interlocks = [tripped(), tripped("fsm_edge")]
    watch.hear()
    assert watch.bells == 4


def test_what_was_acknowledged_does_not_ring():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped()]
    watch.hear()
    watch.acknowledge()
    watch.hear(round(2.5 * BELL_EVERY_S / 0.05))
    assert watch.bells == 1


def test_the_weightiest_comes_first_and_the_rest_are_counted():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [
        *(tripped(f"number_{number}") for number in range(4)),
        tripped("worst", action="freeze"),
    ]
    watch.hear()
    rows = watch.row()
    assert "worst" in rows[0]
    assert "+4 more" in rows[-1]
    for columns in range(60, 121):
        _, rows = watch.bar(columns)
        assert "+4 more" in rows[-1]


@pytest.mark.parametrize("columns", [40, 60, 80, 120, 300])
@pytest.mark.parametrize("wrong", ALARMS)
def test_an_alarm_is_whole_at_every_width(wrong, columns):
    watch = Watch(ALARMS[wrong]())
    watch.hear()
    bar, rows = watch.bar(columns)
    first = watch.book.in_order[0]
    assert max(map(len, rows)) <= columns
    shown = " ".join(" ".join(rows).split())
    what = re.sub(r" at \S+:(?= )", ":", first.what, count=1)
    for words in (what, first.did, first.todo):
        assert not set(words.split()) - set(shown.split())
    assert "…" not in shown
    assert bar.shown == {first.key: first.count}


@pytest.mark.parametrize(
    "wrong", ["drive_fault", "interlock_warns", "device_fault", "faulty_testbed"]
)
def test_at_80_columns_the_common_alarms_need_two_rows(wrong):
    watch = Watch(ALARMS[wrong]())
    watch.hear()
    rows = watch.row(80)
    assert len(rows) == 2
    assert "▸" in rows[1]
    assert "▸" not in rows[0]


def test_only_what_is_shown_is_acknowledged():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped("shown", action="freeze"), tripped("below")]
    watch.hear()
    assert "shown" in watch.row()[0]
    watch.acknowledge()
    assert {alarm.key: alarm.acknowledged for alarm in watch.hear()} == {
        "interlock shown: low": True,
        "interlock below: low": False,
    }
    assert "below" in watch.row()[0]


def test_an_alarm_that_has_grown_since_it_was_shown_is_not_acknowledged():
    watch = Watch(FakeSupervisor())
    watch.supervisor.records_lost = 5
    watch.hear()
    shown = watch.bar()[0].shown
    watch.supervisor.records_lost = 6
    watch.hear()
    watch.book.acknowledge(shown)
    assert [alarm.acknowledged for alarm in watch.hear()] == [False]


def test_an_alarm_that_came_after_the_list_was_drawn_is_not_acknowledged_by_it():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped("known")]
    watch.hear()
    dialog = Alarms(watch.state, watch.book)
    watch.supervisor.interlocks = [tripped("known"), tripped("new")]
    watch.hear()
    dialog._book.acknowledge(dialog._shown)
    acknowledged = {alarm.key: alarm.acknowledged for alarm in watch.hear()}
    assert acknowledged == {"interlock known: low": True, "interlock new: low": False}


def test_an_alarm_stays_chosen_whatever_comes_and_goes(monkeypatch):
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [tripped("one"), tripped("two")]
    watch.hear()
    dialog, shown_s = Alarms(watch.state, watch.book), []
    monkeypatch.setattr(dialog, "_draw", lambda: None)
    monkeypatch.setattr(dialog, "dismiss", shown_s.append)
    dialog.action_choose(1)
    chosen = watch.book.in_order[1]
    watch.supervisor.interlocks = [tripped("one"), tripped("two"), tripped("three")]
    watch.hear()
    dialog.action_show()
    watch.book.alarms.clear()
    watch.supervisor.interlocks = [tripped("one")]
    (left,) = watch.hear()
    dialog.action_show()

    assert shown_s == [chosen.since_s, left.since_s]


def test_an_alarm_of_a_million_letters_is_cut_to_what_the_bar_shows():
    watch = Watch(FakeSupervisor())
    watch.supervisor.interlocks = [msgspec.structs.replace(tripped("x"), reason="a b" * 300_000)]
    watch.hear()
    assert len(watch.bar()[0]._alarm_lines(80, 24)) < 100


def test_a_stop_says_who_it_was_and_looks_like_no_fault():
    watch = Watch(stopped_testbed())
    assert watch.hear() == []
    bar = AlarmBar(watch.state, watch.book)
    lines = bar.draw(80, 9)
    assert "right, metrology, left SAFE: stopped by anna" in text_of(lines[0])
    assert "recover, or off" in text_of(lines[1])
    inks = {s.style.color.name for line in lines for s in line if s.style and s.style.color}
    assert not inks & {RED, ORANGE}
    assert bar.shown == {}


def text_of(line):
    return "".join(segment.text for segment in line)


def test_the_list_has_everything_in_full():
    watch = Watch(failed())
    watch.hear()
    told = alarms_text(watch.state, watch.book).plain
    assert "got axis 2: following error" in told
    assert "remove its cause, then recover" in told
    assert "right went to SAFE" in told
    assert "not acknowledged" in told
