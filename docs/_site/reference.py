"""The pages of the site that are made from the code: commands, rig keys, messages, topics, Python."""

from __future__ import annotations

import copy
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any, get_args

import msgspec
import tomlkit
import typer
from tomlkit.items import AoT, Item, Table
from typer.cli import get_docs_for_click

from fitctl.cli import COMMANDS, app, load_command
from fitctl.config import Rig, default_rig_path
from fitctl.logging.schemas import MESSAGES, TOPICS
from fitctl.messages.commands import AnyCommand
from fitctl.sequences.instrument import Instrument
from fitctl.sequences.reading import STEPS

LOOP = "right"


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown; a bar within a cell is written so that it ends none."""
    cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *cells))


# ---------------------------------------------------------------- the command line


def command_line() -> str:
    """Every command that is not hidden, with its options."""
    group = copy.copy(typer.main.get_command(app))
    group.commands = {name: load_command(name) for name, each in COMMANDS.items() if each.summary}
    _not_cut_short(group)
    text = get_docs_for_click(obj=group, ctx=typer.Context(group), name="fitctl")
    text = re.sub(r"\x08\nExamples:\n((?:  .+\n)+)", _as_block, text)
    return text.replace("# `fitctl`\n", "# Command line\n", 1)


def _as_block(found: re.Match[str]) -> str:
    """Examples, which a terminal shows as they stand, as a block of commands."""
    return f"**Examples**:\n\n```console\n{inspect.cleandoc('  ' + found[1].strip())}\n```\n"


def _not_cut_short(group: Any) -> None:
    """Let lists of commands say a whole sentence about each; a terminal has less room."""
    for command in group.commands.values():
        command.short_help = _first_paragraph(command.help)
        if hasattr(command, "commands"):
            _not_cut_short(command)


# ---------------------------------------------------------------- the rig file


def rig_keys() -> str:
    """Every key of the shipped rig file, section by section: its value, what is allowed, what it is."""
    schema = Rig.model_json_schema()
    document = tomlkit.parse(default_rig_path().read_text(encoding="utf-8"))
    parts = [
        "# Rig keys",
        "This page lists every key of a rig file, with its value in the shipped `fit-mock.toml` and the "
        "allowed values. You can omit a table that is marked optional. Only mocks and simulation use `plant` "
        "and `mocks`. The keys that only `fit-testbed.toml` has, with several loops and a collector, are at "
        "the end. Other amplifiers have keys of their own: [Ensemble](../devices/ensemble.md), [analogue "
        "amplifiers](../devices/bal-analog.md).",
    ]
    head = ["key", "shipped", "allowed", "what it is"]
    known = set()
    for section, rows in sections(document, "", schema, schema):
        parts += [f"## {section or 'The rig'}", table(head, rows)]
        known |= {(_of_any_loop(section), row[0]) for row in rows}
    testbed = default_rig_path().parent / "fit-testbed.toml"
    document = tomlkit.parse(testbed.read_text(encoding="utf-8"))
    del document["base"]  # of files, not of rigs
    for section, rows in sections(document, "", schema, schema):
        further = [row for row in rows if (_of_any_loop(section), row[0]) not in known]
        if further:
            parts += [f"## {section or 'Another rig'} in {testbed.name}", table(head, further)]
    return "\n\n".join(parts)


def _of_any_loop(section: str) -> str:
    """A section's name with its loop's left out."""
    return re.sub(r"\bloops\.\w+", "loops.NAME", section)


def sections(
    at: Any, prefix: str, schema: dict[str, Any], root: dict[str, Any]
) -> Iterator[tuple[str, list[list[str]]]]:
    """The tables of a TOML document, each with a row for each of its keys."""
    rows, below = [], []
    required = schema.get("required", ())
    for key, value in at.items():
        inner = _property(schema, str(key), root)
        name = f"{prefix.removesuffix(' (optional)')}.{key}".lstrip(".")
        if isinstance(value, AoT):
            below.append((value[0], f"{name}[]", _resolved(inner["items"], value[0], root)))
        elif isinstance(value, Table):
            optional = "" if key in required or "properties" not in schema else " (optional)"
            below.append((value, f"{name}{optional}", _resolved(inner, value, root)))
        else:
            rows.append(
                [f"`{key}`", _shown(at.item(key)), allowed(inner, root), _comment(at.item(key))]
            )
    if rows:
        yield prefix, rows
    for inner_table, name, inner in below:
        yield from sections(inner_table, name, inner, root)


def _property(schema: dict[str, Any], key: str, root: dict[str, Any]) -> dict[str, Any]:
    found = schema.get("properties", {}).get(key) or schema["additionalProperties"]
    return _resolved(found, None, root)


def _resolved(schema: dict[str, Any], value: Any, root: dict[str, Any]) -> dict[str, Any]:
    """A schema without references: what ``X | None`` is of, and which of several devices `value` is."""
    while True:
        if "discriminator" in schema:
            if value is None:
                return schema
            schema = {"$ref": schema["discriminator"]["mapping"][value["driver"]]}
        elif "oneOf" in schema:
            if value is None:
                return schema
            each = [_resolved(one, None, root) for one in schema["oneOf"]]
            kind = value.get("kind", "stellar")
            (schema,) = [one for one in each if one["properties"]["kind"]["const"] == kind]
        elif "$ref" in schema:
            schema = root["$defs"][schema["$ref"].removeprefix("#/$defs/")]
        elif "anyOf" in schema:
            (schema, *_) = [each for each in schema["anyOf"] if each.get("type") != "null"]
        else:
            return schema


_BOUNDS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


def allowed(schema: dict[str, Any], root: dict[str, Any]) -> str:
    """What a value may be, in words."""
    if "enum" in schema or "const" in schema:
        choices = schema.get("enum", [schema.get("const")])
        return ", ".join(f"`{msgspec.json.encode(choice).decode()}`" for choice in choices)
    bounds = [f"{sign} {schema[key]:g}" for key, sign in _BOUNDS.items() if key in schema]
    if schema.get("type") == "array":
        of = allowed(_resolved(schema["items"], None, root), root)
        count = schema.get("minItems") if schema.get("minItems") == schema.get("maxItems") else None
        return f"list of {f'{count} × ' if count else ''}{of}"
    if schema.get("type") == "object":
        inner = schema.get("properties", {})
        return f"table of {', '.join(f'`{key}`' for key in inner)}"
    names = {
        "integer": "whole number",
        "number": "number",
        "string": "text",
        "boolean": "true, false",
    }
    return " ".join([names[schema["type"]], ", ".join(bounds)]).strip()


def _shown(value: Item) -> str:
    text = re.sub(r"\s+", " ", value.as_string()).strip()
    return f"`{text}`" if len(text) <= 40 else "see the file"


def _comment(item: Item) -> str:
    return item.trivia.comment.removeprefix("#").strip()


# ---------------------------------------------------------------- what travels, what is logged


def commands() -> str:
    """Every command of the service's schema, with its fields."""
    parts = [
        "# Commands of the service",
        "A client sends these commands to a supervisor as msgpack, encoded by `msgspec` from the structs of "
        "`fitctl.messages.commands`. Each has `version` and `loop` (empty for all loops). The supervisor "
        "rejects unknown fields. `fitctl send` and the console offer the commands that people need.",
    ]
    for kind in sorted(get_args(AnyCommand), key=lambda kind: kind.__name__):
        parts += [f"## {kind.__name__}", _plain(kind)]
        fields = [
            field for field in msgspec.structs.fields(kind) if field.name not in {"version", "loop"}
        ]
        if fields:
            rows = [[f"`{field.name}`", f"`{_type_name(field.type)}`"] for field in fields]
            parts.append(table(["field", "type"], rows))
    return "\n\n".join(parts)


