"""Contact mechanics of the foam: the depth of a probe and the force on it.

The foam is a Winkler layer: each point responds only to its own compression, which is what the
paper's Figs. 11-16 show (no crosstalk, 5 and 6 mm probes alike). Its law is

    sigma(x) = E0 x (1 + k x^2)      with a pole at x = 0.95 from x = 0.85 (about 200 kPa) on,

fitted to the paper's eq. (1) below 130 kPa. With the viscoelastic truth of
`emulator.probes.viscoelastic` a taxel under strain x carries P = sigma(x) - relaxation, and never
less than zero: where the foam has not yet recovered, the probe does not touch it.

No probe squeezes the foam beyond `MOST_STRAIN`, which bears some 2 MPa (Infinergy 3.5 MPa): what a
probe presses with above that goes past the foam into the board below it.

Quantities: strain x = depth / thickness; pressures in kPa; "elastic pressure" is sigma(x).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.probes.overlap import Overlap, PointsInside, shared_rows
from emulator.probes.viscoelastic import FoamTruth

E0_KPA = 91.7
STIFFENING = 2.07
#: Spread from taxel to taxel: k explains that taxels agree at low pressure and differ by 1.44
#: at 155 kPa (paper, Figs. 14-15), E0 hardly differs.
STIFFENING_SD = 0.12
E0_SD = 0.025

#: Infinergy (expanded thermoplastic polyurethane) under air, 3 mm of it on pads of 2.2 mm radius:
#: fitted to the median pad of the recorded insole `left_calibration`, with the Cole-Cole truth at
#: `INFINERGY_LOSS` of its losses. It is over five times as stiff as the paper's foam.
INFINERGY_E0_KPA = 521.0
INFINERGY_STIFFENING = 3.06
INFINERGY_LOSS = 0.464

DENSE_STRAIN = 0.85
POLE_STRAIN = 0.95
MOST_STRAIN = 0.94
_DENSE_KPA = 2000.0
#: Of a drive (N or mm) what is above this counts as this.
_MOST_DRIVE = 1e12

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Foam:
    """The elastic law under each of n taxels: arrays [n] of E0 (kPa), k and thickness (mm)."""

    e0_kpa: Floats
    stiffening: Floats
    thickness_mm: Floats

    @classmethod
    def uniform(cls, n: int, thickness_mm: ArrayLike = 2.0) -> "Foam":
        """The same law everywhere. `thickness_mm`: one value or [n]; 2 on hands, else 3."""
        return cls(
            np.full(n, E0_KPA), np.full(n, STIFFENING), np.broadcast_to(thickness_mm, n) + 0.0
        )

    @classmethod
    def drawn(cls, n: int, rng: np.random.Generator, thickness_mm: ArrayLike = 2.0) -> "Foam":
        """A real layer: k log-normal with sd 12 %, E0 with sd 2.5 %."""
        stiffening = STIFFENING * np.exp(STIFFENING_SD * rng.standard_normal(n))
        e0_kpa = E0_KPA * np.exp(E0_SD * rng.standard_normal(n))
        return cls(e0_kpa, stiffening, np.broadcast_to(thickness_mm, n) + 0.0)

    def infinergy(self) -> "Foam":
        """The same layer, with its spread, of Infinergy instead of the paper's foam."""
        return Foam(
            self.e0_kpa * INFINERGY_E0_KPA / E0_KPA,
            self.stiffening * INFINERGY_STIFFENING / STIFFENING,
            self.thickness_mm,
        )

    def __len__(self) -> int:
        return len(self.e0_kpa)

    def take(self, taxels: Ints) -> "Foam":
        """The law under some taxels only."""
        return Foam(self.e0_kpa[taxels], self.stiffening[taxels], self.thickness_mm[taxels])

    def and_also(self, other: "Foam") -> "Foam":
        """The laws of this foam, then those of another."""
        return Foam(
            np.concatenate([self.e0_kpa, other.e0_kpa]),
            np.concatenate([self.stiffening, other.stiffening]),
            np.concatenate([self.thickness_mm, other.thickness_mm]),
        )

    def elastic_kpa(self, strain: Floats) -> Floats:
        """sigma(x) for strains [n] below the pole."""
        value = self.e0_kpa * strain * (1 + self.stiffening * strain * strain)
        if strain.max(initial=0.0) > DENSE_STRAIN:
            over = np.maximum(strain - DENSE_STRAIN, 0.0)
            value += _DENSE_KPA * over**2 / (POLE_STRAIN - strain)
        return value

    def strain(self, elastic_kpa: Floats) -> Floats:
        """The inverse of `elastic_kpa`, for pressures [n] >= 0."""
        # Without densification the law is a cubic with one real root (hyperbolic form).
        root = np.sqrt(3 * self.stiffening)
        argument = 1.5 * root * elastic_kpa / self.e0_kpa
        strain = 2 / root * np.sinh(np.arcsinh(argument) / 3)
        if strain.max(initial=0.0) <= DENSE_STRAIN:
            return strain
        # The law is convex, so Newton's steps from above come down to the root.
        strain = np.minimum(strain, 0.5 * (DENSE_STRAIN + POLE_STRAIN))
        for _ in range(50):
            value, slope = self.elastic_kpa_and_slope(strain)
            step = (value - elastic_kpa) / slope
            strain = np.minimum(strain - step, 0.5 * (strain + POLE_STRAIN))
            if np.abs(step).max() < 1e-13:
                break
        return strain

    def elastic_kpa_and_slope(self, strain: Floats) -> tuple[Floats, Floats]:
        """sigma(x) and its derivative, for strains [n] below the pole."""
        square = self.stiffening * strain * strain
        value = self.e0_kpa * strain * (1 + square)
        slope = self.e0_kpa * (1 + 3 * square)
        if strain.max(initial=0.0) > DENSE_STRAIN:
            over = np.maximum(strain - DENSE_STRAIN, 0.0)
            room = POLE_STRAIN - strain
            value = value + _DENSE_KPA * over**2 / room
            slope = slope + _DENSE_KPA * over * (2 * room + over) / room**2
        return value, slope


