"""`skin bench receive`: the cost of reading a bus, by python-can's methods and by ours.

Three programs read the same stream and do the same job, each in a separate process: they return a
sweep of every board, as an array of 16 triangles of 12 taxels, when its last frame has arrived.

- notifier_async: python-can's Notifier on the event loop with an AsyncBufferedReader;
- notifier_callback: the Notifier on the event loop with a callback;
- batch: this project's port, assembler and plan of wake-ups, as the daemon runs them.

For comparison, the part that no program can avoid is measured: sleep, and let the kernel copy the
frames. At the end the whole pipeline from frames to touches runs at the highest rate, to count
losses.
"""

import asyncio
import multiprocessing
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import can
import numpy as np

from skin_host.bus.assembler import Assembler, Sweep
from skin_host.bus.opening import open_bus, open_port
from skin_host.bus.wake import WakeUp
from skin_host.bus.wire import (
    HEADER_A,
    HEADER_B,
    TAXELS,
    TRIANGLES,
    VALUES_A,
    FrameBatch,
    MessageClass,
)
from skin_host.config.settings import Settings
from skin_host.evaluation.can_stream import BUS, FrameStream, StreamWire, send
from skin_host.layout import build_layout
from skin_host.processes import beside
from skin_host.processing.core import Engine

PATHS = ("notifier_async", "notifier_callback", "batch")
#: Frames a second; 0 is as fast as the sender can.
RATES = (2000, 8000, 32000, 0)
#: Warm-up time of each path before the measurement; the whole pipeline takes a calibration first.
_WARM_UP_S = dict.fromkeys(PATHS, 0.5) | {"kernel": 0.5, "pipeline": 3.0}
_CALIBRATION_S = 1.0
#: Frames that have not come within this time after the last are lost.
_DRAIN_S = 0.5

Row = dict[str, Any]


def run(*, quick: bool = False) -> dict[str, Any]:
    """Measure every path at every rate, one after the other.

    Args:
        quick: 1 s for each instead of 5 s, and 5 s instead of 60 s for the whole pipeline.
    """
    wire = StreamWire.here()
    seconds, long_s = (1.0, 5.0) if quick else (5.0, 60.0)
    rows = [measure(wire, path, rate, seconds) for rate in RATES for path in PATHS]
    kernel = [measure(wire, "kernel", rate, seconds) for rate in RATES if rate]
    whole = measure(wire, "pipeline", max(RATES), long_s) | {"seconds": long_s}
    return {"transport": wire.transport, "rows": rows, "kernel": kernel, "pipeline": whole}


def describe(document: dict[str, Any]) -> str:
    """The rows as text, with each path's share of the CPU of notifier_async."""
    lines = [
        f"Reading skin frames over {document['transport']}; CPU of one core, the share of the",
        "first path's CPU per frame, and the delay from a sweep's last frame to the sweep:",
        " frames/s received  path                CPU %  ns/frame   share    lost   p50 us   p99 us",
    ]
    reference_ns = {}
    for row in document["rows"]:
        if row["path"] == PATHS[0]:
            reference_ns[row["frames_per_s"]] = row["ns_per_frame"]
        lines.append(_line(row, reference_ns[row["frames_per_s"]]))
    lines.append("The kernel's part of it alone, asleep between two reads, nothing decoded:")
    lines += [_line(row, reference_ns[row["frames_per_s"]]) for row in document["kernel"]]
    whole = document["pipeline"]
    lines += [f"The whole way from frames to touches, {whole['seconds']:g} s:", _line(whole, 0)]
    return "\n".join(lines)


def _line(row: Row, reference_ns: float) -> str:
    share = reference_ns / row["ns_per_frame"] if row["ns_per_frame"] else 0.0
    return (
        f"{row['frames_per_s'] or 'saturated':>9}{row['received_per_s']:9}"
        f"  {row['path']:18}{row['cpu_percent']:7.1f}"
        f"{row['ns_per_frame']:10.0f}{'1/' + format(share, '.1f') if share else '':>8}"
        f"{row['lost']:8d}{row['delay_p50_us']:9.0f}{row['delay_p99_us']:9.0f}"
    )


