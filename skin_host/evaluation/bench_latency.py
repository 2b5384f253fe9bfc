"""`skin bench latency`: from the last CAN frame of a sweep to the touch at a subscriber.

Four processes, as on a robot: a sender that fills a bus with the frames of seven boards, one of
which is pressed and released; the daemon at its default settings; mosquitto; a subscriber. The
delay is the time at which the message was received minus its `t_ns`, the kernel's time stamp of
the frame that completed the sweep. All share one clock.

For comparison, in the same run and at the same load: how long a message of that size takes from
another program to that subscriber, which no daemon can avoid.
"""

import asyncio
import gc
import logging
import multiprocessing
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS, TRIANGLES
from skin_host.config.settings import changed
from skin_host.daemon.daemon import Daemon
from skin_host.errors import BrokerError, SkinError
from skin_host.evaluation.can_stream import FULL_BUS_FRAMES_PER_S, FrameStream, StreamWire, send
from skin_host.evaluation.touch_listener import PLAIN_TOPIC, collected, listen, publish_plain
from skin_host.layout import build_layout
from skin_host.mqtt.broker import find_mosquitto, mosquitto_broker
from skin_host.processes import beside

#: The daemon must have set itself up and calibrated by then; the test machine's processor is slow.
_READY_S = 150.0
_CALIBRATION_S = 1.0
_PRESSED_TRIANGLE, _PRESSED_TAXELS = 7, slice(2, 6)

Document = dict[str, Any]


def run(*, quick: bool = False) -> Document:
    """Measure on a full bus.

    Args:
        quick: for 5 s instead of 30 s.

    Raises:
        BrokerError: mosquitto is not installed.
        SkinError: the daemon did not come up.
    """
    return measure(FULL_BUS_FRAMES_PER_S, 5.0 if quick else 30.0)


def measure(frames_per_s: int, seconds: float) -> Document:
    """Measure; all delays in microseconds.

    Args:
        frames_per_s: on the bus; a slow computer may not bear a full one.
        seconds: for touches, and again for messages of another program.

    Raises:
        BrokerError, SkinError: as `run`.
    """
    program = find_mosquitto()
    if program is None:
        raise BrokerError("mosquitto is not installed; `apt install mosquitto`")
    return asyncio.run(_measure(program, FrameStream.of(frames_per_s), seconds))


def describe(document: Document) -> str:
    """The document as text."""
    plain = document["plain"]
    p50, p99 = (document[key] / plain[key] for key in ("delay_p50_us", "delay_p99_us"))
    return (
        f"From the last CAN frame of a sweep ({document['transport']}, "
        f"{document['frames_per_s']} frames/s) to the touch at a subscriber of mosquitto:\n"
        f"{_line(document)}\n"
        "A message of that length from another program to that subscriber, at the same load:\n"
        f"{_line(plain)}\n"
        f"Frame to touch takes {p50:.1f} times as long at p50, {p99:.1f} times at p99."
    )


def _line(row: Document) -> str:
    return (
        f"  {row['messages']} messages   p50 {row['delay_p50_us'] / 1e3:.2f} ms   "
        f"p99 {row['delay_p99_us'] / 1e3:.2f} ms   max {row['delay_max_us'] / 1e3:.2f} ms"
    )


async def _measure(program: str, stream: FrameStream, seconds: float) -> Document:
    wire = StreamWire.here()
    context = multiprocessing.get_context("spawn")
    async with mosquitto_broker(program) as broker:
        sender_end, sender_child_end = context.Pipe()
        listener_end, listener_child_end = context.Pipe()
        states = tempfile.TemporaryDirectory(prefix="skin-bench-")
        processes = [
            context.Process(target=listen, args=(listener_child_end, broker.port), daemon=True),
            context.Process(
                target=_daemon, args=(wire, stream, broker.port, states.name), daemon=True
            ),
            context.Process(
                target=send,
                args=(sender_child_end, wire, stream, _READY_S + 2 * seconds, _scenes(stream)),
                daemon=True,
            ),
        ]
        with states, beside(processes, listener_child_end, sender_child_end):
            if not await asyncio.to_thread(listener_end.poll, _READY_S):
                raise SkinError(f"the daemon did not calibrate within {_READY_S:g} s")
            listener_end.recv()
            sender_end.send(1)
            await asyncio.sleep(seconds)
            touches_ns = await collected(listener_end)
            await publish_plain(broker.port, seconds)
            plain_ns = (await collected(listener_end))[PLAIN_TOPIC]
    delays_ns = [delay_ns for delays_ns in touches_ns.values() for delay_ns in delays_ns]
    if not delays_ns:
        raise SkinError("no touch was published")
    return {
        "transport": wire.transport,
        "broker": "mosquitto",
        "frames_per_s": stream.frames_per_s,
        **_row(delays_ns),
        "plain": _row(plain_ns),
    }


def _row(delays_ns: list[int]) -> Document:
    delays_us = np.array(delays_ns) / 1e3
    p50, p99 = np.percentile(delays_us, [50, 99])
    return {
        "messages": len(delays_us),
        "delay_p50_us": round(float(p50), 1),
        "delay_p99_us": round(float(p99), 1),
        "delay_max_us": round(float(delays_us.max()), 1),
    }


def _scenes(stream: FrameStream) -> list[NDArray[np.uint8]]:
    """An untouched skin; and one that something presses and leaves, once in 40 periods."""
    shape = (40, stream.boards, TRIANGLES, TAXELS)
    quiet = np.random.default_rng(0).integers(239, 242, shape)
    depth = np.zeros(40)
    depth[:24] = 70.0 * np.sin(np.pi * (np.arange(24) + 0.5) / 24)
    pressed = quiet.copy()
    pressed[:, stream.boards // 2, _PRESSED_TRIANGLE, _PRESSED_TAXELS] -= depth.astype(int)[:, None]
    return [quiet.astype(np.uint8), pressed.astype(np.uint8)]


def _daemon(wire: StreamWire, stream: FrameStream, broker_port: int, state: str) -> None:
    """Process: `skin run`, which keeps its state in a folder of its parent's."""
    logging.disable(logging.WARNING)  # no board of this stream answers commands
    settings = stream.settings(wire.bus())
    settings = changed(
        settings,
        {
            "mqtt.host": "127.0.0.1",
            "mqtt.port": broker_port,
            "processing.calibration.seconds": _CALIBRATION_S,
            "service.state_directory": state,
        },
    )
    daemon = Daemon(settings, build_layout(settings, Path()))
    gc.freeze()  # as `skin run` does
    asyncio.run(daemon.run(asyncio.Event(), calibrate=True))
