"""What is said: frames, touches, contact, health. Pure: data in, payload bytes out, and back.

Decoding takes bytes from strangers: sizes and types are checked, and whatever is wrong is
a `MessageError`. Keys that are not known are passed over, so that a later daemon may say
more. `docs/mqtt.md` is the contract.

A mask of taxels is a hexadecimal number in which bit i is taxel i of the part (bit 0 the
lowest); it is written with its most significant digit first, in lower case, padded with
zeros to one digit for every four taxels. Three taxels of which the first alone is valid
are "1"; twelve of which all but the last are valid are "7ff".
"""

import math
import re
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from skin_host.errors import SkinError
from skin_host.processing.contacts import Load, TouchEvent
from skin_host.processing.pipeline import PressureFrame

FRAME_SCHEMA: Final = "skin.frame/1"
TOUCH_SCHEMA: Final = "skin.touch/1"
HEALTH_SCHEMA: Final = "skin.health/1"
#: One unit of the values of a frame.
SCALE_KPA = 0.01
#: Decimals of kPa, of mm2, of m (0.001 mm), of N, of N m and of the parts of a unit vector.
KPA_DECIMALS = 3
MM2_DECIMALS = 2
M_DECIMALS = 6
N_DECIMALS = 4
NM_DECIMALS = 6
NORMAL_DECIMALS = 4
#: No honest message is longer, no part has more taxels.
MAX_BYTES = 4 * 1024 * 1024
MAX_TAXELS = 100_000

JSON_TYPE = "application/json"
CBOR_TYPE = "application/cbor"
#: RFC 8746, section 2.1: typed arrays of little-endian signed 16-bit and 32-bit integers.
_TYPED_ARRAYS: dict[int, np.dtype[Any]] = {77: np.dtype("<i2"), 78: np.dtype("<i4")}
_INT32 = 2**31 - 1

