"""Explains an error in a configuration file: the place first, then the values seen and wanted."""

import math
import re
import reprlib
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Struct

from skin_host.config.fields import PATTERNS, Name
from skin_host.errors import nearest

Table = type[Struct]
Named = dict[str, Table]
#: Longer values are shown by their beginning.
LONGEST_VALUE = 40
#: No setting is larger: so many seconds in nanoseconds still fit into 64 bits.
LARGEST = 1e9
#: No document is nested deeper: the deepest key is `parts.NAME.patches[0].places[0].normal[0]`.
DEEPEST = 16
#: Shows any value at bounded cost, however deep or long it is.
_SHOWN = reprlib.Repr()
_SHOWN.maxstring = _SHOWN.maxother = _SHOWN.maxlong = 1000


def explain(document: Any, error: msgspec.ValidationError, root: Table, named: Named) -> str:
    """Return where in the file the error is, then what it is.

    msgspec's message is "Expected `int`, got `str` - at `$.boards[...].address`": it does not name
    the board, so each named table is checked once more separately.

    `named` are the sections of the file that hold tables by name, and the type of these.
    """
    for section, table in named.items():
        entries = document.get(section)
        if not isinstance(entries, dict):
            continue
        for name, entry in entries.items():
            try:
                msgspec.convert(name, Name)
            except msgspec.ValidationError:
                return (
                    f'{section}: the name "{name}"; wanted at most 64 of the characters '
                    "a-z, 0-9, - and _"
                )
            try:
                msgspec.convert(entry, table)
            except msgspec.ValidationError as inner:
                return _readable(str(inner), f"{section}.{name}", table, entry)
    return _readable(str(error), "", root, document)


def _readable(message: str, place: str, table: Table, document: Any) -> str:
    """Put the place first, then the value seen; suggest the probable key for an unknown one."""
    text, _, inner = message.partition(" - at ")
    keys = inner.strip("`").removeprefix("$").removeprefix(".")
    place = f"{place}.{keys}".strip(".") if keys else place
    kind = table
    for key in re.sub(r"\[[^]]*\]", "", keys).split(".") if keys else []:
        kind = _innermost(get_type_hints(kind)[key]) if hasattr(kind, key) else kind
    if text.startswith("Object contains unknown field"):
        key = text.split("`")[1]
        near = nearest(key, kind.__struct_fields__)
        meant = f"meant `{near}`?" if near else f"known are {', '.join(kind.__struct_fields__)}"
        text = f"unknown key `{key}`; {meant}"
    elif text.startswith("Invalid enum value"):
        known = ", ".join(str(value) for value in get_args(kind))
        seen = text.removeprefix("Invalid enum value ")
        text = f"seen {seen}, wanted one of: {known}"
    else:
        text = text.replace("Object missing required field", "missing key")
        for pattern, permitted in PATTERNS.items():
            text = text.replace(f" matching regex {pattern!r}", f" of {permitted}")
        wanted, _, got = text.replace("Expected", "wanted").partition(", got ")
        seen = got if " of length " in wanted and got else _value(document, keys)
        text = f"seen {seen}, {wanted}" if wanted.startswith("wanted") and seen else wanted
    return f"{place}: {text}" if place else text


def _value(document: Any, keys: str) -> str:
    """Return the value at a place such as `patches[0].shift`, shortened; empty if not known."""
    value = document
    for key in re.findall(r"[^.\[\]]+", keys):
        if isinstance(value, list) and key.isdecimal() and int(key) < len(value):
            value = value[int(key)]
        elif isinstance(value, dict) and key in value:
            value = value[key]
        else:
            return ""
    text = _SHOWN.repr(value)
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 3] + "..."


def _innermost(hint: Any) -> Any:
    """Return the table or `Literal` within `list[Patch]`, `dict[Name, Bus]`, `X | None` and
    such.
    """
    while get_origin(hint) not in (None, Literal):
        hint = next(inner for inner in reversed(get_args(hint)) if inner is not type(None))
    return hint


def too_deep(document: Any) -> str | None:
    """Return the place of a value that is nested deeper than `DEEPEST`, if there is one.

    What walks through a document later may then call itself.
    """
    level = [("", document)]
    for _ in range(DEEPEST + 1):
        level = [
            (f"{where}.{key}" if where else str(key), inner)
            for where, value in level
            if isinstance(value, dict | list)
            for key, inner in (value.items() if isinstance(value, dict) else enumerate(value))
        ]
    return level[0][0] if level else None


def out_of_bounds(
    value: Any, where: str = "", largest: float = LARGEST
) -> Iterator[tuple[str, str]]:
    """Yield where in a decoded file `nan`, `inf` and numbers beyond `LARGEST` are, and what of
    them is wrong. The options of a CAN adapter may be of any size.
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            bound = math.inf if key == "options" else largest
            yield from out_of_bounds(inner, f"{where}.{key}" if where else key, bound)
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from out_of_bounds(inner, f"{where}[{number}]", largest)
    elif isinstance(value, float) and not math.isfinite(value):
        yield where, f"seen {value}, wanted a finite number"
    elif isinstance(value, int | float) and abs(value) > largest:
        yield where, f"seen {value}, wanted a number between {-largest:g} and {largest:g}"
