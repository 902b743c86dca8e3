"""A metrology loop on devices of a few lines: motors with play, a collector that moves, photodiodes."""

import math

import numpy as np

from fitctl.clock import VirtualClock
from fitctl.config import ARCSEC_PER_RAD, default_rig_path, load_rig
from fitctl.drivers.interface import DeviceIdentity, DiodeReading, LoopDevices, ServoReading
from fitctl.loop.metrology import metrology_loop
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Mode, Trigger
from fitctl.model.metrology.photodiodes import diode_volts
from fitctl.stages.journal import Journal

RIG = default_rig_path().with_name("fit-testbed.toml")
NOBODY = DeviceIdentity("", "", "", "")


class Motors:
    """Amplifiers whose motors follow every velocity at once."""

    def __init__(self, clock):
        self.clock = clock
        self.position_rad = np.zeros(2)
        self.fault = ""
        self._velocity_rad_s, self._since_s = np.zeros(2), clock.now_s()

    def open(self):
        return NOBODY

    enable = disable = reset_fault = close = lambda _self: None

    def exchange(self, velocity_rad_s):
        now_s = self.clock.now_s()
        self.position_rad = self.position_rad + self._velocity_rad_s * (now_s - self._since_s)
        self._velocity_rad_s, self._since_s = np.array(velocity_rad_s), now_s
        return ServoReading(now_s, tuple(self.position_rad.tolist()), True, self.fault)


class Diodes:
    """Photodiodes that answer `delay_s` after they were asked."""

    def __init__(self, bench, delay_s):
        self.bench, self.delay_s = bench, delay_s
        self.light = 1.0
        self.error = None
        self._waiting = []
        self._random = np.random.default_rng(4)

    def open(self):
        return NOBODY

    def close(self):
        pass

    def send_request(self):
        sensor, now_s = self.bench.truth, self.bench.clock.now_s()
        volts = diode_volts(sensor, self.bench.beam_m(), self.light)
        volts += sensor.noise_v * self._random.standard_normal(4)
        self._waiting.append(DiodeReading(now_s, tuple(volts.tolist())))

    def receive(self):
        if self.error is not None:
            raise self.error
        come = [r for r in self._waiting if r.time_s + self.delay_s <= self.bench.clock.now_s()]
        self._waiting = [r for r in self._waiting if r not in come]
        return come[-1] if come else None


class Bench:
    """A metrology loop, its beam `offset_arcsec` off the centre, and a collector at `collector_m(time_s)`."""

    def __init__(self, *overrides, offset_arcsec=(0.0, 0.0), collector_m=lambda _s: (0.0, 0.0)):
        self.rig = load_rig(RIG, overrides)
        self.settings = self.rig.metrology_loops["metrology"]
        self.truth = self.settings.sensor
        self.clock = VirtualClock()
        self.records = []
        self.offset_rad = np.array(offset_arcsec) / ARCSEC_PER_RAD
        self.collector_m = collector_m
        self.motors = Motors(self.clock)
        self.diodes = Diodes(self, self.truth.link_delay_s)
        self._half_play_rad = self.settings.siderostat.backlash_sky_arcsec / ARCSEC_PER_RAD / 2
        self._beam_rad = np.zeros(2)
        journal = Journal(self.clock, self.records.append)
        devices = LoopDevices(self.motors, photodiodes=self.diodes)
        self.loop = metrology_loop("metrology", self.rig, devices, journal)
        self.ticks = []

    def beam_m(self):
        """The beam from the centre of the photodiodes."""
        motor = self.settings.siderostat.sky_rad_per_motor_rad * self.motors.position_rad
        half = self._half_play_rad
        self._beam_rad = np.clip(self._beam_rad, motor - half, motor + half)
        length_m = self.truth.link_length_m
        return length_m * (self._beam_rad + self.offset_rad) - np.array(
            self.collector_m(self.clock.now_s())
        )

    def beam_arcsec(self):
        return self.beam_m() / self.truth.link_length_m * ARCSEC_PER_RAD

    def power_up(self):
        self.loop.servo.open()
        self.loop.begin(None)
        self.loop.fire(Trigger.STANDBY, "test")
        return self

    def acquire(self, command=None):
        command = command or Acquire()
        self.loop.obey(Trigger.ACQUIRE, command)
        return self

    def tick(self):
        period_s, servo = self.rig.camera.period_s, self.loop.servo
        for _ in range(round(period_s / servo.period_s)):
            self.clock.sleep_until(self.clock.now_s() + servo.period_s)
            servo.period()
            self.beam_m()
        self.loop.sense(None, 0, 0)
        self.loop.decide()
        self.loop.send()
        self.loop.confirm()
        self.ticks.append(self.loop.tick_record())

    def run(self, duration_s):
        for _ in range(round(duration_s / self.rig.camera.period_s)):
            self.tick()
        return self

    def until(self, mode, limit_s=20.0):
        end_s = self.clock.now_s() + limit_s
        while self.loop.mode is not mode:
            assert self.clock.now_s() < end_s, f"still {self.loop.mode.name}, wanted {mode.name}"
            self.tick()
        return self

    def held(self):
        return self.power_up().acquire().until(Mode.LOCKED)

    def rms_arcsec(self, duration_s):
        """Of the true beam over `duration_s`, the worse axis."""
        errors = []
        for _ in range(round(duration_s / self.rig.camera.period_s)):
            self.tick()
            errors.append(self.beam_arcsec())
        return math.sqrt(np.mean(np.square(errors), axis=0).max())
