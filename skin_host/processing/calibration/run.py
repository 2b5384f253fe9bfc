"""A calibration while it is being taken: how long, of which samples, and of which zeros."""

from collections.abc import Callable

import numpy as np

from skin_host.layout import Layout
from skin_host.processing.calibration import Calibration
from skin_host.processing.calibration.calibrator import (
    KNOWN_SAMPLES,
    LONGEST_INTERVAL_NS,
    Calibrator,
    Known,
)
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.intake import PartSample
from skin_host.processing.masks import Mask, any_of

#: A calibration takes at least `KNOWN_SAMPLES` of each board, even if that is slow, and the time of
#: so many conversions, even if less is asked for.
SHORTEST_S = KNOWN_SAMPLES * CONVERSION_S


class CalibrationRun:
    """Collects samples until they are enough, then knows which boards were zeroed since.

    Args:
        layout: the skin.
        calibrator: takes the samples.
        seconds: how long to collect, at least.
        fewest: samples of each board, and conversions, that are taken in any case.

    Attributes:
        is_over: the samples have been collected.
        zeroed: the boards that were zeroed since then, and whether touches just before were real.
        begun_again: by board, how often it was zeroed before, after it had sent samples.
    """

    def __init__(self, layout: Layout, calibrator: Calibrator, seconds: float, fewest: int) -> None:
        self._layout = layout
        self._calibrator = calibrator
        self._duration_ns = int(max(seconds, fewest * CONVERSION_S) * 1e9)
        self._fewest = fewest
        #: Time of the newest sample; None before the first.
        self._last_ns: int | None = None
        #: The sum of the intervals between samples: a clock that is set adds nothing.
        self._passed_ns = 0
        #: By board and part, for those that have sent any.
        self._samples: dict[tuple[int, int], int] = {}
        self.is_over = False
        self.zeroed: dict[int, bool] = {}
        self.begun_again: dict[int, int] = {}

    @property
    def progress(self) -> float:
        """Share of the wanted time, and of the fewest samples, that has been collected, 0 to 1."""
        if not self._samples:
            return 0.0
        time_share = self._passed_ns / self._duration_ns
        return min(1.0, time_share, min(self._samples.values()) / self._fewest)

    def add(self, sample: PartSample) -> None:
        """Take in a sample of a part."""
        if self.is_over or not any_of(sample.received):
            return
        interval_ns = 0 if self._last_ns is None else sample.t_ns - self._last_ns
        if 0 < interval_ns <= LONGEST_INTERVAL_NS:
            self._passed_ns += interval_ns
        # Samples of several parts come in any order, by much less.
        if self._last_ns is None or interval_ns > 0 or interval_ns < -LONGEST_INTERVAL_NS:
            self._last_ns = sample.t_ns
        senders = [(board, sample.part) for board in self._sent(sample)]
        samples = [self._samples.setdefault(sender, 0) for sender in senders]
        if self._passed_ns <= self._duration_ns or min(samples) < self._fewest:
            self._calibrator.add(sample.part, sample.raw, sample.received, sample.t_ns)
            for sender in senders:
                self._samples[sender] += 1

    def note_zeroed(self, board: int, believed: bool) -> None:
        """A board has another zero than its samples so far.

        A calibration of two zeros would be that of none, and the rest of its time too short for
        noisy pads. A board that has sent nothing so far takes nothing back: one that is away is set
        up again and again.
        """
        if self.is_over:
            self.zeroed[board] = believed
            return
        mine = [sender for sender in self._samples if sender[0] == board]
        if not any(self._samples[sender] for sender in mine):
            return
        self.begun_again[board] = self.begun_again.get(board, 0) + 1
        self.forget(self._layout.taxels_of([board]))
        self._passed_ns = 0
        self._samples.update(dict.fromkeys(mine, 0))

    def forget(self, taxels: Mask) -> None:
        """Leave out the samples of taxels, bool[n], so far."""
        if not self.is_over:
            self._calibrator.forget(np.flatnonzero(taxels))

    def end(
        self, configuration: str, time: str, known: Known | None, pressed: Mask | None = None
    ) -> Callable[[], Calibration]:
        """Stop collecting; return what computes the calibration, see `Calibrator.finish`."""
        self.is_over = True
        calibrator = self._calibrator
        return lambda: calibrator.finish(configuration, time, known, pressed)

    def _sent(self, sample: PartSample) -> list[int]:
        """Return the boards of which a sample has any value."""
        part = self._layout.parts[sample.part]
        if len(part.boards) == 1:
            return list(part.boards)
        triangles = np.unique(self._layout.triangle_of[part.start : part.stop][sample.received])
        return sorted({self._layout.triangles[triangle].board for triangle in triangles.tolist()})
