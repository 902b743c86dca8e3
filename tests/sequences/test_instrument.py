"""The instrument from Python: blocking, awaited, and in a program that has an event loop already."""

import asyncio
import inspect
import math
import threading

import pytest
from instruments.simulated import SOON, failing

import fitctl
from fitctl import AsyncInstrument, Instrument
from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.messages.commands import Acquire, Recover, Reply, Standby, Status, Stop
from fitctl.sequences.methods import StepMethods
from fitctl.sequences.reading import STEPS
from fitctl.sequences.view import SequenceError

NEAR = load_rig(default_rig_path(), ["plant.loops.right.star_offset_sky_arcsec_max=5.0", SOON])


def mode(instrument):
    return instrument.telemetry().loops[0].mode


@pytest.mark.long
def test_a_script_acquires_holds_and_gets_figures():
    with Instrument(NEAR, simulate=True) as instrument:
        acquired = instrument.acquire()
        held = instrument.hold(5.0, settle_s=5.0)

        assert 0 < acquired["acquired_s"] < 30
        assert 0 < held["rms_az_px"] < held["limit_px"]
        assert mode(instrument) == "VERNIER"


@pytest.mark.long
def test_a_script_records_the_frames_for_the_spot_and_holds_the_star_again():
    with Instrument(NEAR, simulate=True) as instrument:
        instrument.acquire()
        instrument.experiment("spot")

        instrument.hold(1.0, settle_s=1.0)
        assert mode(instrument) == "VERNIER"


def test_what_is_refused_or_fails_raises_and_says_why():
    with Instrument(NEAR, simulate=True) as instrument:
        with pytest.raises(ConfigError, match=r"^hold: duration_s: must be greater than 0"):
            instrument.hold(-1.0)
        with pytest.raises(
            SequenceError, match="hold needs VERNIER; loop right is in OFF"
        ) as failed:
            instrument.hold(1.0)
        assert failed.value.attempt.outcome == "failed"
        with pytest.raises(SequenceError, match="max_offset_px is 2"):
            instrument.offset(3.0, 0.0, max_offset_px=2.0)
        assert mode(instrument) == "OFF"


@pytest.mark.parametrize(("old", "today"), [("target", "offset"), ("jog", "dither")])
def test_an_old_name_of_a_step_is_refused_with_the_new_one(old, today):
    with Instrument(NEAR, simulate=True) as instrument:
        with pytest.raises(AttributeError, match=f"the step {old} is now {today}"):
            getattr(instrument, old)
        assert not hasattr(instrument, "tagret")
        assert not hasattr(AsyncInstrument, old)


def test_words_are_commands_and_a_refusal_is_in_the_reply():
    with Instrument(NEAR, simulate=True) as instrument:
        instrument.send_and_wait("standby")
        assert mode(instrument) == "STANDBY"
        assert instrument.send("stop").accepted
        refused = instrument.send("acquire", loop="right")
        assert not refused.accepted
        assert refused.text == "acquire is not available in SAFE. Available: stop, recover, off"
        with pytest.raises(ConfigError, match=r"unknown command .halt.\. Available: stop"):
            instrument.send("halt")


def test_stop_is_safe_and_no_step_runs_after_it():
    with Instrument(NEAR, simulate=True) as instrument:
        instrument.acquire()
        instrument.stop()

        with pytest.raises(SequenceError, match="SAFE"):
            instrument.hold(1.0)
        assert mode(instrument) == "SAFE"


def test_a_command_is_followed_to_its_end_and_its_failure_raises(monkeypatch):
    with Instrument(NEAR, simulate=True) as instrument:
        instrument.send_and_wait(Standby())
        assert mode(instrument) == "STANDBY"
        instrument.send_and_wait(Stop())
        with pytest.raises(
            SequenceError, match="acquire was refused: acquire is not available in SAFE"
        ):
            instrument.send_and_wait(Acquire())
        piezo = instrument._link._simulation.devices.loops["right"].piezo
        with monkeypatch.context() as broken:
            broken.setattr(piezo, "open", failing(OSError("no such port")))
            with pytest.raises(SequenceError, match=r"loop right: recover failed: .*no such port"):
                instrument.send_and_wait(Recover())
        instrument.send_and_wait(Recover())
        with pytest.raises(SequenceError, match=r"loop right: acquire under way after 0\.1 s"):
            instrument.send_and_wait(Acquire(), timeout_s=0.1)


