"""Records received frames in candump's format, for `skin replay`.

The receive path passes batches on and continues; a thread writes. Frames that the disk does not
take in time, or at all, are lost to the recording and counted, and have no other effect.
"""

import contextlib
import logging
import os
import queue
import threading
from pathlib import Path

import numpy as np

from skin_host.bus.port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM, Clock
from skin_host.errors import SkinError

log = logging.getLogger(__name__)

WAITING_BATCHES = 4096
#: A folder holds no more recordings than this, because requests for them come from the network.
MAX_RECORDINGS = 100
#: A disk that needs longer than this is no longer waited for.
PATIENCE_S = 1.0
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
    """One recording, from now until it is stopped, is long enough, or fails.

    Args:
        path: a new file.
        seconds: how long at most.
        max_bytes: how large at most.
        clock: by which the time ends.

    Attributes:
        frames: recorded.
        lost: frames that the disk did not take in time.
        ended: why it has ended, None while it continues.

    Raises:
        SkinError: the file exists, or cannot be made.
    """

    def __init__(self, path: Path, seconds: float, max_bytes: int, clock: Clock = SYSTEM) -> None:
        self.path = path
        self.frames = 0
        self.bytes = 0
        self.lost = 0
        self.ended: str | None = None
        self._max_bytes = max_bytes
        self._clock = clock
        self._until_s = clock.monotonic_s() + seconds
        self._finishing = threading.Event()
        self._queue: queue.Queue[tuple[str, FrameBatch] | None] = queue.Queue(WAITING_BATCHES)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if sum(1 for _ in path.parent.iterdir()) >= MAX_RECORDINGS:
                raise SkinError(
                    f"{path.parent}: holds {MAX_RECORDINGS} recordings already; move some away"
                )
            self._file = path.open("xb", buffering=0)
        except OSError as error:
            raise SkinError(f"{path}: cannot be recorded to: {error.strerror}") from None
        self._thread = clock.thread(self._write, "recorder")

    def put(self, channel: str, batch: FrameBatch) -> None:
        """Record a batch; never waits."""
        if self.ended is not None or self._finishing.is_set():
            return
        copy = FrameBatch(batch.id.copy(), batch.dlc.copy(), batch.data.copy(), batch.t_ns.copy())
        try:
            self._queue.put_nowait((channel, copy))
        except queue.Full:
            self.lost += len(batch)

    def finish(self) -> None:
        """End the recording, without waiting; frames already put are written first."""
        self._finishing.set()
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)  # wakes the writer; a full queue does so, too

    async def finished(self, patience_s: float = PATIENCE_S) -> None:
        """Wait until it has ended, or the disk needs longer than `patience_s`."""
        end_s = self._clock.monotonic_s() + patience_s
        while self._thread.is_alive():
            if self._clock.monotonic_s() > end_s:
                self.ended = self.ended or "the disk did not take what waited"
                return
            await self._clock.sleep(0.01)

    def _write(self) -> None:
        level = logging.INFO
        try:
            with self._file:
                while True:
                    left_s = self._until_s - self._clock.monotonic_s()
                    if left_s <= 0:
                        self.ended = "the time is over"
                        return
                    if self.ended is not None:
                        return  # given up
                    try:
                        item = self._queue.get(timeout=min(left_s, 0.5))
                    except queue.Empty:
                        item = None
                    if item is None:
                        if not self._finishing.is_set() or not self._queue.empty():
                            continue
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
