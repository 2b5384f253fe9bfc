"""Events of a fingertip besides touches: it slips, or it presses too hard. Their published form.

In both, `id` is that of the contact in the part's touches, and `count` numbers the events of a kind
and part from this node; `missed` of them were lost just before a received one.
"""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from skin_host.processing.events import Count, Int64, TouchEvent

#: What indicated a slip.
Cause = Literal["rate", "friction", "fall"]
PartName = Annotated[str, Meta(max_length=64)]


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
    t_ns: Int64
    count: Count = 0
    part: PartName
    cause: Cause
    force_n: float
    shear_n: float
    shear_rate_n_s: float
    missed: int = 0


class Over(
    Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="schema", tag="skin.over/1"
):
    """A fingertip begins or stops to press harder than `over_n`: normal force `force_n`."""

    event: Literal["begin", "end"]
    id: Count
    t_ns: Int64
    count: Count = 0
    part: PartName
    force_n: float
    missed: int = 0


FingertipEvent = TouchEvent | Slip | Over
