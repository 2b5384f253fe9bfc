"""What the ROS 2 node passes on, with stand-ins for ROS: rclpy is on no package index."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from skin_host.client import Contact, Health
from skin_host.errors import BrokerError
from skin_host.processing.events import Touch
from tests.support.said import touch_event

PACKAGE = Path(__file__).parents[2] / "ros2" / "skin_host_ros"
MODULES = [
    *("rclpy", "rclpy.executors", "rclpy.node", "rclpy.qos", "geometry_msgs", "geometry_msgs.msg"),
    *("diagnostic_msgs", "diagnostic_msgs.msg", "sensor_msgs", "sensor_msgs.msg"),
    *("skin_host_msgs", "skin_host_msgs.msg", "skin_host_msgs.srv"),
]


class Node:
    """Keeps what is published: (topic, message)."""

    def __init__(self, name: str) -> None:
        self.published: list[tuple[str, Any]] = []

    def declare_parameter(self, name: str, default: str) -> Any:
        return SimpleNamespace(value=default)

    def create_publisher(self, _kind: type, topic: str, _qos: object) -> Any:
        return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def create_service(self, *_: object) -> None:
        """Nobody asks for it."""

    def destroy_node(self) -> None:
        """Nothing is left."""


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module of the node."""
    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    sys.modules["rclpy.node"].Node = Node  # type: ignore[attr-defined]
    monkeypatch.syspath_prepend(PACKAGE)
    node = importlib.import_module("skin_host_ros.node")
    monkeypatch.setattr(node, "message_class", lambda _: SimpleNamespace)
    yield node
    for name in [name for name in sys.modules if name.split(".")[0] == "skin_host_ros"]:
        del sys.modules[name]


@pytest.fixture
def node(module: ModuleType) -> Any:
    """The node of a client that knows of no touch yet."""
    made = module.SkinNode()
    made.skin = MagicMock()
    made.skin.present.return_value = []
    return made


def touch(number: int, part: str = "arm", event: Any = "begin") -> Touch:
    place: Any = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    return touch_event(event, number, 1, 1, part, [0], *place, 50.0, 20.0, 10.0, 5.0)


def last(node: Any, topic: str) -> Any:
    return [message for name, message in node.published if name == topic][-1]


def shown(node: Any) -> tuple[int, str, list[int], float]:
    """State, its reason, contacts and force along z of the part, as they were published last."""
    contacts, wrench = last(node, "arm/contacts"), last(node, "arm/wrench").wrench
    return contacts.state, contacts.why, [one.id for one in contacts.contacts], wrench.force.z


def test_contacts_and_force_are_of_what_the_client_knows_to_be_there(node: Any) -> None:
    """Not of what a daemon reported that was started again since."""
    node._on_contact(Contact("arm", "ON"))
    node.skin.present.return_value = [touch(3), touch(4, part="leg")]
    node._on_touch(touch(3))
    assert shown(node) == (1, "", [3], -5.0)
    node.skin.present.return_value = [touch(1)]
    node._on_touch(touch(1))
    assert shown(node) == (1, "", [1], -5.0)
    node.skin.present.return_value = []
    node._on_contact(Contact("arm", "OFF"))
    assert shown(node) == (0, "", [], 0.0)
    # A touch may come before the state that it makes.
    node.skin.present.return_value = [touch(2)]
    node._on_touch(touch(2))
    assert shown(node) == (1, "", [2], -5.0)


@pytest.mark.parametrize("why", ["offline", "stale", "disconnected"])
def test_what_touched_before_is_not_known_of_a_part_that_is_not_received(
    node: Any, why: Any
) -> None:
    node.skin.present.return_value = [touch(3)]
    node._on_touch(touch(3))
    assert shown(node) == (1, "", [3], -5.0)
    node._on_contact(Contact("arm", "UNKNOWN", why))
    assert shown(node) == (2, why, [], 0.0)
    # It is received, but does not feel everywhere.
    node._on_contact(Contact("arm", "UNKNOWN", "not_felt"))
    assert shown(node) == (2, "not_felt", [3], -5.0)


def test_a_contact_whose_end_was_lost_goes_with_the_next_health(node: Any) -> None:
    node._on_contact(Contact("arm", "ON"))
    node.skin.present.return_value = [touch(3)]
    node._on_touch(touch(3))
    for _ in range(2):
        node._on_health(Health("arm", {"state": "ok"}))
    assert len([topic for topic, _ in node.published if topic == "arm/wrench"]) == 2
    node.skin.present.return_value = []
    node._on_health(Health("arm", {"state": "ok"}))
    assert shown(node) == (1, "", [], 0.0)


def test_health_that_the_broker_has_stored_is_not_that_of_now(node: Any) -> None:
    node._on_health(Health("arm", {"state": "ok"}, stored=True))
    assert node.published == []
    node._on_health(Health("arm", {"state": "ok"}))
    assert [topic for topic, _ in node.published] == ["/diagnostics"]


def test_without_a_broker_or_robot_it_ends_with_one_line(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: object) -> None:
        raise BrokerError("no node published its info")

    monkeypatch.setattr(module, "SkinCallbacks", MagicMock())
    monkeypatch.setattr(module.SkinNode, "follow", fail)
    with pytest.raises(SystemExit, match="skin: no node published its info"):
        module.main()
    sys.modules["rclpy"].try_shutdown.assert_called_once()  # type: ignore[attr-defined]


def test_it_is_started_again() -> None:
    launch = (PACKAGE / "launch" / "skin.launch.py").read_text()
    assert "respawn=True" in launch