Mask = NDArray[np.bool_]
Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
HexMask = Annotated[str, Meta(max_length=MAX_TAXELS // 4)]
Vector = tuple[float, float, float]
T = TypeVar("T")
S = TypeVar("S", bound=Struct)
_HEX = re.compile("[0-9a-f]*")


class MessageError(SkinError):
    """A payload is not what its topic promises."""


class Frame(Struct, frozen=True, eq=False):
    """A frame as it was received. Arrays have one entry a taxel [m], in the part's order.

    Attributes:
        pressure_kpa: float64; 0 where not valid.
        valid: the taxel was received and is fit to be believed.
        beyond_range: the pressure is above the calibrated range: its order is right, its
            size a guess.
        raw: uint8, the bytes as the boards sent them; None unless somebody asked for them
            (command `raw`).
        missed: how many sweeps of the part lie between this frame and the one received
            before it. They were lost, or left out on purpose (`mqtt.frame_hz`).
    """

    part: str
    seq: int
    t_ns: int
    pressure_kpa: NDArray[np.float64]
    valid: Mask
    beyond_range: Mask
    missed: int = 0
    raw: NDArray[np.uint8] | None = None


class LoadMessage(Struct, frozen=True, kw_only=True):
    """What a force/torque board says of the contact on its fingertip.

    Attributes:
        verdict: whether one push on the surface gives this force and torque.
        force_n, torque_nm: of what touches on the fingertip, about the origin of its frame.
        shear_n: the share of the force along the surface; None without a place.
        flags: of the finger: search, move, touch, slip, over.
    """

    verdict: Literal["contact", "no_single_contact", "several_contacts", "saturated"]
    force_n: Vector
    torque_nm: Vector
    shear_n: Vector | None
    flags: Annotated[list[Annotated[str, Meta(max_length=16)]], Meta(max_length=16)]


class TouchMessage(Struct, frozen=True, kw_only=True):
    """A contact begins, moves or ends: the payload of `<part>/touch`.

    Attributes:
        id: of the contact, among those of its part.
        seq, t_ns: of the frame in which it happened.
        count: how many events of the part this node has had to say so far, this one
            included. A gap is a loss; it starts again at 1 with the node.
        taxels: numbers within the part.
        area_mm2, peak_kpa, mean_kpa: None on a fingertip without skin.
        sigma_m: radial standard error of `centroid_m`; None where it is not known.
    """

    schema: Literal["skin.touch/1"] = TOUCH_SCHEMA
    event: Literal["begin", "move", "end"]
    id: Count
    seq: Count
    t_ns: Int64
    count: Count = 0
    part: Annotated[str, Meta(max_length=64)]
    taxels: Annotated[list[Annotated[int, Meta(ge=0, le=MAX_TAXELS)]], Meta(max_length=MAX_TAXELS)]
    centroid_m: Vector | None
    normal: Vector | None
    area_mm2: float | None
    peak_kpa: float | None
    mean_kpa: float | None
    force_n: float
    sigma_m: Annotated[float, Meta(ge=0)] | None = None


class FingertipTouchMessage(TouchMessage, frozen=True, kw_only=True):
    """The same of a fingertip on a force/torque board, and what that says."""

    load: LoadMessage


class Touch(TouchMessage, frozen=True, kw_only=True):
    """An event as it was received; `missed` events of its part were lost just before it.

    Only fingertips on force/torque boards have a `load`.
    """

    load: LoadMessage | None = None
    missed: int = 0


class _FrameFields(Struct, omit_defaults=True):
    """The keys of a frame but for its values, which JSON and CBOR hold differently."""

    schema: Annotated[str, Meta(max_length=32)]
    seq: Count
    t_ns: Int64
    unit: Literal["kPa"]
    scale: Annotated[float, Meta(gt=0, le=1000)]
    values: Any
    valid: HexMask
    beyond_range: HexMask = ""
    #: One byte a taxel; base64 in JSON. Empty where they were not asked for.
    raw: Annotated[bytes, Meta(max_length=MAX_TAXELS)] = b""


_Value = Annotated[int, Meta(ge=-(2**31), le=_INT32)]
_Values = Annotated[list[_Value], Meta(max_length=MAX_TAXELS)]


class _JsonFrame(_FrameFields, omit_defaults=True):
    values: _Values


_encoder = msgspec.json.Encoder()
_frame_decoder = msgspec.json.Decoder(_JsonFrame)
_touch_decoder = msgspec.json.Decoder(Touch)
_health_decoder = msgspec.json.Decoder(dict[str, Any])


def encode_mask(mask: Mask) -> str:
    """Write a mask [m] as hexadecimal digits; see the head of this module."""
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
    frame: PressureFrame, encoding: Literal["json", "cbor"] = "json", *, raw: bool = False
) -> bytes:
    """Write the payload of `<part>/frame`, with the boards' own bytes if `raw`.

    A pressure that is not a finite number is sent as 0 and not valid. The key
    `beyond_range` is there only when a taxel is beyond its calibrated range.

    Raises:
        SkinError: CBOR is wanted and cbor2 is not installed.
    """
    scaled = frame.pressure_kpa.astype(np.float64) / SCALE_KPA
    valid = frame.valid
    finite = np.isfinite(scaled)
    if not finite.all():
        valid = valid & finite
        scaled = np.where(finite, scaled, 0.0)
    values = np.clip(np.rint(scaled), -_INT32, _INT32).astype(np.int32)
    fields = _FrameFields(
        FRAME_SCHEMA, frame.seq, frame.t_ns, "kPa", SCALE_KPA, None, encode_mask(valid)
    )
    if frame.beyond_range.any():
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
    check_size(payload)
    # A CBOR map starts with 0xA0 to 0xBF, a JSON object with a brace or white space.
    if payload[:1] >= b"\xa0":
        fields, values = _decode_cbor_frame(payload)
    else:
        fields = decode(_frame_decoder, payload, "frame")
        values = np.array(fields.values, np.int32)
    if fields.schema != FRAME_SCHEMA:
        raise MessageError(f'frame: schema "{fields.schema}"; this program reads {FRAME_SCHEMA}')
    n = len(values)
    beyond = decode_mask(fields.beyond_range, n) if fields.beyond_range else np.zeros(n, np.bool_)
    pressure_kpa = values.astype(np.float64) * fields.scale
    valid = decode_mask(fields.valid, n)
    raw = np.frombuffer(fields.raw, np.uint8) if fields.raw else None
    if raw is not None and len(raw) != n:
        raise MessageError(f"frame: {len(raw)} raw bytes for {n} taxels")
    return Frame(part, fields.seq, fields.t_ns, pressure_kpa, valid, beyond, raw=raw)


def touch_message(event: TouchEvent, count: int) -> TouchMessage:
    """What is said of an event; `count` as in `TouchMessage`. Numbers are rounded as above."""
    said: dict[str, Any] = {
        "event": event.event,
        "id": event.id,
        "seq": event.seq,
        "t_ns": event.t_ns,
        "count": count,
        "part": event.part,
        "taxels": event.taxels,
        "centroid_m": _vector(event.centroid_m, M_DECIMALS),
        "normal": _vector(event.normal, NORMAL_DECIMALS),
        "area_mm2": _known(event.area_mm2, MM2_DECIMALS),
        "peak_kpa": _known(event.peak_kpa, KPA_DECIMALS),
        "mean_kpa": _known(event.mean_kpa, KPA_DECIMALS),
        "force_n": round(event.force_n, N_DECIMALS),
        "sigma_m": None if event.sigma_m is None else round(event.sigma_m, M_DECIMALS),
    }
    if event.load is None:
        return TouchMessage(**said)
    return FingertipTouchMessage(**said, load=_load_message(event.load))


def encode_touch(event: TouchEvent, count: int) -> bytes:
    """Write the payload of `<part>/touch`."""
    return _encoder.encode(touch_message(event, count))


def decode_touch(payload: bytes) -> Touch:
    """Read the payload of `<part>/touch`.

    Raises:
        MessageError: it is not such a payload.
    """
    return decode_event(_touch_decoder, payload, "touch")


def encode_contact(touched: bool) -> bytes:
    """Write the payload of `<part>/contact`."""
    return b"ON" if touched else b"OFF"


def decode_contact(payload: bytes) -> bool:
    """Read the payload of `<part>/contact`.

    Raises:
        MessageError: it is neither ON nor OFF.
    """
    if payload not in (b"ON", b"OFF"):
        raise MessageError(f"contact: {payload[:16]!r}; wanted ON or OFF")
    return payload == b"ON"


def encode_health(record: Any) -> bytes:
    """Write the payload of `<part>/health`: a record with keys, and our schema first."""
    return _encoder.encode({"schema": HEALTH_SCHEMA} | _keys(record))


def decode_health(payload: bytes) -> dict[str, Any]:
    """Read the payload of `<part>/health`.

    Raises:
        MessageError: it is not such a payload.
    """
    check_size(payload)
    record = decode(_health_decoder, payload, "health")
    if record.get("schema") != HEALTH_SCHEMA:
        raise MessageError(f"health: wanted the schema {HEALTH_SCHEMA}")
    return record


def frame_line(frame: PressureFrame) -> bytes:
    """Write a frame as a line of `skin replay`: arrays of all taxels, kPa with three decimals."""
    # Adding 0 turns a rounded -0.0 into 0.0.
    pressure = np.round(frame.pressure_kpa.astype(np.float64), KPA_DECIMALS) + 0.0
    return line(
        "frame",
        {
            "part": frame.part,
            "seq": frame.seq,
            "t_ns": frame.t_ns,
            "raw": frame.raw.tolist(),
            "pressure_kpa": pressure.tolist(),
            "touched": frame.touched.tolist(),
            "valid": frame.valid.tolist(),
        },
    )


def touch_line(event: TouchEvent, count: int) -> bytes:
    """Write an event as a line of `skin replay`: the payload as published, and its type."""
    return line("touch", _keys(touch_message(event, count)))


def health_line(record: Any) -> bytes:
    """Write a health record as a line of `skin replay`."""
    return line("health", {"schema": HEALTH_SCHEMA} | _keys(record))


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
    cbor2 = load_cbor2()
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


def decode(decoder: "msgspec.json.Decoder[T]", payload: bytes, what: str) -> T:
    """Read a payload of the topic `what`.

    Raises:
        MessageError: it is not such a payload.
    """
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"{what}: {error}") from None


