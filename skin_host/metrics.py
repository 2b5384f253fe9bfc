"""Health as Prometheus text, on localhost: `service.metrics_port`.

Off unless configured. Listens on 127.0.0.1 alone; one request a connection, bounded in size
and time. Names follow Prometheus' conventions: base units, `_total` for counters.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from skin_host.fingertip.health import FingertipRecord
from skin_host.health import Record

#: Of parts, and of fingertips on force/torque boards, by name.
Records = Mapping[str, Record | FingertipRecord]

MAX_REQUEST_BYTES = 8192
TIMEOUT_S = 2.0
MAX_CONNECTIONS = 8

_PART = {
    "frames": ("skin_frames_total", "counter", "Frames of pressure with a valid taxel"),
    "rate_hz": ("skin_frame_rate_hertz", "gauge", "Frames of pressure a second"),
    "taxels": ("skin_taxels", "gauge", "Taxels that feel pressure"),
    "valid_taxels": ("skin_valid_taxels", "gauge", "Taxels that can be believed now"),
    "age_ms": ("skin_age_milliseconds", "gauge", "Time since the last valid frame"),
}
_BUS = {
    "frames": ("skin_bus_frames_total", "counter", "CAN frames read"),
    "sweeps": ("skin_bus_sweeps_total", "counter", "Sweeps put together"),
    "incomplete": ("skin_bus_incomplete_total", "counter", "Sweeps without an awaited triangle"),
    "halves": ("skin_bus_halves_total", "counter", "Triangles with one half only"),
    "missed": ("skin_bus_missed_periods_total", "counter", "Periods without any frame"),
    "dropped": ("skin_bus_dropped_total", "counter", "Frames lost for want of buffer"),
    "error_frames": ("skin_bus_error_frames_total", "counter", "Error frames"),
}
_BOARD = {
    "alive": ("skin_board_alive", "gauge", "Whether the board sends"),
    "period_seen_ms": ("skin_board_period_milliseconds", "gauge", "Period seen"),
    "configurations": ("skin_board_configurations_total", "counter", "Times it was set up"),
    "resets": ("skin_board_resets_total", "counter", "Times it started anew by itself"),
}
_FINGERTIP = {
    "samples": ("skin_fingertip_samples_total", "counter", "Samples of force and torque"),
    "rate_hz": ("skin_fingertip_rate_hertz", "gauge", "Samples a second"),
    "lone": ("skin_fingertip_lone_total", "counter", "Force without torque, or the other way"),
    "saturated": ("skin_fingertip_saturated_total", "counter", "Saturated samples"),
    "silences": ("skin_fingertip_silences_total", "counter", "Times its board fell silent"),
    "touched": ("skin_fingertip_touched", "gauge", "Whether it is touched"),
}
_OUTPUT = {
    "connected": ("skin_broker_connected", "gauge", "Whether the broker is there"),
    "frames_sent": ("skin_mqtt_frames_total", "counter", "Frames sent to the broker"),
    "frames_skipped": ("skin_mqtt_frames_skipped_total", "counter", "Frames never sent"),
    "touches_sent": ("skin_mqtt_touches_total", "counter", "Touch events acknowledged"),
    "touches_dropped": ("skin_mqtt_touches_dropped_total", "counter", "Touch events lost"),
}


def exposition(records: Records) -> str:
    """All records in Prometheus' text format 0.0.4."""
    samples: dict[tuple[str, str, str], dict[str, float]] = {}

    def put(table: dict[str, tuple[str, str, str]], source: Mapping[str, Any], labels: str) -> None:
        for key, head in table.items():
            value = source.get(key)
            if value is not None:
                samples.setdefault(head, {})[labels] = float(value)

    every: Mapping[str, Mapping[str, Any]] = records
    for name, record in sorted(every.items()):
        part = _label("part", name)
        put(_FINGERTIP if record.get("kind") == "fingertip" else _PART, record, part)
        faults = ("skin_faults", "gauge", "Faults that are told of now")
        samples.setdefault(faults, {})[part] = float(len(record.get("faults", ())))
        for bus in record.get("buses", ()):
            put(
                _BUS,
                bus | bus.get("port", {}) | {"frames": bus["frames"]},
                _label("bus", bus["name"]),
            )
        for board in record.get("boards", ()):
            put(_BOARD, board, _label("board", board["name"]))
        put(_OUTPUT, record.get("output", {}), "")
    return "".join(_lines(samples))


def _lines(samples: dict[tuple[str, str, str], dict[str, float]]) -> Iterator[str]:
    for (name, kind, about), values in samples.items():
        yield f"# HELP {name} {about}\n# TYPE {name} {kind}\n"
        for labels, value in values.items():
            yield f"{name}{labels} {value:.12g}\n"


def _label(key: str, value: str) -> str:
    escaped = value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
    return f'{{{key}="{escaped}"}}'


async def serve(port: int, records: Callable[[], Records]) -> None:
    """Answer `GET /metrics` on 127.0.0.1 until cancelled.

    Raises:
        OSError: the port is taken.
    """
    busy = 0

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal busy
        busy += 1
        try:
            if busy <= MAX_CONNECTIONS:
                async with asyncio.timeout(TIMEOUT_S):
                    writer.write(_response(await reader.readuntil(b"\r\n\r\n"), records))
                    await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # whoever asked badly gets no answer
        finally:
            busy -= 1
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    server = await asyncio.start_server(answer, "127.0.0.1", port, limit=MAX_REQUEST_BYTES)
    async with server:
        await server.serve_forever()


def _response(request: bytes, records: Callable[[], Records]) -> bytes:
    method, _, rest = request.partition(b" ")
    path = rest.partition(b" ")[0]
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
