"""A node is online and offline also at a broker whose packets have no room for the names of its
parts, in the status or in the last will.
"""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import MqttError, connect, explain
from skin_host.mqtt.info import NodeInfo
from skin_host.mqtt.order import parts_of
from skin_host.mqtt.publisher import Publisher
from tests.attacks.test_odd_brokers import Odd, publishing
from tests.mqtt.test_large_info import info_of
from tests.mqtt.test_publisher import STATUS, listening, settings
from tests.support.broker import Mosquitto
from tests.support.waiting import until

LIMIT_BYTES = 400
NAMES = [f"part_{number:03}" for number in range(60)]


def info() -> NodeInfo:
    """Of parts whose names do not fit into a packet of `LIMIT_BYTES`."""
    found = info_of("demo.toml")
    part = found.parts["left_hand"]
    return msgspec.structs.replace(found, parts=dict.fromkeys(NAMES, part))


@pytest.fixture
def narrow(mosquitto: Mosquitto, tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker that takes no larger packets, the one that connects included."""
    folder = tmp_path / "narrow"
    folder.mkdir()
    with Mosquitto(mosquitto.program, folder, f"max_packet_size {LIMIT_BYTES}\n") as broker:
        yield broker


async def test_a_node_is_online_and_offline_at_a_broker_without_room_for_its_parts(
    narrow: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    async with listening(narrow, STATUS) as seen:
        async with Publisher(settings(narrow), "robot") as publisher:
            publisher.put_info(info())
            await until(lambda: seen.payloads("status") == [b"online"])
            assert publisher.counters.connections == 1
            assert STATUS not in publisher.counters.withheld
        await until(lambda: seen.payloads("status") == [b"online", b"offline"])
    for message in seen.messages:
        named = parts_of(message.properties)
        assert named < set(NAMES)
        assert named
    told = [record.getMessage() for record in caplog.records]
    assert [line for line in told if "of its 60 parts" in line]


async def test_its_last_will_is_published_too(narrow: Mosquitto) -> None:
    async with listening(narrow, STATUS) as seen, Publisher(settings(narrow), "robot") as publisher:
        publisher.put_info(info())
        await until(lambda: seen.payloads("status") == [b"online"])
        connection = publisher._connection
        assert connection is not None
        connection.cut()
        await until(lambda: seen.payloads("status")[:2] == [b"online", b"offline"])
        await until(lambda: seen.payloads("status")[-1] == b"online")


async def test_a_status_keeps_to_a_limit_that_comes_with_the_connection() -> None:
    """Some brokers take larger packets when a client connects."""
    broker = Odd(b"\x27" + LIMIT_BYTES.to_bytes(4, "big"))
    async with publishing(broker) as publisher:
        publisher.put_info(info())
        await until(lambda: STATUS in broker.topics)
        assert STATUS not in publisher.counters.withheld
    assert broker.connections == 1


async def test_a_broker_that_closes_a_connection_unanswered_is_not_waited_for() -> None:
    async def close(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1)
        writer.close()

    server = await asyncio.start_server(close, "127.0.0.1", 0)
    address, _ = Broker.from_url(f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}")
    with pytest.raises(MqttError) as refused:
        async with connect(address):
            pass
    server.close()
    assert "the broker closed the connection" in explain(refused.value)
