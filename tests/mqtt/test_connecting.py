"""A connection to a broker that is given up while it is being made."""

import asyncio
import socket
import threading
from typing import Any

import pytest

from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import MqttError, connect
from tests.support.waiting import PATIENCE_S, until


def test_a_connection_that_is_made_after_its_loop_has_ended_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thread that connects cannot be cancelled; it must close what nobody waits for."""
    asked, ended = threading.Event(), threading.Event()
    resolve = socket.getaddrinfo

    def slow(*arguments: Any, **options: Any) -> Any:
        asked.set()
        assert ended.wait(PATIENCE_S)
        return resolve(*arguments, **options)

    async def give_up(broker: Broker) -> None:
        connecting = asyncio.create_task(connect(broker).__aenter__())
        await until(asked.is_set)
        connecting.cancel()
        await asyncio.gather(connecting, return_exceptions=True)

    with socket.create_server(("127.0.0.1", 0)) as server:
        broker, _ = Broker.from_url(f"mqtt://127.0.0.1:{server.getsockname()[1]}")
        with monkeypatch.context() as patch:
            patch.setattr(socket, "getaddrinfo", slow)
            asyncio.run(give_up(broker))
            ended.set()
            server.settimeout(PATIENCE_S)
            ours, _ = server.accept()
        with ours:
            ours.settimeout(PATIENCE_S)
            assert ours.recv(1) == b""


async def test_a_host_that_no_computer_can_have_is_no_connection() -> None:
    broker, _ = Broker.from_url("mqtt://" + "x" * 70 + ".local")
    with pytest.raises(MqttError, match="too long"):
        async with connect(broker):
            pass
