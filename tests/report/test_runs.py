"""Which files are a run, and what becomes of files that are not whole, double, empty or somebody else's."""

import copy
import dataclasses
import itertools
import json
import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as McapWriter
from samples.forged_logs import forged, forged_of
from samples.log_samples import filled
from samples.logged_simulation import designs_of
from samples.report_samples import record

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.daemon.run import run_info
from fitctl.logging.copying import cut
from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info
from fitctl.logging.records import (
    DeviceHealth,
    Event,
    LoopTiming,
    ModeChange,
    RecorderStatus,
    Tick,
)
from fitctl.logging.schemas import TOPICS, message_class, run_metadata
from fitctl.logging.writer import LogWriter
from fitctl.messages.modes import Mode
from fitctl.report.findings import find
from fitctl.report.gather import gather
from fitctl.report.run import find_run
from fitctl.report.tables import losses


@pytest.fixture
def halves(held, tmp_path):
    """The log in two files that have a second in common, as when a recorder died between them."""
    info = log_info(held[1])
    middle_ns = round((info.start_s + 30.0) * 1e9)
    cut(held[1], tmp_path / "a.mcap", from_ns=0, to_ns=middle_ns + 10**9)
    cut(held[1], tmp_path / "b.mcap", from_ns=middle_ns, to_ns=2**63)
    return tmp_path


@pytest.mark.long
def test_a_run_of_several_files_is_one_and_what_two_have_counts_once(halves, held, findings):
    found = find(find_run([halves / "b.mcap", halves / "a.mcap"]))

    assert [log.path.name for log in found.run.logs] == ["a.mcap", "b.mcap"]
    for name, column in findings.loops["right"].ticks.items():
        np.testing.assert_array_equal(found.loops["right"].ticks[name], column)
    assert [m["reason"] for m in found.gathered.modes] == [
        m["reason"] for m in findings.gathered.modes
    ]
    assert found.gathered.lost == 3


def test_values_of_the_logs_own_rig_can_be_replaced(halves, held, rig):
    run = find_run([held[1]], overrides=["loops.right.requirement_px=0.2"])

    assert run.rig.stellar_loops["right"].requirement_px == 0.2
    assert run.rig.stellar_loops["right"].fsm == rig.stellar_loops["right"].fsm
    with pytest.raises(ConfigError, match=r"^--set: loops\.right\.fsm\.nonsense[^;]*$"):
        find_run([held[1]], overrides=["loops.right.fsm.nonsense=1"])


def test_a_rig_file_of_other_loops_or_frames_is_refused(held, rig):
    testbed = load_rig(default_rig_path().with_name("fit-testbed.toml"))
    narrower = rig.model_copy(update={"camera": rig.camera.model_copy(update={"width_px": 39})})

    assert find_run([held[1]], rig).rig is rig
    for other in (testbed, narrower):
        with pytest.raises(ConfigError, match=r"held\.mcap: --rig .*: loops, camera\.width_px and"):
            find_run([held[1]], other)


def test_a_folder_is_its_newest_run(halves, rig):
    other = halves / "older.mcap"
    info = run_info(rig, "simulated", now_s=-5000.0, designs=designs_of(rig))
    with LogWriter(other, rig.logging) as log:
        log.write(info, 1000.0)
        log.write(Event(time_s=1.0, severity="info", source="x", message="y"), 1000.0)

    (halves / "damaged.mcap").write_bytes(b"no log")

    assert [log.path.name for log in find_run([halves]).logs] == ["a.mcap", "b.mcap"]
    with pytest.raises(LogError, match=r"older\.mcap: is of another run.*--compare"):
        find_run([halves / "a.mcap", other])


def test_a_log_that_was_cut_off_is_judged_as_far_as_it_goes(held, tmp_path):
    path = tmp_path / "cut.mcap"
    whole = held[1].read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])

    found = find(find_run([path]))

    assert not found.run.logs[0].finished
    assert 5 < found.loops["right"].selection.evaluated_s < 40


def test_a_log_without_ticks_is_not_known(rig, tmp_path):
    path = tmp_path / "off.mcap"
    with LogWriter(path, rig.logging) as log:
        info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
        log.write(info, info.wall_minus_monotonic_s)
        log.write(Event(time_s=1.0, severity="error", source="camera", message="gone"), 1.8e9)

    found = find(find_run([path]))

    assert found.word == "not known"
    assert "no time in VERNIER" in found.loops["right"].verdict.why
    assert found.gathered.lost is None
    assert [event["message"] for event in found.gathered.events] == ["gone"]


def test_time_in_off_is_no_pointing(rig, tmp_path):
    path = tmp_path / "off.mcap"
    record(rig, path, lambda simulation: simulation.run(3.0))

    assert find(find_run([path])).word == "not known"


