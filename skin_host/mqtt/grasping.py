"""Messages of slips and of pressing too hard: `<part>/slip`, `<part>/over`. Pure."""

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta, Struct

from skin_host.fingertip.events import OverEvent, SlipEvent
from skin_host.mqtt.messages import N_DECIMALS
from skin_host.mqtt.payload import Count, Int64, decode_event

SLIP_SCHEMA: Final = "skin.slip/1"
OVER_SCHEMA: Final = "skin.over/1"
Part = Annotated[str, Meta(max_length=64)]


class SlipMessage(Struct, frozen=True, kw_only=True):
    """A fingertip begins or stops to slip: the payload of `<part>/slip`.

    Attributes:
        id: of the contact, as in the touches of the part.
        count: number of slip events of the part from this node so far.
        cause: what indicated it first: the rate of the tangential force, its share of the known
            limit of friction, or its abrupt fall.
        force_n, shear_n, shear_rate_n_s: normal force, tangential force and the latter's rate.
    """

    schema: Literal["skin.slip/1"] = SLIP_SCHEMA
    event: Literal["begin", "end"]
    id: Count
    t_ns: Int64
    count: Count = 0
    part: Part
    cause: Literal["rate", "friction", "fall"]
    force_n: float
    shear_n: float
    shear_rate_n_s: float


class OverMessage(Struct, frozen=True, kw_only=True):
    """A fingertip begins or stops to press harder than configured: the payload of `<part>/over`.

    Attributes:
        id: of the contact, as in the touches of the part.
        count: number of such events of the part from this node so far.
        force_n: normal force.
    """

    schema: Literal["skin.over/1"] = OVER_SCHEMA
    event: Literal["begin", "end"]
    id: Count
    t_ns: Int64
    count: Count = 0
    part: Part
    force_n: float


class Slip(SlipMessage, frozen=True, kw_only=True):
    """A received slip; `missed` slip events of its part were lost just before it."""

    missed: int = 0


class Over(OverMessage, frozen=True, kw_only=True):
    """A received excess; `missed` as in `Slip`."""

    missed: int = 0


_slip_decoder = msgspec.json.Decoder(Slip)
_over_decoder = msgspec.json.Decoder(Over)


def grasp_message(event: SlipEvent | OverEvent, count: int) -> SlipMessage | OverMessage:
    """Return the message of an event; `count` as in the messages."""
    if isinstance(event, OverEvent):
        return OverMessage(
            event=event.event,
            id=event.id,
            t_ns=event.t_ns,
            count=count,
            part=event.part,
            force_n=round(event.force_n, N_DECIMALS),
        )
    return SlipMessage(
        event=event.event,
        id=event.id,
        t_ns=event.t_ns,
        count=count,
        part=event.part,
        cause=event.cause,
        force_n=round(event.force_n, N_DECIMALS),
        shear_n=round(event.shear_n, N_DECIMALS),
        shear_rate_n_s=round(event.shear_rate_n_s, N_DECIMALS),
    )


def encode_grasp(event: SlipEvent | OverEvent, count: int) -> bytes:
    """Write the payload of `<part>/slip` or `<part>/over`."""
    return msgspec.json.encode(grasp_message(event, count))


def decode_slip(payload: bytes) -> Slip:
    """Read the payload of `<part>/slip`.

    Raises:
        MessageError: it is not such a payload.
    """
    return decode_event(_slip_decoder, payload, "slip")


def decode_over(payload: bytes) -> Over:
    """Read the payload of `<part>/over`.

    Raises:
        MessageError: it is not such a payload.
    """
    return decode_event(_over_decoder, payload, "over")
