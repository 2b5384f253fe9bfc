"""A ROS 2 node: <part>/pressure (kPa a taxel, NaN: not valid) and <part>/wrench (N, Nm)."""

import sys
from functools import cache, partial

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from std_msgs.msg import Float32MultiArray

from skin_host.client import Frame, SkinCallbacks, Touch

rclpy.init()
node = rclpy.create_node("skin")
publisher = cache(partial(node.create_publisher, qos_profile=10))


def on_frame(frame: Frame) -> None:
    """Pass on the pressures of a part."""
    kpa = np.where(frame.valid, frame.pressure_kpa, np.nan).tolist()
    publisher(Float32MultiArray, f"{frame.part}/pressure").publish(Float32MultiArray(data=kpa))


def on_touch(touch: Touch) -> None:
    """Pass on what a contact does to its part, in the part's own frame."""
    if touch.centroid_m is None or touch.normal is None:
        return
    said = WrenchStamped()
    said.header.frame_id = touch.part
    said.header.stamp.sec, said.header.stamp.nanosec = divmod(touch.t_ns, 10**9)
    force, torque = said.wrench.force, said.wrench.torque
    force.x, force.y, force.z = (-touch.force_n * np.array(touch.normal)).tolist()
    torque.x, torque.y, torque.z = np.cross(touch.centroid_m, [force.x, force.y, force.z]).tolist()
    publisher(WrenchStamped, f"{touch.part}/wrench").publish(said)


with SkinCallbacks(*sys.argv[1:]) as skin:
    skin.on_frame(on_frame)
    skin.on_touch(on_touch)
    rclpy.spin(node)