def file_of(folder, *steps):
    path = folder / "a.toml"
    head = 'schema_version = 1\nname = "a"\ndescription = "b"\n'
    path.write_text(f"{head}steps = [{', '.join(f'{{ {step} }}' for step in steps)}]\n")
    return path


def test_a_file_runs_from_python(tmp_path):
    file = file_of(tmp_path, 'step = "acquire"', 'step = "off"')
    with Instrument(NEAR, simulate=True) as instrument:
        acquired, off = instrument.run_sequence(file)

        assert acquired["acquired_s"] > 0
        assert off == {}
        assert mode(instrument) == "OFF"


def test_a_file_is_ended_from_another_thread_and_the_stages_are_held(tmp_path):
    file = file_of(tmp_path, 'step = "acquire"', 'step = "hold", duration_s = 2000.0')
    with Instrument(NEAR, simulate=True) as instrument:
        instrument.acquire()
        ending = threading.Timer(0.2, instrument.end_step)
        ending.start()
        with pytest.raises(SequenceError, match="stopped by its program"):
            instrument.run_sequence(file)
        ending.join()
        assert mode(instrument) == "STANDBY"


def test_stop_from_another_thread_ends_the_step_that_runs_and_has_the_last_word():
    with Instrument(NEAR, simulate=True) as instrument:
        stopping = threading.Timer(0.2, instrument.stop)
        stopping.start()
        with pytest.raises(SequenceError, match="loop right is SAFE"):
            instrument.wait(80_000.0)
        stopping.join()
        assert mode(instrument) == "SAFE"


def test_a_stop_that_is_refused_is_told(monkeypatch):
    refusal = Reply(accepted=False, text="this key may only watch")
    with Instrument(NEAR, simulate=True) as instrument:
        monkeypatch.setattr(instrument._link, "send", lambda _command: refusal)
        with pytest.raises(SequenceError, match="stop is refused: this key may only watch"):
            instrument.stop()


def test_without_a_supervisor_there_is_no_instrument(tmp_path):
    with pytest.raises(ConnectionError, match="no supervisor answers"):
        Instrument(folder=tmp_path)


def test_the_blocking_form_works_where_an_event_loop_runs():
    async def cell():
        with Instrument(NEAR, simulate=True) as instrument:
            return instrument.acquire()

    assert asyncio.run(cell())["acquired_s"] > 0


@pytest.mark.long
def test_an_awaited_step_leaves_the_event_loop_free():
    async def night():
        beats = 0

        async def beat():
            nonlocal beats
            while True:
                await asyncio.sleep(0.001)
                beats += 1

        async with AsyncInstrument(NEAR, simulate=True) as instrument:
            await instrument.acquire()
            beating = asyncio.create_task(beat())
            held = await instrument.hold(10.0)
            beating.cancel()
            assert (await instrument.send(Status())).accepted is False  # the service's, not here
        return held, beats

    held, beats = asyncio.run(night())

    assert held["frames_seen"] == 500
    assert beats > 0


def test_a_cancelled_step_is_ended_and_the_stages_are_held():
    async def night():
        async with AsyncInstrument(NEAR, simulate=True) as instrument:
            await instrument.acquire()
            holding = asyncio.create_task(instrument.hold(80_000.0))
            await asyncio.sleep(0.2)
            holding.cancel()
            with pytest.raises(asyncio.CancelledError):
                await holding
            return (await instrument.telemetry()).loops[0].mode

    assert asyncio.run(night()) == "STANDBY"


