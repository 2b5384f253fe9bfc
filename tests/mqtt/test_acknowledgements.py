"""The usual acknowledgements are read without paho's decoder, with the same consequences."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from skin_host.mqtt import connection
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import MAX_IN_FLIGHT, Connection, MqttError, connect
from tests.support.packets import CONNECT, PUBLISH, packet_with_flags
from tests.support.waiting import PATIENCE_S, until

#: Makes of the number of a publication, two bytes, what a broker answers to it.
Answer = Callable[[bytes], bytes]


def puback(number: bytes, rest: bytes = b"") -> bytes:
    return bytes([0x40, 2 + len(rest)]) + number + rest


def ping_response(_: bytes) -> bytes:
    return b"\xd0\x00"


@asynccontextmanager
async def answered_by(answer: Answer, *, v5: bool = True) -> AsyncIterator[Connection]:
    """A connection to a broker that answers each publication with QoS 1 so."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                first, body = await packet_with_flags(reader)
                if first >> 4 == CONNECT:
                    writer.write(b"\x20\x03\x00\x00\x00" if v5 else b"\x20\x02\x00\x00")
                elif first >> 4 == PUBLISH:
                    end = 2 + int.from_bytes(body[:2], "big")
                    writer.write(answer(body[end : end + 2]))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    address = Broker("127.0.0.1", port, protocol="5" if v5 else "3.1.1")
    failures: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: failures.append(context))
    try:
        async with connect(address, identifier="acknowledged") as made:
            yield made
    finally:
        server.close()
    assert not failures


@pytest.fixture(params=["read here", "decoded by paho"])
def reading(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What holds for the usual acknowledgements holds when paho decodes them, too."""
    if request.param == "decoded by paho":
        monkeypatch.setattr(connection, "_USUAL_ACKS", {})


async def arrived(done: "asyncio.Future[None]") -> None:
    await asyncio.wait_for(done, PATIENCE_S)


FORMS = {
    "no code": b"",
    "success": b"\x00",
    "nobody listens": b"\x10",
    "success, no properties": b"\x00\x00",
    "nobody listens, with a reason": b"\x10\x05\x1f\x00\x02no",
}


@pytest.mark.usefixtures("reading")
@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
async def test_a_message_has_arrived_in_whatever_form_it_is_acknowledged(form: bytes) -> None:
    async with answered_by(lambda number: puback(number, form)) as link:
        sent = [link.send("t", b"x", qos=1) for _ in range(3)]
        for done in sent:
            await arrived(done)
        await asyncio.wait_for(link.publish("t", b"x", qos=1), PATIENCE_S)
        assert (link.refused, link.discarded) == (0, 0)


@pytest.mark.usefixtures("reading")
@pytest.mark.parametrize("code", [0x80, 0x87, 0x97])
@pytest.mark.parametrize("properties", [b"", b"\x00"])
async def test_a_refusal_is_counted_and_named(code: int, properties: bytes) -> None:
    async with answered_by(lambda number: puback(number, bytes([code]) + properties)) as link:
        await arrived(link.send("t", b"x", qos=1))
        assert link.refused == 1
        assert link.refusal


@pytest.mark.usefixtures("reading")
async def test_an_acknowledgement_lets_the_next_message_go() -> None:
    async with answered_by(puback) as link:
        sent = [link.send("t", b"x", qos=1) for _ in range(3 * MAX_IN_FLIGHT)]
        for done in sent:
            await arrived(done)


@pytest.mark.usefixtures("reading")
async def test_an_acknowledgement_of_another_message_or_for_the_second_time_counts_for_none() -> (
    None
):
    held: list[bytes] = []

    def late(number: bytes) -> bytes:
        held.append(number)
        if len(held) == 1:
            return puback(b"\xff\xfe") + puback(b"\x00\x00")
        return puback(held[1]) + puback(held[1])

    async with answered_by(late) as link:
        first, second = link.send("t", b"1", qos=1), link.send("t", b"2", qos=1)
        await arrived(second)
        third = link.send("t", b"3", qos=1)
        await until(lambda: len(held) == 3)
        assert not first.done()
        assert not third.done()
        assert link.refused == 0


@pytest.mark.usefixtures("reading")
async def test_a_message_of_mqtt_3_is_acknowledged_by_its_number_alone() -> None:
    async with answered_by(puback, v5=False) as link:
        await arrived(link.send("t", b"x", qos=1))
        assert link.refused == 0


@pytest.mark.usefixtures("reading")
@pytest.mark.parametrize(
    ("v5", "packet"), [(True, b"\x40\x01\x00"), (False, b"\x40\x03\x00\x01\x00")]
)
async def test_what_is_no_acknowledgement_ends_the_connection(v5: bool, packet: bytes) -> None:
    with pytest.raises(MqttError):
        async with answered_by(lambda _: packet, v5=v5) as link:
            done = link.send("t", b"x", qos=1)
            await asyncio.wait_for(link.lost(), PATIENCE_S)
    assert not done.done()
