"""`skin bench daemon`: what the whole daemon costs, from 192 taxels to 10 000.

The daemon runs as a process at its default settings, with health, frames and touches on MQTT; a
process sends the boards' frames over stand-in buses; mosquitto is the broker, with one subscriber
on all frames and one on all touches. For each size and rate the skin is first untouched, then one
hand rests on it, then all of it is touched, each with pressures that change from sweep to sweep.

CPU is the daemon process's own. On a machine that others use too it grows with their load, so
each row has figures from the same seconds to compare with: `plain`, what a message of another
program takes to the same subscriber, and `yardstick_us`, the CPU time of a fixed piece of work.
`waited_percent` is how long the daemon was ready to run and had no core: where it is large, the
latencies and losses of that row are the machine's, not the daemon's.
"""

import asyncio
import gc
import json
import logging
import multiprocessing
import resource
import statistics
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import product
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS, TRIANGLES
from skin_host.config.settings import changed
from skin_host.daemon.daemon import Daemon
from skin_host.daemon.workers import share_name, share_of
from skin_host.errors import BrokerError, SkinError
from skin_host.evaluation.body_stream import Body, send_body
from skin_host.evaluation.rooms import RoomClock
from skin_host.evaluation.stand_in import register
from skin_host.evaluation.touch_listener import PLAIN_TOPIC, collected, listen, publish_plain
from skin_host.evaluation.wakeups import Wakeups
from skin_host.layout import build_layout
from skin_host.mqtt.broker import find_mosquitto, mosquitto_broker

SIZES = (192, 2000, 10_000)
RATES_HZ = (20, 50)
TOUCHED = ("untouched", "hand", "all")
#: A hand of an iCub has about so many triangles.
HAND_TRIANGLES = 9
_READY_S = 60.0
_CALIBRATION_S = 1.0
#: Contacts begin and are reported in this time after a scene begins; then the measurement starts.
_SETTLE_S = 0.7
_PERIODS = 20

Row = dict[str, Any]


def run(*, quick: bool = False) -> dict[str, Any]:
    """Measure every size, rate and scene.

    Args:
        quick: 2 s for each row instead of 8 s, at 20 Hz only.

    Raises:
        BrokerError: mosquitto is not installed.
        SkinError: the daemon did not come up.
    """
    seconds, rates = (2.0, RATES_HZ[:1]) if quick else (8.0, RATES_HZ)
    rows: list[Row] = []
    for taxels, hz in product(SIZES, rates):
        rows += measure(taxels, hz, seconds)
    return {"transport": "stand-in", "broker": "mosquitto", "rows": rows}


def measure(taxels: int, hz: int, seconds: float, touched: tuple[str, ...] = TOUCHED) -> list[Row]:
    """Measure one size at one rate: a row for each scene.

    Args:
        taxels: at least so many.
        hz: sweeps a second of each board.
        seconds: for each row.
        touched: of `TOUCHED`.

    Raises:
        BrokerError, SkinError: as `run`.
    """
    return asyncio.run(_measure(Body.of(taxels, hz), hz, seconds, touched))


def describe(document: dict[str, Any]) -> str:
    """Return the rows as a table, and under each the rooms with the highest cost."""
    lines = [
        f"The whole daemon over {document['transport']} buses, {document['broker']} beside it.",
        "CPU of one core; latency from the last frame of a sweep to the touch at a subscriber;",
        "plain: a message of another program to that subscriber in the same seconds; yardstick:",
        "CPU time in us of a fixed piece of work in the same seconds.",
        (
            " taxels  Hz touched      CPU %  waited wake-ups/s"
            "  p50 ms  p99 ms plain p50     p99 yardstick"
        ),
    ]
    for row in document["rows"]:
        lines.append(
            f"{row['taxels']:7} {row['hz']:3} {row['touched']:10}{row['cpu_percent']:8.1f}"
            f"{row['waited_percent']:8.1f}{row['wakeups_hz']:11.0f}{_ms(row['latency_p50_ms'])}{_ms(row['latency_p99_ms'])}"
            f"{_ms(row['plain_p50_ms']):>10}{_ms(row['plain_p99_ms']):>8}"
            f"{row['yardstick_us']:10.0f}"
        )
        rooms = (f"{room} {share:.1f}" for room, share in row["by_room"].items() if share >= 0.1)
        lines.append("        " + ", ".join(rooms))
        lost = row["frames_dropped"] + row["messages_skipped"]
        if lost:
            lines.append(
                f"        {row['frames_dropped']} CAN frames and {row['messages_skipped']} "
                "frame messages were lost: too slow here"
            )
    return "\n".join(lines)