def measure(wire: StreamWire, path: str, frames_per_s: int, seconds: float) -> Row:
    """Run one path on its own stream: one of `PATHS`, "kernel" or "pipeline".

    Args:
        wire: where the stream runs.
        path: what reads it.
        frames_per_s: pace of the sender, 0 for as fast as it can.
        seconds: of the measurement, after warming up.
    """
    stream = FrameStream.of(frames_per_s)
    # Four periods of an untouched skin's noise, because the result does not depend on touches.
    shape = (4, stream.boards, TRIANGLES, TAXELS)
    quiet = np.random.default_rng(0).integers(239, 242, shape).astype(np.uint8)
    context = multiprocessing.get_context("spawn")
    reader_end, reader_child_end = context.Pipe()
    sender_end, sender_child_end = context.Pipe()
    warm_up_s = _WARM_UP_S[path]
    reader = context.Process(target=_read, args=(reader_child_end, wire, path, stream), daemon=True)
    sender = context.Process(
        target=send,
        args=(sender_child_end, wire, stream, warm_up_s + seconds + 0.5, [quiet]),
        daemon=True,
    )
    with beside([reader], reader_child_end):
        reader_end.recv()
        with beside([sender], sender_child_end):
            sender_end.recv()
            time.sleep(warm_up_s)
            reader_end.send("begin")
            time.sleep(seconds)
            reader_end.send("end")
            reader_end.send(sender_end.recv())
            measured: Row = reader_end.recv()
    return {"path": path, "frames_per_s": frames_per_s} | measured


@dataclass(slots=True)
class _Meter:
    """Results of a path: frames taken, and the delay of each sweep in ns."""

    frames: int = 0
    delays_ns: list[int] = field(default_factory=list)
    began: tuple[float, float, int] = (0.0, 0.0, 0)
    result: Row = field(default_factory=dict)

    def begin(self) -> None:
        self.delays_ns.clear()
        self.began = (time.monotonic(), time.process_time(), self.frames)

    def end(self) -> None:
        began_s, cpu_began_s, frames_began = self.began
        seconds = time.monotonic() - began_s
        cpu_s = time.process_time() - cpu_began_s
        frames = self.frames - frames_began
        delays_us = np.array(self.delays_ns or [0]) / 1e3
        self.result = {
            "cpu_percent": round(100 * cpu_s / seconds, 3),
            "ns_per_frame": round(1e9 * cpu_s / frames) if frames else 0,
            "received_per_s": round(frames / seconds),
            "lost": 0,
            "delay_p50_us": round(float(np.percentile(delays_us, 50)), 1),
            "delay_p99_us": round(float(np.percentile(delays_us, 99)), 1),
        }


def _read(parent: Connection, wire: StreamWire, path: str, stream: FrameStream) -> None:
    """Process: read by one path, on the parent's commands."""
    asyncio.run(_PATHS[path](parent, wire, stream))


async def _obey(parent: Connection, meter: _Meter) -> None:
    """Measure between the parent's commands; then wait for the last frames, and answer."""
    parent.send("ready")
    orders: asyncio.Queue[Any] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    loop.add_reader(parent.fileno(), lambda: orders.put_nowait(parent.recv()))
    await orders.get()
    meter.begin()
    await orders.get()
    meter.end()
    sent = await orders.get()
    loop.remove_reader(parent.fileno())
    seen = -1
    while seen < meter.frames < sent:
        seen = meter.frames
        await asyncio.sleep(_DRAIN_S)
    parent.send(meter.result | {"lost": sent - meter.frames})


class _PerFrameDecoder:
    """The same sweeps as the assembler's, in the usual way of one message at a time."""

    _ALL = (1 << 2 * TRIANGLES) - 1

    def __init__(self, meter: _Meter) -> None:
        self._meter = meter
        self._raw = np.zeros((16, TRIANGLES, TAXELS), np.uint8)
        self._got = [0] * 16
        self.sweep: Any = None

    def take(self, message: can.Message) -> None:
        self._meter.frames += 1
        identifier, data = message.arbitration_id, message.data
        if identifier >> 8 != MessageClass.SKIN_STREAM or len(data) < 8:
            return
        board, triangle = identifier >> 4 & 0xF, identifier & 0xF
        if data[0] == HEADER_A:
            self._raw[board, triangle, :VALUES_A] = data[1:]
            bit = 1 << 2 * triangle
        elif data[0] == HEADER_B:
            self._raw[board, triangle, VALUES_A:] = data[1:6]
            bit = 2 << 2 * triangle
        else:
            return
        self._got[board] |= bit
        if self._got[board] == self._ALL:
            self._got[board] = 0
            self.sweep = self._raw[board].copy()
            self._meter.delays_ns.append(time.time_ns() - round(message.timestamp * 1e9))


