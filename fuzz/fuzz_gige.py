"""GigE Vision's parsers, both sides: any bytes leave driver and mock alive.

The first byte chooses a parser, the rest is for it. Where several packets are wanted, each begins with
the two bytes of its length.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from functools import cache

import numpy as np

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol as p
from fitctl.drivers.gige.discovery import decode_found
from fitctl.drivers.gige.features import unpacked
from fitctl.drivers.gige.stream import FrameAssembler
from fitctl.drivers.interface import DeviceError
from fitctl.mocks.gige.camera import GigeCameraMock

SIZE_PX = 20
ENDPOINT = Endpoint("camera", "fuzz")
CLIENTS = (("127.0.0.1", 40001), ("127.0.0.1", 40002))


def packets(data: bytes) -> Iterator[bytes]:
    """The packets that the bytes are cut into."""
    while len(data) > 2:
        length = int.from_bytes(data[:2], "big") % 1500
        yield data[2 : 2 + length]
        data = data[2 + length :]


def answers(data: bytes) -> None:
    """What the driver reads of GVCP."""
    for decode in (p.decode_answer, p.decode_pending_s, decode_found):
        with contextlib.suppress(p.MalformedPacketError):
            decode(data)
    with contextlib.suppress(p.MalformedPacketError):
        p.decode_xml_url(data.decode("latin-1"))


def description(data: bytes) -> None:
    """The GenICam description as the camera keeps it, zipped or not."""
    with contextlib.suppress(DeviceError):
        unpacked(data, ENDPOINT)


def stream(data: bytes) -> None:
    """What the driver makes of GVSP: each frame that comes out is whole, and numbers ascend."""
    asked: list[p.Resend] = []
    assembler = FrameAssembler(
        SIZE_PX, SIZE_PX, p.PIXEL_FORMATS["Mono16"], 576, ENDPOINT, asked.append
    )
    number = 0
    for packet in packets(data):
        asked.clear()
        with contextlib.suppress(DeviceError):
            frame = assembler.add(memoryview(packet))
            if frame is not None:
                assert frame.number > number, "a frame number that does not ascend"
                assert frame.image.shape == (SIZE_PX, SIZE_PX), "another size"
                number = frame.number
        assembler.ask_again()
        for request in asked:
            # Leader and two of pixels.
            assert 0 <= request.first <= request.last < 3, f"asked for {request}"
    assert assembler.frames + assembler.lost == number, "a frame that is not counted"


@cache
def served() -> tuple[asyncio.AbstractEventLoop, GigeCameraMock]:
    """One mock camera for all inputs, and its event loop."""
    rig = load_rig(default_rig_path())
    _, mocks = rig.mock_parts()
    image = np.zeros((rig.camera.height_px, rig.camera.width_px), np.uint16)
    loop = asyncio.new_event_loop()
    mock = GigeCameraMock(rig.camera, mocks.camera, lambda _: image, port=0)
    loop.run_until_complete(mock.start())
    return loop, mock


def commands(data: bytes) -> None:
    """What the mock takes as GVCP, from a client in control and another; it goes on answering."""

    async def ask() -> None:
        for index, packet in enumerate(packets(data)):
            reply = mock.answer(packet, CLIENTS[index % 2])
            if reply is not None:
                p.decode_answer(reply)
        reply = mock.answer(p.encode_command(p.Command.DISCOVERY, 1), CLIENTS[0])
        assert len(reply or b"") == 8 + p.DISCOVERY_BYTES, "no answer any more"
        for client in CLIENTS:
            release = p.encode_words(p.Register.CONTROL_PRIVILEGE, 0)
            mock.answer(p.encode_command(p.Command.WRITEREG, 1, release), client)

    loop, mock = served()
    loop.run_until_complete(ask())


TARGETS: tuple[Callable[[bytes], None], ...] = (answers, description, stream, commands)


def TestOneInput(data: bytes) -> None:  # noqa: N802 - atheris' name for it
    """Feed one parser; whatever is raised is a finding."""
    if data:
        TARGETS[data[0] % len(TARGETS)](data[1:])


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
