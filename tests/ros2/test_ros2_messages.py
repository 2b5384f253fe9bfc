"""What the ROS 2 node sends, serialised and read back without ROS.

rclpy, launch and colcon are on no package index: the node itself was not run. Cyclone DDS is, which
ROS 2 sends messages with.
"""

import ast
import importlib.util
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from skin_host.client import Contact, Frame, Health, PartInfo, Touch
from skin_host.mqtt.info import TriangleInfo
from skin_host.processing.events import Load
from tests.support.cdr import typestore

ROS2 = Path(__file__).parents[2] / "ros2"
NODE = (ROS2 / "skin_host_ros/skin_host_ros/node.py").read_text()
T_NS = 1_700_000_000_123_456_789
ON = Contact("arm", "ON")


def module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


messages = module(ROS2 / "skin_host_ros/skin_host_ros/messages.py")


def as_array(code: str, values: Sequence[Any]) -> Any:
    return np.frombuffer(values, np.uint8) if isinstance(values, bytes) else np.array(values, code)


@pytest.fixture(scope="module")
def store() -> Any:
    return typestore()


@pytest.fixture(scope="module")
def made(store: Any) -> Any:
    return messages.Messages(store.types.__getitem__, as_array, int)


@pytest.fixture
def again(store: Any) -> Callable[[Any], Any]:
    """A message as another process reads it: CDR and back."""

    def read(message: Any) -> Any:
        name = message.__msgtype__
        return store.deserialize_cdr(store.serialize_cdr(message, name), name)

    return read


SHAPE = PartInfo(
    period_ms=50,
    pads=["pressure", "pressure", "thermal"],
    position_m=[(0.0, 0.0, 0.0), (0.005, 0.0, 0.0), (0.01, 0.0, 0.001)],
    normal=[(0.0, 0.0, 1.0)] * 3,
    radius_mm=[2.0] * 3,
    area_mm2=[25.0] * 3,
    triangles=[TriangleInfo("b", 0, "triangle", 0, [(0.0, 0.0, 0.0)] * 3)],
)
FRAME = Frame(
    part="arm",
    seq=7,
    t_ns=T_NS,
    pressure_kpa=np.array([1.5, 20.0, 3.0], np.float32),
    valid=np.array([True, True, False]),
    beyond_range=np.array([False, True, False]),
    raw=None,
)
TOUCH = Touch(
    event="begin",
    id=3,
    seq=7,
    t_ns=T_NS,
    part="arm",
    taxels=[0, 1],
    centroid_m=(0.1, 0.0, 0.0),
    normal=(0.0, 0.0, 1.0),
    area_mm2=50.0,
    peak_kpa=20.0,
    mean_kpa=10.0,
    force_n=2.0,
)


def test_taxels_keep_what_is_valid_and_their_time(made: Any, again: Callable[[Any], Any]) -> None:
    seen = again(made.taxels(FRAME))
    np.testing.assert_array_equal(seen.pressure_kpa, np.array([1.5, 20, np.nan], np.float32))
    assert seen.valid.tolist() == [True, True, False]
    assert seen.beyond_range.tolist() == [False, True, False]
    stamp = seen.header.stamp
    assert stamp.sec * 1_000_000_000 + stamp.nanosec == T_NS
    assert (seen.header.frame_id, seen.seq) == ("arm", 7)
    layout = again(made.layout("arm", SHAPE, T_NS))
    assert [point.x for point in layout.position] == [0.0, 0.005, 0.01]
    assert layout.thermal.tolist() == [False, False, True]


def test_a_point_cloud_has_a_row_a_taxel(made: Any, again: Callable[[Any], Any]) -> None:
    seen = again(made.cloud(FRAME, SHAPE))
    points = np.frombuffer(seen.data, "<f4").reshape(seen.width, -1)
    assert seen.point_step == 16 == 4 * len(seen.fields)
    assert seen.row_step == len(seen.data)
    np.testing.assert_allclose(points[1], [0.005, 0.0, 0.0, 20.0])
    assert np.isnan(points[2, 3])
    assert not seen.is_dense


