"""What the lists show beside names: limits used, courses, summaries of logs, durations of sequences, help."""

import json
import os

import msgspec
import pytest

from fitctl.messages.commands import SequenceStatus
from fitctl.messages.telemetry import TrippedInterlock
from fitctl.text import json_bytes
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import KEYS
from fitctl.tui.views.help import all_sections, matching, now_section
from fitctl.tui.widgets.loglist import AT_ONCE, LogFile, LogList, Summaries
from fitctl.tui.widgets.readings import Detail, DeviceList, Readings, limit_used
from fitctl.tui.widgets.sequencing import (
    CHOSEN_S,
    LONGEST_DRY_RUN_S,
    Estimates,
    Parameters,
    Progress,
    SequenceList,
)
from tests.instruments.fake_supervisor import START_S, FakeSupervisor
from tests.tui.drawn import plain, shown
from tests.tui.fixed import SEQUENCES

# ---------------------------------------------------------------- devices


def watched(**fields):
    row = FakeSupervisor().message().loops[0].watched[0]
    return msgspec.structs.replace(row, **fields)


@pytest.mark.parametrize(
    ("value", "low", "high", "used"),
    [
        (0.5, None, 2.0, 0.25),
        (-1.0, -2.0, 2.0, 0.5),
        (4.0, 1.0, None, 0.25),
        (0.0, 1.0, None, float("inf")),
    ],
)
def test_how_much_of_a_limit_is_used(value, low, high, used):
    assert limit_used(watched(value=value, low=low, high=high)) == used


def names(readings):
    readings.draw(100, 20)
    return readings.names()


def test_what_is_nearest_to_its_limit_comes_first_and_what_is_tripped_before_it():
    supervisor = FakeSupervisor()
    order = names(Readings(shown(supervisor)))
    assert order[:3] == ["fsm_edge", "amplifier_slow", "dac_slow"]
    assert order[-1] == "piezo_limit"  # which is not evaluated in this mode
    supervisor.interlocks = [
        TrippedInterlock(
            name="disk_space", since_s=START_S, action="warn", reset="itself", reason="full"
        )
    ]
    assert names(Readings(shown(supervisor)))[0] == "disk_space"


def test_the_choice_follows_its_row_to_another_place():
    supervisor = FakeSupervisor()
    state = shown(supervisor)
    readings = Readings(state)
    names(readings)
    readings.chosen = 2
    names(readings)
    assert readings.now().name == "dac_slow"
    supervisor.interlocks = [
        TrippedInterlock(
            name="dac_slow", since_s=START_S, action="warn", reset="itself", reason="slow"
        )
    ]
    message = supervisor.message()
    state.accept(message, message.time_s)
    names(readings)
    assert readings.chosen == 0
    assert readings.now().name == "dac_slow"


def test_an_ill_device_comes_first_with_the_events_that_name_it():
    supervisor = FakeSupervisor()
    supervisor.faulty = {"right piezo": "no answer"}
    state = shown(supervisor)
    devices = DeviceList(state)
    assert devices.devices()[0].device == "right piezo"
    state.events.appendleft(
        msgspec.structs.replace(state.events[0], source="right", message="piezo does not answer")
    )
    lines = "\n".join(plain(Detail(state, "", devices, Readings(state)).draw(120, 12)))
    assert "no answer" in lines
    assert "piezo does not answer" in lines
    assert "handed over" not in lines


def test_the_course_of_a_reading_has_its_limits_and_its_span():
    state = shown(FakeSupervisor(), 400)
    loop, row = state.loop, Readings(state).watched()[0]
    detail = Detail(state, "", DeviceList(state), Readings(state))
    lines = plain(detail._course(loop, row, 60, 10))
    assert len(loop.readings["fsm_edge"]) == 20
    assert "31 % to 90 %" in lines[0]
    assert lines[-1].startswith("−0:19")
    assert len(lines) == 10


# ---------------------------------------------------------------- logs


