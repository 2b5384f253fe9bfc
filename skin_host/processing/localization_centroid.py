"""The three ways of Son et al., section 2.2, to locate a contact, for any lattice."""

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Rms radial distance of a contact from a single touched pad, in pitches; less with more pads.
#: Measured on the 12-pad triangle with probes of 3, 6 and 10 mm.
GEOMETRY_PITCHES = 0.36
#: The quadratic fit uses pads up to this many pitches from the strongest.
PEAK_PITCHES = 1.6


class Location(NamedTuple):
    """A contact's position float64[3] in the part's frame, m, and its radial standard error."""

    position_m: Floats
    sigma_m: float


class Localizer(Protocol):
    """Locates one contact."""

    def locate(self, taxels: Indices, units: Floats, usable: Mask) -> Location | None:
        """Locate one contact, or return None where its taxels carry no signal.

        Args:
            taxels: intp[k], the contact's taxels, numbered within the part.
            units: float[n], activation of all taxels of the part.
            usable: bool[n], whether a taxel is valid and belongs to no other contact.
        """
        ...


class CentroidLocalizer:
    """The weighted mean of the contact's taxels (Son et al., eq. 2.2).

    `share` leaves out taxels below that share of the greatest; 0.5 is the paper's
    threshold centroid.
    """

    def __init__(
        self,
        position_m: Floats,
        *,
        noise_units: float = 0.5,
        share: float = 0.0,
        pitch_m: Floats | None = None,
    ) -> None:
        self._position_m = position_m
        self._noise_units = noise_units
        self._share = share
        self._pitch_m = nearest_distance(position_m) if pitch_m is None else pitch_m

    def locate(self, taxels: Indices, units: Floats, usable: Mask) -> Location | None:
        taxels = taxels[usable[taxels]]
        if len(taxels) == 0:
            return None
        weight = np.maximum(units[taxels], 0.0)
        strongest = int(weight.argmax())
        weight = np.where(weight >= self._share * weight[strongest], weight, 0.0)
        total = float(weight.sum())
        if not total > 0.0 or not np.isfinite(total):
            return None
        position = self._position_m[taxels]
        centre = weight @ position / total
        taking_part = weight > 0.0
        spread = ((position[taking_part] - centre) ** 2).sum()
        noise_m = self._noise_units * np.sqrt(spread) / total
        geometry_m = (
            GEOMETRY_PITCHES * self._pitch_m[taxels[strongest]] / np.sqrt(taking_part.sum())
        )
        return Location(centre, float(np.hypot(noise_m, geometry_m)))


class PeakLocalizer:
    """The top of a quadratic through the strongest taxel and those around it (Son et al.).

    On the irregular lattice of a triangle the paper's three points in a row become a
    least-squares paraboloid. Where a taxel around is missing, there are too few, or there
    is no top within a pitch of the strongest, the threshold centroid is used.
    """

    def __init__(
        self,
        position_m: Floats,
        normal: Floats,
        *,
        noise_units: float = 0.5,
        pitch_m: Floats | None = None,
    ) -> None:
        self._position_m = position_m
        self._normal = normal
        self._noise_units = noise_units
        self._pitch_m = nearest_distance(position_m) if pitch_m is None else pitch_m
        self._fallback = CentroidLocalizer(
            position_m, noise_units=noise_units, share=0.5, pitch_m=self._pitch_m
        )
        self._fits: dict[int, tuple[Indices, Floats | None, Floats]] = {}

    def locate(self, taxels: Indices, units: Floats, usable: Mask) -> Location | None:
        mine = taxels[usable[taxels]]
        if len(mine) == 0:
            return None
        strongest = int(mine[units[mine].argmax()])
        top = self._top(strongest, units, usable)
        if top is None:
            return self._fallback.locate(taxels, units, usable)
        position_m, noise_m = top
        geometry_m = GEOMETRY_PITCHES * self._pitch_m[strongest] / math.sqrt(len(mine))
        return Location(position_m, math.hypot(noise_m, geometry_m))

    def _top(self, strongest: int, units: Floats, usable: Mask) -> tuple[Floats, float] | None:
        """Return the paraboloid's top and its standard error from noise, or None."""
        if strongest not in self._fits:
            self._fits[strongest] = self._prepare(strongest)
        index, inverse, basis = self._fits[strongest]
        if inverse is None or not usable[index].all():
            return None
        pitch_m = self._pitch_m[strongest]
        height, x, y, xx, xy, yy = (inverse @ units[index]).tolist()
        determinant = xx * yy - xy * xy
        if not (xx + yy < 0.0 and determinant > (1e-6 * height) ** 2):
            return None
        to_top = np.array([[-yy, xy], [xy, -xx]]) / determinant
        offset = to_top @ (x, y)
        if not math.hypot(*offset) <= 1.0:
            return None
        noise = self._noise_units * float(np.linalg.norm(to_top @ inverse[1:3]))
        return self._position_m[strongest] + pitch_m * (offset @ basis), float(pitch_m * noise)

    def _prepare(self, centre: int) -> tuple[Indices, Floats | None, Floats]:
        """Return the taxels around one, the fit of a paraboloid to them, and the plane's axes."""
        pitch_m = self._pitch_m[centre]
        index, flat_m, basis = tangent_plane(
            self._position_m, self._normal, centre, PEAK_PITCHES * pitch_m
        )
        x, y = (flat_m / pitch_m).T if pitch_m > 0.0 else np.zeros((2, 1))
        design = np.column_stack([np.ones(len(x)), x, y, 0.5 * x * x, x * y, 0.5 * y * y])
        if len(x) < 6 or np.linalg.matrix_rank(design) < 6:
            return index, None, basis
        return index, np.linalg.pinv(design), basis


def nearest_distance(position_m: Floats) -> Floats:
    """Return the distance from each taxel to the nearest other, float64[n]; 0 without others."""
    n = len(position_m)
    nearest = np.zeros(n)
    for i in range(n if n > 1 else 0):
        squared = ((position_m - position_m[i]) ** 2).sum(axis=1)
        squared[i] = np.inf
        nearest[i] = np.sqrt(squared.min())
    return nearest


def tangent_plane(
    position_m: Floats, normal: Floats, centre: int, reach_m: float
) -> tuple[Indices, Floats, Floats]:
    """Project taxels near a centre onto the plane that touches the skin there.

    Distances to the centre are preserved, so that a curved patch is unrolled.
    Taxels that face away (more than a right angle) are on another side of the body.

    Returns:
        intp[k] taxels, the centre among them; float64[k, 2] their flat coordinates, m;
        float64[2, 3] the plane's axes.
    """
    off = position_m - position_m[centre]
    distance = np.sqrt((off**2).sum(axis=1))
    index = np.flatnonzero((distance <= reach_m) & (normal @ normal[centre] > 0.0))
    up = normal[centre]
    aside = np.eye(3)[int(np.abs(up).argmin())]
    first = np.cross(aside, up)
    first /= np.linalg.norm(first)
    basis = np.stack([first, np.cross(up, first)])
    flat = off[index] @ basis.T
    length = np.sqrt((flat**2).sum(axis=1))
    stretch = np.divide(distance[index], length, out=np.ones(len(index)), where=length > 0.0)
    return index, flat * stretch[:, None], basis
