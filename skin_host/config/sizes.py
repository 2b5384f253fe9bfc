"""How large a part may be: one rule for its configuration and for the description of it that
clients receive. Without numpy, which clients do not load.
"""

from collections.abc import Iterable

#: No part is wider, and no pad: beside one, other parts on a map would be too small to be seen.
WIDEST_M = 10.0
#: As far from its origin as a place of a configuration may be.
FARTHEST_M = 1000.0
#: Places are published to 0.001 mm.
DECIMALS_M = 6


def too_large(least_m: Iterable[float], most_m: Iterable[float], radius_mm: float = 0.0) -> str:
    """Return what of a part is larger than any robot's, and what is wanted; nothing: "".

    Args:
        least_m: of all places of its pads and outlines, along each axis.
        most_m: the same.
        radius_mm: that of its largest pad.
    """
    far_m = wide_m = 0.0
    for low_m, high_m in zip(least_m, most_m, strict=True):
        far_m = max(far_m, high_m, -low_m)
        wide_m = max(wide_m, high_m - low_m)
    for size_m, limit_m, what in (
        (far_m, FARTHEST_M, "from its origin"),
        (wide_m, WIDEST_M, "wide"),
        (radius_mm * 1e-3, WIDEST_M, "is the radius of a pad"),
    ):
        if size_m > limit_m:
            return f"{size_m:.8g} m {what}; wanted at most {limit_m:g} m"
    return ""
