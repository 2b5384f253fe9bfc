"""Environmental compensation of the AD7147: ambient values, thresholds, proximity, status.

Nothing here changes a conversion result. The chip follows slow changes of each stage with an
ambient value, puts a high and a low threshold around it, and freezes while something is near.
The rules are [M] except where the register map names a source; a stage is followed through
its noise-free code, since the chip averages many samples and thresholds are hundreds of codes
away. Only the last state of an interval with unchanged inputs is worked out, in closed form,
so an hour costs as much as a sequence.
"""

import numpy as np
from numpy.typing import NDArray

from emulator import ad7147_map as reg

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Words in the chip's slow filter.
SLOW_FILTER_WORDS = 8
#: A peak of a press enters the offset with this weight: four peaks are kept.
PEAK_WEIGHT = 0.25


class AmbientTracking:
    """Ambient, thresholds and threshold status of the twelve stages of one chip."""

    def __init__(self, registers: reg.Registers) -> None:
        self._bank_2 = registers[reg.BANK_2 : reg.BANK_3].reshape(reg.N_STAGES, reg.STAGE_WORDS)
        bank_3 = registers[reg.BANK_3 :].reshape(reg.N_STAGES, reg.RESULT_WORDS)
        self._ambient_word = bank_3[:, reg.SF_AMBIENT]
        self._fast_word = bank_3[:, reg.FF_AVG]
        self._high_word = bank_3[:, reg.HIGH_THRESHOLD]
        self._low_word = bank_3[:, reg.LOW_THRESHOLD]
        self._registers = registers
        self.high = np.zeros(reg.N_STAGES, bool)
        self.low = np.zeros(reg.N_STAGES, bool)
        self.proximity = np.zeros(reg.N_STAGES, bool)
        self._level = np.zeros(reg.N_STAGES)
        self._started = np.zeros(reg.N_STAGES, bool)
        self._near_for = np.zeros(reg.N_STAGES, np.int64)
        self._frozen_for = np.zeros(reg.N_STAGES, np.int64)
        self.configure()

    def configure(self) -> None:
        """Read the set-up registers again. Call after any write to them."""
        cal_en, ctrl_0, ctrl_1, ctrl_2 = (int(word) for word in self._registers[1:5])
        enabled = (cal_en >> np.arange(reg.N_STAGES) & 1).astype(bool)
        self._started &= enabled
        self._enabled = enabled
        # Full power first, low power second.
        skip = (4 << (cal_en >> 12 & 3), 1 + (cal_en >> 14 & 3))
        self._follow = tuple(1 / (SLOW_FILTER_WORDS * samples) for samples in skip)
        self._freeze = (16 * (ctrl_0 >> 4 & 0xF), 4 * (ctrl_0 >> 8 & 0xF))
        self._near_codes = 16.0 * (ctrl_1 & 0xFF)
        # A time of 0 is taken as "never" [D].
        self._recalibrate = (ctrl_2 & 0x3FF, ctrl_2 >> 10)
        interrupts = self._registers[reg.STAGE_LOW_INT_ENABLE : reg.STAGE_COMPLETE_INT_ENABLE]
        self._is_pinned = not (ctrl_1 & 0xFF or any(self._recalibrate) or interrupts.any())
        sensitivity = self._bank_2[:, 3].astype(np.int64)
        self._low_share = 0.25 + 0.75 / 16 * (sensitivity & 0xF)
        self._high_share = 0.25 + 0.75 / 16 * (sensitivity >> 8 & 0xF)
        self._low_peak = 0.4 + 0.1 * np.minimum(sensitivity >> 4 & 7, 5)
        self._high_peak = 0.4 + 0.1 * np.minimum(sensitivity >> 12 & 7, 5)
        offsets = self._bank_2[:, 4:8].astype(np.float64)
        self._offset_low, self._offset_high, self._clamp_high, self._clamp_low = offsets.T.copy()

    @property
    def memoryless(self) -> bool:
        """Whether only the last conversion counts, so that `update` may be put off.

        With a proximity level of zero, as all iCub boards have it, any change freezes the
        ambient values. Peaks that come and go between two looks are then missed [D].
        """
        return self._is_pinned and bool((self._started | ~self._enabled).all())

    def recalibrate(self) -> None:
        """Forget all ambient values: each starts again at its stage's next conversion."""
        self._started[:] = False

    def update(self, counts: Ints, codes: Floats, *, low_power: bool) -> Mask:
        """Account for conversions with unchanged inputs.

        Args:
            counts: int64[12], conversions of each stage that ended since the last call.
            codes: float64[12], the noise-free code that all of them had.
            low_power: which set of times rules.

        Returns:
            bool[12], the enabled or disabled stages whose threshold condition changed.
        """
        done = counts > 0
        self._track(counts, codes, done, int(low_power))
        high = np.where(done, codes > self._high_word, self.high)
        low = np.where(done, codes < self._low_word, self.low)
        changed: Mask = (high != self.high) | (low != self.low)
        self.high, self.low = high, low
        return changed

    def _track(self, counts: Ints, codes: Floats, done: Mask, power: int) -> None:
        active = done & self._enabled
        np.copyto(self._fast_word, codes, where=done, casting="unsafe")
        if not active.any():
            return
        np.copyto(self._level, codes, where=active & ~self._started)
        self._started |= active
        deviation = codes - self._level
        near = active & (np.abs(deviation) > self._near_codes)
        self.proximity = np.where(done, near, self.proximity)
        thawed = np.maximum(counts - self._frozen_for, 0)
        if near.any():
            self._frozen_for = np.where(near, self._freeze[power], self._frozen_for - counts)
            self._near_for = np.where(near, self._near_for + counts, 0)
            if self._recalibrate[power]:
                late = self._near_for > self._recalibrate[power]
                np.copyto(self._level, codes, where=late)
                self._near_for[late] = 0
                self._frozen_for[late] = 0
            self._follow_peaks(active, deviation, counts)
        else:
            self._near_for[:] = 0
            self._frozen_for = np.maximum(self._frozen_for - counts, 0)
        share = 1 - (1 - self._follow[power]) ** thawed
        self._level += np.where(active & ~near, deviation * share, 0.0)

        def store(word: reg.Registers, values: Floats) -> None:
            clipped = np.clip(np.rint(values), 0, reg.FULL_SCALE)
            np.copyto(word, clipped, where=active, casting="unsafe")

        store(self._ambient_word, self._level)
        store(self._high_word, self._level + self._high_share * self._offset_high)
        store(self._low_word, self._level - self._low_share * self._offset_low)

    def _follow_peaks(self, active: Mask, deviation: Floats, counts: Ints) -> None:
        """Adaptive thresholds: strong presses pull the offsets, up to their clamps."""
        share = 1 - (1 - PEAK_WEIGHT) ** counts
        up = active & (deviation > self._high_peak * self._offset_high)
        target = np.minimum(deviation, self._clamp_high)
        self._offset_high += np.where(up, (target - self._offset_high) * share, 0.0)
        down = active & (-deviation > self._low_peak * self._offset_low)
        target = np.minimum(-deviation, self._clamp_low)
        self._offset_low += np.where(down, (target - self._offset_low) * share, 0.0)
        offset_high = self._bank_2[:, reg.OFFSET_HIGH]
        offset_low = self._bank_2[:, reg.OFFSET_LOW]
        np.copyto(offset_high, np.rint(self._offset_high), where=up, casting="unsafe")
        np.copyto(offset_low, np.rint(self._offset_low), where=down, casting="unsafe")