class Job:
    def __init__(self, arguments):
        self.arguments, self.status, self.printed, self.ended = arguments, None, "", False

    def text(self):
        return self.printed

    def end(self):
        self.ended = True


def logs_in(folder, count):
    return [LogFile(folder / f"{n}.mcap", 1000, 1e9 + n, kept=False) for n in range(count)]


def line(log, **fields):
    known = {"path": str(log.path), "start_s": 1796021000.0, "duration_s": 4210.0}
    return json.dumps(known | {"verdict": "met", "rms": {"right": "0.021 px"}} | fields) + "\n"


def test_logs_are_read_by_one_process_at_a_time_and_each_once(tmp_path):
    jobs, logs = [], logs_in(tmp_path, AT_ONCE + 3)

    def start(arguments):
        jobs.append(Job(arguments))
        return jobs[-1]

    summaries = Summaries()
    summaries.ask(start, logs, "0.mcap")
    (job,) = jobs
    assert job.arguments[:3] == ["log", "summary", "--json"]
    assert job.arguments[5:] == [str(log.path) for log in logs[1 : AT_ONCE + 1]]
    job.printed = line(logs[1]) + line(logs[2])[:20]
    summaries.ask(start, logs, "0.mcap")
    assert summaries.of(logs[1]).rms == {"right": "0.021 px"}
    assert summaries.of(logs[2]) is None
    job.printed, job.status = "".join(map(line, logs[1:5])), 0
    summaries.ask(start, logs, "0.mcap")
    assert job.ended
    assert jobs[1].arguments[5:] == [str(log.path) for log in logs[AT_ONCE + 1 :]]
    jobs[1].status = 0
    for _ in range(3):
        summaries.ask(start, logs, "0.mcap")
    assert len(jobs) == 2
    grown = [logs[1]._replace(size_bytes=2000), *logs[2:]]
    summaries.ask(start, grown, "0.mcap")
    assert jobs[2].arguments[5:] == [str(logs[1].path)]


@pytest.mark.parametrize("name", [os.fsdecode(b"c\xff.mcap"), "c\x01é.mcap"], ids=ascii)
def test_a_log_of_any_name_gets_its_summary(tmp_path, name):
    log = LogFile(tmp_path / name, 1000, 1e9, kept=False)
    summaries, job = Summaries(), Job([])
    summaries.ask(lambda _: job, [log], "")
    printed = json_bytes(json.loads(line(log))).decode()
    job.printed, job.status = f"{printed}\n", 0
    summaries.ask(lambda _: job, [log], "")

    assert summaries.of(log).rms == {"right": "0.021 px"}


@pytest.mark.parametrize("columns", [78, 118])
def test_a_log_has_its_start_duration_rms_and_verdict(tmp_path, columns):
    (log,) = logs_in(tmp_path, 1)
    summaries, job = Summaries(), Job([])
    summaries.ask(lambda _: job, [log], "")
    job.printed, job.status = line(log), 0
    summaries.ask(lambda _: job, [log], "")
    logs = LogList(shown(FakeSupervisor()), "Logs", tmp_path, summaries.of)
    logs.look = lambda: None
    logs.logs = [log]
    row = plain(logs.draw(columns, 10))[1]
    for part in ("11-30 06:43:20", "1:10:10", "0.021 px", "✓ met", "0.mcap"):
        assert part in row


# ---------------------------------------------------------------- sequences


def dry_run(*steps_s, failure=""):
    attempts, now_s = [], 5.0
    for number, step_s in enumerate(steps_s, start=1):
        attempts.append({"step_number": number, "began_s": now_s, "ended_s": now_s + step_s})
        now_s += step_s
    return "acquire ━━━ \n" + json.dumps({"failure": failure, "attempts": attempts}) + "done 1/1"


def estimated(printed, document=SEQUENCES[1]):
    jobs, estimates = [], Estimates()

    def start(arguments):
        jobs.append(Job(arguments))
        return jobs[-1]

    for now_s in (0.0, CHOSEN_S + 0.1):
        estimates.ask(start, document, ["jog.toml"], now_s)
    jobs[0].printed, jobs[0].status = printed, 0
    estimates.ask(start, document, ["jog.toml"], 10.0)
    return estimates, jobs


