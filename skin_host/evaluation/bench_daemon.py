"""`skin bench daemon`: what the whole daemon costs, from 192 taxels to 10 000.

The daemon runs as a process at its default settings, with health, frames and touches on MQTT; a
process sends the boards' frames over stand-in buses; mosquitto is the broker, with one subscriber
on all frames and one on all touches. For each size and rate the skin is first untouched, then one
hand rests on it, then all of it is touched, each with pressures that change from sweep to sweep.

CPU is the daemon process's own. Where it goes (`by_room`, scaled to it) and what wakes the daemon
is sampled afterwards, for half of that time, because sampling takes a tenth more. On a machine that
others use too CPU grows with their load, so each row has figures from the same seconds to compare
with: `plain`, what a message of another program takes to the same subscriber, and `yardstick_us`,
the CPU time of a fixed piece of work. `waited_percent` is how long the daemon was ready to run and
had no core: where it is large, the latencies and losses of that row are the machine's, not the
daemon's.
"""

import asyncio
import json
import statistics
import time
from itertools import product
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from skin_host.evaluation.body_stream import Body
from skin_host.evaluation.measured_daemon import TOUCHED, running
from skin_host.evaluation.touch_listener import PLAIN_TOPIC, collected, publish_plain

SIZES = (192, 2000, 10_000)
RATES_HZ = (20, 50)
_READY_S = 60.0
#: Contacts begin and are reported in this time after a scene begins; then the measurement starts.
_SETTLE_S = 0.7

Row = dict[str, Any]


def run(*, quick: bool = False) -> dict[str, Any]:
    """Measure every size, rate and scene.

    Args:
        quick: 4 s for each row instead of 8 s, at 20 Hz only.

    Raises:
        BrokerError: mosquitto is not installed.
        SkinError: the daemon did not come up.
    """
    seconds, rates = (4.0, RATES_HZ[:1]) if quick else (8.0, RATES_HZ)
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
    async with running(body, len(TOUCHED), ready_s=_READY_S) as bench:
        (daemon,), (sender,) = bench.daemons, bench.senders
        rows = []
        for name in touched:
            sender.send(TOUCHED.index(name))
            sender.recv()
            await asyncio.sleep(_SETTLE_S)
            row = {"taxels": body.taxels, "hz": hz, "touched": name, "buses": len(body.ports)}
            rows.append(row | await _row(bench.listener, daemon, bench.port, seconds))
        return rows


async def _row(listener: Connection, daemon: Connection, port: int, seconds: float) -> Row:
    await collected(listener)
    yardstick = asyncio.create_task(_yardstick_us(seconds))
    daemon.send("begin")
    await publish_plain(port, seconds)
    daemon.send("end")
    measured: Row = await asyncio.to_thread(daemon.recv)
    delays_ns = await collected(listener)
    daemon.send("sample")
    await asyncio.sleep(0.5 * seconds)
    daemon.send("rooms")
    measured |= await asyncio.to_thread(daemon.recv)
    shares = measured.pop("by_room_share").items()
    cpu_percent = measured["cpu_percent"]
    measured["by_room"] = {room: round(cpu_percent * share, 2) for room, share in shares}
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
