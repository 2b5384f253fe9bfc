"""A disk that can be full or read-only, and that loses what was not forced to it as power fails."""

import errno
import os
import random
from collections.abc import Callable
from pathlib import Path

from skin_host.evaluation.simulate.trace import Trace
from skin_host.files import Disk


class PowerCut(BaseException):
    """The computer lost its power while it wrote. Nothing may catch this but the simulation."""


class SimulatedDisk(Disk):
    """The disk of one start of the computer, over a folder of the real one.

    Args:
        chance: decides what a power cut leaves.
        now_ns: time, for the trace.
        trace: takes each step.
        cut: called when the power is cut in the middle of writing.

    Attributes:
        refuses: the error that writing gives, or None.
        steps_left: the power is cut after so many more steps; None is not at all.
    """

    def __init__(
        self,
        chance: random.Random,
        now_ns: Callable[[], int],
        trace: Trace,
        cut: Callable[[], None],
    ) -> None:
        self.refuses: int | None = None
        self.steps_left: int | None = None
        self._chance = chance
        self._now_ns = now_ns
        self._trace = trace
        self._cut = cut
        self._dead = False
        #: Files whose bytes are not on the disk yet, and replaced files whose folder is not.
        self._unwritten: set[Path] = set()
        self._replaced: list[tuple[Path, bytes | None]] = []

    def create(self, path: Path, data: bytes) -> Path:
        self._step(f"create {path.name}")
        temporary = super().create(path, data)
        self._unwritten.add(temporary)
        return temporary

    def sync(self, path: Path) -> None:
        self._step("sync")
        if path.is_dir():
            self._replaced.clear()
        else:
            self._unwritten.discard(path)

    def rename(self, temporary: Path, path: Path) -> None:
        self._step(f"rename to {path.name}")
        self._replaced.append((path, path.read_bytes() if path.exists() else None))
        super().rename(temporary, path)
        if temporary in self._unwritten:
            self._unwritten.discard(temporary)
            self._unwritten.add(path)

    def remove(self, temporary: Path) -> None:
        if not self._dead:
            self._unwritten.discard(temporary)
            super().remove(temporary)

    def cut(self) -> None:
        """The power fails: what was not forced to the disk may be there or not."""
        if self._dead:
            return
        self._dead = True
        for path in sorted(self._unwritten):
            if path.exists() and self._chance.random() < 0.7:
                kept = int(self._chance.random() * path.stat().st_size)
                os.truncate(path, kept)
        for path, before in reversed(self._replaced):
            if self._chance.random() < 0.5:
                if before is None:
                    path.unlink()
                else:
                    path.write_bytes(before)

    def die(self) -> None:
        """The process is killed: what it wrote stays, and it writes no more."""
        self._dead = True

    def _step(self, what: str) -> None:
        if self._dead:
            raise PowerCut
        if self.steps_left is not None:
            self.steps_left -= 1
            if self.steps_left < 0:
                self._trace.note(self._now_ns(), f"disk: power fails before {what}")
                self.cut()
                self._cut()
                raise PowerCut
        if self.refuses is not None and not what.startswith("sync"):
            raise OSError(self.refuses, os.strerror(self.refuses))
        self._trace.note(self._now_ns(), f"disk: {what}")


FULL = errno.ENOSPC
READ_ONLY = errno.EROFS