def _ms(value: float | None) -> str:
    return "      -" if value is None else f"{value:8.2f}"


async def _measure(body: Body, hz: int, seconds: float, touched: tuple[str, ...]) -> list[Row]:
    context = multiprocessing.get_context("spawn")
    async with broker_with_subscriber() as port:
        ends = [context.Pipe() for _ in range(3)]
        (listener, listener_child), (daemon, daemon_child), (sender, sender_child) = ends
        processes = [
            context.Process(target=listen, args=(listener_child, port), daemon=True),
            context.Process(target=run_daemon, args=(daemon_child, body, port), daemon=True),
            context.Process(target=send_body, args=(sender_child, body, scenes(body)), daemon=True),
        ]
        try:
            for process in processes:
                process.start()
            if not await asyncio.to_thread(listener.poll, _READY_S):
                raise SkinError(f"the daemon did not calibrate within {_READY_S:g} s")
            listener.recv()
            sender.recv()
            rows = []
            for name in touched:
                sender.send(TOUCHED.index(name))
                sender.recv()
                await asyncio.sleep(_SETTLE_S)
                row = {"taxels": body.taxels, "hz": hz, "touched": name, "buses": len(body.ports)}
                rows.append(row | await _row(listener, daemon, port, seconds))
            return rows
        finally:
            for process in processes:
                process.terminate()
                process.join()


async def _row(listener: Connection, daemon: Connection, port: int, seconds: float) -> Row:
    await collected(listener)
    yardstick = asyncio.create_task(_yardstick_us(seconds))
    daemon.send("begin")
    await publish_plain(port, seconds)
    daemon.send("end")
    measured: Row = await asyncio.to_thread(daemon.recv)
    delays_ns = await collected(listener)
    plain_ms = _percentiles_ms(delays_ns.pop(PLAIN_TOPIC, []))
    touch_ms = _percentiles_ms([delay_ns for part in delays_ns.values() for delay_ns in part])
    return measured | {
        "latency_p50_ms": touch_ms[0],
        "latency_p99_ms": touch_ms[1],
        "plain_p50_ms": plain_ms[0],
        "plain_p99_ms": plain_ms[1],
        "yardstick_us": await yardstick,
    }


def _percentiles_ms(delays_ns: list[int]) -> tuple[float | None, float | None]:
    """p50 and p99; None where there was no message."""
    if not delays_ns:
        return None, None
    p50, p99 = np.percentile(np.array(delays_ns) * 1e-6, [50, 99])
    return round(float(p50), 2), round(float(p99), 2)


async def _yardstick_us(seconds: float) -> float:
    """Median CPU time of a fixed piece of work, done ten times a second: Python and NumPy."""
    times_us = []
    values = np.arange(2000.0)
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        began_ns = time.thread_time_ns()
        json.dumps(np.rint(values * 1.5).astype(np.int32).tolist())
        times_us.append((time.thread_time_ns() - began_ns) * 1e-3)
        await asyncio.sleep(0.1)
    return round(statistics.median(times_us), 1)


def scenes(body: Body) -> list[NDArray[np.uint8]]:
    """Untouched; a hand that rests on the first board; everything touched."""
    shape = (_PERIODS, body.boards, TRIANGLES, TAXELS)
    quiet = np.random.default_rng(0).integers(239, 242, shape)
    depth = 50.0 + 20.0 * np.sin(2 * np.pi * np.arange(_PERIODS) / _PERIODS)
    pressed = depth.astype(int)[:, None, None]
    hand, everything = quiet.copy(), quiet.copy()
    hand[:, 0, : min(HAND_TRIANGLES, body.triangles)] -= pressed
    everything -= pressed[..., None]
    return [scene.astype(np.uint8) for scene in (quiet, hand, everything)]