def test_a_step_that_is_cancelled_as_soon_as_it_begins_is_ended_too():
    async def night():
        async with AsyncInstrument(NEAR, simulate=True) as instrument:
            await instrument.acquire()
            holding = asyncio.create_task(instrument.hold(1000.0))
            await asyncio.sleep(0)
            holding.cancel()
            with pytest.raises(asyncio.CancelledError):
                await holding
            return (await instrument.telemetry()).time_s

    assert asyncio.run(night()) < 500.0


@pytest.mark.long
def test_a_step_that_is_cancelled_before_its_turn_leaves_the_one_that_runs_alone():
    async def night():
        async with AsyncInstrument(NEAR, simulate=True) as instrument:
            await instrument.acquire()
            holding = asyncio.create_task(instrument.hold(10.0))
            await asyncio.sleep(0)
            waiting = asyncio.create_task(instrument.wait(1000.0))
            await asyncio.sleep(0)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            return await holding, await instrument.telemetry()

    held, telemetry = asyncio.run(night())

    assert held["frames_seen"] == 500
    assert telemetry.loops[0].mode == "VERNIER"
    assert telemetry.time_s < 500.0


def test_what_the_blocking_form_can_the_awaited_one_can_too():
    blocking, awaited = (
        {n for n in dir(kind) if n[0] != "_"} for kind in (Instrument, AsyncInstrument)
    )

    assert blocking - awaited == {"close"}  # by `async with` alone


@pytest.mark.parametrize(
    "stop", [AsyncInstrument.stop, lambda instrument: instrument.send(Stop())], ids=["stop", "send"]
)
def test_stop_waits_for_no_step_and_none_runs_after_it(stop):
    async def night():
        async with AsyncInstrument(NEAR, simulate=True) as instrument, asyncio.timeout(60.0):
            running = asyncio.create_task(instrument.wait(80_000.0))
            waiting = asyncio.create_task(instrument.wait(80_000.0))
            await asyncio.sleep(0.1)
            await stop(instrument)
            for task in (running, waiting):
                with pytest.raises(SequenceError, match="loop right is SAFE"):
                    await task
            return await instrument.telemetry()

    telemetry = asyncio.run(night())

    assert telemetry.loops[0].mode == "SAFE"
    assert telemetry.time_s < 80_000.0


def test_stop_is_safe_while_as_many_threads_as_there_may_be_are_busy():
    async def night():
        busy = threading.Event()
        async with AsyncInstrument(NEAR, simulate=True) as instrument:
            for _ in range(100):
                asyncio.get_running_loop().run_in_executor(None, busy.wait, 60.0)
            await instrument.stop()
            busy.set()
            return (await instrument.telemetry()).loops[0].mode

    assert asyncio.run(night()) == "SAFE"


def test_the_step_that_runs_is_ended_and_the_next_one_goes_on():
    async def night():
        async with AsyncInstrument(NEAR, simulate=True) as instrument, asyncio.timeout(60.0):
            running = asyncio.create_task(instrument.wait(80_000.0))
            standing_by = asyncio.create_task(instrument.standby())
            await asyncio.sleep(0)  # asked for, and perhaps not yet begun
            instrument.end_step()
            with pytest.raises(SequenceError, match="stopped by its program"):
                await running
            await standing_by
            instrument.end_step()  # none runs: nothing to end
            await instrument.wait(1.0)
            return instrument.attempts

    (waited,) = asyncio.run(night())

    assert (waited.step, waited.outcome) == ("wait", "done")


def test_a_file_is_awaited_and_what_it_measured_is_written(tmp_path):
    file = file_of(tmp_path, 'step = "standby"', 'step = "dark", frames = 10')

    async def night():
        async with AsyncInstrument(simulate=True, seed=1) as instrument:
            figures = await instrument.run_sequence(file)
            return figures, instrument.attempts, await instrument.write_calibrations(tmp_path)

    (nothing, dark), attempts, fragments = asyncio.run(night())

    assert nothing == {}
    assert dark["bias_dn"] == pytest.approx(1000.0, abs=1.0)
    assert [(a.sequence_name, a.step, a.outcome) for a in attempts] == [
        ("a", "standby", "done"),
        ("a", "dark", "done"),
    ]
    assert fragments == [tmp_path / "fit-mock-dark.toml"]
    assert (tmp_path / "fit-mock-dark.npy").exists()


