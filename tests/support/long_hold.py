"""A long press of some or all pads of a board, through the whole pipeline."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from emulator.probes.viscoelastic import TruthKind
from skin_host.evaluation.histories import PlayedHistory, record
from skin_host.evaluation.rig import Rig
from skin_host.processing.pressure import PressureCurve

CURVE = PressureCurve(2.88)
HOLD_KPA = 65.0
BEFORE_S, AFTER_S = 20.0, 120.0
FEW, ALL = 6, 192


@dataclass(frozen=True)
class LongHold:
    """What became of a long hold.

    Attributes:
        before, during, after: shares [t] of the pressed taxels that were touched.
    """

    before: NDArray[np.float64]
    during: NDArray[np.float64]
    after: NDArray[np.float64]


@cache
def history(truth: TruthKind, seconds: float, hz: float, kpa: float) -> PlayedHistory:
    return record(truth, [(0.0, BEFORE_S), (kpa, seconds), (0.0, AFTER_S)], hz)


def hold(
    truth: TruthKind,
    seconds: float,
    *,
    hz: float,
    pressed: int,
    drift: float = 0.0,
    kpa: float = HOLD_KPA,
) -> LongHold:
    """Press so many pads for so long, while everything drifts by so many units a second.

    Nothing else may be touched.
    """
    played = history(truth, seconds, hz, kpa)
    rig = Rig(1, 0.3, seed=21, hz=hz)
    here = np.arange(rig.n) < pressed
    start, end = round(BEFORE_S * hz), round((BEFORE_S + seconds) * hz)
    shares = []
    for sweep, units in enumerate(CURVE.units(played.momentary_kpa)):
        frame = rig.step(np.where(here, units, 0.0) + drift * sweep / hz)
        shares.append(np.mean(frame.touched[here]))
        assert not frame.touched[~here].any()
    touched = np.array(shares)
    return LongHold(touched[:start], touched[start + 3 : end - 1], touched[end + 3 :])
