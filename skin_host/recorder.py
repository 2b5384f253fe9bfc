"""Recording of what the buses bring, in candump's format, for `skin replay`.

The acquisition hands over batches and goes on; a thread writes. What the disk does not take
in time, or at all, is lost to the recording, counted, and never felt by anyone else.
"""

import contextlib
import logging
import os
import queue
import threading
import time
from pathlib import Path

import numpy as np

from skin_host.bus.port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from skin_host.bus.protocol import FrameBatch
from skin_host.errors import SkinError

log = logging.getLogger(__name__)

WAITING_BATCHES = 4096
_FLAGS = ERROR_FLAG | EXTENDED_FLAG | REMOTE_FLAG


def candump_lines(channel: str, batch: FrameBatch) -> bytes:
    """A batch as lines of a candump log (`candump -l`); error and remote frames are left out."""
    lines = []
    plain = np.flatnonzero((batch.id & np.uint32(_FLAGS)) == 0).tolist()
    for row in plain:
        seconds, rest = divmod(int(batch.t_ns[row]), 1_000_000_000)
        data = batch.data[row, : min(int(batch.dlc[row]), 8)].tobytes().hex().upper()
        lines.append(f"({seconds}.{rest // 1000:06d}) {channel} {int(batch.id[row]):03X}#{data}\n")
    return "".join(lines).encode()


class Recorder:
    """One recording, from now until it is stopped, is long enough, or cannot go on.

    Args:
        path: a new file.
        seconds: how long at most.
        max_bytes: how large at most.

    Attributes:
        frames: recorded.
        lost: frames that the disk did not take in time.
        ended: why it has ended, None while it goes on.

    Raises:
        SkinError: the file exists, or cannot be made.
    """

    def __init__(self, path: Path, seconds: float, max_bytes: int) -> None:
        self.path = path
        self.frames = 0
        self.bytes = 0
        self.lost = 0
        self.ended: str | None = None
        self._max_bytes = max_bytes
        self._until_s = time.monotonic() + seconds
        self._queue: queue.Queue[tuple[str, FrameBatch] | None] = queue.Queue(WAITING_BATCHES)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb", buffering=0)
        except OSError as error:
            raise SkinError(f"{path}: cannot be recorded to: {error.strerror}") from None
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    def put(self, channel: str, batch: FrameBatch) -> None:
        """Record a batch; never waits."""
        if self.ended is not None:
            return
        copy = FrameBatch(batch.id.copy(), batch.dlc.copy(), batch.data.copy(), batch.t_ns.copy())
        try:
            self._queue.put_nowait((channel, copy))
        except queue.Full:
            self.lost += len(batch)

    def stop(self) -> None:
        """End the recording; what has been put is written first."""
        if self.ended is None:
            try:
                self._queue.put(None, timeout=1.0)
            except queue.Full:
                self.ended = "the disk did not take what waited"
        self._thread.join(5.0)

    def _write(self) -> None:
        level = logging.INFO
        try:
            with self._file:
                while True:
                    left_s = self._until_s - time.monotonic()
                    if left_s <= 0:
                        self.ended = "the time is over"
                        return
                    try:
                        item = self._queue.get(timeout=min(left_s, 0.5))
                    except queue.Empty:
                        continue
                    if item is None:
                        self.ended = "stopped"
                        return
                    lines = candump_lines(*item)
                    if self.bytes + len(lines) > self._max_bytes:
                        self.ended = f"it reached its {self._max_bytes} bytes"
                        return
                    self._append(lines)
                    self.bytes += len(lines)
                    self.frames += len(item[1])
        except OSError as error:
            level = logging.WARNING
            self.ended = f"cannot write: {error.strerror}"
            with contextlib.suppress(OSError):
                os.truncate(self.path, self.bytes)  # whole lines, all of them counted
        finally:
            log.log(level, "recording %s ended: %s", self.path, self.ended)

    def _append(self, lines: bytes) -> None:
        rest = memoryview(lines)
        while rest:
            rest = rest[self._file.write(rest) :]
