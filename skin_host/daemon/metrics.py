"""Health as Prometheus text, on localhost: `service.metrics_port`.

Off unless configured. Listens on 127.0.0.1 alone; answers requests whose `Host` is an address or
localhost; one request a connection, bounded in size and time. Names follow Prometheus' conventions:
base units, `_total` for counters.
"""

import asyncio
import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from skin_host.acceptor import accept
from skin_host.clock import SYSTEM, Clock
from skin_host.fingertip.health import FingertipRecord
from skin_host.health import Record
from skin_host.tasks import in_tasks
from skin_host.untrusted import names_us

log = logging.getLogger(__name__)

#: Of parts, and of fingertips on force/torque boards, by name.
Records = Mapping[str, Record | FingertipRecord]

MAX_REQUEST_BYTES = 8192
TIMEOUT_S = 2.0
MAX_CONNECTIONS = 8
#: A port that is taken is tried again after this time.
RETRY_S = 10.0

_PART = {
    "frames": ("skin_frames_total", "counter", "Frames of pressure with a valid taxel"),
    "rate_hz": ("skin_frame_rate_hertz", "gauge", "Frames of pressure a second"),
    "taxels": ("skin_taxels", "gauge", "Taxels that feel pressure"),
    "valid_taxels": ("skin_valid_taxels", "gauge", "Taxels that are valid now"),
    "age_ms": ("skin_age_seconds", "gauge", "Time since the last valid frame"),
}
_BUS = {
    "frames": ("skin_bus_frames_total", "counter", "CAN frames read"),
    "sweeps": ("skin_bus_sweeps_total", "counter", "Sweeps assembled"),
    "incomplete": ("skin_bus_incomplete_total", "counter", "Sweeps without an awaited triangle"),
    "halves": ("skin_bus_halves_total", "counter", "Triangles of which only one frame arrived"),
    "missed": ("skin_bus_missed_periods_total", "counter", "Periods without any frame"),
    "dropped": ("skin_bus_dropped_total", "counter", "Frames lost for want of buffer"),
    "error_frames": ("skin_bus_error_frames_total", "counter", "Error frames"),
}
_BOARD = {
    "alive": ("skin_board_alive", "gauge", "Whether the board sends"),
    "period_seen_ms": ("skin_board_period_seconds", "gauge", "Period seen"),
    "configurations": ("skin_board_configurations_total", "counter", "Times it was set up"),
    "resets": ("skin_board_resets_total", "counter", "Times it restarted by itself"),
}
_FINGERTIP = {
    "samples": ("skin_fingertip_samples_total", "counter", "Samples of force and torque"),
    "rate_hz": ("skin_fingertip_rate_hertz", "gauge", "Samples a second"),
    "lone": ("skin_fingertip_lone_total", "counter", "Force without torque, or the reverse"),
    "saturated": ("skin_fingertip_saturated_total", "counter", "Saturated samples"),
    "silences": ("skin_fingertip_silences_total", "counter", "Times its board timed out"),
    "touched": ("skin_fingertip_touched", "gauge", "Whether it is touched"),
}
_OUTPUT = {
    "connected": ("skin_broker_connected", "gauge", "Whether the broker is connected"),
    "frames_sent": ("skin_mqtt_frames_total", "counter", "Frames sent to the broker"),
    "frames_skipped": ("skin_mqtt_frames_skipped_total", "counter", "Frames never sent"),
    "touches_sent": ("skin_mqtt_touches_total", "counter", "Touch events acknowledged"),
    "touches_dropped": ("skin_mqtt_touches_dropped_total", "counter", "Touch events lost"),
}
_NODE = {
    "log_lines_lost": ("skin_log_lines_lost_total", "counter", "Lines of the log lost"),
}


