"""What the best possible estimators would make of a recording whose true pressure they know.

None of them can be built: each is told something that no calibration can know. What error is left
when it is known shows where the rest comes from.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Row = dict[str, Any]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

AS_REPORTED = "nothing: as reported"
ONE_LINE = "gain and offset of the whole skin"
COMMON_ERROR = "the error that all pads have in common, at each moment"
OWN_CURVES = "the best rising curve of each pad"
#: A curve is found over means of this many equal shares of the samples.
SHARES = 400


def errors(kpa: Floats, valid: Mask, true_kpa: Floats) -> list[Row]:
    """Errors of reported pressures, and what is left of them when something of the truth is known.

    Args:
        kpa: float64[t, k], reported pressures.
        valid: bool[t, k]; each moment and each pad have a valid one.
        true_kpa: float64[t].

    Returns:
        One row for each `known`: `median_rmse_kpa` and `p95_rmse_kpa` over the pads, and
        `skin_rms_kpa` of the mean over the pads.
    """
    mean = _mean(kpa, valid)
    gain, offset = np.polyfit(mean, true_kpa, 1)
    curved, mapped = np.zeros_like(kpa), rising(mean, true_kpa)
    for pad, its in enumerate(valid.T):
        curved[its, pad] = rising(kpa[its, pad], true_kpa[its])
    common = (true_kpa - mean)[:, np.newaxis]
    return [
        _row(AS_REPORTED, kpa, mean, valid, true_kpa),
        _row(ONE_LINE, gain * kpa + offset, gain * mean + offset, valid, true_kpa),
        _row(COMMON_ERROR, kpa + common, true_kpa, valid, true_kpa),
        _row(OWN_CURVES, curved, mapped, valid, true_kpa),
    ]


def rising(values: Floats, wanted: Floats) -> Floats:
    """Return the rising function of values [t] that is nearest to what is wanted [t].

    Least squares over means of `SHARES` shares: neighbours that fall are pooled until none does
    (Barlow et al., Statistical Inference under Order Restrictions, 1972, chapter 1).
    """
    order = np.argsort(values, kind="stable")
    shares = [share for share in np.array_split(order, SHARES) if len(share)]
    pools: list[tuple[float, int, int]] = []
    for share in shares:
        level, weight, count = float(wanted[share].mean()), len(share), 1
        while pools and pools[-1][0] >= level:
            lower, other, more = pools.pop()
            level = (level * weight + lower * other) / (weight + other)
            weight, count = weight + other, count + more
        pools.append((level, weight, count))
    found = np.empty_like(wanted)
    levels = np.repeat([level for level, _, _ in pools], [count for _, _, count in pools])
    for share, level in zip(shares, levels, strict=True):
        found[share] = level
    return found


def _mean(kpa: Floats, valid: Mask) -> Floats:
    mean: Floats = np.sum(kpa, axis=1, where=valid) / valid.sum(axis=1)
    return mean


def _row(known: str, kpa: Floats, mean: Floats, valid: Mask, true_kpa: Floats) -> Row:
    squares = (kpa - true_kpa[:, np.newaxis]) ** 2
    each = np.sqrt(np.sum(squares, axis=0, where=valid) / valid.sum(axis=0))
    return {
        "known": known,
        "median_rmse_kpa": float(np.median(each)),
        "p95_rmse_kpa": float(np.percentile(each, 95.0)),
        "skin_rms_kpa": float(np.sqrt(np.mean((mean - true_kpa) ** 2))),
    }
