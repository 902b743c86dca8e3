"""`fitctl log`: what is in a log, whether it is whole, and other files made from it."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from fitctl.commands.shared.exits import FAILED, UNUSABLE
from fitctl.commands.shared.log_time import time_ns
from fitctl.commands.shared.logs import (
    LatestOption,
    log_alone,
    logging_rig,
    logs_alone,
    say_left_out,
)
from fitctl.commands.shared.options import (
    JsonArrayOption,
    JsonOption,
    OverwriteOption,
    RigOption,
    SetOption,
)
from fitctl.commands.shared.printing import say, to_json
from fitctl.config import ConfigError
from fitctl.logging import copying, exporting, folder, verifying
from fitctl.logging.errors import LogError
from fitctl.logging.listing import logs_in, rig_name
from fitctl.logging.reading import LogInfo, log_info
from fitctl.text import plain

_TOO_LARGE = "too large to be read here"

app = typer.Typer(help="Inspect, repair and convert logs.")

LogArgument = Annotated[
    Path | None, typer.Argument(metavar="LOG", help="An MCAP file, finished or not.")
]
LogsArgument = Annotated[
    list[Path] | None, typer.Argument(metavar="LOG...", help="MCAP files, finished or not.")
]
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="TOPIC",
        help="Only these topics, such as '/fit/right/*'; may be repeated.",
    ),
]


class Format(StrEnum):
    """What can be exported, by the file's ending."""

    csv = "csv"
    parquet = "parquet"
    npz = "npz"


@app.command("list")
def list_(
    rig: RigOption = None, overrides: SetOption = None, as_json: JsonArrayOption = False
) -> None:
    """List the logs of a rig, the newest last.

    Reads the folder `logging.folder` of the rig file. Exit status 1 if a log in it cannot be read.
    """
    where = logging_rig("log list", rig, overrides).logging.folder_path
    found, problems = logs_in(where)
    logs = [(log, size) for log in found if (size := _size(log.path)) is not None]
    if as_json:
        say(to_json([_listed(log, size) for log, size in logs]))
    elif not logs:
        say(f"{where}: no logs")
    else:
        for log, size in logs:
            begin = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(log.start_s))
            span = f"{begin}  {log.duration_s:9.1f} s" if log.counts else "without any record"
            of = f"{rig_name(log)}, {_state(log.path, log)}"
            say(f"{log.path}  {span:<36}  {size / 1e6:9.1f} MB  {of}")
    for problem in problems.values():
        say(str(problem), err=True)
    raise typer.Exit(FAILED if problems else 0)


def _size(log: Path) -> int | None:
    """Bytes of a log; None where the recorder has just deleted it."""
    try:
        return log.stat().st_size
    except FileNotFoundError:
        return None


def _listed(found: LogInfo, size: int) -> dict[str, object]:
    document = _info_document(
        found, size, kept=folder.is_kept(found.path), recording=folder.in_use(found.path)
    )
    del document["counts"], document["metadata"]
    return document | {"rig": rig_name(found)}


def _state(log: Path, found: LogInfo) -> str:
    unfinished = "cut off; `fitctl log recover` mends it" if found.counts else "cut off"
    if folder.in_use(log):
        unfinished = "being recorded"
    return ("finished" if found.finished else unfinished) + (
        "; kept" if folder.is_kept(log) else ""
    )


@app.command()
def info(
    logs: LogsArgument = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result as one JSON object, with the rig file.")
    ] = False,
    latest: LatestOption = False,
    rig: RigOption = None,
) -> None:
    """Show what logs hold.

    With --json, prints one object a line for each log.
    """
    for log in logs_alone("log info", logs, rig, latest=latest):
        found = log_info(log)
        if as_json:
            kept, recording = folder.is_kept(log), folder.in_use(log)
            say(to_json(_info_document(found, _size(log), kept=kept, recording=recording)))
        else:
            _print_info(found)


def _print_info(found: LogInfo) -> None:
    say(f"{found.path}: {_state(found.path, found)}")
    if found.counts:
        start = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(found.start_s))
        say(f"from {start}, {found.duration_s:.1f} s")
    else:
        say("without any record")
    width = max(map(len, found.counts), default=0)
    for topic, count in sorted(found.counts.items()):
        say(f"  {topic:<{width}}  {count}")


def _info_document(
    found: LogInfo, size: int | None, *, kept: bool, recording: bool
) -> dict[str, object]:
    span = {"start_s": found.start_s, "end_s": found.end_s} if found.counts else {}
    return {
        "path": str(found.path),
        "bytes": size,
        "finished": found.finished,
        "recording": recording,
        "kept": kept,
        **span,
        "counts": found.counts,
        "metadata": found.metadata,
    }


