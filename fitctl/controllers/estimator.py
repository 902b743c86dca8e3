"""Where the star falls when no frame shows it: from siderostat encoders and mirror voltages (Eq. 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.model.optics import AzEl, Scales, rows, transformed

Floats = NDArray[np.float64]


class StarEstimator:
    """Remembers where the star would fall with both stages at zero, and adds what the stages do.

    Its error is that of the encoders behind the backlash and of the voltages before the hysteresis:
    about half a pixel, enough to search and to bridge lost frames. Pairs in pixels are plain floats, which
    are several times quicker than arrays.

    Parameters
    ----------
    scale : Scales
    target_px : array, shape (2,)
        Where an unknown star is assumed at the start: on the target.
    """

    def __init__(self, scale: Scales, target_px: Floats) -> None:
        self._scale = scale
        self._motor_px = rows(scale.motor_px_per_rad * scale.siderostat_turn)
        self._mirror_px = rows(scale.mirror_px_per_rad * scale.mirror_turn)
        az_px, el_px = target_px.tolist()
        self._origin_px = az_px, el_px
        self._before_px: AzEl | None = None
        self._expected = False

    def expect(self, star_px: Floats, motor_rad: Floats, mirror_rad: Floats) -> None:
        """:meth:`place` a star of which nothing is known.

        Once: what follows, another search too, expects it where it was expected first.
        """
        if not self._expected:
            self.place(star_px, motor_rad, mirror_rad)

    def place(self, star_px: Floats, motor_rad: Floats, mirror_rad: Floats) -> None:
        """Assume the star at `star_px` with the stages as given; all shapes (2,)."""
        az_px, el_px = star_px.tolist()
        self.observe((az_px, el_px), self.stages_px(motor_rad, mirror_rad))

    def observe(self, star_px: AzEl, stages_px: AzEl) -> None:
        """A frame showed the star at `star_px` with the stages as they were at its exposure."""
        self._origin_px = star_px[0] - stages_px[0], star_px[1] - stages_px[1]
        self._expected = True

    def suppose(self, star_px: AzEl, stages_px: AzEl) -> None:
        """:meth:`observe` what may be another star, until :meth:`keep` or :meth:`withdraw`."""
        if self._before_px is None:
            self._before_px = self._origin_px
        self.observe(star_px, stages_px)

    def keep(self) -> None:
        """It is this loop's star."""
        self._before_px = None

    def withdraw(self) -> None:
        """It is not: the star is expected where it was before."""
        if self._before_px is not None:
            self._origin_px, self._before_px = self._before_px, None

    def forget(self) -> None:
        """The stages' zeros have changed: nothing is known of the star any more."""
        self._expected, self._before_px = False, None

    @property
    def origin_px(self) -> AzEl | None:
        """Where the star falls with both stages at zero; None where nothing is known of it."""
        return (self._before_px or self._origin_px) if self._expected else None

    def predict_px(self, stages_px: AzEl) -> AzEl:
        """Where the star falls with the stages as given."""
        return self._origin_px[0] + stages_px[0], self._origin_px[1] + stages_px[1]

    def motor_for_rad(self, star_px: Floats, mirror_rad: Floats) -> Floats:
        """Motor angles that bring the star to `star_px`, shape (2,)."""
        mirror_px = self._scale.mirror_px(mirror_rad)
        return self._scale.motor_rad(star_px - self._origin_px - mirror_px)

    def stages_px(self, motor_rad: Floats, mirror_rad: Floats) -> AzEl:
        """How far the stages, each shape (2,), move the star."""
        motor_az_px, motor_el_px = transformed(self._motor_px, *motor_rad.tolist())
        mirror_az_px, mirror_el_px = transformed(self._mirror_px, *mirror_rad.tolist())
        return motor_az_px + mirror_az_px, motor_el_px + mirror_el_px
