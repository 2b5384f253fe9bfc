"""Computes which pads the probes of a scene cover, for all probes and some steps at once.

The pads near a probe's way are found once and kept until it leaves it by `MARGIN_MM`. Where
probes go in the next steps is mostly known: straight on. So the steps between which each pad is
covered are found together, and in each of them it only remains to look up how much of each pad a
probe at this distance covers.
"""

from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from emulator.probes.foam import Footprint
from emulator.probes.overlap import POINTS, Neighbours
from emulator.probes.pads import (
    UNDER_MM,
    ZONES,
    Disc,
    Pads,
    Rectangle,
    Shape,
    is_between,
    lens_area_mm2,
    rectangle_area_mm2,
)
from emulator.probes.scene import Probe, resolve, tangents
from skin_host.layout import Layout

#: A probe reaches only pads that face it, and not through the body.
FACING = 0.3
REACH_MM = 15.0
#: How far a probe slides at least before what is within its reach is found again.
MARGIN_MM = 1.5
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
Mask = NDArray[np.bool_]


def points_of_pads_mm(layout: Layout, taxels: Ints) -> Floats:
    """The points of some pads [k] in the frame of their part, float64[k, p, 3] (mm)."""
    along = tangents(layout.normal[taxels].T)
    radius_mm = np.asarray(layout.radius_mm, np.float64)[taxels]
    points_mm: Floats = radius_mm[:, None, None] * np.einsum("pa,axk->kpx", POINTS, along)
    points_mm += 1e3 * layout.position_m[taxels, None]
    return points_mm


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
        #: Of each probe: the pads that face it, and where they are along its axes, [2, k].
        self._facing: list[Ints] = []
        self._facing_mm: list[Floats] = []
        #: And its place (mm) and axes [2, 3] in the frame of its part.
        self._frames: list[tuple[Floats, Floats]] = []
        #: Of the present probes: which are near each other, their places and axes.
        self._neighbours: Neighbours | None = None
        self._middle_mm, self._axes = np.zeros((0, 3)), np.zeros((0, 2, 3))
        self._numbers: Ints = np.zeros(0, np.intp)
        self._gathered = False
        #: Of the pads that the probes `_numbers` face: x and y, pad, probe and reach.
        self._all_mm = np.zeros((2, 0))
        self._all_taxel = self._all_contact = np.zeros(0, np.intp)
        self._all_reach_mm = np.zeros(0)
        #: Of those that are near, as far as is known from where and within what margin.
        self._found_mm, self._margin_mm = np.zeros((0, 2)), 0.0
        self._place_mm = np.zeros((2, 0))
        self._taxel = self._contact = self._rows = np.zeros(0, np.intp)
        self._reach_mm = self._pad_radius_mm = self._pad_mm2 = np.zeros(0)
        self._pads = self._taxel, self._contact, self._reach_mm
        #: Radii that pads have, and which of them each has.
        self._radii_mm, self._of_radius = np.unique(self._radius_mm, return_inverse=True)
        self._curves = LensCurves()
        #: Courses of the probes' curves, [_COURSE, probes, radii], and of the pads that are near,
        #: with their reach: filled when probes slide.
        self._of_probes = np.zeros((0, 0, 0))
        self._course = np.zeros((0, 0))
        self._curve_reach_mm = np.zeros(0)

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
        self._facing.append(taxels)
        along = tangents(normal)
        self._facing_mm.append(along @ (self._position_mm[taxels] - point_m * 1e3).T)
        self._frames.append((point_m * 1e3, along))
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
        [found] = self._footprints(rows[hit], covered[None, hit])
        self._know_points(found, offset_mm, self._meeting(offset_mm))
        return found

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
            Their footprints; of a skin with a membrane, that of the present one alone.
        """
        self._find(numbers, offset_mm, step_mm, steps)
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
        meets = self._meeting(offset_mm, (steps - 1) * step_mm)
        for step, footprint in enumerate(found):
            self._know_points(footprint, offset_mm + step * step_mm, meets)
        return found

    def _meeting(self, offset_mm: Floats, way_mm: Floats | None = None) -> Mask:
        """Which probes may overlap another one, there or on a way on which they slide straight."""
        assert self._neighbours is not None
        place_mm = self._middle_mm + np.einsum("ca,cax->cx", offset_mm, self._axes)
        slid_mm = None if way_mm is None else np.einsum("ca,cax->cx", way_mm, self._axes)
        return self._neighbours.meeting(place_mm, slid_mm)

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

    def _know_points(
        self,
        footprint: Footprint,
        offset_mm: Floats,
        meets: Mask | None = None,
        zone_mm: Floats | None = None,
    ) -> None:
        """Let a footprint find which points of its pads are covered by the present probes.

        Args:
            footprint: of them.
            offset_mm: [c, 2], how far they have slid.
            meets: of the footprint.
            zone_mm: [m, 2], in which zone around its probe each row is; under it if not given.
        """
        footprint.meets = meets
        footprint.points_inside = partial(
            self._inside, footprint.taxel, footprint.contact, self._numbers, offset_mm, zone_mm
        )

    def _inside(
        self,
        taxel: Ints,
        contact: Ints,
        numbers: Ints,
        offset_mm: Floats,
        zone_mm: Floats | None,
        rows: Ints,
    ) -> Mask:
        contact = contact[rows]
        points_mm = points_of_pads_mm(self._layout, taxel[rows])
        outside_mm = np.empty(points_mm.shape[:2])
        for one in np.unique(contact).tolist():
            number, own = numbers[one], contact == one
            point_mm, along = self._frames[number]
            places_mm = (points_mm[own] - point_mm) @ along.T - offset_mm[one]
            outside_mm[own] = self._shapes[number].outside_mm(places_mm)
        return is_between(outside_mm, np.array([UNDER_MM]) if zone_mm is None else zone_mm[rows])

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
            if not len(self._of_probes):
                self._of_probes = self._curves.courses(self._edge_mm, self._radii_mm)
            flat = self._is_rectangle[self._contact]
            self._course = self._of_probes[:, self._contact, self._of_radius[self._taxel]]
            self._curve_reach_mm = np.where(flat, self._reach_mm, self._course[_REACH])
            # Rectangles follow no curve: theirs are held at one node, and not used.
            self._course[_SCALE:, flat] = 0.0
        x_mm, y_mm = self._place_mm - offset_mm.T[:, self._contact]
        now = x_mm * x_mm + y_mm * y_mm
        # Most pads are beyond what the fastest probe reaches.
        fastest_mm = np.sqrt(np.square(step_mm).sum(axis=1).max(initial=0.0))
        far_mm = self._curve_reach_mm + (steps - 1) * fastest_mm
        rows = np.flatnonzero(now < far_mm * far_mm)
        now, x_mm, y_mm = now[rows], x_mm[rows], y_mm[rows]
        step_x_mm, step_y_mm = step_mm.T[:, self._contact[rows]]
        # The squared distance is that of now, and i times this, and i^2 times that.
        towards = -2.0 * (x_mm * step_x_mm + y_mm * step_y_mm)
        fast = np.maximum(step_x_mm * step_x_mm + step_y_mm * step_y_mm, LEAST_STEP_MM**2)
        nearest = -0.5 * towards / fast
        reach_mm2 = self._curve_reach_mm[rows] ** 2
        half = np.sqrt(np.maximum(nearest * nearest - (now - reach_mm2) / fast, 0.0))
        first = np.maximum(np.ceil(nearest - half), 0.0)
        last = np.minimum(np.floor(nearest + half) + 1.0, steps)
        met = np.flatnonzero((half > 0) & (first < last))
        rows = rows[met]
        course = self._course[:, rows]
        course[:_REACH] = np.stack([now, towards, fast])[:, met]
        course[:_REACH] *= course[_SCALE] ** 2
        enter, leave = first[met].astype(np.intp), last[met].astype(np.intp)
        by_rectangle = np.zeros((0, 0))
        flat = np.flatnonzero(self._is_rectangle[self._contact[rows]])
        if len(flat):
            of_flat = rows[flat]
            by_rectangle = np.zeros((steps, len(rows)))
            begin_mm = np.column_stack([x_mm, y_mm])[met[flat]]
            ahead_mm = np.column_stack([step_x_mm, step_y_mm])[met[flat]]
            for step in range(steps):
                area_mm2 = self._rectangle_mm2(of_flat, begin_mm - step * ahead_mm)
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

    def _find(self, numbers: Ints, offset_mm: Floats, step_mm: Floats, steps: int) -> None:
        """Gather the pads near the way of these probes, where they are not known."""
        end_mm = offset_mm + (steps - 1) * step_mm
        if not (self._gathered and np.array_equal(numbers, self._numbers)):
            self._set_contacts(numbers)
        elif (
            np.abs(offset_mm - self._found_mm).max(initial=0.0) <= self._margin_mm
            and np.abs(end_mm - self._found_mm).max(initial=0.0) <= self._margin_mm
        ):
            return
        self._found_mm = offset_mm.copy()
        self._margin_mm = MARGIN_MM + float(np.abs(end_mm - offset_mm).max(initial=0.0))
        x_mm, y_mm = self._all_mm - offset_mm.T[:, self._all_contact]
        # sqrt(2) covers what max-norm margins leave at the corners.
        reach_mm = self._all_reach_mm + np.sqrt(2.0) * self._margin_mm
        near = np.flatnonzero(x_mm * x_mm + y_mm * y_mm < reach_mm * reach_mm)
        self._place_mm = self._all_mm[:, near]
        self._taxel, self._contact = self._all_taxel[near], self._all_contact[near]
        self._pad_radius_mm = self._radius_mm[self._taxel]
        self._pad_mm2 = np.pi * self._pad_radius_mm**2
        self._reach_mm = self._shape_reach_mm[self._contact] + self._pad_radius_mm
        self._rows, self._course = np.full(1, -1, np.intp), np.zeros((0, 0))
        normal = np.cross(self._axes[:, 0], self._axes[:, 1])
        self._neighbours = Neighbours(self._taxel, self._contact, normal, self._shape_reach_mm)

    def _set_contacts(self, numbers: Ints) -> None:
        """Gather the pads that these probes face, and what their shapes are."""
        shapes = [self._shapes[number] for number in numbers]
        facing = [self._facing[number] for number in numbers]
        self._all_taxel = np.concatenate([np.zeros(0, np.intp), *facing])
        self._all_contact = np.repeat(np.arange(len(facing)), [len(pads) for pads in facing])
        places_mm = [self._facing_mm[number] for number in numbers]
        self._all_mm = np.concatenate([np.zeros((2, 0)), *places_mm], axis=1)
        self._shape_reach_mm = np.array([shape.reach_mm for shape in shapes])
        self._all_reach_mm = self._shape_reach_mm[self._all_contact]
        self._all_reach_mm += self._radius_mm[self._all_taxel] + ZONES[-1] * self._membrane_mm
        self._of_probes = np.zeros((0, 0, 0))
        frames = [self._frames[number] for number in numbers]
        self._middle_mm = np.array([middle_mm for middle_mm, _ in frames]).reshape(-1, 3)
        self._axes = np.array([along for _, along in frames]).reshape(-1, 2, 3)
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
        zones_mm = [np.zeros((0, 2))]
        starts = np.searchsorted(self._contact, np.arange(len(self._numbers) + 1)).tolist()
        for number, offset, near in zip(
            self._numbers.tolist(), offset_mm, map(slice, starts, starts[1:]), strict=False
        ):
            taxel = self._taxel[near]
            pads = Pads(
                self._place_mm[:, near].T - offset,
                self._radius_mm[taxel],
                self._thickness_mm[taxel],
                membrane_mm=self._membrane_mm,
            )
            one, zone_mm = pads.zoned_footprint([self._shapes[number]])
            zones_mm.append(zone_mm)
            singles.append((taxel[one.taxel], one))
        rows = [len(taxel) for taxel, _ in singles]
        covered, share, weight, area_mm2, edge = (
            np.concatenate([np.zeros(0), *(getattr(one, name) for _, one in singles)])
            for name in ("covered", "share", "weight", "area_mm2", "edge")
        )
        found = Footprint(
            np.concatenate([np.zeros(0, np.intp), *(taxel for taxel, _ in singles)]),
            np.repeat(np.arange(len(singles)), rows),
            covered,
            share,
            weight,
            area_mm2,
            edge,
        )
        self._know_points(found, offset_mm, zone_mm=np.concatenate(zones_mm))
        return found


#: Numbers of a course: three of the squared distance by step; at which distance the pad is
#: covered first, nodes of the curve per mm, at which node it begins, and from which scaled
#: distance; the last four are what `LensCurves.courses` fills in.
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

    def courses(self, disc_mm: Floats, pad_mm: Floats) -> Floats:
        """The curves of discs [c] on pads [r], by radius: courses [_COURSE, c, r] to be filled."""
        courses = np.zeros((_COURSE, len(disc_mm), len(pad_mm)))
        for number, disc in enumerate(disc_mm.tolist()):
            for kind, pad in enumerate(pad_mm.tolist()):
                courses[_REACH:, number, kind] = self._curve(pad, disc)
        return courses

    def shares(self, course: Floats, start: int, stop: int) -> Floats:
        """The shares that are covered from step `start` to before `stop`, [steps, m]."""
        squares, first, begin = course[:_REACH], course[_FIRST], course[_BEGIN] ** 2
        step = np.arange(start, stop, dtype=np.float64)
        powers = np.stack([np.ones_like(step), step, step * step], axis=1)
        shares = np.empty((len(step), course.shape[1]))
        at_once = max(1, MOST_AT_ONCE // max(1, course.shape[1]))
        nodes = np.empty((min(at_once, len(step)), course.shape[1]), np.intp)
        lines = np.empty(nodes.shape)
        for low in range(0, len(step), at_once):
            place = shares[low : low + at_once]
            node, line = nodes[: len(place)], lines[: len(place)]
            np.matmul(powers[low : low + at_once], squares, out=place)
            np.maximum(place, begin, out=place)
            np.sqrt(place, out=place)
            place += first
            np.copyto(node, place, casting="unsafe")
            # No node is beyond the last, "clip" only spares numpy a copy.
            place *= self._slope.take(node, out=line, mode="clip")
            place += self._value.take(node, out=line, mode="clip")
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
