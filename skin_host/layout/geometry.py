"""Positions of a unit's pads: tiled, placed manually, or read from a file."""

import math
import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import KindSettings, PlaceSettings
from skin_host.errors import ConfigurationError
from skin_host.files import read_whole

#: Pads closer than this many pitches touch the same object: they are neighbours.
NEIGHBOUR_PITCHES = 1.6
#: A tiled patch without places has at most this many triangles in a row.
TILED_IN_A_ROW = 8
#: Larger numbers in a table of positions are refused: their squares may not be finite.
LARGEST_NUMBER = 1e6
#: Pads of a unit whose distance is more times the pitch of their kind, or less than this share of
#: it, are in another unit of length.
UNLIKE_PITCHES = 3.0
#: What positions seem to be, by the factor that they are too large.
_LENGTHS = {1000.0: "mm", 100.0: "cm", 0.001: "metres divided by 1000"}

Floats = NDArray[np.float64]


def tile(kind: KindSettings, n_units: int, shelf_mm: float) -> tuple[list[PlaceSettings], float]:
    """Return places side by side: triangles as a mesh, other shapes with a gap between them."""
    outline = np.array(kind.outline_mm)
    low, high = outline.min(axis=0), outline.max(axis=0)
    width_mm, height_mm = high - low
    if len(outline) == 3:
        places = []
        n_rows = -(-n_units // TILED_IN_A_ROW)
        for i in range(n_units):
            row, column = divmod(i, -(-n_units // n_rows))
            # Every second triangle is upside down, with its centroid a third higher.
            on_tip = (row + column) % 2 == 1
            places.append(
                PlaceSettings(
                    x_mm=column * width_mm / 2,
                    y_mm=shelf_mm + row * height_mm - low[1] + (height_mm / 3 if on_tip else 0.0),
                    turn_deg=180.0 if on_tip else 0.0,
                )
            )
        return places, shelf_mm + height_mm * n_rows
    step_mm = width_mm + NEIGHBOUR_PITCHES * kind.pitch_mm
    places = [PlaceSettings(x_mm=i * step_mm, y_mm=shelf_mm - low[1]) for i in range(n_units)]
    return places, shelf_mm + height_mm + NEIGHBOUR_PITCHES * kind.pitch_mm


def lay(points_mm: Floats, place: PlaceSettings) -> tuple[Floats, Floats]:
    """Points [k, 2] of a unit's frame as positions [k, 3] (mm) and normals [k, 3].

    Raises:
        ConfigurationError: the place's normal is (0, 0, 0).
    """
    flat = points_mm * [-1.0 if place.mirror else 1.0, 1.0]
    turn = np.deg2rad(place.turn_deg)
    cos, sin = np.cos(turn), np.sin(turn)
    turned = np.column_stack(
        [cos * flat[:, 0] - sin * flat[:, 1], sin * flat[:, 0] + cos * flat[:, 1]]
    )
    if not any(place.normal):
        raise ConfigurationError(f"normal: {list(place.normal)}; wanted a direction")
    rotation = _rotation_from_z(tuple(place.normal))
    position = turned @ rotation[:, :2].T + [place.x_mm, place.y_mm, place.z_mm]
    return position, np.broadcast_to(rotation[:, 2], position.shape)


def unit_vectors(vectors: Floats) -> Floats:
    """Vectors [..., 3] of any length but 0, however small or large, as those of length 1."""
    # Squares of small numbers would be 0.
    scaled = vectors / np.abs(vectors).max(axis=-1, keepdims=True)
    unit: Floats = scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return unit


@lru_cache  # most places of a skin have one normal
def _rotation_from_z(normal: tuple[float, ...]) -> Floats:
    """Shortest rotation [3, 3] that lays the z axis along `normal` (Rodrigues)."""
    x, y, z = unit_vectors(np.array(normal))
    side = np.hypot(x, y)
    if side * side == 0:  # so small numbers have no digits that would give the direction
        return np.diag([1.0, np.sign(z), np.sign(z)])
    # With u = (x, y) / side this is exact near -z too, where 1 / (1 + z) is not.
    u, v = x / side, y / side
    k = 1 - z
    return np.array([[1 - k * u * u, -k * u * v, x], [-k * u * v, 1 - k * v * v, y], [-x, -y, z]])


def shares_mm2(kind: KindSettings) -> Floats:
    """The part of a unit's outline that is nearest to each of its pads, float64[pads] in mm2.

    That is the skin whose pressure the pad stands for: force is the sum of pressure times share.
    The shares add up to the outline, so a press that may be anywhere is neither over- nor
    underrated, whatever the pads' own size; the nearest pad is the best guess between them.
    Skin over a pad that measures temperature belongs to the pressure pads around it; its own
    share is 0, and so is that of a pad to which nothing in the outline is nearest. Pads at the
    same place have equal shares.
    """
    pressing = [pad for number, pad in enumerate(kind.pads_mm) if number not in kind.thermal]
    of_place = _cells_mm2(tuple(pressing), tuple(kind.outline_mm))
    return np.array(
        [
            0.0 if number in kind.thermal else of_place[pad] / pressing.count(pad)
            for number, pad in enumerate(kind.pads_mm)
        ]
    )


Point = tuple[float, float]


@lru_cache  # the patches of a robot are of few kinds
def _cells_mm2(places: tuple[Point, ...], outline: tuple[Point, ...]) -> dict[Point, float]:
    """Area of each place's Voronoi cell inside an outline, which need not be convex."""
    sense = math.copysign(1.0, _signed_area(outline))
    cells = {}
    for place in set(places):
        x, y = place
        cell = list(outline)
        for other in sorted(set(places) - {place}, key=lambda other: math.dist(place, other)):
            across = other[0] - x, other[1] - y
            # Places further away than twice the furthest corner cut nothing off any more.
            if not cell or math.hypot(*across) > 2 * max(math.dist(place, one) for one in cell):
                break
            cell = _cut(cell, ((x + other[0]) / 2, (y + other[1]) / 2), across)
        cells[place] = max(sense * _signed_area(cell), 0.0)
    return cells


def _cut(polygon: list[Point], edge: Point, outwards: Point) -> list[Point]:
    """The polygon without what lies beyond a straight edge (Sutherland and Hodgman).

    Of one that is not convex the pieces hang together by strips without area.
    """
    beyond = [(x - edge[0]) * outwards[0] + (y - edge[1]) * outwards[1] for x, y in polygon]
    left = []
    for number, (end, end_beyond) in enumerate(zip(polygon, beyond, strict=True)):
        begin, begin_beyond = polygon[number - 1], beyond[number - 1]
        if (begin_beyond > 0.0) != (end_beyond > 0.0):
            along = begin_beyond / (begin_beyond - end_beyond)
            left.append(
                (begin[0] + along * (end[0] - begin[0]), begin[1] + along * (end[1] - begin[1]))
            )
        if end_beyond <= 0.0:
            left.append(end)
    return left


def _signed_area(polygon: Sequence[Point]) -> float:
    """Area of a polygon, negative if its corners run clockwise."""
    corners = zip(polygon, [*polygon[1:], *polygon[:1]], strict=True)
    return sum(x * next_y - next_x * y for (x, y), (next_x, next_y) in corners) / 2


class PlaneFit(NamedTuple):
    """Position of a flat unit: `origin_m` [3], its x and y `axes` [3, 2], and how well it fits."""

    origin_m: Floats
    axes: Floats
    rms_m: float

    def place(self, points_mm: Floats) -> Floats:
        """Points [k, 2] of the unit's frame as positions [k, 3] (m)."""
        position: Floats = self.origin_m + points_mm * 1e-3 @ self.axes.T
        return position


def fit_unit(pads_mm: Floats, position_m: Floats, normal: Floats) -> PlaneFit:
    """Fit a flat unit so that its pads [k, 2] come closest to known places [k, 3].

    Least squares over rotations and shifts (Kabsch); the result may be mirrored, as some units are.
    Where the places are too few to decide, `normal` [3] decides.
    """
    centre_m, middle_m = position_m.mean(axis=0), pads_mm.mean(axis=0) * 1e-3
    flat = pads_mm * 1e-3 - middle_m
    left, strength, right = np.linalg.svd((position_m - centre_m).T @ flat, full_matrices=False)
    if strength[0] < 1e-9:  # m^2: all at one place
        axes = _rotation_from_z(tuple(normal.tolist()))[:, :2]
    else:
        if strength[1] < 1e-3 * strength[0]:  # in one line
            along = left[:, 0]
            across = np.cross(normal, along)
            if np.linalg.norm(across) < 1e-6:
                across = np.cross(np.eye(3)[np.argmin(np.abs(along))], along)
            across *= np.linalg.det(right) / np.linalg.norm(across)
            left = np.column_stack([along, across])
        axes = left @ right
    apart = position_m - centre_m - flat @ axes.T
    rms_m = float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))
    return PlaneFit(centre_m - axes @ middle_m, axes, rms_m)


def fitted_outline(kind: KindSettings, position_m: Floats, normal: Floats) -> Floats:
    """The outline [k, 3] (m) of a unit whose pads lie at `position_m` [n, 3]."""
    mean = normal.mean(axis=0)
    up = mean if np.linalg.norm(mean) > 0 else normal[0]
    return fit_unit(np.array(kind.pads_mm), position_m, up).place(np.array(kind.outline_mm))


def read_positions(where: str, path: Path, n: int) -> tuple[Floats, Floats]:
    """Read n rows `x y z nx ny nz` (m), the normals of any length; (0, 0, 0) counts as +z.

    Raises:
        ConfigurationError: unreadable, wrong in shape, or with a number that is not finite.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of an empty file; its shape is checked
            table = np.loadtxt(read_whole(path).decode().splitlines(), ndmin=2)
    except OSError as error:
        what = f"{where}.positions: {path}: cannot be read: {error.strerror}"
        raise ConfigurationError(what) from None
    except ValueError as error:
        why = str(error).removesuffix(".")
        raise ConfigurationError(
            f"{where}.positions: {path}: {why}; wanted {n} rows x y z nx ny nz alone: "
            "`skin import positions` takes them from a file of an iCub"
        ) from None
    if table.shape != (n, 6):
        raise ConfigurationError(
            f"{where}.positions: {path}: {table.shape[0]} rows of {table.shape[1]} numbers; "
            f"wanted {n} rows x y z nx ny nz"
        )
    if not np.isfinite(table).all():
        raise ConfigurationError(f"{where}.positions: {path}: holds a number that is not finite")
    if np.abs(table).max() > LARGEST_NUMBER:
        raise ConfigurationError(
            f"{where}.positions: {path}: seen {table.flat[np.abs(table).argmax()]:g}, wanted "
            f"numbers between -{LARGEST_NUMBER:g} and {LARGEST_NUMBER:g}"
        )
    normal = table[:, 3:]
    normal[~normal.any(axis=1)] = [0.0, 0.0, 1.0]
    return table[:, :3], unit_vectors(normal)


def by_unit(kind: KindSettings, vectors: Floats) -> Floats:
    """Return of vectors [n, 3] of units' pads those of each one's pressure pads, [units, k, 3]."""
    pressing = [pad for pad in range(len(kind.pads_mm)) if pad not in kind.thermal]
    return vectors.reshape(-1, len(kind.pads_mm), 3)[:, pressing]


def distances_mm(kind: KindSettings, position_m: Floats) -> Floats:
    """Return the distances of the pressure pads of each unit, [units, k, k].

    A pad is infinitely far from itself.
    """
    position_mm = 1e3 * by_unit(kind, position_m)
    apart_mm: Floats = np.linalg.norm(position_mm[:, :, None] - position_mm[:, None], axis=3)
    pads = np.arange(apart_mm.shape[1])
    apart_mm[:, pads, pads] = np.inf
    return apart_mm


def unlike_pitch(name: str, kind: KindSettings, position_m: Floats) -> str:
    """Return what shows that positions of units of the kind `name` are not in metres, or ""."""
    nearest_mm = distances_mm(kind, position_m).min(axis=2, initial=np.inf)
    if nearest_mm.shape[1] < 2:
        return ""
    apart_mm = float(np.median(nearest_mm))
    pitches = apart_mm / kind.pitch_mm
    if 1.0 / UNLIKE_PITCHES <= pitches <= UNLIKE_PITCHES:
        return ""
    alike = [length for factor, length in _LENGTHS.items() if 0.5 < pitches / factor < 2.0]
    return (
        f"pads lie {apart_mm:.3g} mm apart, those of {name} {kind.pitch_mm:g} mm; wanted metres"
        + "".join(f": these look like {length}" for length in alike)
    )
