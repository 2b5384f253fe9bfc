"""Everything that is put reaches a real broker, through all that can happen to it."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import aiomqtt
import numpy as np
import pytest
from msgspec import json
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from skin_host.clock import Clock
from skin_host.config.settings import Mqtt
from skin_host.errors import ConfigurationError, RequestError
from skin_host.mqtt.order import Stamp
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from tests.support.broker import Mosquitto, free_port
from tests.support.said import touch_event
from tests.support.waiting import PATIENCE_S, until

STATUS = "skin/robot/nodes/main/status"
#: What a node listens to; it has subscribed to all else by then.
COMMANDS = "skin/robot/nodes/main/cmd/+"


def frame(seq: int, t_ns: int = 0, part: str = "palm") -> PressureFrame:
    m = 12
    mask = np.zeros(m, np.bool_)
    pressure = np.full(m, 1.5, np.float32)
    return PressureFrame(part, seq, t_ns, np.zeros(m, np.uint8), pressure, mask, ~mask, mask)


def touch(number: int, event: Any = "begin", part: str = "palm") -> Touch:
    return touch_event(
        event, number, number, number, part, [1], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 1, 2.0, 2.0, 0.1
    )


@dataclass
class Listener:
    """Another program on the broker; it comes back by itself when the broker does."""

    broker: Mosquitto
    topic: str = "skin/#"
    messages: list[aiomqtt.Message] = field(default_factory=list)
    ready: asyncio.Event = field(default_factory=asyncio.Event)

    def payloads(self, end: str) -> list[Any]:
        return [m.payload for m in self.messages if m.topic.value.endswith(end)]

    def touches(self) -> list[int]:
        return [json.decode(payload)["count"] for payload in self.payloads("/touch")]

    async def listen(self) -> None:
        while True:
            try:
                async with aiomqtt.Client(
                    self.broker.host, self.broker.port, protocol=aiomqtt.ProtocolVersion.V5
                ) as client:
                    await client.subscribe(self.topic, qos=1)
                    self.ready.set()
                    async for message in client.messages:
                        self.messages.append(message)
            except aiomqtt.MqttError:
                self.ready.clear()
                await asyncio.sleep(0.02)


@asynccontextmanager
async def listening(broker: Mosquitto, topic: str = "skin/#") -> AsyncIterator[Listener]:
    listener = Listener(broker, topic)
    task = asyncio.create_task(listener.listen())
    await asyncio.wait_for(listener.ready.wait(), PATIENCE_S)
    yield listener
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def settings(broker: Mosquitto, **keys: Any) -> Mqtt:
    return Mqtt(host=broker.host, port=broker.port, **keys)


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_everything_put_arrives_as_the_contract_says(
    mosquitto: Mosquitto, protocol: str
) -> None:
    async with listening(mosquitto) as seen:
        async with Publisher(settings(mosquitto, protocol=protocol), "robot") as publisher:
            await until(lambda: publisher.counters.connected)
            publisher.put_frame(frame(1))
            publisher.put_touch(touch(1))
            publisher.put_contact("palm", "ON")
            publisher.put_health("palm", {"rate_hz": 20.0})
            await until(lambda: len(seen.messages) == 5)
        await until(lambda: seen.payloads("status") == [b"online", b"offline"])
    assert seen.payloads("contact") == [b"ON"]
    assert json.decode(seen.payloads("frame")[0])["values"] == [150] * 12
    assert json.decode(seen.payloads("health")[0])["rate_hz"] == 20.0
    by_topic = {message.topic.value: message for message in seen.messages}
    assert by_topic["skin/robot/palm/touch"].qos == 1
    assert by_topic["skin/robot/palm/frame"].qos == 0
    if protocol == "5":
        properties = by_topic["skin/robot/palm/frame"].properties
        assert properties.ContentType == "application/json"
        assert properties.MessageExpiryInterval == 1


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("skin", "a", "b-c"), ("skin", "a-b", "c")),
        (("hall1", "r", "main"), ("hall2", "r", "main")),
    ],
)
async def test_nodes_of_two_robots_never_have_one_name_at_the_broker(
    mosquitto: Mosquitto, one: tuple[str, str, str], other: tuple[str, str, str]
) -> None:
    """The broker would end the connection of each when the other one comes."""

    def node(base: str, robot: str, name: str) -> Publisher:
        return Publisher(settings(mosquitto, base=base), robot, name)

    async with node(*one) as first:
        await until(lambda: first.counters.connected)
        async with node(*other) as second:
            await until(lambda: second.counters.connected)
            for publisher in (first, second):
                publisher.put_contact("palm", "ON")
            async with listening(mosquitto, "#") as seen:
                await until(lambda: len(seen.payloads("/palm/contact")) == 2)
            assert first.counters.connections == second.counters.connections == 1
    assert "already connected" not in mosquitto.log


async def test_frames_have_the_boards_bytes_for_as_long_as_they_are_asked_for(
    mosquitto: Mosquitto,
) -> None:
    async with listening(mosquitto, "skin/+/palm/frame") as seen:
        async with Publisher(settings(mosquitto), "robot") as publisher:
            await until(lambda: publisher.counters.connected)
            for number, seconds in enumerate((0.0, 3600.0, 0.0)):
                publisher.show_raw(seconds)
                publisher.put_frame(frame(number))
                await until(lambda sent=number + 1: len(seen.messages) == sent)  # type: ignore[misc]
    assert ["raw" in json.decode(one) for one in seen.payloads("frame")] == [False, True, False]


async def test_frames_tell_their_run_also_when_it_changes_within_a_connection(
    mosquitto: Mosquitto,
) -> None:
    async with listening(mosquitto, "skin/+/palm/frame") as seen:
        async with Publisher(settings(mosquitto), "robot") as publisher:
            await until(lambda: publisher.counters.connected)
            publisher.put_frame(frame(1))
            await until(lambda: len(seen.messages) == 1)
            assert publisher._numbers.overtake(Stamp(2_000_000_000_000_000_000, 0))
            publisher._number_messages()
            publisher.put_frame(frame(2))
            await until(lambda: len(seen.messages) == 2)
    runs = [int(dict(message.properties.UserProperty)["run"]) for message in seen.messages]
    assert runs[0] < 2_000_000_000_000_000_000 < runs[1]


async def test_touches_that_waited_belong_to_the_newest_run_after_a_start_with_a_clock_set_back(
    mosquitto: Mosquitto,
) -> None:
    """A subscriber that follows the run before would pass over those of an earlier number."""
    earlier = 2_000_000_000_000_000_000
    async with Publisher(settings(mosquitto), "robot") as publisher:
        publisher._numbers.overtake(Stamp(earlier, 0))
        await until(lambda: publisher.counters.connected)
    async with listening(mosquitto, "skin/+/palm/touch") as seen:
        async with Publisher(settings(mosquitto), "robot") as publisher:
            for number in range(1, 31):
                publisher.put_touch(touch(number))
            await until(lambda: publisher.counters.connections == 2)
            await until(lambda: publisher.counters.touches_sent == 30)
            await until(lambda: seen.touches()[-1:] == [30])
    runs = [int(dict(message.properties.UserProperty)["run"]) for message in seen.messages]
    newest = [json.decode(message.payload)["count"] for message in seen.messages[-30:]]
    assert newest == [*range(1, 31)]
    assert len({*runs[-30:]}) == 1
    assert runs[-1] > earlier > max(runs[:-30], default=0)


async def test_frames_and_touches_are_not_retained_the_rest_is(mosquitto: Mosquitto) -> None:
    async with Publisher(settings(mosquitto), "robot") as publisher:
        await until(lambda: publisher.counters.connected)
        publisher.put_frame(frame(1))
        publisher.put_touch(touch(1))
        publisher.put_contact("palm", "OFF")
        publisher.put_health("palm", {})
        await until(lambda: publisher.counters.retained_sent >= 3)
        await until(lambda: publisher.counters.frames_sent and publisher.counters.touches_sent)
        async with listening(mosquitto) as late:
            await until(lambda: len(late.messages) == 3)
        assert {message.topic.value for message in late.messages} == {
            STATUS,
            "skin/robot/palm/contact",
            "skin/robot/palm/health",
        }


async def test_a_frame_in_cbor_says_its_type(mosquitto: Mosquitto) -> None:
    async with listening(mosquitto, "skin/robot/palm/frame") as seen:
        async with Publisher(settings(mosquitto, encoding="cbor"), "robot") as publisher:
            await until(lambda: publisher.counters.connected)
            publisher.put_frame(frame(1))
            await until(lambda: seen.messages)
    assert seen.messages[0].properties.ContentType == "application/cbor"
    assert seen.messages[0].properties.PayloadFormatIndicator == 0


async def test_of_frames_that_come_faster_than_they_go_only_the_newest_is_sent(
    mosquitto: Mosquitto,
) -> None:
    async with listening(mosquitto, "skin/+/+/frame") as seen:
        async with Publisher(settings(mosquitto), "robot") as publisher:
            await until(lambda: publisher.counters.connected)
            for seq in range(10):
                publisher.put_frame(frame(seq))
                publisher.put_frame(frame(seq, part="arm"))
            await until(lambda: len(seen.messages) == 2)
            assert publisher.counters.frames_skipped == 18
    assert [json.decode(message.payload)["seq"] for message in seen.messages] == [9, 9]


async def test_frames_are_thinned_to_the_rate_that_is_set(mosquitto: Mosquitto) -> None:
    async with Publisher(settings(mosquitto, frame_hz=10.0), "robot") as publisher:
        await until(lambda: publisher.counters.connected)
        for seq in range(100):  # two seconds at 50 Hz, each a little off its time
            publisher.put_frame(frame(seq, t_ns=seq * 20_000_000 + (seq % 3) * 1_000_000))
            await asyncio.sleep(0.002)
        await until(
            lambda: publisher.counters.frames_sent + publisher.counters.frames_skipped >= 20
        )
        counters = publisher.counters
    assert counters.frames_sent + counters.frames_skipped == 20


async def test_thinning_survives_a_clock_that_is_set_back(mosquitto: Mosquitto) -> None:
    async with Publisher(settings(mosquitto, frame_hz=10.0), "robot") as publisher:
        await until(lambda: publisher.counters.connected)
        for t_ns in (10**15, 10**9, 2 * 10**9):
            publisher.put_frame(frame(0, t_ns))
        assert publisher.counters.frames_skipped == 2


async def test_a_contact_that_did_not_change_is_not_said_again(mosquitto: Mosquitto) -> None:
    async with listening(mosquitto, "skin/+/+/contact") as seen:
        async with Publisher(settings(mosquitto), "robot") as publisher:
            await until(lambda: publisher.counters.connected)
            for state in ("ON", "ON", "OFF", "OFF", "UNKNOWN", "ON"):
                publisher.put_contact("palm", state)
                sent = publisher.counters.retained_sent
                await asyncio.sleep(0.05)
            await until(lambda: publisher.counters.retained_sent >= sent)
    assert [message.payload for message in seen.messages] == [b"ON", b"OFF", b"UNKNOWN", b"ON"]


async def test_a_contact_is_published_again_with_health_now_and_then(mosquitto: Mosquitto) -> None:
    """A node that had the part before, and starts or ends later, publishes that it is unknown."""
    clock = Clock()
    now_s = 1000.0
    clock.monotonic_s = lambda: now_s
    async with listening(mosquitto, "skin/+/+/contact") as seen:
        async with Publisher(settings(mosquitto), "robot", clock=clock) as publisher:
            await until(lambda: publisher.counters.connected)
            publisher.put_health("palm", {})
            publisher.put_contact("palm", "OFF")
            await until(lambda: seen.payloads("contact") == [b"OFF"])
            async with aiomqtt.Client(mosquitto.host, mosquitto.port) as former:
                await former.publish("skin/robot/palm/contact", b"UNKNOWN", qos=1, retain=True)
            await until(lambda: seen.payloads("contact") == [b"OFF", b"UNKNOWN"])
            for second in range(1, 8):
                now_s = 1000.0 + second
                publisher.put_health("palm", {"age_ms": second})
                publisher.put_contact("palm", "OFF")
                await publisher._outbox.drained()
            await until(lambda: len(seen.payloads("contact")) == 5)
            publisher.put_contact("palm", "ON")  # a change comes at once
            await until(lambda: len(seen.payloads("contact")) == 6)
    assert seen.payloads("contact")[2:] == [b"OFF", b"OFF", b"OFF", b"ON"]


async def test_a_broker_that_comes_late_gets_what_still_matters(
    mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    mosquitto.kill()
    async with Publisher(settings(mosquitto), "robot") as publisher:
        publisher.put_frame(frame(1))
        publisher.put_touch(touch(1))
        publisher.put_touch(touch(1, "end"))
        publisher.put_contact("palm", "ON")
        publisher.put_contact("palm", "OFF")
        await until(lambda: publisher.counters.last_error)
        mosquitto.start()
        await until(lambda: publisher.counters.touches_sent == 2)
        async with listening(mosquitto) as seen:
            await until(lambda: seen.payloads("contact"))
        assert seen.payloads("contact") == [b"OFF"]
        assert publisher.counters.frames_sent == 0
        assert publisher.counters.frames_skipped == 1
    lost = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert len(lost) == 1
    assert "no broker listens there" in lost[0].getMessage()


async def test_a_killed_broker_gets_every_touch_and_all_that_is_retained_again(
    mosquitto: Mosquitto,
) -> None:
    async with Publisher(settings(mosquitto), "robot") as publisher:
        async with listening(mosquitto) as seen:
            publisher.put_contact("palm", "ON")
            publisher.put_health("palm", {"rate_hz": 1.0})
            number = 0
            for _ in range(3):
                for _ in range(20):
                    number += 1
                    publisher.put_touch(touch(number))
                    await asyncio.sleep(0.001)
                await until(lambda: publisher.counters.touches_waiting == 0)
                await until(lambda n=number: n in seen.touches())
                mosquitto.restart()
                seen.messages.clear()
                await until(lambda: seen.payloads("health"))
                assert {*seen.payloads("contact")} == {b"ON"}
                assert b"online" in seen.payloads("status")
            assert publisher.counters.touches_sent == 60
            assert publisher.counters.touches_dropped == 0


async def test_touches_in_flight_when_the_broker_freezes_arrive_in_order(
    mosquitto: Mosquitto,
) -> None:
    async with Publisher(settings(mosquitto), "robot") as publisher:
        async with listening(mosquitto) as seen:
            await until(lambda: publisher.counters.connected)
            mosquitto.freeze()
            for number in range(1, 31):
                publisher.put_touch(touch(number))
            publisher.put_frame(frame(1))
            await until(lambda: not publisher.counters.connected)
            mosquitto.resume()
            await until(lambda: publisher.counters.touches_sent == 30)
            await until(lambda: 30 in seen.touches())
            # Some come twice (QoS 1), but none before one that is older and new.
            first_seen = list(dict.fromkeys(seen.touches()))
            assert first_seen == list(range(1, 31))
            await until(lambda: seen.payloads("status")[-1:] == [b"online"])


async def test_a_full_queue_loses_moves_first_and_counts_what_it_loses(
    caplog: pytest.LogCaptureFixture,
) -> None:
    nobody = Mqtt(host="127.0.0.1", port=free_port(), event_queue=16)
    async with Publisher(nobody, "robot", drain_s=0.0) as publisher:
        for number in range(1, 13):
            publisher.put_touch(touch(number, "move"))
        assert publisher.counters.touches_waiting == 8
        assert publisher.counters.touches_dropped == 4
        for number in range(13, 23):
            publisher.put_touch(touch(number, "end"))
        assert publisher.counters.touches_waiting == 16
        assert publisher.counters.touches_dropped == 6
    assert publisher.counters.touches_dropped == 22
    assert sum("touch events are lost" in record.getMessage() for record in caplog.records) == 1


async def test_a_subscriber_can_tell_that_events_were_lost(mosquitto: Mosquitto) -> None:
    publisher = Publisher(settings(mosquitto, event_queue=16), "robot")
    for number in range(1, 13):
        publisher.put_touch(touch(number, "move"))
    publisher.put_touch(touch(1, "end"))
    async with listening(mosquitto) as seen, publisher:
        await until(lambda: len(seen.touches()) == 9)
    assert seen.touches() == [1, 2, 3, 4, 5, 6, 7, 8, 13]


async def test_stopping_sends_what_waits_and_says_offline(mosquitto: Mosquitto) -> None:
    async with listening(mosquitto) as seen:
        async with Publisher(settings(mosquitto), "robot", drain_s=60) as publisher:
            await until(lambda: publisher.counters.connected)
            for number in range(200):
                publisher.put_touch(touch(number))
        await until(lambda: seen.payloads("status")[-1:] == [b"offline"])
    assert seen.touches() == list(range(1, 201))


async def test_stopping_sends_what_waits_though_the_connection_is_lost_meanwhile(
    mosquitto: Mosquitto,
) -> None:
    async with listening(mosquitto) as seen:
        publisher = Publisher(settings(mosquitto), "robot", drain_s=PATIENCE_S)
        await publisher.__aenter__()
        await until(lambda: publisher.counters.connected)
        for number in range(200):
            publisher.put_touch(touch(number))
        stopping = asyncio.create_task(publisher.__aexit__())
        await until(publisher._closing.is_set)
        assert publisher._connection is not None
        publisher._connection.cut()
        await stopping
        await until(lambda: seen.payloads("status")[-1:] == [b"offline"])
    assert sorted(set(seen.touches())) == list(range(1, 201))
    assert publisher.counters.connections == 2


@pytest.mark.parametrize("state", ["absent", "frozen"])
async def test_stopping_does_not_wait_for_a_broker_that_does_not_answer(
    mosquitto: Mosquitto, state: str
) -> None:
    publisher = Publisher(settings(mosquitto), "robot", drain_s=0.2)
    async with asyncio.timeout(PATIENCE_S):
        async with publisher:
            await until(lambda: publisher.counters.connected)
            if state == "frozen":
                mosquitto.freeze()
            else:
                mosquitto.kill()
            publisher.put_touch(touch(1))
    assert publisher.counters.touches_dropped == 1


async def test_the_last_will_of_a_daemon_that_dies_says_offline(mosquitto: Mosquitto) -> None:
    async with listening(mosquitto, STATUS) as seen:
        publisher = Publisher(settings(mosquitto), "robot")
        await publisher.__aenter__()
        await until(lambda: b"online" in [m.payload for m in seen.messages])
        publisher._task.cancel()  # type: ignore[union-attr]  # dies without a word
        await until(lambda: seen.messages[-1].payload == b"offline")


async def test_a_late_offline_is_contradicted_while_the_daemon_lives(mosquitto: Mosquitto) -> None:
    async with listening(mosquitto, STATUS) as seen:
        async with Publisher(settings(mosquitto), "robot"):
            await until(lambda: seen.messages)
            async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
                await client.publish(STATUS, "offline", qos=1, retain=True)
                await until(
                    lambda: [m.payload for m in seen.messages][-2:] == [b"offline", b"online"]
                )


async def answer(name: str, payload: bytes) -> dict[str, Any]:
    if name == "fail":
        raise ZeroDivisionError("secret detail")
    if name == "refuse":
        raise RequestError("not now: a calibration is running")
    return {"name": name, "seen": json.decode(payload or b"{}")}


async def request(
    client: aiomqtt.Client, name: str, payload: bytes, reply: str | None = None, **keys: Any
) -> None:
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    if reply is not None:
        properties.ResponseTopic = reply
        properties.CorrelationData = b"42"
    await client.publish(
        f"skin/robot/nodes/main/cmd/{name}", payload, qos=1, properties=properties, **keys
    )


@asynccontextmanager
async def asking(broker: Mosquitto) -> AsyncIterator[tuple[aiomqtt.Client, Listener]]:
    async with listening(broker, "#") as seen:
        async with Publisher(settings(broker), "robot", handler=answer):
            async with aiomqtt.Client(
                broker.host, broker.port, protocol=aiomqtt.ProtocolVersion.V5
            ) as client:
                await until(lambda: broker.subscriptions(COMMANDS))
                yield client, seen


async def test_a_command_is_answered_where_the_request_says(mosquitto: Mosquitto) -> None:
    reply = "skin/robot/nodes/main/replies/me"
    async with asking(mosquitto) as (client, seen):
        await request(client, "calibrate", b'{"seconds":2,"id":"a"}', reply)
        await until(lambda: seen.payloads("replies/me"))
    message = next(m for m in seen.messages if m.topic.value == reply)
    assert message.properties.CorrelationData == b"42"
    assert json.decode(message.payload) == {
        "schema": "skin.result/1",
        "command": "calibrate",
        "ok": True,
        "id": "a",
        "result": {"name": "calibrate", "seen": {"seconds": 2, "id": "a"}},
    }


@pytest.mark.parametrize(
    "reply",
    [
        None,
        "skin/robot/palm/touch",
        "skin/robot/nodes/main/info",
        "elsewhere",
        "/" * 201,  # a broker ends the connection of whoever answers there
    ],
)
async def test_a_command_without_a_fit_reply_topic_is_answered_beside_it(
    mosquitto: Mosquitto, reply: str | None
) -> None:
    async with asking(mosquitto) as (client, seen):
        await request(client, "scan", b"", reply)
        await until(lambda: seen.payloads("cmd/scan/result"))
    assert json.decode(seen.payloads("cmd/scan/result")[0])["result"]["seen"] == {}
    assert not seen.payloads("/touch") + seen.payloads("/info")
    assert seen.payloads("/status").count(b"online") == 1


@pytest.mark.parametrize(
    ("name", "payload", "error"),
    [
        ("refuse", b"{}", "not now: a calibration is running"),
        ("fail", b"{}", "failed: ZeroDivisionError; see the log"),
        ("scan", b"{", "the request is not a JSON object"),
        ("scan", b"[]", "the request is not a JSON object"),
        ("scan", b"[" * 10_000, "the request is not a JSON object"),
        ("scan", b" " * 70_000, "the request has 70000 bytes"),
        ("Scan it", b"{}", "a command's name"),
        # With it the topic is as long as one may be.
        pytest.param("a" * 65_509, b"{}", "a command's name", id="longest"),
    ],
)
async def test_a_refused_command_says_why(
    mosquitto: Mosquitto, name: str, payload: bytes, error: str
) -> None:
    async with asking(mosquitto) as (client, seen):
        await request(client, name, payload)
        await until(lambda: seen.payloads("/result"))
    result = json.decode(seen.payloads("/result")[0])
    assert result["ok"] is False
    assert result["error"].startswith(error)


async def test_a_flood_of_commands_is_cut_and_counted(mosquitto: Mosquitto) -> None:
    async with Publisher(settings(mosquitto), "robot", handler=answer) as publisher:
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
            await until(lambda: mosquitto.subscriptions(COMMANDS))
            for _ in range(300):
                await client.publish("skin/robot/nodes/main/cmd/scan", "{}", qos=0)
            await until(
                lambda: (
                    publisher.counters.commands_taken + publisher.counters.commands_refused == 300
                )
            )
            assert publisher.counters.commands_taken < 60
            assert publisher.counters.connected


async def test_a_retained_command_is_not_obeyed(mosquitto: Mosquitto) -> None:
    async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
        await client.publish("skin/robot/nodes/main/cmd/scan", "{}", qos=1, retain=True)
    for nth, protocol in enumerate(("5", "3.1.1"), start=1):
        keys = settings(mosquitto, protocol=protocol)
        async with Publisher(keys, "robot", handler=answer) as publisher:
            await until(lambda nth=nth: mosquitto.subscriptions(COMMANDS) == nth)
            await asyncio.sleep(0.2)
            assert publisher.counters.commands_taken == 0


async def test_a_retained_command_that_comes_while_the_node_is_online_is_counted_not_obeyed(
    mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    async with Publisher(settings(mosquitto), "robot", handler=answer) as publisher:
        await until(lambda: mosquitto.subscriptions(COMMANDS))
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
            for payload in ("{}", "{}", ""):  # the last one clears it
                await client.publish("skin/robot/nodes/main/cmd/scan", payload, qos=1, retain=True)
        await until(lambda: publisher.counters.commands_refused == 3)
        assert publisher.counters.commands_taken == 0
    said = [r.getMessage() for r in caplog.records if "is ignored" in r.getMessage()]
    assert len(said) == 1
    assert "mosquitto_pub -r -n -t skin/robot/nodes/main/cmd/scan" in said[0]


async def test_a_bomb_of_properties_is_counted_and_stops_nobody(mosquitto: Mosquitto) -> None:
    bomb = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    for _ in range(2000):
        bomb.UserProperty = ("", "")
    async with asking(mosquitto) as (client, seen):
        commands = "skin/robot/nodes/main/cmd/scan"
        await client.publish(commands, "{}", qos=1, properties=bomb)
        await request(client, "scan", b"{}")
        await until(lambda: seen.payloads("cmd/scan/result"))
    assert seen.payloads("/status").count(b"online") == 1
    assert len(seen.payloads("cmd/scan/result")) == 1


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_request_larger_than_any_is_passed_over(
    mosquitto: Mosquitto, protocol: str
) -> None:
    keys = settings(mosquitto, protocol=protocol)
    async with Publisher(keys, "robot", handler=answer) as publisher:
        await until(lambda: mosquitto.subscriptions(COMMANDS))
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
            topic = "skin/robot/nodes/main/cmd/scan"
            for _ in range(3):
                await client.publish(topic, b" " * 5_000_000, qos=1)
            await client.publish(topic, b"{}", qos=1)
        await until(lambda: publisher.counters.commands_taken == 1)
        assert publisher.counters.connections == 1


async def test_with_commands_off_none_is_taken(mosquitto: Mosquitto) -> None:
    keys = settings(mosquitto, commands=False)
    async with Publisher(keys, "robot", handler=answer) as publisher:
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as client:
            await until(lambda: publisher.counters.connected)
            await client.publish("skin/robot/nodes/main/cmd/scan", "{}", qos=1)
            await asyncio.sleep(0.1)
        assert publisher.counters.commands_taken == 0


async def test_names_that_cannot_stand_in_a_topic_are_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"mqtt\.base"):
        Publisher(Mqtt(base="skin/#"), "robot")
