"""The contacts of a frame, and which of those before them each group of taxels continues."""

from collections import Counter
from dataclasses import dataclass
from itertools import accumulate, chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.events import Touch

Floats = NDArray[np.float64]


@dataclass(slots=True)
class Followed:
    """A contact as it is followed; all times are those of `PressureFrame.elapsed_ns`.

    Attributes:
        taxels: those of it.
        order: the same in rising order, intp.
        reported, reported_ns: what was reported of it last, and when.
        firm_kpa: the recent highest pressure.
        unseen: taxels that it lost when they were not received for long: they may still be touched.
        parted_ns: since when it has been in pieces.
        merged_ns: since when it has been connected with another contact.
    """

    taxels: frozenset[int]
    order: NDArray[np.intp]
    reported: Touch
    reported_ns: int
    firm_kpa: float
    unseen: frozenset[int] = frozenset()
    parted_ns: int | None = None
    merged_ns: int | None = None


class Homes:
    """Which contact each taxel of a part was in.

    Args:
        contacts: by their names, which are above 0.
        n: taxels of the part.
    """

    #: A group of more is taken as an array.
    _MANY = 48

    def __init__(self, contacts: dict[int, Followed], n: int) -> None:
        self._names = np.zeros(n, np.int64)
        for name, contact in contacts.items():
            self._names[contact.order] = name
        self._listed: list[int] = self._names.tolist()
        self._orders: dict[frozenset[int], NDArray[np.intp]] = {}
        self._overlaps: dict[frozenset[int], list[tuple[int, int]]] = {}

    def overlaps(self, group: frozenset[int]) -> list[tuple[int, int]]:
        """Contacts that a group shares taxels with, and how many.

        Those with most come first; of equal ones that with the lowest taxel.
        """
        found = self._overlaps.get(group)
        if found is None:
            found = self._overlaps[group] = self._overlaps_of(group)
        return found

    def _overlaps_of(self, group: frozenset[int]) -> list[tuple[int, int]]:
        if len(group) <= self._MANY:
            names = [name for one in group if (name := self._listed[one])]
            if not names or names.count(names[0]) == len(names):
                return [(names[0], len(names))] if names else []
            names = [name for one in sorted(group) if (name := self._listed[one])]
            return Counter(names).most_common()
        found = self._names[self._order(group)]
        found = found[found > 0]
        if len(found) and (found == found[0]).all():
            return [(int(found[0]), len(found))]
        names_found, first, counts = np.unique(found, return_index=True, return_counts=True)
        ranked = np.lexsort((first, -counts))
        return list(zip(names_found[ranked].tolist(), counts[ranked].tolist(), strict=True))

    def sorted(self, group: frozenset[int]) -> list[int]:
        """The taxels of a group in rising order."""
        if len(group) <= self._MANY:
            return sorted(group)
        taxels: list[int] = self._order(group).tolist()
        return taxels

    def note(self, group: frozenset[int], order: NDArray[np.intp]) -> None:
        """Take the taxels of a group in rising order, which are known already."""
        self._orders[group] = order

    def order(self, groups: list[frozenset[int]]) -> NDArray[np.intp]:
        """The taxels of groups, one group after the other."""
        if len(groups) == 1:
            return self._order(groups[0])
        return np.fromiter(chain.from_iterable(map(self.sorted, groups)), np.intp)

    def _order(self, group: frozenset[int]) -> NDArray[np.intp]:
        order = self._orders.get(group)
        if order is None:
            order = self._orders[group] = np.fromiter(group, np.intp, len(group))
            order.sort()
        return order


class Grouping(NamedTuple):
    """The k contacts of a frame, as lists and as flat arrays.

    Attributes:
        names: of the contacts.
        groups: the taxels of each.
        taxels: the same, in order.
        order, starts: intp, all taxels contact by contact, and the index of the first of each.
        spans: which of `order` are of each contact.
        share_mm2, position_m: of the taxels in this order: skin that they stand for, and
            position [.., 3].
        area_mm2: of each contact.
    """

    names: list[int]
    groups: list[frozenset[int]]
    taxels: list[list[int]]
    order: NDArray[np.intp]
    starts: NDArray[np.intp]
    spans: list[slice]
    share_mm2: Floats
    position_m: Floats
    area_mm2: list[float]

    @classmethod
    def of(
        cls,
        names: list[int],
        groups: list[frozenset[int]],
        home: "Homes",
        area_mm2: Floats,
        position_m: Floats,
    ) -> "Grouping":
        taxels = [home.sorted(group) for group in groups]
        order = home.order(groups)
        ends = list(accumulate(map(len, taxels)))
        begins = [0, *ends[:-1]] if ends else []
        starts = np.array(begins, np.intp)
        spans = list(map(slice, begins, ends))
        share_mm2 = area_mm2[order]
        areas = np.add.reduceat(share_mm2, starts).tolist() if ends else []
        return cls(names, groups, taxels, order, starts, spans, share_mm2, position_m[order], areas)
