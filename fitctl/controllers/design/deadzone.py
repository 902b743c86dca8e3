"""The mirror's limit inside the loop (Fig. 10): bounded, and without a swing of its own.

The mirror gives u - q where u was wanted: q is what passes its range. All else is linear, so the loop is
one transfer function M from q to u, closed by the deadzone q = dz(u). Both axes share the diamond, yet
q is always u scaled by one number from 0 to 1, so what holds for one axis holds for the pair:

- describing function: a deadzone's is real and from 0 to 1, so the loop can swing by itself only where
  M crosses the real axis at or above 1;
- circle criterion: where M is stable and its real part stays below 1 at all frequencies, every course
  of the loop is bounded and comes to rest, whatever saturates and for how long.

References: Khalil, Nonlinear Systems (3rd edition), 7.1 and 7.2; for sampled loops, Tsypkin's criterion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.sampled import sampled_loop, timing, write_at_exposure
from fitctl.controllers.pair import Design

Floats = NDArray[np.float64]


class DeadzoneResult(NamedTuple):
    """What the mirror's limit does to a loop.

    Attributes
    ----------
    largest_real : float
        Largest real part of M: bounded and at rest in the end if below 1; infinite where the loop is
        unstable without any limit, so that neither criterion applies.
    largest_crossing : float
        Largest real value at which M crosses the real axis: no limit cycle if below 1.
    at_hz : float
        Where the real part is largest.
    """

    largest_real: float
    largest_crossing: float
    at_hz: float

    @property
    def bounded(self) -> bool:
        """The circle criterion holds."""
        return self.largest_real < 1.0

    @property
    def limit_cycle(self) -> bool:
        """The describing function has a solution."""
        return self.largest_crossing >= 1.0


def deadzone_response(design: Design, basis: Basis, omega_rad_s: Floats) -> NDArray[np.complex128]:
    """M: from what passed the mirror's range to the mirror angle wanted, in the closed loop."""
    loop = sampled_loop(design, basis)
    frames, walked = timing(basis.period_s, basis.delay_s)
    n = len(loop.a)
    own = n - len(design.a)
    # One more state: what passed the range a frame ago, which is an input of the design.
    a, b = np.zeros((n + 1, n + 1)), np.zeros((n + 1, 1))
    a[:n, :n] = loop.a + np.outer(loop.b, loop.star)
    # Into the newest mirror command, and the siderostat's.
    a[0, n], a[frames, n] = design.d[[write_at_exposure(design, walked), 1], 1]
    a[own:n, n] = design.b[:, 1]
    b[0], b[n] = -1.0, 1.0
    wanted = np.append(loop.command[0] + loop.command_error[0] * loop.star, design.d[0, 1])
    z = np.exp(1j * omega_rad_s * basis.period_s)[:, None, None]
    return np.asarray(np.linalg.solve(z * np.eye(n + 1) - a, b)[..., 0] @ wanted, complex)


def deadzone_result(design: Design, basis: Basis) -> DeadzoneResult:
    """Describing function and circle criterion for a design in its loop."""
    if not sampled_loop(design, basis).stable:
        return DeadzoneResult(largest_real=math.inf, largest_crossing=math.inf, at_hz=math.nan)
    # The lowest frequency is as good as rest; the highest is where sampling ends.
    omega = np.append(np.geomspace(1e-5, math.pi, 20_000, endpoint=False), math.pi) / basis.period_s
    response = deadzone_response(design, basis, omega)
    largest = int(response.real.argmax())
    turns = np.flatnonzero(np.diff(np.sign(response.imag)))
    crossings = np.concatenate(
        [response.real[turns], response.real[turns + 1], response.real[[0, -1]]]
    )
    return DeadzoneResult(
        largest_real=float(response.real[largest]),
        largest_crossing=float(crossings.max()),
        at_hz=float(omega[largest]) / (2 * math.pi),
    )
