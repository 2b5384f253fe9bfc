"""Recordings as candump writes them, of one board with sixteen triangles at 20 Hz."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from skin_host.bus.wire import TAXELS, TRIANGLES, encode_sweep

PERIOD_US = 50_000
PRESSED_UNITS = 60
CONFIG = """
robot = "fleet"
[buses.can0]
channel = "can0"
[boards.b]
bus = "can0"
address = 1
[[parts.arm.patches]]
board = "b"
triangles = "0-15"
"""


def write_config(path: Path) -> Path:
    """Write the configuration of the board: part `arm` has all its triangles."""
    path.write_text(CONFIG)
    return path


def write_log(
    path: Path, periods: int, pressed: Callable[[int], Sequence[int]], seed: int = 0
) -> Path:
    """Write a recording of so many sweeps; `pressed` gives the pressed taxels of each."""
    rng = np.random.default_rng(seed)
    lines = []
    for period in range(periods):
        raw = rng.integers(239, 242, TRIANGLES * TAXELS)
        raw[list(pressed(period))] -= PRESSED_UNITS
        ids, data = encode_sweep(
            1,
            np.arange(TRIANGLES),
            raw.astype(np.uint8).reshape(TRIANGLES, TAXELS),
            np.zeros(TRIANGLES, np.uint16),
        )
        for row, (identifier, payload) in enumerate(zip(ids.tolist(), data, strict=True)):
            t_us = 1_700_000_000_000_000 + period * PERIOD_US + row * 125
            stamp = f"{t_us // 1_000_000}.{t_us % 1_000_000:06d}"
            lines.append(f"({stamp}) can0 {identifier:X}#{payload.tobytes().hex()}\n")
    path.write_text("".join(lines))
    return path
