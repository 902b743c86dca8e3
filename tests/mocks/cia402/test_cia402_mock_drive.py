"""The mock drive's axes: CiA 402's state machine, quick stop, profile velocity, software limits."""

import asyncio
import time

import pytest
from cia402_bus import COUNT_RAD, RPM_RAD_S, on_drive

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State


def test_each_axis_walks_the_state_machine():
    async def script(bus, _mock, motors):
        for axis in (0, 1):
            await bus.control(0x00, State.SWITCH_ON_DISABLED, axis)
            await bus.control(0x0F, State.SWITCH_ON_DISABLED, axis)  # not from here
            await bus.enable(axis)
            assert motors.enabled[axis]
            await bus.control(0x07, State.SWITCHED_ON, axis)
            assert not motors.enabled[axis]
            await bus.control(0x0F, State.OPERATION_ENABLED, axis)
            await bus.control(0x06, State.READY_TO_SWITCH_ON, axis)
            await bus.control(0x02, State.SWITCH_ON_DISABLED, axis)
            await bus.enable(axis)
            await bus.control(0x00, State.SWITCH_ON_DISABLED, axis)
        assert motors.enabled == [False, False]

    on_drive(script)


def test_quick_stop_stops_first_and_disables_then():
    async def script(bus, _mock, motors):
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        assert motors.velocity_rad_s == pytest.approx((60 * RPM_RAD_S, 0))  # unit is 1 rpm yet
        await bus.write(protocol.CONTROLWORD, b"\x02\x00")
        await bus.state_becomes(State.SWITCH_ON_DISABLED)
        assert motors.velocity_rad_s == (0, 0)
        assert not motors.enabled[0]

        await bus.write(protocol.QUICK_STOP_OPTION, b"\x06\x00")
        await bus.enable(0)
        await bus.control(0x02, State.QUICK_STOP_ACTIVE)
        assert motors.enabled[0]
        await bus.control(0x0F, State.OPERATION_ENABLED)

    on_drive(script)


def test_a_quick_stop_takes_the_time_of_its_ramp():
    async def script(bus, _mock, motors):
        await bus.write(protocol.QUICK_STOP_DECELERATION, (600).to_bytes(4, "little"))
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        started_s = time.monotonic()
        await bus.control(0x02, State.QUICK_STOP_ACTIVE)  # from 60 rpm by 600 rpm/s
        assert 0 < motors.velocity_rad_s[0] < 60 * RPM_RAD_S
        assert motors.enabled[0]
        await bus.state_becomes(State.SWITCH_ON_DISABLED)
        assert time.monotonic() - started_s >= 0.1
        assert not motors.enabled[0]

    on_drive(script)


@pytest.mark.parametrize("option", [0, 1, 2, 5, 6])
def test_after_any_quick_stop_the_motor_stands(option):
    async def script(bus, _mock, motors):
        await bus.write(protocol.QUICK_STOP_OPTION, option.to_bytes(2, "little"))
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        await bus.write(protocol.CONTROLWORD, b"\x02\x00")
        stays = option >= 5
        await bus.state_becomes(State.QUICK_STOP_ACTIVE if stays else State.SWITCH_ON_DISABLED)
        while motors.velocity_rad_s != (0, 0):
            await asyncio.sleep(0.001)
        assert motors.enabled[0] == stays
        await bus.ask(
            "2b 5a 60 00 03000000", "80 5a 60 00 30 00 09 06"
        )  # option 3: no current limit

    on_drive(script)


def test_profile_velocity_ramps_halts_and_says_where_it_is():
    async def script(bus, _mock, motors):
        reached, zero = protocol.SW_TARGET_REACHED, protocol.SW_SPEED_ZERO
        await bus.enable(0)
        await bus.write(protocol.MODE, b"\x03")
        await bus.write(protocol.ACCELERATION, (600).to_bytes(4, "little"))
        assert await bus.statusword() & (reached | zero) == reached | zero
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        assert not await bus.statusword() & reached
        assert motors.velocity_rad_s[0] < 60 * RPM_RAD_S
        while not await bus.statusword() & reached:
            pass
        assert motors.velocity_rad_s[0] == pytest.approx(60 * RPM_RAD_S)
        assert not await bus.statusword() & zero
        await bus.ask("40 6b 60 00 00000000", "43 6b 60 00 3c 00 00 00")  # the demand, 60 rpm
        await bus.write(protocol.CONTROLWORD, b"\x0f\x01")  # halt
        while not await bus.statusword() & zero:
            pass
        assert motors.velocity_rad_s[0] == 0
        assert protocol.state_of(await bus.statusword()) is State.OPERATION_ENABLED

    on_drive(script)


def test_a_software_limit_holds_the_axis_and_lets_it_back():
    async def script(bus, _mock, motors):
        await bus.write(protocol.POSITION_LIMITS, (-1000).to_bytes(4, "little", signed=True), 1)
        await bus.write(protocol.POSITION_LIMITS, (1000).to_bytes(4, "little"), 2)
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        assert not await bus.statusword() & protocol.SW_INTERNAL_LIMIT
        motors.angles_rad = [1000 * COUNT_RAD, 0]
        while not await bus.statusword() & protocol.SW_INTERNAL_LIMIT:
            pass
        assert motors.velocity_rad_s == (0, 0)
        await bus.write(protocol.TARGET_VELOCITY, (-60).to_bytes(4, "little", signed=True))
        assert motors.velocity_rad_s[0] == pytest.approx(-60 * RPM_RAD_S)
        assert not await bus.statusword() & protocol.SW_INTERNAL_LIMIT
        motors.angles_rad = [-1001 * COUNT_RAD, 0]
        while motors.velocity_rad_s[0]:  # without any message
            await asyncio.sleep(0.001)

    on_drive(script)
