"""What is wrong in a configuration file, in words: the place first, then seen and wanted."""

import difflib
import math
import re
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Struct

from skin_host.fields import Name

Table = type[Struct]
Named = dict[str, Table]


def explain(document: Any, error: msgspec.ValidationError, root: Table, named: Named) -> str:
    """Say where in the file, then what.

    msgspec says "Expected `int`, got `str` - at `$.boards[...].address`": it does not tell
    which board, so each named table is checked once more by itself.

    Args:
        document: the decoded file.
        error: what msgspec said of it.
        root: the type of the whole file.
        named: the sections of the file that hold tables by name, and the type of these.
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
                return _readable(str(inner), f"{section}.{name}", table)
    return _readable(str(error), "", root)


def _readable(message: str, place: str, table: Table) -> str:
    """Put the place first; say what an unknown key was meant to be, or which values there are.

    Args:
        message: msgspec's own.
        place: where in the file `table` stands.
        table: what was checked.
    """
    text, _, inner = message.partition(" - at ")
    keys = inner.strip("`").removeprefix("$").removeprefix(".")
    place = f"{place}.{keys}".strip(".") if keys else place
    kind = table
    for key in re.sub(r"\[[^]]*\]", "", keys).split(".") if keys else []:
        kind = _innermost(get_type_hints(kind)[key]) if hasattr(kind, key) else kind
    if text.startswith("Object contains unknown field"):
        key = text.split("`")[1]
        near = difflib.get_close_matches(key, kind.__struct_fields__, n=1)
        text = f"unknown key `{key}`" + (f"; meant `{near[0]}`?" if near else "")
    elif text.startswith("Invalid enum value"):
        known = ", ".join(str(value) for value in get_args(kind))
        text = f"seen {text.removeprefix('Invalid enum value ')}, wanted one of: {known}"
    else:
        text = text.replace("Object missing required field", "missing key")
        text = text.replace("Expected", "wanted").replace("got", "seen")
    return f"{place}: {text}" if place else text


def _innermost(hint: Any) -> Any:
    """The table or `Literal` within `list[Patch]`, `dict[Name, Bus]`, `X | None` and such."""
    while get_origin(hint) not in (None, Literal):
        hint = next(inner for inner in reversed(get_args(hint)) if inner is not type(None))
    return hint


def not_finite(value: Any, where: str = "") -> Iterator[tuple[str, float]]:
    """Where in a decoded file `nan` and `inf` stand."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from not_finite(inner, f"{where}.{key}" if where else key)
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from not_finite(inner, f"{where}[{number}]")
    elif isinstance(value, float) and not math.isfinite(value):
        yield where, value
