"""What the pipeline reports of contacts. Plain data: subscribers import this without numpy."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from msgspec import Meta, Struct

Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Vector = tuple[float, float, float]

#: Why a contact ended: it is no longer felt; nothing valid comes from where it was; or the daemon
#: stopped, or changed how it decides.
Reason = Literal["released", "lost", "stopped"]


#: Published decimals of m (0.001 mm), of N, of N m and of the parts of a unit vector.
M_DECIMALS = 6
N_DECIMALS = 4
NM_DECIMALS = 6
NORMAL_DECIMALS = 4


class Load(Struct, frozen=True):
    """Force/torque data of the contact on a fingertip, as it is published.

    Attributes:
        verdict: whether one push on the surface gives this force and torque.
        force_n, torque_nm: of the touching object on the fingertip, about the origin of its frame.
        shear_n: the share of the force along the surface; None without a place.
        flags: of the finger, see `fingertip.grasp.Flags`, in lower case.
    """

    verdict: Literal["contact", "no_single_contact", "several_contacts", "saturated"]
    force_n: Vector
    torque_nm: Vector
    shear_n: Vector | None
    flags: Annotated[list[Annotated[str, Meta(max_length=16)]], Meta(max_length=16)]


@dataclass(frozen=True, slots=True)
class TouchEvent:
    """A contact begins, moves or ends.

    Taxels are numbered within their part. Positions are in the part's frame. `sigma_m` is the
    radial standard error of `centroid_m`, in the skin; None where the place is not known. `end`
    has the last place of the contact, and its pressures are 0. Without skin, on a fingertip that
    has only a force/torque board, area and pressures are NaN; `load` is given only there.
    `reason` is that of an end.
    """

    event: Literal["begin", "move", "end"]
    id: int
    seq: int
    t_ns: int
    part: str
    taxels: list[int]
    centroid_m: list[float] | None
    normal: list[float] | None
    area_mm2: float
    peak_kpa: float
    mean_kpa: float
    force_n: float
    sigma_m: float | None = None
    load: Load | None = None
    reason: Reason | None = None

    def ended(self, seq: int, t_ns: int, reason: Reason = "released") -> "TouchEvent":
        """The contact's end: where it was last; what is known of its pressures is 0."""
        nothing_kpa = math.nan if math.isnan(self.area_mm2) else 0.0
        return replace(
            self,
            event="end",
            seq=seq,
            t_ns=t_ns,
            peak_kpa=nothing_kpa,
            mean_kpa=nothing_kpa,
            force_n=0.0,
            reason=reason,
        )


def rounded(values: Sequence[float], decimals: int) -> Vector:
    """Round a vector; without -0.0."""
    x, y, z = (round(value, decimals) + 0.0 for value in values)
    return x, y, z
