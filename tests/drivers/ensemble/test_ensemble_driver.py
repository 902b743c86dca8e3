"""The Ensemble driver against controllers that differ from the mock, and on its other wires."""

import contextlib
import select
import threading
import time

import pytest
from commissioning.motor_bench import site_of
from scripted_server import scripted_server

from fitctl import config
from fitctl.clock import MonotonicClock
from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.steps import motors
from fitctl.commissioning.steps.motors import powered
from fitctl.drivers.ensemble.driver import EnsembleAmplifiers, probe_ensemble
from fitctl.drivers.ensemble.link import EnsembleLink
from fitctl.drivers.ensemble.protocol import Reply
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceMismatch,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)

STILL = (0.0, 0.0)
MOCK = "mocks.loops.right.ensemble"
WELL = {
    "NONE": "!\n",
    "GETPARM(@0, 2)": "%1000.000000\n",
    "GETPARM(@1, 2)": "%-2000.000000\n",
    "GETPARM(@0, 37)": "%-10.0\n",
    "GETPARM(@1, 37)": "%-10.0\n",
    "GETPARM(@0, 38)": "%10.0\n",
    "GETPARM(@1, 38)": "%10.0\n",
    **{
        f"GETPARM(@{axis}, {mask})": f"%{bits}.0\n"
        for axis in (0, 1)
        for mask, bits in ((26, 0x30), (27, 0x10), (28, 0x20))
    },
    "AXISSTATUS(@0)": "%3\n",
    "AXISSTATUS(@1)": "%3\n",
    "AXISFAULT(@0)": "%0\n",
    "AXISFAULT(@1)": "%0\n",
    "PFBKPROG(@0)": "%1.5\n",
    "PFBKPROG(@1)": "%0.25\n",
}


class Script:
    """A controller that answers by a table; a command that is not in it is acknowledged."""

    def __init__(self, answers):
        self.answers = WELL | answers
        self.heard = []
        self.left = threading.Event()

    def talk(self, client):
        try:
            with client.makefile("rb") as lines:
                for line in lines:
                    command = line.decode().strip()
                    self.heard.append(command)
                    client.sendall(self.answers.get(command, "%\n").encode())
        finally:
            self.left.set()


@pytest.fixture
def settings():
    rig = config.load_rig(config.default_rig_path().parent / "ensemble.toml")
    return rig.loops["right"].siderostat


@pytest.fixture
def scripted(settings, bench_of):
    """Makes a driver and the scripted controller that it speaks to."""
    with contextlib.ExitStack() as stack:

        def make(**update):
            script = Script(update.pop("answers", {}))
            port = f"socket://127.0.0.1:{stack.enter_context(scripted_server(script.talk))}"
            device = settings.device.model_copy(
                update={"port": port, "response_timeout_s": 0.2} | update
            )
            driver = EnsembleAmplifiers(settings.model_copy(update={"device": device}))
            stack.callback(driver.close)
            return driver, script

        yield make


def test_the_wire_when_it_is_opened(scripted):
    driver, script = scripted()
    driver.open()
    # 6000 rad/s2 of a motor with 4000 counts a revolution; a unit is 1000 counts, and -2000 of them.
    assert script.heard == [
        "NONE",
        "GETPARM(@0, 2)",
        "GETPARM(@0, 37)",
        "GETPARM(@0, 38)",
        "ABORT @0",
        "DISABLE @0",
        "RAMP MODE @0 RATE",
        "RAMP RATE @0 3819.71863",
        "AXISSTATUS(@0)",
        "AXISFAULT(@0)",
        "GETPARM(@0, 26)",
        "GETPARM(@0, 27)",
        "GETPARM(@0, 28)",
        "GETPARM(@1, 2)",
        "GETPARM(@1, 37)",
        "GETPARM(@1, 38)",
        "ABORT @1",
        "DISABLE @1",
        "RAMP MODE @1 RATE",
        "RAMP RATE @1 1909.859317",
        "AXISSTATUS(@1)",
        "AXISFAULT(@1)",
        "GETPARM(@1, 26)",
        "GETPARM(@1, 27)",
        "GETPARM(@1, 28)",
        "WAIT MODE NOWAIT",
    ]


