"""Checks untrusted CBOR before it is decoded. Pure.

The decoder accepts everything that CBOR can describe: sets, patterns, mails, and references by
which 170 bytes become a key whose hash takes for ever. Our payloads need far less: maps with text
for keys, lists, numbers, text, bytes and typed arrays.
Source: RFC 8949, section 3; RFC 8746, section 2.
"""

from skin_host.mqtt.payload import MessageError

#: Limits of a valid payload: depth of nested values, and number of all values.
MAX_DEPTH = 16
MAX_ITEMS = 10_000
#: Typed arrays of integers.
_TAGS = {77, 78}
_BYTES, _TEXT, _ARRAY, _MAP, _TAG = 2, 3, 4, 5, 6


def check_cbor(payload: bytes, what: str) -> None:
    """Refuse a payload of the topic `what` with items that valid payloads never have.

    Raises:
        MessageError: it has such items, or it breaks off.
    """
    at = 0
    #: The number of items that each open map and list still needs; a map's entries are text and
    #: value.
    open_items: list[tuple[bool, int]] = [(False, 1)]
    for _ in range(MAX_ITEMS):
        while open_items and not open_items[-1][1]:
            open_items.pop()
        if not open_items:
            return
        is_map, left = open_items.pop()
        open_items.append((is_map, left - 1))
        major, count, at = _head(payload, at, what)
        if is_map and left % 2 == 0 and major != _TEXT:
            raise MessageError(f"{what}: a key in CBOR that is not text")
        if major in (_BYTES, _TEXT):
            at += count
        elif major in (_ARRAY, _MAP):
            open_items.append((major == _MAP, count * (2 if major == _MAP else 1)))
        elif major == _TAG:
            if count not in _TAGS:
                raise MessageError(f"{what}: tag {count} in CBOR; wanted none but 77 and 78")
            open_items.append((False, 1))
        if at > len(payload) or len(open_items) > MAX_DEPTH:
            break
    raise MessageError(f"{what}: CBOR that breaks off, or is nested or long beyond reason")


def _head(payload: bytes, at: int, what: str) -> tuple[int, int, int]:
    """Return major type and number of the item that begins at `at`, and where its head ends."""
    if at >= len(payload):
        raise MessageError(f"{what}: CBOR that breaks off")
    major, short = payload[at] >> 5, payload[at] & 0x1F
    at += 1
    if short < 24:
        return major, short, at
    if short > 27:
        raise MessageError(f"{what}: CBOR without a definite length")
    size = 1 << (short - 24)
    return major, int.from_bytes(payload[at : at + size], "big"), at + size
