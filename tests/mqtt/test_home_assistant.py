"""What Home Assistant is told is what its documentation says, and true."""

import asyncio
import json
from pathlib import Path
from typing import Any

import jinja2
import msgspec
import pytest

from skin_host.config.settings import Mqtt, load
from skin_host.layout import build_layout
from skin_host.mqtt.info import (
    EXPIRE_S,
    FingertipInfo,
    NodeInfo,
    discovery,
    discovery_topics,
    node_info,
)
from skin_host.mqtt.publisher import CONTACT_AGAIN_S, Publisher
from skin_host.mqtt.topics import Topics
from tests.support.broker import Mosquitto
from tests.support.subscriber import Subscriber


def words(text: str) -> set[str]:
    return set(text.split())


CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
#: Keys of a binary sensor, and of its tables, in the documentation of Home Assistant's
#: integrations `mqtt` and `binary_sensor.mqtt`.
DOCUMENTED = {
    "": words(
        "availability availability_mode availability_template availability_topic device "
        "device_class enabled_by_default encoding entity_category entity_picture expire_after "
        "force_update icon json_attributes_template json_attributes_topic name object_id "
        "off_delay origin payload_available payload_not_available payload_off payload_on platform "
        "qos state_topic unique_id value_template"
    ),
    "availability": {"payload_available", "payload_not_available", "topic", "value_template"},
    "device": words(
        "configuration_url connections hw_version identifiers manufacturer model model_id name "
        "serial_number suggested_area sw_version via_device"
    ),
    "origin": {"name", "sw_version", "support_url"},
}


@pytest.fixture(scope="module")
def info() -> NodeInfo:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    return node_info(layout, "main", version="0.1.0", configuration="x")


@pytest.fixture
def told(info: NodeInfo) -> dict[str, Any]:
    found = discovery("homeassistant", Topics("skin", "demo"), info)
    return {topic: json.loads(payload) for topic, payload in found.items()}


def test_a_contact_is_announced_as_documented(told: dict[str, Any]) -> None:
    assert told["homeassistant/binary_sensor/skin_demo_left_hand_contact_2c51d961/config"] == {
        "unique_id": "skin_demo_left_hand_contact_2c51d961",
        "name": "left_hand contact",
        "icon": "mdi:gesture-tap",
        "state_topic": "skin/demo/left_hand/contact",
        "value_template": "{{ 'None' if value == 'UNKNOWN' else value }}",
        "expire_after": 10,
        "qos": 1,
        "availability": [
            {"topic": "skin/demo/nodes/main/status"},
            {
                "topic": "skin/demo/left_hand/health",
                "value_template": "{{ 'online' if value_json.state in "
                "('ok', 'warning', 'degraded', 'saturated') else 'offline' }}",
            },
        ],
        "availability_mode": "all",
        "device": {
            "identifiers": ["skin_demo_nodes_main_status_3da716ba"],
            "name": "demo skin, node main",
            "sw_version": "0.1.0",
        },
        "origin": {"name": "skin-host", "sw_version": "0.1.0"},
    }


def test_what_lives_does_not_expire() -> None:
    """Health comes once a second, the contact state with it now and then; both may be late."""
    assert EXPIRE_S > 3 * CONTACT_AGAIN_S


def test_a_problem_is_announced_as_documented(told: dict[str, Any]) -> None:
    assert told["homeassistant/binary_sensor/skin_demo_left_forearm_health_4147dd2f/config"] == {
        "unique_id": "skin_demo_left_forearm_health_4147dd2f",
        "name": "left_forearm problem",
        "device_class": "problem",
        "entity_category": "diagnostic",
        "state_topic": "skin/demo/left_forearm/health",
        "value_template": "{{ 'OFF' if value_json.state == 'ok' else 'ON' }}",
        "json_attributes_topic": "skin/demo/left_forearm/health",
        "json_attributes_template": "{{ {'state': value_json.state, "
        "'sentences': value_json.sentences} | tojson }}",
        "expire_after": 10,
        "qos": 1,
        "availability": [{"topic": "skin/demo/nodes/main/status"}],
        "device": {
            "identifiers": ["skin_demo_nodes_main_status_3da716ba"],
            "name": "demo skin, node main",
            "sw_version": "0.1.0",
        },
        "origin": {"name": "skin-host", "sw_version": "0.1.0"},
    }


def test_every_part_is_announced_with_both(told: dict[str, Any]) -> None:
    assert len(told) == 4


def test_every_key_is_one_of_the_documentation(told: dict[str, Any]) -> None:
    for payload in told.values():
        assert set(payload) <= DOCUMENTED[""]
        assert set(payload["device"]) <= DOCUMENTED["device"]
        assert set(payload["origin"]) <= DOCUMENTED["origin"]
        for topic in payload["availability"]:
            assert set(topic) <= DOCUMENTED["availability"]


