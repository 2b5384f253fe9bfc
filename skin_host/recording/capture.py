"""Records while it happens: messages of a broker and frames of the buses, in or outside the daemon.

Outside, both may go into one MCAP file; CAN frames alone also into the formats of python-can
(candump .log, Vector .asc and .blf, .trc, .csv), chosen by the file's suffix. In the daemon the
receive path passes batches on and continues, and a thread writes them in candump's format. Frames
that the disk does not take in time, or at all, are lost to the recording and counted, and have no
other effect. The live page records messages, as long as somebody who looks at it wants.

Where requests come from the network they name no files, and the folder, each recording and its
marks are bounded.
"""

import asyncio
import contextlib
import logging
import os
import queue
import secrets
import threading
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Self

import can
import numpy as np

from skin_host.bus.opening import open_port
from skin_host.bus.port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Port
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Settings
from skin_host.errors import RequestError, SkinError
from skin_host.files import Draft, refuse_removed, writing
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Retry, connect, explain, first_error
from skin_host.mqtt.payload import MAX_PACKET_BYTES
from skin_host.recording import MCAP_SUFFIX
from skin_host.recording.mcap import Recorder, recorded_topics
from skin_host.tasks import until

#: Takes a batch of a channel.
CanSink = Callable[[str, FrameBatch], None]
CAN_SUFFIXES = (".log", ".asc", ".blf", ".trc", ".csv")
POLL_S = 0.02
MAX_INCOMING = 100_000
WAITING_BATCHES = 4096
#: A folder holds no more recordings than this, because requests for them come from the network.
MAX_RECORDINGS = 100
#: A disk that needs longer than this is no longer waited for.
PATIENCE_S = 1.0
_FLAGS = ERROR_FLAG | EXTENDED_FLAG | REMOTE_FLAG
_ID = 0x1FFFFFFF
#: Bounds of what a page records.
PAGE_MAX_S = 3600.0
PAGE_MAX_BYTES = 1024**3
MAX_MARKS = 1000
#: A mark may be this much older than its request: somebody typed its text meanwhile.
MAX_AGO_S = 600.0
WATCH_S = 0.25

_log = logging.getLogger(__name__)


def message_at(batch: FrameBatch, row: int, channel: str | None = None) -> can.Message:
    """A frame of a batch as python-can has it."""
    flags, dlc = int(batch.id[row]), int(batch.dlc[row])
    return can.Message(
        timestamp=int(batch.t_ns[row]) * 1e-9,
        arbitration_id=flags & _ID,
        is_extended_id=bool(flags & EXTENDED_FLAG),
        is_remote_frame=bool(flags & REMOTE_FLAG),
        is_error_frame=bool(flags & ERROR_FLAG),
        dlc=dlc,
        data=batch.data[row, :dlc].tobytes(),
        channel=channel,
    )


