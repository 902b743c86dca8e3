"""Everything random in a run, from its seed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.model.image.pixel_noise import noise_key
from fitctl.model.optics import scales

Floats = NDArray[np.float64]
_SEEDS_APART = 1000  # of two loops of one run


class RunRandomness(NamedTuple):
    """Everything random in a run, each from a stream of its own.

    Attributes
    ----------
    air : list of Generator
        One for each spot: the first moves all spots, the others what each has besides.
    pixels : int
        Key of the pixel noise.
    place : Generator
        Of the star at the start.
    lines : int
        Key of what drives the vibration lines.
    """

    air: list[np.random.Generator]
    pixels: int
    place: np.random.Generator
    lines: int


def loop_seeds(rig: Rig, seed: int) -> dict[str, int]:
    """The seed of each loop of a run, by name."""
    return {name: seed + _SEEDS_APART * index for index, name in enumerate(rig.loops)}


def run_randomness(seed: int, spots: int) -> RunRandomness:
    """The streams of one run; no stream depends on how much of another is used."""
    air, pixels, place, lines = np.random.SeedSequence(seed).spawn(4)
    return RunRandomness(
        [np.random.default_rng(child) for child in air.spawn(spots)],
        noise_key(pixels),
        np.random.default_rng(place),
        noise_key(lines),
    )


def place_star(rig: Rig, loop_name: str, random: np.random.Generator) -> Floats:
    """A place uniform over the disc of the rig's largest star offset, in pixels from the target."""
    truth, _ = rig.mock_parts()
    largest_arcsec = truth.stellar_loops[loop_name].star_offset_sky_arcsec_max
    arcsec_per_px = scales(rig, rig.stellar_loops[loop_name]).sky_arcsec_per_px
    return disc_place(largest_arcsec, random) / arcsec_per_px


def disc_place(radius: float, random: np.random.Generator) -> Floats:
    """A place uniform over a disc about zero, shape (2,)."""
    distance = radius * np.sqrt(random.uniform())
    angle = random.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)]) * distance
