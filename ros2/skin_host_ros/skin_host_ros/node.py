"""The node. Topics of a part: `<part>/taxels`, `/layout`, `/points`, `/contacts`, `/wrench`.

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
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from skin_host_msgs.msg import ContactArray, TaxelArray, TaxelLayout
from skin_host_msgs.srv import Calibrate

from skin_host.client import Contact, Frame, Health, PartInfo, SkinCallbacks, SkinError, Touch
from skin_host_ros.messages import Messages

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
        self._states: dict[str, Contact] = {}
        #: By part: the contacts that were published last, as touches.
        self._shown: dict[str, list[Touch]] = {}
        self._publisher = cache(self._new_publisher)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self.skin = SkinCallbacks(url, robot=robot)
        self._parts: dict[str, PartInfo] = {}
        self.create_service(Calibrate, "calibrate", self._calibrate)

    def _new_publisher(self, kind: type, topic: str, qos: QoSProfile) -> Any:
        return self.create_publisher(kind, topic, qos)

    def follow(self) -> None:
        """Publish where the taxels of all parts are, and from now on what is received."""
        for info in self.skin.info().values():
            for part, shape in info.parts.items():
                self._parts[part] = shape
                layout = self._messages.layout(part, shape, time.time_ns())
                self._publisher(TaxelLayout, f"{part}/layout", KEPT).publish(layout)
        # They are called one after the other in the client's thread.
        self.skin.on_frame(self._on_frame)
        self.skin.on_touch(self._on_touch)
        self.skin.on_contact(self._on_contact)
        self.skin.on_health(self._on_health)

    def _on_frame(self, frame: Frame) -> None:
        taxels = self._publisher(TaxelArray, f"{frame.part}/taxels", qos_profile_sensor_data)
        taxels.publish(self._messages.taxels(frame))
        shape = self._parts.get(frame.part)
        if shape is not None and len(shape.pads) == len(frame.valid):
            points = self._publisher(PointCloud2, f"{frame.part}/points", qos_profile_sensor_data)
            points.publish(self._messages.cloud(frame, shape))

    def _on_touch(self, touch: Touch) -> None:
        self._publish_contacts(touch.part, touch.t_ns)

    def _on_contact(self, contact: Contact) -> None:
        self._states[contact.part] = contact
        self._publish_contacts(contact.part, time.time_ns())

    def _known_touches(self, part: str) -> list[Touch]:
        """What touches a part. Of one that is not received nothing is known, nor what it does."""
        known = self._states.get(part)
        if known is not None and known.why not in (None, "not_felt"):
            return []
        return [touch for touch in self.skin.present() if touch.part == part]

    def _publish_contacts(self, part: str, t_ns: int) -> None:
        touches = self._shown[part] = self._known_touches(part)
        known = self._states.get(part)
        # A touch may come before the state that it makes.
        if touches and (known is None or known.state == "OFF"):
            known = Contact(part, "ON")
        state = known or Contact(part, "UNKNOWN", "stale")
        contacts = self._messages.contacts(state, touches, t_ns)
        self._publisher(ContactArray, f"{part}/contacts", RELIABLE).publish(contacts)
        wrench = self._messages.wrench(part, touches, t_ns)
        self._publisher(WrenchStamped, f"{part}/wrench", RELIABLE).publish(wrench)

    def _on_health(self, health: Health) -> None:
        if health.stored:
            return  # it may be from any time, and shows nothing of now
        # A contact whose end was lost goes without a message.
        if self._known_touches(health.part) != self._shown.get(health.part, []):
            self._publish_contacts(health.part, time.time_ns())
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
    finally:
        rclpy.try_shutdown()
