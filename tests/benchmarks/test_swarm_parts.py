"""What the swarm has beside the supervisor: recorder, service, console, sequences, and their invariants."""

import itertools
from functools import partial
from random import Random
from typing import get_args

import msgspec
import numpy as np
import pytest
from samples.learner_reports import report

from benchmarks.swarm import plan as plans
from benchmarks.swarm.clients import STEPS
from benchmarks.swarm.commands import LEARNT_DESIGNS
from benchmarks.swarm.devices.amplifiers import SwarmAmplifiers
from benchmarks.swarm.instrument import RIGS as FOLDER
from benchmarks.swarm.invariants import Invariants
from benchmarks.swarm.lines import Line
from benchmarks.swarm.plan import (
    Cloud,
    FullDisk,
    Kill,
    RecorderDeath,
    Sequence,
    Strike,
)
from benchmarks.swarm.recorder import SwarmRecorder, installed
from benchmarks.swarm.rigs import RIGS, SLOW, learning, slow_servos
from benchmarks.swarm.run import run_plan
from benchmarks.swarm.service import SENDERS, SwarmService
from benchmarks.swarm.telemetry_wire import RemoteConsole
from fitctl.config import load_rig
from fitctl.daemon.last_records import finish_log
from fitctl.logging.queue import RecordQueue
from fitctl.logging.records import ControllerChange, Event, RecorderStatus
from fitctl.messages import client
from fitctl.messages.commands import (
    Acquire,
    Jog,
    Look,
    MoveCollector,
    RecorderReport,
    Recover,
    Release,
    Reply,
    Standby,
    Status,
    Stop,
    TakeOver,
)
from fitctl.messages.modes import Mode
from fitctl.model.plant import Plant
from fitctl.sequences.contact import Contact
from fitctl.sequences.steps import AnyStep
from fitctl.service.admission import Admission
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.servo import SiderostatServo
from fitctl.stages.siderostat import SiderostatStage
from fitctl.tui.state import ConsoleState
from tests.benchmarks.plans import gives, plan
from tests.samples.log_samples import tick

# ------------------------------------------------------------ the recorder


@pytest.fixture
def queue(time):
    with installed(time):
        yield RecordQueue("swarm", 50)


def offer(queue, time, count):
    for number in range(count):
        record = Event(time_s=time.now_s(), severity="info", source="test", message=str(number))
        queue.offer(record)


def test_a_recorder_that_dies_loses_nothing_that_was_not_confirmed(time, queue):
    recorder = SwarmRecorder(time, queue)
    for _ in range(6):
        offer(queue, time, 7)
        time.run_until(time.now_s() + 0.2)
        recorder.die()
        time.run_until(time.now_s() + 1.5)
        queue.pump()
    for _ in range(20):
        queue.pump()
        time.run_until(time.now_s() + 0.2)

    assert recorder.written == set(range(42))
    assert recorder.unaccounted(queue.offered) == ""


def test_what_a_full_disk_keeps_out_is_counted(time, queue):
    recorder = SwarmRecorder(time, queue)
    recorder.disk_is_full = True
    for _ in range(10):
        offer(queue, time, 10)
        time.run_until(time.now_s() + 1.0)

    assert queue.lost > 0
    assert recorder.unaccounted(queue.offered) == ""


def test_a_record_that_nobody_counts_is_noticed(time, queue):
    recorder = SwarmRecorder(time, queue)
    recorder.disk_is_full = True
    for _ in range(10):
        offer(queue, time, 10)
        time.run_until(time.now_s() + 1.0)
    queue.lost = 0

    assert "0 counted" in recorder.unaccounted(queue.offered)


def test_a_recorder_that_is_stuck_writes_all_when_it_goes_on(time, queue):
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    recorder.stuck_until_s = time.now_s() + 3.0
    offer(queue, time, 30)
    time.run_until(3.9)
    assert recorder.waits_since(30) == 30
    for _ in range(6):
        queue.pump()
        time.run_until(time.now_s() + 0.5)

    assert recorder.waits_since(30) == 0
    assert recorder.written == set(range(30))


def test_a_recorder_stands_still_with_its_machine(time, queue):
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    offer(queue, time, 5)
    time.stall(2.0)
    time.run_until(2.9)
    assert recorder.written == set()
    time.run_until(4.0)

    assert recorder.written == set(range(5))


def finish(time, recorder):
    """What is missing at the end and was not reported."""
    found = []
    time.spawn(lambda: found.append(recorder.finish()), "main")
    time.run_until(time.now_s() + 30.0)
    (unreported,) = found
    return unreported


