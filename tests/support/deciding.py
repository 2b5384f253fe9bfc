"""The touch decision of a few taxels, fed with units above a rest."""

import numpy as np

from skin_host.processing.touch import Levels, TouchDetector

REST = 200


def levels_of(enter, leave, span, hold):
    """Levels of taxels without noise."""
    enter, leave, span, hold = (np.atleast_1d(value) for value in (enter, leave, span, hold))
    nothing = np.zeros(len(enter))
    votes = nothing.astype(np.int64) + 2
    return Levels(enter, leave, enter, span, hold, nothing, votes, nothing)


#: Two measurements of 2 units begin a touch, two of 1.5 end it.
BAND = levels_of(1.75, 1.75, 0.5, 0.5)
#: Slower than a conversion: each sweep is a new measurement.
SWEEP_S = 0.04


def detector_of(found=BAND, votes=2):
    detector = TouchDetector(found, votes)
    detector.renew(np.full(len(found.enter), float(REST)))
    return detector


def pressed(detector, units, dt_s=SWEEP_S):
    raw = np.full(len(detector.touched), REST, np.uint8) - np.asarray(units, np.uint8)
    return detector.step(raw, dt_s)


def flags(*numbers):
    return [bool(number) for number in numbers]
