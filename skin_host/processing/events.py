"""Events of contacts, from the pipeline to the subscriber. Imported without numpy."""

from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta, Struct, field
from msgspec.structs import replace

#: No part has more.
MAX_TAXELS = 100_000

#: The last time that numpy and the formats of recordings hold, in the year 2262.
LATEST_NS = 2**63 - 1
#: Since 1970.
Nanoseconds = Annotated[int, Meta(ge=0, le=LATEST_NS)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Vector = tuple[float, float, float]
PartName = Annotated[str, Meta(max_length=64)]

#: Why a contact ended: it is no longer felt; nothing valid comes from where it was; or the daemon
#: stopped, or changed how it decides.
Reason = Literal["released", "lost", "stopped"]


#: Published decimals of kPa, mm2, m (0.001 mm), N, N m and of the parts of a unit vector.
KPA_DECIMALS = 3
MM2_DECIMALS = 2
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


class Touch(
    Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="schema", tag="skin.touch/1"
):
    """A contact begins, moves or ends: what `<part>/touch` publishes.

    Attributes:
        id: of the contact, among those of its part.
        seq, t_ns: of the frame in which it happened.
        count: number of events of the part from this node so far, this one included; 0 before it
            is published. A gap is a loss; it starts again at 1 with the node.
        taxels: numbers within the part.
        centroid_m, normal: in the part's frame; None where the place is not known. An end has the
            last place of the contact; its pressures are 0.
        area_mm2, peak_kpa, mean_kpa: None on a fingertip without skin.
        sigma_m: radial standard error of `centroid_m`, in the skin, never 0; None where it is not
            known.
        partial: whether pads of the contact, or next to it, are not valid: more of it may be there
            than is felt.
        beyond: whether any of its pads is pressed beyond its calibrated range: pressures and force
            are estimates, and bounds from below where readings are cut off. Also whether the board
            of a fingertip is saturated; of its force this is so only then.
        reason: why it ended, only with an end.
        load: only of fingertips on force/torque boards.
        missed: of a received event: so many of its part were lost just before it.
    """

    event: Literal["begin", "move", "end"]
    id: Count
    seq: Count
    t_ns: Nanoseconds
    count: Count = 0
    part: PartName
    taxels: Annotated[list[Annotated[int, Meta(ge=0, le=MAX_TAXELS)]], Meta(max_length=MAX_TAXELS)]
    centroid_m: Vector | None
    normal: Vector | None
    area_mm2: float | None
    peak_kpa: float | None
    mean_kpa: float | None
    force_n: float
    #: Written even where it is None: only a plain default is left out.
    sigma_m: Annotated[float, Meta(ge=0)] | None = field(default_factory=lambda: None)
    partial: bool = False
    beyond: bool = False
    reason: Reason | None = None
    load: Load | None = None
    missed: int = 0

    @property
    def force_is_bound(self) -> bool:
        """Whether `force_n` is only known not to be less."""
        if self.load is not None:
            return self.load.verdict == "saturated"
        return self.partial or self.beyond

    @property
    def may_last(self) -> bool:
        """Whether it is an end without a release."""
        return self.reason in ("lost", "stopped")

    def ended(self, seq: int, t_ns: int, reason: Reason = "released") -> "Touch":
        """The contact's end: where it was last; what is known of its pressures is 0."""
        nothing_kpa = None if self.area_mm2 is None else 0.0
        return replace(
            self,
            event="end",
            seq=seq,
            t_ns=t_ns,
            peak_kpa=nothing_kpa,
            mean_kpa=nothing_kpa,
            force_n=0.0,
            beyond=False,
            reason=reason,
        )

    def published(self, count: int) -> "Touch":
        """Return the event as it is sent: numbered, and rounded."""
        return replace(
            self,
            count=count,
            centroid_m=_rounded(self.centroid_m, M_DECIMALS),
            normal=_rounded(self.normal, NORMAL_DECIMALS),
            area_mm2=None if self.area_mm2 is None else round(self.area_mm2, MM2_DECIMALS),
            peak_kpa=None if self.peak_kpa is None else round(self.peak_kpa, KPA_DECIMALS),
            mean_kpa=None if self.mean_kpa is None else round(self.mean_kpa, KPA_DECIMALS),
            force_n=round(self.force_n, N_DECIMALS),
            sigma_m=None if self.sigma_m is None else _not_certain(self.sigma_m),
        )


def _not_certain(sigma_m: float) -> float:
    """Round a standard error, to no less than the last decimal."""
    return round(max(sigma_m, 10.0**-M_DECIMALS), M_DECIMALS)


def _rounded(vector: Vector | None, decimals: int) -> Vector | None:
    return None if vector is None else rounded(vector, decimals)


def rounded(values: Sequence[float], decimals: int) -> Vector:
    """Round a vector; without -0.0."""
    x, y, z = (round(value, decimals) + 0.0 for value in values)
    return x, y, z
