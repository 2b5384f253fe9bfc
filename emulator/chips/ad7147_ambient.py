"""Environmental compensation of the AD7147: ambient values, thresholds, proximity, status.

Nothing here changes a conversion result. The chip follows slow changes of each stage with an
ambient value, puts a high and a low threshold around it, and stops following while something is
near. The rules are [M] except where the register map names a source; a stage is followed through
its noise-free code, since the chip averages many samples and thresholds are hundreds of codes
away.

State changes at conversions only, one pass over the stages at a time, so that it never depends on
when somebody reads the chip. After a pass that changes nothing but counters the next ones are
counted, not computed: an hour costs as much as the minute until then.
"""

import numpy as np
from numpy.typing import NDArray

from emulator.chips import ad7147_map as reg

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Words in the chip's slow filter.
SLOW_FILTER_WORDS = 8
#: A peak of a press enters the offset with this weight: four peaks are kept.
PEAK_WEIGHT = 0.25
#: An ambient value this near to the code has arrived; a filter of whole codes would stop earlier.
ARRIVED_CODES = 2.0**-10
#: Number of passes that may be skipped while nothing changes by itself.
FOR_EVER = 1 << 62


class AmbientTracking:
    """Ambient, thresholds and threshold status of the twelve stages of one chip.

    Attributes:
        high, low: bool[12], whether the stage's last conversion was beyond its threshold.
        proximity: bool[12], whether something is near the stage.
    """

    def __init__(self, registers: reg.Registers) -> None:
        self.bind(registers)
        self.high = np.zeros(reg.N_STAGES, bool)
        self.low = np.zeros(reg.N_STAGES, bool)
        self.proximity = np.zeros(reg.N_STAGES, bool)
        self._level = np.zeros(reg.N_STAGES)
        self._started = np.zeros(reg.N_STAGES, bool)
        #: Conversions for which a stage has been near, and for which it is still frozen.
        self._near_for = np.zeros(reg.N_STAGES, np.int64)
        self._frozen_for = np.zeros(reg.N_STAGES, np.int64)
        self._moved = True
        self._is_pinned = False
        self.configure()

    def bind(self, registers: reg.Registers) -> None:
        """Use these registers from now on."""
        self._bank_2 = registers[reg.BANK_2 : reg.BANK_3].reshape(reg.N_STAGES, reg.STAGE_WORDS)
        bank_3 = registers[reg.BANK_3 :].reshape(reg.N_STAGES, reg.RESULT_WORDS)
        self._ambient_word = bank_3[:, reg.SF_AMBIENT]
        self._fast_word = bank_3[:, reg.FF_AVG]
        self._high_word = bank_3[:, reg.HIGH_THRESHOLD]
        self._low_word = bank_3[:, reg.LOW_THRESHOLD]
        self._registers = registers

    def configure(self) -> None:
        """Read the set-up registers again. Call after any write to them."""
        cal_en, ctrl_0, ctrl_1, ctrl_2 = (int(word) for word in self._registers[1:5])
        enabled = (cal_en >> np.arange(reg.N_STAGES) & 1).astype(bool)
        self._started &= enabled
        self.proximity &= enabled
        self._enabled = enabled
        # Full power first, low power second.
        skip = (4 << (cal_en >> 12 & 3), 1 + (cal_en >> 14 & 3))
        self._follow = tuple(1 / (SLOW_FILTER_WORDS * samples) for samples in skip)
        self._freeze = (16 * (ctrl_0 >> 4 & 0xF), 4 * (ctrl_0 >> 8 & 0xF))
        self._near_codes = 16.0 * (ctrl_1 & 0xFF)
        # A time of 0 is taken as "never" [D].
        self._recalibrate = (ctrl_2 & 0x3FF, ctrl_2 >> 10)
        interrupts = self._registers[reg.STAGE_LOW_INT_ENABLE : reg.STAGE_COMPLETE_INT_ENABLE]
        pinned = not (ctrl_1 & 0xFF or any(self._recalibrate) or interrupts.any())
        if pinned or self._is_pinned:
            # Nothing depends on these counters there; they start when something does.
            self._near_for[:] = 0
            self._frozen_for[:] = 0
        self._is_pinned = pinned
        sensitivity = self._bank_2[:, 3].astype(np.int64)
        self._low_share = 0.25 + 0.75 / 16 * (sensitivity & 0xF)
        self._high_share = 0.25 + 0.75 / 16 * (sensitivity >> 8 & 0xF)
        self._low_peak = 0.4 + 0.1 * np.minimum(sensitivity >> 4 & 7, 5)
        self._high_peak = 0.4 + 0.1 * np.minimum(sensitivity >> 12 & 7, 5)
        offsets = self._bank_2[:, 4:8].astype(np.float64)
        self._offset_low, self._offset_high, self._clamp_high, self._clamp_low = offsets.T.copy()
        self._moved = True

    def restart(self, n_stages: int) -> None:
        """Start a sequence of this many stages: nothing is near the others any more."""
        self.proximity[n_stages:] = False
        self._moved = True

    def recalibrate(self) -> None:
        """Forget all ambient values: each starts again at its stage's next conversion."""
        self._started[:] = False
        self.proximity[:] = False
        self._near_for[:] = 0
        self._frozen_for[:] = 0
        self._moved = True

    def memoryless(self, codes: Floats) -> bool:
        """Return whether any number of conversions of these codes [12] has the effect of the last
        one.

        With a proximity level of zero, as all iCub boards have it, any difference freezes the
        ambient value, and without an interrupt a passed threshold has no effect.
        Only a code far enough away to count as a peak still moves the offsets.
        """
        if not self._is_pinned or not np.array_equal(self._started, self._enabled):
            return False
        deviation = codes - self._level
        up = deviation > self._high_peak * self._offset_high
        down = -deviation > self._low_peak * self._offset_low
        return not (self._enabled & (up | down)).any()

    def convert(self, first: int, stop: int, codes: Floats, *, low_power: bool) -> Mask:
        """Take the conversions of stages `first` to `stop` - 1 of one pass, in their order.

        A stage that something is near stops the following of all stages, and of each for some
        conversions afterwards: while a sensor is active the calibration of the whole chip is
        disabled (data sheet of the sister chip AD7148). `reference` has no page that states it
        of the AD7147, but a finger that rests on a slider would otherwise be absorbed by the
        stages beside it.

        Args:
            first, stop: the stages that were converted.
            codes: float64[12], the noise-free codes of all stages.
            low_power: which set of times rules.

        Returns:
            bool[12], the enabled or disabled stages whose threshold condition changed.
        """
        stages = slice(first, stop)
        now = codes[stages]
        moved = self._follow_codes(stages, now, int(low_power))
        np.copyto(self._fast_word[stages], now, casting="unsafe")
        changed = np.zeros(reg.N_STAGES, bool)
        high, low = now > self._high_word[stages], now < self._low_word[stages]
        changed[stages] = (high != self.high[stages]) | (low != self.low[stages])
        self.high[stages], self.low[stages] = high, low
        self._moved = moved or bool(changed.any()) or (self._moved and first > 0)
        return changed

    def _follow_codes(self, stages: slice, codes: Floats, power: int) -> bool:
        """Ambient values and offsets of some stages; whether any has moved."""
        enabled = self._enabled[stages]
        if not enabled.any():
            return False
        level = self._level[stages]
        before = level.copy()
        started = self._started[stages]
        np.copyto(level, codes, where=enabled & ~started)
        was_started = bool((started | ~enabled).all())
        started |= enabled
        deviation = codes - level

        near = enabled & (np.abs(deviation) > self._near_codes)
        near_for = self._near_for[stages]
        near_for += 1
        near_for[~near] = 0
        frozen_for = self._frozen_for[stages]
        if self._recalibrate[power] and near.any():
            late = near_for > self._recalibrate[power]
            np.copyto(level, codes, where=late)
            near &= ~late
            near_for[late] = 0
        # A stage sees the flags of this pass up to its own, and of the pass before behind it.
        was_near = self.proximity
        behind = np.logical_or.accumulate(was_near[::-1])[::-1]
        later = np.append(behind, False)[stages.start + 1 : stages.stop + 1]
        ahead = bool(was_near[: stages.start].any())
        stopped = np.logical_or.accumulate(near) | ahead | later
        flags_moved = not np.array_equal(near, was_near[stages])
        was_near[stages] = near
        follows = enabled & ~stopped & (frozen_for == 0)
        thawed = bool((frozen_for == 1).any())
        frozen_for -= frozen_for > 0
        frozen_for[stopped] = self._freeze[power]

        gap = codes - level
        np.add(level, gap * self._follow[power], out=level, where=follows)
        np.copyto(level, codes, where=follows & (np.abs(gap) < ARRIVED_CODES))
        moved = self._follow_peaks(stages, enabled, deviation)

        def store(words: reg.Registers, values: Floats) -> None:
            clipped = np.clip(np.rint(values), 0, reg.FULL_SCALE)
            np.copyto(words[stages], clipped, where=enabled, casting="unsafe")

        offset_high, offset_low = self._offset_high[stages], self._offset_low[stages]
        store(self._ambient_word, level)
        store(self._high_word, level + self._high_share[stages] * offset_high)
        store(self._low_word, level - self._low_share[stages] * offset_low)
        moved |= flags_moved or thawed or not was_started
        return moved or not np.array_equal(before, level)

    def _follow_peaks(self, stages: slice, enabled: Mask, deviation: Floats) -> bool:
        """Adaptive thresholds: strong presses pull the offsets, up to their clamps."""
        moved = False
        for size, offset, share, clamp, word in (
            (deviation, self._offset_high, self._high_peak, self._clamp_high, reg.OFFSET_HIGH),
            (-deviation, self._offset_low, self._low_peak, self._clamp_low, reg.OFFSET_LOW),
        ):
            mine = offset[stages]
            pulled = enabled & (size > share[stages] * mine)
            if not pulled.any():
                continue
            gap = np.minimum(size, clamp[stages]) - mine
            pulled &= gap != 0.0
            moved |= bool(pulled.any())
            near = np.abs(gap) < ARRIVED_CODES
            np.add(mine, np.where(near, gap, PEAK_WEIGHT * gap), out=mine, where=pulled)
            np.copyto(self._bank_2[stages, word], np.rint(mine), where=pulled, casting="unsafe")
        return moved

    def settled_for(self, *, low_power: bool) -> int:
        """Return how many more passes would change only counters, at the end of a pass.

        All of them with the codes of the pass that has ended.
        """
        if self._moved:
            return 0
        limit = self._recalibrate[int(low_power)]
        if self.proximity.any():
            return int(limit - self._near_for[self.proximity].max()) if limit else FOR_EVER
        frozen = self._frozen_for[self._frozen_for > 0]
        return int(frozen.min()) if len(frozen) else FOR_EVER

    def skip(self, passes: int) -> None:
        """Count passes without any other change, at most `settled_for`."""
        if self.proximity.any():
            self._near_for[self.proximity] += passes
        else:
            np.maximum(self._frozen_for - passes, 0, out=self._frozen_for)
