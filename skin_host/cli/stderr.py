"""Standard error, which never changes what a command does.

What it does not take, because its disk is full or its reader is gone, is lost. A reader that stops
(a pager, a journal that hangs) holds up a command that prints a few lines, but not one that
runs on: from `write_in_thread` on lines wait in memory, and those for which it has no room are
counted and lost.
"""

import atexit
import codecs
import contextlib
import io
import logging
import os
import select
import sys
import threading
import unicodedata
from collections import deque
from dataclasses import dataclass
from typing import Any

from skin_host.daemon import service

#: How streams encode (`errors=`) a character that their encoding has not: with the characters that
#: stand for it, such as 2 for a raised one, or a question mark.
SPELT = "skin-spelt"
#: So much waits for the reader: some thousand lines.
LIMIT_BYTES = 1 << 20
#: The end of the process waits so long for the reader.
END_S = 1.0


@dataclass(slots=True)
class _Waiting:
    """Bytes that wait, and how many lines are lost that came after them."""

    data: bytes
    lost_after: int = 0
    is_note: bool = False

    @property
    def lines(self) -> int:
        """How many lines are lost with them. A line of more than 8 KiB comes in pieces."""
        return 0 if self.is_note else max(1, self.data.count(b"\n"))


class StandardError(io.RawIOBase):
    """The raw stream below `sys.stderr`.

    Attributes:
        lines_lost: since `write_in_thread`.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._waiting: deque[_Waiting] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self.lines_lost = 0

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        if self._thread is None:
            self._put(data)
            return len(data)
        new = _Waiting(bytes(data))
        with self._changed:
            if self._waiting and self._bytes + len(data) > LIMIT_BYTES:
                self.lines_lost += new.lines
                self._waiting[-1].lost_after += new.lines
            else:
                self._waiting.append(new)
                self._bytes += len(data)
                self._changed.notify_all()
        return len(data)

    def write_in_thread(self) -> None:
        """Never wait for the reader from now on."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="standard error", daemon=True)
            self._thread.start()

    def finish(self) -> None:
        """Wait until all is written, for `END_S` at most."""
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting, END_S)

    def _work(self) -> None:
        unreported = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                first = self._waiting[0]
            written = self._put(first.data)
            with self._changed:
                if written and first.is_note:
                    unreported = 0
                elif not written:
                    self.lines_lost += first.lines
                    unreported += first.lines
                unreported += first.lost_after
                self._waiting.popleft()
                self._bytes -= len(first.data)
                if written and unreported:
                    note = _Waiting(_note(unreported), is_note=True)
                    self._waiting.appendleft(note)
                    self._bytes += len(note.data)
                self._changed.notify_all()

    def _put(self, data: Any) -> bool:
        """Write; return whether all was taken."""
        left = memoryview(data)
        with contextlib.suppress(OSError):
            while left:
                try:
                    left = left[os.write(self._descriptor, left) :]
                except BlockingIOError:  # another program has set the pipe or terminal so
                    poll = select.poll()
                    poll.register(self._descriptor, select.POLLOUT)
                    poll.poll()
            return True
        return False


def _note(lost: int) -> bytes:
    lines = "1 line" if lost == 1 else f"{lost} lines"
    text = f"{lines} of the log were lost here: it was not read, or had no room"
    level = logging.WARNING
    if service.to_journal():
        text = service.with_priority(text, level)
    else:
        text = f"{logging.getLevelName(level):7} {text}"
    return (text + "\n").encode()


def _spell(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    spelt = unicodedata.normalize("NFKC", error.object[error.start : error.end])
    return spelt.encode(error.encoding, "replace").decode(error.encoding), error.end


codecs.register_error(SPELT, _spell)


def replace() -> None:
    """Make `sys.stderr` a stream over `StandardError`, unless it is another program's."""
    own = sys.__stderr__
    if own is None or sys.stderr is not own:
        return
    raw = StandardError(own.fileno())
    sys.stderr = io.TextIOWrapper(
        io.BufferedWriter(raw), encoding=own.encoding, errors=SPELT, line_buffering=True
    )
    atexit.register(raw.finish)


def current() -> StandardError | None:
    """Return what `replace` made, if `sys.stderr` is that."""
    raw = getattr(getattr(sys.stderr, "buffer", None), "raw", None)
    return raw if isinstance(raw, StandardError) else None


def lines_lost() -> int:
    """Return how many lines standard error has lost since it is written in a thread."""
    raw = current()
    return 0 if raw is None else raw.lines_lost
