"""What a node published before it died, of parts that its next start does not have."""

from contextlib import suppress
from typing import Any

import aiomqtt
import pytest
from msgspec.structs import replace

from skin_host.config.settings import Mqtt
from skin_host.mqtt.publisher import Publisher
from tests.mqtt.test_publisher import listening, settings
from tests.support.broker import Mosquitto
from tests.support.waiting import until
from tests.viewer import test_picture as pages

PREFIX = "homeassistant"
BOTH = replace(pages.info({"palm": 3, "thumb": 3}), robot="robot")
PALM = replace(pages.info({"palm": 3}), robot="robot")


async def stored(broker: Mosquitto) -> dict[str, Any]:
    """What somebody finds who comes now."""
    async with listening(broker, "#") as seen:
        await until(lambda: seen.payloads("/status"))
        async with aiomqtt.Client(broker.host, broker.port) as client:
            await client.publish("marker", b"x", qos=1)
        await until(lambda: seen.payloads("marker"))
        return {m.topic.value: m.payload for m in seen.messages if m.retain}


async def lives(keys: Mqtt, broker: Mosquitto) -> None:
    """A node with two parts publishes that nothing touches them, and dies."""
    with suppress(ConnectionError):
        async with Publisher(keys, "robot") as publisher:
            publisher.put_info(BOTH)
            for part in BOTH.parts:
                publisher.put_contact(part, "OFF")
                publisher.put_health(part, {"state": "ok"})
            await until(lambda: publisher.counters.retained_sent >= 6)
            await publisher._outbox.drained()
            assert publisher._connection is not None
            publisher._closing.set()  # it does not come back
            publisher._connection.cut()
            raise ConnectionError


@pytest.mark.parametrize("elsewhere", [(), ("thumb",)])
async def test_a_part_that_is_no_longer_configured_is_not_left_untouched(
    mosquitto: Mosquitto, elsewhere: tuple[str, ...]
) -> None:
    keys = settings(mosquitto, discovery_prefix=PREFIX)
    await lives(keys, mosquitto)
    before = await stored(mosquitto)
    assert before["skin/robot/nodes/main/status"] == b"offline"
    assert before["skin/robot/thumb/contact"] == b"OFF"
    async with Publisher(keys, "robot") as publisher:
        publisher.put_info(PALM, elsewhere)
        publisher.put_contact("palm", "UNKNOWN")
        async with listening(mosquitto, "skin/robot/thumb/contact") as seen:
            await until(lambda: seen.payloads("contact")[-1:] == [b"UNKNOWN"])
            await publisher._outbox.drained()
            await until(lambda: not publisher._left)
        after = await stored(mosquitto)
    assert after["skin/robot/nodes/main/status"] == b"online"
    # What another node of the configuration publishes stays.
    of_thumb = {topic for topic in after if "thumb" in topic}
    assert ("skin/robot/thumb/health" in of_thumb) == bool(elsewhere)
    assert len([topic for topic in of_thumb if topic.startswith(PREFIX)]) == 2 * len(elsewhere)
    assert len([topic for topic in after if topic.startswith(PREFIX)]) == 2 + 2 * len(elsewhere)


async def test_nobody_makes_a_node_take_back_parts_for_ever(mosquitto: Mosquitto) -> None:
    async with listening(mosquitto, "skin/robot/other/contact") as seen:
        async with Publisher(settings(mosquitto), "robot") as publisher:
            publisher.put_info(PALM)
            await until(lambda: publisher.counters.connected)
            properties = publisher._state_properties("other", b"")
            assert properties is not None
            properties.UserProperty = ("parts", "other,a/b,+,#," + "x" * 65)
            async with aiomqtt.Client(
                mosquitto.host, mosquitto.port, protocol=aiomqtt.ProtocolVersion.V5
            ) as stranger:
                for _ in range(20):
                    await stranger.publish(
                        "skin/robot/nodes/main/status",
                        b"online",
                        qos=1,
                        retain=True,
                        properties=properties,
                    )
                await stranger.publish("skin/robot/other/contact", b"marker", qos=1)
            await until(lambda: b"marker" in seen.payloads("contact"))
            assert set(publisher._left) <= {"other"}
            assert len(seen.payloads("contact")) <= 2
