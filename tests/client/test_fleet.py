"""Three brokers, one killed, frozen or brought back: a robot is heard as through one."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from msgspec import json

from skin_host.client import Contact, SkinClient
from skin_host.config.settings import Mqtt
from skin_host.errors import ConfigurationError, RequestError
from skin_host.mqtt.address import Broker
from skin_host.mqtt.order import Stamp, stamp_of
from skin_host.mqtt.publisher import Publisher
from tests.client.test_client import answer, frame, take, touch
from tests.mqtt.test_publisher import listening
from tests.support.broker import Mosquitto
from tests.support.waiting import until


@pytest.fixture
def brokers(mosquitto: Mosquitto, tmp_path: Path) -> Iterator[list[Mosquitto]]:
    """Three that know nothing of each other and remember over restarts what was retained."""
    with ExitStack() as stack:
        found = []
        for name in "abc":
            folder = tmp_path / name
            folder.mkdir()
            folder.chmod(0o777)
            found.append(stack.enter_context(Mosquitto(mosquitto.program, folder, "")))
        yield found


def at(broker: Mosquitto) -> str:
    return f"{broker.host}:{broker.port}"


def in_turn(brokers: list[Mosquitto], name: str = "robot/main") -> list[Mosquitto]:
    """The brokers in the order in which the robot tries them."""
    settings = Mqtt(brokers=[at(one) for one in brokers])
    ports = [one.port for one in Broker.all_from_settings(settings, name=name)]
    return sorted(brokers, key=lambda one: ports.index(one.port))


@asynccontextmanager
async def publishing(brokers: list[Mosquitto], **keys: Any) -> AsyncIterator[Publisher]:
    settings = Mqtt(brokers=[at(one) for one in brokers], **keys)
    async with Publisher(settings, "robot", handler=answer) as publisher:
        await until(lambda: publisher.counters.connected)
        yield publisher


def hearing(brokers: list[Mosquitto]) -> SkinClient:
    return SkinClient([f"mqtt://{at(one)}" for one in brokers], robot="robot")


@pytest.mark.parametrize("how", ["kill", "freeze"])
async def test_a_robot_goes_on_at_the_next_broker_and_nothing_is_lost_or_heard_twice(
    brokers: list[Mosquitto], how: str
) -> None:
    first, second, _ = in_turn(brokers)
    async with publishing(brokers) as publisher, hearing(brokers) as skin:
        touches, contacts = skin.touches(), skin.contacts()
        await skin.ready()
        publisher.put_contact("palm", "ON")
        assert await take(contacts, 1) == [Contact("palm", "ON")]
        for number in range(1, 21):
            publisher.put_touch(touch(number))
        heard = await take(touches, 20)
        (first.kill if how == "kill" else first.freeze)()
        for number in range(21, 41):
            publisher.put_touch(touch(number))
            await asyncio.sleep(0.01)
        publisher.put_contact("palm", "OFF")
        heard += await take(touches, 20)
        (first.restart if how == "kill" else first.resume)()
        await until(lambda: all(link.connection for link in skin._links))
        for number in range(41, 61):
            publisher.put_touch(touch(number))
        heard += await take(touches, 20)
        assert [one.count for one in heard] == list(range(1, 61))
        assert not sum(one.missed for one in heard)
        await until(lambda: skin._presence.reported() == [Contact("palm", "OFF")])
        assert skin.nodes["main"].online
        assert publisher._broker.port == second.port
        assert publisher.counters.touches_dropped == 0


async def test_what_the_broker_that_failed_still_holds_is_history(
    brokers: list[Mosquitto],
) -> None:
    first = in_turn(brokers)[0]
    async with publishing(brokers) as publisher:
        publisher.put_contact("palm", "OFF")
        await until(lambda: publisher.counters.retained_sent >= 2)
        first.freeze()
        publisher.put_contact("palm", "ON")  # lies in the frozen broker's socket
        await until(lambda: publisher.counters.connections == 2)
        publisher.put_contact("palm", "UNKNOWN")
        publisher.put_health("palm", {"state": "ok"})
        await until(lambda: not publisher._outbox.pending)
        first.resume()  # and says `ON`, and, of the last will, `offline`
        async with listening(first) as old:
            await until(lambda: b"offline" in old.payloads("status"))
        async with hearing(brokers) as skin:
            contacts = skin.contacts()
            await skin.ready()
            publisher.put_health("palm", {"state": "ok", "rate_hz": 20.0})  # it lives
            while (await take(contacts, 1))[0] != Contact("palm", "UNKNOWN", "not_felt"):
                pass
            await until(lambda: skin.nodes["main"].online)
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.5):
                    await anext(contacts)


async def test_a_node_that_dies_may_be_anywhere_and_one_that_says_so_is_offline(
    brokers: list[Mosquitto],
) -> None:
    async with hearing(brokers) as skin:
        async with publishing(brokers) as publisher:
            await until(lambda: skin.nodes and skin.nodes["main"].online)
            publisher._task.cancel()  # type: ignore[union-attr]  # its connection is cut
            await until(lambda: skin.nodes["main"].online is None)
        async with publishing(brokers):
            await until(lambda: skin.nodes["main"].online)
        await until(lambda: skin.nodes["main"].online is False)


async def test_a_node_is_unknown_while_no_broker_is_left(brokers: list[Mosquitto]) -> None:
    async with publishing(brokers), hearing(brokers) as skin:
        await until(lambda: skin.nodes and skin.nodes["main"].online)
        for broker in brokers:
            broker.kill()
        await until(lambda: skin.nodes["main"].online is None)
        brokers[1].restart()
        await until(lambda: skin.nodes["main"].online)


async def test_a_command_reaches_the_robot_where_it_is_and_once(brokers: list[Mosquitto]) -> None:
    first = in_turn(brokers)[0]
    async with publishing(brokers) as publisher, hearing(brokers) as skin:
        assert await skin.command("add", n=1) == {"arguments": {"n": 1}}
        first.kill()
        await until(lambda: publisher.counters.connections == 2)
        assert await skin.command("add", n=2) == {"arguments": {"n": 2}}
        assert publisher.counters.commands_taken == 2


async def test_what_was_acknowledged_just_before_is_said_again_to_the_next_broker(
    brokers: list[Mosquitto],
) -> None:
    first, second, _ = in_turn(brokers)
    async with listening(second) as seen, publishing(brokers) as publisher:
        for number in (1, 2, 3):
            publisher.put_touch(touch(number))
        await until(lambda: publisher.counters.touches_sent == 3)
        first.kill()
        await until(lambda: len(seen.touches()) == 3)
        assert seen.touches() == [1, 2, 3]
        await until(lambda: publisher.counters.touches_sent == 3)


async def test_states_move_with_the_robot_and_say_which_are_newer(
    brokers: list[Mosquitto],
) -> None:
    first, second, _ = in_turn(brokers)

    def stamps(seen: Any) -> dict[str, Stamp]:
        found = {}
        for message in seen.messages:
            stamp = stamp_of(message.properties)
            if stamp is not None:
                found[message.topic.value.rpartition("/")[2]] = stamp
        return found

    async with listening(second) as after, listening(first) as before:
        async with publishing(brokers) as publisher:
            publisher.put_contact("palm", "OFF")
            publisher.put_frame(frame(1))
            await until(lambda: len(before.messages) == 3)
            first.kill()
            await until(lambda: after.payloads("contact") == [b"OFF"])
            assert after.payloads("status") == [b"online"]
        await until(lambda: after.payloads("status") == [b"online", b"offline"])
        assert stamps(after)["contact"] > stamps(before)["contact"]
        assert stamps(after)["status"] > stamps(before)["status"]


async def test_after_a_start_with_a_clock_set_back_a_node_is_still_the_newest(
    brokers: list[Mosquitto],
) -> None:
    async with hearing(brokers) as skin:
        contacts, touches = skin.contacts(), skin.touches()
        async with publishing(brokers[:1]) as publisher:
            publisher._numbers.overtake(Stamp(2_000_000_000_000_000_000, 0))
            publisher._number_messages()
            publisher._connection.cut()  # type: ignore[union-attr]
            publisher.put_contact("palm", "ON")
            publisher.put_touch(touch(1))
            assert await take(contacts, 1) == [Contact("palm", "ON")]
            await take(touches, 1)
            await until(lambda: publisher.counters.connected and not publisher._outbox.pending)
        async with publishing(brokers[:1]) as publisher:
            publisher.put_contact("palm", "OFF")
            await until(lambda: publisher.counters.connections == 2)  # it has learned of it
            publisher.put_touch(touch(2))
            while (await take(contacts, 1))[0] != Contact("palm", "OFF"):
                pass
            assert [one.count for one in await take(touches, 1)] == [1]


def test_robots_spread_over_the_brokers_and_those_of_a_lost_one_over_the_others() -> None:
    settings = Mqtt(brokers=["a", "b:1884", "[::1]:1885"])
    first: dict[str, int] = {}
    second: dict[str, int] = {}
    for number in range(600):
        order = Broker.all_from_settings(settings, name=f"robot{number}/main")
        first[order[0].host] = first.get(order[0].host, 0) + 1
        if order[0].host == "a":
            second[order[1].host] = second.get(order[1].host, 0) + 1
    assert set(first) == {"a", "b", "::1"}
    assert min(first.values()) > 150
    assert set(second) == {"b", "::1"}
    assert min(second.values()) > 60


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({"brokers": ["a", "b"], "protocol": "3.1.1"}, 'mqtt.protocol = "5"'),
        ({"brokers": ["a", "a:1883"]}, "twice"),
        ({"brokers": ["a:99999"]}, "mqtt.brokers"),
    ],
)
def test_brokers_that_cannot_be_used_are_refused(keys: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigurationError, match=why):
        Publisher(json.decode(json.encode(keys), type=Mqtt), "robot")


def test_several_brokers_are_asked_for_a_robot_that_is_named() -> None:
    with pytest.raises(RequestError, match="name the robot"):
        SkinClient(["mqtt://a", "mqtt://b"])
    with pytest.raises(RequestError, match="MQTT 5"):
        SkinClient(["mqtt://a", "mqtt://b?protocol=3.1.1"], robot="robot")
