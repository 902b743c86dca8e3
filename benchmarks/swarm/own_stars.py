"""Checks of which star a loop follows: its own, and after a wait from where its siderostat is back at it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from benchmarks.swarm.lines import WRONG_S, Line
from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.drivers.interface import AzEl
from fitctl.logging.records import Tick
from fitctl.messages.modes import FOLLOWING
from fitctl.model.plant import Plant
from fitctl.supervisor.supervisor import Supervisor

_FOLLOWING = frozenset(mode.name for mode in FOLLOWING)
_CHECKED_S = 0.5  # so often the swarm checks which star a loop follows
_ANOTHERS_PX = 6.0  # from its own star, no window of a loop shows its own
_RETURNS_PX = 40.0  # the star of a loop that goes on is nearer to the middle of the frame


def turned_by(rig: Rig, name: str) -> list[str]:
    """The loops whose siderostats turn the light of a loop: its own, and that of its link."""
    loop = rig.stellar_loops.get(name)
    return [name] if loop is None or loop.link is None else [name, loop.link]


class OwnStars:
    """Of one supervisor's loops.

    Parameters
    ----------
    rig : Rig
    clock : Clock
    lines : mapping of str to Line
        By device.
    plant : Plant
        Where the stars truly are.
    violated : callable
        Takes an invariant and what violates it.
    """

    def __init__(
        self,
        rig: Rig,
        clock: Clock,
        lines: Mapping[str, Line],
        plant: Plant,
        violated: Callable[[str, str], None],
    ) -> None:
        self._supervisor: Supervisor | None = None
        self._rig = rig
        self._clock = clock
        self._lines = lines
        self._plant = plant
        self._violated = violated
        self._checked_s: dict[str, float] = {}  # by loop: when the swarm last checked its star
        self._wrong_since_s: dict[str, float] = {}  # by loop: since when it follows another star
        self._pointed: set[str] = set()  # a person said which star these loops follow
        self._waits_since_s: dict[str, float] = {}  # by loop that followed its star before

    def watch(self, supervisor: Supervisor | None) -> None:
        """Watch this one's loops from now on."""
        self._supervisor = supervisor
        self._wrong_since_s.clear()
        self._pointed.clear()
        self._waits_since_s.clear()

    def pointed_at(self, name: str) -> None:
        """A person has pointed at the star that a loop is to follow."""
        self._pointed.add(name)

    def searched(self, name: str) -> None:
        """A loop searches for its own star."""
        self._pointed.discard(name)

    def follows(self, tick: Tick) -> None:
        """Whether the star that a loop follows is its own, unless a person pointed at it."""
        name, now_s = tick.loop, tick.mid_exposure_s
        if not now_s - self._checked_s.get(name, -math.inf) >= _CHECKED_S:
            return
        self._checked_s[name] = now_s
        own_az_px, own_el_px = self._own_star_px(name, now_s)
        away_px = math.hypot(tick.star_az_px - own_az_px, tick.star_el_px - own_el_px)
        follows = tick.mode in _FOLLOWING and name not in self._pointed
        # The star of an image that is repeated is where the own one was, and is followed there.
        follows = follows and not self._lines["camera"].was_wrong("frozen", WRONG_S)
        if not (follows and away_px >= _ANOTHERS_PX):  # nor without a star
            self._wrong_since_s.pop(name, None)
            return
        since_s = self._wrong_since_s.setdefault(name, now_s)
        if now_s - since_s > WRONG_S:
            self._violated(
                "a loop follows its own star",
                f"{name}: in {tick.mode} at az {tick.star_az_px:.1f}, el {tick.star_el_px:.1f} px for "
                f"{now_s - since_s:.1f} s; its own is at az {own_az_px:.1f}, el {own_el_px:.1f} px",
            )

    def begins_to_wait(self, name: str) -> None:
        """A loop waits where its stages are."""
        self._waits_since_s.pop(name, None)
        if name not in self._pointed and self._off_frame_px(name) <= _RETURNS_PX:
            self._waits_since_s[name] = self._clock.now_s()

    def goes_on(self, name: str) -> None:
        """Whether a loop that waited has its siderostat back at its star, if it can be there."""
        since_s = self._waits_since_s.pop(name, None)
        away_px = self._off_frame_px(name)
        lost = _RETURNS_PX < away_px < math.inf
        if since_s is None or not lost or self._supervisor is None:
            return
        loop = self._supervisor.stellar_loops[name]
        waited_s = self._clock.now_s() - since_s
        misled = any(
            self._lines[f"{one} siderostat"].was_wrong("encoder", waited_s + WRONG_S)
            for one in turned_by(self._rig, name)
        )
        at_its_end = np.abs(loop.siderostat.setpoint_rad).max() >= loop.siderostat.travel_rad
        is_expected = loop.star_finder.estimator.origin_px is not None
        if is_expected and not (misled or at_its_end or loop.interlocks.holds):
            self._violated(
                "a loop that waited goes on at its star",
                f"{name}: {away_px:.0f} px from it after {waited_s:.1f} s",
            )

    def _off_frame_px(self, name: str) -> float:
        """From the middle of the frame to the own star of a loop; infinite if the loop follows none."""
        if self._supervisor is None or self._supervisor.loops[name].mode not in FOLLOWING:
            return math.inf
        camera = self._rig.camera
        az_px, el_px = self._own_star_px(name, self._clock.now_s())
        return math.hypot(az_px - camera.width_px / 2, el_px - camera.height_px / 2)

    def _own_star_px(self, name: str, time_s: float) -> AzEl:
        """Where the star of a loop truly is on the camera."""
        part = self._plant.stellar_loops[name]
        az_px, el_px = part.spots_at_px(self._plant.row(time_s))[0, 0].tolist()
        return az_px, el_px
