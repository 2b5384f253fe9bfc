"""Writes files completely or not at all; reads files of limited size, and checks their schema."""

import contextlib
import errno
import fcntl
import logging
import os
import secrets
import signal
import stat
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Protocol, TypeVar

import msgspec

from skin_host.errors import BusyFileError, NewerFileError, SkinError

log = logging.getLogger(__name__)

#: No valid document is larger: a calibration of 100 000 taxels has 20 MB.
MAX_DOCUMENT_BYTES = 64 * 1024 * 1024


class _WithSchema(Protocol):
    schema: str


T = TypeVar("T", bound=_WithSchema)
_PIECE_BYTES = 1 << 20


class _Head(msgspec.Struct):
    schema: str = ""


def read_whole(path: Path, most_bytes: int = MAX_DOCUMENT_BYTES) -> bytes:
    """Read a file that somebody names, whatever it is: a device without end, a pipe, a file that
    grows.

    A named pipe that nobody has open for writing is refused, not waited for. A file that another
    program is writing is refused, because half of it may look like a whole one.

    Args:
        path: of the file.
        most_bytes: the largest size of a regular file; of anything else not more than
            `MAX_DOCUMENT_BYTES` are read.

    Raises:
        OSError: the file cannot be read, or is larger; `strerror` is the reason.
        BusyFileError: another program is writing it.
    """

    def at_once(name: str, flags: int) -> int:
        return os.open(name, flags | os.O_NONBLOCK)

    try:
        file = open(path, "rb", opener=at_once)  # noqa: SIM115
    except ValueError as error:  # a zero byte in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from None
    with file:
        os.set_blocking(file.fileno(), True)
        status = os.fstat(file.fileno())
        if stat.S_ISREG(status.st_mode):
            _refuse_busy(path, file.fileno())
        else:
            most_bytes = min(most_bytes, MAX_DOCUMENT_BYTES)
        # What states its size is refused unread; the rest is read up to the limit.
        left = most_bytes + 1 if status.st_size <= most_bytes else 0
        pieces = []
        while left and (piece := file.read(min(left, _PIECE_BYTES))):
            pieces.append(piece)
            left -= len(piece)
        after = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and _version(after) != _version(status):
        raise _busy(path)
    if stat.S_ISFIFO(status.st_mode) and not pieces:
        raise OSError(errno.ENODATA, "a pipe that nobody writes to", str(path))
    if not left:
        raise OSError(errno.EFBIG, f"larger than {most_bytes} bytes", str(path))
    return b"".join(pieces)


