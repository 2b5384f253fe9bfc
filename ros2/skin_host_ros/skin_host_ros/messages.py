"""From what the client receives to ROS 2 messages. Pure: the message classes are given.

Classes generated for rclpy and those of `rosbags` are both made with keywords, so that the same
code is tested without ROS.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from skin_host.client import Contact, Frame, Health, PartInfo, Touch

NS = 1_000_000_000
FLOAT32 = 7  # sensor_msgs/PointField
#: Levels of diagnostic_msgs/DiagnosticStatus by the state of a part; all others are errors.
OK, WARN, ERROR = 0, 1, 2
_LEVELS = {"ok": OK, "warning": WARN, "degraded": WARN, "disabled": WARN}
STATES = {"OFF": 0, "ON": 1, "UNKNOWN": 2}


class Messages:
    """Makes messages.

    Args:
        types: message classes by name, such as `std_msgs/msg/Header`.
        array: makes the array of a field from a type code of `array.array` and its values.
        level: makes the `byte` of a diagnostic status.
    """

    def __init__(
        self,
        types: Callable[[str], Any],
        array: Callable[[str, Sequence[Any]], Any],
        level: Callable[[int], Any],
    ) -> None:
        self._types, self._array, self._level = types, array, level

    def header(self, part: str, t_ns: int) -> Any:
        """The frame of a part and a time (ns, UTC)."""
        stamp = self._types("builtin_interfaces/msg/Time")(sec=t_ns // NS, nanosec=t_ns % NS)
        return self._types("std_msgs/msg/Header")(stamp=stamp, frame_id=part)

    def taxels(self, frame: Frame) -> Any:
        """skin_host_msgs/TaxelArray."""
        kpa = np.where(frame.valid, frame.pressure_kpa, np.nan)
        return self._types("skin_host_msgs/msg/TaxelArray")(
            header=self.header(frame.part, frame.t_ns),
            seq=frame.seq,
            pressure_kpa=self._array("f", kpa.tolist()),
            valid=self._array("?", frame.valid.tolist()),
            beyond_range=self._array("?", frame.beyond_range.tolist()),
        )

    def layout(self, part: str, info: PartInfo, t_ns: int) -> Any:
        """skin_host_msgs/TaxelLayout."""
        return self._types("skin_host_msgs/msg/TaxelLayout")(
            header=self.header(part, t_ns),
            position=[self._point(place) for place in info.position_m],
            normal=[self._vector(normal) for normal in info.normal],
            area_mm2=self._array("f", info.area_mm2),
            thermal=self._array("?", [pad == "thermal" for pad in info.pads]),
        )

    def contacts(self, contact: Contact, touches: Sequence[Touch], t_ns: int) -> Any:
        """skin_host_msgs/ContactArray: the state of a part, and what touches it now."""
        return self._types("skin_host_msgs/msg/ContactArray")(
            header=self.header(contact.part, t_ns),
            state=STATES[contact.state],
            why=contact.why or "",
            contacts=[self._contact(touch) for touch in touches],
        )

    def cloud(self, frame: Frame, info: PartInfo) -> Any:
        """sensor_msgs/PointCloud2: x, y, z (m) and pressure (kPa, NaN where not valid)."""
        points = np.empty((len(frame.valid), 4), "<f4")
        points[:, :3] = info.position_m
        points[:, 3] = np.where(frame.valid, frame.pressure_kpa, np.nan)
        field = self._types("sensor_msgs/msg/PointField")
        names = ("x", "y", "z", "pressure_kpa")
        return self._types("sensor_msgs/msg/PointCloud2")(
            header=self.header(frame.part, frame.t_ns),
            height=1,
            width=len(points),
            fields=[
                field(name=name, offset=4 * i, datatype=FLOAT32, count=1)
                for i, name in enumerate(names)
            ],
            is_bigendian=False,
            point_step=points.strides[0],
            row_step=points.nbytes,
            data=self._array("B", points.tobytes()),
            is_dense=bool(frame.valid.all()),
        )

    def wrench(self, contact: Contact, touches: Sequence[Touch], t_ns: int) -> Any:
        """geometry_msgs/WrenchStamped: what all contacts do to the part, in its frame.

        Of a fingertip on a force/torque board this is measured, and a bound where the board is
        saturated. It is NaN where it is not known: nothing is known to touch a part that is not
        known to be untouched, or a contact of skin has no place.
        """
        force, torque = np.zeros(3), np.zeros(3)
        if not touches and contact.touched:
            force, torque = np.full(3, np.nan), np.full(3, np.nan)
        for touch in touches:
            if touch.load is not None:
                force += touch.load.force_n
                torque += touch.load.torque_nm
            elif touch.centroid_m is None or touch.normal is None:
                force, torque = np.full(3, np.nan), np.full(3, np.nan)
            else:
                one = -touch.force_n * np.array(touch.normal)
                force += one
                torque += np.cross(touch.centroid_m, one)
        return self._types("geometry_msgs/msg/WrenchStamped")(
            header=self.header(contact.part, t_ns),
            wrench=self._types("geometry_msgs/msg/Wrench")(
                force=self._vector(force.tolist()), torque=self._vector(torque.tolist())
            ),
        )

    def diagnostics(self, healths: Mapping[str, Health], t_ns: int) -> Any:
        """diagnostic_msgs/DiagnosticArray: a status a part, with its sentences."""
        pair = self._types("diagnostic_msgs/msg/KeyValue")
        status = self._types("diagnostic_msgs/msg/DiagnosticStatus")
        return self._types("diagnostic_msgs/msg/DiagnosticArray")(
            header=self.header("", t_ns),
            status=[
                status(
                    level=self._level(_LEVELS.get(health.state, ERROR)),
                    name=f"skin: {part}",
                    message="; ".join(health.sentences) or health.state,
                    hardware_id=part,
                    values=[
                        pair(key=key, value=str(health.record.get(key, "")))
                        for key in ("state", "rate_hz", "taxels", "valid_taxels")
                    ],
                )
                for part, health in healths.items()
            ],
        )

    def _contact(self, touch: Touch) -> Any:
        located = touch.centroid_m is not None
        nothing = math.nan
        return self._types("skin_host_msgs/msg/Contact")(
            id=touch.id,
            taxels=self._array("I", touch.taxels),
            located=located,
            centroid=self._point(touch.centroid_m or (0.0, 0.0, 0.0)),
            normal=self._vector(touch.normal or (0.0, 0.0, 0.0)),
            force_n=touch.force_n,
            peak_kpa=nothing if touch.peak_kpa is None else touch.peak_kpa,
            mean_kpa=nothing if touch.mean_kpa is None else touch.mean_kpa,
            area_mm2=nothing if touch.area_mm2 is None else touch.area_mm2,
            partial=touch.partial,
            beyond=touch.beyond,
            verdict="" if touch.load is None else touch.load.verdict,
        )

    def _point(self, place: Sequence[float]) -> Any:
        x, y, z = place
        return self._types("geometry_msgs/msg/Point")(x=x, y=y, z=z)

    def _vector(self, vector: Sequence[float]) -> Any:
        x, y, z = vector
        return self._types("geometry_msgs/msg/Vector3")(x=x, y=y, z=z)
