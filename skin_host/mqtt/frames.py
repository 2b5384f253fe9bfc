"""Pressure of a part: the payload of `<part>/frame`, JSON or CBOR.

Pure: arrays to bytes and back.

A mask of taxels is a hexadecimal number in which bit i is taxel i of the part (bit 0 the
lowest); it is written with its most significant digit first, in lower case, padded with
zeros to one digit for every four taxels. Three taxels of which only the first is valid
are "1"; twelve of which all but the last are valid are "7ff".

Untrusted CBOR is checked before it is decoded. The decoder accepts everything that CBOR can
describe: sets, patterns, mails, and references by which 170 bytes become a key whose hash takes for
ever. Our payloads need far less: maps with text for keys, lists, numbers, text, bytes and typed
arrays. Source: RFC 8949, section 3; RFC 8746, section 2.
"""

import re
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from skin_host.errors import SkinError
from skin_host.mqtt.messages import SCALE_KPA, Frame
from skin_host.mqtt.payload import MessageError, check_size, decode, other_schema
from skin_host.processing.events import MAX_TAXELS, Count, Nanoseconds
from skin_host.processing.masks import Mask, any_of

FRAME_SCHEMA: Final = "skin.frame/1"
#: RFC 8746, section 2.1: typed arrays of little-endian signed 16-bit and 32-bit integers.
_TYPED_ARRAYS: dict[int, np.dtype[Any]] = {77: np.dtype("<i2"), 78: np.dtype("<i4")}
_INT32 = 2**31 - 1
_HEX = re.compile("[0-9a-f]*")
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


if TYPE_CHECKING:
    from skin_host.processing.frame import PressureFrame


