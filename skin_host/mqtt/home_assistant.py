"""MQTT discovery messages, by which Home Assistant finds the skin automatically.

Two entities per part, grouped by node: whether anything touches it, and whether it has a problem.
Source: Home Assistant's documentation of the MQTT integration ("MQTT discovery") and of its
binary sensor. Only names of the configuration are included.
"""

import re
from typing import Any, Final

import msgspec

from skin_host.mqtt.info import NodeInfo
from skin_host.mqtt.topics import Topics

#: As on the page and in `skin status`: anything but `ok` is a problem, with its sentences.
PROBLEM: Final = "{{ 'OFF' if value_json.state == 'ok' else 'ON' }}"
WHY: Final = "{{ {'state': value_json.state, 'sentences': value_json.sentences} | tojson }}"
#: A part that cannot feel is not "not touched": its contact is unavailable.
FEELS: Final = (
    "{{ 'online' if value_json.state in ('ok', 'warning', 'degraded', 'saturated') "
    "else 'offline' }}"
)


#: For Home Assistant the text None is an unknown state.
STATE: Final = "{{ 'None' if value == 'UNKNOWN' else value }}"


def discovery(prefix: str, topics: Topics, info: NodeInfo) -> dict[str, bytes]:
    """Return topics and payloads, to be retained, that announce the parts and fingertips of a node.

    Args:
        prefix: of Home Assistant's discovery, `homeassistant` by default.
        topics: of the robot.
        info: of the node.
    """
    skin = _identifier(topics.base)
    alive = {"topic": topics.node("status", info.node)}
    messages: dict[str, dict[str, Any]] = {}
    for part in [*info.parts, *info.fingertips]:
        health = topics.part("health", part)
        messages[f"{skin}_{part}_contact"] = {
            "name": f"{part} contact",
            "icon": "mdi:gesture-tap",
            "state_topic": topics.part("contact", part),
            "value_template": STATE,
            "availability": [alive, {"topic": health, "value_template": FEELS}],
            "availability_mode": "all",
        }
        messages[f"{skin}_{part}_problem"] = {
            "name": f"{part} problem",
            "device_class": "problem",
            "entity_category": "diagnostic",
            "state_topic": health,
            "value_template": PROBLEM,
            "json_attributes_topic": health,
            "json_attributes_template": WHY,
            "availability": [alive],
        }
    common = {
        "qos": 1,
        "device": {
            "identifiers": [f"{skin}_nodes_{info.node}"],
            "name": f"{info.robot} skin, node {info.node}",
            "sw_version": info.version,
        },
        "origin": {"name": "skin-host", "sw_version": info.version},
    }
    return {
        f"{prefix}/binary_sensor/{name}/config": msgspec.json.encode(
            {"unique_id": name} | message | common
        )
        for name, message in messages.items()
    }


def _identifier(base: str) -> str:
    """Return a name of letters, digits, `_` and `-`, which are all that a discovery topic may
    have.
    """
    return re.sub(r"[^a-zA-Z0-9_-]", "_", base)
