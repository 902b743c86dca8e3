"""A terminal at a mock MDT693, and settings of every dialect that was recorded."""

import asyncio
from contextlib import asynccontextmanager

from fitctl.config import default_rig_path, load_rig
from fitctl.mocks.mdt693.server import Mdt693Mock

RIG = load_rig(default_rig_path())
PIEZO = RIG.loops["right"].fsm.piezo
EXACT = {"readback_offset_v": 0.0, "readback_noise_v": 0.0, "readback_settling_s": 0.0}
SETTINGS = RIG.mocks.loops["right"].mdt693.model_copy(update=EXACT | {"reply_s": 0.0})

A_301 = {"model": "MDT693A", "firmware": "3.01"}
B_105 = {"firmware": "1.05", "prompt": "*", "decimals": 1, "xyzvoltage": False}
B_110 = {"firmware": "1.10", "prompt": ">", "decimals": 2, "xyzvoltage": True}
QUIET = {"echo": False}
COMPATIBLE = B_110 | {"compatibility_mode": True}


class Terminal:
    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer

    async def transcript(self, *exchanges):
        """Each exchange is what is typed, and what must come back, exactly and nothing more."""
        for typed, answer in exchanges:
            self.writer.write(typed)
            got = await asyncio.wait_for(self.reader.readexactly(len(answer)), 5)
            assert (typed, got) == (typed, answer)

    async def hears_nothing(self, typed, within_s=0.15):
        self.writer.write(typed)
        try:
            got = await asyncio.wait_for(self.reader.read(1), within_s)
        except TimeoutError:
            return
        raise AssertionError(f"{got!r}")


@asynccontextmanager
async def amplifier(*variants, **changes):
    outputs = []
    updates = {key: value for variant in variants for key, value in variant.items()} | changes
    mock = Mdt693Mock(
        SETTINGS.model_copy(update=updates),
        PIEZO,
        lambda volts: outputs.append([round(value, 6) for value in volts]),
        port=0,
    )
    try:
        mock.ends = await mock.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", mock.ends.tcp_port)
        yield mock, Terminal(reader, writer), outputs
        writer.close()
    finally:
        await mock.stop()
