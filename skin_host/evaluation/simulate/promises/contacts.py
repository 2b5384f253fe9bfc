"""What touch events report of a contact: its force, place, area and pressures."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.promises.limits import (
    FAINT_KPA,
    LEAST_AREA,
    LOCATED_PADS,
    LOCATED_SIGMAS,
    LOOKED_BACK_NS,
    MOST_AREA,
    MOST_TILT,
    PUBLISHED,
    TOUCHING_KPA,
    Mask,
)
from skin_host.evaluation.simulate.promises.truth import Floats, Truth
from skin_host.evaluation.simulate.world import World
from skin_host.layout import TAXELS_PER_TRIANGLE, PadKind, PartLayout, TriangleLayout
from skin_host.processing.events import Touch

Taxels = NDArray[np.intp]


class Known(NamedTuple):
    """What is known of a contact: the taxels [k] of the part that it ever had, and its place."""

    taxels: Taxels
    centroid_m: tuple[float, float, float] | None


class ContactCheck:
    """Compares contacts with the true pressures of their pads, and with where these are.

    Args:
        world: to watch.
        truth: what presses.
    """

    def __init__(self, world: World, truth: Truth) -> None:
        self._world, self._truth = world, truth
        layout = world.layout
        pads = layout.pad_kind == PadKind.PRESSURE
        #: Of each taxel: the area of its pad, and its even share of its unit's outline (mm2).
        self._pad_mm2: Floats = np.where(pads, np.pi * layout.radius_mm**2, 0.0)
        self._share_mm2: Floats = np.zeros(layout.n_taxels)
        units: dict[int, list[TriangleLayout]] = {}
        for triangle in layout.triangles:
            units.setdefault(id(triangle.outline_m), []).append(triangle)
        for triangles in units.values():
            mine = np.zeros_like(pads)
            for triangle in triangles:
                mine[triangle.first : triangle.first + TAXELS_PER_TRIANGLE] = True
            mine &= pads
            self._share_mm2[mine] = _area_m2(triangles[0].outline_m) * 1e6 / mine.sum()
        #: And how far the nearest other pad of its part is (m).
        self._pitch_m: Floats = np.concatenate(
            [_nearest_m(layout.position_m[part.start : part.stop]) for part in layout.parts]
        )

    def wrong(
        self, event: Touch, part: PartLayout, before: Known | None, ever: Taxels, fit: Mask
    ) -> str | None:
        """Return what is wrong with an event that is no end, or None.

        Args:
            event: of a contact with skin.
            part: of the contact.
            before: what was known of it before; None for a begin.
            ever: the taxels of the part that it has had, these included.
            fit: bool[n], taxels whose pressures are judged.
        """
        taxels = np.asarray(event.taxels, np.intp)
        mine = taxels + part.start
        assert event.area_mm2 is not None and event.mean_kpa is not None
        assert event.peak_kpa is not None
        name = f"{part.name}: touch {event.id}"
        pad_mm2, share_mm2 = self._pad_mm2[mine], self._share_mm2[mine]
        least_mm2, most_mm2 = LEAST_AREA * pad_mm2.sum(), MOST_AREA * share_mm2.sum()
        if not least_mm2 <= event.area_mm2 <= most_mm2:
            return (
                f"{name} covers {event.area_mm2:.4g} mm2, and its pads {least_mm2:.0f} to "
                f"{most_mm2:.0f} mm2"
            )
        low, high = np.zeros(len(mine)), np.full(len(mine), np.inf)
        if fit[mine].all():
            least_kpa, most_kpa = self._truth.bounds_kpa(LOOKED_BACK_NS)
            low, high = least_kpa[mine], most_kpa[mine]
            least_n = LEAST_AREA * 1e-3 * (low @ pad_mm2)
            most_n = MOST_AREA * 1e-3 * (high @ share_mm2)
            for what, value, least, most, unit in (
                ("presses", event.force_n, least_n, most_n, "N"),
                ("has a peak of", event.peak_kpa, low.max(), high.max(), "kPa"),
                ("has a mean of", event.mean_kpa, low.min(), high.max(), "kPa"),
            ):
                if not least - PUBLISHED <= value <= most + PUBLISHED:
                    return (
                        f"{name} {what} {value:.4g} {unit}, and what presses it gives {least:.3g} "
                        f"to {most:.3g} {unit}"
                    )
        return self._wrong_place(event, part, before, ever, low, high) or self._wrong_normal(
            event, part, ever
        )

    def _wrong_place(
        self,
        event: Touch,
        part: PartLayout,
        before: Known | None,
        ever: Taxels,
        low: Floats,
        high: Floats,
    ) -> str | None:
        """Return a centroid that is a pitch away from all places that the pressures explain.

        On one pad or two a template's probe explains a reading wherever it covers them, and what
        noise has left of a press is explained by many places: it reports how many. What presses
        beside the pads is in the readings that it explains before those pads are touched.
        """
        assert event.peak_kpa is not None
        if event.centroid_m is None:
            return None
        if event.peak_kpa < FAINT_KPA and before is not None:
            # Hardly felt: it may stay where it was.
            if event.centroid_m == before.centroid_m:
                return None
            low, high = np.zeros_like(low), np.full_like(high, np.inf)
        of_part = slice(part.start, part.stop)
        taxels, place_m = np.asarray(event.taxels, np.intp), self._world.layout.position_m[of_part]
        reach_m, chosen = 0.0, self._world.settings.parts[part.name]
        if chosen.localization != "centroid":
            reach_m = LOCATED_SIGMAS * (event.sigma_m or 0.0)
            if len(event.taxels) < LOCATED_PADS:
                reach_m = max(reach_m, max(chosen.probe_mm) / 2e3)
            pressed = np.flatnonzero(self._truth.most_kpa(LOOKED_BACK_NS)[of_part] > TOUCHING_KPA)
            apart_m = np.linalg.norm(place_m[pressed, None] - place_m[None, ever], axis=2)
            beside = pressed[apart_m.min(axis=1, initial=np.inf) < max(chosen.probe_mm) / 1e3]
            taxels = np.union1d(ever, beside)
            low, high = np.zeros(len(taxels)), np.full(len(taxels), np.inf)
        place_m = place_m[taxels]
        mm2 = self._world.layout.area_mm2[of_part][taxels]
        pitch_m = self._pitch_m[of_part][taxels].max()
        if np.isfinite(high).all():
            least_m = least_mean(place_m, low * mm2, high * mm2)
            most_m = -least_mean(-place_m, low * mm2, high * mm2)
        else:
            least_m, most_m = place_m.min(axis=0), place_m.max(axis=0)
        centroid_m = np.array(event.centroid_m)
        off_m = np.linalg.norm(centroid_m - np.clip(centroid_m, least_m, most_m))
        if off_m <= pitch_m + reach_m:
            return None
        return (
            f"{part.name}: touch {event.id} is at {event.centroid_m} m, {off_m * 1e3:.1f} mm from "
            "where its pads are pressed"
        )

    def _wrong_normal(self, event: Touch, part: PartLayout, ever: Taxels) -> str | None:
        """Return a normal that is not among those of the pads that the contact ever had."""
        if event.normal is None:
            return None
        normals = self._world.layout.normal[part.start : part.stop][ever]
        middle = normals.mean(axis=0)
        middle /= max(float(np.linalg.norm(middle)), 1e-9)
        # Whatever presses each of them, their mean is in the cone that has them all.
        cone, tilt = np.arccos(np.clip(((normals @ middle).min(), middle @ event.normal), -1, 1))
        unit = abs(np.linalg.norm(event.normal) - 1.0) < PUBLISHED
        if unit and tilt <= cone + MOST_TILT:
            return None
        return (
            f"{part.name}: touch {event.id} has the normal {event.normal}, which no pad of it has"
        )


def _area_m2(outline_m: Floats) -> float:
    """Area of a flat polygon [k, 3]."""
    spokes = outline_m - outline_m[0]
    return float(np.linalg.norm(np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)) / 2)


def _nearest_m(place_m: Floats) -> Floats:
    """How far the nearest other place is that is another one, for places [k, 3]."""
    apart_m = np.linalg.norm(place_m[:, None] - place_m[None], axis=2)
    nearest: Floats = np.where(apart_m > 1e-6, apart_m, np.inf).min(axis=1)
    return nearest


def least_mean(place_m: Floats, low: Floats, high: Floats) -> Floats:
    """Return the least mean, along each axis, of places [k, 3] with weights between these [k].

    That has the most weight on the lower places and the least on the higher ones.
    """
    order = np.argsort(place_m, axis=0)
    sorted_m = np.take_along_axis(place_m, order, axis=0)
    heavy, light = high[order], low[order]
    weights = np.cumsum(heavy - light, axis=0) + light.sum(axis=0)
    moments = np.cumsum((heavy - light) * sorted_m, axis=0) + (light * sorted_m).sum(axis=0)
    means = moments / np.where(weights > 0, weights, np.inf)
    least: Floats = np.where(weights > 0, means, np.inf).min(axis=0)
    return np.where(np.isfinite(least), least, sorted_m[0])