def test_a_file_that_is_cancelled_is_ended(tmp_path):
    file = file_of(tmp_path, 'step = "standby"', 'step = "wait", duration_s = 80000.0')

    async def night():
        async with AsyncInstrument(NEAR, simulate=True) as instrument, asyncio.timeout(60.0):
            running = asyncio.create_task(instrument.run_sequence(file))
            await asyncio.sleep(0.1)
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running
            return instrument.attempts[-1], await instrument.telemetry()

    attempt, telemetry = asyncio.run(night())

    assert attempt.outcome == "stopped"
    assert telemetry.time_s < 80_000.0


@pytest.mark.parametrize("name", STEPS)
def test_every_step_is_a_method_with_its_keys_and_defaults(name):
    fields = {key: field for key, field in STEPS[name].model_fields.items() if key != "step"}
    method = getattr(StepMethods, name)
    parameters = dict(inspect.signature(method).parameters)
    del parameters["self"]

    assert set(parameters) == set(fields)
    for key, parameter in parameters.items():
        required = parameter.default is inspect.Parameter.empty
        assert required == fields[key].is_required()
        assert required or parameter.default == fields[key].default


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("hold", ["duration_s"]),
        ("stars", ["stars"]),
        ("offset", ["offset_az_px", "offset_el_px"]),
        ("dither", ["dither_px"]),
        ("raster", ["columns", "rows", "spacing_px"]),
        ("controller", ["name"]),
        ("experiment", ["what"]),
        ("chirp", ["channel"]),
        ("dark", ["frames"]),
        ("wait", ["duration_s"]),
    ],
)
def test_what_a_step_is_about_may_be_given_without_its_name(name, keys):
    parameters = list(inspect.signature(getattr(StepMethods, name)).parameters.values())

    assert [parameter.name for parameter in parameters[1 : len(keys) + 1]] == keys
    assert all(
        parameter.kind == parameter.POSITIONAL_OR_KEYWORD
        for parameter in parameters[1 : len(keys) + 1]
    )


@pytest.mark.parametrize("values", [(5.0, 5.0, 0.1, 1.0), (5.0,)], ids=["too many", "twice"])
def test_a_key_is_given_once_by_name_or_in_its_order(values):
    with Instrument(NEAR, simulate=True) as instrument:
        with pytest.raises(TypeError, match="in the order duration_s, settle_s, rms_limit_px"):
            instrument.hold(*values, duration_s=5.0)
        with pytest.raises(ConfigError, match="hold: duratoin_s: unknown key; did you mean"):
            instrument.hold(duratoin_s=5.0)
        with pytest.raises(ConfigError, match="hold: duration_s: is missing"):
            instrument.hold()


def test_a_figure_that_could_not_be_had_is_not_a_number(monkeypatch, tmp_path):
    from fitctl.sequences.behaviours import plain
    from fitctl.sequences.behaviours.behaviour import Result

    never = plain.PLAIN["wait"]._replace(done=lambda _step, _view: Result({"a_s": math.nan}, ""))
    monkeypatch.setitem(fitctl.sequences.runner.BEHAVIOURS, "wait", never)
    with Instrument(NEAR, simulate=True) as instrument:
        assert math.isnan(instrument.wait(1.0)["a_s"])
        (waited,) = instrument.run_sequence(file_of(tmp_path, 'step = "wait", duration_s = 1.0'))
        assert math.isnan(waited["a_s"])


def test_fitctl_has_only_what_it_has():
    with pytest.raises(AttributeError, match="Instruments"):
        _ = fitctl.Instruments