def test_at_the_end_everything_is_written(time, queue):
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    offer(queue, time, 40)

    assert finish(time, recorder) == ""
    assert recorder.written == set(range(40))
    assert not recorder.running


@pytest.mark.parametrize("trouble", ["stuck", "full disk", "dead"])
@pytest.mark.parametrize("reports", [True, False])
def test_what_is_not_written_at_the_end_must_be_reported(
    monkeypatch, time, queue, trouble, reports
):
    if not reports:
        monkeypatch.setattr(
            "benchmarks.swarm.recorder.finish_log",
            lambda queue, recorder, _report: finish_log(queue, recorder, lambda _line: None),
        )
    recorder = SwarmRecorder(time, queue)
    time.run_until(1.0)
    recorder.stuck_until_s = 100.0 if trouble == "stuck" else 0.0
    recorder.disk_is_full = trouble == "full disk"
    if trouble == "dead":
        recorder.die()
    offer(queue, time, 40)
    unreported = finish(time, recorder)

    assert recorder.written == set()
    assert not recorder.running
    expected = "" if reports else "at the end 40 are not written; reported: nothing"
    # Records that a dead recorder was never sent count as lost.
    assert unreported == ("" if trouble == "dead" else expected)


# ------------------------------------------------------------ lease and rights


@pytest.fixture
def plant():
    return Plant(load_rig(FOLDER / "fit-mock.toml"), [1], history_s=20.0)


@pytest.fixture
def invariants(time, plant):
    lines = {"camera": Line("camera", "", time, Random(1), 0.001, 0.1)}
    return Invariants(load_rig(FOLDER / "fit-mock.toml"), time, {}, lines, plant)


STATUS = RecorderStatus(time_s=0.0, path="", records=0, lost=0, bytes_written=0)
COMMANDS = (Release(), Stop(), Status(), TakeOver())


def test_the_rules_of_the_service_are_those_of_the_invariant(time, invariants):
    admission, random = Admission(30.0), Random(3)
    for _ in range(500):
        time.run_until(time.now_s() + random.expovariate(0.1))
        sender = SENDERS[random.choice(list(SENDERS))]
        command = random.choice(COMMANDS)
        refusal = admission.refusal(sender, command, time.now_s())
        invariants.admitted(sender, command, refusal)

    assert invariants.violations == []


@pytest.mark.parametrize(
    ("who", "command", "refusal"),
    [
        ("dora", Stop(), ""),  # who may only watch
        ("ben", Release(), ""),  # without the lease
        ("ada", Release(), "no"),  # with it
        ("ben", RecorderReport(status=STATUS), ""),  # which is for this machine's
    ],
)
def test_more_or_less_than_ones_rights_is_a_violation(invariants, who, command, refusal):
    invariants.admitted(SENDERS["ada"], Standby(), "")
    assert invariants.violations == []

    invariants.admitted(SENDERS[who], command, refusal)

    assert [one.invariant for one in invariants.violations] == ["lease and rights are kept"]


# ------------------------------------------------------------ stars


def follow(invariants, plant, seconds, away_px, mode="VERNIER"):
    for at_s in 5.0 + 0.5 * np.arange(2 * seconds):
        az_px, el_px = plant.spots_px(at_s)[0, 0] + (0.6 * away_px, 0.8 * away_px)
        row = {"mid_exposure_s": at_s, "star_az_px": az_px, "star_el_px": el_px}
        invariants.record(tick(1, loop="right", mode=mode, frame_age_s=0.02, **row))
    return [one.invariant for one in invariants.violations]


@pytest.mark.parametrize("mode", ["COARSE", "VERNIER"])
def test_a_loop_that_follows_anothers_star_is_noticed(invariants, plant, mode):
    assert follow(invariants, plant, 12, 7.0, mode) == ["a loop follows its own star"]


@pytest.mark.parametrize(
    ("seconds", "away_px", "mode"),
    [(12, 5.0, "VERNIER"), (9, 7.0, "VERNIER"), (12, 7.0, "ACQUISITION"), (12, np.nan, "VERNIER")],
)
def test_a_loop_may_see_its_own_star_or_another_for_a_while(
    invariants, plant, seconds, away_px, mode
):
    assert follow(invariants, plant, seconds, away_px, mode) == []


def test_a_loop_may_follow_what_a_frozen_camera_shows(invariants, plant):
    invariants._lines["camera"].wrong["frozen"] = 0.0

    assert follow(invariants, plant, 12, 7.0) == []


