"""Who connects as a program ends is no failure of it."""

import asyncio
import logging
import socket
from typing import Any

import pytest

from skin_host.daemon.metrics import serve
from skin_host.mqtt.broker import embedded_broker
from tests.support.broker import free_port
from tests.support.waiting import until


async def ends_with_a_client_of_metrics(client: socket.socket, turns: int, kept: list[Any]) -> None:
    port = free_port()
    serving = asyncio.create_task(serve(port, dict))
    client.setblocking(False)
    await until(lambda: client.connect_ex(("127.0.0.1", port)) == 0)
    for _ in range(turns):
        await asyncio.sleep(0)
    assert not serving.done()


async def ends_with_a_client_of_the_broker(
    client: socket.socket, turns: int, kept: list[Any]
) -> None:
    kept.append(embedded_broker())  # the loop shuts it down, after its tasks
    broker = await kept[0].__aenter__()
    client.connect((broker.host, broker.port))
    for _ in range(turns):
        await asyncio.sleep(0)


@pytest.mark.parametrize("turns", range(1, 6))
@pytest.mark.parametrize("ends", [ends_with_a_client_of_metrics, ends_with_a_client_of_the_broker])
def test_a_connection_that_is_as_young_as_can_be_at_the_end_is_left_without_a_word(
    ends: Any, turns: int, caplog: pytest.LogCaptureFixture
) -> None:
    kept: list[Any] = []
    with socket.socket() as client, caplog.at_level(logging.ERROR, "asyncio"):
        asyncio.run(ends(client, turns, kept))
    assert [one.getMessage() for one in caplog.records if one.levelno >= logging.ERROR] == []