HexMask = Annotated[str, Meta(max_length=MAX_TAXELS // 4)]


class _FrameFields(Struct, omit_defaults=True):
    """The keys of a frame without its values, which JSON and CBOR store differently."""

    schema: Annotated[str, Meta(max_length=32)]
    seq: Count
    t_ns: Nanoseconds
    unit: Literal["kPa"]
    scale: Annotated[float, Meta(gt=0, le=1000)]
    values: Any
    valid: HexMask
    beyond_range: HexMask = ""
    #: One byte per taxel; base64 in JSON. Empty if they were not requested.
    raw: Annotated[bytes, Meta(max_length=MAX_TAXELS)] = b""


_Value = Annotated[int, Meta(ge=-(2**31), le=_INT32)]
_Values = Annotated[list[_Value], Meta(max_length=MAX_TAXELS)]


class JsonFrame(_FrameFields, omit_defaults=True):
    """Pressure of a part at one instant, one value a taxel: `<part>/frame` in JSON."""

    values: _Values


_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder(JsonFrame)


def encode_mask(mask: Mask) -> str:
    """Write a mask [m] as hexadecimal digits; see the head of this module."""
    return _hex_of(mask.tobytes())


@lru_cache(maxsize=256)
def _hex_of(bits: bytes) -> str:
    """A mask, given as its bytes; most masks are those of the part's last frame."""
    mask = np.frombuffer(bits, np.bool_)
    number = int.from_bytes(np.packbits(mask, bitorder="little").tobytes(), "little")
    return f"{number:0{(len(mask) + 3) // 4}x}" if len(mask) else ""


def decode_mask(text: str, n: int) -> Mask:
    """Read a mask of `n` taxels.

    Raises:
        MessageError: it has not the digits of `n` taxels, or bits beyond them.
    """
    if len(text) != (n + 3) // 4:
        raise MessageError(f"a mask has {len(text)} digits; wanted {(n + 3) // 4} for {n} taxels")
    if not _HEX.fullmatch(text):
        raise MessageError("a mask holds something else than digits 0-9 and a-f")
    number = int(text or "0", 16)
    if number >> n:
        raise MessageError(f"a mask has bits beyond its {n} taxels")
    octets = np.frombuffer(number.to_bytes((n + 7) // 8, "little"), np.uint8)
    return np.unpackbits(octets, count=n, bitorder="little").astype(np.bool_)


def encode_frame(
    frame: "PressureFrame", encoding: Literal["json", "cbor"] = "json", *, raw: bool = False
) -> bytes:
    """Write the payload of `<part>/frame`, with the boards' own bytes if `raw`.

    A pressure that is not a finite number is sent as 0 and not valid. The key
    `beyond_range` is there only when a taxel is beyond its calibrated range.

    Raises:
        SkinError: CBOR is wanted and cbor2 is not installed.
    """
    scaled = np.divide(frame.pressure_kpa, SCALE_KPA, dtype=np.float64)
    np.rint(scaled, out=scaled)
    valid = frame.valid
    # No number can be larger than the root of this, which is not true of what is no number.
    if not np.dot(scaled, scaled) <= _INT32**2:
        finite = np.isfinite(scaled)
        valid = valid & finite
        scaled = np.clip(np.where(finite, scaled, 0.0), -_INT32, _INT32)
    values = scaled.astype(np.int32)
    fields = _FrameFields(
        FRAME_SCHEMA, frame.seq, frame.t_ns, "kPa", SCALE_KPA, None, encode_mask(valid)
    )
    if any_of(frame.beyond_range):
        fields.beyond_range = encode_mask(frame.beyond_range)
    if raw:
        fields.raw = frame.raw.tobytes()
    if encoding == "json":
        fields.values = values.tolist()
        return _encoder.encode(fields)
    cbor2 = load_cbor2()
    small = bool(np.abs(values).max(initial=0) < 2**15)
    tag = 77 if small else 78
    fields.values = cbor2.CBORTag(tag, values.astype(_TYPED_ARRAYS[tag]).tobytes())
    keys = {key: getattr(fields, key) for key in fields.__struct_fields__}
    for key in ("beyond_range", "raw"):
        if not keys[key]:
            del keys[key]
    encoded: bytes = cbor2.dumps(keys)
    return encoded


def decode_frame(part: str, payload: bytes) -> Frame:
    """Read the payload of `<part>/frame`, JSON or CBOR.

    Raises:
        MessageError: it is not such a payload.
        SkinError: it is CBOR and cbor2 is not installed.
    """
    # A CBOR map starts with 0xA0 to 0xBF, a JSON object with a brace or white space.
    if payload[:1] >= b"\xa0":
        fields, values = _decode_cbor_frame(payload)
    else:
        fields = decode(_decoder, payload, "frame")
        values = np.array(fields.values, np.int32)
    if fields.schema != FRAME_SCHEMA:
        raise MessageError(other_schema("frame", fields.schema))
    n = len(values)
    beyond = decode_mask(fields.beyond_range, n) if fields.beyond_range else np.zeros(n, np.bool_)
    pressure_kpa = values.astype(np.float64) * fields.scale
    valid = decode_mask(fields.valid, n)
    raw = np.frombuffer(fields.raw, np.uint8) if fields.raw else None
    if raw is not None and len(raw) != n:
        raise MessageError(f"frame: {len(raw)} raw bytes for {n} taxels")
    return Frame(part, fields.seq, fields.t_ns, pressure_kpa, valid, beyond, raw=raw)


def load_cbor2() -> Any:
    """Import cbor2, which is an extra.

    Raises:
        SkinError: it is not installed.
    """
    try:
        import cbor2
    except ImportError:
        raise SkinError(
            "CBOR frames need the package cbor2, which is not installed; "
            "mend it with: pip install 'skin-host[cbor]'"
        ) from None
    return cbor2


def _decode_cbor_frame(payload: bytes) -> tuple[_FrameFields, NDArray[np.int32]]:
    check_size(payload, "frame")
    cbor2 = load_cbor2()
    check_cbor(payload, "frame")
    try:
        keys = cbor2.loads(payload)
        fields = msgspec.convert(keys, _FrameFields)
    except (cbor2.CBORDecodeError, ValueError, TypeError, ArithmeticError, RecursionError) as error:
        raise MessageError(f"frame: {error}") from None
    tagged = fields.values
    item = _TYPED_ARRAYS.get(tagged.tag) if isinstance(tagged, cbor2.CBORTag) else None
    data = tagged.value if item else None
    if item is None or not isinstance(data, bytes) or len(data) % item.itemsize:
        raise MessageError("frame: values: wanted a typed array of RFC 8746 with tag 77 or 78")
    values = np.frombuffer(data, item).astype(np.int32)
    if len(values) > MAX_TAXELS:
        raise MessageError(f"frame: {len(values)} taxels; wanted at most {MAX_TAXELS}")
    return fields, values
