"""What the ROS 2 node passes on, with stand-ins for ROS: rclpy is on no package index."""

import importlib
import math
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skin_host.client import Contact, Described, Frame, Health, PartInfo
from skin_host.errors import BrokerError
from skin_host.mqtt.topics import MAX_PART, wrong_part
from skin_host.processing.events import Touch
from tests.support.ros import ExternalShutdownException, check_topic
from tests.support.said import touch_event

PACKAGE = Path(__file__).parents[2] / "ros2" / "skin_host_ros"
MODULES = [
    *("rclpy", "rclpy.executors", "rclpy.node", "rclpy.qos", "geometry_msgs", "geometry_msgs.msg"),
    *("diagnostic_msgs", "diagnostic_msgs.msg", "sensor_msgs", "sensor_msgs.msg"),
    *("skin_host_msgs", "skin_host_msgs.msg", "skin_host_msgs.srv"),
]


class Node:
    """Keeps what is published: (topic, message), and what is logged."""

    def __init__(self, name: str) -> None:
        self.published: list[tuple[str, Any]] = []
        self.logged: list[str] = []

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.logged.append)

    def declare_parameter(self, name: str, default: str) -> Any:
        return SimpleNamespace(value=default)

    def create_publisher(self, _kind: type, topic: str, _qos: object) -> Any:
        check_topic(topic)
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
    sys.modules["rclpy.executors"].ExternalShutdownException = ExternalShutdownException  # type: ignore[attr-defined]
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


def touch(number: int, part: str = "arm", event: Any = "begin", t_ns: int = 1) -> Touch:
    place: Any = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    return touch_event(event, number, 1, t_ns, part, [0], *place, 50.0, 20.0, 10.0, 5.0)


def frame(part: str, t_ns: int) -> Frame:
    one = np.zeros(1, np.bool_)
    return Frame(part, 1, t_ns, np.zeros(1), ~one, one)


def shape(x_m: float) -> PartInfo:
    return PartInfo(50, ["pressure"], [(x_m, 0.0, 0.0)], [(0.0, 0.0, 1.0)], [2.0], [25.0], [])


def last(node: Any, topic: str) -> Any:
    return [message for name, message in node.published if name == topic][-1]


def shown(node: Any) -> tuple[int, str, list[int], float]:
    """State, its reason, contacts and force along z of the part, as they were published last."""
    contacts, wrench = last(node, "arm/contacts"), last(node, "arm/wrench").wrench
    return contacts.state, contacts.why, [one.id for one in contacts.contacts], wrench.force.z


def test_contacts_and_force_are_of_what_the_client_knows_to_be_there(node: Any) -> None:
    """Not of what a daemon reported that was started again since."""
    node._on_contact(Contact("arm", "ON"))
    node.skin.present.return_value = [touch(3)]
    node._on_touch(touch(3))
    node.skin.present.assert_called_with("arm")
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
    node.skin.present.return_value = []  # the client knows that, too
    node._on_contact(Contact("arm", "UNKNOWN", why))
    state, reason, contacts, force_n = shown(node)
    assert (state, reason, contacts) == (2, why, [])
    assert math.isnan(force_n)  # 0 N would be known
    # It is received, but does not feel everywhere.
    node.skin.present.return_value = [touch(3)]
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
    state, _, contacts, force_n = shown(node)
    assert (state, contacts, math.isnan(force_n)) == (1, [], True)


@pytest.mark.parametrize(
    ("part", "name"),
    [("left-hand", "left_hand"), ("2nd", "part_2nd"), ("-3", "_3"), ("arm", "arm")],
)
def test_every_name_of_a_part_is_one_of_ros(node: Any, part: str, name: str) -> None:
    node._on_info(Described(part, "main", shape(0.0)))
    node._on_frame(frame(part, 1))
    node._on_contact(Contact(part, "OFF"))
    topics = {f"{name}/{what}" for what in ("layout", "taxels", "points", "contacts", "wrench")}
    assert {topic for topic, _ in node.published} == topics
    # Frames keep the names that the parts have everywhere else.
    assert {message.header.frame_id for _, message in node.published} == {part}


@given(st.text(min_size=1, max_size=MAX_PART).filter(lambda name: wrong_part(name) is None))
def test_whatever_a_part_may_be_called_ros_takes_it(name: str) -> None:
    names = runpy.run_path(str(PACKAGE / "skin_host_ros" / "names.py"))
    check_topic(f"{names['ros_name'](name)}/contacts")


