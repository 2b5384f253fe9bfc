"""What a broker does not let a client do is an error at once, not silence."""

import asyncio
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from skin_host.cli import main
from skin_host.client import CommandError, Contact, SkinCallbacks, SkinClient
from skin_host.errors import BrokerError
from skin_host.mqtt.connection import Connection
from tests.client.test_client import hearing, publishing, take, touch
from tests.support.broker import Mosquitto
from tests.support.waiting import PATIENCE_S, until

NOT_AUTHORIZED = 0x87
#: What a web server answers.
WEB = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 200\r\n\r\n" + b" " * 200


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Topics to which brokers let nobody subscribe from now on."""
    topics: set[str] = set()
    subscribe = Connection.subscribe

    async def answered(self: Connection, topic: str, *words: Any, **options: Any) -> Any:
        if topic in topics:
            return [ReasonCode(PacketTypes.SUBACK, identifier=NOT_AUTHORIZED)]
        return await subscribe(self, topic, *words, **options)

    monkeypatch.setattr(Connection, "subscribe", answered)
    return topics


@pytest.fixture
def reading_only(mosquitto: Mosquitto, tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker that lets nobody publish commands."""
    folder = tmp_path / "reading_only"
    folder.mkdir()
    rules = folder / "rules"
    # The node's messages but no commands.
    published = ("nodes/+/status", "nodes/+/info", "+/touch", "+/contact")
    write = "".join(f"topic write skin/robot/{topic}\n" for topic in published)
    rules.write_text(f"topic read skin/#\n{write}")
    # As root it would become another user, who cannot read pytest's folders.
    with Mosquitto(mosquitto.program, folder, f"user root\nacl_file {rules}\n") as broker:
        yield broker


def refusal(broker: Mosquitto, topic: str) -> str:
    return rf'broker {broker.host}:{broker.port}: refuses us the topic "{topic}"'


TOUCHES = r"skin/robot/\+/touch"


async def test_who_reads_or_waits_for_a_refused_topic_gets_an_error(
    mosquitto: Mosquitto, refused: set[str]
) -> None:
    refused.add("skin/robot/+/touch")
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        events, contacts = skin.events(), skin.contacts()
        with pytest.raises(BrokerError, match=refusal(mosquitto, TOUCHES)):
            await skin.ready()
        with pytest.raises(BrokerError, match=refusal(mosquitto, TOUCHES)):
            await take(events, 1)
        with pytest.raises(BrokerError, match=refusal(mosquitto, TOUCHES)):
            skin.present("palm")
        # What is allowed comes, also to who reads on.
        del events
        await skin.ready()
        publisher.put_contact("palm", "OFF")
        assert await take(contacts, 1) == [Contact("palm", "OFF")]
        late = skin.touches()
        with pytest.raises(BrokerError, match=refusal(mosquitto, TOUCHES)):
            await take(late, 1)
        # The broker is asked again with the next connection.
        refused.clear()
        mosquitto.restart()
        await until(lambda: skin.connections == 2 and publisher.counters.connected)
        await skin.ready()
        publisher.put_touch(touch(1))
        assert (await take(late, 1))[0].count == 1


async def test_a_contact_whose_topic_is_refused_is_unknown(
    mosquitto: Mosquitto, refused: set[str]
) -> None:
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        palm = skin.contacts("palm")
        await skin.ready()
        publisher.put_contact("palm", "OFF")
        assert await take(palm, 1) == [Contact("palm", "OFF")]
        refused.add("skin/robot/+/contact")
        everywhere = skin.contacts()
        with pytest.raises(BrokerError):
            await take(everywhere, 2)
        with pytest.raises(BrokerError):
            await take(palm, 1)
        assert await take(palm, 1) == [Contact("palm", "UNKNOWN", "stale")]


async def test_callbacks_log_and_raise_what_the_broker_refuses(
    mosquitto: Mosquitto, refused: set[str], caplog: pytest.LogCaptureFixture
) -> None:
    refused.add("skin/robot/palm/contact")
    reported = threading.Event()

    def use() -> None:
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_contact(print, part="palm")
            assert reported.wait(PATIENCE_S)

    using = asyncio.create_task(asyncio.to_thread(use))
    topic = "skin/robot/palm/contact"
    await until(lambda: f'refuses us the topic "{topic}"' in caplog.text)
    reported.set()
    with pytest.raises(BrokerError, match=refusal(mosquitto, topic)):
        await using


async def test_answers_are_needed_only_by_who_commands(
    mosquitto: Mosquitto, refused: set[str]
) -> None:
    async with publishing(mosquitto):
        skin = hearing(mosquitto)
        replies = f"skin/robot/nodes/+/replies/{skin._identifier}"
        refused.add(replies)
        async with skin:
            touches = skin.touches()
            await skin.ready()
            with pytest.raises(BrokerError, match="refuses us the topic"):
                await skin.command("status", node="main", timeout_s=10 * PATIENCE_S)
            del touches


@pytest.mark.parametrize("topic", ["skin/+/nodes/+/status", "skin/robot/nodes/+/info"])
async def test_what_the_robot_is_cannot_be_asked_where_that_is_refused(
    mosquitto: Mosquitto, refused: set[str], topic: str
) -> None:
    refused.add(topic)
    robot = None if topic.startswith("skin/+") else "robot"
    with pytest.raises(BrokerError, match="refuses us the topic"):
        async with hearing(mosquitto, robot=robot) as skin:
            await skin.info(0.3)


async def test_a_listener_that_may_not_listen_ends_with_one_line(
    mosquitto: Mosquitto, refused: set[str], capsys: pytest.CaptureFixture[str]
) -> None:
    refused.add("skin/robot/+/slip")
    words = ["listen", "--robot", "robot"]
    words += ["--broker", f"mqtt://{mosquitto.host}:{mosquitto.port}"]
    assert await asyncio.to_thread(main, words) == 1
    (line,) = (one for one in capsys.readouterr().err.splitlines() if "skin listen" in one)
    assert 'refuses us the topic "skin/robot/+/slip"' in line


async def test_a_command_that_the_broker_refuses_is_not_waited_for(
    reading_only: Mosquitto,
) -> None:
    async with publishing(reading_only), hearing(reading_only) as skin:
        with pytest.raises(CommandError, match=r"does not let us command \(Not authorized\)"):
            await skin.command("status", node="main", timeout_s=10 * PATIENCE_S)
        assert skin.connections == 1


async def test_a_command_whose_broker_falls_silent_is_given_up(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto), hearing(mosquitto) as skin:
        await until(lambda: skin.nodes and skin.nodes["main"].online)
        mosquitto.freeze()
        with pytest.raises(CommandError, match="the broker does not answer"):
            await skin.command("status", node="main", timeout_s=10 * PATIENCE_S)
        mosquitto.resume()


@pytest.mark.parametrize(
    ("scheme", "answer", "remedy"),
    [
        ("mqtt", WEB, "check host and port"),
        ("mqtts", WEB, "leave TLS off"),
        ("mqtt", b"", "begin its URL with mqtts://"),
    ],
    ids=["a web server", "a server without TLS", "one that closes, as with TLS alone"],
)
async def test_what_is_no_such_broker_is_an_error_that_names_a_remedy(
    scheme: str, answer: bytes, remedy: str
) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1000)
        writer.write(answer)
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        with pytest.raises(BrokerError, match=remedy):
            async with SkinClient(f"{scheme}://127.0.0.1:{port}", robot="a", patience_s=0.5):
                pass
        # The server may just have accepted another connection, which would outlive its loop.
        await until(lambda: len(asyncio.all_tasks()) == 1)
