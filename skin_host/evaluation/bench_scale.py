"""`skin bench scale`: a whole body on one computer, in as many processes as it has cores.

As `skin bench daemon`, with the daemons of `skin run --workers`: everything on, one hand touched.
Senders and broker share the computer with them. Every frame is accounted for: what was sent is
what was read and what the kernel reports as dropped; the rest is `uncounted`. `sent_share` below
1 means that the senders had too little CPU time for their own pace.
"""

import asyncio
from multiprocessing.connection import Connection
from typing import Any

from skin_host.daemon.workers import share_out
from skin_host.errors import BrokerError, SkinError
from skin_host.evaluation.body_stream import PAUSE, Body
from skin_host.evaluation.measured_daemon import TOUCHED, running
from skin_host.processes import cores

SIZES = (10_000, 30_000, 100_000)
HZ = 20
#: A sender sends about so many frames a second.
_SENDER_HZ = 120_000
_READY_S = 120.0
#: What was sent before has been read after so long.
_DRAIN_S = 2.0

Row = dict[str, Any]


def run(*, quick: bool = False) -> dict[str, Any]:
    """Measure each size.

    Args:
        quick: 3 s each instead of 15 s, and not the largest.

    Returns:
        `rows`, and `too_large`: the first size whose daemons did not come up, and why, or None.

    Raises:
        BrokerError: mosquitto is not installed.
    """
    workers = cores()
    sizes, seconds = (SIZES[:2], 3.0) if quick else (SIZES, 15.0)
    rows: list[Row] = []
    too_large: Row | None = None
    for taxels in sizes:
        try:
            rows.append(measure(taxels, workers, seconds))
        except BrokerError:
            raise
        except SkinError as error:
            too_large = {"taxels": taxels, "why": str(error)}
            break
    return {
        "transport": "stand-in",
        "broker": "mosquitto",
        "cores": workers,
        "rows": rows,
        "too_large": too_large,
    }


def measure(taxels: int, workers: int, seconds: float) -> Row:
    """Measure one size.

    Raises:
        BrokerError: mosquitto is not installed.
        SkinError: the daemons did not come up: this computer is too slow, or has no time.
    """
    return asyncio.run(_measure(Body.of(taxels, HZ), workers, seconds))


def describe(document: dict[str, Any]) -> str:
    """The rows as a table."""
    lines = [
        f"A body at {HZ} Hz in processes on {document['cores']} cores, senders and broker beside.",
        " taxels  buses  workers  frames/s sent (share)  CPU %   dropped  uncounted  messages lost",
    ]
    lines += [
        f"{row['taxels']:7} {row['buses']:6} {row['workers']:8} {row['sent_per_s']:10} "
        f"({row['sent_share']:.2f}) {row['cpu_percent']:11.0f} {row['dropped']:9} "
        f"{row['uncounted']:10} {row['messages_skipped']:14}"
        for row in document["rows"]
    ]
    lines.append("CPU of all daemons together, in % of a core.")
    if (left := document["too_large"]) is not None:
        lines.append(f"{left['taxels']} taxels: {left['why']}")
    return "\n".join(lines)


async def _measure(body: Body, workers: int, seconds: float) -> Row:
    workers = len(share_out(body.settings(), "main", workers))
    senders = max(1, round(body.frames_per_s / _SENDER_HZ))
    async with running(body, 2, daemons=workers, senders=senders, ready_s=_READY_S) as bench:
        row = await _row(bench.daemons, bench.senders, seconds)
    rate = round(row.pop("sent_in_time") / seconds)
    return {
        "taxels": body.taxels,
        "buses": len(body.ports),
        "workers": workers,
        "sent_per_s": rate,
        "sent_share": round(rate / body.frames_per_s, 3),
        **row,
    }


async def _row(daemons: list[Connection], senders: list[Connection], seconds: float) -> Row:
    sent_before = await _scene(senders, PAUSE)
    await asyncio.sleep(_DRAIN_S)
    read_before, dropped_before = await _counted(daemons)
    await _scene(senders, TOUCHED.index("hand"))
    await asyncio.sleep(1.0)
    begun = await _scene(senders, TOUCHED.index("hand"))
    for daemon in daemons:
        daemon.send("begin")
    await asyncio.sleep(seconds)
    for daemon in daemons:
        daemon.send("end")
    in_time = await _scene(senders, PAUSE) - begun
    figures = [await asyncio.to_thread(daemon.recv) for daemon in daemons]
    await asyncio.sleep(_DRAIN_S)
    # The kernel reports how many it dropped with the next frame that it delivers.
    await _scene(senders, TOUCHED.index("untouched"))
    await asyncio.sleep(0.3)
    sent = await _scene(senders, PAUSE) - sent_before
    await asyncio.sleep(_DRAIN_S)
    read, dropped = await _counted(daemons)
    read, dropped = read - read_before, dropped - dropped_before
    return {
        "cpu_percent": round(sum(one["cpu_percent"] for one in figures), 1),
        "waited_percent": round(sum(one["waited_percent"] for one in figures), 1),
        "sent_in_time": in_time,
        "sent": sent,
        "read": read,
        "dropped": dropped,
        "uncounted": sent - read - dropped,
        "messages_skipped": sum(one["messages_skipped"] for one in figures),
    }


async def _scene(senders: list[Connection], number: int) -> int:
    """Choose a scene; how many frames were sent before."""
    for sender in senders:
        sender.send(number)
    return sum([await asyncio.to_thread(sender.recv) for sender in senders])


async def _counted(daemons: list[Connection]) -> tuple[int, int]:
    """How many frames the daemons have read, and how many the kernel dropped."""
    for daemon in daemons:
        daemon.send("count")
    counts = [await asyncio.to_thread(daemon.recv) for daemon in daemons]
    return sum(read for read, _ in counts), sum(dropped for _, dropped in counts)
