"""`skin import`: read files of a kind, write a configuration that `skin check` accepts."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import msgspec

from skin_host.config import settings as configuration
from skin_host.config.settings import Patch, Settings
from skin_host.errors import ConfigurationError
from skin_host.files import write_atomic
from skin_host.importing.boards import import_boards
from skin_host.importing.positions import import_positions
from skin_host.importing.report import Findings
from skin_host.importing.skingui import import_places
from skin_host.importing.skinmanager import import_manager
from skin_host.importing.writing import configuration_text
from skin_host.layout import build_layout

Source = Literal["skinspec", "skingui", "positions", "skinmanager"]
SOURCES: tuple[Source, ...] = get_args(Source)


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

    Args:
        source: the kind of files.
        files: at least one.
        output: the configuration to write; the positions files of `robot.toml` go to the folder
            `robot-positions` beside it.
        findings: receives every remark, also those made before an error.
        config: a configuration to add to; may be `output` itself. Its comments are lost.
        part: the part that a positions file describes.

    Returns:
        The files written; nothing is written if anything is wrong.

    Raises:
        ConfigurationError: a file cannot be read, or the result is not a valid configuration.
    """
    folder = output.parent
    base = None
    if config is not None:
        base = configuration.load(config)
        # Paths of positions files are relative to the configuration's folder, which may be another
        # one here.
        base = _with_positions(base, lambda name: os.path.relpath(config.parent / name, folder))
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
    _check(text, written, output)
    for name, data in written.items():
        write_atomic(folder / name, data)
    write_atomic(output, text.encode())
    return [output, *(folder / name for name in written)]


def _with_positions(settings: Settings, renamed: Callable[[str], str]) -> Settings:
    """Return the same settings with renamed positions files."""

    def changed(patch: Patch) -> Patch:
        if patch.positions is None:
            return patch
        return msgspec.structs.replace(patch, positions=renamed(patch.positions))

    parts = {
        name: msgspec.structs.replace(part, patches=[changed(patch) for patch in part.patches])
        for name, part in settings.parts.items()
    }
    return msgspec.structs.replace(settings, parts=parts)


def _check(text: str, written: dict[str, bytes], output: Path) -> None:
    """Read the new configuration back in a temporary folder before it is written.

    Raises:
        ConfigurationError: it is not a valid configuration.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / output.name
        for name, data in {**written, output.name: text.encode()}.items():
            write_atomic(trial.parent / name, data)

        def where_it_is(name: str) -> str:
            return name if name in written else str((output.parent / name).resolve())

        try:
            settings = _with_positions(configuration.load(trial), where_it_is)
            build_layout(settings, trial.parent)
        except ConfigurationError as error:
            what = str(error).removeprefix(f"{trial}: ")
            raise ConfigurationError(
                f"{output}: the files do not give a valid configuration: {what}"
            ) from None