@pytest.mark.parametrize(
    ("wrong", "violated"), [("drops", []), ("saturated", ["a tick acts on the newest frame"])]
)
def test_a_tick_may_act_on_an_old_frame_where_newer_ones_are_lost(invariants, wrong, violated):
    line = invariants._lines["camera"]
    line.wrong[wrong] = 0.0
    mid_exposure = {"mid_exposure_s": np.nan}
    invariants.record(tick(1, loop="right", mode="STANDBY", frame_age_s=2.0, **mid_exposure))

    assert [one.invariant for one in invariants.violations] == violated


def test_a_loop_may_follow_a_star_that_a_person_pointed_at(invariants, plant):
    invariants.answered(Look(az_px=20.0, el_px=20.0), Reply(accepted=True))

    assert follow(invariants, plant, 12, 7.0) == []


# ------------------------------------------------------------ whole runs


@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "settings"),
    [*((rig, []) for rig in RIGS), *((rig, slow_servos(rig, 1)) for rig in SLOW)],
)
def test_each_rig_holds_its_stars_where_nothing_happens(rig, settings):
    quiet = plan(gives(0.1, None), gives(6.0, None), duration_s=7.0, rig=rig, settings=settings)
    result = run_plan(quiet)

    assert result.violations == []
    assert result.modes["VERNIER"] >= 1


def test_a_learnt_design_comes_by_itself_while_the_star_is_held():
    learnt = report(design_json=LEARNT_DESIGNS[0])
    learner = [gives(float(at_s), learnt) for at_s in range(2, 40, 4)]
    changes = []

    def keep(record):
        if isinstance(record, ControllerChange):
            changes.append(record)

    watched = plan(
        gives(0.1, None),
        gives(1.0, None),
        *learner,
        duration_s=42.0,
        settings=learning("fit-mock.toml"),
    )
    assert run_plan(watched, keep).violations == []
    assert [change.target for change in changes][:1] == ["learnt"]
    assert "learnt from" in changes[0].reason


@pytest.mark.long
def test_a_sequence_runs_beside_operators_and_ends():
    happenings = [
        Sequence(at_s=0.1, who="ada", steps=["acquire", "offset", "hold", "off"]),
        gives(9.0, Stop(), "ben"),
        RecorderDeath(at_s=4.0),
        FullDisk(at_s=5.0, lasts_s=2.0),
    ]

    result = run_plan(plan(*happenings, duration_s=12.0))

    assert result.violations == []
    assert result.modes["SAFE"] >= 1
    assert {"VERNIER", "ACQUISITION"} <= result.modes.keys()


def test_the_steps_of_sequences_are_those_that_plans_draw():
    drawn = set(" ".join((*plans._STEPS, *plans._CALIBRATING, *plans._OF_TESTBED)).split())
    assert drawn == STEPS.keys()
    assert {type(make("right")) for make in STEPS.values()} == set(get_args(AnyStep))


def ends_of(monkeypatch, happenings, **plan_options):
    """How each sequence of a plan ended."""
    ends, end = [], Contact.end

    def noted(self, state, text=""):
        ends.append(f"{state}{': ' if text else ''}{text}")
        end(self, state, text)

    monkeypatch.setattr(Contact, "end", noted)
    assert run_plan(plan(*happenings, **plan_options)).violations == []
    return ends


BY_WORDS = {
    words: "fit-mock.toml" if words not in plans._OF_TESTBED else "fit-testbed.toml"
    for words in (*plans._STEPS, *plans._CALIBRATING, *plans._OF_TESTBED)
    if words != "overlap"  # the plant's fringe spots lie on each other from the beginning
}


@pytest.mark.long
@pytest.mark.parametrize("words", BY_WORDS)
def test_each_step_that_plans_draw_succeeds_on_a_healthy_rig(monkeypatch, words):
    sequences = [
        Sequence(at_s=0.2, who="ada", steps=["acquire"]),
        Sequence(at_s=50.0, who="ada", steps=words.split(), loop="right"),
    ]
    if words.endswith("dark"):
        sequences.append(Cloud(at_s=49.0, lasts_s=60.0, part=0.0))

    ends = ends_of(monkeypatch, sequences, rig=BY_WORDS[words], duration_s=110.0)

    assert ends == ["done", "done"]