def deepest_mm(thickness_mm: float, area_mm2: float, compliance_mm_per_n: float = 0.0) -> float:
    """How deep a probe can be driven: until the foam below it is at `MOST_STRAIN`.

    Args:
        thickness_mm: of the foam.
        area_mm2: of the probe.
        compliance_mm_per_n: of the spring in series, which takes the rest.
    """
    most_kpa = float(Foam.uniform(1).elastic_kpa(np.array([MOST_STRAIN]))[0])
    return MOST_STRAIN * thickness_mm + compliance_mm_per_n * area_mm2 * most_kpa * 1e-3


# Not frozen: sliding probes need one at each step, and a frozen one takes three times as long.
@dataclass(slots=True)
class Footprint:
    """Which pads c contacts cover: m rows, one for each pad (or zone of a pad) of a contact.

    Contacts that slide have a new footprint at each step. Where two footprints share the object
    `area_mm2`, they are of the same contacts; where they share `taxel` too, their rows are of the
    same pads. That saves finding it out.

    Attributes:
        taxel, contact: int[m], indices of the pad and of the contact.
        covered: float64[m], fraction of the pad's area in this row.
        share: float64[m], strain here as a fraction of the strain under the contact: 1 under
            it, less in the zone around it that a membrane draws down.
        weight: float64[m], share of this row in the area that bears its contact: they add up to
            1 for a contact with any pad under it; 0 in the zone around.
        area_mm2: float64[c], the contact's whole area.
        edge: float64[c], force on the contact over force on its area alone; 1 without membrane.
        points_inside: which points of their pads rows cover, to find where contacts overlap; None
            if no two of them cover the same pad.
        meets: bool[c], which contacts may overlap another one; None if that is not known.
    """

    taxel: Ints
    contact: Ints
    covered: Floats
    share: Floats
    weight: Floats
    area_mm2: Floats
    edge: Floats
    points_inside: PointsInside | None = None
    meets: Mask | None = None

    @classmethod
    def empty(cls) -> "Footprint":
        """No contact at all."""
        index, none = np.zeros(0, np.intp), np.zeros(0)
        return cls(index, index, none, none, none, none, none)


@dataclass(frozen=True, slots=True)
class Drive:
    """How c rigid probes are driven: arrays [c].

    A probe that is driven by depth is commanded below the undeformed surface and reaches that
    through a spring in series: load cell, arm, or the object itself.

    Attributes:
        value: float64[c], force (N) or depth (mm).
        is_depth: bool[c], which of the two.
        compliance_mm_per_n: float64[c], of the springs.
    """

    value: Floats
    is_depth: Mask
    compliance_mm_per_n: Floats

    @classmethod
    def by_force(cls, force_n: ArrayLike) -> "Drive":
        """Probes pushed with given forces [c] (N)."""
        force = np.atleast_1d(np.asarray(force_n, np.float64))
        return cls(force, np.zeros(len(force), bool), np.zeros(len(force)))

    @classmethod
    def by_depth(cls, depth_mm: ArrayLike, compliance_mm_per_n: ArrayLike = 0.0) -> "Drive":
        """Probes moved to given depths [c] (mm) by robots of given compliance."""
        depth = np.atleast_1d(np.asarray(depth_mm, np.float64))
        compliance = np.broadcast_to(compliance_mm_per_n, depth.shape).astype(np.float64)
        return cls(depth, np.ones(len(depth), bool), compliance)