def test_a_sequence_lasts_as_long_as_in_its_dry_run():
    estimates, jobs = estimated(dry_run(12.0, 60.2))
    assert jobs[0].arguments == ["sequence", "dry-run", "--json", "jog.toml"]
    sequences = SequenceList(shown(FakeSupervisor()), "", estimates.of)
    sequences.documents = SEQUENCES
    assert "    2    1:12  " in plain(sequences.draw(100, 5))[2]
    sequences.chosen = 1
    steps = "\n".join(plain(Parameters(sequences.state, "", sequences).draw(60, 20)))
    assert "1 acquire  12 s" in steps
    assert "2 dither  60 s" in steps


def test_a_dry_run_that_fails_or_is_no_json_gives_no_duration():
    for printed in (dry_run(12.0, failure="no star"), "Traceback", '{"failure": ""}'):
        estimates, jobs = estimated(printed)
        assert estimates.of(SEQUENCES[1]) is None
        estimates.ask(lambda _: pytest.fail("it was run again"), SEQUENCES[1], ["jog.toml"], 30.0)
        assert jobs[0].ended


def test_a_sequence_that_is_passed_over_is_not_run_dry_and_a_long_one_is_given_up():
    jobs, estimates = [], Estimates()

    def start(arguments):
        jobs.append(Job(arguments))
        return jobs[-1]

    for now_s in (0.0, 1.5, 3.0, 4.5):
        estimates.ask(start, SEQUENCES[round(now_s / 1.5) % 2], ["x"], now_s)
    assert jobs == []
    estimates.ask(start, SEQUENCES[1], ["x"], 7.0)
    estimates.ask(start, SEQUENCES[1], ["x"], 7.0 + LONGEST_DRY_RUN_S + 1)
    assert jobs[0].ended


def test_the_time_to_go_falls_with_the_time():
    estimates, _ = estimated(dry_run(12.0, 60.0))
    supervisor = FakeSupervisor()
    state = shown(supervisor, 20)
    sequences = SequenceList(state, "", estimates.of)
    sequences.documents = SEQUENCES
    progress = Progress(state, "", sequences)

    def to_go(step_number):
        supervisor.running_sequence = SequenceStatus(
            run="1", name="dither", state="running", steps=2, step_number=step_number, step="dither"
        )
        message = supervisor.message()
        state.accept(message, message.time_s)
        return plain(progress.draw(110, 2))[0]

    assert "1:12 to go" in to_go(1)
    supervisor.messages(199)
    assert "1:02 to go" in to_go(1)
    assert "1:00 to go" in to_go(2)


# ---------------------------------------------------------------- help


@pytest.mark.parametrize(
    ("mode", "has", "lacks"),
    [
        ("VERNIER", "Release", "Recover"),
        ("SAFE", "Recover", "Release"),
        ("STANDBY", "Acquire", "Target"),
    ],
)
def test_help_begins_with_what_can_be_done_in_this_mode(mode, has, lacks):
    section = now_section(shown(FakeSupervisor(mode)), AlarmBook())
    meanings = [meaning for _, meaning, _ in section.rows]
    assert section.title == f"Now: right is in {mode}"
    assert any(text.startswith(f"{has}:") for text in meanings)
    assert not any(text.startswith(f"{lacks}:") for text in meanings)
    assert meanings[0].startswith("STOP:")


def test_the_filter_keeps_rows_with_all_its_words():
    sections = all_sections(quit_shuts_down=False)
    found = matching(sections, "mirror HOLDS")
    assert [row[0] for section in found for row in section.rows] == ["◆ VERNIER"]
    assert matching(sections, "") == sections
    assert matching(sections, "no such word") == []
    keys = {row[0] for section in matching(sections, "alarm") for row in section.rows}
    assert {key.shown for key in KEYS if "alarm" in key.help} <= keys
