"""Computes which pads the probes of a scene cover, for all probes at once.

The pads within reach of a probe are found once and kept while it slides by less than
`MARGIN_MM`; each step then costs one pass over those pads.
"""

from collections.abc import Sequence
from dataclasses import dataclass

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
        self._find(numbers, offset_mm)
        if self._membrane_mm:
            return self._with_membrane(offset_mm)
        along_mm = self._place_mm - offset_mm[self._contact]
        distance_mm = np.hypot(along_mm[:, 0], along_mm[:, 1])
        rows = np.flatnonzero(distance_mm < self._reach_mm)
        area_mm2 = self._area_mm2(rows, along_mm[rows], distance_mm[rows])
        covered = area_mm2 / self._pad_mm2[rows]
        hit = covered > LEAST_SHARE
        rows, covered, area_mm2 = rows[hit], covered[hit], area_mm2[hit]
        return Footprint(
            self._taxel[rows],
            self._contact[rows],
            covered,
            np.ones(len(rows)),
            area_mm2,
            self._contact_mm2,
            np.ones(len(numbers)),
        )

    def _area_mm2(self, rows: Ints, along_mm: Floats, distance_mm: Floats) -> Floats:
        contact = self._contact[rows]
        radius_mm = self._pad_radius_mm[rows]
        if not self._is_rectangle.any():
            return lens_area_mm2(distance_mm, radius_mm, self._edge_mm[contact])
        area_mm2 = np.empty(len(rows))
        rectangle = self._is_rectangle[contact]
        disc = ~rectangle
        area_mm2[disc] = lens_area_mm2(
            distance_mm[disc], radius_mm[disc], self._edge_mm[contact[disc]]
        )
        contact = contact[rectangle]
        area_mm2[rectangle] = rectangle_area_mm2(
            along_mm[rectangle], radius_mm[rectangle], self._size_mm[contact], self._turn[contact]
        )
        return area_mm2

    def _find(self, numbers: Ints, offset_mm: Floats) -> None:
        """Gather the pads near these probes, where they are not known."""
        same = self._gathered and np.array_equal(numbers, self._numbers)
        if same and np.abs(offset_mm - self._found_mm).max(initial=0.0) < MARGIN_MM / 2:
            return
        found = []
        for number, offset in zip(numbers.tolist(), offset_mm, strict=True):
            near = self._near.get(number)
            if near is None or np.abs(offset - near.offset_mm).max() >= MARGIN_MM / 2:
                near = self._near[number] = self._look(number, offset)
            found.append(near)
        self._gather(numbers, found)

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

    def _gather(self, numbers: Ints, found: Sequence[_Near]) -> None:
        self._numbers, self._gathered = numbers.copy(), True
        shapes = [self._shapes[number] for number in numbers]
        none = np.zeros((0, 2))
        self._found_mm = np.array([near.offset_mm for near in found]).reshape(-1, 2)
        self._place_mm = np.concatenate([none, *(near.place_mm for near in found)])
        self._taxel = np.concatenate([np.zeros(0, np.intp), *(near.taxel for near in found)])
        self._contact = np.repeat(np.arange(len(found)), [len(near.taxel) for near in found])
        self._pad_radius_mm = self._radius_mm[self._taxel]
        self._pad_mm2 = np.pi * self._pad_radius_mm**2
        self._contact_mm2 = np.array([shape.area_mm2 for shape in shapes])
        self._edge_mm = np.array([shape.edge_radius_mm for shape in shapes])
        self._is_rectangle = np.array([isinstance(shape, Rectangle) for shape in shapes], bool)
        self._size_mm = np.array(
            [(s.width_mm, s.height_mm) if isinstance(s, Rectangle) else (0, 0) for s in shapes]
        ).reshape(-1, 2)
        self._turn = np.deg2rad(
            [shape.turn_deg if isinstance(shape, Rectangle) else 0.0 for shape in shapes]
        )
        reach_mm = np.array([shape.reach_mm for shape in shapes])
        self._reach_mm = reach_mm[self._contact] + self._pad_radius_mm

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
                for name in ("covered", "share", "bears_mm2", "area_mm2", "edge")
            ),
        )
