"""Checks of the zeros that encoders count from: what an opening notices, and what it keeps."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from benchmarks.swarm.lines import WRONG_S, Line
from fitctl.clock import Clock
from fitctl.logging.records import DevicesOpened
from fitctl.supervisor.supervisor import Supervisor

_LEFT_S = 2.0  # a supervisor leaves where its stars are once a second
_JUMP_RAD = 1.0  # what motors may coast unseen, and somewhat more


class Zeros:
    """Of the encoders of all loops.

    Parameters
    ----------
    clock : Clock
    lines : mapping of str to Line
        By device.
    violated : callable
        Takes an invariant and what violates it.
    """

    def __init__(
        self, clock: Clock, lines: Mapping[str, Line], violated: Callable[[str, str], None]
    ) -> None:
        self._supervisor: Supervisor | None = None
        self._clock = clock
        self._lines = lines
        self._violated = violated
        self._lost_rad: dict[str, float] = {}  # by loop, until an opening reads the encoders
        self._read_rad: dict[str, float] = {}  # by loop: read, in an opening that goes on
        self._noticed_s: dict[str, float] = {}
        self._misread: set[str] = set()  # loops whose encoders may have been read wrongly

    def watch(self, supervisor: Supervisor | None) -> None:
        """Watch the openings of this one from now on."""
        self._lost_rad = self._read_rad | self._lost_rad
        self._read_rad.clear()
        for name, noticed_s in self._noticed_s.items():
            # A killed supervisor may have left the star's place from before it noticed.
            if self._clock.now_s() - noticed_s < _LEFT_S:
                self._lost_rad.setdefault(name, 0.0)
        self._supervisor = supervisor

    def lost(self, name: str) -> None:
        """A loop's encoders begin anew at zero."""
        position_rad = 0.0
        if self._supervisor is not None:
            position_rad = float(np.abs(self._supervisor.loops[name].servo.position_rad).max())
        self._lost_rad[name] = max(position_rad, self._lost_rad.get(name, 0.0))

    def is_lost(self, name: str) -> bool:
        """A loop's encoders count from elsewhere, and no opening has noticed."""
        return name in self._lost_rad or name in self._read_rad

    def encoder_wrong(self, name: str) -> None:
        """An encoder of a loop reads wrong angles from now on."""
        self._misread.add(name)

    def read(self, name: str) -> None:
        """A loop's encoders are read for the first time since its amplifiers were opened."""
        lost_rad = self._lost_rad.pop(name, None)
        if lost_rad is not None:
            self._read_rad[name] = max(lost_rad, self._read_rad.get(name, 0.0))

    def opened(self, opened: DevicesOpened, *, again: bool) -> None:
        """The devices of a loop have been opened, perhaps `again` by the same supervisor."""
        name = opened.loop
        # Encoders that lost their zero after this opening had read them are noticed by the next.
        lost_rad = self._read_rad.pop(name, None)
        if lost_rad is not None:
            self._noticed_s[name] = self._clock.now_s()
        # This opening's reading, or the last before it, may have been wrong.
        if name in self._misread:
            if not self._lines[f"{name} siderostat"].was_wrong("encoder", WRONG_S):
                self._misread.discard(name)
            return
        if opened.encoders_jumped and lost_rad is None and not self._reads_zero(name):
            self._violated("encoders that count on keep the star's place", name)
        is_far = lost_rad is not None and lost_rad > _JUMP_RAD and again
        if is_far and not opened.encoders_jumped:
            self._violated("encoders that count from elsewhere are noticed", name)

    def _reads_zero(self, name: str) -> bool:
        """Encoders near zero: motors that passed there look the same as a loss of power."""
        supervisor = self._supervisor
        return supervisor is not None and bool(
            np.abs(supervisor.loops[name].servo.position_rad).max() < _JUMP_RAD / 2
        )
