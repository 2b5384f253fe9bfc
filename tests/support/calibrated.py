"""Sweeps of one patch of skin, and the calibration that they make."""

import numpy as np

from skin_host.evaluation.rig import flat_skin
from skin_host.processing.calibration.calibrator import Calibrator

_, LAYOUT = flat_skin(1)
N = LAYOUT.n_taxels
PRESENT = np.ones(N, bool)
TIME = "2026-01-02T03:04:05+00:00"


def calibrated(sweeps, present=None, percentile=0.95):
    calibrator = Calibrator(LAYOUT, percentile)
    for number, raw in enumerate(sweeps):
        here = PRESENT if present is None else present[number]
        calibrator.add(0, np.asarray(raw, np.uint8), here)
    return calibrator.finish("abc", TIME)


def noisy(rng, sweeps=125, sd=0.4, level=240.3):
    return np.rint(level + rng.normal(0.0, sd, (sweeps, N)))
