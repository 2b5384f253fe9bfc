"""Writes files completely or not at all; reads files of limited size, and checks their schema."""

import contextlib
import errno
import fcntl
import itertools
import logging
import math
import os
import secrets
import select
import signal
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import IO, Protocol, TypeVar

import msgspec

from skin_host.errors import (
    BusyFileError,
    NewerFileError,
    OtherRobotError,
    RequestError,
    SkinError,
)
from skin_host.untrusted import from_json

log = logging.getLogger(__name__)

#: No valid document is larger: a calibration of 100 000 taxels has 20 MB.
MAX_DOCUMENT_BYTES = 64 * 1024 * 1024
#: What does not state its size, as a pipe or a device, is read for so long.
PATIENCE_S = 10.0
#: A name in a folder has at most so many bytes (NAME_MAX of Linux).
_MOST_NAME_BYTES = 255
#: An interim name has at most so many more than the final one.
_MARK_BYTES = 18
#: As many links as the system itself follows from one name.
_MOST_LINKS = 40


class _WithSchema(Protocol):
    schema: str


T = TypeVar("T", bound=_WithSchema)
_PIECE_BYTES = 1 << 20


class _Head(msgspec.Struct):
    schema: str = ""
    robot: str = ""


def read_whole(path: Path, most_bytes: int = MAX_DOCUMENT_BYTES) -> bytes:
    """Read a file that somebody names, whatever it is: a device without end, a pipe, a file that
    grows.

    A named pipe that nobody has open for writing is refused, not waited for. What does not state
    its size is waited for until its end, but no longer than `PATIENCE_S` altogether. A file that
    another program is writing is refused, because half of it may look like a whole one.

    Args:
        path: of the file.
        most_bytes: the largest size of a regular file; of anything else not more than
            `MAX_DOCUMENT_BYTES` are read.

    Raises:
        OSError: the file cannot be read, is larger, or does not end in time; `strerror` is the
            reason.
        BusyFileError: another program is writing it.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except ValueError as error:  # a zero byte in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from None
    try:
        status = os.fstat(descriptor)
        is_regular = stat.S_ISREG(status.st_mode)
        if stat.S_ISDIR(status.st_mode):
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if is_regular:
            _refuse_busy(path, descriptor)
        else:
            most_bytes = min(most_bytes, MAX_DOCUMENT_BYTES)
        # What states its size is refused unread; the rest is read up to the limit.
        left = most_bytes + 1 if status.st_size <= most_bytes else 0
        pieces = []
        # The system's own files of /proc claim to be regular and empty, also the endless ones.
        states_size = is_regular and status.st_size > 0
        end_s = math.inf if states_size else time.monotonic() + PATIENCE_S
        while left and (piece := _piece(path, descriptor, min(left, _PIECE_BYTES), end_s)):
            pieces.append(piece)
            left -= len(piece)
        after = os.fstat(descriptor)
    finally:
        os.close(descriptor)
    if is_regular and _version(after) != _version(status):
        raise _busy(path)
    if stat.S_ISFIFO(status.st_mode) and not pieces:
        raise OSError(errno.ENODATA, "a pipe that nobody writes to", str(path))
    if not left:
        raise OSError(errno.EFBIG, f"larger than {most_bytes} bytes", str(path))
    return b"".join(pieces)


def _piece(path: Path, descriptor: int, most_bytes: int, end_s: float) -> bytes:
    """Return the next bytes of what is open without waiting, none at its end; wait until `end_s`.

    Raises:
        OSError: it cannot be read, or the time is over.
    """
    while True:
        left_s = end_s - time.monotonic()
        if left_s <= 0:
            why = f"it did not end within {PATIENCE_S:g} s"
            raise OSError(errno.ETIMEDOUT, why, str(path))
        try:
            return os.read(descriptor, most_bytes)
        except BlockingIOError:
            waiting = select.poll()
            waiting.register(descriptor, select.POLLIN)
            waiting.poll(min(left_s, PATIENCE_S) * 1e3)


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
        found = from_json(data, kind)
    except msgspec.DecodeError as error:
        if "unknown field" in str(error) and _is_whole(data):
            raise _newer(path, what, str(error)) from None
        raise wrong(f"not a {what} file: {error}") from None
    if found.schema != schema:
        raise wrong(f'schema "{found.schema}", wanted "{schema}"')
    return found


def _is_whole(data: bytes) -> bool:
    try:
        from_json(data, object)
    except msgspec.DecodeError:
        return False
    return True


def refuse_newer(path: Path, schema: str, what: str) -> None:
    """Protect a file that a newer version has written from being replaced.

    Raises:
        NewerFileError: `path` is such a file.
        BusyFileError: another program is writing it.
    """
    data = _what_there_is(path)
    if data is not None:
        _refuse_newer(path, data, schema, what)


def refuse_other_robot(path: Path, robot: str, what: str) -> None:
    """Protect a file that a node of another robot keeps: a state directory gives two of them the
    same name where `a` has a node `b-c`, and `a-b` a node `c`.

    Files of older versions that do not name their robot are everybody's.

    Raises:
        OtherRobotError: `path` is such a file.
        BusyFileError: another program is writing it.
    """
    data = _what_there_is(path)
    if data is None:
        return
    try:
        seen = from_json(data, _Head).robot
    except msgspec.DecodeError:
        return  # damaged, which others report
    if seen not in ("", robot):
        raise OtherRobotError(
            f'{path}: the {what} file of robot "{seen[:64]}", this is robot "{robot}"; give each '
            "robot a folder of its own: service.state_directory"
        )


def _what_there_is(path: Path) -> bytes | None:
    """Return the content of a regular file; None if there is none that can be read."""
    try:
        return read_whole(path) if path.is_file() else None
    except OSError:
        return None


def _refuse_newer(path: Path, data: bytes, schema: str, what: str) -> None:
    try:
        seen = from_json(data, _Head).schema
    except msgspec.DecodeError:
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


def give_second_name(path: Path, word: str) -> Path | None:
    """Give a file the name `NAME.WORD-TIME`, too, under which its content outlives its replacement.
    A file that has this name already keeps it.

    One that this user may not read loses its first name by that: it cannot be copied, and the
    system links only one's own.

    Returns:
        This name; None if its content has such a name already.

    Raises:
        OSError: the folder is read-only, the disk is full, ...
        BusyFileError: another program is writing the file.
    """
    import filecmp

    from skin_host.clock import SYSTEM

    mark = f"{path.name}.{word}-"
    second = _unused(path.with_name(f"{mark}{SYSTEM.today():%Y%m%dT%H%M%SZ}"))
    if not os.access(path, os.R_OK):
        path.rename(second)
        return second
    named = [one for one in path.parent.iterdir() if one.name.startswith(mark)]
    readable = [one for one in named if os.access(one, os.R_OK)]
    if any(filecmp.cmp(path, one, shallow=False) for one in readable):
        return None
    try:
        os.link(path, second)
    except OSError:  # a kind of disk without links
        _replace(second, read_whole(path))
    return second


def _unused(path: Path) -> Path:
    """Return a name that no file has: this one, or with a number. Computers without a clock of
    their own live through the same second at each start.
    """
    names = itertools.chain(
        [path], (path.with_name(f"{path.name}-{n}") for n in itertools.count(2))
    )
    return next(name for name in names if not os.path.lexists(name))


def set_aside(path: Path) -> None:
    """Give a damaged file a second name, under which its content outlives its replacement.

    The first name stays until then: whatever start comes before finds that the file is damaged.
    """
    try:
        if not path.is_file():
            return  # a folder, a pipe: nothing is lost
        aside = give_second_name(path, "damaged")
    except OSError as error:
        log.error("%s: damaged, and cannot be set aside: %s", path, error.strerror)
    else:
        if aside is not None:
            log.warning("%s: damaged; set aside as %s", path, aside.name)


class Disk:
    """The steps in which a file is replaced. To test a power failure between any two of them, tests
    and `skin simulate` replace this object by `on_disk`.
    """

    def create(self, path: Path, data: bytes) -> Path:
        """Write a temporary file beside `path`; return its name."""
        import tempfile  # which imports every way of compression

        name = _cut(path.name, _MOST_NAME_BYTES - _MARK_BYTES)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{name}.")
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
        with contextlib.suppress(OSError):  # a kind of disk without permissions
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
    """Replace `path` by a document as indented JSON, in one step that survives a crash.

    For what the program keeps under names of its own: whatever has the name is replaced, a link or
    a pipe that somebody may have put there, too. Missing parent folders are made.

    Raises:
        OSError: the folder is read-only, the disk is full, ...; `path` is then unchanged.
    """
    with _naming(path):
        _replace(path, msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n")


def write_atomic(path: Path, data: bytes) -> bool:
    """Write `data` where a user names it: a file is replaced in one step that survives a crash at
    any moment.

    The bytes go to a temporary file in the same folder, are forced to disk, and
    then take the name. Missing parent folders are made. Links are followed to the file that they
    name; a device, a pipe, or what this program has open (/dev/stdout) is written into.

    Returns:
        Whether there is a file of that name now: see `becomes_file`.

    Raises:
        OSError: `path` is a folder, the folder is read-only, the disk is full, ...; a file is then
            unchanged. `filename` is `path`.
    """
    with _naming(path):
        end = _end_of(path)
        file = _file_at(end)
        if file is not None:
            _replace(file, data)
        else:
            with _opened(end) as there:
                there.write(data)
        return file is not None


def _replace(path: Path, data: bytes) -> None:
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


def becomes_file(path: Path) -> bool:
    """Whether what is written to `path` is a file of that name afterwards, not what a device, a
    pipe or a descriptor has taken.

    Raises:
        OSError: `path` is a folder, or its links cannot be followed.
    """
    with _naming(path):
        return _file_at(_end_of(path)) is not None


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Let errors name what the user has named, not a temporary file or the end of a link."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None


def _end_of(path: Path) -> Path | int:
    """Follow the links of a name; return the last name, or the descriptor of this program that it
    stands for, as /dev/stdout and /dev/fd/3 do.

    Raises:
        OSError: the links have no end, or another user has put one into a folder of all users.
    """
    own = f"/proc/{os.getpid()}/fd"
    for _ in range(_MOST_LINKS):
        folder = os.path.realpath(path.parent)
        path = Path(folder, path.name)
        try:
            link = path.readlink()
        except OSError:  # no link, or nothing
            return path
        if folder == own:
            return int(path.name)
        _refuse_link_of_others(path)
        path = Path(folder, link)
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))


def _refuse_link_of_others(link: Path) -> None:
    """Where everybody may write, as in /tmp, follow only one's own links and the folder owner's.

    So does the system itself, if it is set up so (fs.protected_symlinks).
    """
    folder, owner = link.parent.stat(), link.lstat().st_uid
    for_all = stat.S_ISVTX | stat.S_IWOTH
    if folder.st_mode & for_all == for_all and owner not in (os.geteuid(), folder.st_uid):
        raise OSError(errno.EACCES, "a link of another user in a folder of all users", str(link))


def _file_at(end: Path | int) -> Path | None:
    """Return the regular file that is there, or can be made there; None where there is another
    thing, which takes what is written.

    Raises:
        OSError: it is a folder, or cannot be looked at.
    """
    if isinstance(end, int):
        return None
    try:
        mode = end.lstat().st_mode
    except FileNotFoundError:
        return end
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, "it is a folder; wanted a file", str(end))
    return end if stat.S_ISREG(mode) else None


def _opened(end: Path | int) -> IO[bytes]:
    """Open a device, a pipe (whose reader is waited for), or a descriptor of this program."""
    if isinstance(end, int):
        return os.fdopen(os.dup(end), "wb")
    return os.fdopen(os.open(end, os.O_WRONLY | os.O_NOCTTY | os.O_NOFOLLOW), "wb")


def _growing(path: Path) -> Path:
    """Return the name of a file that takes the name `path` when it is complete.

    No other program has it: of two that write the same file, the last one's is whole.
    """
    stem = _cut(path.stem, _MOST_NAME_BYTES - _MARK_BYTES - len(os.fsencode(path.suffix)))
    return path.with_name(f".{stem}.growing-{secrets.token_hex(4)}{path.suffix}")


def _cut(name: str, most: int) -> str:
    """Return as much of a name as fits so many bytes, in whole characters."""
    return os.fsencode(name)[: max(most, 0)].decode(errors="ignore")


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
        RequestError: in place of an OSError, if there is a folder of this name.
        SkinError: in place of another OSError.
    """
    try:
        yield
    except OSError as error:
        kind = RequestError if isinstance(error, IsADirectoryError) else SkinError
        raise kind(f"{path}: cannot be written: {error.strerror}") from None


