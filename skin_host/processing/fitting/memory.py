"""Fits the foam's memory, plays that all pads share, to a course of known pressure.

While the pressure only rises, a play moves with it, and any play fits as well as none: what noise
or creep is there would be taken for it. So a play is tried only where the course turns back far
enough for long enough, and kept only if it does more than the pressure itself is uncertain by.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.curves import Memory

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Uncertainty of the known pressure itself.
UNCERTAINTY_KPA = 2.0
#: Radii of plays to try, as shares of the highest pressure, and how many at most. One more is used
#: if it lowers the square error on data that was not fitted by this share; of those that do so but
#: for as little, the widest, because creep looks like a narrow one. Each has at least the least
#: weight, together they stay below the most.
RADII = (0.015, 0.03, 0.06, 0.12, 0.24)
MOST_PLAYS = 3
WORTH_SHARE = 0.1
LEAST_WEIGHT = 0.01
MOST_WEIGHT = 0.5
#: A play shows in a course if it lags by more than so many of its radii, of two at most, for this
#: share of the time.
TURNED_RADII = 1.5
TURNED_SHARE = 0.1
#: The recording is cut into this many pieces; each fit leaves one of them out.
FOLDS = 8


def unloads(pressure_kpa: Floats) -> bool:
    """Return whether a course [t] turns back far enough to show hysteresis of any width."""
    wanted = np.maximum(pressure_kpa, 0.0)
    return _shows(wanted, RADII[-1] * float(np.max(wanted)))


def fit_memory(units: Floats, pressure_kpa: Floats, weight: Floats) -> Memory:
    """Return as many plays as lower the error on data that was not fitted.

    As plays of the pressure they enter the reading linearly: f(x) = P + sum v (p - max(P - rho,
    0)).
    The compensator's plays, of the reading, are those of the inverse operator.

    Args:
        units: activation [t] of the median pad.
        pressure_kpa: the known pressure [t].
        weight: of each sample [t].

    Returns:
        No plays where the course does not show them.
    """
    wanted = np.maximum(pressure_kpa, 0.0)
    highest_kpa = float(np.max(wanted))
    radii = [
        radius for radius in (highest_kpa * np.array(RADII)).tolist() if _shows(wanted, radius)
    ]
    lags = {radius: _play_lag(wanted, radius) for radius in radii}
    bases = hinges(units)
    root = np.sqrt(weight)[:, np.newaxis]
    piece = np.arange(len(units)) * 4 * FOLDS // len(units) % FOLDS

    def basis_of(tried: list[float]) -> Floats:
        return np.hstack([bases, *(-lags[radius][:, np.newaxis] for radius in tried)])

    def fitted(tried: list[float], kept: Mask) -> Floats | None:
        """Return coefficients of hinges and plays; None if no foam has such plays."""
        weighted, known = root * basis_of(tried), root[:, 0] * wanted
        found = np.linalg.lstsq(weighted[kept], known[kept], rcond=None)[0]
        plays = found[bases.shape[1] :]
        return None if np.any(plays < LEAST_WEIGHT) or np.sum(plays) >= MOST_WEIGHT else found

    def held_out(tried: list[float]) -> float:
        basis = basis_of(tried)
        total = 0.0
        for fold in range(FOLDS):
            found = fitted(tried, piece != fold)
            if found is None:
                return np.inf
            error = (basis @ found - wanted)[piece == fold]
            total += float(np.sum(weight[piece == fold] * error**2))
        return total

    chosen: list[float] = []
    best = held_out(chosen)
    while len(chosen) < min(MOST_PLAYS, len(radii)):
        tried = [sorted([*chosen, radius]) for radius in radii if radius not in chosen]
        scores = np.array([held_out(some) for some in tried])
        index = int(np.flatnonzero((1.0 - WORTH_SHARE) * scores <= scores.min())[-1])
        if not scores[index] <= (1.0 - WORTH_SHARE) * best:
            break
        best, chosen = float(scores[index]), tried[index]
    found = fitted(chosen, np.ones(len(units), np.bool_))
    if found is None or not chosen:
        return Memory()
    shares = found[bases.shape[1] :].tolist()
    half_width_kpa = sum(radius * share for radius, share in zip(chosen, shares, strict=True))
    return _inverse(chosen, shares) if half_width_kpa > UNCERTAINTY_KPA else Memory()


def loading_kpa(pressure: Floats, memory: Memory) -> Floats:
    """Return what a pad of the foam reads [t] under pressures [t]: the inverse of C -
    relaxation(C).

    The solution is unique, because C - relaxation rises with C. For each sample the step of C is
    found by trying each possible state of the plays.
    """
    if not memory.radius_kpa:
        return pressure
    radius, weight = np.array(memory.radius_kpa), np.array(memory.weight)
    plays = np.zeros(len(radius))
    result = np.empty_like(pressure)
    reading = 0.0
    for row, wanted in enumerate(np.maximum(pressure, 0.0)):
        # Newton's method on a piecewise linear function ends after at most as many steps as it has
        # pieces.
        for _ in range(4 * len(radius) + 2):
            moved = np.minimum(np.maximum(plays, reading - radius), reading + radius)
            over = reading - radius
            value = reading - float(weight @ (moved - np.maximum(over, 0.0)))
            slope = 1.0 - float(weight @ ((moved != plays) * 1.0 - (over > 0.0)))
            step = (wanted - value) / slope
            reading = max(reading + step, 0.0)
            if abs(step) < 1e-6:
                break
        plays = np.minimum(np.maximum(plays, reading - radius), reading + radius)
        result[row] = reading
    return result


def hinges(units: Floats) -> Floats:
    """A piecewise linear basis [t, k] over an activation [t]."""
    top = float(np.max(units))
    knots = np.linspace(0.0, max(top, 1.0), 9)[:-1]
    columns = [np.ones_like(units), units, *(np.maximum(units - knot, 0.0) for knot in knots[1:])]
    return np.stack(columns, axis=1)


def _shows(pressure: Floats, radius_kpa: float) -> bool:
    """Return whether a course [t] turns back far enough, for long enough, to show such a play.

    The pressure's own noise turns a narrow one all the time, and a single sample may be a spike.
    """
    if radius_kpa <= UNCERTAINTY_KPA:
        return False
    around = np.lib.stride_tricks.sliding_window_view(np.pad(pressure, 1, mode="edge"), 3)
    lag = _play_lag(np.median(around, axis=1), radius_kpa)
    return float(np.mean(lag > TURNED_RADII * radius_kpa)) >= TURNED_SHARE


def _play_lag(pressure: Floats, radius_kpa: float) -> Floats:
    """Return how far a play of the pressure [t] lags behind its value while loading."""
    play, result = 0.0, np.empty_like(pressure)
    for row, kpa in enumerate(pressure.tolist()):
        play = min(max(play, kpa - radius_kpa), kpa + radius_kpa)
        result[row] = play - max(kpa - radius_kpa, 0.0)
    return result


def _inverse(radius_kpa: list[float], weight: list[float]) -> Memory:
    """Plays of the reading that undo plays of the pressure.

    After a turn the reading follows with the slope 1 - sum of the weights of the plays that
    have not yet turned, until twice their radius; the inverse has the inverse slopes.
    """
    slope, rho, r = 1.0 - sum(weight), 0.0, 0.0
    slopes, radii = [1.0 / slope], []
    for next_rho, share in zip(radius_kpa, weight, strict=True):
        r += slope * (next_rho - rho)
        rho, slope = next_rho, slope + share
        radii.append(r)
        slopes.append(1.0 / slope)
    weights = [before - after for before, after in pairwise(slopes)]
    return Memory(tuple(round(r, 3) for r in radii), tuple(round(w, 4) for w in weights))