@app.command()
def summary(
    logs: LogsArgument = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object a line.")] = False,
    most_bytes: Annotated[
        int, typer.Option(min=1, metavar="BYTES", help="Only name files that are larger.")
    ] = 1 << 40,
    latest: LatestOption = False,
    rig: RigOption = None,
) -> None:
    """Print start, length and RMS of each log.

    Prints one line for each log as soon as it is read. The verdict is that of `fitctl report`. Exit status 2 if
    a log cannot be read; the others are summarised.
    """
    failed = False
    for log in logs_alone("log summary", logs, rig, latest=latest):
        line = _summary(log, most_bytes)
        unreadable = line.error not in {"", _TOO_LARGE}
        failed = failed or unreadable
        if as_json:
            say(to_json(line))
        elif unreadable:
            say(line.error, err=True)
        else:
            rms = ", ".join(f"{name} {text}" for name, text in line.rms.items())
            words = f"{_span(line)}, requirement {line.verdict}"
            say(f"{log}: {line.error or words}" + (f": {rms}" if rms else ""))
    raise typer.Exit(UNUSABLE if failed else 0)


def _span(line: LogSummary) -> str:
    if line.start_s is None or line.duration_s is None:
        return "without any record"
    start = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(line.start_s))
    return f"{start}, {line.duration_s:.0f} s"


class LogSummary(msgspec.Struct, kw_only=True):
    """One line of `fitctl log summary`. ``rms`` is text, by loop; times are None where they are not known."""

    path: str
    bytes: int
    start_s: float | None = None
    duration_s: float | None = None
    verdict: str = "not known"
    rms: dict[str, str] = {}
    error: str = ""


def _summary(log: Path, most_bytes: int) -> LogSummary:
    """What is known of a log; of one that is too large or cannot be read, why no more."""
    # Not at the top: scipy must not delay the other commands.
    from fitctl.report.findings import find
    from fitctl.report.run import find_run

    line = LogSummary(path=str(log), bytes=0)
    try:
        line.bytes = log.stat().st_size
        found = log_info(log)
        if found.counts:
            line.start_s, line.duration_s = found.start_s, found.duration_s
        if line.bytes > most_bytes:
            line.error = _TOO_LARGE
            return line
        findings = find(find_run([log]))
        say_left_out(findings.gathered)
    except (LogError, ConfigError) as error:
        line.error = str(error)
        return line
    except OSError as error:
        line.error = f"{log}: cannot be read: {error.strerror or error}; name another log"
        return line
    line.verdict = findings.word
    for name, loop in findings.loops.items():
        worst = max((estimate.rms for estimate in loop.residual.values()), default=math.nan)
        if math.isfinite(worst):
            line.rms[name] = f"{worst:.3f} {loop.quantity.unit}"
    return line


@app.command()
def verify(
    logs: LogsArgument = None,
    latest: LatestOption = False,
    rig: RigOption = None,
    as_json: JsonArrayOption = False,
) -> None:
    """Check that logs are whole.

    Reads each log from end to end: checksums, index, order, every message. Exit status 1 if one is damaged, 2
    if one cannot be read or is no log.
    """
    status, documents = 0, []
    for log in logs_alone("log verify", logs, rig, latest=latest):
        try:
            verdict = verifying.verify(log)
        except LogError as error:
            say(str(error), err=True)
            status = UNUSABLE
            documents.append({"path": str(log), "whole": False, "problems": [str(error)]})
            continue
        if verdict.problems:
            status = max(status, FAILED)
        if as_json:
            documents.append({"path": str(log), "whole": not verdict.problems, **asdict(verdict)})
            continue
        say(
            f"{log}: {'not whole' if verdict.problems else 'whole'}; {verdict.records} records, "
            f"{verdict.lost} lost on the way, {verdict.frames_missing} frames missing"
        )
        for problem in verdict.problems:
            say(f"  {problem}")
    if as_json:
        say(to_json(documents))
    raise typer.Exit(status)


