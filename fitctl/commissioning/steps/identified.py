"""What `fitctl identify` measures, as steps: air path, hysteresis, backlash, delay; then the design."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.commissioning.steps.closed import SETTLED_S, supervised
from fitctl.config import ConfigError
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import DESIGNS, design_for
from fitctl.controllers.design.margins import Margins, Required, margins
from fitctl.controllers.design.standing import Standing, standing
from fitctl.identify.airpath import AirPathResult
from fitctl.identify.backlash import BacklashResult
from fitctl.identify.delay import DelayResult
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import EXPERIMENTS, Finding
from fitctl.identify.hysteresis import HysteresisResult
from fitctl.identify.run import on_rig
from fitctl.model.drives import FSM, SIDEROSTAT, STACKS, experiment_s

SURE = 3.0  # standard deviations by which a rig file's value must differ
_REPORT_EVERY_S = 10.0
_ALIKE = 1.02  # of the least residual; then the simpler design is taken
_WORTH_IT = 0.9  # of the residual that the rig file's design leaves


def identification(what: str) -> Callable[[Site], Outcome]:
    """A step that does one of the identifications."""
    return lambda site: _identify(site, what)


def identification_moves(what: str) -> Callable[[Site], str]:
    """What such a step moves."""

    def moves(site: Site) -> str:
        try:
            drives = EXPERIMENTS[what].plan(site.rig, site.name)  # pyrefly: ignore[not-callable]
        except IdentifyError as error:
            return f"nothing: {error}"
        most = dict.fromkeys((*STACKS, *FSM, *SIDEROSTAT), 0.0)
        for drive in drives:
            largest = max(abs(drive.amplitude), abs(drive.end_amplitude or 0.0))
            most[drive.channel] = max(most[drive.channel], largest)
        moved = [
            f"{channel} by {size:.3g} {_unit(channel)}" for channel, size in most.items() if size
        ]
        loop = f"the loop, to hold the star; then, open loop for {experiment_s(drives):.0f} s, "
        return loop + (", ".join(moved) if moved else "nothing")

    return moves


def _unit(channel: str) -> str:
    return "V" if channel in STACKS else "px"


def _identify(site: Site, what: str) -> Outcome:
    """Hold the star, have the experiment done, and compare what it gives with the rig file.

    Raises
    ------
    StepError
        If the star is not held, or the record gives nothing.
    """
    experiment = EXPERIMENTS[what]
    try:
        drives = experiment.plan(site.rig, site.name)  # pyrefly: ignore[not-callable]
        with supervised(site) as loop:
            loop.acquire()
            time.sleep(SETTLED_S)
            paths = on_rig(loop.client, site.rig, site.name, what, drives, _progress(site))
            loop.stop()
            finding = experiment.from_logs(site.rig, site.name, paths)
    except IdentifyError as error:
        raise StepError(str(error)) from None
    figures, differs = _COMPARED[what](site, finding)
    found = finding.fragment() if differs else {}
    return Outcome(finding.lines(), figures, found, estimated=True)


def _progress(site: Site) -> Callable[[float], None]:
    said_s = [time.monotonic()]

    def report(part: float) -> None:
        if time.monotonic() > said_s[0] + _REPORT_EVERY_S:
            said_s[0] = time.monotonic()
            site.report(f"{part:.0%} of the motions")

    return report


Compared = tuple[dict[str, float], bool]


def _air_path(site: Site, finding: Finding) -> Compared:
    assert isinstance(finding, AirPathResult)  # noqa: S101 - for the type checker
    known = site.loop.vernier.air_path
    pairs = {
        "gain_px": (finding.joint.gain_px, known.gain_px),
        "b1_s2": (finding.joint.b1_s2, known.b1_s2),
        "b2_s": (finding.joint.b2_s, known.b2_s),
    }
    figures = {name: measured.value for name, (measured, _) in pairs.items()}
    figures["noise_px"] = finding.joint.noise_px.value
    differs = any(not one.low <= other <= one.high for one, other in pairs.values())
    return figures, differs and finding.test.fits


def _hysteresis(site: Site, finding: Finding) -> Compared:
    assert isinstance(finding, HysteresisResult)  # noqa: S101
    strokes = finding.gains_m_per_v.sum(axis=1)
    figures = {f"stack {n}_m_per_v": float(one) for n, one in enumerate(strokes, start=1)}
    figures["excess"] = finding.excess
    return (
        figures,
        True,
    )  # its widths are other ones each time, so that only a whole model can be taken


def _backlash(site: Site, finding: Finding) -> Compared:
    assert isinstance(finding, BacklashResult)  # noqa: S101
    known_arcsec = site.loop.siderostat.backlash_sky_arcsec
    sd_arcsec = finding.width_sd_px * finding.sky_arcsec_per_px
    figures = {"backlash_sky_arcsec": finding.width_sky_arcsec, "sd_sky_arcsec": sd_arcsec}
    if known_arcsec is None:
        return figures, True
    return figures, abs(finding.width_sky_arcsec - known_arcsec) > SURE * sd_arcsec


def _delay(site: Site, finding: Finding) -> Compared:
    assert isinstance(finding, DelayResult)  # noqa: S101
    figures = {
        "delay_s": finding.delay_s,
        "delay_std_s": finding.delay_std_s,
        "stamp_error_s": finding.stamp_error_s,
        "jitter_s": finding.jitter_s,
    }
    apart_s = abs(finding.delay_s - site.rig.camera.frame_delay_s)
    return figures, apart_s > SURE * max(finding.delay_std_s, 1e-3)


_COMPARED: dict[str, Callable[[Site, Finding], Compared]] = {
    "airpath": _air_path,
    "hysteresis": _hysteresis,
    "backlash": _backlash,
    "delay": _delay,
}
"""Figures of a finding, and whether the rig file is to take it."""


# ---------------------------------------------------------------- the design
def check_design(site: Site) -> Outcome:
    """Margins and residual of every design on what was identified; the best that keeps its margins is chosen.

    Raises
    ------
    StepError
        If none keeps them.
    """
    required = Required()
    here = site.loop.vernier.controller
    found: dict[str, tuple[Standing, Margins]] = {}
    lines, figures = [], {}
    its_basis = basis(site.rig, site.name)
    for name in dict.fromkeys((here, *DESIGNS)):
        try:
            design = design_for(site.rig, site.name, name)
        except ConfigError as error:
            lines.append(f"{name}: {error}")
            continue
        found[name] = standing(design, its_basis), margins(design, its_basis, required)
        lines.append(_design_line(name, *found[name], kept=found[name][1].excess(required) <= 1))
        figures[f"{name} residual_px"] = found[name][0].residual_px
        figures[f"{name} phase_margin_deg"] = found[name][1].phase_margin_deg
        figures[f"{name} gain_margin_db"] = found[name][1].gain_margin_db
        figures[f"{name} peak_sensitivity"] = found[name][1].peak_sensitivity
    safe = [name for name, one in found.items() if one[1].excess(required) <= 1]
    if not safe:
        msg = (
            f"no design keeps all margins with this delay and air path (phase {required.phase_margin_deg:g} "
            f"degrees, gain {required.gain_margin_db:g} dB, peak sensitivity {required.peak_sensitivity:g}, "
            f"stable for mirror gains from {required.least_gain:g} to {required.greatest_gain:g} and "
            f"{1e3 * required.delay_s:g} ms more or less delay); shorten camera.frame_delay_s or raise the "
            "frame rate, or make a design by hand (docs/designing.md)"
        )
        raise StepError(msg, figures)
    least_px = min(found[name][0].residual_px for name in safe)
    alike = [name for name in safe if found[name][0].residual_px <= _ALIKE * least_px]
    best = min(alike, key=lambda name: found[name][0].order)
    if here in safe and _WORTH_IT * found[here][0].residual_px <= found[best][0].residual_px:
        lines.append(f"{here}, the rig file's controller, stays")
        return Outcome(lines, figures)
    lines.append(f"{best} replaces {here}")
    chosen: dict[str, Any] = {"vernier": {"controller": best}}
    return Outcome(lines, figures, site.found(**chosen), estimated=True)


def _design_line(name: str, stands: Standing, has: Margins, *, kept: bool) -> str:
    return (
        f"{name}: leaves {stands.residual_px:.4f} px; phase margin {has.phase_margin_deg:.0f} degrees, gain "
        f"margin {has.gain_margin_db:.1f} dB, peak sensitivity {has.peak_sensitivity:.2f}"
        f"{'' if kept else ', too little'}"
    )
