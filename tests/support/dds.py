"""DDS as ROS 2 uses it, without ROS: Cyclone DDS under ROS's names of topics and types.

As a program it is the subscriber in another process: `python -m tests.support.dds TYPE...` waits
for one message on the topic of each type and prints them as JSON.
"""

import json
import sys
import time
from functools import cache
from typing import Any
from xml.sax.saxutils import escape

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype

from tests.support.cdr import typestore
from tests.support.waiting import PATIENCE_S

_SCALARS = {"bool": bool, "string": str, "char": types.uint8}
#: What rmw_cyclonedds_cpp makes of a reliable, transient local profile: late subscribers get all.
_KEPT = Qos(
    Policy.Reliability.Reliable(max_blocking_time=1_000_000_000),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(1),
)


def loopback(tag: str) -> str:
    """A value of CYCLONEDDS_URI: loopback without multicast; only the same tag is heard."""
    return f"""<CycloneDDS><Domain Id="any">
        <General>
            <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
            <AllowMulticast>false</AllowMulticast>
        </General>
        <Discovery>
            <Tag>{escape(tag)}</Tag>
            <ParticipantIndex>auto</ParticipantIndex>
            <MaxAutoParticipantIndex>100</MaxAutoParticipantIndex>
            <Peers><Peer address="127.0.0.1"/></Peers>
        </Discovery>
    </Domain></CycloneDDS>"""


def topic_name(name: str) -> str:
    """The DDS topic of a message that these tests send: `rt/` and then ROS's name of a topic."""
    return f"rt/arm/{name.rpartition('/')[2].lower()}"


@cache
def structure(name: str) -> type[IdlStruct]:
    """The IDL type of `package/msg/Name`, called as ROS calls it: `package::msg::dds_::Name_`."""
    package, folder, kind = name.split("/")
    fields = {field: _idl(of) for field, of in typestore().fielddefs[name][1]}
    return make_idl_struct(f"{kind}_", f"{package}::{folder}::dds_::{kind}_", fields)


def _idl(field: Any) -> Any:
    node, of = field
    if node == Nodetype.BASE:
        return _SCALARS.get(of[0]) or getattr(types, of[0])
    if node == Nodetype.NAME:
        return structure(of)
    of_one, size = of
    one = _idl(of_one)
    return types.array[one, size] if node == Nodetype.ARRAY else types.sequence[one]


def publish(participant: DomainParticipant, name: str, cdr: bytes) -> DataWriter[Any]:
    """Publish a serialised message; it can be received as long as the writer lives."""
    topic = Topic(participant, topic_name(name), structure(name))
    writer: DataWriter[Any] = DataWriter(participant, topic, qos=_KEPT)
    writer.write(structure(name).deserialize(cdr))
    return writer


def receive(names: list[str]) -> dict[str, dict[str, str]]:
    """Wait for one message of each type; its topic, its type as announced, and its bytes."""
    participant = DomainParticipant()
    readers: dict[str, DataReader[Any]] = {
        name: DataReader(
            participant, Topic(participant, topic_name(name), structure(name)), qos=_KEPT
        )
        for name in names
    }
    got: dict[str, dict[str, str]] = {}
    give_up = time.monotonic() + PATIENCE_S
    while len(got) < len(names) and time.monotonic() < give_up:
        for name in names:
            for sample in readers[name].take():
                topic = readers[name].topic
                got[name] = {
                    "topic": topic.name,
                    "type": topic.typename,
                    "cdr": sample.serialize().hex(),
                }
        time.sleep(0.01)
    return got


if __name__ == "__main__":
    sys.stdout.write(json.dumps(receive(sys.argv[1:])))
