"""The step `off`: it is done when the devices are closed, and fails if they did not close."""

from instruments.simulated import SlowExecutor, failing

from fitctl.drivers.interface import DeviceTimeout

STANDBY = {"step": "standby"}
WAIT = {"step": "wait", "duration_s": 2.0}
SILENT = DeviceTimeout("D/A", "usb0", "an answer in 1 s", "none", "is it on?")


def test_off_fails_in_each_attempt_if_a_device_did_not_close(tried):
    run = tried()
    run.link._simulation.devices.loops["right"].dac.close = failing(SILENT)

    run(STANDBY, {"step": "off", "attempts": 2})

    assert run.outcomes() == ["done", "failed", "failed"]
    assert "off failed: right D/A did not close well" in run.error
    assert run.link.mode() == "OFF"


def test_off_is_done_when_the_devices_are_closed_so_that_a_standby_may_follow(tried):
    run, slow = tried(), SlowExecutor()
    jobs = run.link._simulation.supervisor._device_jobs
    quick = jobs._executor

    def slow_down(_link):
        jobs._executor = slow

    def finish(_link):
        slow.finish()
        jobs._executor = quick

    run.link.meddling = [(1.0, slow_down), (6.0, finish)]

    run(STANDBY, WAIT, {"step": "off"}, STANDBY)

    assert run.outcomes() == ["done"] * 4
    assert 6.0 < run.attempts[2].ended_s < 6.5