@dataclass(frozen=True, slots=True)
class Felt:
    """Strained foam after a step: arrays [k], the footprint's rows first, then residuals.

    `covered` is the fraction of the pad that is strained so; where contacts overlap, it is the
    deepest one's alone.
    """

    taxel: Ints
    strain: Floats
    covered: Floats


class FoamLayer:
    """The foam of n taxels over time, computed only where something presses or has pressed.

    Args:
        foam: elastic law, n taxels.
        truth: viscoelastic truth, n taxels.

    Attributes:
        pressure_kpa: float64[n], true pressure on the part of each pad that is pressed deepest.
        force_n, depth_mm: float64[c], of each contact in the last step: what the foam bears.
        is_still: the last step changed nothing: nothing pressed, and no foam was due that recovers.
    """

    #: Foam that nothing touches any more is followed in steps of this length.
    RECOVERY_STEP_S = 0.25
    #: A residual below this elastic pressure is over: a hundredth of one unit.
    RESIDUAL_OVER_KPA = 0.02

    def __init__(self, foam: Foam, truth: FoamTruth) -> None:
        self.foam = foam
        self.truth = truth
        self.pressure_kpa = np.zeros(len(foam))
        self.force_n = np.zeros(0)
        self.depth_mm = np.zeros(0)
        self._imprint_strain = np.zeros(len(foam))
        self._covered = np.zeros(len(foam))
        self._touched = self._recovering = np.zeros(0, np.intp)
        #: Since recovering foam was last worked out; foam that was left since then is ahead.
        self._waited_s = 0.0
        self._ahead_s = np.zeros(len(foam))
        self._mean_thickness_mm = float(foam.thickness_mm.mean()) if len(foam) else 1.0
        self._footprint = Footprint.empty()
        self._drive = Drive.by_force([])
        #: Of the footprint's rows in the last step: the pressure, and the fraction of the pad under
        #: it; and where contacts overlap.
        self._row_kpa = self._row_covered = np.zeros(0)
        self._overlap: Overlap | None = None
        self._a = self._b = self._unit = np.zeros(0)
        self._is_moved = False
        self.is_still = False
        #: Strains of the last step, and of the two before it.
        self._strain = np.zeros(0)
        self._strains_before = self._strain, self._strain
        self._cover(self._footprint)
        self._meet(0)

    def step(self, footprint: Footprint, drive: Drive, dt_s: float) -> Felt:
        """Let `dt_s` pass while `footprint`'s contacts go where `drive` takes them.

        A footprint object that stays the same from step to step saves finding out what it
        covers; make a new one only for contacts that moved, came or went.
        """
        is_bare = footprint is self._footprint and not len(footprint.area_mm2)
        if not is_bare:
            self._take(footprint, drive, dt_s)
        self._waited_s += dt_s
        is_due = self._waited_s >= self.RECOVERY_STEP_S
        if is_due:
            self._recover()
        self.is_still = is_bare and not is_due
        if is_bare:
            return Felt(self._felt_taxel, *self._left)
        rows = footprint
        imprint = self.truth.relaxation_kpa[rows.taxel]
        strain = self._press(drive, imprint)[rows.contact] * rows.share
        # Where the foam has not come back to the probe's depth, they do not touch.
        elastic = np.maximum(self._law.elastic_kpa(strain), imprint)
        loose = elastic <= imprint
        is_loose = bool(loose.any())
        if is_loose:
            strain = np.where(loose, self._law.strain(elastic), strain)
        if self._repeats:
            deepest = np.zeros(len(self.foam))
            np.maximum.at(deepest, rows.taxel, elastic)
            pressure = self.truth.step(deepest[self._touched], dt_s, self._touched)
            self.pressure_kpa[self._touched] = np.maximum(pressure, 0.0)
            pressure = self.pressure_kpa[rows.taxel]
            # Each contact on a pad strains it differently, and presses by so much less than the
            # deepest one: the pad's foam has one memory. Zones around a contact are none.
            less_kpa = np.where(rows.share == 1, deepest[rows.taxel] - elastic, 0.0)
            pressure = np.maximum(pressure - less_kpa, 0.0)
        else:
            pressure = np.maximum(self.truth.step(elastic, dt_s, rows.taxel), 0.0)
            self.pressure_kpa[rows.taxel] = pressure
        self._row_kpa = pressure
        covered = rows.covered if self._overlap is None else self._overlap.covered(strain)
        self._row_covered = covered
        borne = rows.weight * (np.where(loose, 0.0, pressure) if is_loose else pressure)
        # Of no rows at all numpy makes whole numbers.
        mean_kpa = np.asarray(np.bincount(rows.contact, borne, len(rows.area_mm2)), np.float64)
        if len(self._between):
            mean_kpa[~self._bears] = self._between.elastic_kpa(self._strain[~self._bears])
        self.force_n = mean_kpa * self._bears_n_per_kpa
        if not len(self._recovering):
            return Felt(rows.taxel, strain, covered)
        left_strain, left_covered = self._left
        return Felt(
            self._felt_taxel,
            np.concatenate([strain, left_strain]),
            np.concatenate([covered, left_covered]),
        )

    def mean_kpa(self) -> Floats:
        """True pressure of each pad, float64[n]: mean over its whole area (kPa)."""
        rows = self._footprint
        # What a contact only draws down is not pressed.
        bears = np.where(rows.weight > 0, self._row_kpa * self._row_covered, 0.0)
        mean = np.bincount(rows.taxel, bears, len(self.foam))
        return mean.astype(np.float64, copy=False)

    def _press(self, drive: Drive, imprint: Floats) -> Floats:
        """The strain under each contact, [c]: a x + b p(x) = d by Newton's method.

        p is the mean pressure under the contact. It is convex in x, so the steps overshoot at
        most once and then come down to the root.
        """
        contact, weight, n_contacts = (
            self._footprint.contact,
            self._footprint.weight,
            len(self._unit),
        )
        law = self._law
        if len(self._between):
            bare = np.flatnonzero(~self._bears)
            contact = np.concatenate([contact, bare])
            weight = np.concatenate([weight, np.ones(len(bare))])
            imprint = np.concatenate([imprint, np.zeros(len(bare))])
            law = law.and_also(self._between)
        # More than any foam bears: whatever a program asks for stays a number that can be divided.
        wanted = np.minimum(np.maximum(drive.value, 0.0), _MOST_DRIVE)
        d = wanted / self._unit
        # Start value: the contact continues nearly as in the last three steps.
        last, before, earlier = self._strain, *self._strains_before
        strain = 3 * (last - before) + earlier
        nearest = np.minimum(0.5 * (last + POLE_STRAIN), MOST_STRAIN)
        strain = np.minimum(np.maximum(strain, 0.0), nearest)
        for _ in range(60):
            value, slope = law.elastic_kpa_and_slope(strain[contact])
            over = value - imprint
            bearing = np.where(over > 0, weight, 0.0)
            mean = np.asarray(np.bincount(contact, bearing * over, n_contacts), np.float64)
            rise = np.asarray(np.bincount(contact, bearing * slope, n_contacts), np.float64)
            if self._is_moved:
                mean, rise = self._a * strain + self._b * mean, self._a + self._b * rise
            newton = (mean - d) / np.maximum(rise, 1e-9)
            # Half way to the pole at most, so that no step jumps over it.
            nearest = np.minimum(0.5 * (strain + POLE_STRAIN), MOST_STRAIN)
            last, strain = strain, np.minimum(np.maximum(strain - newton, 0.0), nearest)
            # Convergence is quadratic: what is left is far below the step just made.
            if np.abs(strain - last).max(initial=0.0) < 1e-5:
                break
        self._strains_before = self._strain, self._strains_before[0]
        self._strain = strain
        self.depth_mm = strain * self._thickness_mm
        return strain

    def _take(self, footprint: Footprint, drive: Drive, dt_s: float) -> None:
        """Take over what has changed in a footprint and a drive."""
        before, self._footprint = self._footprint, footprint
        changed = footprint is not before
        if footprint.taxel is not before.taxel:
            self._release(before, footprint, dt_s)
            self._cover(footprint)
        elif changed and not self._is_even:
            self._set_thickness(footprint)
        else:
            changed = False
        if footprint is not before:
            self._overlap = self._overlapping(footprint)
        if footprint.area_mm2 is not before.area_mm2:
            self._meet(len(footprint.area_mm2))
        if (
            changed
            or drive.is_depth is not self._drive.is_depth
            or drive.compliance_mm_per_n is not self._drive.compliance_mm_per_n
        ):
            self._set_drive(drive)
        self._drive = drive

    def _release(self, before: Footprint, footprint: Footprint, dt_s: float) -> None:
        """Release the foam that a new footprint no longer covers; it has `dt_s` to come back."""
        is_touched = np.zeros(len(self.foam), bool)
        is_touched[footprint.taxel] = True
        left = self._touched[~is_touched[self._touched]]
        self._touched = np.flatnonzero(is_touched)
        if len(left):
            self._covered[left] = 0.0
            np.add.at(self._covered, before.taxel, self._row_covered)
        is_met = is_touched[self._recovering]
        if is_met.any():
            met = self._recovering[is_met]
            self._free(met, self._waited_s - self._ahead_s[met])
            self._recovering = self._recovering[~is_met]
        if not len(self._recovering):
            self._waited_s = 0.0
        if len(left):
            self._ahead_s[left] = self._waited_s + dt_s
            left = self._free(left, dt_s)
            self._recovering = np.concatenate([self._recovering, left])

    def _cover(self, rows: Footprint) -> None:
        """Gather the foam under a footprint."""
        n_contacts = len(rows.area_mm2)
        self._repeats = len(self._touched) < len(rows.taxel)
        self._felt_taxel = np.concatenate([rows.taxel, self._recovering])
        self._set_left()
        self._law = self.foam.take(rows.taxel)
        self._bears = np.bincount(rows.contact, rows.weight, n_contacts) > 0
        # A probe between the pads has foam under it too: nominal, and purely elastic.
        self._between = Foam.uniform(int(np.count_nonzero(~self._bears)))
        self._bears_n_per_kpa = rows.area_mm2 * rows.edge * 1e-3
        self._set_thickness(rows)

    def _overlapping(self, rows: Footprint) -> Overlap | None:
        """Where contacts of a footprint overlap on a pad, or None if they do not."""
        meets = rows.meets
        if not self._repeats or rows.points_inside is None or not (meets is None or meets.any()):
            return None
        shared = shared_rows(rows.taxel, rows.contact, len(self.foam))
        if meets is not None:
            shared = shared[meets[rows.contact[shared]]]
        if not len(shared):
            return None
        overlap = Overlap(rows.taxel, rows.covered, shared, rows.points_inside)
        return overlap if overlap.is_any else None

    def _set_thickness(self, rows: Footprint) -> None:
        """Of the foam under each contact; whether it is the same all over each of them."""
        of_row = self._law.thickness_mm
        thickness_mm = np.full(len(rows.area_mm2), self._mean_thickness_mm)
        thickness_mm[rows.contact] = of_row
        self._is_even = bool((thickness_mm[rows.contact] == of_row).all())
        if not self._is_even:
            mean_mm = np.bincount(rows.contact, rows.weight * of_row, len(rows.area_mm2))
            thickness_mm = np.where(self._bears, mean_mm, self._mean_thickness_mm)
        self._thickness_mm = thickness_mm

    def _meet(self, n_contacts: int) -> None:
        """Of new contacts nothing is known."""
        self._strain = np.full(n_contacts, 0.3)
        self._strains_before = self._strain, self._strain

    def _set_drive(self, drive: Drive) -> None:
        """What `_press` has to solve, but for the present value of the drive."""
        forced = ~drive.is_depth
        self._is_moved = not forced.all()
        softness = drive.compliance_mm_per_n * self._bears_n_per_kpa / self._thickness_mm
        self._a = np.where(forced, 0.0, 1.0)
        self._b = np.where(forced, 1.0, softness)
        self._unit = np.where(forced, self._bears_n_per_kpa, self._thickness_mm)

    def _recover(self) -> None:
        """Bring recovering foam to the present."""
        before = self._recovering
        if len(before):
            self._recovering = self._free(before, self._waited_s - self._ahead_s[before])
            self._set_left()
            # The same pads as before are the same object, which saves finding it out.
            if len(self._recovering) < len(before):
                self._felt_taxel = np.concatenate([self._footprint.taxel, self._recovering])
            self._ahead_s[self._recovering] = 0.0
        self._waited_s = 0.0

    def _set_left(self) -> None:
        """Strain and covered share of foam that still recovers; constant while it is left."""
        left = self._recovering
        self._left = self._imprint_strain[left], self._covered[left]

    def _free(self, taxels: Ints, dt_s: float | Floats) -> Ints:
        """Let untouched foam come back for `dt_s`; returns where a residual is left."""
        elastic = self.truth.step_pressure(np.zeros(len(taxels)), dt_s, taxels)
        self.pressure_kpa[taxels] = 0.0
        self._imprint_strain[taxels] = self.foam.take(taxels).strain(elastic)
        shows = elastic >= self.RESIDUAL_OVER_KPA
        self.truth.reset(taxels[~shows])
        return taxels[shows]