def test_two_loops_are_judged_each_by_itself(rig, tmp_path):
    document = rig.model_dump(mode="json")
    for section in (document["loops"], document["plant"]["loops"], document["mocks"]["loops"]):
        section["left"] = copy.deepcopy(section["right"])
    document["loops"]["left"]["target_px"] = {"az": 10.0, "el": 30.0}
    document["loops"]["left"]["siderostat"]["device"]["node_id"] = 2
    both = type(rig).model_validate_json(json.dumps(document))
    path = tmp_path / "both.mcap"

    def course(simulation):
        simulation.acquire()
        simulation.run(4.0)

    record(both, path, course)

    found = find(find_run([path]))

    assert list(found.loops) == ["right", "left"]
    assert all(len(loop.ticks["time_s"]) > 100 for loop in found.loops.values())


def test_what_two_files_have_both_counts_once_and_no_device_recovers_between_them(rig, tmp_path):
    """A change of mode that knows no angles of a link, and states of a device."""
    info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
    changed = filled(ModeChange, time_s=3.2, target="SAFE", link_az_rad=math.nan)
    states = [
        filled(DeviceHealth, time_s=float(second), device="camera", state=state)
        for second, state in enumerate(["ok", "ok", "ok", "fault", "fault"])
    ]
    for name, part in (("a", states), ("b", states[2:])):
        with LogWriter(tmp_path / f"{name}.mcap", rig.logging) as log:
            log.write(info, info.wall_minus_monotonic_s)
            for each in [*part, changed]:
                log.write(each, info.wall_minus_monotonic_s + each.time_s)

    found = gather(find_run([tmp_path / "a.mcap", tmp_path / "b.mcap"]))

    assert [mode["target"] for mode in found.modes] == ["SAFE"]
    assert [(row["time_s"], row["state"]) for row in found.health] == [(0.0, "ok"), (3.0, "fault")]


def test_every_recorder_counts_its_own_losses(rig, tmp_path):
    path = tmp_path / "lost.mcap"
    with LogWriter(path, rig.logging) as log:
        info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
        log.write(info, info.wall_minus_monotonic_s)
        for second, lost in enumerate([0, 2, 2, 0, 5]):
            status = RecorderStatus(
                time_s=float(second), path="p", records=1, lost=lost, bytes_written=1
            )
            log.write(status, 1.8e9 + second)

    assert gather(find_run([path])).lost == 7


@pytest.mark.parametrize(
    ("kind", "types", "refusal"),
    [
        (DeviceHealth, {"state": None}, "records of health lack state"),
        (Tick, {"error_az_px": None}, "its ticks lack error_az_px"),
        (Tick, {"mode_number": str}, "mode_number of its ticks is str.*; expected numbers"),
        (ModeChange, {"target": float}, "target of its records of modes is float64; expected text"),
    ],
)
def test_records_of_another_shape_are_refused_in_one_line(rig, tmp_path, kind, types, refusal):
    """Records as fitctl has them, but for some fields of another type, or without them."""
    shape = {one.name: one.type for one in msgspec.structs.fields(kind)} | types
    fields = [(name, of_type) for name, of_type in shape.items() if of_type]
    message = message_class(msgspec.defstruct(kind.__name__, fields), DescriptorPool())
    path = tmp_path / "shaped.mcap"
    with path.open("wb") as stream, McapWriter(stream) as writer:
        info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
        for name, values in run_metadata(info).items():
            writer._writer.add_metadata(name, values)
        writer.write_message(TOPICS[kind].format(loop="right"), message(), 10**18, 10**18)

    with pytest.raises(LogError, match=refusal) as raised:
        gather(find_run([path]))

    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["mid_exposure_s", "time_s"])
@pytest.mark.parametrize("value", [np.inf, -1e15, np.nan])
def test_a_time_that_is_none_is_refused(rig, tmp_path, name, value):
    info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
    records = [info, filled(Tick, loop="right")]
    path = forged_of(records, tmp_path / "odd.mcap", "/fit/right/tick", **{name: value})

    with pytest.raises(LogError, match=rf"odd\.mcap: {name} of its ticks is no time"):
        gather(find_run([path]))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *itertools.product(
            ["error_az_px", "stack1_v", "siderostat_el_rad"], [np.nan, np.inf, 1e300, -1e15]
        ),
        *(("star_flux_dn", value) for value in (np.nan, 0.0, 1e-300)),
    ],
)
def test_numbers_that_no_instrument_has_are_refused(rig, tmp_path, name, value):
    info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
    held = filled(Tick, loop="right", mode_number=Mode.VERNIER)
    topic = "/fit/right/tick"
    path = forged_of([info, held], tmp_path / "odd.mcap", topic, **{name: value})

    refusal = rf"odd\.mcap: {name} of its ticks is .*; expected a number that an instrument has"
    with pytest.raises(LogError, match=refusal):
        gather(find_run([path]))