class CanLog:
    """CAN frames in a format of python-can; the file gets its name when it is closed.

    Attributes:
        frames: recorded so far.

    Raises:
        RequestError: the suffix is not one of `CAN_SUFFIXES`.
        SkinError: the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        if path.suffix not in CAN_SUFFIXES:
            known = ", ".join([*CAN_SUFFIXES, MCAP_SUFFIX])
            raise RequestError(f'{path}: suffix "{path.suffix}"; wanted one of {known}')
        self.frames = 0
        self._path = path
        with writing(path):
            self._draft = Draft(path)
            self._logger = can.Logger(self._draft.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not self.frames:
            self._logger.stop()
            self._draft.remove()
        else:
            self.close()

    def put(self, channel: str, batch: FrameBatch) -> None:
        """Record frames of a channel.

        Raises:
            SkinError: the disk is full or gone.
        """
        with writing(self._path):
            refuse_removed(self._draft.path)
            for row in range(len(batch)):
                self._logger.on_message_received(message_at(batch, row, channel))
                self.frames += 1

    def close(self) -> None:
        """End the recording and give it its name.

        Raises:
            SkinError: the disk is full or gone.
        """
        with writing(self._path):
            self._logger.stop()
            self._draft.finish()


async def capture_buses(settings: Settings, sink: CanSink, stop: asyncio.Event) -> int:
    """Pass frames of the configured buses to `sink` until `stop` is set; return how many were lost.

    Other programs, such as the daemon, may read a bus at the same time (SocketCAN).

    Raises:
        BusError: a bus cannot be opened.
        SkinError: the sink failed.
    """
    ports: list[Port] = []
    try:
        for name, bus in settings.buses.items():
            ports.append(open_port(name, bus, settings.receive))
        while not stop.is_set():
            is_behind = False
            for port in ports:
                # Once in turn: a bus on which more comes than is read must not hold up the end.
                batch = port.read()
                is_behind |= len(batch) >= port.capacity
                if len(batch):
                    sink(port.channel, batch)
            await asyncio.sleep(0.0 if is_behind else POLL_S)
        return sum(port.counters.dropped + port.counters.damaged for port in ports)
    finally:
        for port in ports:
            port.close()


async def capture_broker(
    recorder: Recorder, broker: Broker, base: str, robot: str, stop: asyncio.Event
) -> int:
    """Record a robot's messages until `stop` is set; return how often the broker was lost.

    Raises:
        SkinError: the recording cannot be written.
    """
    await until(stop, _listen(recorder, broker, recorded_topics(base, robot)))
    return recorder.gaps


async def _listen(recorder: Recorder, broker: Broker, topics: list[str]) -> None:
    retry = Retry()
    identifier = f"skin-record-{secrets.token_hex(4)}"
    while True:
        try:
            async with connect(
                broker,
                identifier=identifier,
                max_incoming=MAX_INCOMING,
                max_packet=MAX_PACKET_BYTES,
            ) as connection:
                for topic in topics:
                    await connection.subscribe(topic, qos=0 if topic.endswith("/frame") else 1)
                async for message in connection.messages:
                    if isinstance(message.payload, bytes):
                        recorder.say(message.topic.value, time.time_ns(), message.payload)
        except* SkinError as group:
            raise first_error(group) from None
        except* Exception as group:
            recorder.gaps += 1
            _log.warning("broker %s: %s; trying again", broker, explain(first_error(group)))
        await asyncio.sleep(retry.delay_s())


def candump_lines(channel: str, batch: FrameBatch) -> bytes:
    """A batch as lines of a candump log (`candump -l`); error and remote frames are left out."""
    lines = []
    plain = np.flatnonzero((batch.id & np.uint32(_FLAGS)) == 0).tolist()
    for row in plain:
        seconds, rest = divmod(int(batch.t_ns[row]), 1_000_000_000)
        data = batch.data[row, : min(int(batch.dlc[row]), 8)].tobytes().hex().upper()
        lines.append(f"({seconds}.{rest // 1000:06d}) {channel} {int(batch.id[row]):03X}#{data}\n")
    return "".join(lines).encode()


def _check_room(folder: Path, names: str) -> None:
    if sum(1 for _ in folder.glob(names)) >= MAX_RECORDINGS:
        raise RequestError(f"{folder}: holds {MAX_RECORDINGS} recordings already; move some away")


class FrameRecorder:
    """One recording, from now until it is stopped, is long enough, or fails.

    It takes `seconds` at most, by `clock`, and `max_bytes`.

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
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _check_room(path.parent, "*")
            self._file = path.open("xb", buffering=0)
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
                    refuse_removed(self.path)
                    self._append(lines)
                    self.bytes += len(lines)
                    self.frames += len(item[1])
        except OSError as error:
            level = logging.WARNING
            self.ended = f"cannot write: {error.strerror}"
            with contextlib.suppress(OSError):
                os.truncate(self.path, self.bytes)  # whole lines, all of them counted
        finally:
            _log.log(level, "recording %s ended: %s", self.path, self.ended)

    def _append(self, lines: bytes) -> None:
        rest = memoryview(lines)
        while rest:
            rest = rest[self._file.write(rest) :]


class PageRecording:
    """The robot's messages, as pages start, mark and stop them: at most one recording at a time.

    The folder is made when the first recording begins; recordings end by `clock`.
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
        _check_room(self._folder, f"*{MCAP_SUFFIX}")
        self._path = self._folder / self._clock.today().strftime(f"%Y%m%dT%H%M%SZ{MCAP_SUFFIX}")
        if os.path.lexists(self._path):
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
        """End the recording in progress, and return what it holds.

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
                if self._clock.monotonic_s() - self._began_s > PAGE_MAX_S:
                    self._ended = (
                        f"{self._path.name} has ended: it reached {PAGE_MAX_S / 60:.0f} min"
                    )
                elif recorder.size_bytes > PAGE_MAX_BYTES:
                    self._ended = f"{self._path.name} has ended: it reached {PAGE_MAX_BYTES} bytes"
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
            _log.info("recording %s ended", self._path)

    async def close(self) -> None:
        """End a recording in progress; the server stops."""
        with contextlib.suppress(SkinError):
            await self.stop()
