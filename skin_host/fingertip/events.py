"""Events of a fingertip besides touches: it slips, or it presses too hard."""

from dataclasses import dataclass
from typing import Literal

from skin_host.processing.events import TouchEvent

#: What indicated a slip.
Cause = Literal["rate", "friction", "fall"]


@dataclass(frozen=True, slots=True)
class SlipEvent:
    """A fingertip begins or stops to slip.

    Attributes:
        id: of the contact, as in its touches.
        cause: what indicated it: the rate of the tangential force, its share of the known limit of
            friction, or its abrupt fall.
        force_n, shear_n, shear_rate_n_s: normal force, tangential force and the latter's rate.
    """

    event: Literal["begin", "end"]
    id: int
    t_ns: int
    part: str
    cause: Cause
    force_n: float
    shear_n: float
    shear_rate_n_s: float


@dataclass(frozen=True, slots=True)
class OverEvent:
    """A fingertip begins or stops to press harder than `over_n`."""

    event: Literal["begin", "end"]
    id: int
    t_ns: int
    part: str
    force_n: float


FingertipEvent = TouchEvent | SlipEvent | OverEvent
