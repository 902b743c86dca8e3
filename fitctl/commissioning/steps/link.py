"""A link: its loop holds the beam on the photodiodes; the feedforward keeps the star that comes over it."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.commissioning.steps.closed import ACQUIRE_S, HELD_S, SETTLED_S, Loop, supervised
from fitctl.config import ARCSEC_PER_RAD, MetrologyLoop, load_rig
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import EXPERIMENTS, Finding
from fitctl.identify.link.feedforward import FeedforwardResult
from fitctl.identify.run import hear, written_logs
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Mode
from fitctl.model.optics import scales
from fitctl.sequences.contact import Contact
from fitctl.sequences.runner import Runner, run_steps
from fitctl.sequences.steps import CollectorScan
from fitctl.sequences.view import SequenceError

Floats = NDArray[np.float64]
COUPLING_ARCSEC = (
    8.0  # of the link's beam to either side: without the feedforward, the mirror makes up for it
)
_COUPLING_CYCLES = 3
_MOST_OF_REACH = 0.5  # of the mirror, for what the matrix is wrong by while the collector swings
_SURE = 3.0  # standard deviations by which the rig file's matrix must differ, to be replaced ...
_MATTERS = (
    0.01  # ... and an element at least: 0.07 more moved the star by 0.04 px, so this by 0.006 px
)
_MOST_LATE = (
    0.05  # of the ticks of a scan (choice): more, and late commands may be why the star is not held
)
_LEAST_SCALE, _MOST_SCALE = 0.5, 2.0  # on the sky, both siderostats' beams are alike


def moves(site: Site) -> str:
    """What the step moves."""
    radius_arcsec = site.rig.loops[site.name].acquisition.search_radius_sky_arcsec
    return (
        f"the siderostat of {site.name}, to its beam and up to {radius_arcsec:g} arcsec on the sky in search "
        f"of it; then as in operation, for {HELD_S:g} s"
    )


def check_link(site: Site) -> Outcome:
    """Close the loop of the link, and hold its beam on the photodiodes.

    Raises
    ------
    StepError
        If the beam is not found, is lost, or is not held to the requirement.
    """
    wanted_arcsec = site.rig.metrology_loops[site.name].requirement_arcsec
    with supervised(site) as loop:
        began_s = time.monotonic()
        loop.command(Acquire())
        if math.isnan(loop.wait_for(Mode.LOCKED, ACQUIRE_S)):
            mode = loop.mode_of(site.name)
            msg = f"the beam is not held after {ACQUIRE_S:g} s, the loop is in {mode}: {loop.reason()}"
            raise StepError(msg)
        figures = {"acquired_s": time.monotonic() - began_s}
        time.sleep(SETTLED_S)
        figures |= _beam_held(site, loop)
        figures["stop_s"] = loop.stop()
    rms_arcsec = max(figures["rms_az_arcsec"], figures["rms_el_arcsec"])
    lines = [
        f"held for {HELD_S:g} s: RMS az {figures['rms_az_arcsec']:.3f}, el {figures['rms_el_arcsec']:.3f}, "
        f"worst {figures['worst_arcsec']:.3f} arcsec (requirement {wanted_arcsec:g} arcsec RMS)"
    ]
    if rms_arcsec > wanted_arcsec:
        msg = (
            f"the beam is held to {rms_arcsec:.2f} arcsec RMS; the requirement is {wanted_arcsec:g} arcsec; "
            "check the laser's power, the photodiodes and the gain of the loop"
        )
        raise StepError(msg, figures)
    return Outcome(lines, figures)


def _beam_held(site: Site, loop: Loop) -> dict[str, float]:
    """The RMS of the beam's angle from the centre, and the worst, over some time."""
    since_s = time.monotonic()
    seen: list[tuple[float, float]] = []
    while time.monotonic() < since_s + HELD_S:
        telemetry = loop.client.receive(0.5)
        for tick in () if telemetry is None else telemetry.metrology_ticks:
            if tick.loop != site.name or tick.time_s < since_s:
                continue
            if tick.mode != Mode.LOCKED.name:
                msg = (
                    f"the loop left LOCKED for {tick.mode} while it held the beam: {loop.reason()}"
                )
                raise StepError(msg)
            seen.append((tick.beam_az_arcsec, tick.beam_el_arcsec))
    angles = np.array(seen).reshape(-1, 2)
    angles = angles[np.isfinite(angles).all(axis=1)]
    if not len(angles):
        msg = f"no angle of the beam was measured within {HELD_S:g} s; check the photodiodes"
        raise StepError(msg)
    az, el = np.sqrt(np.mean(angles**2, axis=0))
    return {
        "rms_az_arcsec": float(az),
        "rms_el_arcsec": float(el),
        "worst_arcsec": float(np.max(np.abs(angles))),
    }


