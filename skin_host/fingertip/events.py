"""Events of a fingertip besides touches: it slips, or it presses too hard.

In both, `id` is that of the contact in the part's touches, and `count` numbers the events of a kind
and part from this node; `missed` of them were lost just before a received one.
"""

from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from skin_host.processing.events import N_DECIMALS, Count, Nanoseconds, PartName, Touch

#: What indicated a slip.
Cause = Literal["rate", "friction", "fall"]


class Slip(
    Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="schema", tag="skin.slip/1"
):
    """A fingertip begins or stops to slip.

    Attributes:
        cause: what indicated it first: the rate of the tangential force, its share of the known
            limit of friction, or its abrupt fall.
        force_n, shear_n, shear_rate_n_s: normal force, tangential force and the latter's rate.
    """

    event: Literal["begin", "end"]
    id: Count
    t_ns: Nanoseconds
    count: Count = 0
    part: PartName
    cause: Cause
    force_n: float
    shear_n: float
    shear_rate_n_s: float
    missed: int = 0

    def published(self, count: int) -> "Slip":
        """Return the event as it is sent: numbered, and rounded."""
        return replace(
            self,
            count=count,
            force_n=round(self.force_n, N_DECIMALS),
            shear_n=round(self.shear_n, N_DECIMALS),
            shear_rate_n_s=round(self.shear_rate_n_s, N_DECIMALS),
        )


class Over(
    Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="schema", tag="skin.over/1"
):
    """A fingertip begins or stops to press harder than `over_n`: normal force `force_n`."""

    event: Literal["begin", "end"]
    id: Count
    t_ns: Nanoseconds
    count: Count = 0
    part: PartName
    force_n: float
    missed: int = 0

    def published(self, count: int) -> "Over":
        """Return the event as it is sent: numbered, and rounded."""
        return replace(self, count=count, force_n=round(self.force_n, N_DECIMALS))


FingertipEvent = Touch | Slip | Over