def why_unreadable(path: Path) -> str | None:
    """Return why a file cannot be read that is there, or may be; None: it can, or there is none."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        return error.strerror
    return None if os.access(path, os.R_OK) else "no permission"


def _refuse_busy(path: Path, descriptor: int) -> None:
    """Refuse a file that a program has open for writing; who opens it for that then waits until it
    is closed here.

    A read lease does both. The system gives it to a file's owner and to root, and not on every kind
    of disk; where there is none, what changes during the reading is noticed after it.
    """
    lease = getattr(fcntl, "F_SETLEASE", None)  # Linux only
    if lease is None:
        return
    try:
        # Otherwise the signal for "somebody waits" would end the program.
        fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(descriptor, lease, fcntl.F_RDLCK)
    except OSError as error:
        if error.errno == errno.EAGAIN:
            raise _busy(path) from None


def _version(status: os.stat_result) -> tuple[int, int]:
    return status.st_size, status.st_mtime_ns


def _busy(path: Path) -> BusyFileError:
    return BusyFileError(f"{path}: another program is writing it; repeat this when it has ended")


def read_document(
    path: Path, kind: type[T], schema: str, what: str, wrong: Callable[[str], Exception]
) -> T:
    """Read a JSON file that names its schema.

    `what` names the file in messages, and `wrong` makes an error from a message.

    Raises:
        NewerFileError: a newer version has written it: its schema has a larger number, or a field
            that is not known.
        BusyFileError: another program is writing it.
        Exception: result of `wrong`, if the file is unreadable, damaged or of another schema.
    """
    try:
        data = read_whole(path)
    except OSError as error:
        raise wrong(f"cannot be read: {error.strerror}") from None
    _refuse_newer(path, data, schema, what)
    try:
        found = msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        if "unknown field" in str(error) and _is_whole(data):
            raise _newer(path, what, str(error)) from None
        raise wrong(f"not a {what} file: {error}") from None
    if found.schema != schema:
        raise wrong(f'schema "{found.schema}", wanted "{schema}"')
    return found


def _is_whole(data: bytes) -> bool:
    try:
        msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return True


def refuse_newer(path: Path, schema: str, what: str) -> None:
    """Protect a file that a newer version has written from being replaced.

    Raises:
        NewerFileError: `path` is such a file.
        BusyFileError: another program is writing it.
    """
    try:
        data = read_whole(path)
    except OSError:
        return
    _refuse_newer(path, data, schema, what)


def _refuse_newer(path: Path, data: bytes, schema: str, what: str) -> None:
    try:
        seen = msgspec.json.decode(data, type=_Head).schema
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return  # damaged, which others report
    name, _, number = schema.partition("/")
    seen_name, _, seen_number = seen.partition("/")
    if seen_name == name and seen_number.isdecimal() and int(seen_number[:9]) > int(number):
        raise _newer(path, what, f'schema "{seen[:64]}", known is "{schema}"')


def _newer(path: Path, what: str, why: str) -> NewerFileError:
    return NewerFileError(
        f"{path}: a {what} file of a newer version ({why}); start that version, or move the file "
        f"away with: mv {path} {path}.newer"
    )


def set_aside(path: Path) -> None:
    """Give a damaged file another name, so that nothing overwrites it."""
    from skin_host.clock import SYSTEM

    aside = path.with_name(f"{path.name}.damaged-{SYSTEM.today():%Y%m%dT%H%M%SZ}")
    try:
        os.replace(path, aside)
    except OSError as error:
        log.error("%s: damaged, and cannot be set aside: %s", path, error.strerror)
    else:
        log.warning("%s: damaged; set aside as %s", path, aside.name)


class Disk:
    """The steps in which a file is replaced. To test a power failure between any two of them, tests
    and `skin simulate` replace this object by `on_disk`.
    """

    def create(self, path: Path, data: bytes) -> Path:
        """Write a temporary file beside `path`; return its name."""
        import tempfile  # which imports every way of compression

        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
        except BaseException:
            os.unlink(temporary)
            raise
        return Path(temporary)

    def sync(self, path: Path) -> None:
        """Force a file, or the names in a folder, to the disk."""
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def rename(self, temporary: Path, path: Path) -> None:
        """Let a temporary file take the place of `path`."""
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)

    def remove(self, temporary: Path) -> None:
        """Remove a temporary file that is not needed."""
        os.unlink(temporary)


_DISK = Disk()
_disk: ContextVar[Disk | None] = ContextVar("disk", default=None)


@contextlib.contextmanager
def on_disk(disk: Disk) -> Iterator[None]:
    """The code inside, and tasks started there, write to this disk."""
    token = _disk.set(disk)
    try:
        yield
    finally:
        _disk.reset(token)


def write_document(path: Path, document: object) -> None:
    """Replace `path` by a document as indented JSON; see `write_atomic`."""
    write_atomic(path, msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n")


def write_atomic(path: Path, data: bytes) -> None:
    """Replace `path` by `data` in one step that survives a crash at any moment.

    The bytes go to a temporary file in the same folder, are forced to disk, and
    then take the name. Missing parent folders are made.

    Raises:
        OSError: the folder is read-only, the disk is full, ...; `path` is then unchanged.
    """
    disk = _disk.get() or _DISK
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = disk.create(path, data)
    try:
        disk.sync(temporary)
        disk.rename(temporary, path)
    except BaseException:
        disk.remove(temporary)
        raise
    disk.sync(path.parent)


def growing(path: Path) -> Path:
    """Make an empty file that takes the name `path` when it is complete; return its name.

    No other program has it: of two that write the same file, the last one's is whole. And nobody
    who may write to the folder, as everybody to /tmp, can have put a link there.
    """
    name = path.with_name(f".{path.stem}.growing-{secrets.token_hex(4)}{path.suffix}")
    os.close(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    return name


def refuse_removed(path: Path) -> None:
    """Notice that a file that is being written was removed, or its folder: what is written to it
    then is lost, and no write fails.

    Raises:
        OSError: it has been removed.
    """
    if not os.path.lexists(path):
        raise OSError(errno.ENOENT, "it was removed while it was being written", str(path))


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the error of a disk that is full, gone or read-only into one that names the file.

    Raises:
        SkinError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise SkinError(f"{path}: cannot be written: {error.strerror}") from None


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield where to write a file that appears complete or not at all.

    Raises:
        SkinError: it cannot be written.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = growing(path)
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
