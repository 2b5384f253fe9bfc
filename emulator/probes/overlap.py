"""Which contact presses each point of a pad that several of them cover: the deepest one.

Rigid objects that overlap press the foam once, as deep as the deepest of them. So of each row of a
footprint only that part counts where no deeper contact presses the same pad. It is found on
`POINTS` of the pad, as a share of those that the row covers: a row that no other one overlaps, or
that a deeper one covers wholly, is exact.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Mask = NDArray[np.bool_]
_Numbers = TypeVar("_Numbers", NDArray[np.float64], NDArray[np.int32])
#: Which points of their pads some rows [k] of a footprint cover, bool[k, p]. Every row has the
#: same points of a pad, whatever its contact.
PointsInside = Callable[[Ints], Mask]


def _spread(n: int) -> Floats:
    """Points [n, 2] spread evenly over the unit disc (sunflower)."""
    i = np.arange(n) + 0.5
    turn = np.pi * (1 + np.sqrt(5)) * i
    points: Floats = np.sqrt(i / n)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return points


#: A contact reaches pads that lie no higher or lower than this, their own size included.
HIGHEST_MM = 20.0
#: Points of a pad of radius 1, float64[p, 2].
POINTS = _spread(400)


def shared_rows(taxel: Ints, contact: Ints, n_taxels: int) -> Ints:
    """Rows of a footprint on pads that another contact covers, too, int[k].

    Args:
        taxel, contact: of its rows [m].
        n_taxels: of the skin.
    """
    one = np.zeros(n_taxels, np.intp)
    one[taxel] = contact
    by_others = np.zeros(n_taxels, np.bool_)
    by_others[taxel[contact != one[taxel]]] = True
    return np.flatnonzero(by_others[taxel])


class Neighbours:
    """The pairs of contacts that may overlap on a pad that both have.

    Args:
        taxel, contact: pads [m] that contacts may cover, a row for each pad of a contact.
        normal: [c, 3], of the surface under each contact.
        reach_mm: [c], radii of the discs around their middles that hold them.
    """

    def __init__(self, taxel: Ints, contact: Ints, normal: Floats, reach_mm: Floats) -> None:
        self._count = len(reach_mm)
        self._one, self._other = one, other = _pairs(taxel, contact)
        along = normal[one] + normal[other]
        self._along = along / np.linalg.norm(along, axis=1)[:, None]
        # A pad faces each along its own normal, from no further than `HIGHEST_MM`.
        tilt = np.linalg.norm(normal[one] - normal[other], axis=1)
        self._near_mm2 = (reach_mm[one] + reach_mm[other] + 2 * HIGHEST_MM * tilt) ** 2

    def meeting(self, place_mm: Floats, way_mm: Floats | None = None) -> Mask:
        """Which contacts may overlap another one, bool[c].

        Args:
            place_mm: [c, 3], their middles.
            way_mm: [c, 3], how far each slides straight on meanwhile.
        """
        meets = np.zeros(self._count, np.bool_)
        if not len(self._one):
            return meets
        apart_mm = self._across(place_mm)
        if way_mm is not None:
            slid_mm = self._across(way_mm)
            fast = np.maximum(np.einsum("kx,kx->k", slid_mm, slid_mm), 1e-18)
            nearest = np.clip(-np.einsum("kx,kx->k", apart_mm, slid_mm) / fast, 0.0, 1.0)
            apart_mm += nearest[:, None] * slid_mm
        near = ~(np.einsum("kx,kx->k", apart_mm, apart_mm) > self._near_mm2)
        meets[self._one[near]] = meets[self._other[near]] = True
        return meets

    def _across(self, of_all: Floats) -> Floats:
        """Of each pair the difference, across the normal of both."""
        apart = of_all[self._one] - of_all[self._other]
        apart -= np.einsum("kx,kx->k", apart, self._along)[:, None] * self._along
        return apart


def _pairs(taxel: Ints, contact: Ints) -> tuple[Ints, Ints]:
    """The pairs of contacts that have a pad in common, int[k] each."""
    order = np.argsort(taxel, kind="stable")
    taxel, contact = taxel[order], contact[order]
    count = int(contact.max(initial=0)) + 1
    found = [np.zeros(0, np.intp)]
    for shift in range(1, len(taxel)):
        common = np.flatnonzero(taxel[shift:] == taxel[:-shift])
        if not len(common):
            break
        found.append(contact[common] * count + contact[common + shift])
    one, other = np.divmod(np.unique(np.concatenate(found)), count)
    distinct = one != other
    return one[distinct], other[distinct]


class Overlap:
    """The rows of a footprint on pads that several contacts cover.

    Args:
        taxel, covered: pads of the footprint's rows [m], and which fractions of them they cover.
        shared: of them on pads with several contacts, as `shared_rows` found them; at least one.
        points_inside: of the footprint.

    Attributes:
        is_any: some point of a pad is covered twice.
    """

    def __init__(
        self, taxel: Ints, covered: Floats, shared: Ints, points_inside: PointsInside
    ) -> None:
        self._all_covered = self._shown = covered
        self._rows = shared[np.argsort(taxel[shared], kind="stable")]
        self._pad = taxel[self._rows]
        is_first = np.append(True, self._pad[1:] != self._pad[:-1])
        self._firsts, self._group = np.flatnonzero(is_first), np.cumsum(is_first) - 1
        self._inside = points_inside(self._rows).astype(np.int32)
        self._count = self._inside.sum(axis=1)
        self._order = np.zeros(0, np.intp)
        self.is_any = bool((np.add.reduceat(self._inside, self._firsts, axis=0) > 1).any())

    def covered(self, strain: Floats) -> Floats:
        """Fractions of their pads where rows [m] press and none is deeper, float64[m].

        Args:
            strain: of the foam in each row [m].
        """
        order = np.lexsort((-strain[self._rows], self._pad))
        if np.array_equal(order, self._order):
            return self._shown
        self._order = order
        rows, inside, count = self._rows[order], self._inside[order], self._count[order]
        free = (inside * (self._before(inside) == 0)).sum(axis=1)
        # A row too small for any point is taken to be beside the others.
        covered = self._all_covered[rows] * np.where(count > 0, free / np.maximum(count, 1), 1.0)
        # Points are no finer than they are: rows together are not more than the pad.
        room = np.maximum(1.0 - self._before(covered), 0.0)
        self._shown = self._all_covered.copy()
        self._shown[rows] = np.minimum(covered, room)
        return self._shown

    def _before(self, of_rows: _Numbers) -> _Numbers:
        """Sums over the rows before each one on its pad."""
        before = np.cumsum(of_rows, axis=0, dtype=of_rows.dtype) - of_rows
        found: _Numbers = before - before[self._firsts][self._group]
        return found
