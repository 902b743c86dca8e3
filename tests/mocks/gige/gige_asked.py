"""A mock camera without a network before it, and what a client says to it."""

from __future__ import annotations

import asyncio
import itertools
import socket
import struct
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.gige import protocol as p
from fitctl.mocks.gige.camera import GigeCameraMock

ME = ("127.0.0.1", 40001)
OTHER = ("127.0.0.1", 40002)
IDS = itertools.cycle(range(1, 65536))


def camera_mock(port: int = 0, **changes: Any) -> GigeCameraMock:
    rig = load_rig(default_rig_path())
    _, mocks = rig.mock_parts()
    settings = mocks.camera.model_copy(update=changes)
    image = np.full((40, 40), 0x1230, np.uint16)
    return GigeCameraMock(rig.camera, settings, lambda _: image, port=port)


@asynccontextmanager
async def started(**changes: Any) -> AsyncIterator[GigeCameraMock]:
    mock = camera_mock(**changes)
    await mock.start()
    try:
        yield mock
    finally:
        await mock.stop()


def ask(
    mock: GigeCameraMock, command: int, payload: bytes = b"", sender: tuple[str, int] = ME
) -> p.AnswerPacket:
    request_id = next(IDS)
    reply = mock.answer(p.encode_command(command, request_id, payload), sender)
    assert reply is not None
    answer = p.decode_answer(reply)
    assert (answer.command, answer.request_id) == (command + 1, request_id)
    return answer


def write(mock: GigeCameraMock, register: int, value: int, sender: tuple[str, int] = ME) -> int:
    return ask(mock, p.Command.WRITEREG, p.encode_words(register, value), sender).status


def read(mock: GigeCameraMock, register: int, sender: tuple[str, int] = ME) -> int:
    answer = ask(mock, p.Command.READREG, p.encode_words(register), sender)
    return p.decode_words(answer.payload)[0] if answer.payload else answer.status


def scenario(
    test: Callable[[GigeCameraMock], Coroutine[Any, Any, None] | None], **changes: Any
) -> None:
    async def run() -> None:
        async with started(**changes) as mock:
            result = test(mock)
            if result is not None:
                await result

    asyncio.run(run())


@asynccontextmanager
async def streaming(mock: GigeCameraMock) -> AsyncIterator[socket.socket]:
    """Control of the camera, and a socket that its stream goes to."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.setblocking(False)
        write(mock, p.Register.CONTROL_PRIVILEGE, p.CONTROL)
        write(mock, p.Register.STREAM_DESTINATION, 0x7F000001)
        write(mock, p.Register.STREAM_PORT, client.getsockname()[1])
        yield client


async def received(client: socket.socket, within_s: float = 5.0) -> bytes:
    return await asyncio.wait_for(asyncio.get_running_loop().sock_recv(client, 10000), within_s)


def resend(mock: GigeCameraMock, request: p.Resend) -> None:
    payload = p.encode_resend(request)
    command = p.encode_command(p.Command.PACKETRESEND, next(IDS), payload, flags=0)
    assert mock.answer(command, ME) is None


def write_double(mock: GigeCameraMock, register: int, value: float) -> None:
    payload = p.encode_words(register) + struct.pack(">d", value)
    assert ask(mock, p.Command.WRITEMEM, payload).status == p.Status.SUCCESS