async def _notifier_async(parent: Connection, wire: StreamWire, stream: FrameStream) -> None:
    meter = _Meter()
    decoder = _PerFrameDecoder(meter)
    bus = open_bus(BUS, wire.bus())
    reader = can.AsyncBufferedReader()
    notifier = can.Notifier(bus, [reader], loop=asyncio.get_running_loop())

    async def consume() -> None:
        async for message in reader:
            decoder.take(message)

    consuming = asyncio.create_task(consume())
    await _obey(parent, meter)
    consuming.cancel()
    notifier.stop()
    bus.shutdown()


async def _notifier_callback(parent: Connection, wire: StreamWire, stream: FrameStream) -> None:
    meter = _Meter()
    bus = open_bus(BUS, wire.bus())
    notifier = can.Notifier(bus, [_PerFrameDecoder(meter).take], loop=asyncio.get_running_loop())
    await _obey(parent, meter)
    notifier.stop()
    bus.shutdown()


async def _batch(parent: Connection, wire: StreamWire, stream: FrameStream) -> None:
    meter = _Meter()
    settings = stream.settings(wire.bus())
    boards = list(enumerate(build_layout(settings, Path()).boards))
    assembler = Assembler(boards, settings.receive.close_periods)
    await _read_batches(parent, settings, meter, lambda batch: assembler.feed(batch).sweeps)


async def _kernel(parent: Connection, wire: StreamWire, stream: FrameStream) -> None:
    meter = _Meter()
    settings = stream.settings(wire.bus())
    port = open_port(BUS, settings.buses[BUS], settings.receive)
    ended = threading.Event()

    def read() -> None:
        while not ended.is_set():
            time.sleep(settings.receive.poll_ms * 1e-3)
            meter.frames += len(port.read())

    # In a thread, so that there is no event loop between the sleep and the read.
    reading = threading.Thread(target=read)
    reading.start()
    await _obey(parent, meter)
    ended.set()
    reading.join()
    port.close()


async def _pipeline(parent: Connection, wire: StreamWire, stream: FrameStream) -> None:
    settings = stream.settings(wire.bus())
    layout = build_layout(settings, Path())
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    engine.begin_calibration(_CALIBRATION_S)

    def feed(batch: FrameBatch) -> list[Sweep]:
        sweeps = engine.feed(BUS, batch).sweeps
        if engine.calibrating and engine.calibration_progress() >= 1.0:
            engine.use(engine.end_calibration(""))
        return sweeps

    await _read_batches(parent, settings, _Meter(), feed)
    if engine.pipeline is None:
        raise RuntimeError("the calibration did not end in time")


async def _read_batches(
    parent: Connection,
    settings: Settings,
    meter: _Meter,
    feed: Callable[[FrameBatch], list[Sweep]],
) -> None:
    port = open_port(BUS, settings.buses[BUS], settings.receive)
    wake_up = WakeUp(
        settings.receive,
        {i: board.period_ms * 1_000_000 for i, board in enumerate(settings.boards.values())},
    )

    def work() -> None:
        batch = port.read()
        meter.frames += len(batch)
        sweeps = feed(batch)
        now_ns = time.time_ns()
        for sweep in sweeps:
            wake_up.sweep_ended(sweep.board, sweep.t_ns)
            meter.delays_ns.append(now_ns - sweep.t_ns)

    reading = asyncio.create_task(wake_up.run(work))
    await _obey(parent, meter)
    reading.cancel()
    await asyncio.gather(reading, return_exceptions=True)
    port.close()


_PATHS: dict[str, Callable[[Connection, StreamWire, FrameStream], Any]] = {
    "notifier_async": _notifier_async,
    "notifier_callback": _notifier_callback,
    "batch": _batch,
    "kernel": _kernel,
    "pipeline": _pipeline,
}
