"""Designs for the star's measured light: another light is another noise of the sensor."""

from __future__ import annotations

from concurrent.futures import Future

from fitctl.config import ConfigError, Rig
from fitctl.controllers.pair import Design
from fitctl.loop.learning import MOST_NOISE_RATIO
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.modes import WITH_WINDOW
from fitctl.stages.journal import Journal, error_text

FIRST_S, EVERY_S = 1.0, 20.0
"""The light is the mean of so long: once the star is found or the design changes, and from then on."""


def noise_ratio(design: Design, noise_px: float) -> float:
    """How far a noise is from the one that a design was made for: the greater over the smaller."""
    ratio = noise_px / float(design.parameters["noise_px"])
    return max(ratio, 1 / ratio)


class Starlight:
    """One loop's.

    Parameters
    ----------
    rig : Rig
    loop : StellarLoop
    journal : Journal
    """

    def __init__(self, rig: Rig, loop: StellarLoop, journal: Journal) -> None:
        self.loop = loop
        self._journal = journal
        self._first = round(FIRST_S / rig.camera.period_s)
        self._every = round(EVERY_S / rig.camera.period_s)
        self._design = loop.pointing.design
        self._remade: Design | None = None  # that is being made again, for another light
        self._begin()

    def _begin(self) -> None:
        self._frames, self._needed, self._sum_dn = 0, self._first, 0.0

    def observe(self) -> float | None:
        """One tick: the noise in px that the loop's design is to be made for, or None if it may stay."""
        loop = self.loop
        if loop.mode not in WITH_WINDOW or loop.pointing.design is not self._design:
            self._design = loop.pointing.design
            self._begin()
            return None
        star = loop.observation.star
        if star is None or self._remade is not None or not self._design.uses_noise:
            return None
        self._frames += 1
        self._sum_dn += star.flux_dn
        if self._frames < self._needed:
            return None
        flux_dn = self._sum_dn / self._frames
        self._frames, self._needed, self._sum_dn = 0, self._every, 0.0
        noise_px = loop.star_finder.noise_px(flux_dn)
        if noise_ratio(self._design, noise_px) <= MOST_NOISE_RATIO:
            return None
        self._remade = self._design
        return noise_px

    def designed(self, noise_px: float, future: Future) -> None:
        """Use the design that was made, unless the loop has another one by now."""
        error, design, before = future.exception(), self.loop.pointing.design, self._remade
        self._remade = None
        if error is not None:
            self._journal.event(
                "warning",
                self.loop.name,
                f"no design for the star's light: {error_text(error, ConfigError)}",
            )
        elif design is before:
            was_px = float(design.parameters["noise_px"])
            why = f"the star's light gives {noise_px:.4f} px of noise, not {was_px:.4f}"
            self.loop.use(future.result(), why, by_itself=True)