# ---------------------------------------------------------------- the feedforward
class Scanned(NamedTuple):
    """What a scan of the collector gave: the matrix, and the RMS of the star from its target."""

    found: FeedforwardResult
    rms_az_px: float
    rms_el_px: float


def coupling_moves(site: Site) -> str:
    """What the step moves."""
    return f"{_swing(site, coupling_scan(site))}. The feedforward is off"


def feedforward_moves(site: Site) -> str:
    """What the step moves."""
    swing = _swing(site, CollectorScan(loop=site.name))
    return f"{swing}; and the siderostat of {site.name}, by the feedforward, against it"


def _swing(site: Site, scan: CollectorScan) -> str:
    arcsec = 1e-3 * scan.amplitude_mm / _link(site).sensor.link_length_m * ARCSEC_PER_RAD
    return (
        f"the loops of {site.loop.link} and {site.name}, to hold beam and star; then the hexapod, by "
        f"{scan.amplitude_mm:.2g} mm to either side along link_azimuth and across it; the siderostat of "
        f"{site.loop.link} follows it by {arcsec:.3g} arcsec"
    )


def _link(site: Site) -> MetrologyLoop:
    return site.rig.metrology_loops[str(site.loop.link)]


def coupling_scan(site: Site) -> CollectorScan:
    """So small a scan that the mirror keeps the star without the feedforward."""
    amplitude_mm = 1e3 * _link(site).sensor.link_length_m * COUPLING_ARCSEC / ARCSEC_PER_RAD
    return CollectorScan(loop=site.name, amplitude_mm=amplitude_mm, cycles=_COUPLING_CYCLES)


def check_coupling(site: Site) -> Outcome:
    """Without the feedforward, how far the link's siderostat turns the star.

    The rig file's matrix is replaced where the mirror could not make up for what it is wrong by, so that the
    feedforward's own step does not lose the star.

    Raises
    ------
    StepError
        If the star is lost, or the two siderostats' scales disagree.
    """
    found = scanned(site, coupling_scan(site), f"loops.{site.name}.feedforward.gain=0").found
    figures = _matrix_figures(found)
    _require_alike(site, found, figures)
    scale = scales(site.rig, site.loop)
    swing_mm = CollectorScan(loop=site.name).amplitude_mm
    swing_px = 1e-3 * swing_mm / _link(site).sensor.link_length_m * scale.sky_px_per_rad
    most = _MOST_OF_REACH * scale.mirror_px_per_rad * site.loop.fsm.range_rad / swing_px
    off = float(np.abs(found.matrix - _matrix_of(site)).max())
    lines = [
        *found.lines()[:2],
        f"largest difference from the rig file's gain times matrix: {off:.3f} (limit {most:.3f}: the mirror "
        f"can make up for it over {swing_mm:g} mm)",
    ]
    figures["difference"] = off
    return Outcome(lines, figures, found.fragment() if off > most else {}, estimated=True)


