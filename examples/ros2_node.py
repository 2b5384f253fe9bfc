"""A ROS 2 node: <part>/pressure (kPa a taxel, NaN: not valid) and <part>/wrench (N, Nm; NaN: not
known). `python examples/ros2_node.py [URL]`.
"""

import re
import sys
from functools import cache, partial

import numpy as np

from skin_host.client import Contact, Frame, SkinCallbacks, SkinError, Touch

try:
    import rclpy
    from geometry_msgs.msg import WrenchStamped
    from rclpy.executors import ExternalShutdownException
    from std_msgs.msg import Float32MultiArray
except ModuleNotFoundError as error:
    sys.exit(f"{error}: wanted ROS 2, such as by `source /opt/ros/humble/setup.bash`")

rclpy.init()
node = rclpy.create_node("skin")
publisher = cache(partial(node.create_publisher, qos_profile=10))
#: By part: its contact state, and the time (ns) of the last touch.
states: dict[str, Contact] = {}
times_ns: dict[str, int] = {}


def topic(part: str, what: str) -> str:
    """Return a topic of a part; ROS takes letters, digits and `_`, and no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", part)
    return f"part_{name}/{what}" if name[:1].isdigit() else f"{name}/{what}"


def on_frame(frame: Frame) -> None:
    """Pass on the pressures of a part."""
    kpa = np.where(frame.valid, frame.pressure_kpa, np.nan).tolist()
    publisher(Float32MultiArray, topic(frame.part, "pressure")).publish(Float32MultiArray(data=kpa))


def on_touch(touch: Touch) -> None:
    """Take the time of a touch; another contact of the part may last after the end of one."""
    times_ns[touch.part] = touch.t_ns
    publish_wrench(touch.part)


def on_contact(contact: Contact) -> None:
    """Take a state: what touches a part that is not received any more is not known."""
    states[contact.part] = contact
    publish_wrench(contact.part)


def publish_wrench(part: str) -> None:
    """Pass on what all contacts do to a part, in the part's own frame."""
    touches = skin.present(part)
    state = states.get(part)
    # Without a contact that is known, it is 0 N only while nothing touches the part.
    is_known = bool(touches) or (state is not None and not state.touched)
    force, torque = np.zeros(3), np.zeros(3)
    for touch in touches:
        if touch.load is not None:  # of a fingertip on a force/torque board: measured
            force, torque = force + touch.load.force_n, torque + touch.load.torque_nm
        elif touch.centroid_m is None or touch.normal is None:
            is_known = False
        else:
            one = -touch.force_n * np.array(touch.normal)
            force, torque = force + one, torque + np.cross(touch.centroid_m, one)
    if not is_known:
        force, torque = np.full(3, np.nan), np.full(3, np.nan)
    message = WrenchStamped()
    message.header.frame_id = part
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(times_ns.get(part, 0), 10**9)
    for vector, values in ((message.wrench.force, force), (message.wrench.torque, torque)):
        vector.x, vector.y, vector.z = values.tolist()
    publisher(WrenchStamped, topic(part, "wrench")).publish(message)


try:
    with SkinCallbacks(*sys.argv[1:2]) as skin:
        skin.on_frame(on_frame)
        skin.on_contact(on_contact)
        skin.on_touch(on_touch)
        rclpy.spin(node)
except SkinError as error:  # no broker, or no robot there
    sys.exit(str(error))
except (KeyboardInterrupt, ExternalShutdownException):
    pass