def test_a_base_of_several_words_makes_a_topic_of_one(info: NodeInfo) -> None:
    found = discovery("ha/x", Topics("lab 2/skin", "demo"), info)
    topic = "ha/x/binary_sensor/lab_2_skin_demo_left_hand_contact_00e5b00d/config"
    assert json.loads(found[topic])["state_topic"] == "lab 2/skin/demo/left_hand/contact"


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("skin", "arm", "left_hand"), ("skin", "arm_left", "hand")),
        (("lab/x", "arm", "hand"), ("lab_x", "arm", "hand")),
        (("skin", "arm 1", "hand"), ("skin", "arm_1", "hand")),
        (("skin", "左", "hand"), ("skin", "右", "hand")),
    ],
)
def test_two_robots_at_one_broker_have_no_entity_and_no_device_in_common(
    info: NodeInfo, one: tuple[str, str, str], other: tuple[str, str, str]
) -> None:
    topics: list[set[str]] = []
    names: list[set[str]] = []
    for base, robot, part in (one, other):
        mine = msgspec.structs.replace(
            info, robot=robot, parts={part: info.parts["left_hand"]}, fingertips={}
        )
        found = discovery("homeassistant", Topics(base, robot), mine)
        entities = [json.loads(payload) for payload in found.values()]
        topics.append(set(found))
        names.append({entity["unique_id"] for entity in entities})
        names[-1] |= {name for entity in entities for name in entity["device"]["identifiers"]}
        # What takes an entity back names the same topics.
        assert set(discovery_topics("homeassistant", Topics(base, robot), part)) == set(found)
    assert topics[0].isdisjoint(topics[1])
    assert names[0].isdisjoint(names[1])


@pytest.mark.parametrize(
    ("state", "feels", "problem"),
    [
        ("ok", "online", "OFF"),
        ("warning", "online", "ON"),
        ("degraded", "online", "ON"),
        ("saturated", "online", "ON"),
        ("silent", "offline", "ON"),
        ("no data", "offline", "ON"),
        ("not calibrated", "offline", "ON"),
        ("disabled", "offline", "ON"),
    ],
)
def test_a_part_that_feels_nothing_is_unavailable_and_never_untouched(
    told: dict[str, Any], state: str, feels: str, problem: str
) -> None:
    """With the template engine of Home Assistant itself."""
    record = {"state": state, "sentences": ["triangle 3 of board hand: cut <here>"]}

    def said(template: str) -> str:
        return jinja2.Environment().from_string(template).render(value_json=record)

    contact = told["homeassistant/binary_sensor/skin_demo_left_hand_contact_2c51d961/config"]
    health = told["homeassistant/binary_sensor/skin_demo_left_hand_health_3b1b3adc/config"]
    assert said(contact["availability"][1]["value_template"]) == feels
    assert said(health["value_template"]) == problem
    assert json.loads(said(health["json_attributes_template"])) == record


@pytest.mark.parametrize(("value", "state"), [("ON", "ON"), ("OFF", "OFF"), ("UNKNOWN", "None")])
def test_a_contact_that_is_unknown_is_none_to_home_assistant(
    told: dict[str, Any], value: str, state: str
) -> None:
    contact = told["homeassistant/binary_sensor/skin_demo_left_hand_contact_2c51d961/config"]
    template = jinja2.Environment().from_string(contact["value_template"])
    assert template.render(value=value) == state


def test_a_fingertip_is_announced_like_a_part(info: NodeInfo) -> None:
    tip = FingertipInfo(3, "sphere", [7.0], None, None, 0.1, 10.0)
    found = discovery(
        "homeassistant",
        Topics("skin", "demo"),
        msgspec.structs.replace(info, fingertips={"tip": tip}),
    )
    told = json.loads(found["homeassistant/binary_sensor/skin_demo_tip_contact_371d17a0/config"])
    assert told["state_topic"] == "skin/demo/tip/contact"
    assert "homeassistant/binary_sensor/skin_demo_tip_health_64e3e912/config" in found


async def test_it_is_retained_on_the_broker_if_it_was_asked_for(
    mosquitto: Mosquitto, info: NodeInfo, tmp_path: Path
) -> None:
    (tmp_path / "password").write_text("xyzzy")
    settings = Mqtt(
        host=mosquitto.host,
        port=mosquitto.port,
        username="skin-host",
        password_file=str(tmp_path / "password"),
        discovery_prefix="homeassistant",
    )
    async with Publisher(settings, "demo", "main") as publisher:
        publisher.put_info(info)
        listener = Subscriber(mosquitto.host, mosquitto.port, "homeassistant/#")
        wanted = discovery("homeassistant", Topics("skin", "demo"), info)
        heard = await asyncio.to_thread(listener.wait_for, len(wanted))
    listener.close()
    assert heard == wanted
    assert not any(b"xyzzy" in payload for payload in heard.values())


async def test_nothing_is_announced_unless_it_was_asked_for(
    mosquitto: Mosquitto, info: NodeInfo
) -> None:
    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    async with Publisher(settings, "demo", "main") as publisher:
        publisher.put_info(info)
        listener = Subscriber(mosquitto.host, mosquitto.port, "#")
        heard = await asyncio.to_thread(listener.wait_for, 2)
    listener.close()
    assert set(heard) == {"skin/demo/nodes/main/status", "skin/demo/nodes/main/info"}
