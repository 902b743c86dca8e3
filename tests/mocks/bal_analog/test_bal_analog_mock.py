"""The mock station as a stranger's Modbus client sees it: pymodbus' own."""

import asyncio
import functools
import math

import pytest
from instruments.mock_bench import ToldMotors
from pymodbus.client import AsyncModbusTcpClient

from fitctl import config
from fitctl.mocks.bal_analog.station import BalAnalogMockStation

RIG = config.load_rig(config.default_rig_path().parent / "fit-bal-analog.toml")
SIDEROSTAT = RIG.loops["right"].siderostat
SETTINGS = RIG.mocks.loops["right"].bal_analog.model_copy(
    update={"modbus_port": 0, "counters_at_start": [65530, 3]}
)
COUNTS_PER_RAD = 4000 / (2 * math.pi)


def served(test=None, device=None, **update):
    """Run a test with a mock, its motors and pymodbus' client."""

    async def serve(test):
        siderostat = SIDEROSTAT.model_copy(
            update={"device": SIDEROSTAT.device.model_copy(update=device or {})}
        )
        motors = ToldMotors()
        mock = BalAnalogMockStation(siderostat, SETTINGS.model_copy(update=update), motors)
        port = await mock.start()
        client = AsyncModbusTcpClient("127.0.0.1", port=port, timeout=5, retries=0)
        await client.connect()

        async def exchange(az, el, enable):
            answer = await client.readwrite_registers(
                read_address=16, read_count=3, write_address=0, values=[az, el, enable]
            )
            assert not answer.isError()
            return answer.registers

        try:
            await test(mock, motors, client, exchange)
        finally:
            client.close()
            await mock.stop()
            await mock.stop()
        assert motors.enabled == [False, False]

    def decorate(test):
        @functools.wraps(test)
        def run():
            asyncio.run(serve(test))

        del run.__wrapped__  # pytest would take its arguments for fixtures
        return run

    return decorate(test) if test else decorate


def set_fault(mock, kind, **settings):
    mock.faults.set(config.Fault(device="right.drive", kind=kind, **settings))


@served
async def test_one_transaction_commands_and_reads(mock, motors, client, exchange):
    assert await exchange(3277, 0x10000 - 6553, 0b11) == [65530, 3, 0]
    assert motors.enabled == [True, True]
    assert motors.velocity_rad_s == pytest.approx((6.0, -12.0), abs=1e-3)


@served
async def test_without_its_enable_line_an_axis_stands(mock, motors, client, exchange):
    await exchange(3277, 3277, 0b10)
    assert motors.enabled == [False, True]
    assert motors.velocity_rad_s[0] == 0.0
    assert motors.velocity_rad_s[1] == pytest.approx(6.0, abs=1e-3)


@served
async def test_counters_wrap_at_16_bits(mock, motors, client, exchange):
    motors.angles_rad = (10 / COUNTS_PER_RAD, -10 / COUNTS_PER_RAD)
    assert await exchange(0, 0, 0) == [4, 65529, 0]
    motors.angles_rad = (70_000 / COUNTS_PER_RAD, 0.0)
    assert (await exchange(0, 0, 0))[0] == (65530 + 70_000) % 65536


@served
async def test_written_outputs_read_back_and_inputs_cannot_be_written(
    mock, motors, client, exchange
):
    await client.write_registers(0, [5, 6, 0])
    assert (await client.read_holding_registers(0, count=3)).registers == [5, 6, 0]
    await client.write_register(16, 1234)
    assert (await client.read_holding_registers(16, count=1)).registers == [65530]


@pytest.mark.parametrize("address", [3, 15, 19, 65535])
def test_there_is_nothing_beside_the_registers(address):
    @served
    async def ask(mock, motors, client, exchange):
        answer = await client.read_holding_registers(address, count=1)
        assert answer.exception_code == 2

    ask()


@served(device={"device_id": 7})
async def test_another_unit_is_refused(mock, motors, client, exchange):
    answer = await client.read_holding_registers(0, count=1, device_id=9)
    assert answer.exception_code == 0x0B
    assert (await client.read_holding_registers(0, count=1, device_id=7)).registers == [0]


@served(watchdog_s=0.05)
async def test_the_watchdog_takes_commands_and_enable_lines_away(mock, motors, client, exchange):
    await exchange(3277, 3277, 0b11)
    end_s = asyncio.get_running_loop().time() + 5
    while motors.enabled != [False, False]:
        assert asyncio.get_running_loop().time() < end_s
        await asyncio.sleep(0.01)
    assert motors.velocity_rad_s == (0.0, 0.0)
    assert (await client.read_holding_registers(0, count=3)).registers == [0, 0, 0]
    await exchange(0, 0, 0b11)
    assert motors.enabled == [True, True]


@served(device={"enabled_level": "low", "fault_level": "low"}, watchdog_s=60.0)
async def test_lines_may_be_active_low(mock, motors, client, exchange):
    assert (await client.read_holding_registers(2, count=1)).registers == [0b11]
    assert (await exchange(0, 0, 0b10))[2] == 0b11
    assert motors.enabled == [True, False]
    set_fault(mock, "amplifier_fault", part="az")
    assert (await exchange(0, 0, 0b10))[2] == 0b10
    assert motors.enabled == [False, False]


@served(watchdog_s=60.0)
async def test_a_fault_stays_until_the_enable_line_went_down(mock, motors, client, exchange):
    await exchange(3277, 3277, 0b11)
    set_fault(mock, "amplifier_fault", part="el")
    assert motors.enabled == [True, False]
    assert (await exchange(3277, 3277, 0b11))[2] == 0b10
    assert (await exchange(0, 0, 0b00))[2] == 0b10  # its cause is still there
    await exchange(3277, 3277, 0b11)
    mock.faults.clear()
    assert (await exchange(3277, 3277, 0b11))[2] == 0b10
    assert (await exchange(0, 0, 0b00))[2] == 0
    await exchange(3277, 3277, 0b11)
    assert motors.enabled == [True, True]


@served(watchdog_s=60.0)
async def test_a_stuck_axis_is_told_to_stand_and_goes_on_afterwards(mock, motors, client, exchange):
    await exchange(3277, 3277, 0b11)
    set_fault(mock, "stuck_axis", part="az")
    assert motors.velocity_rad_s == pytest.approx((0.0, 6.0), abs=1e-3)
    mock.faults.clear()
    assert motors.velocity_rad_s == pytest.approx((6.0, 6.0), abs=1e-3)


@served
async def test_a_jumped_counter_and_an_offset(mock, motors, client, exchange):
    set_fault(mock, "encoder_jump", part="el", value=100)
    set_fault(mock, "command_offset", part="az", value=0.5)
    assert await exchange(0, 0, 0b11) == [65530, 103, 0]
    assert motors.velocity_rad_s == pytest.approx((3.0, 0.0))


@served(watchdog_s=60.0)
async def test_a_reboot_takes_everything_away(mock, motors, client, exchange):
    await exchange(3277, 3277, 0b11)
    motors.angles_rad = (math.tau, -math.tau)
    set_fault(mock, "reboot", value=0.01)
    assert motors.enabled == [False, False]
    while mock.faults.active:
        await asyncio.sleep(0.001)
    assert motors.velocity_rad_s == (0.0, 0.0)
    assert mock._inputs() == [65530, 3, 0], "counters start anew"


@served
async def test_who_answers(mock, motors, client, exchange):
    answer = await client.read_device_information()
    assert answer.information[1] == b"mock analogue amplifiers"
