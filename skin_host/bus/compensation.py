"""The temperature compensation of the boards, and how it limits the values of a chip. Pure.

A board of skin type 0 or 8 subtracts a share of its temperature pad's change from every byte
(`computedrift` of embot_app_application_theSkin.cpp):

    drift = ((|dT| >> 2) * gain) >> 5, with the sign of dT
    byte = noLoad - ((dC - drift) >> shift)

The temperature pad has gain 0, so its own byte gives dT except for its rounding.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS

#: Temperature gains x128 per taxel, for skin types 0 and 8; all 0 for palms and fingertips.
GAIN = (70, 96, 83, 38, 38, 70, 0, 45, 77, 164, 0, 77)
GAIN_V2 = (58, 91, 39, 23, 35, 90, 0, 38, 68, 115, 0, 86)
NO_GAIN = (0,) * TAXELS
#: The taxels whose change represents the temperature.
THERMAL_TAXEL = 6
THERMAL_TAXEL_PALM = 11
#: Skin type of an ergoCub hand, which compensates its triangles from this one on.
ERGO_HAND = 3
FIRST_HAND_TRIANGLE = 5


def thermal_gains(skin_type: int, triangle: int) -> tuple[tuple[int, ...], int]:
    """Return the gains x128 of a triangle's taxels, and the taxel that measures the temperature.

    `skin_type` is the one that the board's firmware acts by, `Board.effective_skin_type`.
    """
    if skin_type == 0:
        return GAIN, THERMAL_TAXEL
    if skin_type == 8 or (skin_type == ERGO_HAND and triangle >= FIRST_HAND_TRIANGLE):
        return GAIN_V2, THERMAL_TAXEL
    return NO_GAIN, THERMAL_TAXEL_PALM


def drift_of(
    change: NDArray[np.int32], gain: tuple[int, ...], *, truncates: bool
) -> NDArray[np.int32]:
    """Return what is subtracted from the taxels' words (codes), int32[n, 12].

    Args:
        change: int32[n], of the temperature pad's word since the board was zeroed.
        gain: x128 of the twelve taxels.
        truncates: rounds towards 0 as the MTB3 does; the MTB4 rounds down.
    """
    size = (np.abs(change) >> 2)[:, None] * np.array(gain, np.int32)
    cold = -(size >> 5) if truncates else -size >> 5
    return np.where(change[:, None] > 0, size >> 5, cold).astype(np.int32)
