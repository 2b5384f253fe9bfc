"""JSON that anybody may have written: a message of a broker, a wish of a page, a file."""

from functools import lru_cache
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")


def from_json(data: bytes | str, kind: type[T]) -> T:
    """Read JSON as a value of a type.

    Raises:
        msgspec.DecodeError: it is not JSON, or not such a value. No other error is raised.
    """
    decoder: msgspec.json.Decoder[T] = _decoder(kind)  # type: ignore[arg-type]  # types are hashable
    return decoded(decoder, data)


def decoded(decoder: "msgspec.json.Decoder[T]", data: bytes | str) -> T:
    """Read JSON with a decoder.

    Raises:
        msgspec.DecodeError: see `from_json`.
    """
    try:
        return decoder.decode(data)
    except RecursionError:
        raise msgspec.DecodeError("nested too deep") from None
    except UnicodeDecodeError as error:
        raise msgspec.DecodeError(f"not text: {error.reason} at byte {error.start}") from None


@lru_cache
def _decoder(kind: Any) -> "msgspec.json.Decoder[Any]":
    return msgspec.json.Decoder(kind)
