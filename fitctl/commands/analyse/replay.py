"""`fitctl replay`: a log through today's code, and where it decides otherwise."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.logs import LatestOption, chosen_logs
from fitctl.commands.shared.opened import opened_loop
from fitctl.commands.shared.options import ControllerOption, JsonOption, SetOption
from fitctl.commands.shared.printing import progress_line, say, to_json
from fitctl.commands.shared.rig import blaming_controller, controller_overrides
from fitctl.config import ConfigError, Rig, load_rig, rig_from_log
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.document import MATRICES, design_json
from fitctl.controllers.pair import Design
from fitctl.learn.advice import standing
from fitctl.learn.design_basis import estimated
from fitctl.logging.reading import LogInfo, clock_of
from fitctl.logging.schemas import designs_of
from fitctl.processes import ended_by_signals, interrupt
from fitctl.replay.files import logged_files, missing_dark_file
from fitctl.replay.log import read_steps, whole_run
from fitctl.replay.replay import replay as replay_steps
from fitctl.replay.result import LoopReplay, ReplayResult
from fitctl.report.gather import Gathered, gather
from fitctl.report.rejection import held_by_controller
from fitctl.report.run import NO_RIG, find_run, unlike_the_log
from fitctl.text import plain

_ROWS = {
    "star_px": ("star's place", "px"),
    "mirror_rad": ("mirror", "rad"),
    "stacks_v": ("D/A voltages", "V"),
    "beam_arcsec": ("beam's place", "arcsec"),
    "rate_arcsec_s": ("beam's drift", "arcsec/s"),
    "siderostat_setpoint_rad": ("siderostat set-point", "rad"),
    "tilt_arcsec": ("tilt between stars", "arcsec"),
    "visibility": ("visibility", ""),
}
_NOT_REPLAYED = {"plant", "mocks", "logging", "service"}
"""Tables of a rig that neither its supervisor nor its loops read: a replay simulates and records nothing."""
_OPEN_LOOP = (
    "open loop: today's commands do not change the frames, which are the log's; after each tick the stages are "
    "where\nthe log sent them; modes and the controllers' own state continue from today's"
)


def replay(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG...", help="All files of one run, from the first on."),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option("--rig", metavar="FILE", help="Rig file. [default: the one in the log]"),
    ] = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    as_json: JsonOption = False,
    latest: LatestOption = False,
) -> None:
    """Run the frames of a log through today's code, and show where it decides differently.

    A changed command changes no frames. With --controller, that controller stays in force to the end, and the
    command estimates the RMS that it would leave. Exit status 0 if every mode and command is the same to the
    last bit, or if you changed something with --controller, --set or --rig; 1 if they differ without; 2 if the
    log cannot be replayed.
    """
    for override in overrides or ():
        table = override.partition("=")[0].partition(".")[0].strip()
        if table in _NOT_REPLAYED:
            msg = f"replay: --set {override}: a replay uses nothing of the table {table}; leave it out"
            raise ConfigError(msg)
    logs = chosen_logs("replay", logs, rig, latest=latest)
    # Its copies of files would outlive it.
    with ended_by_signals(interrupt), whole_run(logs) as info, logged_files(info) as files:
        settings = _rig(info, files, rig, overrides or [], controller)
        dark_file = None if rig else missing_dark_file(info, settings)
        if dark_file is not None:
            msg = (
                f"{info.path}: an older fitctl recorded it, and kept only the dark frame's name, "
                f"{plain(dark_file)}; no file is read because a log names it: name the dark frame with "
                "--set camera.dark_file=FILE"
            )
            raise ConfigError(msg)
        result = _replayed(info, settings, keep_controllers=controller is not None)
        left = [] if controller is None else _what_is_left(logs, rig, settings)
    named = ", ".join(map(str, logs))
    if as_json:
        document = _document(named, info, settings, result)
        document |= {"controllers": [each._asdict() for each in left]} if left else {}
        say(to_json(document))
    else:
        lines = [
            *_lines(named, info, settings, result),
            *(x for each in left for x in each.lines()),
        ]
        for line in lines:
            say(line)
    asked = bool(controller or overrides or rig)
    raise typer.Exit(0 if result.same or asked else FAILED)


def _replayed(info: LogInfo, rig: Rig, *, keep_controllers: bool) -> ReplayResult:
    """The replay, with its progress."""
    with progress_line("replaying", info.duration_s) as progress:
        result = replay_steps(
            rig, read_steps(info, rig), on_tick=progress, keep_controllers=keep_controllers
        )
        progress(info.duration_s)
    if not any(loop.ticks for loop in result.loops.values()):
        msg = (
            f"{info.path}: has no complete tick of a loop, so nothing was replayed; expected one at least: "
            "name a longer log"
        )
        raise ConfigError(msg)
    return result


class Left(NamedTuple):
    """What controllers leave of a loop's error; RMS in px.

    Attributes
    ----------
    loop : str
    measured : dict of str to tuple of float
        In the log, az and el, under each controller that it had.
    expected : dict of str to float
        On frames, of the worse axis, with the log's last controller and with the one that was asked for.
    true : dict of str to float
        Likewise, of the star itself: in continuous time, and without the sensor's noise.
    why_not : str
        Why nothing is expected.
    """

    loop: str
    measured: dict[str, tuple[float, float]]
    expected: dict[str, float]
    true: dict[str, float]
    why_not: str = ""

    def lines(self) -> list[str]:
        """For people."""
        lines = [
            f"loop {self.loop}, RMS of the error in the log with {name}: az {az:.4f} px, el {el:.4f} px"
            for name, (az, el) in self.measured.items()
        ]
        lines += [
            f"loop {self.loop}, RMS expected on the same night with {name}: {px:.4f} px on frames, "
            f"true {self.true[name]:.4f} px"
            for name, px in self.expected.items()
        ]
        if self.why_not:
            lines.append(f"loop {self.loop}: no expected RMS: {self.why_not}")
        return lines


def _what_is_left(logs: Sequence[Path], file: Path | None, asked: Rig) -> list[Left]:
    """Of each stellar loop: its RMS in the log, and what designs leave of the night that the log shows."""
    gathered = gather(find_run(logs, None if file is None else load_rig(file)))
    return [_left(gathered, loop, asked) for loop in asked.stellar_loops]


def _left(gathered: Gathered, name: str, asked: Rig) -> Left:
    measured: dict[str, tuple[float, float]] = {}
    try:
        loop = opened_loop(gathered, name)
        for held in held_by_controller(gathered, name, loop.selection):
            measured[held.controller] = (held.residual["az"].rms, held.residual["el"].rms)
        _, truth, _ = estimated(loop.series, basis(gathered.run.rig, name))
        design = design_for(asked, name)
        found = {loop.present.title: standing(loop.present, truth)}
        found[_asked_title(design)] = standing(design, truth)
    except ConfigError as error:
        return Left(name, measured, {}, {}, str(error))
    return Left(
        name,
        measured,
        {title: stands.camera_px for title, stands in found.items()},
        {title: stands.residual_px for title, stands in found.items()},
    )


def _asked_title(design: Design) -> str:
    """Of a saved design the name of its file: the log's controller may have the design's own name."""
    return Path(design.file).name if design.file and not design.own else design.title


def _rig(
    info: LogInfo,
    files: Sequence[str],
    path: Path | None,
    overrides: Sequence[str],
    controller: str | None,
) -> Rig:
    """The log's rig or the one of a file, with values replaced; its loops and frames must be the log's."""
    in_log = info.metadata.get("rig", {}).get("json")
    if in_log is None:
        msg = f"{info.path}: has no rig file in it; name a log that fitctl recorded"
        raise ConfigError(msg)
    origin = f"the rig in {info.path}"

    def read(changes: Sequence[str]) -> Rig:
        return load_rig(path, changes) if path else rig_from_log(in_log, origin, [*files, *changes])

    rig = read(overrides)
    if controller is not None:
        with blaming_controller():
            rig = read([*overrides, *controller_overrides(rig.stellar_loops, controller)])
    try:
        unlike = unlike_the_log(rig, in_log)
    except NO_RIG as error:
        msg = (
            f"{origin}: is not as fitctl records it: {error!r}; expected JSON with tables loops and camera; "
            "name a log that fitctl recorded"
        )
        raise ConfigError(msg) from None
    if unlike:
        msg = f"replay: {unlike}; replace other values, or none"
        raise ConfigError(msg)
    return rig


def _from_start_s(info: LogInfo, time_s: float) -> float:
    """Seconds after the log's first record, as `fitctl log cut` takes them, of a monotonic time."""
    return time_s + clock_of(info.path, info.metadata).wall_minus_monotonic_s - info.start_s


