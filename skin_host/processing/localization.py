"""Locates a contact: from the taxels it touches to one position with an uncertainty.

Four methods behind one interface, chosen per part: the three of Son et al. and a template that
uses the pads' geometry. They take the activation of a part's taxels in units (baseline minus
reading, or `PressureCurve.units` of a pressure), because it is proportional to the covered share
of a pad; the pressure of a half covered pad is not.
"""

from collections.abc import Sequence
from typing import Literal, assert_never

from skin_host.processing.localization_centroid import (
    CentroidLocalizer,
    Floats,
    Localizer,
    Location,
    PeakLocalizer,
)
from skin_host.processing.localization_template import TemplateLocalizer

__all__ = ["Localizer", "Location", "Method", "make_localizer", "separate"]

Method = Literal["centroid", "half_maximum", "peak", "template"]

#: Two maxima are two contacts if the lowest taxel between them is below this share of the lower
#: maximum.
SADDLE = 0.6
#: Assumed sizes of touching objects, for the template, mm. One size is more precise if it is the
#: right one and worse than the centroid if it is not.
PROBES_MM = (6.0, 8.0, 10.0, 12.0)


def make_localizer(
    method: Method,
    position_m: Floats,
    normal: Floats,
    radius_mm: Floats,
    *,
    probe_mm: float | Sequence[float] = PROBES_MM,
    noise_units: float = 0.5,
) -> Localizer:
    """Make the localiser of one part.

    Args:
        method: as in the configuration's `localization`.
        position_m: float64[n, 3] of the part's taxels.
        normal: float64[n, 3].
        radius_mm: float64[n], of the pads.
        probe_mm: for `template`, diameter of what touches; several to leave it open.
        noise_units: standard deviation of an untouched reading, rounding included.
    """
    match method:
        case "centroid":
            return CentroidLocalizer(position_m, noise_units=noise_units)
        case "half_maximum":
            return CentroidLocalizer(position_m, noise_units=noise_units, share=0.5)
        case "peak":
            return PeakLocalizer(position_m, normal, noise_units=noise_units)
        case "template":
            return TemplateLocalizer(
                position_m, normal, radius_mm, probe_mm, noise_units=noise_units
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
