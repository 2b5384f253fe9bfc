"""Fits parameters to recordings: the foam's relaxation, and the pressure curve of each taxel.

The recording begins with some seconds of untouched skin, which serve as its calibration. Curves and
gains are those of the boards that were pressed in it: limbs are fitted one after the other.
"""

from skin_host.recording.fitting.curves import fit_curves
from skin_host.recording.fitting.fitted import Fitted, finite
from skin_host.recording.fitting.hold import fit_relaxation, hold_record, save_relaxation
from skin_host.recording.fitting.levels import fit_pressures
from skin_host.recording.fitting.samples import Samples, read_samples

__all__ = [
    "Fitted",
    "Samples",
    "finite",
    "fit_curves",
    "fit_pressures",
    "fit_relaxation",
    "hold_record",
    "read_samples",
    "save_relaxation",
]