def check_feedforward(site: Site) -> Outcome:
    """With the feedforward, measure its matrix, and how well the star is held while the collector moves.

    Raises
    ------
    StepError
        If the star is lost or not held to its requirement, or the two siderostats' scales disagree.
    """
    found, *rms_px = scanned(site, CollectorScan(loop=site.name))
    off = np.abs(found.matrix - _matrix_of(site))
    figures = _matrix_figures(found) | {
        "difference": float(off.max()),
        "px_per_mm": found.px_per_mm,
        "late": found.late,
        "rms_az_px": rms_px[0],
        "rms_el_px": rms_px[1],
    }
    wanted_px = site.loop.requirement_px
    lines = [
        *found.lines(),
        f"held while the collector moved: RMS az {rms_px[0]:.4f}, el {rms_px[1]:.4f} px (requirement "
        f"{wanted_px:g} px)",
    ]
    _require_alike(site, found, figures)
    if (off > np.maximum(_SURE * found.matrix_sd, _MATTERS)).any():
        return Outcome(lines, figures, found.fragment())
    if max(rms_px) > wanted_px:
        why = (
            f"{found.late:.0%} of the ticks were late, so let nothing else run on this computer, and repeat "
            "the step"
            if found.late > _MOST_LATE
            else "the scan does not exclude the matrix, so check the backlash of both siderostats"
        )
        msg = (
            f"while the collector moved, the star was held to {max(rms_px):.3f} px RMS; the requirement is "
            f"{wanted_px:g} px; {why}"
        )
        raise StepError(msg, figures)
    return Outcome(lines, figures)


def _matrix_of(site: Site) -> Floats:
    """The rig file's matrix, times its gain."""
    given = site.loop.feedforward
    return np.zeros((2, 2)) if given is None else given.gain * np.array(given.matrix)


def _matrix_figures(found: FeedforwardResult) -> dict[str, float]:
    names = [f"matrix_{own}_{link}" for own in ("az", "el") for link in ("az", "el")]
    return dict(zip(names, found.matrix.ravel().tolist(), strict=True)) | {
        "matrix_sd": float(found.matrix_sd.max())
    }


def _require_alike(site: Site, found: FeedforwardResult, figures: dict[str, float]) -> None:
    """Refuse a scale that no sign, turn or mirror image explains."""
    most, least = np.linalg.svd(found.matrix, compute_uv=False).tolist()
    if least >= _LEAST_SCALE and most <= _MOST_SCALE:
        return
    msg = (
        f"the siderostat of {site.loop.link} turns the star by {least:.2f} to {most:.2f} times what it turns "
        f"its own beam, expected {_LEAST_SCALE:g} to {_MOST_SCALE:g}; compare gear, screw and lever arm of "
        f"loops.{site.loop.link}.siderostat and loops.{site.name}.siderostat with their data sheets"
    )
    raise StepError(msg, figures)


def scanned(site: Site, scan: CollectorScan, *overrides: str) -> Scanned:
    """Hold beam and star, scan the collector, and evaluate the log, by a rig with these settings.

    Raises
    ------
    StepError
        If beam or star is not held, the collector does not move, or the log gives no matrix.
    """
    rig = load_rig(site.rig_path, [*site.overrides, *overrides])
    paths: dict[Path, None] = {}
    try:
        with supervised(site, *overrides) as loop:
            loop.acquire()
            time.sleep(SETTLED_S)
            hear(loop.client, paths)
            site.report("the collector swings along both axes of the link")
            contact = Contact(loop.client, rig, "commissioning", 1)
            (attempt,) = run_steps(Runner(contact), [scan])
            logs = written_logs(loop.client, rig, paths)
            loop.stop()
        found = EXPERIMENTS["feedforward"].from_logs(rig, site.name, logs)
    except SequenceError as error:
        msg = f"{error}; if the star was lost, repeat the step {site.name}.coupling"
        raise StepError(msg) from None
    except IdentifyError as error:
        raise StepError(str(error)) from None
    return scanned_from(found, attempt.figures_json)


def scanned_from(found: Finding, figures_json: str) -> Scanned:
    """From what the log gave, and the figures of the scan's attempt."""
    assert isinstance(found, FeedforwardResult)  # noqa: S101 - for the type checker
    figures = msgspec.json.decode(figures_json, type=dict[str, float])
    return Scanned(found, figures["rms_az_px"], figures["rms_el_px"])
