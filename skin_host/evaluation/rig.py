"""A skin reduced to its numbers: activations in, bytes through the pipeline, frames out.

For questions of touch and drift, where the contact's mechanics does not matter: a taxel is
a resting level between two codes, noise, an activation in units, and a byte.
"""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.chips.noise import SampledNoise
from skin_host.bus.wire import TRIANGLES
from skin_host.config.settings import Settings
from skin_host.layout import Layout, build_layout, builtin_kinds
from skin_host.layout.geometry import tile
from skin_host.processing.calibration.calibrator import KNOWN_SAMPLES, Calibrator
from skin_host.processing.frame import PressureFrame
from skin_host.processing.pipeline import Pipeline

BOARDS_PER_BUS = 14
#: So many boards lie above each other, in columns this far apart: no part may be wider than 10 m.
BOARDS_PER_COLUMN, COLUMN_MM = 128, 300.0


def wired(boards: int) -> dict[str, dict[str, Any]]:
    """Tables of so many boards, on as many buses as they need."""
    places = [divmod(number, BOARDS_PER_BUS) for number in range(boards)]
    return {
        "buses": {f"can{bus}": {} for bus, _ in places},
        "boards": {
            f"b{number}": {"bus": f"can{bus}", "address": place + 1}
            for number, (bus, place) in enumerate(places)
        },
    }


def _places(kind: str, boards: int) -> list[list[dict[str, float]]]:
    """Where the triangles of each board lie."""
    places, height_mm = tile(builtin_kinds()[kind], TRIANGLES, 0.0)
    return [
        [
            {
                "x_mm": float(place.x_mm + column * COLUMN_MM),
                "y_mm": float(place.y_mm + row * height_mm),
                "turn_deg": place.turn_deg,
            }
            for place in places
        ]
        for column, row in (divmod(number, BOARDS_PER_COLUMN) for number in range(boards))
    ]


def flat_skin(
    boards: int, kind: str = "triangle", processing: dict[str, Any] | None = None
) -> tuple[Settings, Layout]:
    """Settings and layout of one part of `boards` full boards, 192 pads each."""
    wiring = wired(boards)
    document = {
        "robot": "rig",
        **wiring,
        "parts": {
            "skin": {
                "foam_mm": 2.0,
                "patches": [
                    {
                        "board": name,
                        "triangles": "0-15",
                        "kind": kind,
                        "shift": 3,
                        "places": places,
                    }
                    for name, places in zip(wiring["boards"], _places(kind, boards), strict=True)
                ],
            }
        },
        "processing": processing or {},
    }
    settings = msgspec.convert(document, Settings)
    return settings, build_layout(settings, Path())


class Rig:
    """One part of skin, calibrated untouched, at a steady rate.

    Args:
        boards: of 192 pads.
        noise_units: standard deviation of a reading before it is rounded; None for noise as
            it was measured on real skin, conversions that are sent again included.
        seed: of everything random.
        hz: sweeps a second.
        kind: of the triangles.
        processing: table of the configuration, as in TOML.
        calibrate_s: length of the calibration, which takes enough samples in any case.
    """

    def __init__(
        self,
        boards: int,
        noise_units: float | None,
        *,
        seed: int = 0,
        hz: float = 25.0,
        kind: str = "triangle",
        processing: dict[str, Any] | None = None,
        calibrate_s: float = 5.0,
    ) -> None:
        self.settings, self.layout = flat_skin(boards, kind, processing)
        self.n = self.layout.n_taxels
        self.dt_s = 1.0 / hz
        self._dt_ns = round(1e9 / hz)
        self._noise = np.float32(noise_units or 0.0)
        self._measured = SampledNoise(16 * boards, seed) if noise_units is None else None
        self._rng = np.random.default_rng(seed)
        self._present = np.ones(self.n, dtype=np.bool_)
        self._resting = self._rng.uniform(200.0, 240.0, self.n).astype(np.float32)
        self.t_ns = 0
        calibrator = Calibrator(self.layout)
        for _ in range(max(round(calibrate_s * hz), KNOWN_SAMPLES)):
            self.t_ns += self._dt_ns
            calibrator.add(0, self.read(0.0), self._present)
        self.calibration = calibrator.finish("rig", "1970-01-01T00:00:00Z")
        self.pipeline = Pipeline(self.layout, self.settings.processing, self.calibration)

    def read(self, activation_units: ArrayLike) -> NDArray[np.uint8]:
        """The bytes [n] that activations (a number or [n]) give now."""
        level = self._resting - np.asarray(activation_units, dtype=np.float32)
        if self._noise > 0.0:
            level = level + self._noise * self._rng.standard_normal(self.n, dtype=np.float32)
        if self._measured is not None:
            level = level + self._measured.at(self.t_ns).astype(np.float32)
        return np.asarray(np.clip(np.rint(level), 0.0, 255.0), dtype=np.uint8)

    def step(self, activation_units: ArrayLike) -> PressureFrame:
        """Let one period pass with these activations."""
        self.t_ns += self._dt_ns
        return self.pipeline.step(0, self.read(activation_units), self._present, self.t_ns)

    @property
    def true_baseline(self) -> NDArray[np.float64]:
        """Baseline [n] of a reading without activation, in the pipeline's terms."""
        return self.layout.no_load.astype(np.float64) - self._resting
