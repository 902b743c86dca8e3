"""A report's figures as tables of text."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

from fitctl.error_budget import CAUSES
from fitctl.report.findings import AXES, Findings, LoopFindings, StarFindings
from fitctl.report.fringes import FringeFindings
from fitctl.report.residual import Estimate
from fitctl.report.run import Run
from fitctl.report.selection import searches_for_lost_star

UNKNOWN = "not known"
MOST_ROWS = 400
_LEVELS = {1: "debug", 2: "info", 3: "warning", 4: "error", 5: "fatal"}  # foxglove.Log


class Table(NamedTuple):
    """One table; its first column heads the rows.

    Attributes
    ----------
    caption : str
    head : sequence of str
    rows : sequence of sequence of str
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def number(value: float, form: str, unit: str = "", scale: float = 1.0) -> str:
    """A number with its unit, or that it is not known."""
    if math.isnan(value):
        return UNKNOWN
    return f"{value * scale:{form}}{' ' if unit else ''}{unit}"


def seconds(value: float) -> str:
    """A length of time for people."""
    if math.isnan(value):
        return UNKNOWN
    if value < 120 or math.isinf(value):
        return f"{value:.1f} s"
    hours, rest = divmod(round(value), 3600)
    minutes, left = divmod(rest, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {left:02d} s"


def utc(run: Run, time_s: float = 0.0, form: str = "%Y-%m-%d %H:%M:%S UTC") -> str:
    """A moment of a run."""
    return time.strftime(form, time.gmtime(run.start_ns / 1e9 + time_s))


def interval(found: Estimate) -> str:
    """95 % confidence."""
    return f"{found.low:.4f} to {found.high:.4f}" if found.known else UNKNOWN


def residual(loop: LoopFindings) -> Table:
    """What the verdict is of."""
    unit = loop.quantity.unit
    sky = {"arcsec on the sky": loop.sky_arcsec_per_px} if isinstance(loop, StarFindings) else {}
    return Table(
        f"Measured error of the {loop.quantity.of}, RMS about its target, with 95 % confidence",
        ["axis", unit, f"interval, {unit}", *sky, "of the requirement", "independent values"],
        [
            [
                axis,
                number(found.rms, ".4f"),
                interval(found),
                *(number(found.rms * arcsec_per_px, ".4f") for arcsec_per_px in sky.values()),
                number(found.rms / loop.requirement, ".0f", "%", 100),
                number(found.independent, ".0f"),
            ]
            for axis, found in loop.residual.items()
        ],
    )


def by_controller(loop: StarFindings) -> Table:
    """How well the star was held under each of several controllers."""
    rows = [
        [
            held.controller,
            seconds(held.evaluated_s),
            *(
                text
                for found in held.residual.values()
                for text in (number(found.rms, ".4f", "px"), interval(found))
            ),
        ]
        for held in loop.held_by_controller
    ]
    head = [
        "controller",
        "judged",
        *(part for axis in AXES for part in (f"RMS {axis}", "interval")),
    ]
    return Table("RMS of the error under each controller", head, rows if len(rows) > 1 else [])


def headline(loop: LoopFindings) -> str:
    """The one number of a loop: the RMS of its worse axis."""
    worse = max(
        (found.rms for found in loop.residual.values()),
        key=lambda rms: -math.inf if math.isnan(rms) else rms,
    )
    unit = loop.quantity.unit
    if math.isnan(worse):
        return f"requirement {loop.requirement:g} {unit} RMS"
    return f"{worse:.4f} of {loop.requirement:g} {unit} RMS"


def error_budget(loop: StarFindings) -> Table:
    """Where the error came from, under each controller, beside what its design and the rig file expect."""
    budgets = [
        (found.controller, found.budget) for found in loop.rejections if found.budget is not None
    ]
    head = [part for name, _ in budgets for part in (name, f"{name}, expected")]
    rows = [["RMS of an axis"]]
    for _, budget in budgets:
        rows[0] += [f"{budget.measured_px:.4f} px", f"{budget.expected_px:.4f} px"]
    for cause in CAUSES:
        row = [cause]
        for _, budget in budgets:
            row += [f"{budget.percent[cause]} %", f"{100 * budget.expected_fractions[cause]:.0f} %"]
        rows.append(row)
    verdicts = "; ".join(f"{name}: {budget.verdict}" for name, budget in budgets)
    caption = f"Where the error comes from: parts of its mean square. {verdicts}"
    return Table(caption.strip(), ["cause", *head], rows if budgets else [])


def key_figures(loop: LoopFindings) -> Table:
    """What else one asks first."""
    selection, held = loop.selection, loop.quantity
    rows = [
        [f"time in {held.mode.name}, all of the run", seconds(selection.held_s)],
        ["judged", f"{seconds(selection.evaluated_s)}; pieces: {len(selection.pieces)}"],
        [
            f"{held.of} measured in it",
            number(selection.measured_fraction, ".2f", "% of the frames", 100),
        ],
    ]
    if isinstance(loop, StarFindings):
        rows += _stages(loop)
    rows.append(
        [
            "modes, all of the run",
            ", ".join(f"{mode} {seconds(s)}" for mode, s in loop.mode_s.items()) or "no ticks",
        ]
    )
    lost_s = searches_for_lost_star(loop.ticks)
    if lost_s:
        times = f"{len(lost_s)} times, searched again for {seconds(sum(lost_s))}"
        rows.append(
            [f"{held.of} lost, all of the run", f"{times}, at most {seconds(max(lost_s))} at once"]
        )
    return Table("In the part that is judged", ["what", "how much"], rows)


def _stages(loop: StarFindings) -> list[list[str]]:
    """Rows of a stellar loop's mirror and siderostat."""
    moved = loop.stages
    rows = [
        [
            "mirror's range",
            f"{number(moved.range_mean, '.1f', '% mean', 100)}, "
            f"{number(moved.range_worst, '.1f', '% worst', 100)}",
        ],
        ["mirror saturated", number(moved.saturated_fraction, ".2f", "% of the frames", 100)],
        ["piston (Eq. 4), RMS", number(moved.piston_rms_m, ".1f", "nm", 1e9)],
    ]
    rows += [
        [
            f"siderostat's set-point, {axis}",
            number(px * loop.sky_arcsec_per_px, "+.2f", "arcsec on the sky from first to last"),
        ]
        for axis, px in zip(AXES, moved.motor_moved_px, strict=True)
    ]
    return rows


def rejected(loop: StarFindings) -> Table:
    """Measured rejection beside the design's."""
    head = ["controller", "judged", "bound", "design's residual"]
    frequencies = [at_hz for at_hz, *_ in loop.rejections[0].table()] if loop.rejections else []
    head += [f"{at_hz:g} Hz" for at_hz in frequencies]
    rows = []
    for found in loop.rejections:
        predicted = found.predicted
        least, left = (
            (math.nan,) * 2 if predicted is None else (predicted.bound_px, predicted.residual_px)
        )
        row = [found.controller, seconds(found.evaluated_s)]
        row += [number(least, ".4f", "px"), number(left, ".4f", "px")]
        row += [
            f"{measured:.2f} / {number(design, '.2f')}" for _, measured, design in found.table()
        ]
        rows.append(row)
    return Table("Disturbance rejection: measured / design", head, rows)


def fringes(found: FringeFindings) -> Table:
    """The tilt and what it leaves."""
    figures = found.figures
    rows = [
        ["judged: both loops hold, and have settled", seconds(figures.judged_s)],
        ["visibility, mean", number(figures.visibility_mean, ".4f")],
        ["visibility, 5 % of the frames are below", number(figures.visibility_p5, ".4f")],
    ]
    for axis in AXES:
        mean, spread = (getattr(figures, f"tilt_{what}_{axis}_arcsec") for what in ("mean", "std"))
        rows.append([f"tilt {axis}, mean", number(mean, "+.4f", "arcsec")])
        rows.append([f"tilt {axis}, RMS about its mean", number(spread, ".4f", "arcsec")])
    one, other = found.loops
    return Table(f"Tilt of {one} less {other}, as measured", ["what", "how much"], rows)


def timings(loop: LoopFindings) -> Table:
    """Milliseconds."""
    found = loop.timing
    rows = {
        "frame's age when used": (found["age_median_s"], found["age_worst_s"]),
        "tick, from frame to command": (found["compute_median_s"], found["compute_worst_s"]),
        "servo's wake-up late": (found["servo_late_median_s"], found["servo_late_worst_s"]),
        "the machine stood still": (math.nan, found["worst_stall_s"]),
    }
    texts = [
        [what, *(number(value, ".3f", "ms", 1e3) for value in values)]
        for what, values in rows.items()
    ]
    return Table("Timing", ["what", "median", "worst"], texts)


def losses(findings: Findings) -> Table:
    """What did not arrive, and what was late."""
    run = findings.run
    rows = [
        [
            name,
            *(f"{loop.counts[what]}" for what in ("frames", "frames_lost", "late_ticks", "stalls")),
        ]
        for name, loop in findings.loops.items()
    ]
    lost = findings.gathered.lost
    unfinished = [str(log.path.name) for log in run.logs if not log.finished]
    caption = f"Losses. Records lost on the way to the log: {UNKNOWN if lost is None else lost}."
    if findings.gathered.misdated:
        caption += (
            f" Left out: {findings.gathered.misdated} records whose own time is not of the run."
        )
    if unfinished:
        caption += f" Not finished, so that its end may be missing: {', '.join(unfinished)}."
    return Table(
        caption, ["loop", "frames", "frames lost", "late ticks", "stalls of the machine"], rows
    )


def events(findings: Findings) -> Table:
    """Events as operators see them; of very many the worst first."""
    recorded = findings.gathered.events
    shown = sorted(recorded, key=lambda event: -event["level"])[:MOST_ROWS]
    shown.sort(key=lambda event: event["time_s"])
    caption = (
        "Events"
        if len(shown) == len(recorded)
        else f"Events: {len(shown)} of {len(recorded)}, the gravest"
    )
    rows = [
        [
            utc(findings.run, event["time_s"], "%H:%M:%S"),
            seconds(event["time_s"]),
            _LEVELS.get(event["level"], str(event["level"])),
            event["name"],
            event["message"],
        ]
        for event in shown
    ]
    return Table(caption, ["UTC", "after start", "level", "of", "what"], rows)


def modes(findings: Findings) -> Table:
    """Every change."""
    changes = findings.gathered.modes
    rows = [
        [
            utc(findings.run, change["time_s"], "%H:%M:%S"),
            seconds(change["time_s"]),
            change["loop"],
            f"{change['source']} → {change['target']}",
            change["reason"],
        ]
        for change in changes[:MOST_ROWS]
    ]
    caption = "Changes of mode" + (
        f": the first {MOST_ROWS} of {len(changes)}" if len(changes) > MOST_ROWS else ""
    )
    return Table(caption, ["UTC", "after start", "loop", "change", "why"], rows)


def devices(findings: Findings) -> Table:
    """How each was, and when that changed."""
    rows = [
        [
            row["device"],
            utc(findings.run, row["time_s"], "%H:%M:%S"),
            row["state"],
            row["identity"],
            row["endpoint"],
            row["detail"],
        ]
        for row in findings.gathered.health[:MOST_ROWS]
    ]
    return Table(
        "Devices: each change of state",
        ["device", "UTC", "state", "identity", "endpoint", "detail"],
        rows,
    )


def attempts(findings: Findings) -> Table:
    """Steps of sequences."""
    rows = [
        [
            f"{row['sequence_name']} {row['step_number']}: {row['step']}",
            row["loop"],
            str(row["attempt"]),
            seconds(row["ended_s"] - row["began_s"]),
            row["outcome"],
            row["message"],
        ]
        for row in findings.gathered.attempts[:MOST_ROWS]
    ]
    return Table(
        "Steps of sequences", ["step", "loop", "attempt", "took", "outcome", "message"], rows
    )


def versions(findings: Findings) -> Table:
    """Of the software that recorded, and how it ran."""
    metadata = findings.run.metadata
    rows = [[name, version] for name, version in metadata.get("versions", {}).items()]
    rows += [["scheduling", metadata.get("scheduling", {}).get("policy", UNKNOWN)]]
    return Table("Versions when it was recorded", ["what", "which"], rows)


def files(run: Run) -> Table:
    """Of the run."""
    rows = [
        [
            str(log.path.name),
            utc(run, log.start_s - run.start_ns / 1e9) if log.counts else "no records",
            seconds(log.duration_s),
            f"{log.path.stat().st_size / 1e6:.1f} MB",
            f"{sum(log.counts.values())}",
            "yes" if log.finished else "no",
        ]
        for log in run.logs
    ]
    return Table("Files", ["file", "begins", "lasts", "size", "records", "finished"], rows)
