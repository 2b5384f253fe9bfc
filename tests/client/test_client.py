"""A program hears the skin through a real broker, and through what happens to it."""

import asyncio
import math
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np
import pytest
from msgspec import json
from msgspec.structs import replace
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from skin_host.client import CommandError, Contact, SkinCallbacks, SkinClient
from skin_host.client.requests import ANSWER_S, answer_within_s
from skin_host.client.session import LEAST_STALE_S
from skin_host.config.settings import Mqtt, changed, load
from skin_host.errors import BrokerError, RequestError, SkinError, StateError
from skin_host.layout import build_layout
from skin_host.mqtt.address import Broker
from skin_host.mqtt.info import node_info
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from tests.support.broker import Mosquitto, free_port
from tests.support.said import touch_event
from tests.support.waiting import PATIENCE_S, until

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"


def frame(seq: int, part: str = "palm") -> PressureFrame:
    m = 12
    valid = np.ones(m, np.bool_)
    valid[3] = False
    none = np.zeros(m, np.bool_)
    kpa = np.arange(m, dtype=np.float32) * np.float32(0.5)
    return PressureFrame(part, seq, seq, np.zeros(m, np.uint8), kpa, none, valid, none)


def touch(number: int, part: str = "palm", event: Any = "move") -> Touch:
    return touch_event(event, 1, number, number, part, [1], None, None, 1.0, 2.0, 2.0, 0.1)


async def answer(name: str, payload: bytes) -> Mapping[str, Any]:
    if name == "refuse":
        raise RequestError("no such thing")
    if name == "later":
        raise StateError("not now")
    if name == "fail":
        raise SkinError("no board sent a sweep")
    if name == "sleep":
        await asyncio.sleep(60)
    arguments = json.decode(payload)
    del arguments["id"]
    return {"arguments": arguments}


@asynccontextmanager
async def publishing(
    broker: Mosquitto, robot: str = "robot", node: str = "main", **keys: Any
) -> AsyncIterator[Publisher]:
    settings = Mqtt(host=broker.host, port=broker.port, **keys)
    commands = f"skin/{robot}/nodes/{node}/cmd/+"
    before = broker.subscriptions(commands)
    async with Publisher(settings, robot, node, handler=answer) as publisher:
        await until(lambda: broker.subscriptions(commands) > before)
        yield publisher


def hearing(broker: Mosquitto, robot: str | None = "robot", **keys: Any) -> SkinClient:
    return SkinClient(f"mqtt://{broker.host}:{broker.port}", robot=robot, **keys)


async def take(stream: Any, n: int) -> list[Any]:
    async with asyncio.timeout(PATIENCE_S):
        return [await anext(stream) for _ in range(n)]


@pytest.mark.parametrize("encoding", ["json", "cbor"])
async def test_frames_come_as_arrays_in_kpa(mosquitto: Mosquitto, encoding: str) -> None:
    async with publishing(mosquitto, encoding=encoding) as publisher, hearing(mosquitto) as skin:
        frames = skin.frames()
        await skin.ready()
        publisher.put_frame(frame(4))
        (seen,) = await take(frames, 1)
    np.testing.assert_allclose(seen.pressure_kpa, np.arange(12) * 0.5)
    assert np.flatnonzero(~seen.valid).tolist() == [3]
    assert not seen.beyond_range.any()


