"""The vernier/coarse pair: mirror and siderostat, driven together from the star's error (Figs. 8 and 10).

A design is data: one linear system, the same for both axes, at the loop's rate. Everything that is not
linear is here, once for all designs: the mirror's diamond, and the deadzone feedback about it.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.model.optics import AzEl, Scales, rows, saturate_diamond, transformed

Floats = NDArray[np.float64]

HAND_OVER_S = 10.0
"""Time constant with which the siderostat takes over what a design found the mirror holding (choice)."""

LEAST_EXCESS_PX = 1e-9
"""A wanted mirror angle that passes the diamond by less has only been rounded."""

LEARNT: Final = "learnt"
"""The controller that stands for the design that was learnt last."""
_NO_EXCESS = np.zeros(2)
INPUTS = ("error_px", "excess_px", "mirror_px", "motor_px", "target_px")
OUTPUTS = ("mirror_px", "motor_step_px")


@dataclass(frozen=True)
class Design:
    """A vernier/coarse pair: x+ = A x + B u, y = C x + D u, for each axis.

    Inputs u, of the frame in hand:

    - ``error_px``: star less target;
    - ``excess_px``: by how much the last wanted mirror angle passed the diamond (Fig. 10);
    - ``mirror_px``: where the mirror had moved the star at mid-exposure;
    - ``motor_px``: where the siderostat's encoders had, from where the pair was started;
    - ``target_px``: the target, from where it was when the pair was started.

    Outputs y: ``mirror_px``, where the mirror shall move the star until the next write of the D/A;
    ``motor_step_px``, by how much the siderostat's set-point moves it; then ``mirror_px`` of each further write
    before the next frame's command, if there are any. Writes are at equal intervals.

    Attributes
    ----------
    name : str
        eq20, lqg-ltr, minimum-variance, fslq, or that of a file of the user's.
    period_s, delay_s : float
        Of the loop that it was made for: frame period, and mid-exposure to command.
    a, b, c, d : arrays, shapes (n, n), (n, 5), (1 + writes, n), (1 + writes, 5)
    hysteresis_inverse : bool
        Whether stack voltages go through the inverse of the identified hysteresis.
    parameters : dict
        Everything that it was made from; with the name, enough to make it again.
    file : str
        The file that it was read from, absolute; empty when it was made from the rig's values.
    learnt : bool
        Made for a night that was learnt from a loop's own frames.
    own : bool
        Made by a Python file of the user's (:mod:`fitctl.controllers.design.own`): its matrices are all that
        there is to it.

    Examples
    --------
    >>> from fitctl.config import default_rig_path, load_rig
    >>> from fitctl.controllers.design.choose import design_for
    >>> design = design_for(load_rig(default_rig_path()), "right", "minimum-variance")
    >>> design.a.shape, design.b.shape, design.c.shape, design.d.shape
    ((5, 5), (5, 5), (2, 5), (2, 5))
    >>> design.period_s
    0.02
    """

    name: str
    period_s: float
    delay_s: float
    a: Floats = field(repr=False)
    b: Floats = field(repr=False)
    c: Floats = field(repr=False)
    d: Floats = field(repr=False)
    hysteresis_inverse: bool
    parameters: dict[str, Any] = field(repr=False)
    file: str = ""
    learnt: bool = False
    own: bool = False

    @property
    def writes(self) -> int:
        """Of the D/A, in a frame period."""
        return len(self.d) - 1

    @functools.cached_property
    def digest(self) -> str:
        """Of all that it computes with: two designs with one digest do the same."""
        digest = hashlib.sha256(
            f"{self.period_s} {self.delay_s} {self.hysteresis_inverse}".encode()
        )
        for matrix in (self.a, self.b, self.c, self.d):
            digest.update(f"{matrix.shape}".encode() + np.ascontiguousarray(matrix).tobytes())
        return digest.hexdigest()

    @property
    def title(self) -> str:
        """What people call it: its name, or `LEARNT`."""
        return LEARNT if self.learnt else self.name

    @property
    def uses_noise(self) -> bool:
        """Whether another noise of the sensor makes another design: of the shipped ones, if it predicts."""
        by_itself = not (self.learnt or self.own or self.file)
        return by_itself and self.name in {"minimum-variance", "fslq"}


def mirror_outputs(writes: int) -> list[int]:
    """Which outputs of a design with so many writes are the mirror's, in their order in time."""
    return [0, *range(len(OUTPUTS), writes + 1)]


