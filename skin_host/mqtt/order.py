"""Numbers that show which of two messages of a node is newer, whichever broker they came from.

Brokers that failed and came back send stored messages, last wills too, and a cluster sends a
message to a subscriber several times from several nodes. User properties of MQTT 5 put them in
order:

- `run`, of events and frames: the number of this run of the node; within it `count` or `seq` rises.
- `stamp`, of retained messages: two numbers with a dot between, that of the connection and that of
  the message in it, which is 1 for the last will only.

Runs and connections have rising numbers: nanoseconds since 1970, by the clock of the node. Those of
messages rise with the nanoseconds since the connection began: a subscriber that sees the distance
to its own clock grow knows that messages come late.

The status has another one, `parts`: of which parts the node publishes. The next start of the node
finds it at the broker, and with it what an earlier configuration left there.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from skin_host.mqtt.connection import Will
from skin_host.mqtt.topics import NAME

STAMP = "stamp"
RUN = "run"
PARTS = "parts"
#: Names beyond this length are left out: a message has 4 KiB of properties.
MAX_PARTS_BYTES = 3000
#: Longer numbers are not nanoseconds.
_MAX_DIGITS = 19
#: A run that comes after a later one than this would have a longer number.
_LAST_RUN = 10**_MAX_DIGITS - 10**9
_ONLINE, _LAST_WILL = 0, 1


class Stamp(NamedTuple):
    """When a retained message was published: the greater one is newer."""

    connection: int
    message: int

    @property
    def sent_s(self) -> float:
        """When it was published, by the node's clock."""
        return (self.connection + self.message) * 1e-9

    @property
    def is_last_will(self) -> bool:
        """Whether the broker published it: the connection has ended, but perhaps not the node."""
        return self.message == _LAST_WILL


class Numbers:
    """Gives the numbers of a node.

    Args:
        now_ns: time of day; it may be set back.
        monotonic_ns: a time that is never set.
    """

    def __init__(self, now_ns: Callable[[], int], monotonic_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._monotonic_ns = monotonic_ns
        self._last = 0
        self._message = 0
        self._began_ns = monotonic_ns()
        self.run = self.connection = self._next()

    def _next(self) -> int:
        self._last = max(self._now_ns(), self._last + 1)
        return self._last

    def connect(self) -> None:
        """Continue with the numbers of the next connection."""
        self.connection = self._next()
        self._message = _LAST_WILL
        self._began_ns = self._monotonic_ns()

    @property
    def online(self) -> Stamp:
        """Return the stamp of the status while the connection lasts."""
        return Stamp(self.connection, _ONLINE)

    @property
    def last_will(self) -> Stamp:
        """Return the stamp of what the broker publishes when the connection breaks."""
        return Stamp(self.connection, _LAST_WILL)

    def state(self) -> Stamp:
        """Return the stamp of any other retained message, also of the node's own `offline`."""
        self._message = max(self._message + 1, self._monotonic_ns() - self._began_ns)
        return Stamp(self.connection, self._message)

    def overtake(self, stamp: Stamp) -> bool:
        """Begin a run that is newer than one that left a message, if that one looks newer.

        A forged number that leaves no room above it is not followed: nobody could read ours.
        """
        if not self.connection < stamp.connection < _LAST_RUN:
            return False
        self._last = max(self._last, stamp.connection)
        self.run = self._next()
        return True


def put_run(properties: Properties | None, run: int) -> None:
    """Add the number of the run to a message; MQTT 3.1.1 has no place for it."""
    if properties is not None:
        properties.UserProperty = (RUN, str(run))


def put_stamp(properties: Properties | None, stamp: Stamp) -> None:
    """Add the stamp to a retained message; MQTT 3.1.1 has no place for it."""
    if properties is not None:
        properties.UserProperty = (STAMP, f"{stamp.connection}.{stamp.message}")


def that_fit(parts: Sequence[str], room_bytes: int | None = None) -> Sequence[str]:
    """Return the first of these parts, as many as a status has room to name.

    Args:
        parts: of which the node publishes.
        room_bytes: in a packet that the broker takes, if there is a limit.
    """
    most = MAX_PARTS_BYTES if room_bytes is None else min(MAX_PARTS_BYTES, room_bytes)
    ends = accumulate(len(name) + 1 for name in parts)  # with a comma behind each
    return parts[: bisect_right(list(ends), most + 1)]


def put_parts(properties: Properties | None, parts: Sequence[str]) -> None:
    """Add to a status of which parts the node publishes; MQTT 3.1.1 has no place for it."""
    if properties is not None and parts:
        properties.UserProperty = (PARTS, ",".join(parts))


def last_will(topic: str, payload: bytes, stamp: Stamp | None, parts: Sequence[str] = ()) -> Will:
    """Return the broker's message for a node that vanishes; without a stamp for MQTT 3.1.1."""
    properties = None
    if stamp is not None:
        properties = Properties(PacketTypes.WILLMESSAGE)  # type: ignore[no-untyped-call]
        put_stamp(properties, stamp)
        put_parts(properties, parts)
    return Will(topic, payload, qos=1, retain=True, properties=properties)


def run_of(properties: Any) -> int | None:
    """Return the number of a message's run, if it has one."""
    return _number(_user_property(properties, RUN))


def stamp_of(properties: Any) -> Stamp | None:
    """Return the stamp of a retained message, if it has one."""
    text, _, rest = _user_property(properties, STAMP).partition(".")
    connection, message = _number(text), _number(rest)
    return None if connection is None or message is None else Stamp(connection, message)


def parts_of(properties: Any) -> set[str]:
    """Return the parts of which a node published, by its status."""
    return set(filter(NAME.fullmatch, _user_property(properties, PARTS).split(",")))


def _user_property(properties: Any, name: str) -> str:
    return next((v for key, v in getattr(properties, "UserProperty", ()) if key == name), "")


def _number(text: str) -> int | None:
    fit = len(text) <= _MAX_DIGITS and text.isascii() and text.isdecimal()
    return int(text) if fit else None
