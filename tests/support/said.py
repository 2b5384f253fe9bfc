"""A frame and a touch to say, of which a test changes what it is about."""

from typing import Any

import numpy as np

from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame

#: In this order a test may give what it is about.
_KEYS = (
    *("event", "id", "seq", "t_ns", "part", "taxels", "centroid_m", "normal"),
    *("area_mm2", "peak_kpa", "mean_kpa", "force_n", "sigma_m", "load"),
)


def touch_event(*values: Any) -> Touch:
    """A touch from values in the order of `_KEYS`."""
    return Touch(**dict(zip(_KEYS, values, strict=False)))


def make_frame(pressure_kpa: list[float], **changes: object) -> PressureFrame:
    m = len(pressure_kpa)
    keys: dict[str, object] = {
        "part": "palm",
        "seq": 7,
        "t_ns": 1_763_700_000_123_456_789,
        "raw": np.arange(m, dtype=np.uint8),
        "pressure_kpa": np.array(pressure_kpa, np.float32),
        "touched": np.zeros(m, np.bool_),
        "valid": np.ones(m, np.bool_),
        "beyond_range": np.zeros(m, np.bool_),
    }
    return PressureFrame(**(keys | changes))  # type: ignore[arg-type]


def make_event(**changes: object) -> Touch:
    keys: dict[str, object] = {
        "event": "begin",
        "id": 3,
        "seq": 8,
        "t_ns": 1000,
        "part": "palm",
        "taxels": [4, 5],
        "centroid_m": [0.01234567, -0.0000001, 0.0],
        "normal": [0.0, 0.0, 1.0],
        "area_mm2": 25.128,
        "peak_kpa": 12.34567,
        "mean_kpa": 8.0,
        "force_n": 0.123456,
        "sigma_m": 0.00123456,
    }
    return Touch(**(keys | changes))  # type: ignore[arg-type]