def exposition(records: Records) -> str:
    """All records in Prometheus' text format 0.0.4."""
    samples: dict[tuple[str, str, str], dict[str, float]] = {}

    def put(table: dict[str, tuple[str, str, str]], source: Mapping[str, Any], labels: str) -> None:
        for key, head in table.items():
            value = source.get(key)
            if value is not None:
                unit = 1e-3 if key.endswith("_ms") else 1.0
                # A time stamp may be a little newer than the time of this record.
                samples.setdefault(head, {})[labels] = max(0.0, float(value) * unit)

    every: Mapping[str, Mapping[str, Any]] = records
    for name, record in sorted(every.items()):
        part = _label("part", name)
        put(_FINGERTIP if record.get("kind") == "fingertip" else _PART, record, part)
        faults = ("skin_faults", "gauge", "Faults that are reported now")
        samples.setdefault(faults, {})[part] = float(len(record.get("faults", ())))
        fault = ("skin_fault", "gauge", "1 for each fault that is reported now")
        for one in record.get("faults", ()):
            where = _labels(part=name, code=one["code"], where=one["where"])
            samples.setdefault(fault, {})[where] = 1.0
        for bus in record.get("buses", ()):
            put(
                _BUS,
                bus | bus.get("port", {}) | {"frames": bus["frames"]},
                _label("bus", bus["name"]),
            )
        for board in record.get("boards", ()):
            put(_BOARD, board, _label("board", board["name"]))
        put(_OUTPUT, record.get("output", {}), "")
        put(_NODE, record, "")
    return "".join(_lines(samples))


def _lines(samples: dict[tuple[str, str, str], dict[str, float]]) -> Iterator[str]:
    for (name, kind, about), values in samples.items():
        yield f"# HELP {name} {about}\n# TYPE {name} {kind}\n"
        for labels, value in values.items():
            yield f"{name}{labels} {value:.12g}\n"


def _label(key: str, value: str) -> str:
    return _labels(**{key: value})


def _labels(**values: str) -> str:
    pairs = []
    for key, value in values.items():
        escaped = value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
        pairs.append(f'{key}="{escaped}"')
    return "{" + ",".join(pairs) + "}"


async def serve(port: int, records: Callable[[], Records], clock: Clock = SYSTEM) -> None:
    """Answer `GET /metrics` on 127.0.0.1 until cancelled. Waits for a port that is taken."""
    busy = 0

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal busy
        busy += 1
        try:
            if busy <= MAX_CONNECTIONS:
                async with clock.timeout(TIMEOUT_S):
                    writer.write(_response(await reader.readuntil(b"\r\n\r\n"), records))
                    await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            # An invalid request gets no answer, and who reads none is not waited for.
            writer.transport.abort()
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
            busy -= 1

    begin = in_tasks(answer)

    async def take(connection: socket.socket) -> None:
        begin(*await asyncio.open_connection(sock=connection, limit=MAX_REQUEST_BYTES))

    said = False
    while True:
        try:
            with socket.create_server(("127.0.0.1", port)) as listening:
                await accept(listening, take, f"metrics on 127.0.0.1:{port}", clock)
        except OSError as error:
            if not said:
                said = True
                why = os.strerror(error.errno) if error.errno else str(error)
                log.warning("no metrics: 127.0.0.1:%d: %s; trying again", port, why)
        await clock.sleep(RETRY_S)


def _is_ours(header: bytes) -> bool:
    """Whether a header is not a `Host` with a name that somebody can make point here."""
    key, _, value = header.decode("latin-1").partition(":")
    return key.strip().lower() != "host" or names_us(value.strip(), {"localhost"})


def _response(request: bytes, records: Callable[[], Records]) -> bytes:
    line, *headers = request.split(b"\r\n")
    method, _, rest = line.partition(b" ")
    path = rest.partition(b" ")[0]
    if not all(_is_ours(header) for header in headers):
        # A browser asks for a page from elsewhere, whose name was made to point at this machine.
        return b"HTTP/1.0 403 Forbidden\r\n\r\nask for localhost or 127.0.0.1\n"
    if method != b"GET":
        return b"HTTP/1.0 405 Method Not Allowed\r\nAllow: GET\r\n\r\n"
    if path != b"/metrics":
        return b"HTTP/1.0 404 Not Found\r\n\r\nsee /metrics\n"
    body = exposition(records()).encode()
    head = (
        "HTTP/1.0 200 OK\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body
