"""Payloads of every topic: types, and decoding of untrusted input. Pure.

Sizes and types are checked, and every error is a `MessageError`. Unknown keys are ignored, so that
a later daemon may add some.
"""

from typing import TypeVar

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from skin_host.errors import SkinError, visible
from skin_host.untrusted import decoded, from_json

#: No valid message is longer, with stated exceptions.
MAX_BYTES = 4 * 1024 * 1024
#: The largest valid payload with its topic and properties.
MAX_PACKET_BYTES = MAX_BYTES + 80_000

JSON_TYPE = "application/json"
CBOR_TYPE = "application/cbor"

T = TypeVar("T")
S = TypeVar("S", bound=Struct)


class MessageError(SkinError):
    """A payload does not fit its topic."""


class _Schema(Struct):
    schema: str = ""


def other_schema(what: str, seen: object) -> str:
    """Return that a payload of the topic `what` has a schema that is not ours."""
    return (
        f'{what}: schema "{visible(str(seen), 64)}"; this program reads skin.{what}/1: it needs '
        "the version of skin-host that published it"
    )


def check_size(payload: bytes, what: str, max_bytes: int = MAX_BYTES) -> None:
    """Refuse a payload of the topic `what` that is longer than any valid one.

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
        return decoded(decoder, payload)
    except msgspec.DecodeError as error:
        why = f"{what}: {error}"
    try:
        seen = from_json(payload, _Schema).schema
    except msgspec.DecodeError:
        raise MessageError(why) from None
    is_ours = seen in ("", f"skin.{what}/1") or not seen.startswith(f"skin.{what}/")
    raise MessageError(why if is_ours else other_schema(what, seen))


def decode_event(decoder: "msgspec.json.Decoder[S]", payload: bytes, what: str) -> S:
    """Read a numbered event of the topic `what`; `missed` is never taken from the sender.

    Raises:
        MessageError: it is not such a payload.
    """
    return replace(decode(decoder, payload, what), missed=0)
