"""What tests put about a mock: an event loop, and motors."""

import asyncio
import functools
import threading
import time


def in_a_loop(test):
    """Let a coroutine be a test."""

    @functools.wraps(test)
    def run(*args, **kwargs):
        asyncio.run(test(*args, **kwargs))

    return run


class ToldMotors:
    """Motors that are where a test puts them, and know what they were told."""

    def __init__(self, az_rad=0.0, el_rad=0.0):
        self.angles_rad = (az_rad, el_rad)
        self.velocity_rad_s = (0.0, 0.0)
        self.enabled = [False, False]

    def position_rad(self):
        return self.angles_rad

    def command_velocity_rad_s(self, az, el):
        self.velocity_rad_s = (az, el)

    def set_enabled(self, axis, enabled):
        self.enabled[axis] = enabled


class SimulatedMotors:
    """Two ideal motors: the angle is the time integral of the velocity, where there is current."""

    def __init__(self) -> None:
        self.velocity_rad_s = (0.0, 0.0)
        self.enabled = [False, False]
        self._angle_rad = [0.0, 0.0]
        self._at_s = time.monotonic()
        self._lock = threading.Lock()  # the mock's thread moves them, the test's looks

    def position_rad(self) -> tuple[float, float]:
        with self._lock:
            return self._move()

    def turn_to(self, az_rad: float, el_rad: float) -> None:
        with self._lock:
            self._move()
            self._angle_rad = [az_rad, el_rad]

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        with self._lock:
            self._move()
            self.velocity_rad_s = (az, el)

    def set_enabled(self, axis: int, enabled: bool) -> None:
        with self._lock:
            self._move()
            self.enabled[axis] = enabled

    @property
    def moving(self) -> bool:
        return any(
            on and abs(velocity) > 0.05  # a position loop hunts within half a count of its encoder
            for on, velocity in zip(self.enabled, self.velocity_rad_s, strict=True)
        )

    def _move(self) -> tuple[float, float]:
        now_s = time.monotonic()
        for axis, velocity in enumerate(self.velocity_rad_s):
            self._angle_rad[axis] += velocity * (now_s - self._at_s) * self.enabled[axis]
        self._at_s = now_s
        az_rad, el_rad = self._angle_rad
        return az_rad, el_rad
