"""`fitctl identify`: an experiment (on a rig, mocks, the virtual clock) or a log, and what it gives."""

from __future__ import annotations

import itertools
import os
import stat
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from fitctl import demo as demos
from fitctl.commands.shared.exits import FAILED, UNUSABLE
from fitctl.commands.shared.logs import LatestOption, chosen_log
from fitctl.commands.shared.options import JsonOption, LoopOption, RigOption, SeedOption, SetOption
from fitctl.commands.shared.printing import progress_line, say, to_json
from fitctl.commands.shared.rig import named_rig, require_loop, rig_of
from fitctl.commands.shared.supervisor import address, address_or_shipped, client_of, show_rig
from fitctl.config import ConfigError, Rig, default_rig_path, rig_from_log
from fitctl.files import write_whole
from fitctl.identify.errors import IdentifyError
from fitctl.identify.experiments import (
    EXPERIMENTS,
    Finding,
    response_on_mock_bench,
)
from fitctl.identify.fragments import fragment_text
from fitctl.identify.run import Progress, on_rig, on_simulation, require_vernier
from fitctl.logging.reading import log_info, logs_of_one_run_each
from fitctl.messages.modes import Mode
from fitctl.processes import ended_by_signals, interrupt

_PLOTS = {".png": "Software", ".svg": "Creator"}  # and which of its metadata says who wrote it
_MOST_HEAD = 4096  # bytes before the end of a plot's metadata, at most
_MOCK_VERNIER_S = 60.0
_MOCK_SETTLE_S = 5.0
_BENCH_ONLY = (
    "the response is measured on a bench of its own, with a position-sensing detector: give its "
    "record with --log FILE (NPZ or CSV), or --mocks for the mock bench"
)


class Source(NamedTuple):
    """Where the records come from; without any of these, from the rig's running supervisor."""

    log: Path | None
    simulate: bool
    mock: bool
    seed: int