def run_daemon(
    parent: Connection, body: Body, broker_port: int, number: int = 1, shares: int = 1
) -> None:
    """Process: `skin run`, measured on the parent's commands.

    Args:
        parent: sends `begin`, `end` (answered with figures of the time between) and `count`
            (answered with CAN frames read and dropped since the start).
        body: whose frames it reads.
        broker_port: of the broker on this machine.
        number, shares: this is one of several workers, from 1.
    """
    register()
    logging.disable(logging.WARNING)  # no board of this stream answers commands
    with tempfile.TemporaryDirectory(prefix="skin-bench-") as state:
        settings = changed(
            body.settings(),
            {
                "mqtt.host": "127.0.0.1",
                "mqtt.port": broker_port,
                "processing.calibration.seconds": _CALIBRATION_S,
                "service.state_directory": state,
            },
        )
        node = "main"
        if shares > 1:
            settings, node = share_of(settings, node, number, shares), share_name(node, number)
        daemon = Daemon(settings, build_layout(settings, Path()), node)
        gc.freeze()  # as `skin run` does
        wakeups = Wakeups()
        with wakeups.runner() as runner:
            runner.run(_obey(parent, daemon, wakeups))


async def _obey(parent: Connection, daemon: Daemon, wakeups: Wakeups) -> None:
    rooms = RoomClock()
    began: list[tuple[float, ...]] = []

    def now() -> tuple[float, ...]:
        sleeps = resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw
        dropped = sum(port.counters.dropped for port in daemon.link.ports.values())
        counters = daemon.publisher.counters
        skipped = counters.frames_skipped
        return time.monotonic(), time.process_time(), _waited_s(), sleeps, dropped, skipped

    def order() -> None:
        wanted = parent.recv()
        if wanted == "count":
            counters = [port.counters for port in daemon.link.ports.values()]
            parent.send((sum(one.frames for one in counters), sum(one.dropped for one in counters)))
            return
        if wanted == "begin":
            began[:] = [now()]
            wakeups.counts.clear()
            rooms.begin()
            return
        shares = rooms.end()
        wall_s, cpu_s, waited_s, sleeps, dropped, skipped = (
            end - begin for end, begin in zip(now(), began[0], strict=True)
        )
        causes = {cause: round(n / wall_s, 1) for cause, n in wakeups.counts.most_common()}
        percent = 100 * cpu_s / wall_s
        parent.send(
            {
                "cpu_percent": round(percent, 2),
                "by_room": {room: round(share * percent, 2) for room, share in shares.items()},
                "waited_percent": round(100 * waited_s / wall_s, 2),
                "wakeups_hz": round(sleeps / wall_s),
                "wakeups_by_cause_hz": causes,
                "us_per_wakeup": round(1e6 * cpu_s / max(sleeps, 1)),
                "frames_dropped": dropped,
                "messages_skipped": skipped,
            }
        )

    asyncio.get_running_loop().add_reader(parent.fileno(), order)
    await daemon.run(asyncio.Event(), calibrate=True)


def _waited_s() -> float:
    """How long this thread was ready to run without a core."""
    return int(Path("/proc/self/schedstat").read_text().split()[1]) * 1e-9


@asynccontextmanager
async def broker_with_subscriber() -> AsyncIterator[int]:
    """Mosquitto with one subscriber on all frames; the port."""
    program = find_mosquitto()
    if program is None:
        raise BrokerError("mosquitto is not installed; `apt install mosquitto`")
    async with mosquitto_broker(program) as broker:
        command = ["mosquitto_sub", "-p", str(broker.port), "-t", "skin/bench/+/frame"]
        try:
            subscriber = await asyncio.create_subprocess_exec(
                *command, stdout=asyncio.subprocess.DEVNULL
            )
        except FileNotFoundError:
            raise BrokerError(
                "mosquitto_sub is not installed; `apt install mosquitto-clients`"
            ) from None
        try:
            yield broker.port
        finally:
            subscriber.terminate()
            await subscriber.wait()
