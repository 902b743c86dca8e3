"""What values of different tables of a rig must agree on: one module a subject.

A check yields a :class:`~fitctl.config.conflict.Conflict` for each contradiction. It names every key that
could be the wrong one, each with what it must be if the others stay.
"""

from __future__ import annotations

from collections.abc import Iterator

from fitctl.config.checks.camera import camera_conflicts
from fitctl.config.checks.collector import collector_conflicts
from fitctl.config.checks.focal_plane import focal_plane_conflicts
from fitctl.config.checks.interlocks import interlock_conflicts
from fitctl.config.checks.mirror import mirror_conflicts
from fitctl.config.checks.places import place_conflicts
from fitctl.config.checks.pointing import pointing_conflicts
from fitctl.config.checks.siderostat import siderostat_conflicts
from fitctl.config.conflict import Conflict
from fitctl.config.rig import Rig

__all__ = ["rig_conflicts"]


def rig_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Everything on which a rig's tables contradict one another."""
    yield from camera_conflicts(rig)
    yield from focal_plane_conflicts(rig)
    yield from siderostat_conflicts(rig)
    yield from mirror_conflicts(rig)
    yield from pointing_conflicts(rig)
    yield from interlock_conflicts(rig)
    yield from collector_conflicts(rig)
    yield from place_conflicts(rig)