class Draft:
    """A file in progress that gets to where a user names it when it is complete, or not at all.

    It lies beside the file that it replaces, links followed. Where it becomes no file, but goes
    into a device, a pipe or what this program has open (/dev/stdout), it lies in the folder of
    temporary files: it can be written in any order, and nobody reads half of it.

    Args:
        wanted: the name; missing parent folders are made, and removed with a draft that is not
            completed.
        new: a file that has this name by then is not replaced.

    Attributes:
        path: where to write; its suffix is that of `wanted`.

    Raises:
        OSError: `wanted` is a folder, or there can be none that it lies in.
    """

    def __init__(self, wanted: Path, *, new: bool = False) -> None:
        self._wanted, self._new = wanted, new
        #: Folders that were made for it, the deepest first.
        self._folders: list[Path] = []
        with _naming(wanted):
            self._end = _end_of(wanted)
            self._file = _file_at(self._end)
            if self._file is not None:
                self._folders = [one for one in self._file.parents if not os.path.lexists(one)]
                self._file.parent.mkdir(parents=True, exist_ok=True)
                self.path = _growing(self._file.with_name(wanted.name))
            else:
                import tempfile  # which imports every way of compression

                self.path = _growing(Path(tempfile.gettempdir()) / wanted.name)

    def begin(self) -> None:
        """Make it, empty. A signal that ends the program may come right after.

        Raises:
            OSError: no file can be made there.
        """
        mode = 0o600 if self._file is None else 0o666
        with _naming(self._wanted):
            # Nobody who may write to the folder, as everybody to /tmp, can have put a link there.
            os.close(os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))

    def sync(self) -> None:
        """Force it to the disk, which may be full only then.

        Raises:
            OSError: the disk is full, ...
        """
        with _naming(self._wanted):
            (_disk.get() or _DISK).sync(self.path)

    def finish(self) -> None:
        """Let it replace the wanted file, or write it into what is there.

        Raises:
            OSError: the disk is full, the file was removed, ...
            FileExistsError: a new file was wanted, and there is another by now.
        """
        with _naming(self._wanted):
            if self._file is not None:
                (_disk.get() or _DISK).sync(self.path)
                if self._new:
                    # Of two that end at once one makes the name; not every file system has links.
                    os.close(os.open(self._file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
                os.replace(self.path, self._file)
                return
            import shutil

            with self.path.open("rb") as whole, _opened(self._end) as there:
                shutil.copyfileobj(whole, there)
            self.remove()

    @contextlib.contextmanager
    def keeping(self) -> Iterator[None]:
        """If it cannot be completed, let the error name what there is of it.

        Raises:
            OSError: in place of one that the code inside raises.
        """
        try:
            yield
        except OSError as error:
            if error.errno is None or not self.path.exists():
                raise
            if isinstance(error, FileExistsError):
                why = f"another file got this name meanwhile; this one is {self.path}"
                raise OSError(error.errno, why) from None
            raise OSError(error.errno, f"{error.strerror}; a part of it is {self.path}") from None

    def remove(self) -> None:
        """Remove it, if it is still in progress, and the folders that were made for it alone."""
        self.path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # something else lies there
            for folder in self._folders:
                folder.rmdir()


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield where to write a file that appears complete or not at all; see `Draft`.

    Raises:
        RequestError: there is a folder of this name.
        SkinError: it cannot be written.
    """
    with writing(path):
        draft = Draft(path)
        try:
            draft.begin()
            yield draft.path
            draft.finish()
        finally:
            draft.remove()


def refuse_input(output: Path | None, *inputs: Path | None) -> None:
    """Protect what a command reads from being replaced by what it writes.

    Raises:
        RequestError: `output` is one of the inputs; None is none.
    """
    for one in inputs:
        if output is not None and one is not None:
            with contextlib.suppress(OSError):  # one of them is absent
                if output.samefile(one):
                    raise RequestError(f"{output}: is read by this command; choose another name")


def check_output(output: Path, *, folder: bool = False) -> None:
    """Check before long work that its result can be written, as far as that can be known then.

    Args:
        output: where to write.
        folder: it is to be a folder of files.

    Raises:
        RequestError: there is a folder where a file is wanted, or the reverse.
        SkinError: it lies where nothing can be written.
    """
    with writing(output), _naming(output):
        place = output.absolute()
        if not folder:
            file = _file_at(_end_of(output))
            if file is None:
                return  # a device, a pipe, or what is open
            place = file.absolute().parent
        while not os.path.lexists(place):
            place = place.parent
        if folder and place == output.absolute() and not place.is_dir():
            raise RequestError(f"{output}: is a file; wanted a folder")
        if not place.is_dir():
            raise OSError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(place))
        import tempfile  # which imports every way of compression

        # Permissions do not show what a file system such as /proc takes.
        with tempfile.TemporaryFile(dir=place):
            pass


def write_together(
    files: Iterable[tuple[Path, bytes]], made_from: Sequence[Path] = ()
) -> list[Path]:
    """Write files that belong together: names and contents. None gets its name before all of them
    are on the disk, so that one that is full leaves what was there.

    Args:
        files: names and contents.
        made_from: files that none of them replaces.

    Returns:
        The names.

    Raises:
        RequestError: there is a folder of one of these names, or one is of `made_from`.
        SkinError: one of them cannot be written.
    """
    drafts: dict[Path, Draft] = {}
    try:
        for path, data in files:
            refuse_input(path, *made_from)
            with writing(path):
                drafts[path] = Draft(path)
                drafts[path].begin()
                drafts[path].path.write_bytes(data)
                drafts[path].sync()
        for path, draft in drafts.items():
            with writing(path):
                draft.finish()
    finally:
        for draft in reversed(drafts.values()):  # the first may have made the folder of all
            draft.remove()
    return list(drafts)
