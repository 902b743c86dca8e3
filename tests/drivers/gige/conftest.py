from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from gige_served import IMAGE, Served, camera_settings, mock_settings
from numpy.typing import NDArray

from fitctl.config import GigeMock
from fitctl.drivers.gige.driver import GigeCamera


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    """Start mock cameras: ``serve(render, mock=..., **settings)``."""
    served = []

    def start(
        render: Callable[[float], NDArray[np.uint16]] = lambda _: IMAGE,
        *,
        mock: GigeMock | None = None,
        **changes: Any,
    ) -> Served:
        served.append(Served(camera_settings(**changes), mock or mock_settings(), render))
        return served[-1]

    yield start
    for one in served:
        one.close()


@pytest.fixture
def connect() -> Iterator[Callable[..., GigeCamera]]:
    """Open drivers: ``connect(served, **settings)``."""
    cameras = []

    def start(served: Served, **changes: Any) -> GigeCamera:
        camera = GigeCamera(camera_settings(gvcp_port=served.port, **changes))
        cameras.append(camera)
        camera.open()
        return camera

    yield start
    for camera in cameras:
        camera.close()
