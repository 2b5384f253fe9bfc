"""The types of ROS 2 and of this project's messages, without ROS."""

from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MESSAGES = Path(__file__).parents[2] / "ros2/skin_host_msgs/msg"


@cache
def typestore() -> Any:
    """Types by name, such as `std_msgs/msg/Header`; hundreds of them, read once."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for path in sorted(MESSAGES.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"skin_host_msgs/msg/{path.stem}"))
    return store
