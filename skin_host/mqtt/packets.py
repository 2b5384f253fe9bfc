"""MQTT packets as bytes: numbers and text in them, and limits that are checked before decoding.
Pure.

paho decodes properties in quadratic time: 80 kB of them take a second, 700 kB most of a minute.
So packets that are too long or have too many properties are found here first, in bounded time.
Source: MQTT 5.0, sections 1.5.4 (text), 1.5.5 (variable byte integer), 2.2.2 (properties) and 3.3
(PUBLISH); MQTT 3.1.1 has no properties.

Of what is published, frames are the most, and differ only in their payload: the head of a topic's
packet is encoded once.
"""

from typing import NamedTuple

#: Of a packet that is larger than its reader takes, this much is kept until it is acknowledged.
KEPT_BYTES = 70_000
#: Packets besides PUBLISH are short: acknowledgements and their reasons.
MAX_OTHER_BYTES = 8192
MAX_PROPERTY_BYTES = 4096
MAX_PROPERTIES = 32

_PUBLISH = 0x30
#: In the first byte of a PUBLISH: QoS 1, and to be retained.
_QOS_1, _RETAIN = 0x02, 0x01
#: The largest variable byte integer: the maximum length of a packet after its fixed header.
_MOST_BYTES = 268_435_455
#: Bytes of a property's value by its identifier; strings, binary data and pairs have a length.
_FIXED = {
    0x01: 1, 0x02: 4, 0x11: 4, 0x13: 2, 0x17: 1, 0x18: 4, 0x19: 1, 0x21: 2,
    0x22: 2, 0x23: 2, 0x24: 1, 0x25: 1, 0x27: 4, 0x28: 1, 0x29: 1, 0x2A: 1,
}  # fmt: skip
_STRINGS = {0x03: 1, 0x08: 1, 0x09: 1, 0x12: 1, 0x15: 1, 0x16: 1, 0x1A: 1, 0x1C: 1, 0x1F: 1}
_STRINGS[0x26] = 2  # user property: name and value
_SUBSCRIPTION = 0x0B


class Unfit(NamedTuple):
    """Why a packet is not decoded; `mid` is the number in its acknowledgement, 0 without one."""

    why: str
    mid: int = 0
    is_publish: bool = False


def unfit(
    command: int, packet: bytes | bytearray, length: int, limit: int, v5: bool
) -> Unfit | None:
    """Find a packet that must not be decoded. Malformed ones are left to the decoder.

    Args:
        command: first byte of the packet.
        packet: what follows the fixed header, or the first `KEPT_BYTES` of it.
        length: of all that follows.
        limit: the longest PUBLISH that its reader takes, in bytes.
        v5: whether packets have properties.
    """
    if command & 0xF0 != _PUBLISH:
        if length > MAX_OTHER_BYTES:
            return Unfit(f"a packet of {length} bytes that is no message")
        return None
    name_end = 2 + int.from_bytes(packet[:2], "big")
    has_mid = command & 0x06
    mid = int.from_bytes(packet[name_end : name_end + 2], "big") if has_mid else 0
    if length > limit:
        return Unfit(f"a message of {length} bytes; wanted at most {limit}", mid, True)
    topic = packet[2:name_end]
    if not topic or any(byte in topic for byte in b"+#\0") or not _is_text(topic):
        return Unfit("a message with an invalid topic", mid, True)
    if v5:
        why = _properties(packet, name_end + (2 if has_mid else 0))
        if why is not None:
            return Unfit(why, mid, True)
    return None


def _properties(packet: bytes | bytearray, at: int) -> str | None:
    """Why the properties that begin at `at` are not decoded."""
    size, at = unpack_number(packet, at)
    if size > MAX_PROPERTY_BYTES:
        return f"a message with {size} bytes of properties; wanted at most {MAX_PROPERTY_BYTES}"
    end = at + size
    for _ in range(MAX_PROPERTIES + 1):
        if at >= min(end, len(packet)):
            return None
        identifier = packet[at]
        at += 1
        if identifier == _SUBSCRIPTION:
            _, at = unpack_number(packet, at)
        elif identifier in _FIXED:
            at += _FIXED[identifier]
        else:
            for _ in range(_STRINGS.get(identifier, 0)):
                at += 2 + int.from_bytes(packet[at : at + 2], "big")
            if identifier not in _STRINGS:
                return None  # malformed: the decoder reports it
    return f"a message with more than {MAX_PROPERTIES} properties"


def publish_head(topic: str, properties: bytes | None) -> bytes:
    """Return the bytes between fixed header and payload of a PUBLISH with QoS 0.

    Args:
        topic: where to.
        properties: packed, with their length; None for MQTT 3.1.1.
    """
    return pack_text(topic) + (properties or b"")


def publish_packet(head: bytes, payload: bytes, first: int = _PUBLISH) -> bytes:
    """A whole PUBLISH.

    Args:
        head: of `publish_head`.
        payload: of the message.
        first: byte of the packet; that of QoS 0, not retained, by default.

    Raises:
        ValueError: it is longer than a packet can be.
    """
    left = len(head) + len(payload)
    if left > _MOST_BYTES:
        raise ValueError(f"a packet of {left} bytes; wanted at most {_MOST_BYTES}")
    return b"".join((bytes((first,)), pack_number(left), head, payload))


def numbered_packet(
    topic: str, number: int, properties: bytes | None, payload: bytes, *, retain: bool
) -> bytes:
    """A whole PUBLISH with QoS 1.

    Args:
        topic: where to.
        number: by which it is acknowledged.
        properties: packed, with their length; None for MQTT 3.1.1.
        payload: of the message.
        retain: whether the broker keeps it.

    Raises:
        ValueError: it is longer than a packet can be.
    """
    head = b"".join((pack_text(topic), number.to_bytes(2, "big"), properties or b""))
    return publish_packet(head, payload, _PUBLISH | _QOS_1 | retain * _RETAIN)


def pack_number(number: int) -> bytes:
    """Write a variable byte integer."""
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    found.append(number)
    return bytes(found)


def pack_text(text: str) -> bytes:
    """Write text with its length."""
    octets = text.encode()
    return len(octets).to_bytes(2, "big") + octets


def unpack_number(packet: bytes | bytearray, at: int) -> tuple[int, int]:
    """Return the variable byte integer at `at`, as far as it is there, and where it ends."""
    value = 0
    for shift in range(0, 28, 7):
        if at >= len(packet):
            break
        byte = packet[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            break
    return value, at


def _is_text(topic: bytes | bytearray) -> bool:
    try:
        topic.decode()
    except UnicodeDecodeError:
        return False
    return True