def test_a_period_on_the_wire(scripted):
    driver, script = scripted()
    driver.open()
    del script.heard[:]
    reading = driver.exchange((1.0, 1.0))
    driver.exchange((1.0, 2.0))
    assert script.heard == [
        "FREERUN @0 0.63662",
        "FREERUN @1 -0.318310",  # a negative scale turns the sense
        "PFBKPROG(@0)",
        "PFBKPROG(@1)",
        "AXISSTATUS(@0)",
        "FREERUN @1 -0.636620",  # the other one is as it was
        "PFBKPROG(@0)",
        "PFBKPROG(@1)",
        "AXISFAULT(@0)",
    ]
    assert reading.position_rad == pytest.approx((2.356194, -0.785398), abs=1e-6)
    assert reading.enabled
    assert reading.fault == ""


def test_velocities_are_held_within_the_motors_limit(scripted, settings):
    driver, script = scripted()
    driver.open()
    del script.heard[:]
    driver.exchange((1e9, -1e9))
    most = settings.velocity_limit_rad_s * 4000 / 6.283185307 / 1000
    assert float(script.heard[0].split()[-1]) == pytest.approx(most, rel=1e-5)


def test_other_axes_of_a_larger_controller(scripted):
    answers = {
        command.replace("@1", "@4").replace("@0", "@3"): answer for command, answer in WELL.items()
    }
    driver, script = scripted(answers=answers, axes=[3, 4])
    assert "@3 and @4" in driver.open().model
    assert not any("@0" in heard or "@1" in heard for heard in script.heard)


@pytest.mark.parametrize(
    "style",
    [
        {"ABORT @0": "%", "DISABLE @0": "%", "WAIT MODE NOWAIT": "%"},  # no newline
        {"PFBKPROG(@0)": "%\n%1.5\n"},  # a bare acknowledgement first
        {"PFBKPROG(@0)": "% 1.5 \r\n"},
        {"AXISSTATUS(@0)": "%4294967295\n"},
    ],
)
def test_what_controllers_differ_in_is_taken(scripted, style):
    driver, _ = scripted(answers=style)
    driver.open()
    assert driver.exchange(STILL).position_rad[0] == pytest.approx(2.356194, abs=1e-6)


@pytest.mark.parametrize(
    ("answers", "error", "said"),
    [
        ({"NONE": ""}, DeviceTimeout, "NONE within 0.2 s"),
        ({"GETPARM(@1, 2)": "!\n"}, DeviceRefused, r"GETPARM\(@1, 2\) .* not understood"),
        ({"GETPARM(@0, 2)": "%0.0\n"}, DeviceMismatch, "azimuth: .*CountsPerUnit"),
        ({"GETPARM(@1, 38)": "%-10.0\n"}, DeviceMismatch, "elevation: software limits"),
        ({"AXISSTATUS(@1)": "%1\n"}, DeviceMismatch, "elevation: .* that act, got not homed"),
        ({"GETPARM(@0, 26)": "%16.0\n"}, DeviceMismatch, "azimuth: .*got FaultMask 0x10 without"),
        ({"GETPARM(@0, 27)": "%0.0\n"}, DeviceMismatch, "FaultMaskDecel and FaultMaskDisable 0x20"),
        ({"GETPARM(@0, 28)": "!\n"}, DeviceRefused, r"GETPARM\(@0, 28\) .* not understood"),
        ({"GETPARM(@0, 2)": "%nan\n"}, DeviceProtocolError, "a number"),
        ({"GETPARM(@0, 2)": "?\n"}, DeviceProtocolError, "one of"),
        ({"GETPARM(@0, 2)": "%" + "1" * 2000}, DeviceProtocolError, "without an end"),
        ({"RAMP MODE @1 RATE": "#\n"}, DeviceRefused, "RAMP MODE @1 RATE .* fault"),
        ({"WAIT MODE NOWAIT": "$\n"}, DeviceRefused, "timeout"),
    ],
)
def test_what_is_wrong_at_open_is_said(scripted, answers, error, said):
    driver, _ = scripted(answers=answers)
    with pytest.raises(error, match=said):
        driver.open()
    with pytest.raises(DeviceUnreachable, match="open"):
        driver.exchange(STILL)


