"""Which files can be replayed, and what is said of those that cannot."""

import msgspec
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from replay_courses import hold_a_star, replayed

from fitctl.config import default_rig_path, load_rig
from fitctl.logging import schemas
from fitctl.logging.copying import cut
from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info
from fitctl.logging.records import Tick
from fitctl.supervisor.messages import SetTarget, Stop
from tests.logged_simulation import WALL_S, LoggedSimulation


def test_the_files_that_a_run_was_rotated_into_are_replayed_as_one(logged, tmp_path):
    second = tmp_path / "second.mcap"

    def course(simulation):
        hold_a_star(simulation)
        simulation.go_on_in(second)
        simulation.command(SetTarget(az_px=22.0, el_px=18.5))
        simulation.run(1.0)

    first, simulation = logged(course)
    result = replayed(first, second)

    assert result.same, result
    assert (
        result.loops["right"].ticks
        > sum(tick.time_s < simulation.clock.now_s() - 0.1 for tick in simulation.ticks) - 3
    )
    with pytest.raises(LogError, match=r"midst of a run .* give all files of the run"):
        replayed(second)


def test_a_log_that_was_torn_is_replayed_up_to_there(held_log):
    path, _ = held_log()
    whole = replayed(path).loops["right"].ticks
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    result = replayed(path)

    assert result.same, result
    assert 10 < result.loops["right"].ticks < whole


def test_the_midst_of_a_run_is_refused_whether_cut_soon_or_late(logged, tmp_path):
    def course(simulation):
        hold_a_star(simulation)
        simulation.command(Stop())
        simulation.run(9.0)

    path, _ = logged(course)
    for from_s, said in ((2.0, "loop right is in VERNIER"), (11.0, "11 s after the run's start")):
        part = tmp_path / f"from {from_s}.mcap"
        cut(path, part, from_ns=round((WALL_S + from_s) * 1e9), to_ns=2**63)
        with pytest.raises(LogError, match=said):
            replayed(part)


def test_a_log_without_frames_is_refused(held_log, tmp_path):
    path, _ = held_log()
    part = tmp_path / "part.mcap"
    ticks_only = ["/fit/right/tick", "/fit/right/opened"]
    cut(path, part, from_ns=0, to_ns=2**63, topics=ticks_only)

    with pytest.raises(LogError, match=r"has no /fit/camera/frame.*topics: /fit/right"):
        replayed(part)


def test_logs_of_two_runs_are_not_taken_for_one(held_log, tmp_path):
    path, _ = held_log()
    other = tmp_path / "other.mcap"
    rig = load_rig(default_rig_path())
    LoggedSimulation(rig, other, start_s=1.0).writer.close()

    with pytest.raises(LogError, match=r"other.mcap: is of another run"):
        replayed(path, other)


def test_a_log_of_an_older_fitctl_is_refused_and_says_what_it_lacks(held_log, monkeypatch):
    fields = [f for f in msgspec.structs.fields(Tick) if f.required]
    old = msgspec.defstruct("Tick", [(f.name, f.type) for f in fields])
    message = schemas.message_class(old, DescriptorPool())
    monkeypatch.setitem(
        schemas.MESSAGES, Tick, lambda **values: message(**{f.name: values[f.name] for f in fields})
    )
    path, _ = held_log()

    assert log_info(path).counts["/fit/right/tick"] > 100
    with pytest.raises(LogError, match=r"older fitctl .* neither commands nor when voltages"):
        replayed(path)
