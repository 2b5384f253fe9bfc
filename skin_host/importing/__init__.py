"""`skin import`: read files of a kind, write a configuration that `skin check` accepts.

Only values that differ from the defaults are written. (The available TOML writers do not keep each
place on one line and cannot write comments.)
"""

import json
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_type_hints

import msgspec
from msgspec import Struct

from skin_host.config import settings as configuration
from skin_host.config.fields import FileName
from skin_host.config.relaxation import RelaxationFile
from skin_host.config.settings import Patch, Settings
from skin_host.errors import ConfigurationError
from skin_host.files import becomes_file, write_together, writing
from skin_host.importing.positions import import_positions
from skin_host.importing.report import Findings
from skin_host.importing.skingui import import_places
from skin_host.importing.skinmanager import import_manager
from skin_host.importing.skinspec import import_boards
from skin_host.layout import build_layout

Source = Literal["skinspec", "skingui", "positions", "skinmanager"]
SOURCES: tuple[Source, ...] = get_args(Source)
#: What a file of a fitted foam has.
FITTED_KEYS = tuple(key for key in RelaxationFile.__struct_fields__ if key != "schema")

T = TypeVar("T")


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
        table = getattr(settings.processing, section)
        # A file replaces the numbers.
        from_file = section == "relaxation" and table.file is not None
        lines += _table(f"processing.{section}", table, without=FITTED_KEYS if from_file else ())
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


def import_files(
    source: Source,
    files: list[Path],
    output: Path,
    findings: Findings,
    *,
    config: Path | None = None,
    part: str | None = None,
) -> list[Path]:
    """Turn files of the iCub software into the configuration `output`.

    The positions files of `robot.toml` go to the folder `robot-positions` beside it. `findings`
    receives every remark, also those made before an error. `config` is a configuration to add to;
    it may be `output` itself. Its comments are lost; the files that it names stay where they are.
    `part` is what a positions file describes.

    Returns:
        The files written; nothing is written if anything is wrong. A device or a pipe as `output`
        takes the configuration and is none of them.

    Raises:
        ConfigurationError: a file cannot be read, or the result is not a valid configuration, or
            is one with positions files and `output` is no file.
        RequestError: one of `files` has the name of a file to write.
        SkinError: a file cannot be written.
    """
    folder = output.parent
    with writing(output):
        is_file = becomes_file(output)
    base = None
    if config is not None:
        base = configuration.load(config)
        # Names of files are relative to the configuration's folder, which may be another one here.
        base = _with_files(
            base, lambda name: _moved(name, config.parent, folder if is_file else None)
        )
    written: dict[str, bytes] = {}
    if source == "skinspec":
        settings = import_boards(files, base, findings)
    elif source == "skingui":
        settings = import_places(files, base, findings)
    elif source == "positions":
        settings, written = import_positions(
            files, base, part, f"{output.stem}-positions", findings
        )
    else:
        settings = import_manager(files, base, findings)
    names = ", ".join(file.name for file in files)
    text = configuration_text(settings, f"Imported from {names} by `skin import {source}`.")
    _check(settings, written, output)
    if written and not is_file:
        raise ConfigurationError(
            f"{output}: positions files go to a folder beside it; wanted a file"
        )
    documents = [(output.name, text.encode()), *written.items()]
    paths = write_together(((folder / name, data) for name, data in documents), files)
    return paths if is_file else []


def _with_files(table: T, renamed: Callable[[str], str]) -> T:
    """Return the same settings with every file that they name renamed."""
    found: Any = table
    if isinstance(table, Struct):
        kinds = _kinds(type(table))
        entries = {key: getattr(table, key) for key in kinds}
        changed = {
            key: renamed(value)
            if kinds[key] == FileName | None and value is not None
            else _with_files(value, renamed)
            for key, value in entries.items()
        }
        found = msgspec.structs.replace(table, **changed)
    elif isinstance(table, dict):
        found = {key: _with_files(value, renamed) for key, value in table.items()}
    elif isinstance(table, list):
        found = [_with_files(value, renamed) for value in table]
    return cast(T, found)


@cache
def _kinds(table: type[Struct]) -> dict[str, Any]:
    return get_type_hints(table, include_extras=True)


def _moved(name: str, old: Path, new: Path | None) -> str:
    """Name a file from another folder, or from any (None); what has an absolute name keeps it.

    Links in the names of the folders are followed: what is above a link is not above its end.
    """
    if Path(name).is_absolute():
        return name
    there = Path(os.path.realpath((old / name).parent), Path(name).name)
    return str(there) if new is None else os.path.relpath(there, os.path.realpath(new))


def _check(settings: Settings, written: dict[str, bytes], output: Path) -> None:
    """Write a new configuration into a temporary folder and read it back before it is written.

    Raises:
        ConfigurationError: it is not a valid configuration.
    """

    def where_it_is(name: str) -> str:
        return name if name in written else str((output.parent / name).resolve())

    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / output.name
        text = configuration_text(_with_files(settings, where_it_is))
        write_together(
            (trial.parent / name, data)
            for name, data in {**written, output.name: text.encode()}.items()
        )
        try:
            build_layout(configuration.load(trial), trial.parent)
        except ConfigurationError as error:
            what = str(error).removeprefix(f"{trial}: ")
            raise ConfigurationError(
                f"{output}: the files do not give a valid configuration: {what}"
            ) from None