def test_contacts_and_their_wrench(store: Any, made: Any, again: Callable[[Any], Any]) -> None:
    seen = again(made.contacts(ON, [TOUCH], T_NS))
    (contact,) = seen.contacts
    assert (seen.state, seen.state) == (store.types["skin_host_msgs/msg/ContactArray"].ON, 1)
    assert (contact.id, contact.taxels.tolist(), contact.located) == (3, [0, 1], True)
    unknown = again(made.contacts(Contact("arm", "UNKNOWN", "offline"), [], T_NS))
    assert (unknown.state, unknown.why) == (2, "offline")
    wrench = again(made.wrench(ON, [TOUCH], T_NS)).wrench
    assert wrench.force.z == -2.0  # into the skin
    assert wrench.torque.y == pytest.approx(0.2)


def test_the_wrench_on_a_fingertip_is_what_its_board_measures(
    made: Any, again: Callable[[Any], Any]
) -> None:
    """With the force along the surface, and of several contacts that have no one place."""
    load = Load("several_contacts", (0.5, 0.0, -2.0), (0.01, 0.0, 0.002), None, ["touch"])
    several = replace(TOUCH, centroid_m=None, normal=None, load=load)
    wrench = again(made.wrench(ON, [several], T_NS)).wrench
    assert (wrench.force.x, wrench.force.z) == (0.5, -2.0)
    assert (wrench.torque.x, wrench.torque.z) == (0.01, 0.002)
    # Beyond its range it measures a bound, and not nothing.
    saturated = replace(several, load=replace(load, verdict="saturated"), beyond=True)
    assert again(made.wrench(ON, [saturated], T_NS)).wrench.force.z == -2.0
    (contact,) = again(made.contacts(ON, [saturated], T_NS)).contacts
    assert (contact.verdict, contact.beyond, contact.partial) == ("saturated", True, False)


@pytest.mark.parametrize(
    ("state", "force_n"), [("OFF", 0.0), ("ON", math.nan), ("UNKNOWN", math.nan)]
)
def test_wrench_is_0_only_where_nothing_touches(
    made: Any, again: Callable[[Any], Any], state: Any, force_n: float
) -> None:
    wrench = again(made.wrench(Contact("arm", state), [], T_NS)).wrench
    seen = [getattr(of, axis) for of in (wrench.force, wrench.torque) for axis in "xyz"]
    np.testing.assert_array_equal(seen, [force_n] * 6)


#: Fields of a touch that no message of ROS has, and why.
LEFT_OUT = {
    "event": "an array holds what lasts now",
    "reason": "the same: an end is not in it, and an end that is none is in the state",
    "seq": "the header has the time",
    "t_ns": "the header has the time",
    "count": "nothing is counted: the array is whole",
    "missed": "the array is whole",
    "sigma_m": "of the place alone",
}
#: Of a load; the wrench of the part has its force and torque.
LEFT_OUT_OF_LOAD = {"force_n", "torque_nm", "shear_n", "flags"}


def test_what_a_touch_has_is_passed_on_or_left_out_on_purpose(store: Any) -> None:
    message = set(store.types["skin_host_msgs/msg/Contact"].__dataclass_fields__)
    known = {"centroid_m": "centroid", "load": "verdict", "part": None}
    for field in Touch.__struct_fields__:
        name = known.get(field, field)
        assert name is None or (name in message) is not (field in LEFT_OUT), field
    assert {*Load.__struct_fields__} == LEFT_OUT_OF_LOAD | {"verdict"}


def test_health_is_diagnostics(made: Any, again: Callable[[Any], Any]) -> None:
    record: Any = {"state": "degraded", "sentences": ["taxel 3: stuck"], "rate_hz": 20.0}
    (status,) = again(made.diagnostics({"arm": Health("arm", record)}, T_NS)).status
    assert (status.level, status.hardware_id) == (messages.WARN, "arm")
    assert status.message == "taxel 3: stuck"
    assert {pair.key: pair.value for pair in status.values}["rate_hz"] == "20.0"