def topics() -> str:
    """Every topic of a log, with the type of each field."""
    parts = [
        "# Topics of a log",
        "Messages are protobuf, with their schema in the file; foxglove's are as Foxglove defines them. Units "
        "are in the names. Frames of reference and how to read a log: [logs](../logs.md).",
    ]
    for kind, topic in TOPICS.items():
        message = MESSAGES[kind].DESCRIPTOR
        rows = [
            [f"`{field.name}`", _wire_type(field), str(field.number)] for field in message.fields
        ]
        parts += [
            f"## {topic.format(loop=LOOP)}",
            f"`{message.full_name}`. {_plain(kind)}",
            table(["field", "type", "number"], rows),
        ]
    return "\n\n".join(parts)


def _wire_type(field: Any) -> str:
    if field.message_type is not None:
        return field.message_type.full_name
    names = {getattr(field, name): name for name in dir(field) if name.startswith("TYPE_")}
    return names[field.type].removeprefix("TYPE_").lower()


def _type_name(kind: Any) -> str:
    return kind.__name__ if inspect.isclass(kind) else str(kind).replace("typing.", "")


def _plain(kind: type) -> str:
    """A docstring's first paragraph, without its roles."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", _first_paragraph(kind.__doc__)).replace("``", "`")


def _first_paragraph(text: str | None) -> str:
    return inspect.cleandoc(text or "").split("\n\n")[0].replace("\n", " ")


# ---------------------------------------------------------------- Python

PYTHON = """# Python

This page lists what scripts import. [Sequences](../sequences.md#from-python) has examples, and
[logs](../logs.md) explains how to read logs.

## Instrument

::: fitctl.Instrument

{steps}

## AsyncInstrument

::: fitctl.AsyncInstrument

It has the methods of the steps above, too: `await instrument.hold(30.0)`.

## Reading logs

::: fitctl.logging.reading

::: fitctl.logging.listing

## Rig files

::: fitctl.config.load_rig

## Simulation

::: fitctl.simulation.simulation.Simulation

## Designs

::: fitctl.controllers.pair.Design

::: fitctl.controllers.design.basis.Basis

::: fitctl.controllers.design.choose.design_for

## Drivers

::: fitctl.drivers.interface
"""


def python() -> str:
    """Classes and functions by their docstrings, and the methods that steps are, by their keys."""
    return PYTHON.replace("{steps}", _steps())


def _steps() -> str:
    """Each step as a method: its arguments in order, their types, defaults and meanings."""
    parts = [
        "### Steps",
        "Methods of `Instrument` and `AsyncInstrument`; each returns its figures.",
    ]
    for name, kind in STEPS.items():
        signature = inspect.signature(getattr(Instrument, name))
        arguments = [each for key, each in signature.parameters.items() if key != "self"]
        own = [each for each in arguments if each.kind is not inspect.Parameter.KEYWORD_ONLY]
        rows = [
            [
                f"`{each.name}`",
                "required" if each.default is inspect.Parameter.empty else f"`{each.default!r}`",
                kind.model_fields[each.name].description or "",
            ]
            for each in arguments
        ]
        usage = ", ".join([*(each.name for each in own), "*", "..."])
        text = inspect.cleandoc(kind.__doc__ or "")
        parts += [f"#### {name}", f"`instrument.{name}({usage})`", text]
        parts.append(table(["argument", "default", "meaning"], rows))
    return "\n\n".join(parts)


PAGES: dict[str, Callable[[], str]] = {
    "reference/command-line.md": command_line,
    "reference/rig-keys.md": rig_keys,
    "reference/commands.md": commands,
    "reference/topics.md": topics,
    "reference/python.md": python,
}
