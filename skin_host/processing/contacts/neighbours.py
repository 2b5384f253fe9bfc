"""Which taxels of a part are next to each other, and next to pads that feel nothing."""

from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.layout import Layout, PadKind
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.patches import Patches

Floats = NDArray[np.float64]


class Near:
    """Which taxels of a part are next to each other: what takes long to make is made when needed.

    Attributes:
        start, neighbour: as in `Layout`, of the part alone.
        position_m: [m, 3].
        pads: bool[m], which ones measure pressure.
        radius_m, kind_pitch_m: [m], of the pads, and their distance in a unit of their kind.
    """

    def __init__(
        self,
        start: NDArray[np.int32],
        neighbour: NDArray[np.int32],
        position_m: Floats,
        pads: Mask,
        radius_m: Floats,
        kind_pitch_m: Floats,
    ) -> None:
        self.start = start
        self.neighbour = neighbour
        self.position_m = position_m
        self.pads = pads
        self.radius_m = radius_m
        self.kind_pitch_m = kind_pitch_m

    @classmethod
    def of(cls, layout: Layout, mine: slice) -> "Near":
        start = layout.neighbour_start[mine.start : mine.stop + 1]
        neighbour = layout.neighbour[start[0] : start[-1]] - np.int32(mine.start)
        return cls(
            start - start[0],
            neighbour,
            layout.position_m[mine],
            layout.pad_kind[mine] == PadKind.PRESSURE,
            1e-3 * layout.radius_mm[mine],
            1e-3 * layout.pitch_mm[mine],
        )

    def is_same(self, other: "Near") -> bool:
        return (
            np.array_equal(self.start, other.start)
            and np.array_equal(self.neighbour, other.neighbour)
            and np.array_equal(self.position_m, other.position_m, equal_nan=True)
            and np.array_equal(self.pads, other.pads)
            and np.array_equal(self.radius_m, other.radius_m)
            and np.array_equal(self.kind_pitch_m, other.kind_pitch_m)
        )

    @cached_property
    def lists(self) -> list[list[int]]:
        """The neighbours of each taxel."""
        flat = self.neighbour.tolist()
        return [flat[begin:end] for begin, end in pairwise(self.start.tolist())]

    @cached_property
    def patches(self) -> Patches:
        return Patches(self.lists)

    @cached_property
    def taxel(self) -> NDArray[np.intp]:
        """Whose neighbour each of `neighbour` is."""
        count = np.diff(self.start)
        return np.repeat(np.arange(len(count)), count)

    @cached_property
    def pitch_m(self) -> Floats:
        """Distance [m] of each taxel to the nearest pad that measures pressure.

        Where none is next to it, or one closer than pads can lie to each other, it is that of its
        kind: places that are wrong must not seem precise.
        """
        steps = self.position_m[self.neighbour] - self.position_m[self.taxel]
        apart_m = np.where(self.pads[self.neighbour], np.linalg.norm(steps, axis=1), np.inf)
        nearest_m = np.full(len(self.pads), np.inf)
        np.minimum.at(nearest_m, self.taxel, apart_m)
        is_known = (nearest_m >= self.radius_m) & np.isfinite(nearest_m)
        return np.where(is_known, nearest_m, self.kind_pitch_m)

    @cached_property
    def usual_pitch_m(self) -> float:
        """The median of those of all pads that measure pressure."""
        return float(np.median(self.pitch_m[self.pads]))


class Unfelt(NamedTuple):
    """Pads of a part that measure pressure and are not valid.

    Attributes:
        valid: the mask of the frame, as bytes.
        any: whether there are any.
        pads: bool[m], which ones.
        beside: bool[m], which taxels are next to one.
    """

    valid: bytes
    any: bool
    pads: Mask
    beside: Mask

    @classmethod
    def of(cls, valid: Mask, near: "Near", last: "Unfelt | None") -> "Unfelt":
        """Return those of a frame; mostly they are those of the last one."""
        seen = valid.tobytes()
        if last is not None and last.valid == seen:
            return last
        pads = near.pads & ~valid
        beside = np.zeros(len(pads), np.bool_)
        beside[near.taxel[pads[near.neighbour]]] = True
        return cls(seen, any_of(pads), pads, beside)
