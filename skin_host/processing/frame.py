"""What the daemon knows of a part at one instant: it is published, recorded and judged."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.processing.masks import Mask


@dataclass(slots=True)
class PressureFrame:
    """One part at one instant. Arrays have one entry per taxel [m], in the layout's order.

    Attributes:
        part: its name.
        seq: counts the part's frames from 0.
        t_ns: time of the sweep's last CAN frame.
        raw: uint8, bytes as received.
        pressure_kpa: float32, 0 where not valid.
        touched: whether something touches the taxel.
        valid: received now, and reliable.
        beyond_range: the pressure is above the calibrated range, or the byte at an end of its
            scale (0 or 255): its order is right, its value an estimate.
        computed: False if pressures were not requested and nothing touches: they are 0.
        elapsed_ns: time that passed for the part since its first sweep. What waits or times out
            counts by this: `t_ns` can be set, forward or back.
        felt: bool, taxels that something presses, though it may be too little to be called a touch;
            None: those that are touched.
    """

    part: str
    seq: int
    t_ns: int
    raw: NDArray[np.uint8]
    pressure_kpa: NDArray[np.float32]
    touched: Mask
    valid: Mask
    beyond_range: Mask
    computed: bool = True
    elapsed_ns: int = 0
    felt: Mask | None = None
