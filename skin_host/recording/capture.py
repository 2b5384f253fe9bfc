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
import errno
import logging
import os
import queue
import secrets
import time
from bisect import bisect_right, insort
from collections.abc import Awaitable, Callable, Collection
from io import FileIO
from pathlib import Path
from typing import Any, Self, cast

import can

from skin_host.bus.asc import DatedAscWriter
from skin_host.bus.logs import WINDOW_NS, candump_name, name_in
from skin_host.bus.opening import open_port
from skin_host.bus.port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Port
from skin_host.bus.wire import FrameBatch, in_slices
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Settings
from skin_host.errors import RequestError, SkinError, StateError
from skin_host.files import Draft, refuse_removed, writing
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Retry, connect, explain, first_error
from skin_host.mqtt.payload import MAX_PACKET_BYTES
from skin_host.recording import MCAP_SUFFIX
from skin_host.recording.mcap import Recorder, recorded_topics
from skin_host.tasks import leave_if_cancelled, until

#: Takes a batch of a channel.
CanSink = Callable[[str, FrameBatch], None]
CANDUMP_SUFFIX = ".log"
CAN_SUFFIXES = (CANDUMP_SUFFIX, ".asc", ".blf", ".trc", ".csv")
POLL_S = 0.02
#: All buses have been read again within this time.
HELD_S = 0.1
#: More frames are not held back: their times stand still.
MAX_HELD = 10_000
MAX_INCOMING = 100_000
WAITING_BATCHES = 4096
#: A folder holds no more recordings than this, because requests for them come from the network.
MAX_RECORDINGS = 100
#: So much of a disk is left to what the daemon keeps there, as whether something is touched.
RESERVE_BYTES = 16 * 1024**2
#: A recording begins only where it may take this beside: else it would be an empty file.
LEAST_BYTES = 64 * 1024
#: A disk that needs longer than this is no longer waited for.
PATIENCE_S = 1.0
#: A recording looks this often whether its time is over.
LOOK_S = 0.5
_ID = 0x1FFFFFFF
_ERROR_OR_ID = _ID | ERROR_FLAG
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


def can_suffix(path: Path) -> str:
    """Return the suffix of a file that is to hold CAN frames, one of `CAN_SUFFIXES`.

    Raises:
        RequestError: it has another one.
    """
    suffix = path.suffix.lower()
    if suffix not in CAN_SUFFIXES:
        known = ", ".join([*CAN_SUFFIXES, MCAP_SUFFIX])
        raise RequestError(f'{path}: suffix "{path.suffix}"; wanted one of {known}')
    return suffix


class CanLog:
    """CAN frames in a format of python-can; the file gets its name when it is closed.

    Args:
        path: the file; its suffix, one of `CAN_SUFFIXES`, gives the format.
        channels: that will be recorded.

    Attributes:
        frames: recorded so far.
        left_out: frames of a kind that the format does not know.
        moved: frames whose time was before that of the frame before, where the format does not know
            that: they have that time. A clock that is set back does so.

    Raises:
        RequestError: an unknown suffix, or a format in which two channels are the same.
        SkinError: the file cannot be made.
    """

    def __init__(self, path: Path, channels: Collection[str] = ()) -> None:
        suffix = can_suffix(path)
        if len({name_in(path, channel) for channel in channels}) < len(channels):
            raise RequestError(
                f"{path}: channels {', '.join(channels)} are the same in this format; "
                f"wanted {MCAP_SUFFIX}"
            )
        self.frames = 0
        self._path = path
        with writing(path):
            self._draft = Draft(path, new=True)
            self._draft.begin()
            if suffix == CANDUMP_SUFFIX:
                self._file: _Candump | _PythonCan = _Candump(self._draft.path)
            else:
                self._file = _PythonCan(self._draft.path, suffix)

    @property
    def left_out(self) -> int:
        return self._file.left_out

    @property
    def moved(self) -> int:
        return self._file.moved

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not self.frames:
            with contextlib.suppress(OSError):
                self._file.close()
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
            self.frames += self._file.put(channel, batch)

    def close(self) -> None:
        """End the recording and give it its name.

        Raises:
            SkinError: the disk is full or gone; what there is of it keeps its interim name.
        """
        with writing(self._path), self._draft.keeping():
            self._file.close()
            self._draft.finish()