def test_limits_that_someone_has_verified_need_neither_homing_nor_masks(scripted):
    unhomed = {"AXISSTATUS(@0)": "%1\n", "AXISSTATUS(@1)": "%1\n", "GETPARM(@0, 26)": "!\n"}
    driver, _ = scripted(answers=unhomed, software_limits_verified=True)
    driver.open()
    assert driver.exchange(STILL).fault == ""


def test_an_axis_that_is_homed_no_longer_is_a_fault(scripted):
    driver, script = scripted()
    driver.open()
    script.answers["AXISSTATUS(@1)"] = "%1\n"
    readings = [driver.exchange(STILL) for _ in range(4)]
    assert readings[-1].fault == "elevation: not homed"


def test_an_answer_that_nobody_asked_for_is_an_error(scripted):
    driver, script = scripted()
    driver.open()
    script.answers["PFBKPROG(@1)"] = "%0.25\n%0.25\n"
    with pytest.raises(DeviceProtocolError, match=r"nothing before .*, got b'%'"):
        driver.exchange(STILL)


def test_after_an_answer_that_did_not_come_nothing_is_asked_before_it_is_opened_anew(scripted):
    driver, script = scripted()
    driver.open()
    answer = script.answers.pop("PFBKPROG(@0)")
    script.answers["PFBKPROG(@0)"] = ""
    with pytest.raises(DeviceTimeout):
        driver.exchange(STILL)
    script.answers["PFBKPROG(@0)"] = answer
    with pytest.raises(DeviceUnreachable):
        driver.exchange(STILL)
    driver.open()
    driver.exchange(STILL)


@pytest.mark.parametrize("answer", ["?!\n", ""], ids=["nonsense", "silence"])
def test_before_it_is_given_up_the_controller_is_told_to_stop_both_axes(scripted, answer):
    driver, script = scripted()
    driver.open()
    driver.enable()
    driver.exchange((0.5, 0.0))
    script.answers["PFBKPROG(@0)"] = answer
    with pytest.raises(DeviceError):
        driver.exchange((0.5, 0.0))

    assert script.left.wait(5.0)
    assert script.heard[-3:] == ["PFBKPROG(@0)", "ABORT @0", "ABORT @1"]


def rested(driver):
    """Open and at rest for so long that the motors have lost all speed."""
    driver.open()
    driver.exchange(STILL)
    time.sleep(0.3)
    driver.exchange(STILL)


@pytest.mark.parametrize("false", ["%2.25\n", "%0.85\n", "%-8.25\n", "%1e300\n"])
def test_a_false_angle_is_dropped_and_the_next_one_counts(scripted, false):
    """0.85 and 2.25 are within what the velocity limit allows in 0.3 s, but not for a motor at rest."""
    driver, script = scripted()
    rested(driver)
    time.sleep(0.3)
    script.answers["PFBKPROG(@1)"] = false
    assert driver.exchange(STILL) is None
    script.answers["PFBKPROG(@1)"] = "%0.2505\n"
    reading = driver.exchange(STILL)
    assert reading.position_rad == pytest.approx((2.356194, -0.786969), abs=1e-6)


def test_a_false_angle_that_comes_again_is_a_fault(scripted):
    driver, script = scripted()
    rested(driver)
    script.answers["PFBKPROG(@1)"] = "%2.25\n"
    assert driver.exchange(STILL) is None
    with pytest.raises(
        DeviceFault, match=r"azimuth moved by 0.000 rad, elevation moved by -6.283 rad"
    ):
        driver.exchange(STILL)
    driver.open()
    assert driver.exchange(STILL).position_rad[1] == pytest.approx(-7.068583)


