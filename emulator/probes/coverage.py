"""Computes which pads the probes of a scene cover, for all probes and some steps at once.

The pads within reach of a probe are found once and kept while it slides by less than
`MARGIN_MM`. Where probes go in the next steps is mostly known: straight on. So the steps between
which each pad is covered are found together, and in each of them it only remains to look up how
much of each pad a probe at this distance covers.
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
#: Probes that slide less than this in a step are taken to slide so much.
LEAST_STEP_MM = 1e-9
#: How far the shares that sliding discs cover may be from the exact ones.
WORST_SHARE = 1e-5
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
        self._curves = LensCurves()
        #: Of each of them, what `LensCurves.find` returns: filled when probes slide.
        self._course = np.zeros((0, 0))

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
        self._find(numbers, offset_mm, np.zeros_like(offset_mm), 1)
        if self._membrane_mm:
            return self._with_membrane(offset_mm)
        x_mm, y_mm = self._place_mm - offset_mm.T[:, self._contact]
        # As `np.hypot`, which guards against numbers that no length has, at five times the cost.
        distance_mm = np.sqrt(x_mm * x_mm + y_mm * y_mm)
        rows = np.flatnonzero(distance_mm < self._reach_mm)
        contact, radius_mm = self._contact[rows], self._pad_radius_mm[rows]
        area_mm2 = lens_area_mm2(distance_mm[rows], radius_mm, self._edge_mm[contact])
        rectangle = np.flatnonzero(self._is_rectangle[contact])
        if len(rectangle):
            along_mm = np.column_stack([x_mm, y_mm])[rows[rectangle]]
            area_mm2[rectangle] = self._rectangle_mm2(rows[rectangle], along_mm)
        covered = area_mm2 / self._pad_mm2[rows]
        hit = covered > LEAST_SHARE
        return self._footprints(rows[hit], covered[None, hit])[0]

    def footprints(
        self, numbers: Ints, offset_mm: Floats, step_mm: Floats, steps: int
    ) -> list[Footprint]:
        """What some probes [c] cover as they slide straight on.

        What discs cover is right to `WORST_SHARE` of each pad.

        Args:
            numbers: of the probes.
            offset_mm: [c, 2], how far they have slid from their places.
            step_mm: [c, 2], how far each slides in a step.
            steps: how many are wanted, the present one among them.

        Returns:
            The footprints of the first steps: one at least.
        """
        steps = self._find(numbers, offset_mm, step_mm, steps)
        if self._membrane_mm:
            return [self._with_membrane(offset_mm)]
        rows, course, enter, leave, by_rectangle = self._on_the_way(offset_mm, step_mm, steps)
        is_turn = np.zeros(steps + 1, bool)
        is_turn[[0, -1]] = is_turn[enter] = is_turn[leave] = True
        found: list[Footprint] = []
        for start, stop in pairwise(np.flatnonzero(is_turn).tolist()):
            on = np.flatnonzero((enter <= start) & (leave >= stop))
            covered = self._curves.shares(course[:, on], start, stop)
            if len(by_rectangle):
                flat = np.flatnonzero(self._is_rectangle[self._contact[rows[on]]])
                covered[:, flat] = by_rectangle[start:stop, on[flat]]
            found += self._footprints(rows[on], covered)
        return found

    def _footprints(self, rows: Ints, covered: Floats) -> list[Footprint]:
        """Of some steps in which the same pads `rows` are covered, by so much [k, rows]."""
        # The same pads as before are the same object, see `Footprint`.
        if not np.array_equal(rows, self._rows):
            self._rows = rows
            self._pads = self._taxel[rows], self._contact[rows], np.ones(len(rows))
            contact = self._pads[1]
            is_first = np.append(True, contact[1:] != contact[:-1])[: len(contact)]
            self._firsts, self._group = np.flatnonzero(is_first), np.cumsum(is_first) - 1
        taxel, contact, ones = self._pads
        size, no_edge = self._contact_mm2, self._no_edge
        if len(self._firsts) == len(rows):
            # Each contact is borne by one pad.
            return [
                Footprint(taxel, contact, of_pad, ones, ones, size, no_edge) for of_pad in covered
            ]
        weight = covered * self._pad_mm2[rows]
        weight /= np.add.reduceat(weight, self._firsts, axis=1).take(self._group, axis=1)
        return [
            Footprint(taxel, contact, of_pad, ones, share, size, no_edge)
            for of_pad, share in zip(covered, weight, strict=True)
        ]

    def _on_the_way(
        self, offset_mm: Floats, step_mm: Floats, steps: int
    ) -> tuple[Ints, Floats, Ints, Ints, Floats]:
        """Which of the pads near the probes are covered in some of the next steps.

        Returns:
            Their rows [m]; their courses [_COURSE, m]; the first step [m] in which each is
            covered, and that after the last; and by how much rectangles cover them, [steps, m],
            empty if there are no rectangles.
        """
        if not len(self._course):
            flat = self._is_rectangle[self._contact]
            self._course = self._curves.find(self._pad_radius_mm, self._edge_mm[self._contact])
            reach_mm = np.where(flat, self._reach_mm, self._course[_REACH])
            # Rectangles follow no curve: theirs are held at one node, and not used.
            self._course[_SCALE:, flat] = 0.0
            self._reach_mm2 = reach_mm * reach_mm
        x_mm, y_mm = self._place_mm - offset_mm.T[:, self._contact]
        step_x_mm, step_y_mm = step_mm.T[:, self._contact]
        # The squared distance is that of now, and i times this, and i^2 times that.
        now = x_mm * x_mm + y_mm * y_mm
        towards = -2.0 * (x_mm * step_x_mm + y_mm * step_y_mm)
        fast = np.maximum(step_x_mm * step_x_mm + step_y_mm * step_y_mm, LEAST_STEP_MM**2)
        nearest = -0.5 * towards / fast
        half = np.sqrt(np.maximum(nearest * nearest - (now - self._reach_mm2) / fast, 0.0))
        enter = np.maximum(np.ceil(nearest - half), 0.0)
        leave = np.minimum(np.floor(nearest + half) + 1.0, steps)
        rows = np.flatnonzero((half > 0) & (enter < leave))
        course = self._course[:, rows]
        course[:_REACH] = now[rows], towards[rows], fast[rows]
        course[:_REACH] *= course[_SCALE] ** 2
        enter, leave = enter[rows].astype(np.intp), leave[rows].astype(np.intp)
        by_rectangle = np.zeros((0, 0))
        flat = np.flatnonzero(self._is_rectangle[self._contact[rows]])
        if len(flat):
            of_flat = rows[flat]
            by_rectangle = np.zeros((steps, len(rows)))
            for step in range(steps):
                along_mm = np.column_stack([x_mm - step * step_x_mm, y_mm - step * step_y_mm])
                area_mm2 = self._rectangle_mm2(of_flat, along_mm[of_flat])
                by_rectangle[step, flat] = area_mm2 / self._pad_mm2[of_flat]
            # Both are convex: there is no second time.
            hit = by_rectangle[:, flat] > LEAST_SHARE
            enter[flat] = np.where(hit.any(axis=0), hit.argmax(axis=0), steps)
            leave[flat] = steps - hit[::-1].argmax(axis=0)
        return rows, course, enter, leave, by_rectangle

    def _rectangle_mm2(self, rows: Ints, along_mm: Floats) -> Floats:
        """Area common to pads and rectangles, by where the pads are in the probes' axes [k, 2]."""
        contact = self._contact[rows]
        return rectangle_area_mm2(
            along_mm, self._pad_radius_mm[rows], self._size_mm[contact], self._turn[contact]
        )

    def _find(self, numbers: Ints, offset_mm: Floats, step_mm: Floats, steps: int) -> int:
        """Gather the pads near these probes where they are not known; for how many steps."""
        longest_mm = float(np.abs(step_mm).max(initial=0.0))
        if longest_mm * (steps - 1) >= MARGIN_MM / 2:
            steps = max(1, int(MARGIN_MM / 2 / longest_mm))
        ends_mm = np.stack([offset_mm, offset_mm + (steps - 1) * step_mm])
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
        self._rows, self._course = np.full(1, -1, np.intp), np.zeros((0, 0))
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