class _Candump:
    """A growing log of candump: whole lines, also on a full disk."""

    left_out = moved = 0

    def __init__(self, path: Path) -> None:
        self._log = _Lines(path.open("wb", buffering=0))

    def put(self, channel: str, batch: FrameBatch) -> int:
        self._log.append(candump_lines(channel, batch))
        return len(batch)

    def close(self) -> None:
        self._log.file.close()


class _PythonCan:
    """A growing file of python-can.

    Some formats need frames in the order of their times. Buses are read in turn, so the newest
    frames are held back for these until those of the others have come, or the clock is set back:
    then those held are before what follows, whatever their times.
    """

    def __init__(self, path: Path, suffix: str) -> None:
        self.left_out = self.moved = 0
        logger = DatedAscWriter(path) if suffix == ".asc" else can.Logger(path)
        self._logger = cast(can.io.generic.FileIOMessageWriter[Any], logger)
        self._knows_data_alone = suffix == ".trc"
        self._needs_order = suffix in (".asc", ".blf")
        #: In the order of their times, where the format needs that.
        self._held: list[can.Message] = []
        self._last_s = 0.0
        #: Time of each channel's last frame.
        self._last_of_s: dict[str, float] = {}

    def put(self, channel: str, batch: FrameBatch) -> int:
        messages = [message_at(batch, row, channel) for row in range(len(batch))]
        if self._knows_data_alone:
            data = [one for one in messages if not (one.is_remote_frame or one.is_error_frame)]
            self.left_out += len(messages) - len(data)
            messages = data
        if self._needs_order:
            n = self._hold(channel, messages)
        else:
            self._held += messages
            n = len(messages)
        self._write(n)
        return len(messages)

    def close(self) -> None:
        try:
            self._write(len(self._held))
            self._logger.stop()
        finally:
            # It leaves the file open if the disk is full.
            with contextlib.suppress(OSError):
                self._logger.file.close()

    def _hold(self, channel: str, messages: list[can.Message]) -> int:
        """Hold back a channel's messages; return how many of those held need not wait longer."""
        held = self._held
        for message in messages:
            newest_s = held[-1].timestamp if held else 0.0
            first_s = max(self._last_of_s.get(channel, 0.0), newest_s - HELD_S)
            if message.timestamp < first_s:  # the clock was set back
                self._write(len(held))
            insort(held, message, key=_time_of)
            self._last_of_s[channel] = message.timestamp
        if not held:
            return 0
        known = bisect_right(held, held[-1].timestamp - HELD_S, key=_time_of)
        return known if len(held) - known <= MAX_HELD else len(held)

    def _write(self, n: int) -> None:
        """Write the first `n` of those that are held back."""
        for message in self._held[:n]:
            if self._needs_order and message.timestamp < self._last_s:
                message.timestamp = self._last_s
                self.moved += 1
            self._last_s = message.timestamp
            self._logger.on_message_received(message)
        del self._held[:n]


def _time_of(message: can.Message) -> float:
    return message.timestamp


class _Lines:
    """A file that grows by whole lines.

    Attributes:
        bytes: of the whole lines.
    """

    def __init__(self, file: FileIO) -> None:
        self.file = file
        self.bytes = 0

    def append(self, lines: bytes) -> None:
        """Write lines; none of them if not all.

        Raises:
            OSError: the disk is full or gone.
        """
        rest = memoryview(lines)
        try:
            while rest:
                rest = rest[self.file.write(rest) :]
        except OSError:
            with contextlib.suppress(OSError):
                self.file.truncate(self.bytes)
                self.file.seek(self.bytes)
            raise
        self.bytes += len(lines)


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
            # Once in turn: a bus on which more comes than is read must not hold up the end.
            batches = [(port.channel, port.read()) for port in ports]
            is_behind = any(
                len(batch) >= port.capacity for port, (_, batch) in zip(ports, batches, strict=True)
            )
            # Whoever reads the recording gets its frames in this order.
            for channel, batch in in_slices(batches, WINDOW_NS):
                sink(channel, batch)
            await asyncio.sleep(0.0 if is_behind else POLL_S)
        return sum(port.counters.dropped + port.counters.damaged for port in ports)
    finally:
        for port in ports:
            port.close()


