"""Messages of touches, slips, contact and health. Pure: converts data to payload bytes and back.

`docs/mqtt.md` is the contract. A received frame is described here, too, and decoded in `frames`:
programs that only want touches never load numpy.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import msgspec
from msgspec import Struct

from skin_host.fingertip.events import FingertipEvent, Over, Slip
from skin_host.mqtt.payload import MessageError, decode, decode_event, other_schema
from skin_host.processing.events import Touch

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from skin_host.processing.masks import Mask

#: ON: touched; OFF: not touched; UNKNOWN: some of the part cannot feel.
ContactState = Literal["ON", "OFF", "UNKNOWN"]
HEALTH_SCHEMA: Final = "skin.health/1"
#: One unit of the values of a frame.
SCALE_KPA = 0.01


class Frame(Struct, frozen=True, eq=False):
    """A received frame. Arrays have one entry per taxel [m], in the part's order.

    Attributes:
        pressure_kpa: float64; 0 where not valid.
        valid: the taxel was received and is reliable.
        beyond_range: the pressure is above the calibrated range: its order is right, its
            value an estimate.
        raw: uint8, the bytes as the boards sent them; None unless they were requested
            (command `raw`).
        missed: how many sweeps of the part lie between this frame and the one received
            before it. They were lost, or left out on purpose (`mqtt.frame_hz`).
    """

    part: str
    seq: int
    t_ns: int
    pressure_kpa: "NDArray[np.float64]"
    valid: "Mask"
    beyond_range: "Mask"
    missed: int = 0
    raw: "NDArray[np.uint8] | None" = None


_encoder = msgspec.json.Encoder()
_CONTACT_STATES: dict[bytes, ContactState] = {
    state.encode(): state for state in get_args(ContactState)
}
_touch_decoder = msgspec.json.Decoder(Touch)
_slip_decoder = msgspec.json.Decoder(Slip)
_over_decoder = msgspec.json.Decoder(Over)
_health_decoder = msgspec.json.Decoder(dict[str, Any])


class _Fault(Struct):
    code: str
    where: str


class _HealthHead(Struct):
    """The keys of a health record that subscribers rely on, and their types."""

    state: str = ""
    kind: str = ""
    taxels: int = 0
    valid_taxels: int = 0
    rate_hz: float = 0.0
    age_ms: float | None = None
    faults: list[_Fault] = []
    sentences: list[str] = []


def encode_event(event: FingertipEvent, count: int) -> bytes:
    """Write the payload of `<part>/touch`, `slip` or `over`; `count` as in the events."""
    return _encoder.encode(event.published(count))


def decode_touch(payload: bytes) -> Touch:
    """Read the payload of `<part>/touch`.

    Raises:
        MessageError: it is not such a payload.
    """
    return decode_event(_touch_decoder, payload, "touch")


def decode_slip(payload: bytes) -> Slip:
    """Read the payload of `<part>/slip`; see `decode_touch`."""
    return decode_event(_slip_decoder, payload, "slip")


def decode_over(payload: bytes) -> Over:
    """Read the payload of `<part>/over`; see `decode_touch`."""
    return decode_event(_over_decoder, payload, "over")


#: By topic of a part: reads its events.
EVENT_DECODERS: dict[str, Callable[[bytes], FingertipEvent]] = {
    "touch": decode_touch,
    "slip": decode_slip,
    "over": decode_over,
}


def encode_contact(state: ContactState) -> bytes:
    """Write the payload of `<part>/contact`."""
    return state.encode()


def decode_contact(payload: bytes) -> ContactState:
    """Read the payload of `<part>/contact`.

    Raises:
        MessageError: it is not a contact state.
    """
    state = _CONTACT_STATES.get(payload)
    if state is None:
        raise MessageError(f"contact: {payload[:16]!r}; wanted ON, OFF or UNKNOWN")
    return state


def health_keys(record: Any) -> dict[str, Any]:
    """Return the keys of a health message: the record, after our schema."""
    keys: dict[str, Any] = msgspec.to_builtins(record)
    return {"schema": HEALTH_SCHEMA} | keys


def encode_health(record: Any) -> bytes:
    """Write the payload of `<part>/health`."""
    return _encoder.encode(health_keys(record))


def decode_health(payload: bytes) -> dict[str, Any]:
    """Read the payload of `<part>/health`.

    Raises:
        MessageError: it is not such a payload.
    """
    record = decode(_health_decoder, payload, "health")
    if record.get("schema") != HEALTH_SCHEMA:
        raise MessageError(other_schema("health", record.get("schema")))
    check_health(record)
    return record


def check_health(record: Any) -> None:
    """Check the keys of a health record that others rely on.

    Raises:
        MessageError: they have other types.
    """
    try:
        msgspec.convert(record, _HealthHead)
    except msgspec.ValidationError as error:
        raise MessageError(f"health: {error}") from None
