"""What the mock drive sends of itself: PDOs, heartbeats; and what a master's silence does."""

import asyncio

import pytest
from cia402_bus import COUNT_RAD, RPM_RAD_S, on_drive

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State


def test_a_pdo_cycle():
    async def script(bus, mock, motors):
        await bus.map_pdos()
        for index in (protocol.UNIT_VELOCITY, protocol.UNIT_VELOCITY + 0x800):
            await bus.write(index, protocol.UNIT_MILLI_RPM.to_bytes(4, "little"))
        bus.send(0x000, "01 01")
        await bus.see(0x281, "50 02 50 02")  # both switch-on disabled, remote, voltage
        await bus.enable(0)
        await bus.enable(1)
        statuswords = [data for can_id, data in bus.passed_over if can_id == 0x281]
        assert statuswords[-1] == "37 12 37 12"  # each change was told

        motors.angles_rad = [10 * COUNT_RAD, -1.4 * COUNT_RAD]
        bus.send(0x201, "60 ea 00 00 a0 15 ff ff")  # 60 and -60 rpm
        await bus.ask("40 ff 60 00 00000000", "43 ff 60 00 00 00 00 00")
        assert motors.velocity_rad_s == (0, 0)  # not before SYNC
        bus.send(0x080)
        await bus.see(0x181, "0a 00 00 00 ff ff ff ff")
        assert motors.velocity_rad_s == pytest.approx((60 * RPM_RAD_S, -60 * RPM_RAD_S))

        motors.angles_rad = [2**31 * COUNT_RAD, 0]  # the counter wraps
        bus.send(0x080)
        await bus.see(0x181, "00 00 00 80 00 00 00 00")

        bus.send(0x201, "60 ea")  # too short: not acted on, but told
        bus.send(0x080)
        await bus.see(0x081, "10 82 00 00 00 00 00 00")

        bus.send(0x000, "80 01")
        for axis in (0, 1):  # leaving operation stops both
            await bus.state_becomes(State.SWITCH_ON_DISABLED, axis)
        assert motors.velocity_rad_s == (0, 0)
        bus.send(0x080)
        bus.passed_over.clear()
        await bus.statusword()
        assert not [frame for frame in bus.passed_over if frame[0] == 0x181]

    on_drive(script)


def test_tpdos_by_divided_sync_and_by_timer():
    async def script(bus, _mock, _motors):
        await bus.map_pdos()
        await bus.write(0x1800, b"\x03", 2)  # every third SYNC
        await bus.write(0x1801, (30).to_bytes(2, "little"), 5)
        bus.send(0x000, "01 01")
        for _ in range(6):
            bus.send(0x080)
        await bus.ask("40 00 10 00 00000000", "43 00 10 00 92 01 ff ff")
        assert [frame[0] for frame in bus.passed_over].count(0x181) == 2
        for _ in range(3):
            await bus.see(0x281, "50 02 50 02")

    on_drive(script)


def test_a_tpdo_on_change_at_sync():
    async def script(bus, _mock, _motors):
        await bus.map_pdos()
        await bus.write(0x1801, b"\x00", 2)
        bus.send(0x000, "01 01")
        bus.send(0x080)
        await bus.see(0x281, "50 02 50 02")
        bus.send(0x080)
        await bus.control(0x06, State.READY_TO_SWITCH_ON)
        assert 0x281 not in [frame[0] for frame in bus.passed_over]
        bus.send(0x080)
        await bus.see(0x281, "31 02 50 02")

    on_drive(script)


def test_a_tpdo_can_be_asked_for_by_a_remote_frame():
    async def script(bus, _mock, motors):
        await bus.map_pdos()
        motors.angles_rad = [10 * COUNT_RAD, 0]
        bus.ask_for(0x181)  # not operational yet
        bus.send(0x000, "01 01")
        bus.ask_for(0x181)
        await bus.see(0x181, "0a 00 00 00 00 00 00 00")

        await bus.write(0x1800, (0x4000_0181 | protocol.PDO_DISABLED).to_bytes(4, "little"), 1)
        await bus.write(0x1800, b"\xfc", 2)  # 252: as sampled at SYNC
        await bus.write(0x1800, (0x181).to_bytes(4, "little"), 1)
        bus.send(0x080)
        await bus.statusword()
        motors.angles_rad = [20 * COUNT_RAD, 0]
        bus.ask_for(0x181)
        await bus.see(0x181, "0a 00 00 00 00 00 00 00")

        await bus.write(0x1800, protocol.PDO_DISABLED.to_bytes(4, "little"), 1)
        await bus.write(0x1800, (0x4000_0181).to_bytes(4, "little"), 1)  # no remote frames
        bus.ask_for(0x181)
        bus.passed_over.clear()
        await bus.statusword()
        assert 0x181 not in [frame[0] for frame in bus.passed_over]

    on_drive(script)


def test_the_heartbeat_says_the_nmt_state():
    async def script(bus, _mock, _motors):
        await bus.write(protocol.HEARTBEAT_PRODUCER, (20).to_bytes(2, "little"))
        await bus.see(0x701, "7f")
        bus.send(0x000, "01 00")
        await bus.see_after(0x701, "7f", "05")
        bus.send(0x000, "02 01")
        await bus.see_after(0x701, "05", "04")
        bus.send(0x601, "40 00 10 00 00000000")
        assert (await bus.frame())[0] == 0x701  # stopped: no SDO
        bus.send(0x000, "81 02")  # another node's reset
        bus.send(0x000, "81 01")
        await bus.see_after(0x701, "04", "00")  # boot-up, and the producer is off again
        await bus.ask("40 17 10 00 00000000", "4b 17 10 00 00 00 00 00")

    on_drive(script)


def test_a_lost_master_heartbeat_stops_both_motors():
    async def script(bus, _mock, motors):
        await bus.write(
            protocol.HEARTBEAT_CONSUMER, bytes.fromhex("64007f00"), 1
        )  # node 127, 100 ms
        await bus.enable(0)
        await bus.enable(1)
        await asyncio.sleep(0.15)
        assert motors.enabled == [True, True]  # it was not seen yet
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        bus.send(0x77F, "05")
        await bus.see(0x081, "30 81 11 00 00 00 00 00")
        for axis in (0, 1):
            await bus.state_becomes(State.FAULT, axis)
        assert motors.velocity_rad_s == (0, 0)
        assert motors.enabled == [False, False]

    on_drive(script)


@pytest.mark.parametrize(
    ("option", "state"),
    [(0, State.OPERATION_ENABLED), (2, State.SWITCH_ON_DISABLED), (3, State.SWITCH_ON_DISABLED)],
)
def test_what_a_lost_master_does_can_be_chosen(option, state):
    async def script(bus, _mock, motors):
        await bus.write(protocol.ABORT_OPTION, option.to_bytes(2, "little"))
        await bus.write(protocol.HEARTBEAT_CONSUMER, bytes.fromhex("14007f00"), 1)
        await bus.enable(0)
        bus.send(0x77F, "05")
        await bus.see(0x081, "30 81 11 00 00 00 00 00")  # the other axis is in fault
        await bus.state_becomes(state)
        assert motors.enabled[0] == (option == 0)

    on_drive(script)