def test_a_motor_may_have_turned_as_fast_as_it_was_commanded(scripted):
    driver, script = scripted()
    rested(driver)
    driver.exchange((0.0, 20.0))
    time.sleep(0.1)
    script.answers["PFBKPROG(@1)"] = "%-0.38\n"  # 2 rad in 0.1 s
    assert driver.exchange(STILL) is not None


def test_an_axis_without_power_may_be_turned_by_hand(scripted):
    driver, script = scripted()
    rested(driver)
    script.answers |= {"AXISSTATUS(@0)": "%2\n", "AXISSTATUS(@1)": "%2\n"}
    driver.disable()
    time.sleep(0.1)
    script.answers["PFBKPROG(@1)"] = "%-0.38\n"
    assert driver.exchange(STILL) is not None


def test_a_refused_run_of_an_axis_without_fault_is_an_error(scripted):
    driver, script = scripted()
    driver.open()
    script.answers["FREERUN @0 0.63662"] = "!\n"
    with pytest.raises(DeviceRefused, match=r"FREERUN @0 0\.63662"):
        driver.exchange((1.0, 0.0))


def test_an_axis_that_does_not_come_up_is_an_error_and_both_are_disabled(scripted):
    driver, script = scripted()
    driver.open()
    script.answers["AXISSTATUS(@1)"] = "%0\n"
    del script.heard[:]
    with pytest.raises(DeviceError):
        driver.enable()
    assert script.heard.index("ENABLE @1") < script.heard.index("DISABLE @0")
    assert "DISABLE @1" in script.heard


def test_an_axis_that_keeps_its_power_fails_the_step_of_a_commissioning(scripted, monkeypatch):
    driver, _ = scripted()  # both axes report that they are enabled, whatever they are commanded
    monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: driver)
    ends = "azimuth disabled, got not within 0.2 s; .* a motor may still have power"
    with pytest.raises(StepError, match=ends), powered(site_of(clock=MonotonicClock())):
        pass


def test_asked_only_what_is_no_status_word_is_an_error_too(scripted, settings):
    driver, _ = scripted(answers={"AXISFAULT(@1)": "%1.5\n"})
    with pytest.raises(DeviceProtocolError, match=r"a number in answer to AXISFAULT\(@1\)"):
        probe_ensemble(settings.model_copy(update={"device": driver._device}))


# ---------------------------------------------------------------- with the mock


def test_over_its_serial_port_it_is_the_same(bench_of):
    bench = bench_of("ensemble")
    port = bench.endpoints["mocks.loops.right.ensemble_pty"]
    device = bench.siderostat.device.model_copy(update={"port": port})
    driver = EnsembleAmplifiers(bench.siderostat.model_copy(update={"device": device}))
    driver.open()
    driver.enable()
    while driver.exchange((5.0, 0.0)).position_rad[0] < 0.2:
        pass
    driver.close()
    assert bench.motors.enabled == [False, False]


def test_without_newlines_behind_acknowledgements_it_is_the_same(bench_of):
    bench = bench_of("ensemble", f"{MOCK}.always_send_eos=false")
    bench.driver.open()
    bench.driver.enable()
    while bench.driver.exchange((5.0, 0.0)).position_rad[0] < 0.2:
        pass


def test_polling_keeps_the_connection_and_silence_loses_it(bench_of):
    bench = bench_of("ensemble", f"{MOCK}.idle_timeout_s=0.3")
    bench.driver.open()
    end_s = time.monotonic() + 0.5
    while time.monotonic() < end_s:
        bench.driver.exchange(STILL)
    time.sleep(0.6)
    with pytest.raises(DeviceUnreachable, match="timeout of the controller's socket"):
        bench.driver.exchange(STILL)


