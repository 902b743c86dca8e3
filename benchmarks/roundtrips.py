"""How long each mock takes to answer, beside a plain asyncio echo, sinstruments and tickit in the same run.

One device at a time in a process of its own, asked by a blocking client in this one, in several rounds so that
what else the machine does meets all alike. Lines named "at its pace" hold the wire and the device to their
times, which are the rig file's; all others have neither baud rate nor thinking time. The ratio is to the
echo on the same kind of socket.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
import multiprocessing
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import serial

from benchmarks import foreign
from benchmarks.motors import StillMotors
from fitctl.config import Loop, LoopMocks, default_rig_path, load_rig
from fitctl.drivers.cia402.protocol import encode_sdo
from fitctl.drivers.gige.protocol import Command, Register, encode_command, encode_words
from fitctl.mocks.amplifiers import amplifier_mock
from fitctl.mocks.event_loop import run_on_time
from fitctl.mocks.gige.camera import GigeCameraMock
from fitctl.mocks.labjack_t7.server import LabJackT7Mock
from fitctl.mocks.mdt693.server import Mdt693Mock
from fitctl.mocks.modbus.rtu import frame as rtu_frame
from fitctl.mocks.modbus.tcp import frame as tcp_frame
from fitctl.mocks.modbus_dac.server import ModbusDacMock
from fitctl.mocks.pty import Endpoints

STARTS_WITHIN_S = 20.0
ANSWERS_WITHIN_S = 5.0
WARM_UP = 50
BAUD_RATE = 115200
UPLOAD, STATUSWORD = 0x40, 0x6041
SDO_REQUEST, SDO_ANSWER = 0x600, 0x580
TCP, UDP, PTY = "TCP", "UDP", "pty"
Start = Callable[[], Coroutine[Any, Any, int | str]]


@dataclass(frozen=True)
class Line:
    """A line of the table: whom to ask what, and when the answer is whole.

    The first line of a wire is the echo to which the others are compared.
    """

    name: str
    wire: str
    start: Callable[..., Any]
    request: bytes
    is_answer: Callable[[bytes], bool]
    is_ours: bool = True
    is_paced: bool = False
    needs: str = ""
    before: bytes = b""


# ---------------------------------------------------------------- our mocks, each started alone


def _rig(name: str, *settings: str) -> tuple[Loop, LoopMocks]:
    rig = load_rig(default_rig_path().with_name(name), settings)
    return rig.stellar_loops["right"], rig.mock_parts()[1].stellar_loops["right"]


async def _mdt693(*settings: str) -> Endpoints:
    loop, mocks = _rig("fit-mock.toml", *settings)
    return await Mdt693Mock(mocks.mdt693, loop.fsm.piezo, lambda _: None, port=0).start()


async def _mdt693_fast() -> int:
    mock = "mocks.loops.right.mdt693"
    return (await _mdt693(f"{mock}.reply_s=0.0", f"{mock}.baud_rate=1000000000")).tcp_port


async def _mdt693_pty() -> str:
    return (await _mdt693()).pty_path


async def _dac() -> Endpoints:
    loop, mocks = _rig("fit-mock.toml")
    return await ModbusDacMock(loop.fsm.dac, mocks.dac, lambda _: None, port=0).start()


async def _dac_tcp() -> int:
    return (await _dac()).tcp_port


async def _dac_pty() -> str:
    return (await _dac()).pty_path


async def _amplifiers(name: str, *settings: str) -> Any:
    loop, mocks = _rig(name, *(f"mocks.loops.right.{setting}" for setting in settings))
    return await amplifier_mock(loop.siderostat, mocks, StillMotors()).start()


async def _drive() -> int:
    return int(await _amplifiers("fit-mock.toml", "slcan_port=0"))


async def _ensemble(*settings: str) -> int:
    listening = await _amplifiers("ensemble.toml", "ensemble.tcp_port=0", *settings)
    return int(listening.tcp_port)


async def _bal_analog() -> int:
    return int(await _amplifiers("fit-bal-analog.toml", "bal_analog.modbus_port=0"))


async def _labjack() -> int:
    rig = load_rig(default_rig_path().with_name("fit-testbed.toml"))
    (name, loop), *_ = rig.metrology_loops.items()
    ours = rig.mock_parts()[1].metrology_loops[name].labjack
    ours = ours.model_copy(update={"modbus_port": 0})
    return await LabJackT7Mock(loop.sensor.device, ours, lambda _: [5.0] * 4).start()


async def _camera() -> int:
    rig = load_rig(default_rig_path())
    image = np.zeros((rig.camera.height_px, rig.camera.width_px), np.uint16)
    settings = rig.mock_parts()[1].camera
    return await GigeCameraMock(rig.camera, settings, lambda _: image, port=0).start()


# ---------------------------------------------------------------- what is asked


def _ends(with_: bytes) -> Callable[[bytes], bool]:
    return lambda answer: answer.endswith(with_)


def _is(count: int) -> Callable[[bytes], bool]:
    return lambda answer: len(answer) >= count


def every_line() -> Iterator[Line]:
    """The table's lines, in order."""
    echo, answer = foreign.QUESTION, _ends(foreign.ANSWER)
    yield Line("asyncio streams: echo", TCP, foreign.tcp_echo, echo, _ends(echo), is_ours=False)
    for start in (foreign.sinstruments, foreign.tickit):
        name = start.__name__
        yield Line(f"{name}: a line", TCP, start, echo, answer, is_ours=False, needs=name)
    loop, _ = _rig("fit-mock.toml")
    voltage = b"xvoltage?\r", _ends(b"\r*")
    yield Line("MDT693: a voltage", TCP, _mdt693_fast, *voltage)
    dac = loop.fsm.dac
    write = struct.pack(">BHHB6x", 16, dac.first_register, 3, 6)
    yield Line("D/A: FC 16, three channels", TCP, _dac_tcp, _adu(dac.device_id, write), _is(12))
    bal: Any = _rig("fit-bal-analog.toml")[0].siderostat.device
    both = struct.pack(
        ">BHHHHB6x", 23, bal.first_input_register, 3, bal.first_output_register, 3, 6
    )
    yield Line(
        "BAL station: FC 23, both axes", TCP, _bal_analog, _adu(bal.device_id, both), _is(15)
    )
    position = b"PFBKPROG(@0)\n", _ends(b"\n")
    yield Line("Ensemble: a position", TCP, partial(_ensemble, "ensemble.reply_s=0.0"), *position)
    drive: Any = loop.siderostat.device
    node = drive.node_id
    upload = f"t{SDO_REQUEST + node:03x}8{encode_sdo(UPLOAD, STATUSWORD, 0).hex()}\r".encode()
    uploaded = f"t{SDO_ANSWER + node:03x}8".encode()
    yield Line(
        "drive: an SDO, over SLCAN",
        TCP,
        _drive,
        upload,
        lambda answer: uploaded in answer and answer.endswith(b"\r"),
        before=b"S8\rO\r",
    )
    readreg = encode_command(Command.READREG, 1, encode_words(Register.VERSION))
    yield Line("asyncio datagrams: echo", UDP, foreign.udp_echo, readreg, _is(12), is_ours=False)
    yield Line("camera: READREG", UDP, _camera, readreg, _is(12))
    yield Line("MDT693 at its pace: a voltage", PTY, _mdt693_pty, *voltage, is_paced=True)
    framed = rtu_frame(dac.device_id, write)
    yield Line("D/A at its pace: FC 16, RTU", PTY, _dac_pty, framed, _is(8), is_paced=True)
    diodes = _adu(1, struct.pack(">BHH", 3, 0, 8))
    yield Line("LabJack T7 at its pace: four inputs", TCP, _labjack, diodes, _is(25), is_paced=True)
    yield Line("Ensemble at its pace: a position", TCP, _ensemble, *position, is_paced=True)


