"""The skin as tags of a robot's description in URDF.

URDF has no tag for skin. Written is what the package `urdf_tactile` (ubi-agni/tactile_toolbox)
reads: a `<sensor>` a part, in it `<tactile>` with a `<taxel>` for each that measures pressure. The
z axis of a taxel is its normal; `idx` is its place in the part's arrays, as they are published.
"""

import math
from xml.etree import ElementTree as ET

from skin_host.layout import Layout, PadKind

#: Pads are drawn as discs of this thickness.
DISC_M = 0.0005


def urdf_text(layout: Layout) -> str:
    """Describe the skin of a robot: a link and a sensor a part.

    A configuration does not contain where on the body a part is: who includes this adds a joint
    from a link of the body to the link of each part.
    """
    root = ET.Element("robot", name=layout.robot)
    for part in layout.parts:
        period_ms = max(layout.boards[board].settings.period_ms for board in part.boards)
        ET.SubElement(root, "link", name=part.name)
        sensor = ET.SubElement(
            root, "sensor", name=f"{part.name}_skin", update_rate=f"{1000 / period_ms:g}"
        )
        ET.SubElement(sensor, "parent", link=part.name)
        ET.SubElement(sensor, "origin", xyz="0 0 0", rpy="0 0 0")
        tactile = ET.SubElement(sensor, "tactile", channel=part.name)
        for taxel in range(part.start, part.stop):
            if layout.pad_kind[taxel] == PadKind.PRESSURE:
                radius_m = layout.radius_mm[taxel] * 1e-3
                tag = ET.SubElement(
                    tactile,
                    "taxel",
                    idx=str(taxel - part.start),
                    xyz=_numbers(*layout.position_m[taxel]),
                    rpy=_numbers(*_along(*layout.normal[taxel])),
                )
                geometry = ET.SubElement(tag, "geometry")
                ET.SubElement(geometry, "cylinder", radius=f"{radius_m:g}", length=f"{DISC_M:g}")
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _along(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch and yaw (rad) that lay the z axis along a normal; the yaw is 0."""
    return -math.asin(max(-1.0, min(1.0, y))), math.atan2(x, z), 0.0


def _numbers(*values: float) -> str:
    return " ".join(f"{round(value, 6) + 0.0:g}" for value in values)