#: Numbers of a course: three of the squared distance by step; at which distance the pad is
#: covered first, nodes of the curve per mm, at which node it begins, and from which scaled
#: distance; the latter are what `LensCurves.find` finds.
_COURSE = 7
_REACH, _SCALE, _FIRST, _BEGIN = range(3, _COURSE)


class LensCurves:
    """The shares of pads that discs cover, by their distance: a curve for each pair of radii.

    Straight lines join nodes of the exact curve, so near each other that it is met to
    `WORST_SHARE`. Nothing else in sliding has to compute a root of an angle.
    """

    #: Nodes of the coarsest curve and of the finest.
    NODES = 1 << 8, 1 << 16

    def __init__(self) -> None:
        self._known: dict[tuple[float, float], tuple[float, ...]] = {}
        #: Of the line from each node on: its value at node 0, and its slope per node.
        self._value = self._slope = np.zeros(0)

    def find(self, pad_mm: Floats, disc_mm: Floats) -> Floats:
        """The curves of pads and discs by their radii [m]: courses [_COURSE, m] to be filled."""
        pairs, of_row = np.unique(np.stack([pad_mm, disc_mm]), axis=1, return_inverse=True)
        known = [self._curve(*pair) for pair in pairs.T.tolist()]
        course = np.zeros((_COURSE, len(pad_mm)))
        course[_REACH:] = np.array(known).reshape(-1, _COURSE - _REACH).T[:, of_row]
        return course

    def shares(self, course: Floats, start: int, stop: int) -> Floats:
        """The shares that are covered from step `start` to before `stop`, [steps, m]."""
        squares, first, begin = course[:_REACH], course[_FIRST], course[_BEGIN] ** 2
        shares = np.empty((stop - start, course.shape[1]))
        at_once = max(1, MOST_AT_ONCE // max(1, course.shape[1]))
        for low in range(start, stop, at_once):
            high = min(low + at_once, stop)
            step = np.arange(low, high)
            place = np.stack([np.ones(high - low), step, step * step], axis=1) @ squares
            np.maximum(place, begin, out=place)
            np.sqrt(place, out=place)
            place += first
            node = place.astype(np.intp)
            place *= self._slope.take(node)
            np.add(place, self._value.take(node), out=shares[low - start : high - start])
        return shares

    def _curve(self, pad_mm: float, disc_mm: float) -> tuple[float, ...]:
        """Where the curve of a pair of radii is, in the order of a course."""
        pair = pad_mm, disc_mm
        if pair not in self._known:
            self._known[pair] = self._add(pad_mm, disc_mm)
        return self._known[pair]

    def _add(self, pad_mm: float, disc_mm: float) -> tuple[float, ...]:
        inside_mm, beside_mm = abs(pad_mm - disc_mm), pad_mm + disc_mm
        nodes, most = self.NODES
        while True:
            # Every second one is a node, the others prove the lines half way between them.
            distance_mm = np.linspace(inside_mm, beside_mm, 2 * nodes + 1)
            exact = lens_area_mm2(distance_mm, pad_mm, disc_mm) / (np.pi * pad_mm**2)
            share = exact[::2]
            between = (share[1:] + share[:-1]) / 2
            if np.abs(between - exact[1::2]).max() < WORST_SHARE / 2 or nodes == most:
                break
            nodes *= 2
        reach_mm = float(np.interp(LEAST_SHARE, share[::-1], distance_mm[::-2]))
        # Rounding may carry a distance out of the curve: it is level before and after.
        share = np.concatenate([share[:1], share, share[-1:]])
        slope = np.append(np.diff(share), 0.0)
        node = len(self._value) + np.arange(len(slope))
        self._value = np.append(self._value, share - node * slope)
        self._slope = np.append(self._slope, slope)
        scale = nodes / (beside_mm - inside_mm)
        begin = inside_mm * scale
        return reach_mm, scale, float(node[1]) - begin, begin
