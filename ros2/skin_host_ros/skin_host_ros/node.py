"""The node. Topics of a part: `<part>/taxels`, `/layout`, `/points`, `/contacts`, `/wrench`,
where `<part>` is its name as ROS takes it.

`/diagnostics` has the health of all parts, the service `calibrate` calibrates untouched skin.
"""

import importlib
import json
import sys
import time
from array import array
from collections.abc import Sequence
from functools import cache
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from skin_host_msgs.msg import ContactArray, TaxelArray, TaxelLayout
from skin_host_msgs.srv import Calibrate

from skin_host.client import (
    Contact,
    Described,
    Frame,
    Health,
    PartInfo,
    RequestError,
    SkinCallbacks,
    SkinError,
    Touch,
)
from skin_host_ros.messages import NS, Messages
from skin_host_ros.names import ros_name

#: What is further back is the time of a robot whose clock was set back.
SET_BACK_NS = NS
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABLE = QoSProfile(depth=100)


@cache
def message_class(name: str) -> Any:
    """The class of `package/msg/Name`."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def message_array(code: str, values: Sequence[Any]) -> Any:
    """What rclpy takes for a field of many numbers."""
    return list(values) if code == "?" else array(code, values)


class SkinNode(Node):
    """Passes on what a robot's skin publishes."""

    def __init__(self) -> None:
        super().__init__("skin")
        url = self.declare_parameter("broker", "mqtt://localhost").value
        robot = self.declare_parameter("robot", "").value or None
        self._messages = Messages(message_class, message_array, lambda level: bytes([level]))
        #: By name in topics: the part that has it.
        self._named: dict[str, str] = {}
        #: Parts whose names others have.
        self._nameless: set[str] = set()
        self._shapes: dict[str, PartInfo] = {}
        #: By part: the newest time that came of it, by the robot's clock.
        self._newest_ns: dict[str, int] = {}
        self._states: dict[str, Contact] = {}
        #: By part: the contacts that were published last, as touches.
        self._shown: dict[str, list[Touch]] = {}
        self._publisher = cache(self._new_publisher)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self.skin = SkinCallbacks(url, robot=robot)
        self.create_service(Calibrate, "calibrate", self._calibrate)

    def _new_publisher(self, kind: type, topic: str, qos: QoSProfile) -> Any:
        return self.create_publisher(kind, topic, qos)

    def _publish(self, part: str, what: str, kind: type, qos: QoSProfile, message: Any) -> None:
        """Publish a message of a part, unless another part has its name; that is logged once."""
        try:
            name = self._name(part)
        except RequestError as error:
            if part not in self._nameless:
                self._nameless.add(part)
                self.get_logger().error(str(error))
            return
        self._nameless.discard(part)
        self._publisher(kind, f"{name}/{what}", qos).publish(message)

    def _name(self, part: str) -> str:
        """Return a part's name in topics.

        Raises:
            RequestError: another part has it.
        """
        name = ros_name(part)
        other = self._named.setdefault(name, part)
        if other != part:
            raise RequestError(
                f"the parts {other} and {part} would both be {name} in ROS; rename one of them"
            )
        return name

    def follow(self) -> None:
        """Publish from now on where the taxels of all parts are, and what is received.

        Raises:
            BrokerError: no node published its info.
            RequestError: two parts would have one name in ROS.
        """
        self.skin.info()
        for part in self.skin.parts():
            self._name(part)
        # They are called one after the other in the client's thread.
        self.skin.on_info(self._on_info)
        self.skin.on_frame(self._on_frame)
        self.skin.on_touch(self._on_touch)
        self.skin.on_contact(self._on_contact)
        self.skin.on_health(self._on_health)

    def _on_info(self, described: Described) -> None:
        part, shape = described.part, described.skin
        self._shapes.pop(part, None)
        if described.info is None and self._named.get(ros_name(part)) == part:
            del self._named[ros_name(part)]
        if shape is not None:
            self._shapes[part] = shape
            layout = self._messages.layout(part, shape, time.time_ns())
            self._publish(part, "layout", TaxelLayout, KEPT, layout)

    def _on_frame(self, frame: Frame) -> None:
        part, shape = frame.part, self._shapes.get(frame.part)
        self._note_time(part, frame.t_ns)
        taxels = self._messages.taxels(frame)
        self._publish(part, "taxels", TaxelArray, qos_profile_sensor_data, taxels)
        if shape is not None and len(shape.pads) == len(frame.valid):
            points = self._messages.cloud(frame, shape)
            self._publish(part, "points", PointCloud2, qos_profile_sensor_data, points)

    def _note_time(self, part: str, t_ns: int) -> None:
        """Take the time of a frame or touch; they come in nearly the order of their times."""
        if not 0 < self._newest_ns.get(part, 0) - t_ns < SET_BACK_NS:
            self._newest_ns[part] = t_ns

    def _on_touch(self, touch: Touch) -> None:
        self._note_time(touch.part, touch.t_ns)
        self._publish_contacts(touch.part)

    def _on_contact(self, contact: Contact) -> None:
        self._states[contact.part] = contact
        self._publish_contacts(contact.part)

    def _publish_contacts(self, part: str) -> None:
        """Publish what touches a part, as of the newest time that is known of it."""
        touches = self._shown[part] = self.skin.present(part)
        known = self._states.get(part)
        # A touch may come before the state that it makes.
        if touches and (known is None or known.state == "OFF"):
            known = Contact(part, "ON")
        state = known or Contact(part, "UNKNOWN", "stale")
        t_ns = self._newest_ns.get(part, 0)
        contacts = self._messages.contacts(state, touches, t_ns)
        self._publish(part, "contacts", ContactArray, RELIABLE, contacts)
        wrench = self._messages.wrench(state, touches, t_ns)
        self._publish(part, "wrench", WrenchStamped, RELIABLE, wrench)

    def _on_health(self, health: Health) -> None:
        if health.stored:
            return  # it may be from any time, and shows nothing of now
        # A contact whose end was lost goes without a message.
        if self.skin.present(health.part) != self._shown.get(health.part, []):
            self._publish_contacts(health.part)
        one = self._messages.diagnostics({health.part: health}, time.time_ns())
        self._diagnostics.publish(one)

    def _calibrate(self, request: Any, response: Any) -> Any:
        wanted = {"part": request.part} if request.part else {}
        if request.seconds > 0:
            wanted["seconds"] = request.seconds
        try:
            result = self.skin.command(
                "calibrate", node=request.node or None, timeout_s=60.0 + request.seconds, **wanted
            )
        except SkinError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, json.dumps(result.get("verdicts", result))
        return response


def main() -> None:
    """Run until ROS shuts down, or there is no broker or robot: the launch file tries again."""
    rclpy.init()
    try:
        node = SkinNode()
        executor = MultiThreadedExecutor()  # a calibration takes seconds
        executor.add_node(node)
        try:
            with node.skin:
                node.follow()
                executor.spin()
        finally:
            node.destroy_node()
    except SkinError as error:
        sys.exit(f"skin: {error}")
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
