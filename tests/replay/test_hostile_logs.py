"""No text of a log becomes a path: a log comes from whoever wrote it."""

import json
import math
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from samples.forged_logs import forged_of
from samples.learner_reports import report
from samples.log_samples import RUN_INFO, filled, frame, tick, write_log
from samples.replay_courses import hold_a_star

from fitctl.cli import main
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.document import design_json
from fitctl.drivers.interface import DeviceError, DeviceTimeout
from fitctl.logging import schemas
from fitctl.logging.errors import LogError
from fitctl.logging.exporting import export
from fitctl.logging.reading import log_info
from fitctl.logging.records import (
    ControllerChange,
    DevicesOpened,
    Event,
    LoopTiming,
    ModeChange,
    OutputsFound,
    Tick,
)
from fitctl.logging.schemas import MESSAGES
from fitctl.messages.command_table import command_record
from fitctl.messages.commands import Reply, SetController
from fitctl.messages.modes import Mode
from fitctl.replay.devices import logged_error
from fitctl.replay.log import Logged, LoggedStep, read_steps
from fitctl.replay.replay import Replay
from tests.samples.logged_simulation import LoggedSimulation

PLANTED = "planted-by-the-log"


@pytest.fixture(scope="module")
def opened_paths():
    """Every path that this process opens, lists or makes, from now on."""
    paths, on = [], [True]

    def audit(event, arguments):
        if on[0] and event in {"open", "os.mkdir", "os.listdir", "os.scandir", "os.rename"}:
            paths.append(str(arguments[0]))

    sys.addaudithook(audit)  # cannot be removed again
    yield paths
    on[0] = False


def log_of(path, course, change_rig=lambda document: None, change=lambda record: record, **run):
    """A log of a run, whose description of itself is changed afterwards."""

    class Changed(LoggedSimulation):
        def go_on_in(self, path, rig=None):
            document = json.loads(self.info.rig_json)
            change_rig(document)
            self.info = msgspec.structs.replace(self.info, rig_json=json.dumps(document), **run)
            super().go_on_in(path, rig)

    simulation = Changed(load_rig(default_rig_path()), path, change)
    course(simulation)
    simulation.writer.close()
    return path


def replay_and_report(log, folder, monkeypatch):
    monkeypatch.chdir(folder)
    ends = []
    for arguments in (["replay", str(log)], ["report", str(log), "--out", str(folder / "out")]):
        with pytest.raises(SystemExit) as end:
            main(arguments)
        ends.append(end.value.code)
    return ends


def test_a_loop_s_name_in_the_designs_is_no_path_to_write_to(tmp_path, monkeypatch):
    victim = tmp_path / "victim" / "notebook.json"
    victim.parent.mkdir()
    victim.write_text("mine")
    name = str(victim.with_suffix(""))

    def change(document):
        document["loops"][name] = {"vernier": {"controller": "any.json"}}

    log = log_of(tmp_path / "run.mcap", lambda _: None, change, designs={name: "OWNED"})
    replay_and_report(log, tmp_path, monkeypatch)

    assert victim.read_text() == "mine"


@pytest.mark.long
@pytest.mark.parametrize("text", ["[", "[1]", '{"name": "\\u001b[31m", "parameters": 7}'])
def test_designs_that_are_none_end_in_no_traceback(tmp_path, monkeypatch, capsys, text):
    log = log_of(tmp_path / "run.mcap", hold_a_star, designs={"right": text, "odd\n": text})
    monkeypatch.chdir(tmp_path)
    for arguments in (["report"], ["replay", "--set", "loops.right.coarse.gain_rad_per_m=1.0"]):
        with pytest.raises(SystemExit) as end:
            main([arguments[0], str(log), *arguments[1:]])
        assert end.value.code in {0, 1, None}, capsys.readouterr().err
    printed = capsys.readouterr().out
    assert "begins with controller eq20, in the log with " in printed
    assert "\x1b" not in printed


@pytest.mark.long
def test_no_file_that_a_log_names_is_opened(tmp_path, monkeypatch, opened_paths):
    folder = tmp_path / PLANTED
    folder.mkdir()
    np.save(folder / "dark.npy", np.full((40, 40), 1000.0))
    text = design_json(design_for(load_rig(default_rig_path()), "right"))
    (folder / "design.json").write_text(text)

    def change(document):
        document["camera"]["dark_file"] = str(folder / "dark.npy")
        document["loops"]["right"]["vernier"]["controller"] = str(folder / "design.json")
        for table, key in (
            ("logging", "folder"),
            ("service", "folder"),
            ("service", "keys_folder"),
        ):
            document[table][key] = str(folder / key)

    def course(simulation):
        hold_a_star(simulation)
        to = folder / "design.json"
        for text in ("{", json.dumps({"name": str(to), "learnt": True}), "[1]"):
            simulation.log(
                ControllerChange(
                    time_s=1.0,
                    loop="right",
                    source="eq20",
                    target=str(to),
                    siderostat_az_rad=0.0,
                    siderostat_el_rad=0.0,
                    design_json=text,
                )
            )

    log = log_of(tmp_path / "run.mcap", course, change)
    del opened_paths[:]
    replay_and_report(log, tmp_path, monkeypatch)

    assert [path for path in opened_paths if PLANTED in path] == []


