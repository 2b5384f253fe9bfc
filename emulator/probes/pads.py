"""Pads: how much of them a contact covers, and the resulting capacitance.

A pad with the conductive cover above it is a plate capacitor whose gap shrinks by the strain x
of the foam: under the covered part of the pad the capacitance rises by C0 x / (1 - x). C0 is
100 fF for a pad of 2.1 mm radius under 2 mm of foam, which reproduces the paper's Figs. 11-16.
Without the cover only a grounded object, such as a hand, is felt: it is the other plate.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.chips.noise import SENT_UNIT_FF
from emulator.probes.foam import Felt, Footprint
from emulator.probes.overlap import POINTS

C0_FF = 100.0
C0_RADIUS_MM = 2.1
C0_THICKNESS_MM = 2.0
#: What a resting pad measures with its traces, from codes seen on an iCub (inferred).
RESTING_FF = 7800.0
RESTING_SD_FF = 700.0
#: Bounds of the zones of a drawn-down surface, in decay lengths from the contact's edge.
ZONES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
#: Distances (mm) from a contact that are under it.
UNDER_MM = -np.inf, 0.0
#: One unit of the paper's 8-bit value.
UNIT_FF = 2.88

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Shape(Protocol):
    """The outline of a flat contact."""

    @property
    def area_mm2(self) -> float:
        """Area of the whole contact."""
        ...

    @property
    def edge_radius_mm(self) -> float:
        """Radius of the disc of this area."""
        ...

    @property
    def reach_mm(self) -> float:
        """Radius of the disc around its middle that holds it."""
        ...

    def covered_mm2(self, centre_mm: Floats, radius_mm: Floats) -> Floats:
        """Area common with round pads at `centre_mm` [k, 2] of `radius_mm` [k]."""
        ...

    def outside_mm(self, point_mm: Floats) -> Floats:
        """Distance of points [..., 2] from the shape, 0 inside."""
        ...


@dataclass(frozen=True, slots=True)
class Disc:
    """A flat round probe."""

    x_mm: float
    y_mm: float
    diameter_mm: float

    @property
    def area_mm2(self) -> float:
        """Area of the whole contact."""
        return float(np.pi * self.diameter_mm**2 / 4)

    @property
    def edge_radius_mm(self) -> float:
        """Radius of the disc."""
        return self.diameter_mm / 2

    @property
    def reach_mm(self) -> float:
        """Radius of the disc."""
        return self.diameter_mm / 2

    def covered_mm2(self, centre_mm: Floats, radius_mm: Floats) -> Floats:
        """Area common with round pads: the lens of two circles."""
        apart_mm = np.hypot(centre_mm[:, 0] - self.x_mm, centre_mm[:, 1] - self.y_mm)
        return lens_area_mm2(apart_mm, radius_mm, self.diameter_mm / 2)

    def outside_mm(self, point_mm: Floats) -> Floats:
        """Distance of points [..., 2] from the disc, 0 inside."""
        apart_mm = np.hypot(point_mm[..., 0] - self.x_mm, point_mm[..., 1] - self.y_mm)
        return np.maximum(apart_mm - self.diameter_mm / 2, 0.0)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A flat rectangular contact, turned by `turn_deg`."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float
    turn_deg: float = 0.0

    @property
    def area_mm2(self) -> float:
        """Area of the whole contact."""
        return self.width_mm * self.height_mm

    @property
    def edge_radius_mm(self) -> float:
        """Radius of the disc of this area."""
        return float(np.sqrt(self.area_mm2 / np.pi))

    @property
    def reach_mm(self) -> float:
        """Half its diagonal."""
        return float(np.hypot(self.width_mm, self.height_mm) / 2)

    def covered_mm2(self, centre_mm: Floats, radius_mm: Floats) -> Floats:
        """Area common with round pads, by 24-point quadrature across each pad (to 0.1 %)."""
        k = len(centre_mm)
        size_mm = np.broadcast_to([self.width_mm, self.height_mm], (k, 2))
        return rectangle_area_mm2(
            centre_mm - [self.x_mm, self.y_mm],
            np.broadcast_to(radius_mm, k),
            size_mm,
            np.full(k, np.deg2rad(self.turn_deg)),
        )

    def outside_mm(self, point_mm: Floats) -> Floats:
        """Distance of points [..., 2] from the rectangle, 0 inside."""
        beyond = np.abs(self._local(point_mm)) - [self.width_mm / 2, self.height_mm / 2]
        beyond = np.maximum(beyond, 0.0)
        distance: Floats = np.hypot(beyond[..., 0], beyond[..., 1])
        return distance

    def _local(self, point_mm: Floats) -> Floats:
        turn = np.deg2rad(self.turn_deg)
        cos, sin = np.cos(turn), np.sin(turn)
        moved = point_mm - [self.x_mm, self.y_mm]
        local: Floats = moved @ np.array([[cos, -sin], [sin, cos]])
        return local


def rectangle_area_mm2(
    centre_mm: Floats, radius_mm: Floats, size_mm: Floats, turn: Floats
) -> Floats:
    """Area common to k pads and a rectangle around the origin for each, float64[k].

    By 24-point quadrature across each pad (to 0.1 %).

    Args:
        centre_mm: [k, 2]. radius_mm: [k]. size_mm: width and height [k, 2].
        turn: of the rectangles [k], rad.
    """
    cos, sin = np.cos(turn), np.sin(turn)
    x_mm = centre_mm[:, 0] * cos + centre_mm[:, 1] * sin
    y_mm = centre_mm[:, 1] * cos - centre_mm[:, 0] * sin
    half_mm = size_mm / 2
    # Across the pad in x = r sin(u) the chord is 2 r cos(u) long.
    side = np.stack([-half_mm[:, 0] - x_mm, half_mm[:, 0] - x_mm])
    start, stop = np.arcsin(np.clip(side / radius_mm, -1.0, 1.0))
    u = start[:, None] + (stop - start)[:, None] * (_NODES + 1) / 2
    half_chord = radius_mm[:, None] * np.cos(u)
    top = np.minimum(half_chord, (half_mm[:, 1] - y_mm)[:, None])
    bottom = np.maximum(-half_chord, (-half_mm[:, 1] - y_mm)[:, None])
    strips = np.maximum(top - bottom, 0.0) * half_chord
    area: Floats = strips @ _WEIGHTS * (stop - start) / 2
    return area


def lens_area_mm2(apart_mm: Floats, radius_a_mm: ArrayLike, radius_b_mm: ArrayLike) -> Floats:
    """Area common to two circles, broadcast over distances and radii."""
    a, b = np.asarray(radius_a_mm, np.float64), np.asarray(radius_b_mm, np.float64)
    small, large = np.minimum(a, b), np.maximum(a, b)
    inside = large - small
    # Inside each other, or apart, the formula holds at the nearest touching distance.
    d = np.minimum(np.maximum(apart_mm, np.maximum(inside, 1e-9)), large + small)
    along = 0.5 * (d - inside * (large + small) / d)
    half_chord = np.sqrt(np.maximum(small * small - along * along, 0.0))
    lens: Floats = small * small * _arccos(along / small)
    lens += large * large * _arccos((d - along) / large)
    lens -= d * half_chord
    np.maximum(lens, 0.0, out=lens)
    np.copyto(lens, np.pi * small * small, where=apart_mm <= inside)
    return lens


def _arccos(cosine: Floats) -> Floats:
    """The angle of a cosine that rounding may have carried beyond 1."""
    angle: Floats = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
    return angle


def is_between(outside_mm: Floats, zone_mm: Floats) -> Mask:
    """Whether points are in zones around a contact, the nearer bound excluded, bool[k, p].

    Args:
        outside_mm: [k, p], how far points are from it, 0 under it.
        zone_mm: [k, 2], from where to where the zones are.
    """
    return (outside_mm > zone_mm[:, :1]) & (outside_mm <= zone_mm[:, 1:])


class Pads:
    """The n pads of a flat piece of skin.

    Args:
        centre_mm: [n, 2].
        radius_mm: one value or [n].
        thickness_mm: of the foam above, one value or [n].
        cover: whether the conductive cover is on, one value or [n].
        membrane_mm: decay length of the surface around a contact (0.2-0.35 mm) if the cover is
            to pull its surroundings down; 0 is the plain Winkler layer.
    """

    def __init__(
        self,
        centre_mm: ArrayLike,
        radius_mm: ArrayLike = C0_RADIUS_MM,
        thickness_mm: ArrayLike = C0_THICKNESS_MM,
        *,
        cover: ArrayLike = True,
        membrane_mm: float = 0.0,
    ) -> None:
        self.centre_mm = np.array(centre_mm, np.float64).reshape(-1, 2)
        n = len(self.centre_mm)
        self.radius_mm = np.broadcast_to(radius_mm, n).astype(np.float64)
        thickness = np.broadcast_to(thickness_mm, n).astype(np.float64)
        self.area_mm2 = np.pi * self.radius_mm**2
        self.c0_ff = C0_FF * (self.radius_mm / C0_RADIUS_MM) ** 2 * C0_THICKNESS_MM / thickness
        self.cover = np.broadcast_to(cover, n).astype(bool)
        self._is_covered = bool(self.cover.all())
        self.membrane_mm = membrane_mm

    def __len__(self) -> int:
        return len(self.centre_mm)

    def footprint(self, shapes: Sequence[Shape]) -> Footprint:
        """What the given contacts cover; contact i of the footprint is `shapes[i]`."""
        return self.zoned_footprint(shapes)[0]

    def zoned_footprint(self, shapes: Sequence[Shape]) -> tuple[Footprint, Floats]:
        """As `footprint`, and between which distances (mm) from its contact each row [m] is.

        The distances, float64[m, 2], are those of `is_between`.
        """
        if not shapes:
            return Footprint.empty(), np.zeros((0, 2))
        rows = [
            (number, *zone) for number, shape in enumerate(shapes) for zone in self._zones(shape)
        ]
        area_mm2 = np.array([shape.area_mm2 for shape in shapes])
        edge = np.ones(len(shapes))
        if self.membrane_mm:
            # K1/K0 of large arguments; good to 2 % for the discs of the rig.
            steep = self.membrane_mm / np.array([shape.edge_radius_mm for shape in shapes])
            edge = 1 + 2 * steep * (1 + steep / 2)
        sizes = [len(taxel) for _, taxel, *_ in rows]
        contact = np.repeat([number for number, *_ in rows], sizes)
        zone_mm = np.repeat([zone_mm for *_, zone_mm in rows], sizes, axis=0)
        taxel, covered, share = (
            np.concatenate(column) for column in list(zip(*rows, strict=True))[1:4]
        )
        covered_mm2 = covered * self.area_mm2[taxel]
        bears_mm2 = np.where(share == 1, covered_mm2, 0.0)
        # Beside the pads, the foam of those it draws down stands for what is under it.
        beside = np.bincount(contact, bears_mm2, len(shapes)) == 0
        bears_mm2 = np.where(beside[contact], covered_mm2, bears_mm2)
        weight = bears_mm2 / np.bincount(contact, bears_mm2, len(shapes))[contact]

        def points_inside(some: Ints) -> Mask:
            of = taxel[some]
            points_mm = self.centre_mm[of, None] + self.radius_mm[of, None, None] * POINTS
            outside_mm = np.empty(points_mm.shape[:2])
            for number in np.unique(contact[some]).tolist():
                own = contact[some] == number
                outside_mm[own] = shapes[number].outside_mm(points_mm[own])
            return is_between(outside_mm, zone_mm[some])

        found = Footprint(taxel, contact, covered, share, weight, area_mm2, edge, points_inside)
        return found, zone_mm

    def _zones(self, shape: Shape) -> Iterator[tuple[Ints, Floats, Floats, tuple[float, float]]]:
        """The contact, then the zones it draws down: pads, covered fractions, shares of the depth,
        and between which distances from the contact (mm) they are.
        """
        reach_mm = self.radius_mm + ZONES[-1] * self.membrane_mm
        near = np.flatnonzero(shape.outside_mm(self.centre_mm) < reach_mm)
        covered = (
            shape.covered_mm2(self.centre_mm[near], self.radius_mm[near]) / self.area_mm2[near]
        )
        hit = covered > 1e-6
        yield near[hit], covered[hit], np.ones(np.count_nonzero(hit)), UNDER_MM
        if not self.membrane_mm:
            return
        points = self.centre_mm[near, None] + self.radius_mm[near, None, None] * POINTS
        outside_mm = shape.outside_mm(points)
        # K0(r/l) / K0(a/l) of large arguments.
        radius_mm = shape.edge_radius_mm
        share = np.sqrt(radius_mm / (radius_mm + outside_mm)) * np.exp(
            -outside_mm / self.membrane_mm
        )
        for start, stop in pairwise(ZONES):
            zone_mm = start * self.membrane_mm, stop * self.membrane_mm
            zone = (outside_mm > zone_mm[0]) & (outside_mm <= zone_mm[1])
            count = zone.sum(axis=1)
            some = count > 0
            mean = (share * zone).sum(axis=1)[some] / count[some]
            yield near[some], count[some] / len(POINTS), mean, zone_mm

    def rise_ff(self, felt: Felt, footprint: Footprint, grounded: ArrayLike = False) -> Floats:
        """Capacitance above rest of all pads, float64[n] (fF).

        Args:
            felt: strained foam, as `FoamLayer.step` answered for `footprint`.
            footprint: where the contacts are.
            grounded: whether each contact's object is grounded, one value or [c]. It only
                matters where the conductive cover is off.
        """
        rise_ff = self.row_rise_ff(felt, footprint, grounded)
        return np.asarray(np.bincount(felt.taxel, rise_ff, len(self)), np.float64)

    def row_rise_ff(self, felt: Felt, footprint: Footprint, grounded: ArrayLike = False) -> Floats:
        """As `rise_ff`, what each row of `felt` adds to its pad, float64[k]."""
        under = felt.covered * self.c0_ff[felt.taxel]
        rise: Floats = under * felt.strain / (1 - felt.strain)
        if not self._is_covered:
            is_grounded = np.zeros(len(felt.taxel), bool)
            contacts = np.broadcast_to(grounded, len(footprint.area_mm2))
            is_grounded[: len(footprint.taxel)] = contacts[footprint.contact]
            bare = np.where(is_grounded, under / (1 - felt.strain), 0.0)
            rise = np.where(self.cover[felt.taxel], rise, bare)
        return rise


def draw_resting_ff(n: int, rng: np.random.Generator) -> Floats:
    """What n untouched pads measure: around 7.8 pF, several thousand codes apart."""
    return RESTING_FF + RESTING_SD_FF * rng.standard_normal(n)


def draw_noise_ff(n: int, rng: np.random.Generator) -> Floats:
    """rms noise of n pads of the best skin: 0.2-0.4 units."""
    return UNIT_FF * rng.uniform(0.2, 0.4, n)


class Jumps:
    """Pads that change to another level above some pressure, until it has fallen well below.

    On the recorded insoles pads of some triangles jump by 15 to 40 units, most of them between
    30 and 120 kPa, and come back at 0.6 of it: a contact or a membrane, not the pressure.

    Args:
        at_kpa: float64[n], where each pad jumps; infinite for one that does not.
        by_ff: float64[n], how far.

    Attributes:
        can: bool[n], whether a pad jumps at any pressure.
    """

    #: Share of the pressure where a pad jumped at which it comes back.
    BACK_SHARE = 0.6

    def __init__(self, at_kpa: Floats, by_ff: Floats) -> None:
        self._at_kpa = at_kpa
        self._by_ff = by_ff
        self._jumped = np.zeros(len(at_kpa), bool)
        self.can = np.isfinite(at_kpa)

    @classmethod
    def drawn(cls, thermal: NDArray[np.bool_], rng: np.random.Generator) -> "Jumps":
        """One triangle in twelve with jumping pads.

        Args:
            thermal: bool[k, 12], the temperature pads: what presses does not reach them.
            rng: draws.
        """
        triangles, n = len(thermal), thermal.size
        at_kpa = np.where(rng.random(triangles) < 1 / 12, rng.uniform(30, 120, triangles), np.inf)
        size = rng.uniform(15, 40, n) * SENT_UNIT_FF
        return cls(np.where(thermal, np.inf, at_kpa[:, None]).ravel(), size)

    @classmethod
    def none(cls, n: int) -> "Jumps":
        """n pads that do not jump."""
        return cls(np.full(n, np.inf), np.zeros(n))

    def step_ff(self, pads: Ints, pressure_kpa: Floats) -> Floats:
        """What the jumps add to some pads [k] that are under so much pressure now (fF)."""
        at_kpa = self._at_kpa[pads]
        at_kpa = np.where(self._jumped[pads], self.BACK_SHARE * at_kpa, at_kpa)
        jumped = self._jumped[pads] = pressure_kpa > at_kpa
        added: Floats = np.where(jumped, self._by_ff[pads], 0.0)
        return added


def draw_dead(n: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which of n pads never move: one in two hundred [chosen].

    The recorded insoles have whole dead triangles, one in nine to two in three of them, and
    hardly a dead pad elsewhere; a dead chip is a fault of its own.
    """
    return rng.random(n) < 1 / 200
