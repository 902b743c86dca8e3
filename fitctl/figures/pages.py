"""Pages made from templates, for people, and their JSON, for programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from fitctl.text import json_bytes, plain


def write_page(path: Path, package: str, template: str, **values: Any) -> None:
    """Write a package's template, filled in; HTML is escaped, Markdown is not.

    Line breaks in values stay; :func:`fitctl.text.plain` makes other invisible characters visible.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    pages = Environment(
        loader=PackageLoader(package),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        finalize=_visible,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    pages.filters["number"] = number
    path.write_text(pages.get_template(template).render(values), encoding="utf-8")


def _visible(value: Any) -> Any:
    is_part_of_page = hasattr(value, "__html__")
    if isinstance(value, str) and not is_part_of_page:
        return "\n".join(map(plain, value.split("\n")))
    return value


def number(value: float | None, form: str, unknown: str = "") -> str:
    """A number as a format has it, or what stands for one that is not known."""
    return unknown if value is None or math.isnan(value) else f"{value:{form}}"


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write JSON; what is not a number becomes null.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    path.write_bytes(msgspec.json.format(json_bytes(value), indent=2) + b"\n")
