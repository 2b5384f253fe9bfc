"""Names of parts as ROS 2 takes them. Pure."""

import re


def ros_name(part: str) -> str:
    """Return a part's level of a topic: letters, digits and `_`, and no digit first.

    `left-hand` is `left_hand`, `2nd` is `part_2nd`. So two parts may have one name.
    """
    name = re.sub(r"[^A-Za-z0-9_]", "_", part)
    return f"part_{name}" if name[:1].isdigit() else name