def _document(named: str, info: LogInfo, rig: Rig, result: ReplayResult) -> dict[str, Any]:
    loops = {}
    for name, loop in result.loops.items():
        loops[name] = document = asdict(loop)
        for difference in document["differences"].values():
            difference["first_s"] = _from_start_s(info, difference["first_s"])
        document["mode"]["first_s"] = _from_start_s(info, loop.mode.first_s)
    span_s = result.end_s - result.start_s
    return {
        "log": named,
        "rig": rig.name,
        "same": result.same,
        "span_s": span_s,
        "speed_x": span_s / result.wall_s,
        "records_lost": result.records_lost,
        "refused": result.refused,
        "controllers_left_out": result.controllers_left_out,
        "loops": loops,
    }


def _lines(named: str, info: LogInfo, rig: Rig, result: ReplayResult) -> Iterator[str]:
    span_s = result.end_s - result.start_s
    yield f"{named}: {span_s:.1f} s of rig {rig.name}, replayed at {span_s / result.wall_s:.0f}x real time"
    for name, loop in result.loops.items():
        yield from _loop_lines(info, name, loop)
    yield from (f"accepted then, refused today: {text}" for text in result.refused)
    if result.controllers_left_out:
        yield f"left out: the log's commands to change the controller ({result.controllers_left_out})"
    if result.records_lost:
        yield f"{result.records_lost} records were lost on the way to the log; what follows them may differ"
    if result.same:
        yield "the same, to the last bit"
        return
    yield from _other_designs(info, rig)
    yield from _OPEN_LOOP.splitlines()


