"""Where the star falls when no frame shows it: from siderostat encoders and mirror voltages (Eq. 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.model.optics import Scales

Floats = NDArray[np.float64]


class StarEstimator:
    """Remembers where the star would fall with both stages at zero, and adds what the stages do.

    Its error is that of the encoders behind the backlash and of the voltages before the hysteresis:
    about half a pixel, enough to search and to bridge lost frames.

    Parameters
    ----------
    scale : Scales
    target_px : array, shape (2,)
        Where an unknown star is assumed at the start: on the target.
    """

    def __init__(self, scale: Scales, target_px: Floats) -> None:
        self._scale = scale
        self._origin_px = target_px.copy()
        self._expected = False

    def expect(self, star_px: Floats, motor_rad: Floats, mirror_rad: Floats) -> None:
        """:meth:`place` a star of which nothing is known.

        Once: what follows, another search too, expects it where it was expected first.
        """
        if not self._expected:
            self.place(star_px, motor_rad, mirror_rad)

    def place(self, star_px: Floats, motor_rad: Floats, mirror_rad: Floats) -> None:
        """Assume the star at `star_px` with the stages as given; all shapes (2,)."""
        self.observe(star_px, self.stages_px(motor_rad, mirror_rad))

    def observe(self, star_px: Floats, stages_px: Floats) -> None:
        """A frame showed the star at `star_px` with the stages as they were at its exposure."""
        self._origin_px = star_px - stages_px
        self._expected = True

    def forget(self) -> None:
        """The stages' zeros have changed: nothing is known of the star any more."""
        self._expected = False

    def predict_px(self, stages_px: Floats) -> Floats:
        """Where the star falls with the stages as given, shape (2,)."""
        return self._origin_px + stages_px

    def motor_for_rad(self, star_px: Floats, mirror_rad: Floats) -> Floats:
        """Motor angles that bring the star to `star_px`, shape (2,)."""
        mirror_px = self._scale.mirror_px(mirror_rad)
        return self._scale.motor_rad(star_px - self._origin_px - mirror_px)

    def stages_px(self, motor_rad: Floats, mirror_rad: Floats) -> Floats:
        """How far the stages, each shape (2,), move the star, shape (2,)."""
        return self._scale.motor_px(motor_rad) + self._scale.mirror_px(mirror_rad)