def identify(
    what: Annotated[
        str,
        typer.Argument(
            help="hysteresis, backlash, response, airpath, delay or spot; of a link: feedforward, photodiodes, "
            "link_delay or ambient."
        ),
    ],
    rig: RigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    log: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="Use this log (or bench file) of an earlier run."),
    ] = None,
    latest: LatestOption = False,
    simulated: Annotated[
        bool, typer.Option("--simulate", help="Make the experiment on the virtual clock.")
    ] = False,
    mock: Annotated[
        bool, typer.Option("--mocks", help="Start the mock devices of the rig for the experiment.")
    ] = False,
    seed: SeedOption = 0,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Fragment to write. [default: RIG-LOOP-WHAT.toml]"),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Plot to write. [default: a PNG beside the fragment]"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the parameters of a rig, and write a fragment that its rig file includes.

    Without --log, --latest, --simulate or --mocks, the running supervisor makes the experiment: the loop must
    hold a star in VERNIER. The stages then move open loop; STOP ends the experiment at once. The parameters of
    a link come from the log of a sequence: name it with --log or --latest. Exit status 1 if an experiment gives
    no parameters, 2 if a log gives none.
    """
    if what not in EXPERIMENTS:
        msg = f"identify: unknown experiment {what!r}. Available: {', '.join(EXPERIMENTS)}"
        raise ConfigError(msg)
    given, is_named = overrides or [], named_rig(rig) is not None
    if latest:
        found = address_or_shipped("identify", rig, overrides)
        rig, overrides = found.file, found.settings
        log = chosen_log("identify", log, rig, latest=True)
    step = EXPERIMENTS[what].step
    _require_one_source(what, step, log, simulated=simulated, mock=mock, seed=seed)
    if not (log or simulated or mock):
        found = address("identify", rig, overrides)
        rig, overrides = found.file, found.settings
    # The log of a response is a file of the bench, which has no rig.
    log_of_run = None if what == "response" else log
    if log_of_run is not None:
        logs_of_one_run_each([log_of_run])
    settings = (
        rig_of(rig, overrides) if log_of_run is None or is_named else _rig_in(log_of_run, given)
    )
    if not (log or simulated or mock):
        show_rig(settings.name, str(rig))
    if not step or loop not in settings.loops:
        require_loop("identify", settings, loop)
    source = Source(log, simulated, mock, seed)
    by = f"fitctl identify {what}{' --simulate' * simulated}{' --mocks' * mock}"
    fragment_path = out or Path(f"{settings.name}-{loop}-{what}.toml")
    plot_path = _plot_path(fragment_path, plot, by)
    try:
        with ended_by_signals(interrupt), progress_line(f"identify {what}") as progress:
            finding = _finding(
                settings, rig or default_rig_path(), overrides or [], what, loop, source, progress
            )
        # The plot first: it shows why, where there is nothing to write for the rig.
        mark = {_PLOTS[plot_path.suffix]: f"Written by `{by}`"}
        _write(plot_path, lambda: finding.draw().savefig(plot_path, metadata=mark))
        text = fragment_text(by, settings, finding.lines(), finding.fragment())
    except (IdentifyError, ConnectionError, demos.DemoError) as error:
        named = f"{log}: " if log else ""
        say(f"identify {what}: {named}{error}", err=True)
        raise typer.Exit(UNUSABLE if log else FAILED) from None
    _write(fragment_path, lambda: write_whole(fragment_path, text.encode()))
    if as_json:
        found_values = {"what": what, "loop": loop, "values": finding.fragment()}
        written = {"fragment": str(fragment_path), "plot": str(plot_path)}
        say(to_json(found_values | written | {"lines": finding.lines()}))
        return
    for line in finding.lines():
        say(line)
    say(f"written: {fragment_path} (name it in the rig file's include list), {plot_path}")


def _require_one_source(
    what: str, step: str, log: Path | None, *, simulated: bool, mock: bool, seed: int
) -> None:
    if step and log is None:
        msg = (
            f"identify: {what} is evaluated from the log of a sequence with the step {step}; run one with "
            f"fitctl sequence run, and name its log with --log, or with --latest"
        )
        raise ConfigError(msg)
    if (log is not None) + simulated + mock > 1:
        msg = "identify: --log, --simulate and --mocks exclude each other; give one, or none for the rig"
        raise ConfigError(msg)
    if seed and not (simulated or mock):
        msg = "identify: --seed is for --simulate and --mocks; leave it out"
        raise ConfigError(msg)


def _rig_in(log: Path, overrides: list[str]) -> Rig:
    """The rig that a log was recorded with, for people too."""
    in_log = log_info(log).metadata.get("rig", {}).get("json")
    if in_log is None:
        msg = f"identify: {log}: has no rig file in it; name one with --rig"
        raise ConfigError(msg)
    rig = rig_from_log(in_log, f"the rig in {log}", overrides)
    show_rig(rig.name, f"in {log}")
    return rig


def _plot_path(fragment: Path, wanted: Path | None, by: str) -> Path:
    """Where the plot goes; refuses, before minutes of an experiment, what could not be written after them."""
    _require_writable(fragment)
    _require_own(fragment, by, "--out")
    plot = wanted or fragment.with_suffix(".png")
    if plot.suffix not in _PLOTS:
        msg = f"identify: {plot}: plots are {' or '.join(_PLOTS)}; name another with --plot"
        raise ConfigError(msg)
    if plot.resolve() == fragment.resolve():
        msg = f"identify: {plot}: is both the fragment and the plot; name another with --out or --plot"
        raise ConfigError(msg)
    _require_writable(plot)
    _require_own(plot, by, "--plot")
    return plot


def _require_writable(path: Path) -> None:
    try:
        is_writable = stat.S_ISREG(path.stat().st_mode) and os.access(path, os.W_OK)
    except FileNotFoundError:
        is_writable = os.access(path.parent, os.W_OK)
    except OSError:  # a name that is too long, or a folder that one may not enter
        is_writable = False
    if not is_writable:
        msg = f"identify: {path}: nothing can be written there; name another with --out or --plot"
        raise ConfigError(msg)


def _require_own(path: Path, by: str, option: str) -> None:
    """Refuse a file that another command wrote; a simulated run does not replace what was measured either."""
    try:
        with path.open("rb") as file:
            head = file.readline(200) if option == "--out" else file.read(_MOST_HEAD)
        is_own = (
            f"Written by `{by}".encode() in head
        )  # a measured run also replaces `... --simulate`
    except FileNotFoundError:
        return
    except OSError:
        is_own = False
    if not is_own:
        msg = (
            f"identify: {path}: exists already, and was not written by {by}; name another file with "
            f"{option}, or move that one away"
        )
        raise ConfigError(msg)


def _write(path: Path, write: Callable[[], object]) -> None:
    try:
        write()
    except OSError as error:
        msg = f"identify: {path}: cannot be written: {error}; name another with --out or --plot"
        raise ConfigError(msg) from None


def _finding(
    rig: Rig,
    rig_path: Path,
    overrides: Sequence[str],
    what: str,
    loop_name: str,
    source: Source,
    progress: Progress,
) -> Finding:
    experiment = EXPERIMENTS[what]
    if source.log is not None:
        return experiment.from_log(rig, loop_name, source.log)
    if experiment.plan is None or experiment.from_records is None:
        if not (source.simulate or source.mock):
            raise IdentifyError(_BENCH_ONLY)
        rig.mock_parts()
        return response_on_mock_bench(rig, loop_name, source.seed, _by_axis(progress))
    drives = experiment.plan(rig, loop_name)
    if source.simulate:
        rig.mock_parts()
        records = on_simulation(rig, loop_name, what, drives, source.seed, progress)
        return experiment.from_records(rig, loop_name, records)
    if source.mock:
        rig.mock_parts()
        with demos.instrument(rig_path, overrides, source.seed) as running:
            _hold_a_star(running, loop_name)
            paths = on_rig(running.client, rig, loop_name, what, drives, progress)
            return experiment.from_logs(rig, loop_name, paths)
    client = client_of(rig)
    try:
        require_vernier(client, loop_name)
        paths = on_rig(client, rig, loop_name, what, drives, progress)
    finally:
        client.close()
    return experiment.from_logs(rig, loop_name, paths)


def _by_axis(progress: Progress) -> Callable[[str], None]:
    """Progress by halves."""
    done = itertools.count()
    return lambda _axis: progress(next(done) / 2)


def _hold_a_star(running: demos.Instrument, loop_name: str) -> None:
    demos.acquire(running)
    deadline_s = time.monotonic() + _MOCK_VERNIER_S
    since_s = None
    while since_s is None or time.monotonic() < since_s + _MOCK_SETTLE_S:
        running.check()
        telemetry = running.client.receive(0.5)
        modes = {} if telemetry is None else {loop.name: loop.mode for loop in telemetry.loops}
        if since_s is None and modes.get(loop_name) == Mode.VERNIER.name:
            since_s = time.monotonic()
        if since_s is None and time.monotonic() > deadline_s:
            msg = f"the mock star was not held within {_MOCK_VERNIER_S:g} s; modes {modes}"
            raise IdentifyError(msg)
