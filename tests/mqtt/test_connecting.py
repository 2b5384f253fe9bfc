"""A connection to a broker that is given up while it is being made, or ended by the broker."""

import asyncio
import contextlib
import socket
import threading
from typing import Any

import pytest

from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Connection, MqttError, connect, explain
from tests.support.packets import CONNACK, SUBSCRIBE, packet
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


@pytest.mark.parametrize(
    ("farewell", "reason"),
    [(b"\xe0\1\x97", "Quota exceeded"), (b"", "the broker closed the connection")],
)
async def test_a_subscription_over_which_the_connection_ends_fails_for_the_reason_of_the_end(
    farewell: bytes, reason: str
) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await packet(reader)
        writer.write(CONNACK)
        assert (await packet(reader))[0] == SUBSCRIBE
        writer.write(farewell)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    broker = Broker("127.0.0.1", server.sockets[0].getsockname()[1])
    with contextlib.suppress(MqttError):
        async with connect(broker) as link:
            with pytest.raises(MqttError) as subscribing:
                await link.listen_to("t")
            with pytest.raises(MqttError) as sending:
                link.send("t", b"x", qos=1)
    server.close()
    assert reason in explain(subscribing.value)
    assert "the broker closed the connection" in explain(sending.value)


@pytest.mark.parametrize("fails", [False, True])
async def test_a_wait_that_ends_as_its_task_is_cancelled_is_cancelled(fails: bool) -> None:
    """Otherwise the task goes on, and who cancelled it waits for ever."""
    broker, _ = Broker.from_url("mqtt://127.0.0.1")
    connection = Connection(
        broker,
        identifier=None,
        will=None,
        max_incoming=1,
        max_packet=100,
        session_s=0,
        resume=False,
    )
    answer: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    waiting = asyncio.create_task(connection._wait_for(answer, PATIENCE_S))
    await asyncio.sleep(0)
    if fails:
        answer.set_exception(MqttError("closed"))
    else:
        answer.set_result(None)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
