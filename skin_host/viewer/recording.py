"""A recording that pages start, mark and stop: the robot's messages, in a folder of the server.

Pages name no files, and the folder, each recording and its marks are bounded: requests come from
the network.
"""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable
from pathlib import Path
from typing import Any

from skin_host.clock import SYSTEM, Clock
from skin_host.errors import RequestError, SkinError
from skin_host.mqtt.address import Broker
from skin_host.recording.capture import MAX_RECORDINGS, capture_broker
from skin_host.recording.mcap import SUFFIX, Recorder

MAX_S = 3600.0
MAX_BYTES = 1024**3
MAX_MARKS = 1000
#: A mark may be this much older than its request: somebody typed its text meanwhile.
MAX_AGO_S = 600.0
WATCH_S = 0.25

log = logging.getLogger(__name__)


class PageRecording:
    """At most one recording at a time.

    Args:
        folder: the files go there; it is made when the first recording begins.
        clock: by which the time ends.
    """

    def __init__(self, folder: Path, clock: Clock = SYSTEM) -> None:
        self._folder = folder
        self._clock = clock
        self._path = folder
        self._recorder: Recorder | None = None
        self._task: asyncio.Task[None] | None = None
        self._stop = asyncio.Event()
        self._began_s = 0.0
        self._ended: str | None = None
        self._marks = 0

    @property
    def state(self) -> dict[str, Any] | None:
        """What pages show: the file, its seconds so far, its marks, and why it ended by itself."""
        if self._recorder is not None:
            seconds = int(self._clock.monotonic_s() - self._began_s)
            return {"file": self._path.name, "seconds": seconds, "marks": self._marks}
        if self._ended is not None:
            return {"file": self._path.name, "ended": self._ended}
        return None

    def start(self, broker: Broker, base: str, robot: str) -> dict[str, Any]:
        """Begin a recording.

        Raises:
            RequestError: one is in progress, or the folder is full.
            SkinError: mcap is not installed, or the file cannot be made.
        """
        if self._recorder is not None:
            raise RequestError(f"{self._path.name} is being recorded already; stop it")
        if sum(1 for _ in self._folder.glob(f"*{SUFFIX}")) >= MAX_RECORDINGS:
            raise RequestError(
                f"{self._folder}: holds {MAX_RECORDINGS} recordings already; move some away"
            )
        self._path = self._folder / self._clock.today().strftime(f"%Y%m%dT%H%M%SZ{SUFFIX}")
        if self._path.exists():
            raise RequestError(f"{self._path.name}: is there already; try again")
        self._recorder = Recorder(self._path)
        self._began_s, self._marks, self._ended = self._clock.monotonic_s(), 0, None
        self._stop = asyncio.Event()
        capture = capture_broker(self._recorder, broker, base, robot, self._stop)
        self._task = asyncio.create_task(self._run(capture), name="page's recording")
        return {"file": str(self._path)}

    def mark(self, text: str, ago_s: float) -> dict[str, Any]:
        """Mark a moment of the recording in progress.

        Raises:
            RequestError: there is none, or it has too many marks.
            SkinError: the disk is full or gone.
        """
        if self._recorder is None:
            raise RequestError("nothing is being recorded")
        if self._marks >= MAX_MARKS:
            raise RequestError(f"{self._path.name} has {MAX_MARKS} marks already")
        self._recorder.mark(self._clock.now_ns() - int(ago_s * 1e9), text)
        self._marks += 1
        return {"marks": self._marks}

    async def stop(self) -> dict[str, Any]:
        """End the recording in progress, and say what it holds.

        Raises:
            RequestError: there is none.
            SkinError: the disk is full or gone.
        """
        recorder, task = self._recorder, self._task
        if recorder is None or task is None:
            raise RequestError("nothing is being recorded")
        self._stop.set()
        await asyncio.wait([task])
        if self._ended is not None:
            raise SkinError(self._ended)
        return {
            "file": str(self._path),
            "messages": sum(recorder.messages.values()),
            "marks": self._marks,
            "gaps": recorder.gaps,
        }

    async def _run(self, capture: Awaitable[int]) -> None:
        """Record until stopped, too long or too large, or the disk fails."""
        recorder = self._recorder
        assert recorder is not None
        working = asyncio.ensure_future(capture)
        try:
            while not working.done():
                if self._clock.monotonic_s() - self._began_s > MAX_S:
                    self._ended = f"{self._path.name} has ended: it reached {MAX_S / 60:.0f} min"
                elif recorder.size_bytes > MAX_BYTES:
                    self._ended = f"{self._path.name} has ended: it reached {MAX_BYTES} bytes"
                if self._ended is not None:
                    self._stop.set()
                await asyncio.wait([working], timeout=WATCH_S)
            working.result()
            recorder.close()
        except SkinError as error:
            self._ended = str(error)
        finally:
            working.cancel()
            self._recorder = self._task = None
            log.info("recording %s ended", self._path)

    async def close(self) -> None:
        """End a recording in progress; the server stops."""
        with contextlib.suppress(SkinError):
            await self.stop()
