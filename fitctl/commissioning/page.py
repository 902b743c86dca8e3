"""A commissioning on one page, to file, and compared with another one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from importlib.metadata import version
from typing import Any, NamedTuple

from fitctl.commissioning.record import Commissioning, Entry

_STYLE = """
body { font: 14px/1.35 system-ui, sans-serif; max-width: 66rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: .2rem; } h2 { font-size: 1.1rem; margin: 1.4rem 0 .2rem; } small { color: #555; }
table { border-collapse: collapse; width: 100%; margin: .3rem 0 1rem; }
th, td { border-bottom: 1px solid #ddd; padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.w, td.passed, td.corrected, td.measured, td.failed, td.skipped, td.todo { white-space: nowrap; }
.verdict { font-size: 1.15rem; padding: .5rem .8rem; border-left: 6px solid #999; background: #f4f4f4; }
.verdict.yes { border-color: #060; } .verdict.no { border-color: #a00; }
.figures { columns: 2; column-gap: 2rem; } .figures table { break-inside: avoid; font-size: 12px; }
.todo { color: #888; } .sign td { padding-top: 1.6rem; width: 33%; border-bottom: 1px solid #111; }
.failed { color: #a00; font-weight: 600; } .corrected, .measured { color: #850; } .passed { color: #060; }
@media print { body { margin: 0; font-size: 10px; } h2 { break-after: avoid; } }
"""


_VALUE_COLUMNS = 60


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
        return f"not commissioned yet: {len(left)} of {len(entries)} steps to do, the next is {left[0]}"
    if skipped:
        return f"commissioned, except for what was skipped: {', '.join(skipped)}"
    return "commissioned"


def page(
    record: Commissioning,
    titles: dict[str, str],
    earlier: Commissioning | None = None,
    said: dict[str, Any] | None = None,
) -> str:
    """The page as HTML that needs no other file.

    Parameters
    ----------
    record : Commissioning
    titles : dict
        What each task does, by its name, in their order.
    earlier : Commissioning, optional
        Compared with the record.
    said : dict, optional
        What the rig file says, by whole keys.
    """
    said = said or {}
    conclusion = verdict(record, titles)
    ended = sorted(entry.at for entry in record.tasks.values())
    when = f"{_when(ended[0])} to {_when(ended[-1])} UTC" if ended else "nothing done yet"
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f"<title>Commissioning of {escape(record.rig)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>Commissioning of {escape(record.rig)}</h1>",
        f"<p><small>{escape(when)}; fitctl {escape(version('fitctl'))}</small></p>",
        f'<p class="verdict {_colour(conclusion)}">{escape(conclusion[0].upper() + conclusion[1:])}.</p>',
        "<h2>Steps</h2>",
        _table(("step", "result", "ended (UTC)", "took", "what was seen"), _steps(record, titles)),
        "<h2>Changes to the rig file</h2>",
        _table(("key", "the rig file says", "found", "by step"), _found(record, said)),
        '<table class="sign"><tr><td>Commissioned by</td><td>Date</td><td>Approved by</td></tr></table>',
    ]
    if earlier is not None:
        parts += [
            "<h2>Compared with the earlier commissioning</h2>",
            _table(("figure", "now", "then", "change"), _compared(record, earlier)),
        ]
    parts += ["<h2>Figures</h2>", '<div class="figures">', *_figures(record), "</div>"]
    return "\n".join([*parts, "</body></html>", ""])


def _colour(conclusion: str) -> str:
    if conclusion.startswith("commissioned"):
        return "yes"
    return "no" if "failed" in conclusion else ""


def _when(at: str) -> str:
    return at.replace("T", " ")[:16]


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    header = "".join(f"<th>{escape(one)}</th>" for one in head)
    body = "\n".join(f"<tr>{''.join(cells)}</tr>" for cells in rows)
    return f"<table><tr>{header}</tr>\n{body}</table>" if body else "<p>None.</p>"


def _cell(text: str, kind: str = "") -> str:
    return f'<td class="{kind}">{escape(text)}</td>' if kind else f"<td>{escape(text)}</td>"


def _steps(record: Commissioning, titles: dict[str, str]) -> Iterator[list[str]]:
    for name, title in titles.items():
        entry = record.tasks.get(name)
        head = f"<td><b>{escape(name)}</b><br><small>{escape(title)}</small></td>"
        if entry is None:
            yield [head, _cell("to do", "todo"), _cell(""), _cell(""), _cell("")]
            continue
        yield [
            head,
            _cell(entry.state, entry.state),
            _cell(_when(entry.at), "w"),
            _cell(f"{entry.took_s:.0f} s", "n"),
            f"<td>{'<br>'.join(map(escape, _seen(entry)))}</td>",
        ]


def _seen(entry: Entry) -> list[str]:
    tries = [f"tried {entry.tries} times"] if entry.tries > 1 else []
    return [*entry.lines, *([entry.trouble] if entry.trouble else []), *tries]


def _found(record: Commissioning, said: dict[str, Any]) -> Iterator[list[str]]:
    for name, entry in record.tasks.items():
        for key, value in flat(entry.found).items():
            was = _short(said[key]) if key in said else "nothing"
            yield [_cell(key), _cell(was), _cell(_short(value)), _cell(name)]


def _short(value: Any) -> str:
    """A value on one line; long lists by their first numbers."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if not isinstance(value, list):
        return str(value)
    text = f"[{', '.join(map(_short, value))}]"
    return text if len(text) <= _VALUE_COLUMNS else f"{text[: _VALUE_COLUMNS - 1]}…"


def _figures(record: Commissioning) -> Iterator[str]:
    for name, entry in record.tasks.items():
        rows = [
            [_cell(figure), _cell(f"{value:.6g}", "n")] for figure, value in entry.figures.items()
        ]
        if rows:
            yield _table((name, ""), rows)


def _compared(record: Commissioning, earlier: Commissioning) -> Iterator[list[str]]:
    for change in changes(record, earlier):
        yield [_cell(change.figure), *(_cell(text, "n") for text in change_texts(change))]


def change_texts(change: Change) -> tuple[str, str, str]:
    """Now, then, and by how much, for people."""
    now, then = ("" if one is None else f"{one:.6g}" for one in (change.now, change.then))
    return now, then, "" if change.relative is None else f"{change.relative:+.1%}"