def test_infinite_times_of_a_loop_are_refused(rig, tmp_path):
    info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
    topic, records = "/fit/right/timing", [info, filled(LoopTiming, loop="right")]
    path = forged_of(records, tmp_path / "odd.mcap", topic, compute_worst_s=np.inf)

    with pytest.raises(LogError, match=r"compute_worst_s of its records of timing is inf"):
        gather(find_run([path]))


def test_a_tick_without_a_frame_needs_no_time_of_one(rig, tmp_path):
    path = tmp_path / "blind.mcap"
    info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
    with LogWriter(path, rig.logging) as log:
        log.write(info, 1e9)
        log.write(filled(Tick, loop="right", number=-1, mid_exposure_s=np.nan), 1e9)

    assert len(gather(find_run([path])).ticks["right"]["time_s"]) == 1


@pytest.mark.parametrize("wrong_ns", [0, 2**62])
def test_one_record_of_a_wrong_time_leaves_the_others(held, findings, tmp_path, wrong_ns):
    def change(record):
        is_it = record.topic == "/fit/right/tick" and record.sequence == 1000
        return wrong_ns if is_it else None

    found = find(find_run([forged(held[1], tmp_path / "forged.mcap", change)]))

    expected = findings.loops["right"].ticks["number"]
    np.testing.assert_array_equal(found.loops["right"].ticks["number"], expected[expected != 1000])
    assert (found.gathered.misdated, findings.gathered.misdated) == (1, 0)
    assert "Left out: 1 records" in losses(found).caption
    assert "Left out" not in losses(findings).caption


def test_records_that_come_out_of_their_order_are_all_there(held, findings, tmp_path):
    """One tick has a time of an hour later: those after it are no copies of earlier ones."""

    def change(record):
        is_it = record.topic == "/fit/right/tick" and record.sequence == 1000
        return record.publish_time_ns + 3600 * 10**9 if is_it else None

    found = find(find_run([forged(held[1], tmp_path / "forged.mcap", change)]))

    ticks, expected = found.loops["right"].ticks, findings.loops["right"].ticks
    assert sorted(ticks["number"]) == sorted(expected["number"])
    assert ticks["number"][-1] == 1000


@pytest.mark.parametrize("off_s", [-3600.0, 3600.0, -1e12, 1e12])
def test_a_frame_exposed_at_an_impossible_time_ends_a_piece(held, findings, tmp_path, off_s):
    def change(record):
        if record.topic == "/fit/right/tick" and record.sequence == 1000:
            record.message.mid_exposure_s += off_s

    found = find(find_run([forged(held[1], tmp_path / "forged.mcap", change)]))

    one, other = (each.loops["right"] for each in (found, findings))
    assert len(one.selection.pieces) == len(other.selection.pieces) + 1
    assert len(one.selection.rows) == len(other.selection.rows) - 1
    assert one.residual["az"].rms == pytest.approx(other.residual["az"].rms, rel=1e-2)


def test_more_records_than_bytes_in_a_file_are_refused(rig, tmp_path):
    path = tmp_path / "off.mcap"
    record(rig, path, lambda simulation: simulation.run(1.0))
    run = find_run([path])
    counts = {TOPICS[Tick].format(loop="right"): 2**62}
    forged = run._replace(logs=(dataclasses.replace(run.logs[0], counts=counts),))

    with pytest.raises(LogError, match=r"off\.mcap: is damaged: its index counts .*log recover"):
        gather(forged)


def foreign(path, metadata):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for name, values in metadata.items():
            writer.add_metadata(name, values)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("metadata", "error", "told"),
    [
        ({}, LogError, "has no rig in it; name a log that fitctl recorded"),
        ({"rig": {"name": "x", "json": "{"}}, ConfigError, "not JSON.*--rig"),
        ({"rig": {"name": "x", "json": '{"name": "x"}'}}, ConfigError, "--rig"),
    ],
)
def test_somebody_else_s_log_is_refused_in_one_line(metadata, error, told, tmp_path):
    with pytest.raises(error) as raised:
        find_run([foreign(tmp_path / "f.mcap", metadata)])

    assert re.search(told, str(raised.value))
    assert "\n" not in str(raised.value)
    assert "f.mcap" in str(raised.value)


def test_a_folder_without_logs_is_refused(tmp_path):
    with pytest.raises(LogError, match="holds no log"):
        find_run([tmp_path])


def test_a_file_that_is_none_is_refused():
    with pytest.raises(LogError, match="cannot be opened"):
        find_run([Path("missing.mcap")])