def _adu(unit: int, pdu: bytes) -> bytes:
    return tcp_frame(1, unit, pdu)


# ---------------------------------------------------------------- asking


def serve(start: Start, pipe: Connection) -> None:
    """A mock until the process is ended; tells first where it is."""

    async def run() -> None:
        pipe.send(await start())
        await asyncio.Event().wait()

    run_on_time(run())


def free_port() -> int:
    """A port that nobody has now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def connect(line: Line, where: int | str, stack: ExitStack) -> int:
    """A file descriptor to the device; tried again until it listens."""
    if line.wire == PTY:
        return int(stack.enter_context(serial.Serial(str(where), BAUD_RATE)).fileno())
    kind = socket.SOCK_STREAM if line.wire == TCP else socket.SOCK_DGRAM
    end_s = time.monotonic() + STARTS_WITHIN_S
    while True:
        client = socket.socket(socket.AF_INET, kind)
        try:
            client.connect(("127.0.0.1", where))
            if line.wire == UDP:  # only an answer shows that somebody is there
                client.send(line.request)
                client.recv(4096)
        except ConnectionRefusedError:
            client.close()
            if time.monotonic() > end_s:
                raise
            time.sleep(0.05)
            continue
        stack.enter_context(client)
        if line.wire == TCP:
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return client.fileno()


def _told(pipe: Connection, line: Line) -> int | str:
    """Where our mock says that it is."""
    if not pipe.poll(STARTS_WITHIN_S):
        msg = f"{line.name}: not started in {STARTS_WITHIN_S:g} s"
        raise TimeoutError(msg)
    where: int | str = pipe.recv()
    return where


def ask(fd: int, line: Line) -> None:
    """One exchange, to the answer's last byte."""
    os.write(fd, line.request)
    answer = b""
    while not line.is_answer(answer):
        if not select.select([fd], [], [], ANSWERS_WITHIN_S)[0]:
            msg = f"{line.name}: no whole answer to {line.request!r} in {ANSWERS_WITHIN_S:g} s: {answer!r}"
            raise TimeoutError(msg)
        answer += os.read(fd, 4096)


