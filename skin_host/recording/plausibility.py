"""Whether known pressures may be those of a skin: a mistaken unit is a factor of 7 or more.

They are compared with the common curve of the configuration. The paper's own pads differ from it by
a few ten percent, other foam by a factor of two; the stiffest that was measured, an insole of
Infinergy, takes 5 to 6 times as much pressure (`skin_host.evaluation.insole`).
"""

import math
import sys

from skin_host.errors import RequestError

#: Pressures below this ratio to the common curve are in another unit, and those above the other
#: one: between the stiffest foam and the smallest mistake upwards. From the middle one on it may be
#: either.
LEAST_RATIO = 0.25
DOUBTFUL_RATIO = 4.0
MOST_RATIO = 7.0
#: Units that pressure sensors and their tables have, and how many kPa each is.
_UNITS_KPA = {
    "MPa (1 MPa = 1000 kPa)": 1000.0,
    "bar (1 bar = 100 kPa)": 100.0,
    "N/cm2 or psi (1 N/cm2 = 10 kPa, 1 psi = 6.9 kPa)": 8.3,
    "mbar or mmHg (10 mbar or 7.5 mmHg = 1 kPa)": 0.115,
    "Pa (1000 Pa = 1 kPa)": 0.001,
}


def describe_ratio(ratio: float) -> str:
    """Return how pressures compare with the common curve, and in which unit they may be.

    Args:
        ratio: the pressures given over those of the common curve at the same readings.
    """
    positive = max(ratio, sys.float_info.min)
    unit = min(_UNITS_KPA, key=lambda name: abs(math.log(positive * _UNITS_KPA[name])))
    return (
        f"the pressures are {ratio:.2g} times those of the configured curve "
        f"(processing.pressure); are they in {unit}? wanted kPa"
    )


def check_ratio(ratio: float) -> None:
    """Check that pressures may be those of a skin.

    Args:
        ratio: see `describe_ratio`.

    Raises:
        RequestError: no known foam is so soft or so stiff.
    """
    if not LEAST_RATIO <= ratio <= MOST_RATIO:
        raise RequestError(describe_ratio(ratio))
