"""What messages cost: frames of many sizes to a real broker, beside an empty publish.

`skin bench publish` needs mosquitto on the PATH. CPU seconds are of this process and of the
broker's; the reference in the same run is a message of one byte. The last rows show what a frame
message that is encoded already costs in a turn of the loop that publishes anyway, by three ways:
`aiomqtt`, its `publish`; `paho`, `Connection.send`, by which everything that is acknowledged goes;
`bytes`, `Connection.write_now`, by which frames go.
"""

import asyncio
import contextlib
import resource
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.config.settings import Mqtt
from skin_host.errors import RequestError
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Connection, PackedProperties, connect, message_properties
from skin_host.mqtt.frames import encode_frame
from skin_host.mqtt.packets import publish_head, publish_packet
from skin_host.mqtt.payload import JSON_TYPE
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.frame import PressureFrame

TAXELS = (192, 816, 2000)
RATE_HZ = 50.0
WAYS = ("aiomqtt", "paho", "bytes")
#: Messages in a turn: what the second costs above the first is that of messages.
_TURNS_OF = (1, 33)
_PAYLOAD_BYTES = 813
_TOPIC = "skin/bench/part/frame"


def run(*, quick: bool = False) -> dict[str, Any]:
    """Measure and return the rows."""
    seconds = 2.0 if quick else 8.0
    with _broker() as (port, pid):
        rows = []
        for taxels, subscribers in (*((n, 0) for n in (1, *TAXELS)), (816, 1), (816, 8)):
            with _subscribers(port, subscribers):
                row = asyncio.run(_row(port, pid, taxels, seconds))
            rows.append(row | {"subscribers": subscribers})
        in_turn = asyncio.run(_in_turn(port, 100 if quick else 400))
    reference = rows[0]["host_us"]
    for row in rows:
        row["times_one_byte"] = round(row["host_us"] / max(reference, 1e-9), 2)
    return {"rate_hz": RATE_HZ, "rows": rows, "in_turn": in_turn}


def describe(document: dict[str, Any]) -> str:
    """The rows as a table."""
    head = f"{'taxels':>7} {'bytes':>7} {'subscribers':>12} {'host us':>9} {'broker us':>10}"
    lines = [
        f"frames at {document['rate_hz']:g} Hz to mosquitto on this machine",
        f"{head} {'ratio':>6}",
    ]
    lines += [
        f"{row['taxels']:>7} {row['bytes']:>7} {row['subscribers']:>12} {row['host_us']:>9.0f} "
        f"{row['broker_us']:>10.0f} {row['times_one_byte']:>6.2f}"
        for row in document["rows"]
    ]
    lines.append("us: CPU time a message; ratio: host's against a frame of one taxel")
    lines.append(f"one more message of {_PAYLOAD_BYTES} bytes in a turn that publishes anyway:")
    lines += [f"  {row['way']:8} {row['message_us']:7.1f} us" for row in document["in_turn"]]
    return "\n".join(lines)


async def _row(port: int, pid: int, taxels: int, seconds: float) -> dict[str, Any]:
    rng = np.random.default_rng(1)
    pressure = np.where(rng.random(taxels) < 0.5, 0.0, rng.uniform(0, 60, taxels))
    mask = np.ones(taxels, np.bool_)
    raw = np.zeros(taxels, np.uint8)
    settings = Mqtt(host="127.0.0.1", port=port, commands=False)
    async with Publisher(settings, "bench") as publisher:
        while not publisher.counters.connected:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.3)
        size = 0
        before = publisher.counters.frames_sent
        own_s, broker_s = _cpu_s(), _cpu_of_s(pid)
        began_s = time.monotonic()
        for seq in range(int(seconds * RATE_HZ)):
            frame = PressureFrame(
                "part", seq, time.time_ns(), raw, pressure.astype(np.float32), ~mask, mask, ~mask
            )
            size = size or len(encode_frame(frame, "json"))
            publisher.put_frame(frame)
            await asyncio.sleep(max(0.0, began_s + (seq + 1) / RATE_HZ - time.monotonic()))
        sent = publisher.counters.frames_sent - before
        own_s, broker_s = _cpu_s() - own_s, _cpu_of_s(pid) - broker_s
    return {
        "taxels": taxels,
        "bytes": size,
        "sent": sent,
        "host_us": round(own_s / max(sent, 1) * 1e6, 1),
        "broker_us": round(broker_s / max(sent, 1) * 1e6, 1),
    }


async def _in_turn(port: int, turns: int) -> list[dict[str, Any]]:
    """CPU time of one more message in a turn, by each way; the ways take turns, too."""
    broker = Broker("127.0.0.1", port)
    properties = PackedProperties.of(message_properties(broker, JSON_TYPE))
    assert properties is not None
    head = publish_head(_TOPIC, properties.pack())
    payload = b"1" * _PAYLOAD_BYTES
    took_s: dict[tuple[str, int], list[float]] = {(w, n): [] for w in WAYS for n in _TURNS_OF}
    async with connect(broker, identifier="bench") as connection:
        for _ in range(turns):
            for (way, n), times_s in took_s.items():
                await asyncio.sleep(0.002)
                began_s = time.thread_time()
                await _publish(connection, way, n, head, payload, properties)
                times_s.append(time.thread_time() - began_s)
    few, many = _TURNS_OF
    medians_us = {key: float(np.median(times_s)) * 1e6 for key, times_s in took_s.items()}
    return [
        {
            "way": way,
            "turn_us": round(medians_us[way, few], 1),
            "message_us": round((medians_us[way, many] - medians_us[way, few]) / (many - few), 1),
        }
        for way in WAYS
    ]


async def _publish(
    connection: Connection,
    way: str,
    n: int,
    head: bytes,
    payload: bytes,
    properties: PackedProperties,
) -> None:
    """Publish `n` messages in one turn of the loop."""
    if way == "bytes":
        connection.write_now([publish_packet(head, payload) for _ in range(n)])
    elif way == "paho":
        written = [connection.send(_TOPIC, payload, properties=properties) for _ in range(n)]
        await asyncio.wait(written)
    else:
        for _ in range(n):
            await connection.publish(_TOPIC, payload, properties=properties)


@contextlib.contextmanager
def _subscribers(port: int, n: int) -> Iterator[None]:
    command = ["mosquitto_sub", "-p", str(port), "-t", "skin/bench/+/frame"]
    listeners = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(n)]
    try:
        yield
    finally:
        for listener in listeners:
            listener.terminate()
            listener.wait()


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def _cpu_of_s(pid: int) -> float:
    """CPU time of another process: schedstat counts nanoseconds, stat only ticks."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) * 1e-9


@contextlib.contextmanager
def _broker() -> Iterator[tuple[int, int]]:
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
    if program is None:
        raise RequestError("bench publish: no mosquitto on the PATH; install it")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        configuration = Path(folder) / "mosquitto.conf"
        configuration.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
        process = subprocess.Popen(
            [program, "-c", configuration], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            time.sleep(0.5)
            yield port, process.pid
        finally:
            process.terminate()
            process.wait()
