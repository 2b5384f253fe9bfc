"""Payloads of every topic: how they are typed, and how those of strangers are read. Pure.

Sizes and types are checked, and whatever is wrong is a `MessageError`. Keys that are not
known are passed over, so that a later daemon may say more.
"""

from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from skin_host.errors import SkinError

#: No honest message is longer, but for those that say so; no part has more taxels.
MAX_BYTES = 4 * 1024 * 1024
MAX_TAXELS = 100_000

JSON_TYPE = "application/json"
CBOR_TYPE = "application/cbor"

Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Vector = tuple[float, float, float]
T = TypeVar("T")
S = TypeVar("S", bound=Struct)


class MessageError(SkinError):
    """A payload is not what its topic promises."""


def check_size(payload: bytes, what: str, max_bytes: int = MAX_BYTES) -> None:
    """Refuse what no honest program sends in a payload of the topic `what`.

    Raises:
        MessageError: it is too long.
    """
    if len(payload) > max_bytes:
        raise MessageError(f"{what}: {len(payload)} bytes; wanted at most {max_bytes}")


def decode(
    decoder: "msgspec.json.Decoder[T]", payload: bytes, what: str, max_bytes: int = MAX_BYTES
) -> T:
    """Read a payload of the topic `what`.

    Raises:
        MessageError: it is not such a payload, or too long.
    """
    check_size(payload, what, max_bytes)
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"{what}: {error}") from None


def decode_event(decoder: "msgspec.json.Decoder[S]", payload: bytes, what: str) -> S:
    """Read a numbered event of the topic `what`; how many were missed is not the sender's to say.

    Raises:
        MessageError: it is not such a payload.
    """
    return replace(decode(decoder, payload, what), missed=0)
