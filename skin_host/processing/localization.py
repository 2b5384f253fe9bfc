"""Locates a contact: from the taxels it touches to one position with an uncertainty.

Four methods behind one interface, chosen per part: the three of Son et al. and a template that
uses the pads' geometry. They take the activation of a part's taxels in units (baseline minus
reading, or `PressureCurve.units` of a pressure), because it is proportional to the covered share
of a pad; the pressure of a half covered pad is not.

The template finds the place of a round probe that explains the readings best. A pad responds in
proportion to the covered area (foam as independent springs, paper Figs. 11-13), so a probe of known
size at a known place gives a known pattern. The patterns of all places around a pad are computed
when it is first the strongest; each contact is then one product with that table. The mean of the
places, weighted by how well they explain the readings, has the least expected square error, and
their spread is the uncertainty: for a small probe inside one pad, all places in that pad are
equally probable.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.localization_centroid import (
    CentroidLocalizer,
    Floats,
    Indices,
    Localizer,
    Location,
    Mask,
    PeakLocalizer,
    tangent_plane,
)

Floats32 = NDArray[np.float32]

__all__ = ["Localizer", "Location", "Method", "make_localizer", "separate"]
Method = Literal["centroid", "half_maximum", "peak", "template"]
#: Two maxima are two contacts if the lowest taxel between them is below this share of the lower
#: maximum.
SADDLE = 0.6
#: Assumed sizes of touching objects, for the template, mm. One size is more precise if it is the
#: right one and worse than the centroid if it is not.
PROBES_MM = (6.0, 8.0, 10.0, 12.0)
#: Least distance of the candidate places, mm. Between them the pattern is treated as linear.
STEP_MM = 0.3
#: Most shares of pads that are looked at for one table: places times pads times sizes of probe.
#: Where there would be more, the places lie farther apart. A part of triangles with four sizes has
#: half of that. So a table is laid down within some 200 MB and a second, whatever the pads.
MOST_SHARES = 1_000_000
#: A place is a candidate if the pad is covered there nearly as much as the most covered one.
#: Strengths of pads differ, so the strongest reading may not be that of the most covered pad.
STRONGEST_WITHIN = 0.25
#: Pads differ in strength by about this share even after calibration.
GAIN_SPREAD = 0.03
#: Error of a pattern whose place is up to half of `STEP_MM` away from the candidate, in units per
#: unit (rms).
STEP_SHARE = 0.02
#: Tables of a part that are kept at a time. One has about 0.7 MB with four sizes of probe.
MOST_TABLE_BYTES = 100_000_000


class _Table(NamedTuple):
    """Patterns around one pad, of all candidate places and the pads that any of them covers.

    `pattern` and twice its square are [pads, places]: BLAS is faster over long rows. `moments`
    [places, 4] are 1, x, y, x^2 + y^2 of the places, each times the prior weight of the place (see
    `TemplateLocalizer`); `shape` [places, 3, pads] are the pattern and its slopes along x and y,
    per mm. `frame` [3, 3] holds, in mm, the pad's position and its change per mm along x and y.
    `step_mm` is the distance of the places.
    """

    step_mm: float
    pads: Indices
    place_mm: Floats
    moments: Floats32
    pattern: Floats32
    twice_squared: Floats32
    shape: Floats32
    frame: Floats

    @property
    def size_bytes(self) -> int:
        """Memory of its arrays."""
        return sum(array.nbytes for array in self if isinstance(array, np.ndarray))


class TemplateLocalizer:
    """Matches the readings around the strongest pad with those of a round probe.

    The strength of the push is not known, and two pads alone do not determine how far to their side
    the probe is: farther away and stronger gives the same readings. Strong pushes are assumed to be
    rarer, with the square of the strength, which has no scale; so a place counts in proportion to
    the size of its pattern.

    A contact wider than the largest probe matches none of the patterns: the centroid is used for
    it.

    Args:
        position_m: float64[n, 3] of the part's taxels.
        normal: float64[n, 3].
        radius_mm: float64[n], of the pads.
        probe_mm: diameter of the touching object; several to leave the size open.
        noise_units: standard deviation of an untouched reading, rounding included.
        pitch_m: float64[n], see `make_localizer`.
    """

    def __init__(
        self,
        position_m: Floats,
        normal: Floats,
        radius_mm: Floats,
        probe_mm: float | Sequence[float] = 10.0,
        *,
        noise_units: float = 0.5,
        pitch_m: Floats | None = None,
    ) -> None:
        self._position_m = position_m
        self._normal = normal
        self._radius_mm = radius_mm
        self._probes_mm = np.atleast_1d(np.asarray(probe_mm, np.float64))
        self._noise_units = noise_units
        widest_m = 1e-3 * float(self._probes_mm.max() + 2.0 * radius_mm.max(initial=0.0))
        #: For each taxel those that no probe covers together with it, as bits of a number.
        self._far = [
            int.from_bytes(np.packbits(away, bitorder="little").tobytes(), "little")
            for away in (
                np.linalg.norm(position_m - here, axis=1) > widest_m for here in position_m
            )
        ]
        self._centroid = CentroidLocalizer(position_m, noise_units=noise_units, pitch_m=pitch_m)
        #: Those used longest ago come first.
        self._tables: dict[int, _Table] = {}
        self._tables_bytes = 0

    def locate(self, taxels: Indices, units: Floats, usable: Mask) -> Location | None:
        mine = taxels[usable[taxels]]
        if len(mine) == 0:
            return None
        strongest = int(mine[units[mine].argmax()])
        peak = float(units[strongest])
        if not 0.0 < peak < np.inf:
            return None
        if self._is_wide(mine.tolist()):
            return self._centroid.locate(taxels, units, usable)
        table = self._tables.pop(strongest, None) or self._laid_down(strongest)
        self._tables[strongest] = table
        # Each call of numpy costs as much as its work here, so there are few. All is float32: one
        # float64 among these would copy the tables at each touch.
        trust = usable.take(table.pads)
        reading = np.multiply(units.take(table.pads), trust, dtype=np.float32)
        spread = reading * reading
        spread *= np.float32(GAIN_SPREAD**2)
        between = STEP_SHARE * table.step_mm / STEP_MM
        unsure = np.float32(self._noise_units**2 + (between * peak) ** 2)
        coarse = np.divide(trust, spread + unsure, dtype=np.float32)
        weighted = coarse * reading
        # The strength of the push is unknown: use the best one for each place.
        match = weighted @ table.pattern
        match *= match
        match /= coarse @ table.twice_squared
        place = int(match.argmax())
        best = match[place]
        # The residual of the best pattern, beyond noise, shows that the contact has another shape.
        left = float(weighted @ reading) - 2.0 * float(best)
        excess = max(0.0, left - (np.count_nonzero(trust) - 3))
        misfit = 1.0 + excess / max(len(mine) - 3, 1)
        match -= best
        total, x, y, squared = (np.exp(match, out=match) @ table.moments).tolist()
        x, y = x / total, y / total
        variance_mm2 = max(squared / total - x * x - y * y, 0.0)
        cell_mm2 = table.step_mm**2
        if variance_mm2 < cell_mm2:
            # The places that explain the readings are those around one candidate.
            spread += np.float32(self._noise_units**2)
            fine = np.divide(trust, spread, dtype=np.float32)
            refined = _refine(table, place, reading, fine)
            # A pattern that does not change with the place cannot be refined.
            if refined is not None and refined[2] < variance_mm2 + cell_mm2:
                x, y, of_noise_mm2 = refined
                # A place that lies somewhere in a cell has this spread by itself.
                variance_mm2 = of_noise_mm2 + max(variance_mm2 - cell_mm2 / 6.0, 0.0)
            else:
                variance_mm2 = max(variance_mm2, cell_mm2 / 6.0)
        place_mm = np.array((1.0, x, y)) @ table.frame
        return Location(1e-3 * place_mm, 1e-3 * math.sqrt(variance_mm2 * misfit))

    def _is_wide(self, taxels: list[int]) -> bool:
        """Return whether two of the taxels are too far apart to be covered by one probe."""
        mask = 0
        for taxel in taxels:
            mask |= 1 << taxel
        return any(mask & self._far[taxel] for taxel in taxels)

    def _laid_down(self, centre: int) -> _Table:
        """Return a new table of a pad, after as many others are forgotten as leave room for it."""
        table = self._lay_down(centre)
        self._tables_bytes += table.size_bytes
        while self._tables and self._tables_bytes > MOST_TABLE_BYTES:
            self._tables_bytes -= self._tables.pop(next(iter(self._tables))).size_bytes
        return table

    def _lay_down(self, centre: int) -> _Table:
        """Return the patterns of all places at which this pad would have about the highest
        reading.
        """
        radius = self._radius_mm
        reach_mm = self._probes_mm.max() + 2.0 * radius.max()
        pads, flat_m, basis = tangent_plane(self._position_m, self._normal, centre, 1e-3 * reach_mm)
        flat_mm = 1e3 * flat_m
        half_mm = 0.5 * self._probes_mm.max() + radius[centre]
        places_a_side = math.sqrt(MOST_SHARES / (len(pads) * len(self._probes_mm)))
        step_mm = max(STEP_MM, 2.0 * half_mm / places_a_side)
        axis = step_mm * np.arange(-np.ceil(half_mm / step_mm), np.ceil(half_mm / step_mm) + 1)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        grid = grid[np.hypot(*grid.T) < half_mm]
        # Places much nearer to another pad cannot cover this one most; drop them early.
        away = np.hypot(*_offsets(grid, flat_mm))
        own = int(np.flatnonzero(pads == centre)[0])
        near_places = away[:, own] <= away.min(axis=1) + radius.max()
        near_pads = away.min(axis=0) < half_mm
        grid, away = grid[near_places], away[near_places][:, near_pads]
        pads, flat_mm, radius = pads[near_pads], flat_mm[near_pads], radius[pads[near_pads]]
        own = int(np.flatnonzero(pads == centre)[0])
        places, patterns, slopes = [], [], []
        for probe_mm in self._probes_mm:
            share = _shares(away, radius, probe_mm)
            near = (share[:, own] > 0.0) & (share[:, own] >= share.max(axis=1) - STRONGEST_WITHIN)
            places.append(grid[near])
            patterns.append(share[near])
            slopes.append(_slopes(grid[near], flat_mm, away[near], radius, probe_mm))
        place_mm = np.concatenate(places)
        pattern = np.concatenate(patterns)
        used = pattern.max(axis=0) > 0.0
        pattern = pattern[:, used].astype(np.float32)
        moments = np.column_stack([np.ones(len(place_mm)), place_mm, (place_mm**2).sum(axis=1)])
        moments *= np.linalg.norm(pattern, axis=1, keepdims=True)
        return _Table(
            step_mm,
            pads[used],
            place_mm,
            moments.astype(np.float32),
            np.ascontiguousarray(pattern.T),
            np.ascontiguousarray(2.0 * pattern.T**2),
            np.concatenate([pattern[:, None], np.concatenate(slopes)[:, :, used]], axis=1),
            np.concatenate([1e3 * self._position_m[centre : centre + 1], basis[:2]]),
        )


def _refine(
    table: _Table, place: int, reading: Floats32, weight: Floats32
) -> tuple[float, float, float] | None:
    """One Gauss-Newton step in strength and place, from a candidate place.

    Returns:
        The place, mm, and the sum of its two variances, mm2. None where the step leaves the range
        in which its pattern is linear.
    """
    shape = table.shape[place]
    weighted = shape * weight
    (tt, tx, ty), (_, xx, xy), (_, _, yy) = (weighted @ shape.T).tolist()
    t, x, y = (weighted @ reading).tolist()
    # Solved by elimination of the strength; numpy's solver costs more than all the rest.
    xx, xy, yy = xx - tx * tx / tt, xy - tx * ty / tt, yy - ty * ty / tt
    x, y = x - tx * t / tt, y - ty * t / tt
    determinant = xx * yy - xy * xy
    if not determinant > 1e-6 * (xx + yy) ** 2:
        return None
    move_x, move_y = (yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant
    strength = (t - tx * move_x - ty * move_y) / tt
    limit = table.step_mm * strength
    if not (abs(move_x) <= limit and abs(move_y) <= limit):
        return None
    at_x, at_y = table.place_mm[place].tolist()
    variance = (xx + yy) / determinant / strength**2
    return at_x + move_x / strength, at_y + move_y / strength, variance


def covered_share(
    place_mm: Floats, pad_mm: Floats, pad_radius_mm: Floats, probe_mm: float
) -> Floats:
    """Share of each pad that a round probe covers, float64[places, pads].

    The area of the lens that two circles share, over the pad's area.

    Args:
        place_mm: float64[places, 2], centres of the probe.
        pad_mm: float64[pads, 2].
        pad_radius_mm: float64[pads].
        probe_mm: diameter of the probe.
    """
    return _shares(np.hypot(*_offsets(place_mm, pad_mm)), pad_radius_mm, probe_mm)


def _shares(distance_mm: Floats, pad_radius_mm: Floats, probe_mm: float) -> Floats:
    """Return the same from distances float64[places, pads]."""
    a, b = np.broadcast_to(pad_radius_mm, distance_mm.shape), 0.5 * probe_mm
    cut = _is_cut(distance_mm, a, b)
    share = np.where(distance_mm <= np.abs(a - b), np.minimum(1.0, (b / a) ** 2), 0.0)
    d, a = distance_mm[cut], a[cut]
    at_pad = np.arccos(np.clip((d**2 + a**2 - b**2) / (2.0 * d * a), -1.0, 1.0))
    at_probe = np.arccos(np.clip((d**2 + b**2 - a**2) / (2.0 * d * b), -1.0, 1.0))
    lens = a**2 * at_pad + b**2 * at_probe - 0.5 * np.sqrt(_kite(d, a, b))
    share[cut] = lens / (np.pi * a**2)
    return share


def _slopes(
    place_mm: Floats, pad_mm: Floats, distance_mm: Floats, pad_radius_mm: Floats, probe_mm: float
) -> Floats32:
    """How `covered_share` changes with the place along x and y, float32[places, 2, pads], per mm:
    the lens of two circles shrinks by the length of its chord.
    """
    a, b = np.broadcast_to(pad_radius_mm, distance_mm.shape), 0.5 * probe_mm
    cut = _is_cut(distance_mm, a, b)
    d, a = distance_mm[cut], a[cut]
    slopes = np.zeros((len(place_mm), 2, len(pad_mm)), np.float32)
    for axis, offset in enumerate(_offsets(place_mm, pad_mm)):
        slopes[:, axis][cut] = -np.sqrt(_kite(d, a, b)) / (np.pi * a**2 * d**2) * offset[cut]
    return slopes


def _offsets(place_mm: Floats, pad_mm: Floats) -> tuple[Floats, Floats]:
    """Return from each pad to each place, along x and y, float64[places, pads] each, mm."""
    x: Floats = place_mm[:, 0, None] - pad_mm[:, 0]
    y: Floats = place_mm[:, 1, None] - pad_mm[:, 1]
    return x, y


def _is_cut(d: Floats, a: Floats, b: float) -> Mask:
    """Return at which distances circles of radii a and b cut each other."""
    cut: Mask = (d > np.abs(a - b)) & (d < a + b)
    return cut


def _kite(d: Floats, a: Floats, b: float) -> Floats:
    """Return the square of distance times common chord of circles that cut each other."""
    kite: Floats = (a + b - d) * (d + a - b) * (d - a + b) * (d + a + b)
    return np.maximum(kite, 0.0)


def make_localizer(
    method: Method,
    position_m: Floats,
    normal: Floats,
    radius_mm: Floats,
    *,
    probe_mm: float | Sequence[float] = PROBES_MM,
    noise_units: float = 0.5,
    pitch_m: Floats | None = None,
) -> Localizer:
    """Make the localiser of one part.

    Args:
        method: as in the configuration's `localization`.
        position_m: float64[n, 3] of the part's taxels.
        normal: float64[n, 3].
        radius_mm: float64[n], of the pads.
        probe_mm: for `template`, diameter of what touches; several to leave it open.
        noise_units: standard deviation of an untouched reading, rounding included.
        pitch_m: float64[n], distance of the pads around each; by default that to the nearest.
    """
    match method:
        case "centroid":
            return CentroidLocalizer(position_m, noise_units=noise_units, pitch_m=pitch_m)
        case "half_maximum":
            return CentroidLocalizer(
                position_m, noise_units=noise_units, share=0.5, pitch_m=pitch_m
            )
        case "peak":
            return PeakLocalizer(position_m, normal, noise_units=noise_units, pitch_m=pitch_m)
        case "template":
            return TemplateLocalizer(
                position_m,
                normal,
                radius_mm,
                probe_mm,
                noise_units=noise_units,
                pitch_m=pitch_m,
            )
    assert_never(method)


def separate(
    taxels: Sequence[int], units: Floats, neighbours: Sequence[Sequence[int]]
) -> list[list[int]]:
    """Split a connected group of touched taxels where it has several clear maxima.

    Each taxel goes with its strongest neighbour uphill to a maximum; two hills become one again if
    the pass between them is higher than `SADDLE` of the lower. Groups are ordered by strength,
    strongest first; ties go to the lower number.

    Args:
        taxels: a connected group, numbered within the part.
        units: float[n], activation of the part's taxels.
        neighbours: for each taxel of the part its neighbours.
    """
    members = set(taxels)
    height = {taxel: float(units[taxel]) for taxel in taxels}
    downhill = sorted(taxels, key=lambda taxel: (-height[taxel], taxel))
    rank = {taxel: place for place, taxel in enumerate(downhill)}
    hill_of: dict[int, int] = {}
    merged: dict[int, int] = {}

    def root(hill: int) -> int:
        while merged[hill] != hill:
            hill = merged[hill]
        return hill

    for taxel in downhill:
        # The order is downhill, so this taxel is the pass between the hills that meet here.
        higher = sorted(
            (
                other
                for other in neighbours[taxel]
                if other in members and rank[other] < rank[taxel]
            ),
            key=rank.__getitem__,
        )
        if not higher:
            hill_of[taxel] = merged[taxel] = taxel
            continue
        hill_of[taxel] = hill_of[higher[0]]
        first = root(hill_of[taxel])
        for other in higher[1:]:
            second = root(hill_of[other])
            if first == second:
                continue
            upper, lower = sorted((first, second), key=rank.__getitem__)
            if height[taxel] >= SADDLE * height[lower]:
                merged[lower] = upper
                first = upper
    groups: dict[int, list[int]] = {}
    for taxel in downhill:
        groups.setdefault(root(hill_of[taxel]), []).append(taxel)
    return [sorted(group) for group in groups.values()]
