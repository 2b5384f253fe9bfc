"""Contacts from outside a scene, such as a simulation of bodies: what presses now, and where.

A source gives at each step of the mechanics the contacts of that moment, as places and forces in
the frames of the parts. Their forces press the emulated foam, each on a disc around its place.
"""

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.probes.coverage import FACING, LEAST_SHARE, points_of_pads_mm
from emulator.probes.foam import Footprint
from emulator.probes.overlap import POINTS, Neighbours
from emulator.probes.pads import lens_area_mm2
from skin_host.layout import Layout

#: Pads are looked up by cells of this edge, and by radii of contacts in steps of the second.
CELL_MM = 6.0
RADII_MM = 3.0
#: The largest radius of a contact.
MOST_RADIUS_MM = 10.0
#: Contacts on the body of a part, but this far from all its pads, are beside its skin.
BESIDE_MM = 5.0
#: The surface of the body is this near to its pads.
DEEP_MM = 8.0
#: Contacts that move or grow by less than this stay where they are for the foam.
STILL_MM = 0.01

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Contacts:
    """What presses at one time: arrays over c contacts.

    Attributes:
        part: intp[c], index of the part in the layout.
        place_mm: float64[c, 3], in the frame of that part.
        normal: float64[c, 3], unit vector out of the body, in the same frame.
        force_n: float64[c], along the normal into the body, not negative.
        radius_mm: float64[c], of the disc on which it presses.
    """

    part: Ints
    place_mm: Floats
    normal: Floats
    force_n: Floats
    radius_mm: Floats

    @classmethod
    def none(cls) -> "Contacts":
        """No contact at all."""
        return cls(
            np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0)
        )

    def __len__(self) -> int:
        return len(self.part)

    def take(self, rows: Ints | Mask) -> "Contacts":
        """Some of them."""
        return Contacts(
            self.part[rows],
            self.place_mm[rows],
            self.normal[rows],
            self.force_n[rows],
            self.radius_mm[rows],
        )

    def is_still(self, before: "Contacts") -> bool:
        """Whether these are the contacts from before, where they were, perhaps pressing harder."""
        return (
            np.array_equal(self.part, before.part)
            and np.abs(self.place_mm - before.place_mm).max(initial=0.0) < STILL_MM
            and np.abs(self.radius_mm - before.radius_mm).max(initial=0.0) < STILL_MM
        )


class ContactSource(Protocol):
    """Gives the contacts of each moment."""

    def at(self, t_ns: int) -> Contacts:
        """The contacts at a time, which is not before that of the last call."""
        ...


