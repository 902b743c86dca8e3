"""Text from elsewhere, made safe for a terminal: from a log, a message, a device or another person."""

from __future__ import annotations

import types
from functools import lru_cache
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec

_T = TypeVar("_T")
UNDECODABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What msgspec raises for bytes from elsewhere: they do not fit, are no text, or are nested a thousand deep."""
_NO_TEXT = {int, float, bool, bytes, types.NoneType}


def plain(text: str) -> str:
    r"""The same text on one line, with nothing in it that a terminal obeys.

    Control characters, line breaks and characters that change the direction of writing become visible, as
    JSON escapes them (``\n``, ``\u001b``); so JSON stays the same JSON.
    """
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() else _escaped(character) for character in text
    )


def _escaped(character: str) -> str:
    if character == "\n":
        return r"\n"
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))


def json_bytes(value: Any) -> bytes:
    """JSON; what is not a number becomes null.

    Surrogates, which the name of a file has where it is not UTF-8, become visible as :func:`plain` shows them.
    """
    try:
        return msgspec.json.encode(value)
    except UnicodeEncodeError:
        return msgspec.json.encode(plain_message(msgspec.to_builtins(value, str_keys=True)))


def plain_message(value: _T) -> _T:
    """A decoded message whose texts have all gone through :func:`plain`, however deep they are."""
    return _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return plain(value)
    if isinstance(value, msgspec.Struct):
        changed = {}
        for name in _fields_with_text(type(value)):
            before = getattr(value, name)
            after = _plain(before)
            if after is not before:
                changed[name] = after
        return msgspec.structs.replace(value, **changed) if changed else value
    if isinstance(value, list | tuple):
        items = [_plain(item) for item in value]
        same = all(a is b for a, b in zip(items, value, strict=True))
        return value if same else type(value)(items)
    if isinstance(value, dict):
        return {_plain(key): _plain(item) for key, item in value.items()}
    return value


@lru_cache(maxsize=256)
def _fields_with_text(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    """The fields that may hold a text somewhere; numbers, which are most, are passed over."""
    hints = get_type_hints(kind)
    return tuple(name for name in kind.__struct_fields__ if not _leaves(hints[name]) <= _NO_TEXT)


def _leaves(annotation: Any) -> set[Any]:
    if get_origin(annotation) is Literal:  # decoding has compared it
        return set()
    inside = get_args(annotation)
    return set().union(*map(_leaves, inside)) if inside else {annotation}