def decode_event(decoder: "msgspec.json.Decoder[S]", payload: bytes, what: str) -> S:
    """Read a numbered event of the topic `what`; how many were missed is not the sender's to say.

    Raises:
        MessageError: it is not such a payload.
    """
    check_size(payload)
    return replace(decode(decoder, payload, what), missed=0)


def check_size(payload: bytes) -> None:
    """Refuse what no honest program sends.

    Raises:
        MessageError: it is too long.
    """
    if len(payload) > MAX_BYTES:
        raise MessageError(f"a message of {len(payload)} bytes; wanted at most {MAX_BYTES}")


def _keys(record: Any) -> dict[str, Any]:
    keys: dict[str, Any] = msgspec.to_builtins(record)
    return keys


def line(kind: str, keys: dict[str, Any]) -> bytes:
    """Write a line of `skin replay` of this type."""
    return _encoder.encode({"type": kind} | keys) + b"\n"


def _load_message(load: Load) -> LoadMessage:
    return LoadMessage(
        verdict=load.verdict,
        force_n=_rounded(load.force_n, N_DECIMALS),
        torque_nm=_rounded(load.torque_nm, NM_DECIMALS),
        shear_n=_vector(load.shear_n, N_DECIMALS),
        flags=load.flags,
    )


def _known(value: float, decimals: int) -> float | None:
    return None if math.isnan(value) else round(value, decimals)


def _vector(values: list[float] | None, decimals: int) -> Vector | None:
    if values is None:
        return None
    return _rounded(values, decimals)


def _rounded(values: list[float], decimals: int) -> Vector:
    x, y, z = (round(value, decimals) + 0.0 for value in values)
    return x, y, z
