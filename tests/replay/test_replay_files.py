"""Which files can be replayed, and what is said of those that cannot."""

import shutil

import msgspec
import numpy as np
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from samples.replay_courses import hold_a_star, replayed

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.files import save_design
from fitctl.logging import schemas
from fitctl.logging.copying import cut
from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info
from fitctl.logging.records import Tick
from fitctl.messages.commands import SetTarget, Standby, Stop
from tests.samples.logged_simulation import WALL_S, LoggedSimulation


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
    with pytest.raises(LogError, match=r"middle of a run .* name all files of the run"):
        replayed(second)


def test_a_log_that_was_torn_is_replayed_up_to_there(held_log):
    path, _ = held_log()
    whole = replayed(path).loops["right"].ticks
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    result = replayed(path)

    assert result.same, result
    assert 10 < result.loops["right"].ticks < whole


@pytest.mark.long
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


def new_dark(path, seed):
    np.save(path, np.random.default_rng(seed).normal(1000.0, 30.0, (40, 40)))


def test_the_dark_frame_is_that_of_the_log_whatever_its_file_holds_by_now(logged, tmp_path):
    file, second = tmp_path / "dark.npy", tmp_path / "second.mcap"
    new_dark(file, 1)

    def course(simulation):
        hold_a_star(simulation)
        simulation.go_on_in(second)
        simulation.run(0.5)

    path, _ = logged(course, f"camera.dark_file={file}")
    new_dark(file, 2)

    assert replayed(path, second).same
    file.unlink()
    assert replayed(path).same


def test_a_log_with_only_the_name_of_its_dark_frame_is_replayed_with_the_file_that_the_user_names(
    logged, tmp_path, monkeypatch
):
    file = tmp_path / "dark.npy"
    new_dark(file, 1)
    monkeypatch.setattr("fitctl.daemon.run.dark_bytes", lambda _path: None)
    path, _ = logged(hold_a_star, f"camera.dark_file={file}")

    named = [f"camera.dark_file={file}"]
    assert replayed(path, change=named).same
    new_dark(file, 2)
    assert replayed(path, change=named).loops["right"].differences["star_px"].ticks > 100


def test_a_design_from_a_file_is_that_of_the_log_whatever_the_file_holds_by_now(logged, tmp_path):
    rig, file = load_rig(default_rig_path()), tmp_path / "mine.json"
    save_design(design_for(rig, "right", "lqg-ltr"), file)
    path, _ = logged(hold_a_star, f"loops.right.vernier.controller={file}")
    save_design(design_for(rig, "right", "minimum-variance"), file)

    assert replayed(path).same
    file.unlink()
    assert replayed(path).same


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


def test_a_copy_of_several_files_needs_room(logged, tmp_path, monkeypatch):
    second = tmp_path / "second.mcap"

    def course(simulation):
        simulation.command(Standby())
        simulation.go_on_in(second)
        simulation.run(0.1)

    first, _ = logged(course)
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)

    with pytest.raises(
        LogError, match=r"has 0 MB free, .* 2 files as one; .* set TMPDIR to another"
    ):
        replayed(first, second)
