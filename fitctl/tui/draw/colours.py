"""Colour maps: even steps of lightness, which people of every colour vision read the same way."""

from __future__ import annotations

from functools import cache

import numpy as np

LEVELS = 32

# Anchors at even steps of matplotlib's maps of these names (CC0).
ANCHORS = {
    "inferno": "000004 160b39 420a68 6a176e 932667 bc3754 dd513a f37819 fca50a f6d746 fcffa4",
    "viridis": "440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725",
    "cividis": "00224e 083370 35456c 4f576c 666970 7d7c78 948e77 aea371 c8b866 e5cf52 fee838",
    "grey": "000000 ffffff",
}


@cache
def colour_map(name: str) -> tuple[str, ...]:
    """`LEVELS` colours from dark to bright."""
    anchors = np.array([list(bytes.fromhex(c)) for c in ANCHORS[name].split()], dtype=float)
    places = np.linspace(0, len(anchors) - 1, LEVELS)
    channels = [np.interp(places, np.arange(len(anchors)), anchors[:, i]) for i in range(3)]
    return tuple(
        f"#{int(r):02x}{int(g):02x}{int(b):02x}" for r, g, b in zip(*channels, strict=True)
    )