@app.command()
def recover(
    log: LogArgument = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Log to write. [default: LOG_recovered.mcap]"),
    ] = None,
    overwrite: OverwriteOption = False,
    latest: LatestOption = False,
    rig: RigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a whole log from a damaged one.

    LOG itself does not change. Exit status 1 if the new log has problems too: what a record says is not mended.
    """
    log = log_alone("log recover", log, rig, latest=latest)
    if folder.in_use(log):
        msg = f"{log}: is still being recorded; there is nothing to repair"
        raise ConfigError(msg)
    if not verifying.verify(log).problems:
        if as_json:
            say(to_json({"log": str(log), "out": None}))
        else:
            say(f"{log}: is not damaged; there is nothing to repair")
        return
    target = out or log.with_name(f"{log.stem}_recovered.mcap")
    _insist_on_another(target, [log])
    saved = copying.recover(log, target, overwrite=overwrite)
    left = verifying.verify(target).problems
    if as_json:
        say(to_json({"log": str(log), "out": str(target), **asdict(saved), "problems": left}))
        raise typer.Exit(FAILED if left else 0)
    lost = f"{saved.damaged_chunks} damaged chunks skipped, " if saved.damaged_chunks else ""
    if saved.undescribed:
        lost += f"{saved.undescribed} records lost that only a damaged chunk describes, "
    if saved.went_back:
        lost += f"{saved.went_back} log times that went back set to the one before, "
    say(
        f"{target}: {saved.records} records saved; {lost}{saved.unread_bytes} bytes at the end unreadable"
    )
    for problem in left:
        say(f"  cannot be mended: {problem}")
    raise typer.Exit(FAILED if left else 0)


@app.command()
def cut(
    log: LogArgument = None,
    from_: Annotated[
        str, typer.Option("--from", metavar="TIME", help="Seconds after LOG's start, or UTC.")
    ] = "0",
    to: Annotated[
        str | None,
        typer.Option("--to", metavar="TIME", help="End of the span, exclusive, in the same form."),
    ] = None,
    topic: TopicOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Log to write. [default: LOG_cut.mcap]"),
    ] = None,
    overwrite: OverwriteOption = False,
    latest: LatestOption = False,
    rig: RigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Copy a span of time, some topics, or both.

    UTC times look like 2026-11-21T09:18:30.5.
    """
    log = log_alone("log cut", log, rig, latest=latest)
    found = log_info(log)
    if not found.counts:
        msg = f"cut: {log} has no record, so there is nothing to cut; name another log"
        raise ConfigError(msg)
    from_ns = time_ns("--from", from_, found)
    to_ns = 2**64 if to is None else time_ns("--to", to, found)  # MCAP has unsigned 64 bit
    if to_ns <= from_ns:
        msg = (
            f"cut: --to {to} is not after --from {from_}; choose a later --to, or an earlier --from"
        )
        if to is None:
            msg = f"cut: {log} ends before --from {from_}; choose an earlier --from"
        raise ConfigError(msg)
    target = out or log.with_name(f"{log.stem}_cut.mcap")
    _insist_on_another(target, [log])
    topics = _topics(found, topic)
    records = copying.cut(
        log, target, from_ns=from_ns, to_ns=to_ns, topics=topics, overwrite=overwrite
    )
    if as_json:
        say(to_json({"log": str(log), "out": str(target), "records": records}))
        return
    say(f"{target}: {records} of {sum(found.counts.values())} records")


@app.command()
def merge(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="MCAP files.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Log to write.")],
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Join logs in the order of time.

    For example the logs of one night, or the two halves of a log that a crash cut in two.
    """
    _insist_on_another(out, logs)
    records, doubles = copying.merge(logs, out, overwrite=overwrite)
    if as_json:
        say(to_json({"out": str(out), "records": records, "doubles": doubles}))
        return
    also = f"; {doubles} were in two logs" if doubles else ""
    say(f"{out}: {records} records of {len(logs)} logs{also}")


@app.command()
def export(
    format_: Annotated[Format, typer.Option("--format", help="CSV has no frames.")],
    log: LogArgument = None,
    topic: TopicOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder to write. [default: LOG_FORMAT beside LOG]"
        ),
    ] = None,
    latest: LatestOption = False,
    rig: RigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write each topic of a log as a table.

    The names of the columns have units.
    """
    log = log_alone("log export", log, rig, latest=latest)
    topics = _topics(log_info(log), topic)
    target = out or log.with_name(f"{log.stem}_{format_}")
    files = exporting.export(log, target, format_.value, topics)
    if as_json and files:
        written = [{"file": str(file), "rows": rows} for file, rows in sorted(files.items())]
        say(to_json({"log": str(log), "files": written}))
    for file, rows in () if as_json else sorted(files.items()):
        say(f"{file}: {rows} rows")
    if not files:
        msg = f"export: {log} has nothing to write as {format_}; frames need npz or parquet"
        raise ConfigError(msg)


@app.command()
def keep(
    logs: LogsArgument = None,
    undo: Annotated[bool, typer.Option("--undo", help="Remove the protection.")] = False,
    latest: LatestOption = False,
    rig: RigOption = None,
) -> None:
    """Protect logs from deletion by the recorder.

    Makes an empty file LOG.keep beside each log.
    """
    for log in logs_alone("log keep", logs, rig, latest=latest):
        folder.keep(log, kept=not undo)
        say(f"{log}: {'no longer kept' if undo else 'kept'}")


def _insist_on_another(target: Path, logs: list[Path]) -> None:
    """Refuse to overwrite a log with what is made from it, under whichever name: the rest of it would be lost.

    Raises
    ------
    ConfigError
        If the target is one of the logs.
    """
    if any(target.exists() and log.exists() and target.samefile(log) for log in logs):
        msg = f"{target}: is the log itself, which must not change; give another name with --out"
        raise ConfigError(msg)


def _topics(found: LogInfo, patterns: list[str] | None) -> list[str]:
    """The log's topics that are asked for; all without patterns.

    Raises
    ------
    ConfigError
        If a pattern is of no topic.
    """
    for pattern in patterns or ():
        if not any(fnmatchcase(topic, pattern) for topic in found.counts):
            there = plain(", ".join(sorted(found.counts))) or "none"
            msg = f"--topic {pattern}: {found.path} has no such topic. Available: {there}"
            raise ConfigError(msg)
    return [
        topic
        for topic in sorted(found.counts)
        if not patterns or any(fnmatchcase(topic, pattern) for pattern in patterns)
    ]