def test_two_parts_of_one_name_in_ros_end_it_with_one_line(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    skin = MagicMock()
    skin.return_value.parts.return_value = dict.fromkeys(["left-hand", "left_hand"])
    monkeypatch.setattr(module, "SkinCallbacks", skin)
    both = "skin: the parts left-hand and left_hand would both be left_hand in ROS"
    with pytest.raises(SystemExit, match=both):
        module.main()


def test_a_part_may_take_the_name_in_ros_of_one_that_is_gone(node: Any) -> None:
    node._on_info(Described("left-hand", "main", shape(0.0)))
    node._on_info(Described("left-hand", "", None))
    node._on_info(Described("left_hand", "main", shape(1.0)))
    assert last(node, "left_hand/layout").header.frame_id == "left_hand"


def test_taxels_are_where_the_newest_description_has_them(node: Any) -> None:
    """Of a node that starts later, too, and after a change of the configuration."""
    node.follow()
    on_info = node.skin.on_info.call_args.args[0]
    for x_m in (0.25, 0.5):
        on_info(Described("arm", "main", shape(x_m)))
        node._on_frame(frame("arm", 1))
        assert last(node, "arm/layout").position[0].x == x_m
        assert np.frombuffer(last(node, "arm/points").data, "<f4")[0] == x_m
    on_info(Described("arm", "", None))
    node.published.clear()
    node._on_frame(frame("arm", 2))
    assert [topic for topic, _ in node.published] == ["arm/taxels"]


def stamps_ns(node: Any) -> list[int]:
    times = [one.header.stamp for topic, one in node.published if topic == "arm/wrench"]
    return [time.sec * 1_000_000_000 + time.nanosec for time in times]


def test_stamps_are_times_of_the_robot_and_go_back_with_its_clock_only(node: Any) -> None:
    """Also of states, which have no time of their own; none is of this computer's clock."""
    second = 1_000_000_000
    node._on_contact(Contact("arm", "UNKNOWN", "not_felt"))
    node._on_frame(frame("arm", 100 * second))
    node._on_contact(Contact("arm", "OFF"))
    node._on_touch(touch(1, t_ns=100 * second - 1))  # the frame after it came first
    node._on_touch(touch(1, t_ns=101 * second))
    node._on_contact(Contact("arm", "ON"))
    node._on_touch(touch(1, part="leg", t_ns=999 * second))
    node._on_contact(Contact("arm", "UNKNOWN", "offline"))
    node._on_frame(frame("arm", 50 * second))  # it was set back
    node._on_contact(Contact("arm", "OFF"))
    assert stamps_ns(node) == [second * s for s in (0, 100, 100, 101, 101, 101, 50)]


def test_a_force_of_a_place_that_is_not_known_is_not_known(node: Any) -> None:
    nowhere = replace(touch(3), centroid_m=None, normal=None)
    node.skin.present.return_value = [touch(2), nowhere]
    node._on_touch(nowhere)
    assert math.isnan(last(node, "arm/wrench").wrench.force.z)


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


@pytest.mark.parametrize("end", [KeyboardInterrupt, ExternalShutdownException])
def test_it_ends_quietly_with_ctrl_c_and_when_ros_shuts_down(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch, end: type[BaseException]
) -> None:
    """Its client has ended then, too."""
    skin, executor = MagicMock(), MagicMock()
    skin.return_value.__exit__.return_value = None
    skin.return_value.parts.return_value = {}
    executor.return_value.spin.side_effect = end
    monkeypatch.setattr(module, "SkinCallbacks", skin)
    monkeypatch.setattr(module, "MultiThreadedExecutor", executor)
    module.main()
    skin.return_value.__exit__.assert_called_once()
    sys.modules["rclpy"].try_shutdown.assert_called_once()  # type: ignore[attr-defined]


def test_a_later_part_of_a_name_that_is_taken_is_named_once(node: Any) -> None:
    """Its frames come for hours, fifty a second."""
    node._on_info(Described("left-hand", "main", shape(0.0)))
    for seq in range(3):
        node._on_frame(frame("left_hand", seq))
        node._on_contact(Contact("left_hand", "OFF"))
    assert {message.header.frame_id for _, message in node.published} == {"left-hand"}
    both = "the parts left-hand and left_hand would both be left_hand in ROS; rename one of them"
    assert node.logged == [both]


def test_it_is_started_again() -> None:
    launch = (PACKAGE / "launch" / "skin.launch.py").read_text()
    assert "respawn=True" in launch
