"""Location of a contact on a strip array: the three ways of Son et al., section 2.2, and a fourth.

All work on many samples at once: responses float64[n, rows, columns] to places along the columns'
direction, float64[n], in the unit of `around_mm`. Samples without a response give NaN.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.processing.localization_centroid import quadratic_peak

Floats = NDArray[np.float64]

#: Width of the window of `smooth_peak`, in pitches. Wide enough that a sum over places a
#: pitch apart is as good as an integral, narrow enough to leave far elements out.
WINDOW_PITCHES = 1.25


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """Crossed strips wrapped around a cylinder (Son et al., Fig. 1).

    Attributes:
        around_mm: float64[columns], places along the circumference, from the middle.
        along_mm: float64[rows], places along the cylinder's axis, from the middle.
        radius_mm: of the outer surface.
        depth_mm: of the elements below it.
    """

    around_mm: Floats
    along_mm: Floats
    radius_mm: float
    depth_mm: float


def strip_array(
    *,
    strips: int = 8,
    pitch_mm: float = 2.0,
    radius_mm: float = 15.7,
    depth_mm: float = 2.4,
) -> ArrayLayout:
    """The 8 x 8 array of Son et al.: 2 mm pitch under 2.4 mm of rubber, radius 15.7 mm."""
    place: Floats = pitch_mm * (np.arange(strips, dtype=np.float64) - 0.5 * (strips - 1))
    return ArrayLayout(place, place.copy(), radius_mm, depth_mm)


def centroid(response: ArrayLike, around_mm: Floats, *, share: float = 0.0) -> Floats:
    """Centroid over all elements of at least `share` of the greatest (eq. 2.2).

    With share 0 it is the paper's simple centroid, with 0.5 its threshold centroid.
    """
    p = np.asarray(response, np.float64)
    if share > 0.0:
        p = np.where(p >= share * p.max(axis=(1, 2), keepdims=True), p, 0.0)
    # Negative readings stay: cutting them off would turn noise into load all over the array.
    columns = p.sum(axis=1)
    total = columns.sum(axis=1)
    total = np.where(total > 0.0, total, np.nan)
    place: Floats = columns @ around_mm / total
    return place


def peak(response: ArrayLike, around_mm: Floats) -> Floats:
    """Top of a parabola through the greatest element and its neighbours in its row.

    At an edge of the array the greatest element itself is the answer.
    """
    p = np.asarray(response, np.float64)
    n, _, columns = p.shape
    row, column = np.divmod(p.reshape(n, -1).argmax(axis=1), columns)
    inner = np.clip(column, 1, columns - 2)
    sample = np.arange(n)
    a, b, c = (p[sample, row, inner + side] for side in (-1, 0, 1))
    offset = quadratic_peak(a, b, c, float(around_mm[1] - around_mm[0]))
    place = around_mm[column] + np.where(inner == column, offset, 0.0)
    return np.where(p.max(axis=(1, 2)) > 0.0, place, np.nan)


def smooth_peak(response: ArrayLike, around_mm: Floats, *, steps: int = 8) -> Floats:
    """Top of the profile after smoothing with a Gaussian window (mean shift).

    Each step takes the centroid within a window about the last. It looks neither at one
    element's noise, as `peak` does, nor at far elements, as `centroid` does, and has no
    threshold for elements to jump across.
    """
    profile = np.maximum(np.asarray(response, np.float64), 0.0).sum(axis=1)
    place: Floats = around_mm[profile.argmax(axis=1)]
    width = WINDOW_PITCHES * float(around_mm[1] - around_mm[0])
    for _ in range(steps):
        off = around_mm - place[:, None]
        weight = profile * np.exp(-0.5 * (off / width) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            # A bell under the window of its own width moves only half way: step twice.
            place = place + 2.0 * (weight * off).sum(axis=1) / weight.sum(axis=1)
    return place
