"""The command palette's commands beyond the keys: places on the frame, controllers, tripped interlocks."""

from __future__ import annotations

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, cast

from textual.command import DiscoveryHit, Hit, Hits, Provider

from fitctl.config import CONTROLLERS
from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import AnyCommand, Look, Reset, SetController, SetTarget

if TYPE_CHECKING:
    from fitctl.tui.app import ConsoleApp

_NUMBER = r"[+-]?\d+(?:\.\d*)?"
_PLACES: dict[str, tuple[type[SetTarget | Look], str]] = {
    "target": (SetTarget, "Move the target to"),
    "look": (Look, "Put the window on"),
}
_PLACE = re.compile(rf"\s*({'|'.join(_PLACES)})\s+({_NUMBER})[\s,]+({_NUMBER})\s*", re.IGNORECASE)


def parse_place(query: str) -> tuple[str, SetTarget | Look] | None:
    """What a text such as ``target 24 19.5``, in px, does, and its command; None when it is something else."""
    match = _PLACE.fullmatch(query)
    if match is None:
        return None
    make, does = _PLACES[match[1].lower()]
    az_px, el_px = float(match[2]), float(match[3])
    if not (math.isfinite(az_px) and math.isfinite(el_px)):
        return None
    return f"{does} az {az_px:g}, el {el_px:g} px", make(az_px=az_px, el_px=el_px)


class PlaceProvider(Provider):
    """Offers to move the shown loop's target or window as soon as two numbers are typed."""

    async def discover(self) -> Hits:
        """Tell that the commands exist."""
        for word, (make, _) in _PLACES.items():
            told = f"Type it with two numbers, in px: {word} 24 19.5. {ROWS[make].help}"
            yield DiscoveryHit(f"{word} AZ EL", lambda: None, help=told)

    async def search(self, query: str) -> Hits:
        """Match a complete place."""
        found = parse_place(query)
        if found is not None:
            label, command = found
            app = cast("ConsoleApp", self.app)
            yield Hit(1.0, label, partial(app.give, command), help=ROWS[type(command)].help)


class _ListProvider(Provider):
    """Offers the commands of a list by their names."""

    async def discover(self) -> Hits:
        """All of them."""
        for name, command, told in self._offers():
            yield DiscoveryHit(name, self._give(command), help=told)

    async def search(self, query: str) -> Hits:
        """Those that match."""
        matcher = self.matcher(query)
        for name, command, told in self._offers():
            score = matcher.match(name)
            if score > 0:
                yield Hit(score, matcher.highlight(name), self._give(command), help=told)

    @abstractmethod
    def _offers(self) -> Iterator[tuple[str, AnyCommand, str]]:
        """Name, command and what there is to say about it."""

    def _give(self, command: AnyCommand) -> Callable[[], object]:
        return partial(cast("ConsoleApp", self.app).give, command)


class ControllerProvider(_ListProvider):
    """Offers every controller by name."""

    def _offers(self) -> Iterator[tuple[str, AnyCommand, str]]:
        for name in CONTROLLERS:
            told = "In VERNIER the mirror goes on where it is"
            yield f"controller {name}", SetController(name=name), told


class ResetProvider(_ListProvider):
    """Offers to let go of each tripped interlock of the shown loop."""

    def _offers(self) -> Iterator[tuple[str, AnyCommand, str]]:
        loop = cast("ConsoleApp", self.app).state.loop
        for trip in loop.state.interlocks if loop else []:
            yield f"reset {trip.name}", Reset(name=trip.name), trip.reason
