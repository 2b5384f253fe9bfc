"""Computes which pads the probes of a scene cover, for all probes and some steps at once.

The pads within reach of a probe are found once and kept while it slides by less than
`MARGIN_MM`. Where probes go in the next steps is mostly known, so that these steps are computed
together; what then remains to be done in each of them costs hardly more than in a press.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from emulator.probes.foam import Footprint
from emulator.probes.pads import (
    ZONES,
    Disc,
    Pads,
    Rectangle,
    Shape,
    lens_area_mm2,
    rectangle_area_mm2,
)
from emulator.probes.scene import Probe, resolve, tangents
from skin_host.layout import Layout

#: A probe reaches only pads that face it, and not through the body.
FACING = 0.3
REACH_MM = 15.0
#: How far a probe slides before what is within its reach is found again.
MARGIN_MM = 3.0
#: So many pads times steps are computed at once: more would not stay in the processor's cache.
MOST_AT_ONCE = 1 << 13
#: A pad of which less than this share is covered counts as not covered.
LEAST_SHARE = 1e-6

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class _Near:
    """The pads near a probe's place: k of them, along its own axes, and where it was then."""

    offset_mm: Floats
    taxel: Ints
    place_mm: Floats


class Coverage:
    """The probes of a scene over the pads of a layout.

    Args:
        layout: of the skin.
        thickness_mm: float64[n], foam above each pad.
        membrane_mm: decay length of the surface around a contact; 0 is a plain Winkler layer.
    """

    def __init__(self, layout: Layout, thickness_mm: Floats, membrane_mm: float) -> None:
        self._layout = layout
        self._position_mm = layout.position_m * 1e3
        self._radius_mm = np.asarray(layout.radius_mm, np.float64)
        self._thickness_mm = thickness_mm
        self._membrane_mm = membrane_mm
        self._shapes: list[Shape] = []
        #: Point (mm), axes along the skin [2, 3] and pads that face it, of each probe.
        self._places: list[tuple[Floats, Floats, Ints]] = []
        self._near: dict[int, _Near] = {}
        self._numbers: Ints = np.zeros(0, np.intp)
        self._gathered = False
        #: What is gathered about the pads near all probes: x and y, pad, probe, reach and size.
        self._place_mm = np.zeros((2, 0))
        self._taxel = self._contact = self._rows = np.zeros(0, np.intp)
        self._reach_mm = self._pad_radius_mm = self._pad_mm2 = np.zeros(0)
        self._pads = self._taxel, self._contact, self._reach_mm

    def add(self, probe: Probe) -> None:
        """One more probe.

        Raises:
            ConfigurationError: there is no such part, triangle or taxel.
        """
        point_m, normal = resolve(probe.at, probe.part, self._layout)
        part = self._layout.part(probe.part)
        of_part = slice(part.start, part.stop)
        height_mm = (self._position_mm[of_part] - point_m * 1e3) @ normal
        facing = (self._layout.normal[of_part] @ normal > FACING) & (np.abs(height_mm) < REACH_MM)
        taxels = np.flatnonzero(facing) + part.start
        self._places.append((point_m * 1e3, tangents(normal), taxels))
        if probe.size_mm is None:
            self._shapes.append(Disc(0.0, 0.0, probe.diameter_mm))
        else:
            self._shapes.append(Rectangle(0.0, 0.0, *probe.size_mm, probe.turn_deg))

    def footprint(self, numbers: Ints, offset_mm: Floats) -> Footprint:
        """What some probes [c] cover that have slid by `offset_mm` [c, 2] from their places."""
        return self.footprints(numbers, offset_mm[None])[0]

    def footprints(self, numbers: Ints, path_mm: Floats) -> list[Footprint]:
        """What some probes [c] cover along their path [k, c, 2], offsets from their places.

        Returns:
            The footprints of the first steps of the path, which is straight: one at least.
        """
        path_mm = path_mm[: self._find(numbers, path_mm)]
        if self._membrane_mm:
            return [self._with_membrane(path_mm[0])]
        near = self._on_the_way(path_mm)
        path_mm = path_mm[: max(1, MOST_AT_ONCE // max(1, len(near)))]
        contact = self._contact[near]
        along_mm = np.stack(
            [self._place_mm[axis, near] - path_mm[:, :, axis][:, contact] for axis in (0, 1)]
        )
        area_mm2 = self._area_mm2(near, along_mm)
        covered = area_mm2 / self._pad_mm2[near]
        hit = covered > LEAST_SHARE
        turns = np.flatnonzero((hit[1:] != hit[:-1]).any(axis=1)) + 1
        found: list[Footprint] = []
        for start, stop in pairwise([0, *turns.tolist(), len(hit)]):
            columns = np.flatnonzero(hit[start])
            rows = near[columns]
            # The same pads as before are the same object, see `Footprint`.
            if not np.array_equal(rows, self._rows):
                self._rows = rows
                self._pads = self._taxel[rows], self._contact[rows], np.ones(len(rows))
            taxel, contact, ones = self._pads
            weight = _shares(area_mm2[start:stop, columns], contact)
            found += [
                Footprint(taxel, contact, of_pad, ones, share, self._contact_mm2, self._no_edge)
                for of_pad, share in zip(covered[start:stop, columns], weight, strict=True)
            ]
        return found

    def _on_the_way(self, path_mm: Floats) -> Ints:
        """Which of the pads near the probes their paths [k, c, 2] reach, and a few more."""
        ends_mm = path_mm[[0, -1]]
        middle_mm, half_mm = ends_mm.mean(axis=0), np.abs(ends_mm[1] - ends_mm[0]) / 2
        distance_mm = _length_mm(*(self._place_mm - middle_mm.T[:, self._contact]))
        away_mm = _length_mm(*half_mm.T)[self._contact]
        return np.flatnonzero(distance_mm < self._reach_mm + away_mm)

    def _area_mm2(self, rows: Ints, along_mm: Floats) -> Floats:
        """Area common to pads and probes, [k, rows], by where they are, x and y [2, k, rows]."""
        contact = self._contact[rows]
        radius_mm = self._pad_radius_mm[rows]
        distance_mm = _length_mm(*along_mm)
        rectangle = self._is_rectangle[contact]
        if not rectangle.any():
            return lens_area_mm2(distance_mm, radius_mm, self._edge_mm[contact])
        area_mm2 = np.empty(distance_mm.shape)
        disc = ~rectangle
        area_mm2[:, disc] = lens_area_mm2(
            distance_mm[:, disc], radius_mm[disc], self._edge_mm[contact[disc]]
        )
        contact, radius_mm = contact[rectangle], radius_mm[rectangle]
        for step, of_step_mm in enumerate(np.moveaxis(along_mm[:, :, rectangle], 0, 2)):
            area_mm2[step, rectangle] = rectangle_area_mm2(
                of_step_mm, radius_mm, self._size_mm[contact], self._turn[contact]
            )
        return area_mm2

    def _find(self, numbers: Ints, path_mm: Floats) -> int:
        """Gather the pads near these probes where they are not known; for how many steps."""
        ends_mm = path_mm[[0, -1]]
        longest_mm = float(np.abs(ends_mm[1] - ends_mm[0]).max(initial=0.0))
        steps = len(path_mm)
        if longest_mm >= MARGIN_MM / 2:
            steps = max(1, int(steps * MARGIN_MM / 2 / longest_mm))
            ends_mm = path_mm[[0, steps - 1]]
        same = self._gathered and np.array_equal(numbers, self._numbers)
        if same and np.abs(ends_mm - self._found_mm).max(initial=0.0) < MARGIN_MM / 2:
            return steps
        found = []
        for number, own_mm in zip(numbers.tolist(), np.moveaxis(ends_mm, 1, 0), strict=True):
            near = self._near.get(number)
            # Those that are half way to their margin are looked for with those beyond it.
            if near is None or np.abs(own_mm - near.offset_mm).max() >= MARGIN_MM / 4:
                near = self._near[number] = self._look(number, own_mm[0])
            found.append(near)
        self._gather(numbers, found, same=same)
        return steps

    def _look(self, number: int, offset_mm: Floats) -> _Near:
        point_mm, along, taxels = self._places[number]
        place_mm = (self._position_mm[taxels] - point_mm) @ along.T
        shape = self._shapes[number]
        # sqrt(2) covers what max-norm margins leave at the corners.
        reach_mm = shape.reach_mm + np.sqrt(2.0) * MARGIN_MM / 2
        reach_mm += ZONES[-1] * self._membrane_mm
        apart_mm = place_mm - offset_mm
        near = np.hypot(apart_mm[:, 0], apart_mm[:, 1]) < reach_mm + self._radius_mm[taxels]
        return _Near(offset_mm.copy(), taxels[near], place_mm[near])

    def _gather(self, numbers: Ints, found: Sequence[_Near], *, same: bool) -> None:
        self._rows = np.full(1, -1, np.intp)
        shapes = [self._shapes[number] for number in numbers]
        none = np.zeros((0, 2))
        self._found_mm = np.array([near.offset_mm for near in found]).reshape(-1, 2)
        self._place_mm = np.concatenate([none, *(near.place_mm for near in found)]).T.copy()
        self._taxel = np.concatenate([np.zeros(0, np.intp), *(near.taxel for near in found)])
        self._contact = np.repeat(np.arange(len(found)), [len(near.taxel) for near in found])
        self._pad_radius_mm = self._radius_mm[self._taxel]
        self._pad_mm2 = np.pi * self._pad_radius_mm**2
        if not same:
            self._set_contacts(numbers, shapes)
        reach_mm = np.array([shape.reach_mm for shape in shapes])
        self._reach_mm = reach_mm[self._contact] + self._pad_radius_mm

    def _set_contacts(self, numbers: Ints, shapes: Sequence[Shape]) -> None:
        self._numbers, self._gathered = numbers.copy(), True
        self._contact_mm2 = np.array([shape.area_mm2 for shape in shapes])
        self._no_edge = np.ones(len(shapes))
        self._edge_mm = np.array([shape.edge_radius_mm for shape in shapes])
        self._is_rectangle = np.array([isinstance(shape, Rectangle) for shape in shapes], bool)
        self._size_mm = np.array(
            [(s.width_mm, s.height_mm) if isinstance(s, Rectangle) else (0, 0) for s in shapes]
        ).reshape(-1, 2)
        self._turn = np.deg2rad(
            [shape.turn_deg if isinstance(shape, Rectangle) else 0.0 for shape in shapes]
        )

    def _with_membrane(self, offset_mm: Floats) -> Footprint:
        """What a drawn-down surface adds is found contact by contact."""
        singles = []
        for number, offset in zip(self._numbers.tolist(), offset_mm, strict=True):
            near = self._near[number]
            pads = Pads(
                near.place_mm - offset,
                self._radius_mm[near.taxel],
                self._thickness_mm[near.taxel],
                membrane_mm=self._membrane_mm,
            )
            one = pads.footprint([self._shapes[number]])
            singles.append((near.taxel[one.taxel], one))
        rows = [len(taxel) for taxel, _ in singles]
        return Footprint(
            np.concatenate([np.zeros(0, np.intp), *(taxel for taxel, _ in singles)]),
            np.repeat(np.arange(len(singles)), rows),
            *(
                np.concatenate([np.zeros(0), *(getattr(one, name) for _, one in singles)])
                for name in ("covered", "share", "weight", "area_mm2", "edge")
            ),
        )


def _length_mm(x_mm: Floats, y_mm: Floats) -> Floats:
    """As `np.hypot`, which guards against numbers that no length has, at five times the cost."""
    length_mm: Floats = np.sqrt(x_mm * x_mm + y_mm * y_mm)
    return length_mm


def _shares(area_mm2: Floats, contact: Ints) -> Floats:
    """Share of each pad in what its contact covers, [k, m]; the pads of a contact together."""
    is_first = np.append(True, contact[1:] != contact[:-1])[: len(contact)]
    if is_first.all():
        return np.ones(area_mm2.shape)
    sums_mm2 = np.add.reduceat(area_mm2, np.flatnonzero(is_first), axis=1)
    shares: Floats = area_mm2 / sums_mm2[:, np.cumsum(is_first) - 1]
    return shares