class ContactPads:
    """Which pads contacts cover.

    The pads around a place are found once for each cell of the space around the skin that is
    ever touched.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._position_mm = layout.position_m * 1e3
        self._normal = layout.normal
        self._radius_mm = np.asarray(layout.radius_mm, np.float64)
        self._parts = [np.arange(part.start, part.stop) for part in layout.parts]
        self._cells: dict[tuple[int, ...], Ints] = {}

    def place(self, contacts: Contacts) -> tuple[Mask, Footprint]:
        """Which contacts are on skin, bool[c], and what those cover."""
        cells = np.column_stack(
            [
                contacts.part,
                np.ceil(contacts.radius_mm / RADII_MM),
                np.floor(contacts.place_mm / CELL_MM),
            ]
        )
        near = [self._around(*cell) for cell in cells.astype(int).tolist()]
        taxel = np.concatenate([np.zeros(0, np.intp), *near])
        contact = np.repeat(np.arange(len(contacts)), [len(pads) for pads in near])
        normal = contacts.normal[contact]
        apart_mm = self._position_mm[taxel] - contacts.place_mm[contact]
        height_mm = (apart_mm * normal).sum(axis=1)
        faces = (self._normal[taxel] * normal).sum(axis=1) > FACING
        rows = np.flatnonzero(faces & (np.abs(height_mm) < DEEP_MM))
        taxel, contact = taxel[rows], contact[rows]
        along_mm = np.sqrt(
            np.maximum((apart_mm[rows] ** 2).sum(axis=1) - height_mm[rows] ** 2, 0.0)
        )
        pad_mm = self._radius_mm[taxel]
        radius_mm = contacts.radius_mm[contact]
        on_skin = np.zeros(len(contacts), bool)
        on_skin[contact[along_mm < radius_mm + pad_mm + BESIDE_MM]] = True
        area_mm2 = lens_area_mm2(along_mm, pad_mm, radius_mm)
        covered = area_mm2 / (np.pi * pad_mm**2)
        hit = (along_mm < radius_mm + pad_mm) & (covered > LEAST_SHARE)
        contact, area_mm2 = contact[hit], area_mm2[hit]
        borne_mm2 = np.bincount(contact, area_mm2, len(contacts))
        neighbours = Neighbours(taxel[hit], contact, contacts.normal, contacts.radius_mm)
        footprint = Footprint(
            taxel[hit],
            (np.cumsum(on_skin) - 1)[contact],
            covered[hit],
            np.ones(len(contact)),
            area_mm2 / borne_mm2[contact],
            np.pi * contacts.radius_mm[on_skin] ** 2,
            np.ones(np.count_nonzero(on_skin)),
            partial(self._inside, contacts, taxel[hit], contact),
            neighbours.meeting(contacts.place_mm)[on_skin],
        )
        return on_skin, footprint

    def _inside(self, contacts: Contacts, taxel: Ints, contact: Ints, rows: Ints) -> Mask:
        """Which points of their pads some rows cover."""
        taxel, contact = taxel[rows], contact[rows]
        apart_mm = points_of_pads_mm(self._layout, taxel) - contacts.place_mm[contact, None]
        height_mm = np.einsum("kpx,kx->kp", apart_mm, contacts.normal[contact])
        along_mm2 = np.square(apart_mm).sum(axis=2) - np.square(height_mm)
        inside: Mask = along_mm2 <= contacts.radius_mm[contact, None] ** 2
        return inside

    def _around(self, part: int, size: int, *cell: int) -> Ints:
        """The pads of a part that a contact in a cell may cover, or lie beside."""
        key = (part, size, *cell)
        found = self._cells.get(key)
        if found is None:
            taxels = self._parts[part]
            middle_mm = (np.array(cell) + 0.5) * CELL_MM
            along_mm = size * RADII_MM + BESIDE_MM + self._radius_mm[taxels]
            reach_mm = np.hypot(along_mm, DEEP_MM) + CELL_MM * np.sqrt(3.0) / 2
            apart_mm = np.linalg.norm(self._position_mm[taxels] - middle_mm, axis=1)
            found = self._cells[key] = taxels[apart_mm < reach_mm]
        return found


def joined(first: Footprint, second: Footprint) -> Footprint:
    """Two footprints as one: the contacts of the first, then those of the second."""
    if not len(second.area_mm2):
        return first
    if not len(first.area_mm2):
        return second
    return Footprint(
        np.concatenate([first.taxel, second.taxel]),
        np.concatenate([first.contact, second.contact + len(first.area_mm2)]),
        np.concatenate([first.covered, second.covered]),
        np.concatenate([first.share, second.share]),
        np.concatenate([first.weight, second.weight]),
        np.concatenate([first.area_mm2, second.area_mm2]),
        np.concatenate([first.edge, second.edge]),
        partial(_inside_either, first, second),
    )


def _inside_either(first: Footprint, second: Footprint, rows: Ints) -> Mask:
    inside = np.zeros((len(rows), len(POINTS)), np.bool_)
    is_first = rows < len(first.taxel)
    for one, own, begin in ((first, is_first, 0), (second, ~is_first, len(first.taxel))):
        if one.points_inside is not None:
            inside[own] = one.points_inside(rows[own] - begin)
    return inside
