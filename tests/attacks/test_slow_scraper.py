"""Who asks for metrics and reads no answer holds nothing up, and leaves nothing behind."""

import asyncio
import socket

from skin_host.clock import SYSTEM
from skin_host.daemon import metrics
from skin_host.daemon.metrics import MAX_CONNECTIONS
from tests.support.broker import free_port
from tests.support.waiting import PATIENCE_S, until

REQUEST = b"GET /metrics HTTP/1.0\r\n\r\n"


async def test_a_scraper_that_does_not_read_is_left(monkeypatch) -> None:
    # More than the buffers of both sockets take.
    monkeypatch.setattr(metrics, "exposition", lambda _: "x" * 50_000_000)
    monkeypatch.setattr(metrics, "TIMEOUT_S", 0.5)
    port = free_port()
    serving = asyncio.create_task(metrics.serve(port, dict, SYSTEM))
    stalled = []

    async def listens() -> bool:
        try:
            _, writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            return False
        writer.close()
        return True

    async with asyncio.timeout(PATIENCE_S):
        while not await listens():  # noqa: ASYNC110
            await asyncio.sleep(0.02)
    before = len(asyncio.all_tasks())
    for _ in range(MAX_CONNECTIONS):
        stalled.append(socket.create_connection(("127.0.0.1", port)))
        stalled[-1].sendall(REQUEST)
    await until(lambda: len(asyncio.all_tasks()) > before)
    await until(lambda: len(asyncio.all_tasks()) <= before)
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    for one in stalled:
        one.close()
