"""The greatest force that a force/torque board measures in every direction. Pure."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: The largest value of a channel, as a share of its full scale.
LARGEST = 0x7FFF / 0x8000


def reach_n(to_force: Floats, full_scale: Floats, offset: Floats | None = None) -> float:
    """Return up to which force (N) something is measured, whatever its direction.

    The values within the full scales give the forces of a convex body (a zonotope), and the result
    is how far its nearest face is. Each face is spanned by two channels; where those of all
    channels are parallel, or there is none, an axis takes the place of a channel.

    Args:
        to_force: float64[3, 6], from the values of the board to the force (N).
        full_scale: float64[6], the largest values (N, N m).
        offset: float64[6], the values without a load.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        spans = to_force * (LARGEST * full_scale)
        directions = np.nan_to_num(np.hstack([spans / np.linalg.norm(spans, axis=0), np.eye(3)]).T)
        first, second = np.triu_indices(len(directions), 1)
        normals = np.cross(directions[first], directions[second])
        sizes = np.linalg.norm(normals, axis=1)
        normals = normals[sizes > 0.0] / sizes[sizes > 0.0, None]
        distances = np.abs(normals @ spans).sum(axis=1)
        if offset is not None:
            distances -= np.abs(normals @ (to_force @ offset))
        return max(0.0, float(distances.min()))
