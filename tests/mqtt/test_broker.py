"""The broker of the tests can be broken in every way that the daemon must survive."""

import socket
from pathlib import Path

import pytest
from aiomqtt import Client, MqttError

from tests.support.broker import Mosquitto
from tests.support.waiting import PATIENCE_S


async def _echo(broker: Mosquitto, payload: str, timeout_s: float = 20.0) -> bytes:
    async with Client(broker.host, broker.port, timeout=timeout_s) as client:
        await client.subscribe("echo")
        await client.publish("echo", payload, qos=1)
        async for message in client.messages:
            assert isinstance(message.payload, bytes)
            return message.payload
    raise AssertionError("no message came")


async def test_a_message_comes_back(mosquitto: Mosquitto) -> None:
    assert await _echo(mosquitto, "hello") == b"hello"


async def test_a_broker_that_was_killed_comes_back_on_its_port(mosquitto: Mosquitto) -> None:
    port = mosquitto.port
    mosquitto.kill()
    with pytest.raises(MqttError):
        await _echo(mosquitto, "lost")
    mosquitto.restart()
    assert mosquitto.port == port
    assert await _echo(mosquitto, "back") == b"back"


async def test_a_frozen_broker_answers_nobody_until_it_goes_on(mosquitto: Mosquitto) -> None:
    mosquitto.freeze()
    with socket.create_connection((mosquitto.host, mosquitto.port)) as client:
        client.sendall(bytes.fromhex("100c00044d5154540402003c0000"))
        client.settimeout(0.2)
        with pytest.raises(TimeoutError):
            client.recv(1)
        mosquitto.resume()
        client.settimeout(PATIENCE_S)
        assert client.recv(1) == b"\x20"  # CONNACK


def test_a_broker_that_cannot_start_says_why(mosquitto: Mosquitto, tmp_path: Path) -> None:
    (tmp_path / "second").mkdir()
    second = Mosquitto(mosquitto.program, tmp_path / "second", settings="nonsense true\n")
    with pytest.raises(RuntimeError, match="nonsense"):
        second.start()
