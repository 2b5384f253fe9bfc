"""What a part says, as objects: the payloads of its topics, read."""

from collections.abc import Callable
from typing import Any, NamedTuple

from skin_host.publish.frames import Frame, decode_frame
from skin_host.publish.grasping import Over, Slip, decode_over, decode_slip
from skin_host.publish.messages import Touch, decode_contact, decode_health, decode_touch
from skin_host.publish.payload import MessageError
from skin_host.publish.topics import PartTopic


class Contact(NamedTuple):
    """Whether anything touches a part."""

    part: str
    touched: bool


class Health(NamedTuple):
    """How a part is; `docs/operations.md` explains the keys of `record`."""

    part: str
    record: dict[str, Any]


_EVENTS: dict[str, Callable[[bytes], Touch | Slip | Over]] = {
    "touch": decode_touch,
    "slip": decode_slip,
    "over": decode_over,
}


def read(
    kind: PartTopic, part: str, payload: bytes
) -> Touch | Slip | Over | Frame | Contact | Health | None:
    """Read what was said of a part; None says that a retained message was deleted.

    Raises:
        MessageError: it is not what the topic promises.
    """
    if kind in _EVENTS:
        event = _EVENTS[kind](payload)
        if event.part != part:
            raise MessageError(f'a {kind} of "{event.part}" among those of "{part}"')
        return event
    if kind == "frame":
        return decode_frame(part, payload)
    if not payload:
        return None
    if kind == "contact":
        return Contact(part, decode_contact(payload))
    return Health(part, decode_health(payload))
