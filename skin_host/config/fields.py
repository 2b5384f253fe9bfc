"""Types of single values that several files use.

Each quantity has a range: wider than any robot needs, narrow enough that what is computed from it
stays finite and rises with the reading. A value outside of it is a mistake of units, or a typo.
"""

from typing import Annotated
from urllib.parse import urlsplit

from msgspec import Meta

#: What a pattern permits, for messages.
PATTERNS: dict[str, str] = {}


def _text(pattern: str, permitted: str) -> str:
    PATTERNS[pattern] = permitted
    return pattern


#: Names end up in MQTT topics and in file names. `$` alone would also let a line end pass.
Name = Annotated[
    str,
    Meta(pattern=_text(r"^[a-z0-9_-]+(?!\n)$", "the characters a-z, 0-9, - and _"), max_length=64),
]
#: What steers a terminal, and the zero byte, which the system refuses.
_UNPRINTABLE = "\\x00-\\x1f\\x7f-\\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff"
#: Free text.
Printable = Annotated[
    str, Meta(pattern=_text(f"^[^{_UNPRINTABLE}]*$", "characters that can be printed"))
]
#: One computer: no URL and no port. An IPv6 address has two colons or more.
Host = Annotated[
    str,
    Meta(
        pattern=_text(
            f"^([^:/{_UNPRINTABLE}]+|([^:/{_UNPRINTABLE}]*:){{2}}[^/{_UNPRINTABLE}]*)(?!\n)$",
            "a host alone; its port is the key `port`",
        )
    ),
]
#: A file, from the folder of the configuration.
FileName = Annotated[Printable, Meta(extra={"names": "file"})]
#: host, host:port or [IPv6]:port
Address = Annotated[
    str,
    Meta(
        pattern=_text(
            r"^([A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?(?!\n)$",
            "host, host:port or [IPv6]:port",
        )
    ),
]


def host_and_port(address: str, port: int) -> tuple[str, int]:
    """Return the host and the port of an `Address`, by default `port`.

    Raises:
        ValueError: it has a number that no port has, or no IPv6 address in its brackets.
    """
    parts = urlsplit(f"//{address}")
    given = parts.port
    if given == 0 or parts.hostname is None:
        raise ValueError("wanted a port from 1 to 65535")
    return parts.hostname, given or port


#: Sizes: of pads, foams, probes, fingertips.
Millimetres = Annotated[float, Meta(ge=0.001, le=10_000)]
#: Coordinates.
PlaceMm = Annotated[float, Meta(ge=-1_000_000, le=1_000_000)]
Seconds = Annotated[float, Meta(ge=0.001, le=1e9)]
Hertz = Annotated[float, Meta(ge=0.001, le=1_000_000)]
#: A byte has no more.
Units = Annotated[float, Meta(ge=0, le=255)]
#: In newtons, or newton metres.
Newtons = Annotated[float, Meta(ge=1e-6, le=1e6)]
#: Coefficients of capacitance and pressure; `PressureCurve` judges what becomes of them together.
Coefficient = Annotated[float, Meta(ge=-1e6, le=1e6)]
PositiveCoefficient = Annotated[float, Meta(ge=1e-6, le=1e6)]
#: What a mode of the foam takes of the pressure.
Share = Annotated[float, Meta(ge=0, le=1)]