def exchange(line: Line, duration_s: float) -> list[float]:
    """How long each exchange of that time took, s."""
    here, there = multiprocessing.Pipe()
    context = multiprocessing.get_context("spawn")
    port = free_port()
    if line.is_ours:
        process = context.Process(target=serve, args=(line.start, there))
    else:
        process = context.Process(target=line.start, args=(port,))
    process.start()
    try:
        with ExitStack() as stack:
            fd = connect(line, _told(here, line) if line.is_ours else port, stack)
            os.write(fd, line.before)
            for _ in range(WARM_UP):
                ask(fd, line)
            took_s: list[float] = []
            end_s = time.perf_counter() + duration_s
            while (began_s := time.perf_counter()) < end_s:
                ask(fd, line)
                took_s.append(time.perf_counter() - began_s)
            return took_s
    finally:
        process.terminate()
        process.join(10)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=1.0, help="seconds a device and round")
    parser.add_argument(
        "--rounds", type=int, default=5, help="how often the whole table is gone through"
    )
    arguments = parser.parse_args()
    lines = []
    for line in every_line():
        if line.needs and importlib.util.find_spec(line.needs) is None:
            print(f"{line.needs} is not installed; `make bench-devices` installs it")
        else:
            lines.append(line)
    took_us: dict[Line, list[float]] = {line: [] for line in lines}
    for _ in range(arguments.rounds):
        for line in lines:
            took_us[line] += [1e6 * took_s for took_s in exchange(line, arguments.duration)]
    print(
        f"{'round trip, us':36}{'wire':5}{'count':>8}{'median':>9}{'99 %':>9}{'worst':>9}  median / echo's"
    )
    echo_us: dict[str, float] = {}
    for line in lines:
        median, most, worst = np.percentile(took_us[line], [50, 99, 100])
        echo_us.setdefault(line.wire, median)
        ratio = "" if line.is_paced else f"{median / echo_us[line.wire]:.2f}"
        count = len(took_us[line])
        print(
            f"{line.name:36}{line.wire:5}{count:8}{median:9.0f}{most:9.0f}{worst:9.0f}{ratio:>17}"
        )


if __name__ == "__main__":
    main()
