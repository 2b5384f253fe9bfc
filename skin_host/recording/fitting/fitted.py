"""What a recording under known pressure has shown, beside what was known before."""

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from skin_host.errors import RequestError
from skin_host.layout import Layout, PadKind
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration import Calibration, with_curves, with_gains
from skin_host.processing.curves import Curves, CurveVerdict
from skin_host.processing.fitting.course import GainFit
from skin_host.recording.fitting.samples import Samples, boards_of
from skin_host.recording.plausibility import describe_ratio

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A board is pressed if at least this share of its usable pads are. Of fewer, as at the edge of a
#: bag of air on its neighbour, the pressure is not known.
PRESSED_SHARE = 0.25
#: Pressures belong to a recording if at least this share of the pads of pressed boards that answer
#: can be fitted.
LEAST_FITTED = 0.5


Found = TypeVar("Found", Curves, GainFit)


@dataclass(frozen=True)
class Fitted(Generic[Found]):
    """A calibration with what a recording under known pressure has shown, and that alone.

    Attributes:
        calibration: that of the recording where boards were pressed; elsewhere the one before.
        found: what was fitted, only to the pads of boards that were pressed.
        pressed: bool[n], the pads that were received of these boards.
        ratio: known pressures over those of the common curve, of the median pad.
        unshown: bool[n], those of them of which the recording does not show a curve.
        unloads: whether the foam's hysteresis is known, by this recording or before it.
        memory_kept: whether it is the one before, because pads keep their curves.
    """

    calibration: Calibration
    found: Found
    pressed: Mask
    ratio: float
    unshown: Mask
    unloads: bool = True
    memory_kept: bool = False


def pressed_boards(pressed: Mask, samples: Samples, layout: Layout) -> Mask:
    """Return the taxels [n] of each board of each part of which enough pads are pressed, bool[n].

    Raises:
        RequestError: there is none.
    """
    pads = samples.usable & (layout.pad_kind == PadKind.PRESSURE)
    found: Mask = np.zeros_like(pads)
    most = 0.0
    for part in layout.parts:
        for _, mine in boards_of(layout, part):
            share = float(pressed[mine & pads].mean()) if np.any(mine & pads) else 0.0
            most = max(most, share)
            if share >= PRESSED_SHARE:
                found |= mine
    if not found.any():
        raise RequestError(
            f"no board is pressed: at most {most:.0%} of a board's pads follow the pressure; "
            "wanted all pads of a board under the same pressure"
        )
    return found


def check_share(fitted: Mask, pads: Mask, ratio: float) -> None:
    """Check that enough of the pads [n] that answer are fitted [n].

    Raises:
        RequestError: the pressures are hardly those of this recording, or show little of it.
    """
    if np.count_nonzero(fitted & pads) < LEAST_FITTED * np.count_nonzero(pads):
        raise RequestError(
            f"{np.count_nonzero(fitted & pads)} of {np.count_nonzero(pads)} pads of the pressed "
            f"boards can be fitted, wanted at least {LEAST_FITTED:.0%}; {describe_ratio(ratio)}"
        )


def renewed_calibration(
    samples: Samples,
    before: Calibration | None,
    pressed: Mask,
    gain: Floats,
    bend: Floats,
    curves: Curves | None,
) -> Calibration:
    """Return the calibration of a recording where pads were pressed, elsewhere the one before."""
    base = samples.calibration
    if before is not None:
        # Its curves would judge the new zeros, and are replaced.
        base = calibrations.merge(replace(before, curves=None), base, pressed)
    gained = with_gains(
        base, np.where(pressed, gain, base.gain), np.where(pressed, bend, base.bend)
    )
    return with_curves(gained, curves)


def without(curves: Curves | None, taxels: Mask) -> Curves | None:
    """Return curves with nothing known of some taxels; None if nothing is known of others."""
    if curves is None:
        return None
    left = replace(
        curves,
        beyond_units=np.where(taxels, np.inf, curves.beyond_units),
        error_kpa=np.where(taxels, np.nan, curves.error_kpa),
        verdict=np.where(taxels, CurveVerdict.UNKNOWN, curves.verdict).astype(np.uint8),
    )
    return left if np.any(left.verdict != CurveVerdict.UNKNOWN) else None


def finite(value: float) -> float | None:
    """A number for JSON, which has none that are not finite."""
    return value if np.isfinite(value) else None
