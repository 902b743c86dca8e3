"""Steps that record the data of the link's identifications: collector_scan, beam_scan, ambient.

They leave ticks in the log and evaluate little of them; `fitctl identify` does the rest.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from fitctl.config import ARCSEC_PER_RAD, Rig
from fitctl.messages.commands import Jog, MoveCollector, Release
from fitctl.messages.modes import Mode
from fitctl.model.collector_motion import beyond, course_of
from fitctl.model.optics import sky_px_per_rad
from fitctl.sequences import steps
from fitctl.sequences.behaviours.behaviour import Behaviour, Result
from fitctl.sequences.view import StepFailed, View, columns

_DIRECTIONS_DEG = (0.0, 90.0)  # azimuth and elevation of the link
_LEAST_SAMPLES = 100
_REST_S = 1.0  # at the ends of a scan; a hexapod that was stopped slows down meanwhile
_PART_OF_COMMANDS = 0.5  # of those that one person may send: reports and people need the rest
AzElArcsec = tuple[float, float]


def _log_hint(view: View, *commands: str) -> str:
    """The commands that evaluate the log, where there is one."""
    recorder = view.telemetry.recorder
    if recorder is None:
        return ""
    return "".join(
        f"; fitctl identify {command} --loop {view.loop_name} --log {recorder.path}"
        for command in commands
    )


# ---------------------------------------------------------------- collector_scan


def _check_collector_scan(step: steps.CollectorScan, rig: Rig, loop_name: str) -> list[str]:
    if rig.collector is None:
        return [f"rig {rig.name} has no collector that moves"]
    if rig.stellar_loops[loop_name].link is None:
        return [f"loop {loop_name} has no link; its star does not come over the collector"]
    sines = [
        course_of(rig.collector.motion.changed(_sine(step, axis)), seed=0) for axis in range(2)
    ]
    return [problem for sine in sines for problem in beyond(sine, rig.collector)]


def _sine(step: steps.CollectorScan, axis: int) -> dict[str, Any]:
    """The motion along one axis."""
    return {
        "kind": "sine",
        "direction_deg": _DIRECTIONS_DEG[axis],
        "amplitude_mm": step.amplitude_mm,
        "frequency_hz": step.frequency_hz,
    }


def _scan_s(step: steps.CollectorScan) -> float:
    """Along one axis."""
    return step.cycles / step.frequency_hz


def _run_collector_scan(step: steps.CollectorScan, view: View) -> None:
    collector = view.telemetry.collector
    if collector is not None and collector.motion:
        msg = f"the collector moves already: {collector.motion}; stop it first"
        raise StepFailed(msg)
    _start_axis(step, view, 0)


def _start_axis(step: steps.CollectorScan, view: View, axis: int) -> None:
    view.command(MoveCollector(action="start", **_sine(step, axis)))
    view.rows["axes"].append((float(axis),))


def _collector_scan_done(step: steps.CollectorScan, view: View) -> Result | None:
    """Start, wait until it moves, stop after whole cycles, wait until it stands; then the other axis."""
    link_name = view.settings.link
    link = next(loop for loop in view.telemetry.loops if loop.name == link_name)
    view.require_mode(Mode.VERNIER)
    if link.mode != Mode.LOCKED.name:
        msg = f"loop {link.name} is in {link.mode}; the link must hold during the scan"
        raise StepFailed(msg)
    view.squares.add(columns(view.measurements)[:, 3:5])
    view.measurements.clear()  # the log has them
    collector = view.telemetry.collector
    if collector is None or collector.error:
        msg = "the supervisor has no collector" if collector is None else collector.error
        raise StepFailed(msg)
    axis = len(view.rows["axes"]) - 1
    begun, stopping = len(view.marks) > axis, len(view.rows["stops"]) > axis
    if collector.busy:
        return None
    if not begun:
        if collector.motion:
            view.marks.append(view.now_s)
        return None
    if stopping:
        (stopped_s,) = view.rows["stops"][-1]
        if collector.motion or view.now_s - stopped_s < _REST_S:
            return None
        if axis + 1 < len(_DIRECTIONS_DEG):
            _start_axis(step, view, axis + 1)
            return None
        az_px, el_px = view.squares.rms_px.tolist()
        return Result(
            {"scanned_s": view.now_s - view.marks[0], "rms_az_px": az_px, "rms_el_px": el_px},
            f"scanned along both axes, the star within az {az_px:.3f}, el {el_px:.3f} px RMS"
            f"{_log_hint(view, 'feedforward')}",
        )
    view.require_motion(view.marks[-1])
    if view.now_s - view.marks[-1] >= _scan_s(step):
        view.command(MoveCollector(action="stop"))
        view.rows["stops"].append((view.now_s,))
    return None


def _stop_collector_scan(_step: steps.CollectorScan, view: View) -> None:
    view.ask(MoveCollector(action="stop"))


# ---------------------------------------------------------------- beam_scan


def beam_course(step: steps.BeamScan) -> list[tuple[float, AzElArcsec]]:
    """Corners of the scan: seconds from its start, and where the beam is then, on the sky from its start."""
    corners: list[tuple[float, AzElArcsec]] = [(0.0, (0.0, 0.0)), (_REST_S, (0.0, 0.0))]
    for axis in range(2):
        for speed in (step.fast_sky_arcsec_s, step.slow_sky_arcsec_s):
            for place in (step.span_sky_arcsec, -step.span_sky_arcsec) * step.cycles + (0.0,):
                before_s, before = corners[-1]
                after = (place, 0.0) if axis == 0 else (0.0, place)
                corners.append((before_s + math.dist(before, after) / speed, after))
    corners.append((corners[-1][0] + _REST_S, (0.0, 0.0)))
    return corners


def _place_at(corners: list[tuple[float, AzElArcsec]], since_s: float) -> AzElArcsec:
    for (start_s, start), (end_s, end) in pairwise(corners):
        if since_s < end_s:
            part = (since_s - start_s) / (end_s - start_s)
            return (
                start[0] + part * (end[0] - start[0]),
                start[1] + part * (end[1] - start[1]),
            )
    return corners[-1][1]


def _check_beam_scan(step: steps.BeamScan, rig: Rig, loop_name: str) -> list[str]:
    if loop_name not in rig.metrology_loops:
        return [f"beam_scan is for a metrology loop; {loop_name} points a star"]
    problems = []
    travel_arcsec = rig.metrology_loops[loop_name].siderostat.travel_sky_arcsec
    if step.span_sky_arcsec > travel_arcsec:
        problems.append(
            f"span_sky_arcsec must be at most {travel_arcsec:g}, the siderostat's travel_sky_arcsec"
        )
    if step.slow_sky_arcsec_s > step.fast_sky_arcsec_s / 2:
        problems.append("slow_sky_arcsec_s must be at most half of fast_sky_arcsec_s")
    most_arcsec = min(rig.camera.width_px, rig.camera.height_px) / sky_px_per_rad(rig)
    jog_arcsec = step.fast_sky_arcsec_s * 2 * _jog_period_s(rig)
    if jog_arcsec > most_arcsec * ARCSEC_PER_RAD:
        problems.append(
            "fast_sky_arcsec_s is too fast for the pace of the telemetry and of commands; lower it"
        )
    return problems


def _beam_scan_s(step: steps.BeamScan, _rig: Rig, _loop_name: str) -> float:
    return beam_course(step)[-1][0]


def _run_beam_scan(_step: steps.BeamScan, view: View) -> None:
    if view.mode is not Mode.STANDBY:
        view.command(Release(loop=view.loop_name))


def _beam_scan_done(step: steps.BeamScan, view: View) -> Result | None:
    """A jog for each message, or fewer, if more would be too many commands."""
    view.require_mode(Mode.STANDBY)
    _require_still(view)
    if not view.marks:
        # When it began, how far the beam was moved, and when it was moved last.
        view.marks += [view.now_s, 0.0, 0.0, -math.inf]
    corners = beam_course(step)
    if view.link.now_s() - view.marks[3] >= _least_period_s(view.rig):
        _follow_course(view, corners)
    since_s = view.link.now_s() - view.marks[0]
    _record_volts(view)
    if since_s < corners[-1][0]:
        return None
    volts = np.array(view.rows["volts"]).reshape(-1, 4)
    if len(volts) < _LEAST_SAMPLES:
        msg = f"the photodiodes gave {len(volts)} samples; see fitctl status"
        raise StepFailed(msg)
    swing_v = float(np.ptp(volts, axis=0).min())
    return Result(
        {"samples": float(len(volts)), "swing_v": swing_v},
        f"each photodiode swung by at least {swing_v:.2f} V{_log_hint(view, 'photodiodes', 'link_delay')}",
    )


def _follow_course(view: View, corners: list[tuple[float, AzElArcsec]]) -> None:
    """Move the beam to where it is to be at the next jog."""
    jogged_s = view.link.now_s()
    since_s = jogged_s - view.marks[0] + _jog_period_s(view.rig)
    az_arcsec, el_arcsec = _place_at(corners, since_s)
    view.command(
        Jog(
            loop=view.loop_name,
            az_sky_arcsec=az_arcsec - view.marks[1],
            el_sky_arcsec=el_arcsec - view.marks[2],
        )
    )
    view.marks[1:] = [az_arcsec, el_arcsec, jogged_s]


def _least_period_s(rig: Rig) -> float:
    """Between two jogs."""
    return 1 / (_PART_OF_COMMANDS * rig.service.commands_per_s)


def _jog_period_s(rig: Rig) -> float:
    """Between two jogs, each of which follows a message of the telemetry."""
    return max(1 / rig.supervisor.telemetry_hz, _least_period_s(rig))


def _require_still(view: View) -> None:
    collector = view.telemetry.collector
    if collector is not None and collector.motion:
        msg = f"the collector moves: {collector.motion}; stop it first"
        raise StepFailed(msg)


def _record_volts(view: View) -> None:
    view.rows["volts"] += [
        (
            tick.diode_az_plus_v,
            tick.diode_az_minus_v,
            tick.diode_el_plus_v,
            tick.diode_el_minus_v,
        )
        for tick in view.telemetry.metrology_ticks
        if tick.loop == view.loop_name and tick.sampled_s >= view.began_s
    ]


# ---------------------------------------------------------------- ambient


def _check_ambient(_step: steps.Ambient, rig: Rig, loop_name: str) -> list[str]:
    if loop_name not in rig.metrology_loops:
        return [f"ambient is for a metrology loop; {loop_name} points a star"]
    return []


def _ambient_s(step: steps.Ambient, _rig: Rig, _loop_name: str) -> float:
    return step.duration_s


def _ambient_done(step: steps.Ambient, view: View) -> Result | None:
    view.require_mode(Mode.STANDBY)
    _record_volts(view)
    if view.elapsed_s < step.duration_s:
        return None
    volts = np.array(view.rows["volts"]).reshape(-1, 4)
    if len(volts) < _LEAST_SAMPLES:
        msg = f"the photodiodes gave {len(volts)} samples, expected at least {_LEAST_SAMPLES}"
        raise StepFailed(msg)
    means = ", ".join(f"{value:.4f}" for value in volts.mean(axis=0).tolist())
    return Result({"samples": float(len(volts))}, f"means {means} V{_log_hint(view, 'ambient')}")


SCANS = {
    "collector_scan": Behaviour(
        frozenset({Mode.VERNIER}),
        _collector_scan_done,
        _run_collector_scan,
        _stop_collector_scan,
        _check_collector_scan,
        lambda step, _rig, _loop_name: len(_DIRECTIONS_DEG) * _scan_s(step),
    ),
    "beam_scan": Behaviour(
        frozenset({Mode.LOCKED, Mode.STANDBY}),
        _beam_scan_done,
        _run_beam_scan,
        lambda _step, _view: None,
        _check_beam_scan,
        _beam_scan_s,
        of_beams=True,
    ),
    "ambient": Behaviour(
        frozenset({Mode.STANDBY}),
        _ambient_done,
        check=_check_ambient,
        own_s=_ambient_s,
        of_beams=True,
    ),
}
