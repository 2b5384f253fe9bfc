"""Received messages of a part as objects: decodes the payloads of its topics."""

from typing import TYPE_CHECKING, NamedTuple, cast

from skin_host.client.presence import Contact
from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.info import FingertipInfo, PartInfo
from skin_host.mqtt.messages import EVENT_DECODERS, Frame, decode_contact, decode_health
from skin_host.mqtt.order import Stamp
from skin_host.mqtt.payload import MessageError
from skin_host.mqtt.topics import ONLINE, PartTopic
from skin_host.processing.events import Touch

if TYPE_CHECKING:
    from skin_host.health.record import Record


class Health(NamedTuple):
    """Health of a part; `docs/operations.md` explains the keys of `record`.

    A fingertip on a force/torque board has only some of them, and others. `stored` is true of what
    the broker, or the client, had before it was asked for: it does not show that the part lives.
    """

    part: str
    record: "Record"
    stored: bool = False

    @property
    def state(self) -> str:
        """Return `ok`, `warning`, `degraded`, ...; reasons for any but `ok` are in `sentences`."""
        return self.record.get("state", "")

    @property
    def codes(self) -> set[str]:
        """Return the codes of all present faults."""
        return {fault["code"] for fault in self.record.get("faults", [])}

    @property
    def sentences(self) -> list[str]:
        return self.record.get("sentences", [])


class Described(NamedTuple):
    """A part or fingertip, as the node describes it that has it now.

    A part may have moved from one node to another, which both name it: it is that of the node that
    is online, and of several the one whose info is the newest. In a stream `info` is None, and
    `node` empty, when no node names the part any more.
    """

    part: str
    node: str
    info: PartInfo | FingertipInfo | None

    @property
    def skin(self) -> PartInfo | None:
        """Where its taxels are, if it is a part of skin."""
        return self.info if isinstance(self.info, PartInfo) else None

    @property
    def fingertip(self) -> FingertipInfo | None:
        """Its shape, if it is a fingertip on a force/torque board."""
        return self.info if isinstance(self.info, FingertipInfo) else None


def is_online(payload: bytes, stamp: Stamp | None, *, is_only_broker: bool) -> bool | None:
    """Return whether a node is online by its status; None: that does not show it.

    A last will means that a connection has ended. Where there are several brokers, the node may
    have another connection by then, of which nothing has been received yet.
    """
    if payload == ONLINE:
        return True
    is_will = stamp is not None and stamp.is_last_will
    return None if not payload or (is_will and not is_only_broker) else False


def read(
    kind: PartTopic, part: str, payload: bytes, *, stored: bool = False
) -> Touch | Slip | Over | Frame | Contact | Health | None:
    """Decode a message of a part; None means that a retained message was deleted.

    Args:
        kind: of topic.
        part: whose.
        payload: of the message.
        stored: the broker had it before it was asked for.

    Raises:
        MessageError: the payload does not fit the topic.
    """
    if kind in EVENT_DECODERS:
        event = EVENT_DECODERS[kind](payload)
        if event.part != part:
            raise MessageError(f'a {kind} of "{event.part}" among those of "{part}"')
        return event
    if kind == "frame":
        # numpy makes up half of the time that it takes to import the client.
        from skin_host.mqtt.frames import decode_frame

        return decode_frame(part, payload)
    if not payload:
        return None
    if kind == "contact":
        return Contact(part, decode_contact(payload))
    return Health(part, cast("Record", decode_health(payload)), stored)
