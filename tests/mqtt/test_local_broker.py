"""The demo finds a broker on every machine."""

import asyncio
import contextlib
import socket
import sys
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np
import pytest

from skin_host.config.settings import Mqtt
from skin_host.errors import BrokerError
from skin_host.mqtt import broker as local
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.frame import PressureFrame
from tests.support.said import touch_event
from tests.support.waiting import until


async def publish_and_listen(host: str, port: int, protocol: str) -> list[str]:
    """What arrives of one message of each kind, and of the daemon's end."""
    seen: list[str] = []

    async def listen(client: aiomqtt.Client) -> None:
        async for message in client.messages:
            seen.append(message.topic.value.rpartition("/")[2])  # noqa: PERF401

    mask = np.zeros(12, np.bool_)
    frame = PressureFrame(
        "palm", 1, 1, np.zeros(12, np.uint8), np.zeros(12, np.float32), mask, ~mask, mask
    )
    touch = touch_event("begin", 1, 1, 1, "palm", [1], None, None, 1.0, 1.0, 1.0, 0.1)
    async with aiomqtt.Client(host, port) as client:
        await client.subscribe("skin/#", qos=1)
        task = asyncio.create_task(listen(client))
        keys = Mqtt(host=host, port=port, protocol=protocol)  # type: ignore[arg-type]
        async with Publisher(keys, "robot") as publisher:
            await until(lambda: publisher.counters.connected)
            publisher.put_frame(frame)
            publisher.put_touch(touch)
            publisher.put_contact("palm", "ON")
            await until(lambda: len(seen) == 4)
        await until(lambda: len(seen) == 5)
        task.cancel()
    return seen


async def test_the_embedded_broker_carries_everything() -> None:
    pytest.importorskip("amqtt")
    async with local.embedded_broker() as broker:
        host, port, kind = broker
        assert broker.url == f"mqtt://{host}:{port}?protocol=3.1.1"
        seen = await publish_and_listen(host, port, broker.protocol)
    assert kind == "amqtt"
    assert sorted(seen) == ["contact", "frame", "status", "status", "touch"]


async def test_mosquitto_is_chosen_where_it_is_installed() -> None:
    if local.find_mosquitto() is None:
        pytest.skip("mosquitto is not installed")
    async with local.local_broker() as broker:
        assert (broker.kind, broker.protocol) == ("mosquitto", "5")
        seen = await publish_and_listen(broker.host, broker.port, "5")
    assert sorted(seen) == ["contact", "frame", "status", "status", "touch"]
    with pytest.raises(OSError):
        await asyncio.open_connection(broker.host, broker.port)


async def test_without_mosquitto_the_embedded_broker_is_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("amqtt")
    monkeypatch.setattr(local, "find_mosquitto", lambda: None)
    async with local.local_broker() as broker:
        assert broker.kind == "amqtt"


async def test_without_any_broker_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(local, "find_mosquitto", lambda: None)
    monkeypatch.setitem(sys.modules, "amqtt.broker", None)
    with pytest.raises(BrokerError, match="apt install mosquitto"):
        async with local.local_broker():
            pass


async def test_a_mosquitto_that_does_not_start_is_an_error_that_says_so() -> None:
    with pytest.raises(BrokerError, match="did not start"):
        async with local.mosquitto_broker("/bin/false"):
            pass


async def test_a_mosquitto_that_ctrl_c_reaches_as_it_starts_goes_on(tmp_path: Path) -> None:
    """It is for the program that has started it, whose clients are to disconnect first."""
    mosquitto = local.find_mosquitto()
    if mosquitto is None:
        pytest.skip("mosquitto is not installed")
    program = tmp_path / "mosquitto"
    program.write_text(f'#!/bin/sh\nkill -INT $$\nexec {mosquitto} "$@"\n')
    program.chmod(0o755)
    async with local.mosquitto_broker(str(program)) as broker:
        async with aiomqtt.Client(broker.host, broker.port):
            pass


def test_a_reserved_port_is_free_for_a_server_and_for_nobody_else() -> None:
    """Between finding a port and listening there another program could take it."""
    with local.reserved_port() as port:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((local.HOST, port))
        assert port not in {local.free_port() for _ in range(2000)}
        with (
            socket.create_server((local.HOST, port)),
            socket.create_connection((local.HOST, port)),
        ):
            pass


async def test_a_port_that_another_program_took_is_an_error_of_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("amqtt")
    with socket.create_server((local.HOST, 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(local, "reserved_port", lambda: contextlib.nullcontext(port))
        with pytest.raises(BrokerError, match=f"amqtt did not start on port {port}"):
            async with local.embedded_broker():
                pass


def test_a_connection_that_is_left_when_the_program_ends_is_no_failure() -> None:
    pytest.importorskip("amqtt")
    told: list[dict[str, Any]] = []

    async def leave() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context))
        async with local.embedded_broker() as broker:
            client.connect((broker.host, broker.port))
            await asyncio.sleep(0.2)  # until the broker waits for the client's first words

    with socket.socket() as client:
        asyncio.run(leave())
    assert told == []


async def test_clients_that_come_while_others_subscribe_are_served() -> None:
    pytest.importorskip("amqtt")
    told: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context))

    async def come(broker: local.LocalBroker, name: str) -> str:
        async with aiomqtt.Client(broker.host, broker.port) as client:
            for level in range(int(name[-1])):
                await client.subscribe(f"{name}/{level}", qos=1)
            await client.subscribe("kept/#", qos=1)
            async with asyncio.timeout(20):
                message = await anext(client.messages)
        return message.topic.value

    seen: set[str] = set()
    async with local.embedded_broker() as broker:
        async with aiomqtt.Client(broker.host, broker.port) as first:
            await first.publish("kept/1", "here", qos=1, retain=True)
            await first.subscribe("kept/#", qos=1)
            for round_ in range(4):
                names = [f"client_{round_}_{n}" for n in range(8)]
                seen |= set(await asyncio.gather(*(come(broker, name) for name in names)))
    assert seen == {"kept/1"}
    assert told == []
