"""GVSP at several frame rates: what arrives, when, and what is lost.

The mock camera runs in a process of its own and shows a picture that costs it nothing, the driver in this
one. An interval's error is the time between two frames' completion less the period. Two processes share
the machine with everything else: compare lines of one run only.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import time
from itertools import pairwise
from multiprocessing.connection import Connection

import numpy as np

from fitctl.config import Camera, default_rig_path, load_rig
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import Frame
from fitctl.mocks.event_loop import run_on_time
from fitctl.mocks.gige.camera import GigeCameraMock

RATES_HZ = (50.0, 500.0, 2000.0)


def serve(pipe: Connection) -> None:
    """A mock camera until the pipe says something; tells its port first, and how many were late last."""

    async def run() -> None:
        rig = load_rig(default_rig_path())
        _, mocks = rig.mock_parts()
        camera = rig.camera
        image = np.full((camera.height_px, camera.width_px), 1000, np.uint16)
        mock = GigeCameraMock(camera, mocks.camera, lambda _: image, port=0)
        pipe.send(await mock.start())
        await asyncio.to_thread(pipe.recv)
        pipe.send((mock.acquisition.late_frames, mock.acquisition.worst_late_s))
        await mock.stop()

    run_on_time(run())


def settings(rate_hz: float, port: int) -> Camera:
    """The default rig's camera at another rate, exposed for half of each period."""
    return load_rig(
        default_rig_path(),
        [
            f"camera.frame_rate_hz={rate_hz}",
            f"camera.exposure_s={min(0.01, 0.5 / rate_hz)}",
            f"camera.device.gvcp_port={port}",
        ],
    ).camera


def receive(camera: GigeCamera, duration_s: float) -> list[Frame]:
    """All frames of that time, from the first on."""
    frames: list[Frame] = []
    camera.start()
    end_s = float("inf")
    while time.monotonic() < end_s:
        frame = camera.next_frame(1.0)
        if frame is None:
            break
        frames.append(frame)
        end_s = min(end_s, frame.received_s + duration_s)
    return frames


def measure(rate_hz: float, duration_s: float) -> str:
    """One line of the table."""
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=serve, args=(there,))
    process.start()
    try:
        camera = GigeCamera(settings(rate_hz, here.recv()))
        camera.open()
        try:
            began_s = time.process_time()
            frames = receive(camera, duration_s)
            core = (time.process_time() - began_s) / (frames[-1].received_s - frames[0].received_s)
            counts = camera.counts()
        finally:
            camera.close()
        here.send("stop")
        late, worst_late_s = here.recv()
    finally:
        process.join(10)
        process.kill()
    steps_s = [
        abs(b.received_s - a.received_s - (b.number - a.number) / rate_hz)
        for a, b in pairwise(frames)
    ]
    median, most, worst = 1e6 * np.percentile(steps_s, [50, 99, 100])
    return (
        f"{rate_hz:8.0f}{counts.frames:9}{counts.lost:6}{counts.packets_lost:9}"
        f"{median:10.0f}{most:10.0f}{worst:10.0f}{late:7}{1e3 * worst_late_s:9.1f}{core:8.2f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=20.0, help="seconds at each rate")
    duration_s = parser.parse_args().duration
    print("frames/s   frames  lost  packets    interval error, us         mock late       cores")
    print("                            lost    median      99 %     worst  >2 ms  worst ms  here")
    for rate_hz in RATES_HZ:
        print(measure(rate_hz, duration_s), flush=True)


if __name__ == "__main__":
    main()
