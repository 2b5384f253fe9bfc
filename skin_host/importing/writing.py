"""Writes settings as the text of a configuration file.

Only values that differ from the defaults are written. (The available TOML writers do not keep each
place on one line and cannot write comments.)
"""

import json
from typing import Any

import msgspec
from msgspec import Struct

from skin_host.config.settings import Patch, Settings


def configuration_text(settings: Settings, comment: str = "") -> str:
    """Write `settings` so that `settings.load` reads the same ones; `comment` comes first."""
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines.append(f"robot = {_value(settings.robot)}")
    for section, tables in (
        ("buses", settings.buses),
        ("boards", settings.boards),
        ("kinds", settings.kinds),
        ("fingertips", settings.fingertips),
    ):
        for name, table in tables.items():
            lines += _table(f"{section}.{name}", table, empty=True)
    for name, part in settings.parts.items():
        lines += _table(f"parts.{name}", part, without=("patches",))
        for patch in part.patches:
            lines += _patch(name, patch)
    for section in ("calibration", "pressure", "relaxation", "touch", "drift"):
        lines += _table(f"processing.{section}", getattr(settings.processing, section))
    for section in ("mqtt", "receive", "service"):
        lines += _table(section, getattr(settings, section))
    return "\n".join(lines) + "\n"


def _table(
    head: str, table: Struct, *, empty: bool = False, without: tuple[str, ...] = ()
) -> list[str]:
    """Return a table with the values that differ from the defaults; empty if there are none."""
    entries = [
        f"{key} = {_value(value)}" for key, value in _changed(table).items() if key not in without
    ]
    return ["", f"[{head}]", *entries] if entries or empty else []


def _patch(part: str, patch: Patch) -> list[str]:
    lines = ["", f"[[parts.{part}.patches]]"]
    for key, value in _changed(patch).items():
        if key == "places":
            places = [f"    {_inline(_changed(place))}," for place in patch.places]
            lines += ["places = [", *places, "]"]
        elif key == "cdc_offset":
            lines.append(f"{key} = {value:#06x}")
        else:
            lines.append(f"{key} = {_value(value)}")
    return lines


def _changed(table: Struct) -> dict[str, Any]:
    """Return the entries of a table that are required or differ from their defaults."""
    changed = {}
    for entry in msgspec.structs.fields(table):
        value = getattr(table, entry.name)
        default = entry.default
        if entry.default_factory is not msgspec.NODEFAULT:
            default = entry.default_factory()
        if value is not None and (default is msgspec.NODEFAULT or value != default):
            changed[entry.name] = value
    return changed


def _inline(entries: dict[str, Any]) -> str:
    inner = ", ".join(f"{key} = {_value(value)}" for key, value in entries.items())
    return f"{{ {inner} }}" if inner else "{}"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        # A JSON string is a valid TOML basic string, except for DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return _inline({_value(key): inner for key, inner in value.items()})
    return f"[{', '.join(_value(inner) for inner in value)}]"
