"""A part that becomes warmer or colder while it is calibrated: its pads move alike, and slowly."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.calibration import Floats
from skin_host.processing.calibration.block_means import BlockMeans

#: Less than this in the whole time is left in the readings; baselines follow it within seconds.
LEAST_UNITS = 1.0
#: The course of a part is looked at in so many pieces. In none of them it may go faster than drift,
#: by more than so many standard errors.
PIECES = 16
SURE_ERRORS = 5.0
#: It rises or falls: this share of its way is from its begin to its end. Noise that wanders goes to
#: and fro.
STRAIGHT_SHARE = 0.8
#: Fewer pads that are not constant do not represent their part, ...
REFERENCES = 4
#: ... of which this share must move by half to twice as much as their median.
ALIKE_SHARE = 0.8
MOST_SHARE = 2.0


class Warming(NamedTuple):
    """What pads have drifted by, in bytes, while they were calibrated.

    Attributes:
        end: float64[m], of their readings at the end, over their means.
        variance: float64[m], of all of them.
    """

    end: Floats
    variance: Floats


def leave_out(
    course: BlockMeans, pads: NDArray[np.intp], passed_s: float, fastest_units_per_s: float
) -> Warming | None:
    """Leave the drift that pads [m] of one part share out of their courses, which are then as at
    the end; None: there is none.

    A press of all pads that grows as slowly reads the same, and is taken for it, as in use.

    Args:
        course: of all taxels; changed in place.
        pads: those that were received all the time.
        passed_s: how long that was.
        fastest_units_per_s: of drift; what is faster is a press.
    """
    number = course.number[pads]
    if int(number.min()) < PIECES:
        return None
    each = np.empty((len(pads), PIECES))
    for length in np.unique(number):
        mine = number == length
        begins = np.arange(PIECES) * length // PIECES
        sums = np.add.reduceat(course.means[pads[mine], :length], begins, axis=1)
        each[mine] = sums / np.diff(begins, append=length)
    each -= each.mean(axis=1, keepdims=True)
    lively = each.any(axis=1)
    if np.count_nonzero(lively) < REFERENCES:
        return None
    shared = np.median(each[lively], axis=0)
    moved = float(np.ptp(shared))
    # Second differences, because a steady rise is no noise.
    error = float(np.median(np.abs(np.diff(shared, 2)))) / (0.6745 * np.sqrt(6.0))
    most, chance = fastest_units_per_s * passed_s, SURE_ERRORS * error * np.sqrt(2.0)
    steps = np.diff(shared)
    if not LEAST_UNITS < moved <= most + chance:
        return None
    if np.abs(steps).max() > most / PIECES + chance:
        return None
    if abs(steps.sum()) < STRAIGHT_SHARE * np.abs(steps).sum():
        return None
    share = np.clip(each @ shared / (shared @ shared), 0.0, MOST_SHARE)
    alike = (share[lively] > 1.0 / MOST_SHARE) & (share[lively] < MOST_SHARE)
    if alike.mean() < ALIKE_SHARE:
        return None
    half = steps[[0, -1]] / 2.0
    at = np.concatenate([[0.0], (np.arange(PIECES) + 0.5) / PIECES, [1.0]])
    shown = np.concatenate([[shared[0] - half[0]], shared, [shared[-1] + half[1]]])
    end, variance = np.empty(len(pads)), np.empty(len(pads))
    for length in np.unique(number):
        mine = number == length
        drift = np.interp((np.arange(length) + 0.5) / length, at, shown)
        course.means[pads[mine], :length] -= share[mine, None] * (drift - shown[-1])
        end[mine] = share[mine] * (shown[-1] - drift.mean())
        variance[mine] = share[mine] ** 2 * drift.var()
    return Warming(end, variance)