async def capture_broker(
    recorder: Recorder, broker: Broker, base: str, robot: str, stop: asyncio.Event
) -> int:
    """Record a robot's messages until `stop` is set; return how often the broker was lost or not
    there.

    Raises:
        SkinError: the recording cannot be written.
    """
    await until(stop, _listen(recorder, broker, recorded_topics(base, robot)))
    return recorder.gaps


async def _listen(recorder: Recorder, broker: Broker, topics: list[str]) -> None:
    retry = Retry()
    identifier = f"skin-record-{secrets.token_hex(4)}"
    is_out = False
    while True:
        since_s: float | None = None
        try:
            async with connect(
                broker,
                identifier=identifier,
                max_incoming=MAX_INCOMING,
                max_packet=MAX_PACKET_BYTES,
            ) as connection:
                since_s = time.monotonic()
                try:
                    for topic in topics:
                        await connection.subscribe(topic, qos=0 if topic.endswith("/frame") else 1)
                    is_out = False
                    async for message in connection.messages:
                        if isinstance(message.payload, bytes):
                            recorder.say(
                                message.topic.value,
                                time.time_ns(),
                                message.payload,
                                stored=message.retain,
                            )
                finally:
                    recorder.discarded += connection.discarded
        except* SkinError as group:
            raise first_error(group) from None
        except* Exception as group:
            recorder.gaps += not is_out  # however many attempts it takes to listen again
            is_out = True
            _log.warning("broker %s: %s; trying again", broker, explain(first_error(group)))
        leave_if_cancelled()
        await asyncio.sleep(retry.delay_s(0.0 if since_s is None else time.monotonic() - since_s))


def candump_lines(channel: str, batch: FrameBatch) -> bytes:
    """A batch as lines of a candump log (`candump -L`), a line each frame of any kind."""
    lines = []
    name = candump_name(channel)
    for row, (number, dlc, t_ns) in enumerate(
        zip(batch.id.tolist(), batch.dlc.tolist(), batch.t_ns.tolist(), strict=True)
    ):
        seconds, rest = divmod(t_ns, 1_000_000_000)
        is_long = number & (EXTENDED_FLAG | ERROR_FLAG)
        identifier = f"{number & _ERROR_OR_ID:08X}" if is_long else f"{number & _ID:03X}"
        data = batch.data[row, : min(dlc, 8)].tobytes().hex().upper()
        if number & REMOTE_FLAG:
            data = f"R{dlc or ''}"
        lines.append(f"({seconds}.{rest // 1000:06d}) {name} {identifier}#{data}\n")
    return "".join(lines).encode()