@pytest.mark.long
@pytest.mark.parametrize("answers", [0, 2])
def test_an_answer_that_a_sequence_never_or_twice_receives_is_found(monkeypatch, answers):
    take = SwarmService._take_answer

    def wrong(self, tag, payload):
        of_sequence = not isinstance(self._sent[tag][2], partial)  # people's have a number
        for _ in range(answers if of_sequence else 1):
            take(self, tag, payload)

    monkeypatch.setattr(SwarmService, "_take_answer", wrong)
    happenings = [Sequence(at_s=1.0, who="ada", steps=["standby"])]

    found = run_plan(plan(*happenings, duration_s=8.0)).violations

    assert "a command is answered once" in {one.invariant for one in found}


@pytest.mark.long
def test_nothing_begins_once_all_is_being_healed():
    late = Strike(at_s=36.0, device="camera", fault="mute", lasts_s=60.0)

    assert run_plan(plan(late, duration_s=8.0)).violations == []


@pytest.mark.long
def test_a_console_that_shows_another_mode_is_noticed(monkeypatch):
    accept = ConsoleState.accept

    def accept_late(self, message, now_s):
        for loop in message.loops:
            if loop.mode == Mode.ACQUISITION.name:
                message = msgspec.structs.replace(
                    message, loops=[msgspec.structs.replace(loop, mode="STANDBY")]
                )
        accept(self, message, now_s)

    monkeypatch.setattr(ConsoleState, "accept", accept_late)
    result = run_plan(plan(gives(0.1, None), gives(1.0, Acquire()), duration_s=2.0))

    assert "the console shows what is" in {one.invariant for one in result.violations}


@pytest.mark.long
@pytest.mark.parametrize("kind", ["ticks", "piezo", "timing", "events"])
def test_a_console_that_does_not_show_the_newest_of_a_kind_is_noticed(monkeypatch, kind):
    accept = ConsoleState.accept

    def forget(self, message, now_s):
        accept(self, msgspec.structs.replace(message, **{kind: getattr(message, kind)[:-1]}), now_s)

    monkeypatch.setattr(ConsoleState, "accept", forget)
    happens = [gives(at_s, None) for at_s in (0.1, 1.0, 2.0, 3.0)]
    (violation,) = run_plan(plan(*happens, duration_s=12.0)).violations

    assert violation.invariant == "the console shows what is"


REMOTE = msgspec.structs.replace(
    plan(
        *[gives(at_s, None) for at_s in (0.1, 1.0, 2.0)],
        Kill(at_s=20.0, back_after_s=0.5),
        *[gives(at_s, None) for at_s in (22.0, 24.0)],
        duration_s=40.0,
    ),
    remote_consoles=2,
)


@pytest.mark.long
def test_consoles_far_away_receive_what_was_sent_and_change_nothing(monkeypatch):
    missed, take = [], RemoteConsole._take

    def noted(self, message):
        take(self, message)
        missed.append(self._state.missed)

    monkeypatch.setattr(RemoteConsole, "_take", noted)
    result = run_plan(REMOTE)

    assert result.violations == []
    assert len(missed) > 100
    assert max(missed) > 0  # their links have little room
    assert result.digest == run_plan(msgspec.structs.replace(REMOTE, remote_consoles=0)).digest


@pytest.mark.long
@pytest.mark.parametrize(
    ("owner", "name", "mistake"),
    [
        (client, "plain_message", lambda message: msgspec.structs.replace(message, events=[])),
        (ConsoleState, "missed", property(lambda _: 0, lambda _, missed: None)),
    ],
)
def test_a_console_far_away_that_decodes_or_counts_wrongly_is_noticed(
    monkeypatch, owner, name, mistake
):
    monkeypatch.setattr(owner, name, mistake, raising=False)
    violated = {one.invariant for one in run_plan(REMOTE).violations}

    assert "a console far away shows what was" in violated


@pytest.mark.long
def test_the_testbed_goes_back_to_its_stars_though_two_supervisors_are_killed_before_a_search():
    result = run_plan(
        plan(
            *[gives(at_s, None) for at_s in (0.1, 1.5, 3.0, 5.0, 8.0)],
            Kill(at_s=26.0, back_after_s=0.5),
            gives(28.0, Standby()),
            Kill(at_s=32.0, back_after_s=0.5),
            duration_s=34.0,
            rig="fit-testbed.toml",
        )
    )

    assert result.violations == []
    assert result.modes["VERNIER"] >= 2