def test_they_can_be_kept_in_a_bag(store: Any, made: Any, tmp_path: Path) -> None:
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer

    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for topic, message in (
            ("arm/taxels", made.taxels(FRAME)),
            ("arm/points", made.cloud(FRAME, SHAPE)),
        ):
            kind = message.__msgtype__
            connection = bag.add_connection(f"/{topic}", kind, typestore=store)
            bag.write(connection, T_NS, store.serialize_cdr(message, kind))
    with Reader(tmp_path / "bag") as bag:
        seen = {c.topic: store.deserialize_cdr(data, c.msgtype) for c, _, data in bag.messages()}
    assert seen["/arm/taxels"].seq == 7
    assert seen["/arm/points"].width == 3


def test_other_processes_receive_the_same_bytes_over_dds(
    store: Any, made: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Under the names that ROS 2 gives topics and types, as rmw_cyclonedds_cpp would send them."""
    pytest.importorskip("cyclonedds", reason="no wheel of cyclonedds for this Python or machine")
    from cyclonedds.domain import DomainParticipant

    from tests.support import dds

    sick: Any = {"state": "degraded", "sentences": ["taxel 3: stuck"], "rate_hz": 20.0}
    sent = {
        message.__msgtype__: bytes(store.serialize_cdr(message, message.__msgtype__))
        for message in (
            made.taxels(FRAME),
            made.layout("arm", SHAPE, T_NS),
            made.cloud(FRAME, SHAPE),
            made.contacts(ON, [TOUCH], T_NS),
            made.wrench(ON, [TOUCH], T_NS),
            made.diagnostics({"arm": Health("arm", sick)}, T_NS),
        )
    }
    monkeypatch.setenv("CYCLONEDDS_URI", dds.loopback(str(tmp_path)))
    participant = DomainParticipant()
    writers = [dds.publish(participant, name, cdr) for name, cdr in sent.items()]
    process = subprocess.run(
        [sys.executable, "-m", "tests.support.dds", *sent],
        cwd=ROS2.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert len(writers) == len(sent)  # they live until here
    received = json.loads(process.stdout or "{}")
    assert set(received) == set(sent), process.stderr
    assert {name: bytes.fromhex(one["cdr"]) for name, one in received.items()} == sent
    assert received["sensor_msgs/msg/PointCloud2"]["topic"] == "rt/arm/pointcloud2"
    assert received["skin_host_msgs/msg/ContactArray"]["type"] == (
        "skin_host_msgs::msg::dds_::ContactArray_"
    )


def test_the_packages_hold_together() -> None:
    """Names that only ROS would resolve: imports of the node, interfaces, the launch file."""
    built = (ROS2 / "skin_host_msgs/CMakeLists.txt").read_text()
    interfaces = {path.name for path in (ROS2 / "skin_host_msgs").glob("*/*.[ms][sr][gv]")}
    assert interfaces == set(re.findall(r"(\w+\.(?:msg|srv))$", built, re.MULTILINE))
    needed = re.findall(r"_depend>(\w+)<", (ROS2 / "skin_host_ros/package.xml").read_text())
    tree = ast.parse(NODE)
    imported = {
        (node.module or "").partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
    }
    known = {"array", "collections", "functools", "typing", "skin_host", "skin_host_ros"}
    assert imported - known <= set(needed)
    launch = (ROS2 / "skin_host_ros/launch/skin.launch.py").read_text()
    setup = (ROS2 / "skin_host_ros/setup.py").read_text()
    assert 'executable="skin"' in launch
    assert "skin = {NAME}.node:main" in setup
    for name in re.findall(r'"(\w+)": LaunchConfiguration', launch):
        assert f'declare_parameter("{name}"' in NODE