def _make_room(folder: Path, names: str) -> None:
    """Make a folder for one more recording.

    Raises:
        StateError: the folder holds as many as it may, or its disk is full but for the reserve.
        OSError: it cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if sum(1 for _ in folder.glob(names)) >= MAX_RECORDINGS:
        raise StateError(f"{folder}: holds {MAX_RECORDINGS} recordings already; move some away")
    if (full := _full(folder, LEAST_BYTES)) is not None:
        raise StateError(f"{folder}: {full}; move recordings away")


def _full(file: Path | int, more: int = 0) -> str | None:
    """Return why a recording must take no more bytes of the disk of a file; None if it may."""
    disk = os.statvfs(file)
    # Some file systems in user space do not know their size.
    if not disk.f_blocks or disk.f_bavail * disk.f_frsize - more >= RESERVE_BYTES:
        return None
    return f"less than {RESERVE_BYTES >> 20} MiB of its disk are left, for what the daemon keeps"


class FrameRecorder:
    """One recording, from now until it is stopped, is long enough, or fails.

    It takes `seconds` at most, by `clock`, and `max_bytes`.

    Attributes:
        frames: in the file.
        ended: why it has ended, None while it continues.

    Raises:
        RequestError: the name is not that of a candump log, or the file exists.
        StateError: the folder is full, or the disk up to what is left to the daemon's own files.
        SkinError: the file cannot be made.
    """

    def __init__(self, path: Path, seconds: float, max_bytes: int, clock: Clock = SYSTEM) -> None:
        if path.suffix != CANDUMP_SUFFIX:
            raise RequestError(f'{path.name}: wanted a name that ends in "{CANDUMP_SUFFIX}"')
        self.path = path
        self.frames = 0
        self.ended: str | None = None
        self._came = 0
        self._max_bytes = max_bytes
        self._clock = clock
        self._until_s = clock.monotonic_s() + seconds
        #: Why no more frames are taken.
        self._over: str | None = None
        self._queue: queue.Queue[tuple[str, FrameBatch] | None] = queue.Queue(WAITING_BATCHES)
        with writing(path):
            _make_room(path.parent, "*")
            try:
                file = path.open("xb", buffering=0)
            except FileExistsError:
                raise RequestError(f"{path}: is there already; wanted another name") from None
            self._log = _Lines(file)
        self._append = self._log.append
        self._thread = clock.thread(self._write, "recorder")

    @property
    def bytes(self) -> int:
        """Size of the file."""
        return self._log.bytes

    @property
    def lost(self) -> int:
        """Frames that came before its time was over and are not in the file: the disk did not take
        them, or they are beyond `max_bytes`. While it continues, they may wait for the disk.
        """
        return self._came - self.frames

    def put(self, channel: str, batch: FrameBatch) -> None:
        """Record a batch; never waits."""
        self._look_at_time()
        if self._over is not None:
            return
        self._came += len(batch)
        if self.ended is not None:
            return
        copy = FrameBatch(batch.id.copy(), batch.dlc.copy(), batch.data.copy(), batch.t_ns.copy())
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait((channel, copy))

    def finish(self) -> None:
        """End the recording, without waiting; frames already put are written first."""
        self._over = self._over or "stopped"
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

    def _look_at_time(self) -> None:
        if self._over is None and self._clock.monotonic_s() >= self._until_s:
            self._over = "the time is over"

    def _write(self) -> None:
        level = logging.INFO
        try:
            with self._log.file:
                self._write_queue()
        except OSError as error:
            level = logging.WARNING
            self.ended = f"cannot write: {error.strerror}"
        finally:
            _log.log(
                level,
                "recording %s ended: %s; %d frames, %d lost",
                self.path,
                self.ended,
                self.frames,
                self.lost,
            )

    def _write_queue(self) -> None:
        """Write what is put until it is over.

        Raises:
            OSError: the disk is gone, or full but for the reserve.
        """
        while self.ended is None:  # given up otherwise
            left_s = max(0.0, self._until_s - self._clock.monotonic_s())
            try:
                item = self._queue.get(timeout=min(left_s, LOOK_S))
            except queue.Empty:
                item = None
            self._look_at_time()
            if item is None:
                if self._over is not None and self._queue.empty():
                    self.ended = self._over
                continue
            lines = candump_lines(*item)
            if self.bytes + len(lines) > self._max_bytes:
                self.ended = f"it reached its {self._max_bytes} bytes"
                return
            refuse_removed(self.path)
            if (full := _full(self._log.file.fileno(), len(lines))) is not None:
                raise OSError(errno.ENOSPC, full)
            self._append(lines)
            self.frames += len(item[1])


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
            RequestError: one is in progress.
            StateError: the folder is full, or its disk but for the reserve.
            SkinError: mcap is not installed, or the file cannot be made.
        """
        if self._recorder is not None:
            raise RequestError(f"{self._path.name} is being recorded already; stop it")
        with writing(self._folder):
            _make_room(self._folder, f"*{MCAP_SUFFIX}")
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
            "lost": recorder.discarded,
        }

    async def _run(self, capture: Awaitable[int]) -> None:
        """Record until stopped, too long or too large, or the disk fails or is full."""
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
                with writing(self._path):
                    if (full := _full(self._folder)) is not None:
                        self._ended = f"{self._path.name} has ended: {full}"
                if self._ended is not None:
                    self._stop.set()
                await asyncio.wait([working], timeout=WATCH_S)
            working.result()
        except SkinError as error:
            self._ended = str(error)
        finally:
            working.cancel()
            try:
                recorder.close()
            except SkinError as error:
                self._ended = str(error)
            self._recorder = self._task = None
            _log.info("recording %s ended", self._path)

    async def close(self) -> None:
        """End a recording in progress; the server stops."""
        with contextlib.suppress(SkinError):
            await self.stop()
