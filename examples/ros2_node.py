"""A ROS 2 node: pressure and wrench of every part. `python3 examples/ros2_node.py [URL]`."""

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Float32MultiArray

from skin_host.client import Frame, SkinCallbacks, Touch


class SkinNode(Node):
    """Publishes <part>/pressure (kPa a taxel, NaN: not valid) and <part>/wrench (N, Nm)."""

    def __init__(self) -> None:
        super().__init__("skin")
        self.topics: dict[str, Publisher] = {}

    def on_frame(self, frame: Frame) -> None:
        """Pass on a frame of pressure."""
        kpa = np.where(frame.valid, frame.pressure_kpa, np.nan)
        self.send(Float32MultiArray(data=kpa.tolist()), f"{frame.part}/pressure")

    def on_touch(self, touch: Touch) -> None:
        """Pass on what a contact does to its part, in the part's own frame."""
        if touch.centroid_m is None or touch.normal is None:
            return
        said = WrenchStamped()
        said.header.frame_id = touch.part
        said.header.stamp.sec, said.header.stamp.nanosec = divmod(touch.t_ns, 10**9)
        force_n = -touch.force_n * np.array(touch.normal)
        for vector, values in (
            (said.wrench.force, force_n),
            (said.wrench.torque, np.cross(touch.centroid_m, force_n)),
        ):
            vector.x, vector.y, vector.z = values.tolist()
        self.send(said, f"{touch.part}/wrench")

    def send(self, message: object, topic: str) -> None:
        """Publish on a topic, which is made when it is first needed."""
        if topic not in self.topics:
            self.topics[topic] = self.create_publisher(type(message), topic, 10)
        self.topics[topic].publish(message)


def main(url: str) -> None:
    """Pass on all that is heard until ROS says stop."""
    rclpy.init()
    node = SkinNode()
    with SkinCallbacks(url) as skin:
        skin.on_frame(node.on_frame)
        skin.on_touch(node.on_touch)
        rclpy.spin(node)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "mqtt://localhost")
