"""An instrument that holds its star, and a way to strike each interlock of the shipped rig file."""

from functools import partial

import numpy as np
from instruments.simulated import SOON

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceFault, DeviceTimeout
from fitctl.logging.records import Event, RecorderStatus
from fitctl.messages.commands import Stop
from fitctl.messages.modes import Mode
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.simulation.simulation import Simulation

ROWS = load_rig(default_rig_path()).interlocks
TRIPS_WITHIN_S = 20.0
RESETS_WITHIN_S = 12.0


class Bench:
    """An instrument that holds its star, and ways to strike it; :meth:`heal` takes them all back."""

    def __init__(self, *overrides, rig=None):
        self.records, self.buffer = [], TelemetryBuffer()
        rig = rig or load_rig(default_rig_path(), [SOON, *overrides])
        self.simulation = Simulation(rig, 0, star_offset_px=(10.0, -6.0), record=self.take)
        self.supervisor, self.clock = self.simulation.supervisor, self.simulation.clock
        self.loop = self.supervisor.loops["right"]
        self.devices = self.simulation.devices.loops["right"]
        self.camera = self.simulation.devices.camera
        self.each_step = lambda: None
        self._healing = []
        self.simulation.acquire()
        assert self.until(lambda: self.loop.mode is Mode.VERNIER, 20.0)

    def telemetry(self):
        """What consoles hear now; the recorder is well."""
        now_s = self.clock.now_s()
        self.buffer.recorder = RecorderStatus(
            time_s=now_s, path="", records=1, lost=0, bytes_written=1
        )
        state = ServiceState(
            pid=1,
            wall_minus_monotonic_s=0.0,
            scheduling="",
            records_lost=lambda: 0,
            records_offered=lambda: 0,
        )
        return self.buffer.telemetry(self.supervisor, state, now_s)

    def take(self, record):
        self.buffer.add(record)
        if isinstance(record, Event):
            self.records.append(record)

    def until(self, reached, limit_s):
        end_s = self.clock.now_s() + limit_s
        while not reached() and self.clock.now_s() < end_s:
            self.each_step()
            self.supervisor.step()
        return reached()

    def run(self, duration_s):
        self.until(lambda: False, duration_s)

    def replace(self, owner, name, new):
        """Put `new`, which is given what was there, in its place."""
        old = getattr(owner, name)
        setattr(owner, name, partial(new, old))
        self._healing.append(partial(setattr, owner, name, old))

    def laws(self, law):
        """Move by `law` in every mode."""
        self.replace(self.loop, "_laws", lambda _: None)
        self.loop._laws = dict.fromkeys(Mode, law)

    def heal(self):
        self.each_step = lambda: None
        while self._healing:
            self._healing.pop()()

    @property
    def tripped(self):
        return {trip.name: trip for trip in self.loop.interlocks.tripped}

    def told(self, text):
        return [event for event in self.records if text in event.message]


# ---------------------------------------------------------------- ways to strike


def light(factor, bench):
    scene = bench.camera._scene
    before, scene._flux_dn = scene._flux_dn, scene._flux_dn * factor
    bench._healing.append(lambda: setattr(scene, "_flux_dn", before))


def mirror_at_its_edge(bench):
    edge_rad = np.array([0.95 * bench.loop.settings.fsm.range_rad, 0.0])
    move = bench.loop.mirror.move_to
    bench.laws(lambda _observation: move(edge_rad, hysteresis_inverse=False))
    bench.replace(bench.loop.following, "evaluate", lambda *_: None)  # else it goes back to COARSE


def set_point_beyond_the_travel(bench):
    siderostat = bench.loop.siderostat
    bench.laws(
        lambda _observation: siderostat.move_to(np.array([1.2 * siderostat.travel_rad, 0.0]))
    )


def motors_beyond_the_travel(bench):
    siderostat, servo = bench.loop.siderostat, bench.loop.servo
    bench.laws(lambda _observation: servo.move_to(np.array([1.03 * siderostat.travel_rad, 0.0])))


def motors_run_away(rate_rad_s, bench):
    since_s = bench.clock.now_s()

    def exchange(ask, velocity_rad_s):
        reading = ask(velocity_rad_s)
        az_rad, el_rad = reading.position_rad
        away_rad = rate_rad_s * (reading.time_s - since_s)
        return reading._replace(position_rad=(az_rad + away_rad, el_rad))

    bench.replace(bench.devices.amplifiers, "exchange", exchange)


def motors_move_in_safe(bench):
    bench.simulation.command(Stop())
    motors_run_away(3.0, bench)


