"""What each controller did about the disturbance, beside what its design says."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ConfigError, Rig
from fitctl.controllers.design.basis import Basis, basis, night_of
from fitctl.controllers.design.choose import DESIGNS, design_for
from fitctl.controllers.design.files import design_of
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.loopshape import sampled_response
from fitctl.controllers.design.theory import loop_theory
from fitctl.controllers.pair import LEARNT, Design
from fitctl.error_budget import Budget, LoopTheory, budget, motion, regular
from fitctl.figures.attenuation import (
    SEGMENT_S,
    Rebuilt,
    Spectra,
    attenuation,
    mean_spectra,
    mirror_at_exposure_rad,
    spectra,
    stages_px,
)
from fitctl.identify.record import axis_pair
from fitctl.logging.reading import Columns
from fitctl.report.gather import Gathered
from fitctl.report.residual import Estimate, rms_estimate
from fitctl.report.selection import Selection
from fitctl.text import plain, plain_message

Floats = NDArray[np.float64]
AT_HZ = (0.25, 0.5, 1.0, 2.0, 5.0)


class Predicted(NamedTuple):
    """What a design says of itself.

    Attributes
    ----------
    rejection : array, shape (frequencies,)
        Disturbance over error, as amplitudes.
    residual_px, bound_px : float
        What it leaves of the air path that it was made for, linear and true; and the least that any could.
    """

    rejection: Floats
    residual_px: float
    bound_px: float


class Rejection(NamedTuple):
    """One controller's part of a run.

    Attributes
    ----------
    controller : str
    evaluated_s : float
        In pieces long enough for a spectrum.
    spectra : Spectra
        Of error and rebuilt disturbance, the mean of both axes, above frequency zero.
    predicted : Predicted or None
        None where the design cannot be made again; then `why` says why.
    why : str
    budget : Budget or None
        Where the error of all evaluated frames under this controller came from; None without `predicted`.
    """

    controller: str
    evaluated_s: float
    spectra: Spectra
    predicted: Predicted | None
    why: str
    budget: Budget | None

    @property
    def measured(self) -> Floats:
        """Disturbance over error, as amplitudes, shape (frequencies,)."""
        return np.sqrt(self.spectra.disturbance / self.spectra.error)

    def table(self) -> list[tuple[float, float, float]]:
        """Frequency, measured, design's (nan if unknown), up to what the camera resolves."""
        frequency_hz = self.spectra.frequency_hz
        return [
            (
                at_hz,
                attenuation(self.spectra, at_hz),
                math.nan
                if self.predicted is None
                else float(np.interp(at_hz, frequency_hz, self.predicted.rejection)),
            )
            for at_hz in AT_HZ
            if at_hz < 0.9 * frequency_hz[-1]
        ]


class Held(NamedTuple):
    """How well a loop held its star under one controller.

    Attributes
    ----------
    controller : str
    evaluated_s : float
    residual : dict of str to Estimate
        By axis, px.
    """

    controller: str
    evaluated_s: float
    residual: dict[str, Estimate]


def held_by_controller(gathered: Gathered, loop_name: str, selection: Selection) -> list[Held]:
    """One for each controller with frames that are evaluated, in the order of their first use."""
    ticks = gathered.ticks[loop_name]
    error_px = axis_pair(ticks, "error_{}_px")
    found = []
    for title, its in _by_title(gathered, loop_name).items():
        pieces = _within(selection, ticks, its)
        if not pieces:
            continue
        rows = np.concatenate(pieces)
        residual = {
            axis: rms_estimate(error_px[rows, column]) for column, axis in enumerate(("az", "el"))
        }
        found.append(Held(title, len(rows) * gathered.run.rig.camera.period_s, residual))
    return found


def _by_title(gathered: Gathered, loop_name: str) -> dict[str, list[_InForce]]:
    """When each controller was in force, in the order of their first use."""
    found: dict[str, list[_InForce]] = {}
    for one in _in_force(gathered, loop_name):
        found.setdefault(one.title, []).append(one)
    return found


def rejections(gathered: Gathered, loop_name: str, selection: Selection) -> list[Rejection]:
    """One for each controller that was in force long enough, in the order of their first use."""
    rig, ticks = gathered.run.rig, gathered.ticks[loop_name]
    if not selection.pieces:
        return []
    error_px = axis_pair(ticks, "error_{}_px")
    fsm = rig.stellar_loops[loop_name].fsm
    mirror_rad = mirror_at_exposure_rad(fsm, ticks)
    disturbance_px = error_px - stages_px(rig, loop_name, ticks)
    period_s = rig.camera.period_s
    found = []
    for title, its in _by_title(gathered, loop_name).items():
        its_spectra, segments, seconds = [], [], 0.0
        pieces = _within(selection, ticks, its)
        for piece in pieces:
            time_s = ticks["mid_exposure_s"][piece]
            if time_s[-1] - time_s[0] < SEGMENT_S:
                continue
            both = np.hstack([error_px[piece], disturbance_px[piece]])
            both = regular(time_s, both, period_s)
            series = Rebuilt(time_s[0] + period_s * np.arange(len(both)), both[:, :2], both[:, 2:])
            its_spectra.append(spectra(series, period_s))
            seconds += len(both) * period_s
            segments.append(2 * len(both) * period_s / SEGMENT_S - 1)
        if its_spectra:
            # Not at rest, where the siderostat integrates and a logarithm ends.
            measured = Spectra(*(of[1:] for of in mean_spectra(its_spectra, segments)))
            predicted, theory, why = _predicted(gathered, loop_name, its, measured.frequency_hz)
            its_budget = (
                None
                if theory is None
                else budget(theory, ticks, motion(theory, ticks, mirror_rad), pieces)
            )
            found.append(Rejection(title, seconds, measured, predicted, why, its_budget))
    return found


