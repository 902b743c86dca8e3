"""Runs a command beside a mock camera, in a network namespace of its own where discovery reaches nobody.

Its one argument is JSON: see :class:`Order`.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np

from fitctl.config import Fault, default_rig_path, load_rig
from fitctl.mocks.gige.camera import GigeCameraMock

SETTLE_S = 0.2  # the capture writes what it has taken


class Order(msgspec.Struct):
    """What to run.

    Attributes
    ----------
    command : list of str
        Its exit status is ours.
    mock : bool
        Whether the default rig's mock camera answers.
    beside : list of str
        A program that runs meanwhile.
    faults : list of dict
        Of the mock, each at its time from the start.
    capture : str
        A file for all packets; empty for none.
    """

    command: list[str]
    mock: bool = True
    beside: list[str] = []
    faults: list[dict] = []
    capture: str = ""


def image() -> np.ndarray:
    """What the mock shows."""
    return np.arange(1600, dtype=np.uint16).reshape(40, 40) * 40


async def main(order: Order) -> int:
    rig = load_rig(default_rig_path())
    _, mocks = rig.mock_parts()
    mock = GigeCameraMock(rig.camera, mocks.camera, lambda _: image(), port=3956)
    if order.mock:
        await mock.start()
    for settings in order.faults:
        fault = Fault(device="camera", **settings)
        asyncio.get_running_loop().call_later(fault.at_s, mock.faults.set, fault)
    others = []
    if order.capture:
        capturing = ["tshark", "-Q", "-i", "lo", "-s", "0", "-w", order.capture]
        others.append(await asyncio.create_subprocess_exec(*capturing))
        while not Path(order.capture).exists() or not Path(order.capture).stat().st_size:
            await asyncio.sleep(0.05)
    if order.beside:
        silent = subprocess.DEVNULL
        others.append(await asyncio.create_subprocess_exec(*order.beside, stdout=silent))
    try:
        running = await asyncio.create_subprocess_exec(*order.command)
        return await running.wait()
    finally:
        await asyncio.sleep(SETTLE_S)
        for other in others:
            other.send_signal(signal.SIGINT)
            await other.wait()
        await mock.stop()


if __name__ == "__main__":
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    os.umask(0o077)
    sys.exit(asyncio.run(main(msgspec.json.decode(sys.argv[1], type=Order))))
