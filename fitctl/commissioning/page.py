"""A commissioning on one page, to file, and compared with another one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from typing import Any, NamedTuple

from fitctl.commissioning.record import Commissioning, Entry

_STYLE = """
body { font: 15px/1.4 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; width: 100%; margin: .5rem 0 1.5rem; }
th, td { border-bottom: 1px solid #ccc; padding: .25rem .6rem .25rem 0; text-align: left; vertical-align: top; }
td.n { text-align: right; font-variant-numeric: tabular-nums; }
.failed { color: #a00; font-weight: 600; } .corrected, .measured { color: #850; } .passed { color: #060; }
@media print { body { margin: 0; font-size: 11px; } }
"""


class Change(NamedTuple):
    """A figure in two commissionings; None where one has not measured it."""

    figure: str
    now: float | None
    then: float | None

    @property
    def relative(self) -> float | None:
        """By which part it has changed."""
        if self.now is None or not self.then:
            return None
        return self.now / self.then - 1


def changes(now: Commissioning, then: Commissioning) -> list[Change]:
    """Every figure of both, in the order of the newer one."""
    one, other = now.figures(), then.figures()
    return [Change(name, one.get(name), other.get(name)) for name in {**one, **other}]


def flat(table: dict[str, Any], under: str = "") -> dict[str, Any]:
    """A fragment's values by their whole keys."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        whole = f"{under}.{key}" if under else key
        found |= flat(value, whole) if isinstance(value, dict) else {whole: value}
    return found


def verdict(record: Commissioning, tasks: Iterable[str]) -> str:
    """What the record comes to, in one line."""
    entries = {name: record.tasks.get(name) for name in tasks}
    failed = [name for name, entry in entries.items() if entry and entry.state == "failed"]
    skipped = [name for name, entry in entries.items() if entry and entry.state == "skipped"]
    left = [name for name, entry in entries.items() if entry is None]
    if failed:
        return f"not commissioned: {', '.join(failed)} failed"
    if left:
        return f"not commissioned yet: {', '.join(left)} to do"
    if skipped:
        return f"commissioned, but for what was skipped: {', '.join(skipped)}"
    return "commissioned"


def page(
    record: Commissioning, titles: dict[str, str], earlier: Commissioning | None = None
) -> str:
    """The page as HTML that needs no other file.

    Parameters
    ----------
    record : Commissioning
    titles : dict
        What each task does, by its name, in their order.
    earlier : Commissioning, optional
        Compared with the record.
    """
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f"<title>Commissioning of {escape(record.rig)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>Commissioning of {escape(record.rig)}</h1>",
        f"<p><strong>Verdict: {escape(verdict(record, titles))}.</strong></p>",
        "<h2>Steps</h2>",
        _table(("step", "result", "ended", "took", "what was seen"), _steps(record, titles)),
        "<h2>Found, other than the rig file said</h2>",
        _table(("key", "value"), _found(record)),
        "<h2>Figures</h2>",
        _table(("figure", "value"), _figures(record)),
    ]
    if earlier is not None:
        parts += [
            "<h2>Compared with the earlier commissioning</h2>",
            _table(("figure", "now", "then", "change"), _compared(record, earlier)),
        ]
    return "\n".join([*parts, "</body></html>", ""])


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    header = "".join(f"<th>{escape(one)}</th>" for one in head)
    body = "\n".join(f"<tr>{''.join(cells)}</tr>" for cells in rows)
    return f"<table><tr>{header}</tr>\n{body}</table>" if body else "<p>None.</p>"


def _cell(text: str, kind: str = "") -> str:
    return f'<td class="{kind}">{escape(text)}</td>' if kind else f"<td>{escape(text)}</td>"


def _steps(record: Commissioning, titles: dict[str, str]) -> Iterator[list[str]]:
    for name, title in titles.items():
        entry = record.tasks.get(name)
        head = _cell(f"{name}: {title}")
        if entry is None:
            yield [head, _cell("not done"), _cell(""), _cell(""), _cell("")]
            continue
        yield [
            head,
            _cell(entry.state, entry.state),
            _cell(entry.at),
            _cell(f"{entry.took_s:.0f} s", "n"),
            f"<td>{'<br>'.join(map(escape, _seen(entry)))}</td>",
        ]


def _seen(entry: Entry) -> list[str]:
    tries = [f"tried {entry.tries} times"] if entry.tries > 1 else []
    return [*entry.lines, *([entry.trouble] if entry.trouble else []), *tries]


def _found(record: Commissioning) -> Iterator[list[str]]:
    for entry in record.tasks.values():
        for key, value in flat(entry.found).items():
            yield [_cell(key), _cell(str(value))]


def _figures(record: Commissioning) -> Iterator[list[str]]:
    for name, value in record.figures().items():
        yield [_cell(name), _cell(f"{value:.6g}", "n")]


def _compared(record: Commissioning, earlier: Commissioning) -> Iterator[list[str]]:
    for change in changes(record, earlier):
        yield [_cell(change.figure), *(_cell(text, "n") for text in change_texts(change))]


def change_texts(change: Change) -> tuple[str, str, str]:
    """Now, then, and by how much, for people."""
    now, then = ("" if one is None else f"{one:.6g}" for one in (change.now, change.then))
    return now, then, "" if change.relative is None else f"{change.relative:+.1%}"