class Designer(Protocol):
    """Makes designs of a rig's loops."""

    def __call__(
        self, rig: Rig, loop_name: str, controller: str, noise_px: float | None = None, /
    ) -> Design:
        """By the controller's name or file, or by the parameters of a learnt design.

        For the last there is :func:`fitctl.controllers.design.document.parameters_json`. An empty `controller`
        is that of the rig file; `noise_px` is the sensor's noise, by default for the light of the rig file.

        Raises
        ------
        ConfigError
            If there is no such design, or it cannot be used with this rig.
        """


class Measurement(NamedTuple):
    """Star and stages at one frame: pairs in pixels from the frame, shapes (2,) in radians from the stages."""

    error_px: AzEl
    target_px: AzEl
    mirror_rad: Floats
    motor_rad: Floats


class PairCommand(NamedTuple):
    """What both stages shall do until the next frame's command.

    Attributes
    ----------
    mirror_rad, motor_step_rad : arrays, shape (2,)
        Mirror angles on the diamond, and the step of the motors' set-point.
    later_rad : tuple of array, shape (2,)
        Mirror angles of the writes that follow, on the diamond too.
    """

    mirror_rad: Floats
    motor_step_rad: Floats
    later_rad: tuple[Floats, ...] = ()


class Pair:
    """A design at work on both axes.

    Parameters
    ----------
    design : Design
    scale : Scales
    range_rad : float
        phi_max: |az| + |el| of the mirror.
    """

    def __init__(self, design: Design, scale: Scales, range_rad: float) -> None:
        self.design = design
        self._scale = scale
        self._range_rad = range_rad
        self.at_rest = rest_state(design)
        self.left_at_rest = left_at_rest(design, self.at_rest)
        self._later = len(OUTPUTS) + len(design.a) + 1  # the first row of the writes that follow
        self.system = self._in_rad()
        self._mirror_turn = rows(scale.mirror_turn)
        self._siderostat_turn = rows(scale.siderostat_turn)
        self._given = np.zeros((self.system.shape[1], 2))
        self._inputs = self._given[: len(INPUTS)].reshape(-1)  # a view: az and el of each
        self.start(np.zeros(2), np.zeros(2), (0.0, 0.0))

    def start(self, mirror_rad: Floats, motor_rad: Floats, target_px: AzEl) -> None:
        """Begin as if the mirror had long been held at `mirror_rad`, so that it goes on without a bump.

        What a design does not hold by itself without an error (Eq. 20 holds nothing so) is added to its
        command, and handed over to the siderostat little by little.
        """
        mirror_px = self._scale.mirror_px(mirror_rad)
        self._given[len(INPUTS) : -1] = np.outer(self.at_rest, mirror_px)
        self._given[-1] = mirror_px * self.left_at_rest
        self.excess_px = np.zeros(2)
        self.motor_origin_rad = np.array(motor_rad, dtype=float)
        self.target_origin_px = target_px

    @property
    def state(self) -> Floats:
        """Of both axes, shape (n + 1, 2): the design's, and last what it found held."""
        return self._given[len(INPUTS) :]

    @property
    def holds_by_itself(self) -> bool:
        """At rest, the design commands what it measures of the mirror: all that it remembers was measured."""
        return abs(self.left_at_rest) < 0.1

    def start_knowing(self, recent: Sequence[Measurement]) -> None:
        """Begin in the state to which recent frames bring it, as if it had watched them.

        For a design that holds by itself. The frames are in their order and without gaps.
        """
        first = recent[0]
        self.start(first.mirror_rad, first.motor_rad, first.target_px)
        for measured in recent:
            self._advance(measured)

    @property
    def saturated(self) -> bool:
        """The last wanted mirror angle was outside the diamond."""
        az_px, el_px = self.excess_px.tolist()
        return max(abs(az_px), abs(el_px)) > LEAST_EXCESS_PX

    def step(self, measured: Measurement) -> PairCommand:
        """One period."""
        scale, made = self._scale, self._advance(measured)
        wanted_rad = made[0].dot(scale.mirror_back.T)
        mirror_rad = saturate_diamond(wanted_rad, self._range_rad)
        # Fed back a frame later, where the camera takes nearly two: much as the error would have been
        # had the mirror followed.
        within = mirror_rad is wanted_rad
        self.excess_px = _NO_EXCESS if within else scale.mirror_px(wanted_rad - mirror_rad)
        later_rad = tuple(
            saturate_diamond(row.dot(scale.mirror_back.T), self._range_rad)
            for row in made[self._later :]
        )
        return PairCommand(mirror_rad, made[1].dot(scale.siderostat_back.T), later_rad)

    def _advance(self, measured: Measurement) -> Floats:
        """One period of the linear system: the first outputs, its next state, and the other writes' outputs."""
        given = self._given
        # The design's axes are the camera's; the stages' may be turned from them.
        motor_az_rad, motor_el_rad = measured.motor_rad.tolist()
        origin_az_rad, origin_el_rad = self.motor_origin_rad.tolist()
        target_az_px, target_el_px = measured.target_px
        origin_az_px, origin_el_px = self.target_origin_px
        self._inputs[:] = (
            *measured.error_px,
            *self.excess_px.tolist(),
            *transformed(self._mirror_turn, *measured.mirror_rad.tolist()),
            *transformed(
                self._siderostat_turn, motor_az_rad - origin_az_rad, motor_el_rad - origin_el_rad
            ),
            target_az_px - origin_az_px,
            target_el_px - origin_el_px,
        )
        made = self.system.dot(given)  # `@` takes twice as long
        given[len(INPUTS) :] = made[len(OUTPUTS) : self._later]
        return np.asarray(made)

    def _in_rad(self) -> Floats:
        """The design with its hand-over, but the stages in radians, as they are measured and commanded."""
        system, scale = self._with_hand_over(), self._scale
        system[:, INPUTS.index("mirror_px")] *= scale.mirror_px_per_rad
        system[:, INPUTS.index("motor_px")] *= scale.motor_px_per_rad
        system[OUTPUTS.index("mirror_px")] /= scale.mirror_px_per_rad
        system[OUTPUTS.index("motor_step_px")] /= scale.motor_px_per_rad
        system[self._later :] /= scale.mirror_px_per_rad
        return system

    def _with_hand_over(self) -> Floats:
        """The design and, as one more state, what it found held: in a tick one product costs least."""
        design, kept = self.design, math.exp(-self.design.period_s / HAND_OVER_S)
        none = np.zeros((len(design.a), 1))
        first = len(OUTPUTS)
        system = np.block(
            [
                [design.d[:first], design.c[:first], np.array([[1.0], [1.0 - kept]])],
                [design.b, design.a, none],
                [np.zeros((1, len(INPUTS))), none.T, np.full((1, 1), kept)],
            ]
        )
        later = np.hstack([design.d[first:], design.c[first:], np.ones((design.writes - 1, 1))])
        return np.vstack([system, later])


def rest_state(design: Design) -> Floats:
    """The state in which a design rests while the mirror is held at one pixel, shape (n,).

    x with x = A x + B u for u = (0, 0, 1, 0, 0): no error, and the mirror where it is.
    """
    mirror = INPUTS.index("mirror_px")
    rest = np.eye(len(design.a)) - design.a
    solution, *_ = np.linalg.lstsq(rest, design.b[:, mirror], rcond=None)
    return np.asarray(solution, dtype=float)


def left_at_rest(design: Design, at_rest: Floats) -> float:
    """What a design at rest does not command of the one pixel at which the mirror is held."""
    mirror = INPUTS.index("mirror_px")
    return float(1.0 - design.c[0] @ at_rest - design.d[0, mirror])