@pytest.mark.parametrize("name", ["planted.py", "planted.json"])
def test_no_report_of_a_learner_names_a_design_to_run(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text("open('ran', 'w')")
    replay = Replay(load_rig(default_rig_path()))
    commands = (report(design_json=name), SetController(name="learnt", loop="right"))
    steps = [command_record(one, Reply(accepted=True), "anna", "here", 1.0) for one in commands]
    change = ControllerChange(
        time_s=1.0,
        loop="right",
        source="eq20",
        target=name,
        siderostat_az_rad=0.0,
        siderostat_el_rad=0.0,
        design_json="",
    )
    for records in (steps, [change]):
        step = LoggedStep()
        step.begin = [
            Logged(type(one), MESSAGES[type(one)](**msgspec.structs.asdict(one))) for one in records
        ]
        replay.play(step)

    assert not (tmp_path / "ran").exists()
    assert "the parameters of a design" in replay.result.refused[0]


def test_a_topic_is_no_path_to_export_to(tmp_path, monkeypatch):
    topics = {**schemas.TOPICS, Event: "/../\x1b]0;x\x07\n/planted"}
    with monkeypatch.context() as patched:
        patched.setattr(schemas, "TOPICS", topics)
        event = Event(time_s=1.0, severity="info", source="right", message="hello")
        log = log_of(tmp_path / "run.mcap", lambda simulation: simulation.log(event))
    topic = next(topic for topic in log_info(log).counts if "planted" in topic)

    (file,) = export(log, tmp_path / "out", "csv", [topic])

    assert file.parent == tmp_path / "out"
    assert file.name.isprintable()
    assert Path(file).exists()


def test_a_record_of_another_loop_than_its_topic_s_is_refused(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(schemas, "TOPICS", {**schemas.TOPICS, Tick: "/fit/right/tick"})
        path = write_log(tmp_path / "a.mcap", [RUN_INFO, tick(1, loop="other"), frame(1)])

    refusal = r"a\.mcap: /fit/right/tick is not as fitctl records it: .*'other'; expected 'right'"
    with pytest.raises(LogError, match=refusal):
        list(read_steps(log_info(path), load_rig(default_rig_path())))


@pytest.mark.parametrize("value", [math.inf, -1e15, 1e308])
@pytest.mark.parametrize("name", ["mid_exposure_s", "compute_s"])
def test_numbers_that_no_instrument_has_are_refused(tmp_path, name, value):
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, tick(1, **{name: value}), frame(1)])

    refusal = rf"a\.mcap: /fit/right/tick is not as fitctl records it: {name} is "
    with pytest.raises(LogError, match=refusal):
        list(read_steps(log_info(path), load_rig(default_rig_path())))


@pytest.mark.parametrize("name", ["mid_exposure_s", "time_s"])
def test_a_frame_s_time_that_is_not_a_number_is_refused(tmp_path, name):
    path = forged_of(
        [RUN_INFO, tick(1), frame(1)], tmp_path / "a.mcap", "/fit/right/tick", **{name: math.nan}
    )

    refusal = rf"a\.mcap: /fit/right/tick is not as fitctl records it: {name} is nan"
    with pytest.raises(LogError, match=refusal):
        list(read_steps(log_info(path), load_rig(default_rig_path())))


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e15])
def test_outputs_that_no_d_a_has_are_refused(tmp_path, value):
    opened = filled(DevicesOpened, loop="right", error="", stack2_v=value)
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, opened, tick(1), frame(1)])

    with pytest.raises(LogError, match=r"a\.mcap: .* is not as fitctl records it: stack2_v is "):
        list(read_steps(log_info(path), load_rig(default_rig_path())))


@pytest.mark.parametrize(
    ("record", "name"),
    [
        (tick(1), "fsm_az_rad"),
        (tick(1), "star_el_px"),
        (tick(1), "stack3_v"),
        (filled(ModeChange, loop="right"), "siderostat_az_rad"),
        (filled(OutputsFound, loop="right"), "stack1_v"),
    ],
)
def test_numbers_that_no_device_has_are_refused(tmp_path, record, name):
    wrong = msgspec.structs.replace(record, **{name: 1e300})
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, wrong, tick(2), frame(2)])

    with pytest.raises(
        LogError, match=rf"a\.mcap: .* is not as fitctl records it: {name} is 1e\+300"
    ):
        list(read_steps(log_info(path), load_rig(default_rig_path())))


@pytest.mark.parametrize("name", ["siderostat_az_rad", "siderostat_el_rad"])
def test_motors_that_are_nowhere_while_the_loop_is_not_off_are_refused(tmp_path, name):
    opened = filled(DevicesOpened, loop="right", error="")
    standby = {"mode": "STANDBY", "mode_number": int(Mode.STANDBY)}
    path = write_log(
        tmp_path / "a.mcap", [RUN_INFO, opened, tick(1, **standby, **{name: math.nan}), frame(1)]
    )

    with pytest.raises(LogError, match=rf"a\.mcap: .* is not as fitctl records it: {name} is nan"):
        list(read_steps(log_info(path), load_rig(default_rig_path())))


def test_more_periods_of_a_servo_than_a_second_has_are_refused(tmp_path):
    timing = filled(LoopTiming, loop="right", servo_periods=2**31 - 1)
    path = write_log(tmp_path / "a.mcap", [RUN_INFO, timing, tick(1), frame(1)])

    with pytest.raises(
        LogError, match=r"a\.mcap: .* is not as fitctl records it: servo_periods is 2"
    ):
        list(read_steps(log_info(path), load_rig(default_rig_path())))


def test_a_frame_whose_data_are_not_its_size_counts_for_none():
    step = LoggedStep()
    for data in (b"12", bytes(12)):
        step.add_frame(RawImage(width=3, height=2, step=len(data) // 2, data=data), 1)
    assert [len(each.data) for each in step.older] == [12]


@pytest.mark.parametrize("kind", ["Frame", "np", "Callable", "__doc__", "none"])
def test_the_name_of_an_error_makes_no_other_object(kind):
    assert type(logged_error(kind, "text")) is DeviceError
    assert type(logged_error("DeviceTimeout", "text")) is DeviceTimeout
