"""How a sequence runs: attempts, time limits, pauses, and every way to end one."""

from pathlib import Path

import numpy as np
import pytest
from instruments.simulated import AS_SHIPPED
from sequence_runs import run_sequence

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import Acquire, Release, SequenceControl, Stop
from fitctl.sequences import view
from fitctl.sequences.behaviours import pointing
from fitctl.sequences.files import find_sequence, shipped_sequences
from fitctl.sequences.links import SimulatedLink
from fitctl.sequences.reading import load_sequence

ACQUIRE = {"step": "acquire"}
HOLD = {"step": "hold", "duration_s": 5.0, "settle_s": 5.0}
RIG = load_rig(default_rig_path())
RIGS = default_rig_path().parent
SKIES = {
    "stars": load_rig(RIGS / "star-field.toml"),
    **dict.fromkeys(
        ("ambient", "feedforward", "overlap", "photodiodes", "testbed"),
        load_rig(RIGS / "fit-testbed.toml"),
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("path", shipped_sequences(), ids=lambda path: path.stem)
def test_every_shipped_sequence_runs_to_its_end(path):
    rig = SKIES.get(path.stem, RIG)
    sequence = load_sequence(path, rig)
    assert sequence.name == path.stem

    attempts = run_sequence(SimulatedLink(rig, 0), rig, sequence)

    last = {attempt.step_number: attempt.outcome for attempt in attempts}
    assert list(last.values()) == ["done"] * len(sequence.steps)


@pytest.mark.long
def test_a_held_star_is_judged_against_the_requirement(tried):
    run = tried()

    run(ACQUIRE, HOLD, {**HOLD, "rms_limit_px": 1e-4, "attempts": 2})

    assert run.outcomes() == ["done", "done", "failed", "failed"]
    held = run.figures(1)
    assert 0 < held["rms_az_px"] < held["limit_px"] == RIG.loops["right"].requirement_px
    assert held["frames_seen"] == 250
    assert "required 0.0001 px" in run.error
    assert run.link.mode() == "VERNIER"  # a poor RMS is no reason to let go


def test_a_search_that_finds_nothing_is_tried_again(tried):
    run = tried(
        "plant.loops.right.star_offset_sky_arcsec_max=5000.0",
        "loops.right.acquisition.search_radius_sky_arcsec=40.0",
    )

    run({**ACQUIRE, "attempts": 2}, HOLD)

    assert run.outcomes() == ["failed", "failed"]
    assert "no star within" in run.attempts[0].message
    assert [attempt.attempt for attempt in run.attempts] == [1, 2]
    assert run.states[-1] == "failed"


ELSEWHERE = {"expected_az_sky_arcsec": 200.0, "expected_el_sky_arcsec": 0.0}
GROWING = {"search_radius_sky_arcsec": 40.0, "radius_growth": 2.0, "max_offset_sky_arcsec": 170.0}


def searches(run):
    asked = [command for command in run.link.commands if isinstance(command, Acquire)]
    return [command.search_radius_sky_arcsec for command in asked]


def test_each_attempt_searches_wider_about_the_same_place(tried):
    run = tried()

    run({**ACQUIRE, **ELSEWHERE, **GROWING, "attempts": 5})

    assert run.outcomes() == ["failed", "failed", "done"]
    assert searches(run) == [40.0, 80.0, 160.0]
    assert "no star within 80 arcsec" in run.attempts[1].message


def test_no_attempt_searches_beyond_the_largest_offset(tried):
    run = tried()
    nowhere = {**ELSEWHERE, "expected_az_sky_arcsec": -900.0}

    run({**ACQUIRE, **nowhere, **GROWING, "attempts": 4})

    assert run.outcomes() == ["failed"] * 4
    assert searches(run) == [40.0, 80.0, 160.0, 170.0]


def test_without_a_largest_offset_every_attempt_is_the_rig_files(tried):
    run = tried("plant.loops.right.star_offset_sky_arcsec_max=5000.0")

    run({**ACQUIRE, "attempts": 2})

    assert searches(run) == [None, None]


def test_a_star_that_is_held_is_let_go_for_one_that_is_expected_elsewhere(tried):
    run = tried()

    run(ACQUIRE, {**ACQUIRE, **ELSEWHERE, "attempts": 1, "search_radius_sky_arcsec": 20.0})

    assert run.outcomes() == ["done", "failed"]
    assert "no star within 20 arcsec" in run.error


def test_a_step_that_takes_too_long_is_stopped_and_the_stages_are_held(tried):
    run = tried("plant.loops.right.star_offset_sky_arcsec_max=200.0", AS_SHIPPED)

    run({**ACQUIRE, "timeout_s": 1.0, "attempts": 1})

    assert run.outcomes() == ["timed out"]
    taken_s = run.attempts[0].ended_s - run.attempts[0].began_s
    assert taken_s == pytest.approx(8.2, abs=0.5)  # the search itself takes 7.2 s
    assert run.link.mode() == "STANDBY"


def test_a_step_waits_for_the_mode_that_it_needs_but_not_for_one_that_never_comes(tried):
    run = tried()

    run(HOLD)

    assert run.outcomes() == ["failed"]
    assert "hold needs VERNIER; loop right is in OFF" in run.error
    assert run.link.commands == []


def test_a_star_that_is_let_go_fails_the_hold_and_the_next_attempt_says_why(tried):
    run = tried()
    run.link.meddling = [(15.0, Release())]

    run(ACQUIRE, {**HOLD, "duration_s": 60.0, "attempts": 2})

    assert run.outcomes() == ["done", "failed", "failed"]
    assert "not held all the time" in run.attempts[1].message
    assert "needs VERNIER" in run.attempts[2].message


def test_a_hold_shorter_than_a_frame_is_judged_by_one_frame(tried):
    run = tried()
    run(ACQUIRE, {**HOLD, "duration_s": 0.005})

    assert run.figures(1)["frames_seen"] == 1
    assert run.figures(1)["rms_az_px"] < 0.1


def test_a_sequence_goes_on_where_telemetry_is_slow(tried):
    run = tried("supervisor.telemetry_hz=1.0")
    run({"step": "standby"})

    assert (run.outcomes(), run.error) == (["done"], "")


def test_a_loop_that_the_supervisor_does_not_have_ends_the_sequence(tried):
    run = tried()
    run.rig = load_rig(default_rig_path().parent / "two-stars.toml")
    run({"step": "standby", "loop": "left"})

    assert "the supervisor has no loop left" in run.error


def test_stop_ends_the_sequence_at_once_and_has_the_last_word(tried):
    run = tried()
    run.link.meddling = [(15.0, Stop())]

    run(ACQUIRE, {"step": "dither", "dwell_s": 20.0, "attempts": 3}, HOLD)

    assert run.outcomes() == ["done", "stopped"]
    assert run.attempts[-1].ended_s < 15.5
    assert "SAFE" in run.error
    given = len(run.link.commands)
    assert run.link.mode() == "SAFE"
    run(ACQUIRE)
    assert "SAFE" in run.error
    assert len(run.link.commands) == given  # nothing was commanded


@pytest.mark.parametrize(
    "step", [{"step": "wait", "duration_s": 60.0}, {**ACQUIRE, **ELSEWHERE, "loop": "right"}]
)
def test_safe_of_any_loop_that_had_a_step_ends_the_sequence_at_once(tried, step):
    run = tried(rig="fit-testbed.toml")
    first, other = list(run.rig.loops)[:2]
    run.link.meddling = [(3.0, Stop(loop=other))]

    run({"step": "standby", "loop": other}, step, {"step": "standby", "loop": first})

    assert run.outcomes() == ["done", "stopped"]
    assert run.attempts[-1].ended_s < 3.5
    assert f"loop {other} is SAFE" in run.error
    assert not any(isinstance(command, Release) for command in run.link.commands)


@pytest.mark.parametrize("used", [0, 1])
def test_safe_of_a_loop_that_had_no_step_ends_no_sequence(tried, used):
    run = tried(rig="fit-testbed.toml")
    loops = list(run.rig.loops)[:2]
    run.link.meddling = [(3.0, Stop(loop=loops[1 - used]))]

    run({"step": "standby", "loop": loops[used]}, {"step": "wait", "duration_s": 5.0})

    assert (run.outcomes(), run.error) == (["done", "done"], "")


def test_the_operator_stops_it_and_the_stages_are_held(tried):
    run = tried()
    run.link.meddling = [(15.0, SequenceControl(action="end"))]

    run(ACQUIRE, {**HOLD, "duration_s": 600.0}, HOLD)

    assert run.outcomes() == ["done", "stopped"]
    assert "stopped by the operator" in run.error
    assert run.link.mode() == "STANDBY"


def test_loops_are_released_in_the_order_in_which_they_had_steps(tried):
    run = tried(rig="fit-testbed.toml")
    run.link.meddling = [(5.0, SequenceControl(action="end"))]

    run(
        *({"step": "standby", "loop": name} for name in ("left", "metrology", "right")),
        {"step": "wait", "duration_s": 60.0},
    )

    released = [command.loop for command in run.link.commands if isinstance(command, Release)]
    assert released == ["left", "metrology", "right"]


@pytest.mark.parametrize("when_s", [0.5, 15.0])
def test_ctrl_c_ends_the_step_and_holds_the_stages(tried, when_s):
    def interrupt(_link):
        raise KeyboardInterrupt

    run = tried("plant.loops.right.star_offset_sky_arcsec_max=60.0")
    run.link.meddling = [(when_s, interrupt)]

    with pytest.raises(KeyboardInterrupt):
        run(ACQUIRE, {"step": "offset", "offset_az_px": 3.0, "offset_el_px": 0.0, "dwell_s": 60.0})

    assert run.attempts[-1].outcome == "stopped"
    assert run.link.mode() == "STANDBY"
    target = RIG.loops["right"].target_px
    assert run.link.target_px() == [target.az, target.el]


@pytest.mark.long
def test_a_long_hold_remembers_no_more_frames_than_a_message_brings(tried, monkeypatch):
    remembered = []

    def columns(measurements):
        remembered.append(len(measurements))
        return view.columns(measurements)

    monkeypatch.setattr(pointing, "columns", columns)
    run = tried()
    run(ACQUIRE, {**HOLD, "duration_s": 30.0})

    assert run.figures(1)["frames_seen"] == 1500
    assert sum(remembered) >= 1500
    assert max(remembered) < 10


@pytest.mark.long
def test_a_pause_within_a_hold_is_not_judged_and_not_counted(tried):
    run = tried()
    run.link.meddling = [
        (15.0, SequenceControl(action="pause")),
        (200.0, SequenceControl(action="resume")),
    ]

    run(ACQUIRE, {**HOLD, "duration_s": 10.0, "timeout_s": 5.0})

    assert run.outcomes() == ["done", "done"]
    assert run.attempts[1].ended_s > 200.0
    assert run.figures(1)["frames_seen"] == 500
    assert run.states == ["running", "paused", "running", "done"]


@pytest.mark.long
def test_a_pause_within_a_motion_takes_effect_after_it(tried):
    run = tried()
    run.link.meddling = [
        (15.0, SequenceControl(action="pause")),
        (100.0, SequenceControl(action="resume")),
    ]

    run(ACQUIRE, {"step": "dither", "dwell_s": 12.0}, {"step": "wait", "duration_s": 1.0})

    assert run.outcomes() == ["done", "done", "done"]
    jog, wait = run.attempts[1:]
    assert jog.ended_s < 60.0
    assert wait.ended_s > 100.0


@pytest.mark.long
def test_a_target_that_fails_goes_back_to_the_rig_files(tried):
    run = tried(AS_SHIPPED)
    away = {"step": "offset", "offset_az_px": 2.0, "offset_el_px": -1.0, "dwell_s": 12.0}

    run(ACQUIRE, away, {**away, "offset_az_px": 3.0, "rms_limit_px": 1e-4})

    assert run.outcomes() == ["done", "done", "failed"]
    target = RIG.loops["right"].target_px
    assert run.link.target_px() == [target.az, target.el]


@pytest.mark.long
def test_motions_that_a_lost_star_ends_are_not_taken_for_whole_but_made_again(tried):
    def jump(link):
        link._simulation.plants["right"].constants.spot_origin_px[:] += np.array([40.0, 0.0])

    run = tried()
    run.link.meddling = [(15.0, jump)]

    run(ACQUIRE, {"step": "chirp", "channel": "fsm_az", "duration_s": 20.0, "attempts": 2})

    assert run.outcomes() == ["done", "failed", "done"]
    assert "ended early, in ACQUISITION, by star lost" in run.attempts[1].message
    assert run.figures(2)["seen_fraction"] > 0.99


@pytest.mark.long
def test_motions_that_the_operator_stops_end_at_once(tried):
    run = tried()
    run.link.meddling = [(15.0, SequenceControl(action="end"))]

    run(ACQUIRE, {"step": "chirp", "channel": "fsm_az", "duration_s": 100.0})

    assert run.outcomes() == ["done", "stopped"]
    assert run.attempts[-1].ended_s < 15.5
    assert run.link.mode() == "STANDBY"


def test_attempts_of_a_run_are_recorded_once_each(rig):
    records = []
    link = SimulatedLink(rig, 0)
    link._simulation._on_record = records.append
    sequence = load_sequence(find_sequence(Path("acquire")), rig)

    attempts = run_sequence(link, rig, sequence)

    recorded = [record for record in records if type(record).__name__ == "SequenceAttempt"]
    assert recorded == attempts


@pytest.mark.long
def test_a_step_that_acquires_ends_the_search_for_a_lost_star_and_begins_its_own(tried):
    def goes_away(link):
        link._simulation.plants["right"].constants.spot_origin_px[:] += 5000.0

    run = tried()
    run.link.meddling = [(15.0, goes_away)]

    run(
        ACQUIRE,
        {"step": "wait", "duration_s": 15.0},
        {**ACQUIRE, "attempts": 1, "search_radius_sky_arcsec": 40.0},
    )

    assert run.outcomes() == ["done", "done", "failed"]
    assert "no star within 40 arcsec" in run.attempts[-1].message