def last_design(gathered: Gathered, loop_name: str) -> Design:
    """The design that drove a loop at the end of a run.

    Raises
    ------
    ConfigError
        If its matrices are not in the log and cannot be made again.
    """
    its = _last_in_force(gathered, loop_name)
    return _design(gathered, loop_name, its, basis(gathered.run.rig, loop_name))


def under_last_design(gathered: Gathered, loop_name: str) -> NDArray[np.bool_]:
    """Whether :func:`last_design` was in force, shape (ticks,)."""
    time_s = gathered.ticks[loop_name]["time_s"]
    its = _last_in_force(gathered, loop_name)
    return np.any([(time_s >= one.begin_s) & (time_s < one.end_s) for one in its], axis=0)


class _InForce(NamedTuple):
    """A controller while it was in force; from the second learnt one on, their titles have numbers."""

    begin_s: float
    end_s: float
    title: str
    name: str
    design: str


def _in_force(gathered: Gathered, loop_name: str) -> list[_InForce]:
    """What was in force, in order, from the run's description and its changes."""
    first = _first_design(gathered, loop_name)
    changes = [change for change in gathered.changes if change["loop"] == loop_name]
    vernier = gathered.run.rig.stellar_loops[loop_name].vernier
    logged_name = _parsed(first).get("name", vernier.controller)
    begins = [(-math.inf, str(changes[0]["source"] if changes else logged_name), first)]
    begins += [
        (change["time_s"], str(change["target"]), str(change.get("design_json") or ""))
        for change in changes
    ]
    ends = [begin_s for begin_s, _, _ in begins[1:]] + [math.inf]
    found, numbers = [], dict[str, int]()
    for (begin_s, its, design), end_s in zip(begins, ends, strict=True):
        number = numbers.setdefault(design, len(numbers) + 1) if its == LEARNT else 1
        title = its if number == 1 else f"{its} ({number})"
        found.append(_InForce(begin_s, end_s, plain(title), plain(its), design))
    return found


def _last_in_force(gathered: Gathered, loop_name: str) -> list[_InForce]:
    every = _in_force(gathered, loop_name)
    return [one for one in every if one.title == every[-1].title]


def _within(
    selection: Selection, ticks: Columns, its: Iterable[_InForce]
) -> list[NDArray[np.intp]]:
    pieces = []
    for piece in selection.pieces:
        time_s = ticks["time_s"][piece]
        for one in its:
            inside = piece[(time_s >= one.begin_s) & (time_s < one.end_s)]
            if len(inside) > 1:
                pieces.append(inside)
    return pieces


def _predicted(
    gathered: Gathered, loop_name: str, its: Sequence[_InForce], frequency_hz: Floats
) -> tuple[Predicted | None, LoopTheory | None, str]:
    try:
        its_basis = basis(gathered.run.rig, loop_name)
        design = _design(gathered, loop_name, its, its_basis)
        its_basis = night_of(design, its_basis)
    except ConfigError as error:
        return None, None, str(error)
    rejection = np.abs(1 + sampled_response(design, its_basis)(2 * math.pi * frequency_hz))
    least_px = bound(its_basis).residual_px
    predicted = Predicted(rejection, linear_residual(design, its_basis), least_px)
    return predicted, loop_theory(gathered.run.rig, loop_name, design), ""


def _first_design(gathered: Gathered, loop_name: str) -> str:
    """The design with which a loop began, as it was logged."""
    return str(gathered.run.metadata.get("designs", {}).get(loop_name) or "")


def _design(
    gathered: Gathered, loop_name: str, its: Sequence[_InForce], its_basis: Basis
) -> Design:
    """As it was logged, of several of one title the last; one that was not logged is made again by its name."""
    rig: Rig = gathered.run.rig
    name, first = its[-1].name, _first_design(gathered, loop_name)
    logged = _parsed(next((one.design for one in reversed(its) if one.design), first))
    if _title(logged) == name:
        design = design_of(logged, gathered.run.logs[-1].path, its_basis, DESIGNS)
        return dataclasses.replace(design, learnt=name == LEARNT)
    if name not in DESIGNS:  # a text of the log, which must never become a path
        msg = f"{name}: its matrices are not in the log"
        raise ConfigError(msg)
    return design_for(rig, loop_name, name)


def _parsed(text: str) -> dict[str, Any]:
    """A logged design, its texts made printable; empty if it is none that this fitctl wrote."""
    try:
        logged = plain_message(json.loads(text or "{}", parse_int=float))
    except (ValueError, RecursionError):
        return {}
    return logged if isinstance(logged, dict) else {}


def _title(logged: Mapping[str, Any]) -> str:
    """What people call a logged design."""
    return LEARNT if logged.get("learnt") else str(logged.get("name", ""))
