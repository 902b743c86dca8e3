"""The fast steering mirror as far as it is known: from wanted angles to stack voltages, and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Fsm
from fitctl.model.hysteresis import (
    hysteresis_output,
    inverse_model,
    inverse_state,
    play,
    raised_displacement,
)
from fitctl.model.optics import mirror_from_stacks, stack_matrix

Floats = NDArray[np.float64]


class Mirror:
    """Remembers what was written to the D/A, and with it where the mirror is.

    Where the rig file has the stacks' hysteresis, angles are what that model gives for the voltages so
    far, and it can be inverted; otherwise they are Eq. 5's.

    Parameters
    ----------
    fsm : Fsm

    Attributes
    ----------
    stack_v : array, shape (3,)
        As last written.
    angles_rad : array, shape (2,)
        Where the mirror is; replaced as a whole.
    """

    def __init__(self, fsm: Fsm) -> None:
        self._fsm = fsm
        self.stack_matrix = stack_matrix(fsm.stack_radius_m)
        # Eq. 1 and 5, whose matrices are the same at every tick.
        self._stack_v_per_rad = self.stack_matrix / fsm.stack_scale_m_per_v
        self.rad_per_stack_v = np.linalg.pinv(self._stack_v_per_rad)
        known = fsm.hysteresis
        self.hysteresis_known = known is not None
        # Without a model, one play that does nothing.
        self.half_width_v, self.gains_m_per_v, self.zero_m = (
            np.zeros(1),
            np.zeros((3, 1)),
            np.zeros(3),
        )
        if known is not None:
            self.half_width_v = np.asarray(known.half_widths_v)
            self.gains_m_per_v = np.asarray(known.gains_m_per_v)
            # Where stacks rest that came up from zero to their bias: the mirror's zero.
            self.zero_m = raised_displacement(fsm.bias_v, self.half_width_v, self.gains_m_per_v)
            self._slopes_m_per_v = np.cumsum(self.gains_m_per_v, axis=-1)
            self._inverse_half_m, self._inverse_v_per_m = inverse_model(
                self.half_width_v, self.gains_m_per_v
            )
            self._zero_rad = mirror_from_stacks(self.zero_m, fsm.stack_radius_m)
            per_m = mirror_from_stacks(np.eye(3), fsm.stack_radius_m).T
            self._rad_per_play_v = (per_m[..., None] * self.gains_m_per_v).reshape(2, -1)
        self._inverts = False  # the inverse was asked for last
        self.assume(np.full(3, fsm.bias_v))

    def assume(self, stack_v: Floats) -> None:
        """Take the stacks, shape (3,), to have come up to these voltages from zero."""
        self._plays_v = np.zeros_like(self.gains_m_per_v)
        self._written_v: list[float] = []
        self.written(stack_v)

    def written(self, stack_v: Floats) -> None:
        """These voltages, shape (3,), are on the D/A now."""
        written_v = stack_v.tolist()
        if written_v == self._written_v:  # a play that meets the same again stays where it is
            return
        self._written_v = written_v
        self.stack_v = np.array(stack_v, dtype=float)
        if self.hysteresis_known:
            self._plays_v = play(self._plays_v, self.stack_v[:, None], self.half_width_v)
            if (
                self._inverts
            ):  # here, after the D/A has its voltages, and not between a frame and them
                self._prepare_inverse()
        self.angles_rad = self._find_angles()

    def _prepare_inverse(self) -> None:
        self._inverse_plays_m = inverse_state(
            self._plays_v, self.gains_m_per_v, self._slopes_m_per_v
        )

    def _find_angles(self) -> Floats:
        if not self.hysteresis_known:
            return self.rad_per_stack_v @ (self.stack_v - self._fsm.bias_v)
        return self._rad_per_play_v.dot(self._plays_v.ravel()) - self._zero_rad

    def held_rad(self, *, hysteresis_inverse: bool) -> Floats:
        """The angles, shape (2,), for which :meth:`volts_for` leaves the mirror as it is.

        By Eq. 1 these are the angles of ideal stacks at the voltages as they are. Eq. 5 would not do: it
        has the mirror's middle at rest, and voltages that the inverse made have moved it.
        """
        if hysteresis_inverse and self.hysteresis_known:
            return self.angles_rad
        ideal_m = (self.stack_v - self._fsm.bias_v) * self._fsm.stack_scale_m_per_v
        return mirror_from_stacks(ideal_m, self._fsm.stack_radius_m)

    def volts_for(self, mirror_rad: Floats, *, hysteresis_inverse: bool) -> Floats:
        """Voltages, shape (3,), that turn the mirror to `mirror_rad`, shape (2,), within the D/A's range.

        By Eq. 1, or by the exact inverse of the identified hysteresis where asked for and known.
        """
        inverts = hysteresis_inverse and self.hysteresis_known
        if inverts and not self._inverts:
            self._prepare_inverse()
        self._inverts = inverts
        if inverts:
            wanted_m = self.zero_m + self.stack_matrix.dot(mirror_rad)
            plays_m = play(self._inverse_plays_m, wanted_m[:, None], self._inverse_half_m)
            volts = hysteresis_output(plays_m, self._inverse_v_per_m)
        else:
            volts = self._stack_v_per_rad.dot(mirror_rad) + self._fsm.bias_v  # `@` takes longer
        full_scale_v = self._fsm.dac.full_scale_v
        asked_v = volts.tolist()
        if min(asked_v) >= 0.0 and max(asked_v) <= full_scale_v:  # as at nearly every tick
            return volts
        return np.minimum(np.maximum(volts, 0.0), full_scale_v)
