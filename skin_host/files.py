"""Files are written whole or not at all, and read as what they say they are."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

import msgspec


class _WithSchema(Protocol):
    schema: str


T = TypeVar("T", bound=_WithSchema)


def read_document(
    path: Path, kind: type[T], schema: str, what: str, wrong: Callable[[str], Exception]
) -> T:
    """Read a JSON file that names its schema.

    Args:
        path: of the file.
        kind: what it must hold.
        schema: the one that is known.
        what: the file is called in messages.
        wrong: makes an error of what is wrong.

    Raises:
        Exception: what `wrong` makes, if the file is unreadable, damaged or of another schema.
    """
    try:
        found = msgspec.json.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise wrong(f"cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise wrong(f"not a {what} file: {error}") from None
    if found.schema != schema:
        raise wrong(f'schema "{found.schema}", wanted "{schema}"')
    return found


def write_atomic(path: Path, data: bytes) -> None:
    """Replace `path` by `data` in one step that survives a crash at any moment.

    The bytes go to a temporary file in the same folder, are forced to disk, and
    then take the name. Missing parent folders are made.

    Raises:
        OSError: the folder is read-only, the disk is full, ...; `path` is then unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
