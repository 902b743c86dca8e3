"""The command palette's commands with numbers: places on the frame."""

from __future__ import annotations

import math
import re
from functools import partial
from typing import cast

from textual.command import DiscoveryHit, Hit, Hits, Provider

from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import Look, SetTarget
from fitctl.tui.console import Console

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
        """Show that the commands exist."""
        for word, (make, _) in _PLACES.items():
            text = f"Type it with two numbers, in px: {word} 24 19.5. {ROWS[make].help}"
            yield DiscoveryHit(f"{word} AZ EL", lambda: None, help=text)

    async def search(self, query: str) -> Hits:
        """Match a complete place, or say what is missing."""
        found = parse_place(query)
        if found is not None:
            label, command = found
            console = cast("Console", self.app)
            yield Hit(1.0, label, partial(console.send, command), help=ROWS[type(command)].help)
            return
        word = query.partition(" ")[0].lower()
        if word in _PLACES:
            yield Hit(1.0, f"{word} takes AZ EL in px, such as: {word} 24 19.5", lambda: None)