def test_a_following_error_is_a_fault_by_name(bench_of):
    bench = bench_of("ensemble")
    bench.driver.open()
    bench.driver.enable()
    bench.fault("following_error", "az")
    for _ in range(8):
        reading = bench.driver.exchange(STILL)
    assert reading.fault == "azimuth: position error"
    assert not reading.enabled


def test_a_stuck_axis_becomes_the_controllers_position_error(bench_of):
    bench = bench_of("ensemble")
    bench.driver.open()
    bench.driver.enable()
    bench.fault("stuck_axis", "el")
    end_s = time.monotonic() + 5
    while not (reading := bench.driver.exchange((0.0, 5.0))).fault:
        assert time.monotonic() < end_s
    assert reading.fault == "elevation: position error"


@pytest.mark.parametrize(("outward", "name"), [(1, "cw"), (-1, "ccw")], ids=["high", "low"])
def test_the_software_limit_ends_a_run_with_a_fault_and_leads_back(bench_of, outward, name):
    bench = bench_of("ensemble")  # two revolutions
    bench.driver.open()
    bench.driver.enable()
    end_s = time.monotonic() + 5
    while not (reading := bench.driver.exchange((30.0 * outward, 0.0))).fault:
        assert time.monotonic() < end_s
    faults = reading.fault.removeprefix("azimuth: ").split(", ")
    assert faults[-1] == f"{name} software limit"
    # The computer may have stood still: see the mock's limitations.
    assert faults[:-1] in ([], ["position error"])
    bench.driver.reset_fault()
    bench.driver.enable()
    while bench.driver.exchange((-10.0 * outward, 0.0)).position_rad[0] * outward > 11.0:
        assert time.monotonic() < end_s


def test_a_controller_that_is_not_homed_is_refused_until_it_is(bench_of):
    bench = bench_of("ensemble", f"{MOCK}.homed=false")
    with pytest.raises(DeviceMismatch, match="not homed"):
        bench.driver.open()
    assert [text.split(":")[0] for text in probe_ensemble(bench.siderostat).disagreements] == [
        "axis @0 has software limits that may not act (not homed)",
        "axis @1 has software limits that may not act (not homed)",
    ]
    with contextlib.closing(EnsembleLink(bench.siderostat.device)) as link:
        for command in ("ENABLE @0 @1", "IGLOBAL(32) = 2", 'PROGRAM RUN 5, "HomeAsync.bcx"'):
            assert link.command(command) is Reply.DONE
        time.sleep(0.1)
    bench.driver.open()


def test_asked_only_it_tells_what_disagrees_and_stays_as_it_is(bench_of):
    bench = bench_of("ensemble", f"{MOCK}.software_limit_units=0.0")
    bench.fault("amplifier_fault", "el")
    time.sleep(0.05)
    probe = probe_ensemble(bench.siderostat)
    assert probe.identity.maker == "Aerotech"
    assert 0 < probe.round_trip_s < 1
    assert [text.split(":")[0] for text in probe.disagreements] == [
        "axis @0 has no software limits",
        "axis @1 has no software limits",
        "axis @1 is in fault (amplifier)",
    ]


def test_an_interrupt_between_a_command_and_its_answer_takes_the_power_of_both_axes(
    bench_of, monkeypatch
):
    bench = bench_of("ensemble")
    monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: bench.driver)
    answered = EnsembleLink._reply

    def interrupted(line, _text, _deadline_s):
        monkeypatch.setattr(EnsembleLink, "_reply", answered)
        assert select.select([line._port], [], [], 5.0)[0], "no answer came"
        raise KeyboardInterrupt

    def step():
        with powered(site_of(clock=MonotonicClock())) as held:
            held.exchange((5.0, 0.0))
            assert bench.motors.enabled == [True, True]
            monkeypatch.setattr(EnsembleLink, "_reply", interrupted)
            held.exchange((5.0, 0.0))

    with pytest.raises(KeyboardInterrupt):
        step()
    assert bench.motors.enabled == [False, False]