def motors_lag(bench):
    stuck_rad = bench.loop.servo.position_rad
    bench.replace(bench.devices.amplifiers, "exchange", lambda ask, _: ask((0.0, 0.0)))
    bench.laws(lambda _observation: bench.loop.siderostat.move_to(stuck_rad + np.array([0.9, 0.0])))


def fail(owner, method, error, bench):
    def failing(*_):
        raise error

    bench.replace(getattr(bench.devices, owner), method, failing)


def slow_amplifiers(bench):
    """Each exchange takes two periods by the servo's clock, and no time for anybody else."""
    real, servo = bench.clock, bench.loop.servo

    class Slow:
        asked_s = 0.0

        def now_s(self):
            asked_s, self.asked_s = self.asked_s, 0.0
            return real.now_s() + asked_s

    def exchange(ask, velocity_rad_s):
        reading = ask(velocity_rad_s)
        servo._clock.asked_s = 2 * servo.period_s
        return reading._replace(time_s=reading.time_s + 2 * servo.period_s)

    bench.replace(servo, "_clock", lambda old: old)
    servo._clock = Slow()
    bench.replace(bench.devices.amplifiers, "exchange", exchange)


def servo_that_skips(bench):
    servo = bench.loop.servo

    def step():
        servo.late_s.extend([0.0] * 5)
        servo.skipped += 5

    bench.each_step = step
    bench._healing.append(lambda: setattr(bench, "each_step", lambda: servo.late_s.append(0.0)))


def write_slowly(bench):
    def confirm(old):
        bench.clock.sleep_until(bench.clock.now_s() + 0.03)
        old()

    bench.replace(bench.devices.dac, "confirm", confirm)


def stall(bench):
    def next_frame(old, timeout_s):
        if timeout_s > 0:  # not while it only looks for a newer one
            bench.clock.sleep_until(bench.clock.now_s() + 0.6)
        return old(timeout_s)

    bench.replace(bench.camera, "next_frame", next_frame)


def no_frames(bench):
    go_on_to = bench.camera._go_on_to
    bench.replace(
        bench.camera, "next_frame", lambda _, timeout_s: go_on_to(bench.clock.now_s() + timeout_s)
    )


def late_frames(bench):
    def next_frame(old, timeout_s):
        frame = old(timeout_s)
        return frame and frame._replace(received_s=frame.received_s + 0.05)

    bench.replace(bench.camera, "next_frame", next_frame)


def every_second_frame(bench):
    def next_frame(old, timeout_s):
        old(timeout_s)
        return old(timeout_s)

    bench.replace(bench.camera, "next_frame", next_frame)


def computer(name, ill, well, bench):
    def say(value):
        bench.each_step = lambda: bench.supervisor.report_quantity(name, value)

    say(ill)
    bench._healing.append(lambda: say(well))


LAX_SERVO = ["loops.right.siderostat.servo.following_error_limit_rad=100.0"]  # else it is first
STRIKES = {
    "star_lost": partial(light, 0.0),
    "flux_low": partial(light, 0.68),
    "fsm_edge": mirror_at_its_edge,
    "siderostat_limit": set_point_beyond_the_travel,
    "siderostat_beyond": motors_beyond_the_travel,
    "siderostat_rate": partial(motors_run_away, 150.0),
    "siderostat_moves": motors_move_in_safe,
    "following_error": motors_lag,
    "amplifier_fault": partial(
        fail, "amplifiers", "exchange", DeviceFault("siderostat", "can0", "no fault", "hot", "wait")
    ),
    "amplifier_slow": slow_amplifiers,
    "servo_overrun": servo_that_skips,
    "piezo_limit": lambda bench: bench.replace(bench.devices.piezo, "limit_v", lambda _: 100.0),
    "piezo_fault": partial(
        fail, "piezo", "limit_v", DeviceTimeout("piezo amplifier", "ttyUSB0", "150 V", "none")
    ),
    "dac_watchdog": stall,
    "dac_slow": write_slowly,
    "frame_missing": no_frames,
    "frame_age": late_frames,
    "frame_interval": every_second_frame,
    "loop_overrun": write_slowly,
    "disk_space": partial(computer, "disk_free_bytes", 1e6, 1e12),
    "recorder_behind": partial(computer, "recorder_backlog_fraction", 0.9, 0.0),
    "clock_step": partial(computer, "clock_step_s", 0.2, 0.0),
}


def struck(name):
    """A bench on which this row has tripped."""
    bench = Bench(*(LAX_SERVO if name == "siderostat_rate" else []))
    bench.run(1.0)
    assert not bench.tripped
    STRIKES[name](bench)
    assert bench.until(lambda: name in bench.tripped, TRIPS_WITHIN_S), bench.tripped
    return bench
