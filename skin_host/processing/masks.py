"""Masks over taxels."""

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def any_of(flags: Mask) -> bool:
    """Return whether any is set; numpy's own takes several times as long up to some thousand
    entries.
    """
    return flags.tobytes().find(1) >= 0


def all_of(flags: Mask) -> bool:
    """Return whether every one is set, as fast."""
    return b"\0" not in flags.tobytes()