@pytest.mark.long
def test_the_testbed_finds_its_star_though_the_collector_went_far_without_a_held_beam():
    result = run_plan(
        plan(
            gives(0.5, MoveCollector(action="reference")),
            gives(8.0, MoveCollector(action="start", kind="drift", velocity_mm_s=1.0)),
            duration_s=24.0,
            rig="fit-testbed.toml",
        )
    )

    assert result.violations == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("part", "violated"), [(1.0, []), (1.05, ["no siderostat is driven beyond its travel"])]
)
def test_a_siderostat_that_is_jogged_to_the_end_stays_within_its_travel(
    monkeypatch, part, violated
):
    made = SiderostatStage.__init__

    def made_with_travel(self, *arguments):
        made(self, *arguments)
        self.travel_rad *= part

    monkeypatch.setattr(SiderostatStage, "__init__", made_with_travel)
    jogs = plans._jogged_to_the_end(Random(1), 12.0, ("right",))
    result = run_plan(plan(*[gives(at_s, None) for at_s in (0.1, 1.0)], *jogs, duration_s=20.0))

    assert [one.invariant for one in result.violations] == violated


POWER_CUT = plan(
    gives(0.1, Standby()),
    gives(2.0, Acquire(expected_az_sky_arcsec=400.0, expected_el_sky_arcsec=0.0)),
    Strike(at_s=6.0, device="right siderostat", fault="power cut"),
    gives(7.0, Recover()),
)


@pytest.mark.long
def test_after_a_power_cut_of_its_amplifiers_a_star_is_found_again():
    result = run_plan(POWER_CUT)

    assert result.violations == []
    assert result.modes["VERNIER"] >= 1


def power_cuts_about_openings(times, step_s):
    """Every three seconds a jog, a stop, an opening and a power cut, each time a step later in the opening."""
    for number in range(times):
        at_s = 1.0 + 3.0 * number
        yield gives(
            at_s, Jog(loop="right", az_sky_arcsec=-60.0 if number % 2 else 60.0, el_sky_arcsec=0.0)
        )
        yield gives(at_s + 1.0, Stop())
        yield gives(at_s + 1.3, Recover())
        cut_s = at_s + 1.25 + step_s * number
        yield Strike(at_s=cut_s, device="right siderostat", fault="power cut")
        yield gives(at_s + 2.2, Recover())


@pytest.mark.long
@pytest.mark.parametrize("rig", sorted(RIGS.keys() - {"fit-testbed.toml"}))
def test_a_power_cut_at_any_instant_of_an_opening_is_noticed(rig):
    times, noticed = 60, []
    happenings = [gives(0.1, Standby()), *power_cuts_about_openings(times, 0.005)]

    def on_record(record):
        if isinstance(record, Event) and "encoders read elsewhere" in record.message:
            noticed.append(record.time_s)

    result = run_plan(plan(*happenings, duration_s=1.0 + 3.0 * times, rig=rig), on_record)

    assert result.violations == []
    assert [int((at_s - 1.0) / 3.0) for at_s in noticed] == list(range(times))


@pytest.mark.long
def test_encoders_that_lost_their_zero_unnoticed_are_a_violation(monkeypatch):
    never = property(lambda _: False, lambda _, jumped: None)
    monkeypatch.setattr(SiderostatServo, "encoders_jumped", never, raising=False)
    violated = {one.invariant for one in run_plan(POWER_CUT).violations}

    assert "encoders that count from elsewhere are noticed" in violated


@pytest.mark.long
def test_a_stage_that_moves_by_a_zero_that_is_lost_is_a_violation(monkeypatch):
    # As if the link outlived the loss of power. Analogue amplifiers do not report that they have none.
    monkeypatch.setattr(SwarmAmplifiers, "reset", SwarmAmplifiers._power_down)
    on_analogue = msgspec.structs.replace(POWER_CUT, rig="fit-bal-analog.toml")
    violated = {one.invariant for one in run_plan(on_analogue).violations}

    assert "no stage moves by a zero that is lost" in violated


@pytest.mark.long
@pytest.mark.parametrize("jump_urad", [0.0, 3.0])
def test_a_mirror_that_jumps_to_and_fro_while_a_star_is_held_is_a_violation(monkeypatch, jump_urad):
    move_to, jumps_rad = MirrorStage.move_to, itertools.cycle([jump_urad * 1e-6, -jump_urad * 1e-6])

    def jump(self, mirror_rad, **options):
        move_to(self, mirror_rad + next(jumps_rad), **options)

    monkeypatch.setattr(MirrorStage, "move_to", jump)
    violated = {one.invariant for one in run_plan(plan(gives(0.1, Standby()))).violations}

    assert violated == ({"a star that is held stays so"} if jump_urad else set())
