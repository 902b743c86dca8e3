"""Rig files as documents that keep their comments: a comment that stands before a table goes with it."""

from __future__ import annotations

import re
from typing import Any

import tomlkit

_OF_TABLE = "#< "  # marks a comment that stood before its table


def parse_commented(text: str) -> tomlkit.TOMLDocument:
    """A rig file as a document that can be changed.

    Raises
    ------
    tomlkit.exceptions.ParseError
        If it is not TOML.
    """
    return tomlkit.parse(re.sub(r"((?:^#.*\n)+)(^\[.*\n)", _into_table, text, flags=re.M))


def _into_table(match: re.Match[str]) -> str:
    comments, table = match.groups()
    return table + "".join(_OF_TABLE + line for line in comments.splitlines(keepends=True))


def dump_commented(document: tomlkit.TOMLDocument) -> str:
    """The text, with comments before their tables again."""
    text = re.sub(
        rf"(^\[.*\n)((?:^{_OF_TABLE}.*\n)+)", _before_table, tomlkit.dumps(document), flags=re.M
    )
    return text.rstrip() + "\n"


def _before_table(match: re.Match[str]) -> str:
    table, comments = match.groups()
    return comments.replace(_OF_TABLE, "") + table


def set_value(table: Any, key: str, value: Any) -> None:
    """Put a value in the place of another; the comment behind it stays in its column."""
    before = table.item(key)
    table[key] = value
    after = table.item(key)
    if not after.trivia.comment:
        return
    column = len(before.as_string()) + len(before.trivia.comment_ws)
    after.trivia.comment_ws = " " * max(1, column - len(after.as_string()))
