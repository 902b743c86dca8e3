"""What tests put about a mock: an event loop, and motors."""

import asyncio
import functools


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
