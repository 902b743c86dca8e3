"""The mock drive's faults on the wire, and what mends them."""

import asyncio

import pytest
from cia402_bus import COUNT_RAD, on_drive

from fitctl.config import Fault
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State


def fault(kind, **settings):
    return Fault(device="right.drive", kind=kind, **settings)


def test_a_fault_stops_is_told_and_is_reset_by_an_edge():
    async def script(bus, mock, motors):
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        mock.faults.set(fault("amplifier_fault", part="az"))
        await bus.see(0x081, "10 23 01 01 00 00 00 00")
        await bus.state_becomes(State.FAULT)
        assert motors.velocity_rad_s == (0, 0)
        assert motors.enabled == [False, False]
        await bus.ask("40 3f 60 00 00000000", "4b 3f 60 00 10 23 00 00")
        await bus.ask("40 01 10 00 00000000", "4f 01 10 00 01 00 00 00")  # error register
        await bus.ask("40 03 10 00 00000000", "4f 03 10 00 01 00 00 00")  # history
        await bus.ask("40 03 10 01 00000000", "43 03 10 01 10 23 01 00")
        await bus.ask("40 03 10 02 00000000", "80 03 10 02 24 00 00 08")  # no more
        await bus.control(0x0F, State.FAULT)
        await bus.control(0x80, State.FAULT)  # the cause is still there
        mock.faults.clear()
        await bus.control(0x00, State.FAULT)
        await bus.control(0x80, State.SWITCH_ON_DISABLED)
        assert (0x081, "00 00 00 00 00 00 00 00") in bus.passed_over
        await bus.ask("2f 03 10 00 01000000", "80 03 10 00 30 00 09 06")
        await bus.ask("2f 03 10 00 00000000", "60 03 10 00 00 00 00 00")  # forgotten
        await bus.ask("40 03 10 00 00000000", "4f 03 10 00 00 00 00 00")
        mock.faults.set(fault("amplifier_fault", part="az", for_s=0.01))
        while mock.faults.active:
            await asyncio.sleep(0.001)
        await bus.control(0x80, State.FAULT)  # the bit was set already: no edge

    on_drive(script)


def test_the_last_client_leaving_does_not_stop_the_drive_by_itself():
    async def script(bus, mock, motors):
        await bus.enable(0)
        mock.faults.set(fault("disconnect"))
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await bus.frame()
        assert motors.enabled[0]

    on_drive(script)


def test_a_severed_can_cable_leaves_an_adapter_without_a_drive():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("link_loss"))
        bus.send(0x601, "40 00 10 00 00000000")
        await bus.caught_up()
        mock.faults.clear()
        await bus.ask("40 18 10 04 00000000", "43 18 10 04 01 29 35 01")
        assert bus.passed_over == []

    on_drive(script)


def test_a_jumped_encoder_counts_more_until_it_is_mended():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("encoder_jump", part="el", value=-3))
        await bus.ask("40 64 60 00 00000000", "43 64 60 00 00 00 00 00")
        await bus.ask("40 64 68 00 00000000", "43 64 68 00 fd ff ff ff")
        mock.faults.clear()
        await bus.ask("40 64 68 00 00000000", "43 64 68 00 00 00 00 00")

    on_drive(script)


def test_a_stuck_axis_stands_still_and_the_drive_does_not_know():
    async def script(bus, mock, motors):
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        mock.faults.set(fault("stuck_axis"))
        assert motors.velocity_rad_s == (0, 0)
        await bus.state_becomes(State.OPERATION_ENABLED)
        mock.faults.clear()
        assert motors.velocity_rad_s[0] > 0

    on_drive(script)


def test_a_following_error_is_a_fault_of_its_own():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("following_error", part="el"))
        await bus.see(0x081, "11 86 01 02 00 00 00 00")
        await bus.state_becomes(State.FAULT, axis=1)
        await bus.state_becomes(State.SWITCH_ON_DISABLED, axis=0)

    on_drive(script)


def test_neither_a_reset_of_the_node_nor_a_reboot_mends_an_amplifier():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("amplifier_fault", part="el"))
        bus.send(0x000, "81 01")
        await bus.see(0x701, "00")
        await bus.state_becomes(State.FAULT, axis=1)
        mock.faults.set(fault("reboot", value=0.01))
        while mock.faults.value("reboot") is not None:
            await asyncio.sleep(0.001)
        await bus.connect_again()
        await bus.state_becomes(State.FAULT, axis=1)
        await bus.state_becomes(State.SWITCH_ON_DISABLED, axis=0)

    on_drive(script)


def test_after_a_reboot_all_is_as_at_power_up_and_counters_start_anew():
    async def script(bus, mock, motors):
        await bus.enable(0)
        await bus.write(protocol.HEARTBEAT_PRODUCER, (20).to_bytes(2, "little"))
        motors.angles_rad = [100 * COUNT_RAD, 0]
        mock.faults.set(fault("reboot", value=0.01))
        assert motors.enabled == [False, False]
        while mock.faults.active:
            await asyncio.sleep(0.001)
        assert mock.nmt_state == 0x7F
        assert mock.heartbeat_ms == 0
        await bus.connect_again()
        motors.angles_rad = [101 * COUNT_RAD, 0]
        await bus.ask("40 64 60 00 00000000", "43 64 60 00 01 00 00 00")
        assert protocol.state_of(await bus.statusword()) is State.SWITCH_ON_DISABLED

    on_drive(script)