async def test_touches_of_one_part_are_heard_alone(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        palm, everywhere = skin.touches("palm"), skin.touches()
        await skin.ready()
        for part in ("arm", "palm", "arm", "palm"):
            publisher.put_touch(touch(1, part))
        assert [(t.part, t.count) for t in await take(palm, 2)] == [("palm", 1), ("palm", 2)]
        assert [t.part for t in await take(everywhere, 4)] == ["arm", "palm", "arm", "palm"]


async def test_state_is_known_with_the_next_health_and_then_to_who_asks_later(
    mosquitto: Mosquitto,
) -> None:
    async with publishing(mosquitto) as publisher:
        publisher.put_contact("palm", "ON")
        publisher.put_health("palm", {"rate_hz": 20.0})
        await until(lambda: not publisher._outbox.pending)
        async with hearing(mosquitto, stale_s=10 * PATIENCE_S) as skin:
            first, health = skin.contacts(), skin.health()
            (seen,) = await take(health, 1)
            assert (seen.part, seen.record["rate_hz"], seen.stored) == ("palm", 20.0, True)
            publisher.put_health("palm", {"rate_hz": 21.0})
            (seen,) = await take(health, 1)
            assert (seen.part, seen.record["rate_hz"], seen.stored) == ("palm", 21.0, False)
            assert await take(first, 1) == [Contact("palm", "ON")]
            second, later = skin.contacts("palm"), skin.health()
            assert await take(second, 1) == [Contact("palm", "ON")]
            assert (await take(later, 1))[0].stored


async def test_contact_states_are_subscribed_to_before_what_shows_that_their_parts_live(
    mosquitto: Mosquitto,
) -> None:
    """What is live may come before what is retained of a later subscription, and would show nothing
    of a state that is not known yet.
    """
    parts = [f"part{i}" for i in range(8)]
    async with hearing(mosquitto) as skin:
        streams = [kind(part) for part in parts for kind in (skin.health, skin.contacts)]
        await skin.ready()
        for stream in streams:
            stream.close()
    asked = [line.rsplit("/", 1)[-1] for line in mosquitto.log.splitlines() if "/part" in line]
    assert asked[:8] == ["contact"] * 8
    assert sorted(asked[8:]) == ["health"] * 8 + ["touch"] * 8


async def stored(broker: Mosquitto, **messages: bytes) -> None:
    """Leave retained messages of a part at the broker, as somebody who is not a node."""
    async with aiomqtt.Client(broker.host, broker.port) as stranger:
        await stranger.publish("skin/robot/nodes/main/status", b"online", qos=1, retain=True)
        for kind, payload in messages.items():
            await stranger.publish(f"skin/robot/palm/{kind}", payload, qos=1, retain=True)


async def test_what_the_broker_kept_of_a_robot_that_is_switched_off_is_not_known(
    mosquitto: Mosquitto,
) -> None:
    """After a power cut the broker has the last states, and nobody that corrects them."""
    await stored(mosquitto, contact=b"OFF", health=json.encode({"schema": "skin.health/1"}))
    async with hearing(mosquitto, stale_s=LEAST_STALE_S) as skin:
        contacts = skin.contacts("palm")
        assert await take(contacts, 1) == [Contact("palm", "UNKNOWN", "stale")]


async def test_a_state_that_somebody_deletes_is_not_known(mosquitto: Mosquitto) -> None:
    """That health is deleted, too, is no sign of the part's life."""
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        contacts = skin.contacts("palm")
        await skin.ready()
        publisher.put_contact("palm", "OFF")
        assert await take(contacts, 1) == [Contact("palm", "OFF")]
        alive_s = skin._presence._parts["palm"].alive_s
        await stored(mosquitto, health=b"", contact=b"")
        assert await take(contacts, 1) == [Contact("palm", "UNKNOWN", "stale")]
        assert skin._presence._parts["palm"].alive_s == alive_s
        mosquitto.kill()
        assert await take(contacts, 1) == [Contact("palm", "UNKNOWN", "disconnected")]


async def test_a_stream_that_ends_takes_nothing_from_the_others(mosquitto: Mosquitto) -> None:
    """What is known of a part stays while somebody follows it, by whichever topic."""
    long_s = 10 * PATIENCE_S
    async with publishing(mosquitto) as publisher, hearing(mosquitto, stale_s=long_s) as skin:
        palm, foot = skin.contacts("palm"), skin.contacts("foot")
        await skin.ready()
        for part in ("palm", "foot"):
            publisher.put_contact(part, "OFF")
        await take(palm, 1)
        assert await take(foot, 1) == [Contact("foot", "OFF")]
        everywhere = skin.contacts()
        assert {one.part for one in await take(everywhere, 2)} == {"palm", "foot"}
        await skin.ready()  # the topic of all replaces those of two
        assert {one.part for one in skin._presence.reported()} == {"palm", "foot"}
        del everywhere, palm
        skin._ask_again()
        await until(lambda: "skin/robot/+/contact" not in skin._links[0]._subscribed)
        assert [one.part for one in skin._presence.reported()] == ["foot"]
        mosquitto.kill()
        assert await take(foot, 1) == [Contact("foot", "UNKNOWN", "disconnected")]


async def test_who_reads_touches_alone_goes_on_knowing_those_that_last(
    mosquitto: Mosquitto,
) -> None:
    """Whatever other streams end."""
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        touches, contacts = skin.touches(), skin.contacts("palm")
        await skin.ready()
        publisher.put_touch(touch(1, event="begin"))
        publisher.put_contact("palm", "ON")
        await take(contacts, 1)
        await take(touches, 1)
        del contacts
        skin._ask_again()
        await until(lambda: "skin/robot/palm/contact" not in skin._links[0]._subscribed)
        assert [one.part for one in skin.present()] == ["palm"]
        assert skin._presence.reported() == []
        del touches
        skin._ask_again()
        await until(lambda: not skin._presence._parts)


async def test_the_first_events_of_a_node_that_was_started_again_are_missed_and_counted(
    mosquitto: Mosquitto,
) -> None:
    async with hearing(mosquitto) as skin:
        touches = skin.touches()
        await skin.ready()
        for before in (0, 9):
            async with publishing(mosquitto) as publisher:
                publisher._outbox._counts["skin/robot/palm/touch"] = before
                publisher.put_touch(touch(1 + before))
                publisher.put_touch(touch(2 + before))
                await publisher._outbox.drained()
        seen = [(one.count, one.missed) for one in await take(touches, 4)]
        assert seen == [(1, 0), (2, 0), (10, 9), (11, 0)]


async def test_a_client_hears_what_was_said_while_its_link_was_cut(
    mosquitto: Mosquitto,
) -> None:
    async with hearing(mosquitto) as skin:
        touches = skin.touches()
        await skin.ready()
        async with publishing(mosquitto) as publisher:
            publisher.put_touch(touch(1))
            assert (await take(touches, 1))[0].count == 1
            skin._links[0].connection.cut()  # type: ignore[union-attr]  # its link alone breaks
            await until(lambda: not skin.connected)
            for number in (2, 3, 4):
                publisher.put_touch(touch(number))
            await until(lambda: publisher.counters.touches_sent == 4)
            await until(lambda: skin.connected)
            publisher.put_touch(touch(5))
            seen = await take(touches, 4)
            assert [(one.count, one.missed) for one in seen] == [(2, 0), (3, 0), (4, 0), (5, 0)]


async def test_events_that_the_broker_keeps_do_not_wait_behind_states(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """Its room is limited, health comes every second, and a state that was kept is an old one."""
    with Mosquitto(mosquitto.program, tmp_path, "max_queued_messages 50\n") as broker:
        async with publishing(broker) as publisher, hearing(broker) as skin:
            touches, contacts, health = skin.touches(), skin.contacts(), skin.health()
            await skin.ready()
            publisher.put_touch(touch(1))
            await take(touches, 1)
            link = skin._links[0]
            there, link.broker = link.broker, Broker(broker.host, free_port())
            link.connection.cut()  # type: ignore[union-attr]
            await until(lambda: not skin.connected)
            async with aiomqtt.Client(broker.host, broker.port) as somebody:
                for _ in range(100):
                    old = json.encode({"schema": "skin.health/1", "state": "ok"})
                    await somebody.publish("skin/robot/palm/health", old, qos=1)
                    await somebody.publish("skin/robot/palm/contact", b"OFF", qos=1)
            publisher.put_touch(touch(2))
            await until(lambda: publisher.counters.touches_sent == 2)
            link.broker = there
            await until(lambda: skin.connected)
            publisher.put_touch(touch(3))
            assert [one.count for one in await take(touches, 1)] == [2]
            publisher.put_health("palm", {"state": "silent"})
            assert (await take(health, 1))[0].state == "silent"
            del contacts


async def test_a_client_survives_the_broker(mosquitto: Mosquitto) -> None:
    async with hearing(mosquitto) as skin:
        touches = skin.touches()
        await skin.ready()
        async with publishing(mosquitto) as publisher:
            publisher.put_touch(touch(1))
            assert (await take(touches, 1))[0].count == 1
            mosquitto.restart()
            await until(lambda: skin.connections == 2)
            await until(lambda: publisher.counters.connected)
            publisher.put_touch(touch(2))
            (seen,) = await take(touches, 1)
            assert (seen.count, seen.missed) == (2, 0)


async def test_a_stream_that_ended_while_the_link_was_cut_is_given_up(
    mosquitto: Mosquitto,
) -> None:
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        frames, touches = skin.frames(), skin.touches()
        await skin.ready()
        skin._links[0].connection.cut()  # type: ignore[union-attr]
        del frames
        await until(lambda: skin.connections == 2)
        received: list[Any] = []
        skin._intake._take_part = lambda kind, *_, **__: received.append(kind)  # type: ignore[method-assign]
        publisher.put_frame(frame(1))
        await until(lambda: publisher.counters.frames_sent)
        publisher.put_touch(touch(1))
        await until(lambda: received)
        assert received == ["touch"]
        del touches


async def test_topics_that_nobody_reads_any_more_are_given_up(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        frames = skin.frames()
        await skin.ready()
        assert "skin/robot/+/frame" in skin._links[0]._subscribed
        del frames
        publisher.put_frame(frame(1))
        await until(lambda: "skin/robot/+/frame" not in skin._links[0]._subscribed)


async def test_streams_end_with_the_client(mosquitto: Mosquitto) -> None:
    async with hearing(mosquitto) as skin:
        touches = skin.touches()
    assert [touch async for touch in touches] == []


async def test_who_waits_for_a_client_that_ends_waits_no_longer(mosquitto: Mosquitto) -> None:
    async with hearing(mosquitto) as skin:
        mosquitto.kill()
        await until(lambda: not skin.connected)
        waiting = [
            asyncio.create_task(asked)
            for asked in (
                skin.ready(),
                skin.info(10 * PATIENCE_S),
                skin.command("status", node="main", timeout_s=10 * PATIENCE_S),
            )
        ]
        await asyncio.sleep(0)
    async with asyncio.timeout(PATIENCE_S):
        for task in waiting:
            with pytest.raises(RequestError, match="this client has ended"):
                await task


async def test_nodes_say_what_they_are_and_whether_they_live(mosquitto: Mosquitto) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    async with hearing(mosquitto) as skin:
        async with publishing(mosquitto) as publisher:
            publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
            info = await skin.info(PATIENCE_S)
            assert list(info["main"].parts) == ["left_hand", "left_forearm"]
            assert skin.nodes["main"].online
        await until(lambda: skin.nodes["main"].online is False)


@pytest.mark.parametrize(
    ("ask", "part", "why"),
    [
        (SkinClient.frames, "index", "has no taxels and no frames; wanted a part of skin"),
        (SkinClient.frames, "thumb", 'no frames; wanted "thumb_skin", its skin'),
        (SkinClient.frames, "thumb_skin", "no frames: its configuration has `frames = false`"),
        (SkinClient.slips, "thumb_skin", 'wanted a fingertip on a .* board, "thumb"$'),
        (SkinClient.overs, "thumb_skin", "skin has no slips and no excesses"),
    ],
)
async def test_a_stream_of_what_a_part_does_not_publish_is_refused(
    ask: Callable[[SkinClient, str], Any], part: str, why: str, mosquitto: Mosquitto
) -> None:
    """Once: a configuration may be changed, and who reads on receives what comes then."""
    fingertips = CONFIG.with_name("fingertips.toml")
    settings = changed(load(fingertips), {"parts.thumb_skin.frames": False})
    info = node_info(
        build_layout(settings, fingertips.parent),
        "main",
        version="1",
        configuration="x",
        parts=settings.parts,
        fingertips=settings.fingertips,
    )
    async with hearing(mosquitto) as skin, publishing(mosquitto) as publisher:
        stream = ask(skin, part)
        others = [skin.frames(), skin.slips("thumb"), skin.events("thumb_skin")]
        publisher.put_info(info)
        with pytest.raises(RequestError, match=f'robot "robot", part "{part}": .*{why}'):
            await take(stream, 1)
        skin._check_parts(asyncio.get_running_loop().time())
        assert not any(one._failure for one in [stream, *others])
        if ask is SkinClient.frames:
            publisher.put_frame(frame(1, part))
            assert (await take(stream, 1))[0].seq == 1


async def test_info_is_of_all_nodes_that_are_online(mosquitto: Mosquitto) -> None:
    """One that has just connected sends its info a moment after its status."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x")
    async with hearing(mosquitto) as skin, publishing(mosquitto) as publisher:
        async with publishing(mosquitto, node="arm") as arm:
            publisher.put_info(info)
            await until(lambda: skin.nodes and skin.nodes["main"].info)
            await until(lambda: "arm" in skin.nodes)
            asked = asyncio.create_task(skin.info(PATIENCE_S))
            await asyncio.sleep(0)
            arm.put_info(replace(info, node="arm"))
            assert set(await asked) == {"main", "arm"}
            # What is known when the time is over is better than nothing.
            async with publishing(mosquitto, node="leg"):
                await until(lambda: "leg" in skin.nodes)
                assert set(await skin.info(0.1)) == {"main", "arm"}


async def test_without_a_node_info_says_what_to_start(mosquitto: Mosquitto) -> None:
    async with hearing(mosquitto) as skin:
        with pytest.raises(BrokerError, match="is `skin run` running"):
            await skin.info(0.1)


async def test_who_misspells_the_robot_reads_which_there_are(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto), hearing(mosquitto, "robto") as skin:
        for ask in (skin.info(1.0), skin.command("status", timeout_s=PATIENCE_S)):
            with pytest.raises(BrokerError, match=r'no node of robot "robto".*robots: robot$'):
                await ask


async def test_a_node_whose_info_cannot_be_read_is_not_called_absent(mosquitto: Mosquitto) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    async with (
        hearing(mosquitto) as skin,
        aiomqtt.Client(mosquitto.host, mosquitto.port) as node,
    ):
        await node.publish(
            "skin/robot/nodes/main/info", b'{"schema":"skin.info/2"}', 1, retain=True
        )
        await until(lambda: skin.unreadable)
        with pytest.raises(BrokerError) as refused:
            await skin.info(0.1)
        assert 'skin/robot/nodes/main/info: info: schema "skin.info/2"' in str(refused.value)
        async with publishing(mosquitto) as publisher:
            publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
            await until(lambda: skin.info_error == "")


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_command_returns_its_result(mosquitto: Mosquitto, protocol: Any) -> None:
    async with publishing(mosquitto, protocol=protocol):
        async with hearing(mosquitto, protocol=protocol) as skin:
            result = await skin.command("calibrate", seconds=2)
            assert result == {"arguments": {"seconds": 2}}
            both = await asyncio.gather(
                skin.command("a", node="main", x=1), skin.command("b", node="main", x=2)
            )
            assert [one["arguments"]["x"] for one in both] == [1, 2]


async def test_a_command_that_fails_says_why(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto), hearing(mosquitto) as skin:
        with pytest.raises(CommandError, match="no board sent a sweep"):
            await skin.command("fail")
        with pytest.raises(CommandError, match='no answer to "sleep" from node "main"') as failed:
            await skin.command("sleep", node="main", timeout_s=0.2)
        assert "within 0.2 s; it may still be carried out" in str(failed.value)
        with pytest.raises(RequestError, match='it has no node "other"; wanted one of: main'):
            await skin.command("calibrate", node="other", timeout_s=10 * PATIENCE_S)


async def test_a_command_goes_to_a_node_of_which_the_broker_keeps_nothing(
    mosquitto: Mosquitto,
) -> None:
    async with hearing(mosquitto) as skin:
        with pytest.raises(CommandError, match='no answer to "calibrate" from node "main"'):
            await skin.command("calibrate", node="main", timeout_s=1.0)


async def test_a_command_to_a_robot_that_is_not_there_names_those_that_are(
    mosquitto: Mosquitto,
) -> None:
    async with publishing(mosquitto), hearing(mosquitto, robot="robt") as skin:
        there = 'no node of robot "robt" is known; there are the robots: robot'
        with pytest.raises(CommandError, match=there):
            await skin.command("calibrate", node="main", timeout_s=1.0)


@pytest.mark.parametrize(
    ("name", "cause", "status"),
    [("refuse", "request", 2), ("later", "state", 1), ("fail", "failure", 1)],
)
async def test_a_refused_command_shows_whose_the_mistake_is(
    mosquitto: Mosquitto, name: str, cause: str, status: int
) -> None:
    """A wrong request can be caught as any other wrong request of the client."""
    async with publishing(mosquitto), hearing(mosquitto) as skin:
        with pytest.raises(CommandError) as refused:
            await skin.command(name, node="main", timeout_s=PATIENCE_S)
    assert refused.value.cause == cause
    assert refused.value.exit_status == status
    assert isinstance(refused.value, RequestError) == (cause == "request")


async def test_a_command_without_an_answer_has_no_cause_of_the_node(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto), hearing(mosquitto) as skin:
        with pytest.raises(CommandError) as refused:
            await skin.command("sleep", node="main", timeout_s=0.2)
    assert refused.value.cause is None
    assert refused.value.exit_status == 1


async def test_a_request_has_the_clients_own_number(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto), hearing(mosquitto) as skin:
        assert await skin.command("calibrate", node="main", id="mine", timeout_s=PATIENCE_S) == {
            "arguments": {}
        }


@pytest.mark.parametrize("number", [math.nan, math.inf])
async def test_a_number_that_json_does_not_have_is_refused(
    mosquitto: Mosquitto, number: float
) -> None:
    """It would be null in the request, which stands for what is not given."""
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        with pytest.raises(RequestError, match="thresholds: seen nan or inf, wanted numbers"):
            await skin.command("thresholds", node="main", set={"margin_units": number})
        assert publisher.counters.commands_taken == 0


async def test_a_command_to_a_node_that_is_or_goes_offline_is_not_waited_for(
    mosquitto: Mosquitto,
) -> None:
    async with hearing(mosquitto) as skin:
        async with publishing(mosquitto) as publisher:
            asked = asyncio.create_task(
                skin.command("sleep", node="main", timeout_s=10 * PATIENCE_S)
            )
            await until(lambda: publisher.counters.commands_taken == 1)
            publisher._task.cancel()  # type: ignore[union-attr]  # its connection is cut
            with pytest.raises(CommandError, match='node "main" of robot "robot" is offline'):
                await asked
        with pytest.raises(CommandError, match='node "main" of robot "robot" is offline'):
            await skin.command("status", node="main", timeout_s=10 * PATIENCE_S)


async def test_a_command_to_a_node_that_takes_none_is_refused(mosquitto: Mosquitto) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x", commands=False)
    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with Publisher(settings, "robot") as publisher, hearing(mosquitto) as skin:
        publisher.put_info(info)
        await skin.info(PATIENCE_S)
        refusal = r"takes no commands: its configuration has `\[mqtt\] commands = false`"
        with pytest.raises(CommandError, match=refusal):
            await skin.command("status", timeout_s=PATIENCE_S)


async def test_a_command_whose_answer_cannot_come_names_the_broker_that_is_gone(
    mosquitto: Mosquitto,
) -> None:
    async with publishing(mosquitto), hearing(mosquitto) as skin:
        asked = asyncio.create_task(skin.command("sleep", node="main", timeout_s=1.0))
        await until(lambda: skin._requests.waiting)
        mosquitto.kill()
        with pytest.raises(CommandError, match=f"broker 127.0.0.1:{mosquitto.port}: "):
            await asked


@pytest.mark.parametrize("twice", [True, False])
async def test_an_answer_that_comes_twice_or_is_of_another_request_harms_nobody(
    mosquitto: Mosquitto, twice: bool
) -> None:
    async with hearing(mosquitto) as skin:

        async def forge() -> None:
            topic = f"skin/robot/nodes/main/replies/{skin._identifier}"
            head = {"schema": "skin.result/1", "command": "status", "ok": True}
            async with aiomqtt.Client(mosquitto.host, mosquitto.port) as stranger:
                await until(lambda: skin._requests.waiting)
                (number,) = skin._requests.waiting
                for other in ("", f"{number}0", 1, [], None):
                    await stranger.publish(topic, json.encode({**head, "id": other}), qos=1)
                for result in ({"n": 1}, {"n": 2})[: 1 + twice]:
                    answer = {**head, "id": number, "result": result}
                    await stranger.publish(topic, json.encode(answer), qos=1)

        forging = asyncio.create_task(forge())
        assert await skin.command("status", node="main", timeout_s=PATIENCE_S) == {"n": 1}
        await forging
        assert skin.connections == 1


async def test_a_command_to_one_of_two_nodes_names_it(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto), publishing(mosquitto, node="arm"), hearing(mosquitto) as skin:
        with pytest.raises(RequestError, match="arm, main"):
            await skin.command("calibrate")
        assert await skin.command("calibrate", node="arm") == {"arguments": {}}


async def test_the_only_robot_of_a_broker_needs_no_name(mosquitto: Mosquitto) -> None:
    with pytest.raises(BrokerError, match="is `skin run` running"):
        async with hearing(mosquitto, None):
            pass
    async with publishing(mosquitto, "nao"):
        async with hearing(mosquitto, None) as skin:
            assert skin.robot == "nao"
        async with publishing(mosquitto, "icub"):
            with pytest.raises(RequestError, match="icub, nao"):
                async with hearing(mosquitto, None):
                    pass
        # One that has said goodbye is still known to the broker, but not meant.
        async with hearing(mosquitto, None) as skin:
            assert skin.robot == "nao"


async def test_nonsense_on_a_topic_is_counted_and_passed_over(mosquitto: Mosquitto) -> None:
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        touches = skin.touches()
        await skin.ready()
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as stranger:
            for topic in ("palm/touch", "nodes/main/info", "nodes/x/replies/y"):
                await stranger.publish(f"skin/robot/{topic}", b"\xff{", qos=1)
        publisher.put_touch(touch(1, part="arm"))
        assert (await take(touches, 1))[0].part == "arm"
        assert skin.unreadable == 2  # the third was for somebody else


async def test_names_that_no_configuration_has_are_passed_over(
    mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    names = ("N" * 60_000, "<script>", "\u202emlap", "Palm")
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        contacts = skin.contacts()
        await skin.ready()
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as somebody:
            for name in names:
                await somebody.publish(f"skin/robot/{name}/contact", b"ON", qos=1)
                await somebody.publish(f"skin/robot/nodes/{name}/status", b"online", qos=1)
        await until(lambda: skin.unreadable == 2 * len(names))
        publisher.put_contact("palm", "ON")
        assert (await take(contacts, 1))[0].part == "palm"
        assert set(skin.nodes) == {"main"}
    assert len([line for line in caplog.messages if "passed over" in line]) == 1


async def test_what_cannot_be_read_steers_no_terminal(
    mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    async with hearing(mosquitto) as skin:
        touches = skin.touches()
        await skin.ready()
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as stranger:
            payload = json.encode(touch(1, part="\x1b[2J").published(1))
            await stranger.publish("skin/robot/palm/touch", payload, qos=1)
        await until(lambda: skin.unreadable)
        del touches
    (line,) = (line for line in caplog.messages if "passed over" in line)
    assert r'a touch of "\x1b[2J"' in line


async def test_a_bomb_of_properties_stops_no_client(mosquitto: Mosquitto) -> None:
    bomb = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    for _ in range(5000):
        bomb.UserProperty = ("", "")
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        touches = skin.touches()
        await skin.ready()
        async with aiomqtt.Client(
            mosquitto.host, mosquitto.port, protocol=aiomqtt.ProtocolVersion.V5
        ) as stranger:
            await stranger.publish("skin/robot/palm/touch", b"{}", qos=1, properties=bomb)
        publisher.put_touch(touch(1))
        assert (await take(touches, 1))[0].count == 1
        assert skin.unreadable == 0  # it was not even decoded
        assert skin.connections == 1


async def test_without_a_broker_the_error_says_so() -> None:
    with pytest.raises(BrokerError, match="no broker listens there"):
        async with SkinClient(f"mqtt://127.0.0.1:{free_port()}", robot="r", patience_s=0.3):
            pass


async def test_a_broker_without_robots_is_not_taken_for_one_that_does_not_answer(
    mosquitto: Mosquitto,
) -> None:
    with pytest.raises(BrokerError, match="no robot has published"):
        async with hearing(mosquitto, robot=None, patience_s=0.3):
            pass


async def test_a_command_to_a_robot_that_is_not_there_asks_for_no_node(
    mosquitto: Mosquitto,
) -> None:
    async with hearing(mosquitto) as skin:
        with pytest.raises(BrokerError, match='no node of robot "robot" is online; is `skin run`'):
            await skin.command("status")


@pytest.mark.parametrize(
    "url", ["http://x", "localhost", "mqtt://", "mqtt://x:y", "mqtt://u:secret@"]
)
def test_a_wrong_url_is_refused_and_its_password_not_repeated(url: str) -> None:
    with pytest.raises(RequestError) as raised:
        SkinClient(url)
    assert "secret" not in str(raised.value)


async def test_callbacks_hear_the_same_from_a_thread_of_their_own(mosquitto: Mosquitto) -> None:
    heard: list[Any] = []

    def fail_once(contact: Contact) -> None:
        heard.append(contact)
        raise ZeroDivisionError

    def use(sent: threading.Event, ready: threading.Event) -> dict[str, Any]:
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_touch(heard.append, part="palm")
            skin.on_frame(heard.append)
            skin.on_contact(fail_once)
            result = skin.command("calibrate", seconds=1)
            skin.ready()
            ready.set()
            assert sent.wait(PATIENCE_S)
            return result

    async with publishing(mosquitto) as publisher:
        publisher.put_contact("palm", "ON")
        sent, ready = threading.Event(), threading.Event()
        user = asyncio.create_task(asyncio.to_thread(use, sent, ready))
        await asyncio.to_thread(ready.wait, PATIENCE_S)
        publisher.put_touch(touch(1))
        publisher.put_frame(frame(1))
        publisher.put_contact("palm", "OFF")
        await until(lambda: len(heard) == 4)
        sent.set()
        assert (await user) == {"arguments": {"seconds": 1}}
    assert [item for item in heard if isinstance(item, Contact)] == [
        Contact("palm", "ON"),
        Contact("palm", "OFF"),
    ]


async def test_a_callback_that_would_wait_for_messages_is_told_so(mosquitto: Mosquitto) -> None:
    """All other callbacks would wait meanwhile, those that stop a motor, too."""

    def use() -> list[object]:
        told: list[object] = []
        done = threading.Event()

        def ask(_: Touch) -> None:
            told.append([one.id for one in skin.present()])
            status, on_touch = partial(skin.command, "status"), partial(skin.on_touch, print)
            for call in (skin.ready, skin.info, status, on_touch):
                try:
                    call()
                except RequestError as error:
                    told.append(str(error))
            done.set()

        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_touch(ask)
            skin.ready()
            asyncio.run_coroutine_threadsafe(put(), loop).result()
            assert done.wait(PATIENCE_S)
        return told

    async def put() -> None:
        publisher.put_touch(touch(1))

    loop = asyncio.get_running_loop()
    async with publishing(mosquitto) as publisher:
        told = await asyncio.to_thread(use)
    refusal = "a callback cannot wait for messages; ask in another thread"
    assert told == [[1], *4 * [refusal]]


async def test_a_slow_callback_holds_up_no_message_and_another_callback_only_once(
    mosquitto: Mosquitto,
) -> None:
    called: list[Any] = []
    gate, left = threading.Event(), threading.Event()

    def slow(seen: Any) -> None:
        called.append(seen)
        assert gate.wait(PATIENCE_S)

    def use() -> None:
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_frame(slow)
            skin.on_contact(called.append)
            skin.on_touch(print)
            skin.ready()
            for seq in range(1, 6):
                do(lambda seq=seq: publisher.put_frame(frame(seq)))
                done_by = time.monotonic() + PATIENCE_S
                while not called and time.monotonic() < done_by:
                    time.sleep(0.01)
            do(lambda: publisher.put_contact("palm", "ON"))
            do(lambda: publisher.put_touch(touch(1)))
            while not skin.present():  # it is received while the first call lasts
                time.sleep(0.01)
            assert len(called) == 1
            gate.set()
            while not any(isinstance(one, Contact) for one in called):
                time.sleep(0.01)
        left.set()

    def do(what: Callable[[], object]) -> None:
        async def doing() -> None:
            what()

        asyncio.run_coroutine_threadsafe(doing(), loop).result(PATIENCE_S)

    loop = asyncio.get_running_loop()
    async with publishing(mosquitto) as publisher:
        await asyncio.wait_for(asyncio.to_thread(use), PATIENCE_S)
    assert Contact("palm", "ON") in called[:3]


async def test_who_leaves_waits_for_the_callback_that_runs(mosquitto: Mosquitto) -> None:
    called: list[int] = []
    running, leaving = threading.Event(), threading.Event()

    def slow(_: Touch) -> None:
        running.set()
        assert leaving.wait(PATIENCE_S)
        called.append(len(skin.present()))

    def use(ready: threading.Event) -> list[int]:
        nonlocal skin
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_touch(slow)
            skin.ready()
            ready.set()
            assert running.wait(PATIENCE_S)
            threading.Timer(0.1, leaving.set).start()
        return list(called)

    skin: SkinCallbacks
    async with publishing(mosquitto) as publisher:
        ready = threading.Event()
        user = asyncio.create_task(asyncio.to_thread(use, ready))
        await asyncio.to_thread(ready.wait, PATIENCE_S)
        publisher.put_touch(touch(1))
        publisher.put_touch(touch(2))
        assert await user == [1]


@pytest.mark.parametrize("error", [SystemExit, asyncio.CancelledError])
async def test_a_callback_that_ends_its_thread_does_not_silence_the_others(
    mosquitto: Mosquitto, error: type[BaseException], caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[Contact] = []

    def fail(contact: Contact) -> None:
        raise error

    def use(ready: threading.Event, sent: threading.Event) -> None:
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_contact(fail)
            skin.on_contact(seen.append)
            ready.set()
            assert sent.wait(PATIENCE_S)

    async with publishing(mosquitto) as publisher:
        ready, sent = threading.Event(), threading.Event()
        user = asyncio.create_task(asyncio.to_thread(use, ready, sent))
        await asyncio.to_thread(ready.wait, PATIENCE_S)
        for n, state in enumerate(("ON", "OFF"), 1):
            publisher.put_contact("palm", state)
            await until(lambda n=n: len(seen) == n)  # type: ignore[misc]
        sent.set()
        await user
    assert caplog.text.count("a callback failed") >= 2


@pytest.mark.parametrize("name", ["patience_s", "stale_s"])
@pytest.mark.parametrize("seconds", [math.nan, -1.0])
def test_a_time_that_is_none_is_refused(name: str, seconds: float) -> None:
    """Without a number no part would ever be stale."""
    with pytest.raises(RequestError, match=f"{name}: seen {seconds}, wanted seconds from 0 on"):
        SkinClient(robot="robot", **{name: seconds})  # type: ignore[arg-type]


@pytest.mark.parametrize("seconds", [0.0, 0.8, 1.49])
def test_a_part_is_not_called_stale_between_two_records_of_its_health(seconds: float) -> None:
    with pytest.raises(RequestError, match=f"stale_s: seen {seconds}, wanted 1.5 s or more"):
        SkinClient(robot="robot", stale_s=seconds)


@pytest.mark.parametrize(
    ("seconds", "lasts_s"),
    [(12, 12.0), (0.5, 0.5), (-1, 0.0), (math.inf, 0.0), (math.nan, 0.0), ("3", 0.0), (None, 0.0)],
)
async def test_a_command_that_lasts_is_waited_for_that_long(
    mosquitto: Mosquitto, seconds: Any, lasts_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited_s: list[float | None] = []

    class Timeout:
        def __init__(self, seconds: float | None) -> None:
            waited_s.append(seconds)

        async def __aenter__(self) -> None:
            raise TimeoutError

        async def __aexit__(self, *_: object) -> None:
            pass

    assert answer_within_s({"seconds": seconds}) == ANSWER_S + lasts_s
    if isinstance(seconds, float) and not math.isfinite(seconds):
        return
    async with hearing(mosquitto) as skin:
        monkeypatch.setattr(asyncio, "timeout", Timeout)
        with pytest.raises(CommandError, match="no answer"):
            await skin.command("calibrate", seconds=seconds)
        monkeypatch.undo()
    assert waited_s[0] == ANSWER_S + lasts_s


async def test_who_cannot_read_frames_gets_an_error_once_and_the_log_each_reason(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def missing(*_: object) -> None:
        raise SkinError("CBOR frames need the package cbor2")

    async with publishing(mosquitto, encoding="cbor") as publisher, hearing(mosquitto) as skin:
        frames, others, touches = skin.frames("palm"), skin.frames("foot"), skin.touches()
        await skin.ready()
        await stored(mosquitto, touch=b"{not json")
        await until(lambda: skin.unreadable)
        monkeypatch.setattr("skin_host.mqtt.frames._decode_cbor_frame", missing)
        with pytest.raises(SkinError, match="need the package cbor2"):
            async with asyncio.timeout(PATIENCE_S):
                publisher.put_frame(frame(1))
                await anext(frames)
        monkeypatch.undo()
        # It is raised once: who reads on gets what can be read.
        for number in (2, 3):
            publisher.put_frame(frame(number))
        assert (await take(frames, 1))[0].seq > 1
        assert skin.unreadable == 2
        assert others._refusals == touches._refusals == type(others._refusals)()
    assert caplog.text.count("such messages are passed over") == 2
    assert caplog.text.count("need the package cbor2") == 1


@pytest.mark.parametrize("seconds", [math.nan, -1.0])
async def test_no_time_to_wait_is_refused(mosquitto: Mosquitto, seconds: float) -> None:
    async with hearing(mosquitto) as skin:
        for asked in (skin.info(seconds), skin.command("status", timeout_s=seconds)):
            with pytest.raises(RequestError, match=f"timeout_s: seen {seconds}, wanted seconds"):
                await asked


def test_callbacks_raise_what_entering_raises() -> None:
    with pytest.raises(BrokerError):
        with SkinCallbacks(f"mqtt://127.0.0.1:{free_port()}", robot="r", patience_s=0.2):
            pass


async def test_who_meets_silence_is_told_of_the_older_protocol() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:  # connections are made and never read
        url = f"mqtt://127.0.0.1:{deaf.getsockname()[1]}"
        with pytest.raises(BrokerError, match=r"end its URL with \?protocol=3\.1\.1"):
            async with SkinClient(url, robot="robot", patience_s=3.5):
                pass
