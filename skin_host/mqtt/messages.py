"""Messages of touches, slips, contact and health. Pure: converts data to payload bytes and back.

`docs/mqtt.md` is the contract. A received frame is described here, too, and decoded in `frames`:
programs that only want touches never load numpy.
"""

import math
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, get_args

import msgspec
from msgspec import Meta, Struct, field
from msgspec.structs import replace

from skin_host.fingertip.events import Over, PartName, Slip
from skin_host.mqtt.payload import MAX_TAXELS, MessageError, decode, decode_event
from skin_host.processing.events import (
    M_DECIMALS,
    N_DECIMALS,
    NORMAL_DECIMALS,
    Count,
    Int64,
    Load,
    Reason,
    TouchEvent,
    Vector,
    rounded,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from skin_host.processing.masks import Mask

#: ON: touched; OFF: not touched; UNKNOWN: some of the part cannot feel.
ContactState = Literal["ON", "OFF", "UNKNOWN"]
HEALTH_SCHEMA: Final = "skin.health/1"
#: One unit of the values of a frame.
SCALE_KPA = 0.01
#: Decimals of kPa and of mm2; see `processing.events` for the others.
KPA_DECIMALS = 3
MM2_DECIMALS = 2


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


class Touch(
    Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="schema", tag="skin.touch/1"
):
    """A contact begins, moves or ends: the payload of `<part>/touch`.

    Attributes:
        id: of the contact, among those of its part.
        seq, t_ns: of the frame in which it happened.
        count: number of events of the part from this node so far, this one included. A gap is a
            loss; it starts again at 1 with the node.
        taxels: numbers within the part.
        area_mm2, peak_kpa, mean_kpa: None on a fingertip without skin.
        sigma_m: radial standard error of `centroid_m`; None where it is not known.
        reason: why it ended, only with an end.
        load: only of fingertips on force/torque boards.
        missed: of a received event: so many of its part were lost just before it.
    """

    event: Literal["begin", "move", "end"]
    id: Count
    seq: Count
    t_ns: Int64
    count: Count = 0
    part: PartName
    taxels: Annotated[list[Annotated[int, Meta(ge=0, le=MAX_TAXELS)]], Meta(max_length=MAX_TAXELS)]
    centroid_m: Vector | None
    normal: Vector | None
    area_mm2: float | None
    peak_kpa: float | None
    mean_kpa: float | None
    force_n: float
    #: Written even where it is None: only a plain default is left out.
    sigma_m: Annotated[float, Meta(ge=0)] | None = field(default_factory=lambda: None)
    reason: Reason | None = None
    load: Load | None = None
    missed: int = 0


_encoder = msgspec.json.Encoder()
_CONTACT_STATES: dict[bytes, ContactState] = {
    state.encode(): state for state in get_args(ContactState)
}
_touch_decoder = msgspec.json.Decoder(Touch)
_slip_decoder = msgspec.json.Decoder(Slip)
_over_decoder = msgspec.json.Decoder(Over)
_health_decoder = msgspec.json.Decoder(dict[str, Any])


def touch_message(event: TouchEvent, count: int) -> Touch:
    """Return the message of an event; `count` as in `Touch`. Numbers are rounded."""
    return Touch(
        event=event.event,
        id=event.id,
        seq=event.seq,
        t_ns=event.t_ns,
        count=count,
        part=event.part,
        taxels=event.taxels,
        centroid_m=_vector(event.centroid_m, M_DECIMALS),
        normal=_vector(event.normal, NORMAL_DECIMALS),
        area_mm2=_known(event.area_mm2, MM2_DECIMALS),
        peak_kpa=_known(event.peak_kpa, KPA_DECIMALS),
        mean_kpa=_known(event.mean_kpa, KPA_DECIMALS),
        force_n=round(event.force_n, N_DECIMALS),
        sigma_m=None if event.sigma_m is None else round(event.sigma_m, M_DECIMALS),
        reason=event.reason,
        load=event.load,
    )


def encode_touch(event: TouchEvent, count: int) -> bytes:
    """Write the payload of `<part>/touch`."""
    return _encoder.encode(touch_message(event, count))


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


def encode_grasp(event: Slip | Over, count: int) -> bytes:
    """Write the payload of `<part>/slip` or `<part>/over`; `count` as in the events."""
    return _encoder.encode(replace(event, count=count))


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
        raise MessageError(f"health: wanted the schema {HEALTH_SCHEMA}")
    return record


def _known(value: float, decimals: int) -> float | None:
    return None if math.isnan(value) else round(value, decimals)


def _vector(values: list[float] | None, decimals: int) -> Vector | None:
    return None if values is None else rounded(values, decimals)
