"""What anybody may have written: JSON of a broker, a page or a file, and the host of a request."""

from collections.abc import Collection
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


def names_us(host: str, names: Collection[str]) -> bool:
    """Return whether a header `Host` has an address, which nobody can make point elsewhere, or one
    of these names.
    """
    # Only those that serve pages need them, and every command reads files.
    import ipaddress
    from urllib.parse import urlsplit

    try:
        name = urlsplit(f"//{host}").hostname or ""
        if name not in names:
            ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
