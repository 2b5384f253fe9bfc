"""Stand-ins for the few names of ROS 2 that `examples/ros2_node.py` and the node of `ros2/` use.

rclpy comes with ROS 2 and with nothing else: it is on no package index. What is ours in the
programs is run with these; what ROS does with the messages is not tested here.
"""

import re
import sys
import threading
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

PATIENCE_S = 30.0


def check_topic(topic: str) -> str:
    """Refuse what rcl and rmw refuse of a topic without substitutions."""
    levels = topic.removeprefix("/").split("/")
    if len(topic) > 247 or not all(re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", one) for one in levels):
        raise ValueError(f"Invalid topic name: {topic}")
    return topic


class Vector3:
    def __init__(self) -> None:
        self.x = self.y = self.z = 0.0


class WrenchStamped:
    def __init__(self) -> None:
        self.header = SimpleNamespace(frame_id="", stamp=SimpleNamespace(sec=0, nanosec=0))
        self.wrench = SimpleNamespace(force=Vector3(), torque=Vector3())


class Float32MultiArray:
    def __init__(self, data: list[float]) -> None:
        self.data = data


class Node:
    """Keeps what is published: (topic, message)."""

    def __init__(self, name: str, enough: int) -> None:
        self.name = name
        self.enough = enough
        self.made: list[str] = []
        self.published: list[tuple[str, Any]] = []
        self.heard = threading.Event()

    def create_publisher(self, _kind: type, topic: str, qos_profile: int) -> Any:
        self.made.append(check_topic(topic))

        def publish(message: Any) -> None:
            self.published.append((topic, message))
            if len(self.published) >= self.enough:
                self.heard.set()

        return SimpleNamespace(publish=publish)


class ExternalShutdownException(Exception):  # noqa: N818  # rclpy names it
    """What rclpy raises where something else has shut it down, as its handler of SIGTERM does."""


nodes: list[Node] = []


def spin(node: Node) -> None:
    """Return once the node has published enough."""
    assert not node.enough or node.heard.wait(PATIENCE_S)


def install(monkeypatch: pytest.MonkeyPatch, enough: int) -> None:
    """Make `import rclpy` and what belongs to it find these."""

    def create_node(name: str) -> Node:
        nodes.append(Node(name, enough))
        return nodes[-1]

    nodes.clear()
    for name, attributes in {
        "rclpy": {"init": lambda: None, "create_node": create_node, "spin": spin},
        "rclpy.executors": {"ExternalShutdownException": ExternalShutdownException},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"WrenchStamped": WrenchStamped},
        "std_msgs": {},
        "std_msgs.msg": {"Float32MultiArray": Float32MultiArray},
    }.items():
        module = ModuleType(name)
        vars(module).update(attributes)
        monkeypatch.setitem(sys.modules, name, module)