def _loop_lines(info: LogInfo, name: str, loop: LoopReplay) -> Iterator[str]:
    yield f"loop {name}: {loop.ticks} ticks"
    if loop.frames_missing:
        yield (
            f"  {loop.frames_missing} frames are not in the log; their ticks were replayed without, "
            "so what follows may differ"
        )
    yield f"  {'differs':<22}{'ticks':>8}{'first at':>12}{'worst':>16}{'rms':>16}"
    mode = loop.mode
    first = f"{_from_start_s(info, mode.first_s):>10.2f} s   {mode.then} then, {mode.now} now"
    yield f"  {'mode':<22}{mode.ticks:>8}" + (first if mode.ticks else "")
    for what, (title, unit) in _ROWS.items():
        if (found := loop.differences.get(what)) is None:
            continue
        first = f"{_from_start_s(info, found.first_s):>10.2f} s"
        sizes = "".join(
            f"{f'{value:.3g} {unit}'.rstrip():>16}" for value in (found.worst, found.rms)
        )
        yield f"  {title:<22}{found.ticks:>8}" + (first + sizes if found.ticks else "")


def _other_designs(info: LogInfo, rig: Rig) -> Iterator[str]:
    """Where the controller to begin with is not that of the log."""
    logged = designs_of(info.metadata)
    for name in [name for name in rig.stellar_loops if name in info.metadata.get("designs", {})]:
        design = design_for(rig, name)
        then, now = logged.get(name, {}), json.loads(design_json(design))
        was, asked = plain(str(then.get("name"))), _asked_title(design)
        if all(then.get(matrix) == now[matrix] for matrix in MATRICES):
            continue
        if was != asked:
            yield f"loop {name} begins with controller {asked}, in the log with {was}"
        else:
            yield f"loop {name}: today's design of {asked} is not the log's"
