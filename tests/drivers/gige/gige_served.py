"""A mock camera in an event loop of its own thread, and rigs that point at it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Camera, Fault, GigeMock, default_rig_path, load_rig
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import Frame
from fitctl.mocks.gige.camera import GigeCameraMock

IMAGE = np.random.default_rng(1).integers(0, 65536, (40, 40), dtype=np.uint16)


def camera_settings(**changes: Any) -> Camera:
    """The default rig's camera with some settings changed; `device` settings by their own names."""
    camera = load_rig(default_rig_path()).camera
    device = {k: changes.pop(k) for k in list(changes) if k in type(camera.device).model_fields}
    settings = camera.model_dump() | changes
    settings["device"] |= device
    return Camera.model_validate(settings)


def mock_settings(**changes: Any) -> GigeMock:
    """The default rig's mock camera with some settings changed."""
    _, mocks = load_rig(default_rig_path()).mock_parts()
    return mocks.camera.model_copy(update=changes)


def received(camera: GigeCamera, count: int) -> list[Frame]:
    """So many frames, none of which takes longer than any stall of the machine."""
    frames = [camera.next_frame(5.0) for _ in range(count)]
    assert None not in frames
    return [frame for frame in frames if frame is not None]


class Served:
    """A mock that answers at `port`; `call` runs a function in its event loop."""

    def __init__(
        self, camera: Camera, mock: GigeMock, render: Callable[[float], NDArray[np.uint16]]
    ) -> None:
        self.mock = GigeCameraMock(camera, mock, render, port=0)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.port: int = self._run(self.mock.start())

    def call(self, function: Callable[[], Any]) -> Any:
        async def run() -> Any:
            return function()

        return self._run(run())

    def fault(self, kind: str, **settings: Any) -> None:
        fault = Fault(device="camera", kind=kind, **settings)
        self.call(lambda: self.mock.faults.set(fault))

    def mend(self) -> None:
        self.call(self.mock.faults.clear)

    def stop(self) -> None:
        self._run(self.mock.stop())

    def close(self) -> None:
        self.stop()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)
        self._loop.close()

    def _run(self, coroutine: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(5)
