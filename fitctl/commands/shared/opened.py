"""A loop of a logged run, opened on paper: what would have moved its star with the stages at rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fitctl.controllers.design.theory import loop_theory
from fitctl.controllers.pair import Design
from fitctl.error_budget import pieces_of
from fitctl.figures.attenuation import mirror_at_exposure_rad
from fitctl.identify.record import axis_pair
from fitctl.learn.frame_rates import AtOtherRate, by_rate, joined
from fitctl.learn.opened import Series, rebuild
from fitctl.report.gather import Gathered
from fitctl.report.rejection import last_design, under_last_design
from fitctl.report.selection import Selection, select_frames


class OpenedLoop(NamedTuple):
    """A loop, opened.

    Attributes
    ----------
    series : list of Series
    others : list of AtOtherRate
        What was recorded at other frame rates than the rig file's.
    selection : Selection
        The frames of it; those at which the stages were held are no part of the series.
    measured_px : tuple of float, or None
        RMS of the error on the series' frames under the present design, az and el; None without any.
    present : Design
        That was in force at the end.
    """

    series: list[Series]
    others: list[AtOtherRate]
    selection: Selection
    measured_px: tuple[float, float] | None
    present: Design


def opened_loop(gathered: Gathered, loop_name: str) -> OpenedLoop:
    """Open a stellar loop of a run.

    Raises
    ------
    ConfigError
        If the loop's design is not known.
    """
    rig, ticks = gathered.run.rig, gathered.ticks[loop_name]
    loop = rig.stellar_loops[loop_name]
    present = last_design(gathered, loop_name)
    selection = select_frames(ticks, rig.camera.period_s, loop.requirement_px)
    usable = np.zeros(len(ticks["held"]), bool)
    usable[selection.rows] = True
    usable &= ~ticks["held"]
    exposed_s = ticks["mid_exposure_s"]
    pieces, others = by_rate(exposed_s, pieces_of(exposed_s, usable), rig.camera.period_s)
    theory = loop_theory(rig, loop_name, present)
    mirror_rad = mirror_at_exposure_rad(loop.fsm, ticks)
    every = joined(pieces)
    under_present = every[under_last_design(gathered, loop_name)[every]]
    error_px = axis_pair(ticks, "error_{}_px")[under_present]
    return OpenedLoop(
        rebuild(theory, ticks, pieces, mirror_rad),
        [AtOtherRate(s, rebuild(theory, ticks, [rows], mirror_rad)) for s, rows in others],
        selection,
        tuple(np.sqrt(np.mean(error_px**2, axis=0)).tolist()) if len(error_px) else None,
        present,
    )
