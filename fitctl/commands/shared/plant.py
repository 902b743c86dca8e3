"""Checks of a rig's simulated hardware."""

from __future__ import annotations

import numpy as np

from fitctl.config import Rig
from fitctl.model.plant_constants import plant_constants


def require_plant(rig: Rig) -> None:
    """Reject a rig without simulated hardware, or with some that cannot be.

    Raises
    ------
    ConfigError
        If so.
    """
    rig.mock_parts()
    check_plant(rig)


def check_plant(rig: Rig) -> None:
    """See that the rig's simulated hardware, if it has any, can be.

    Raises
    ------
    ConfigError
        If not.
    """
    if rig.plant is not None:
        for name in rig.stellar_loops:
            plant_constants(rig, name, np.zeros((1, 2)))
