"""Chips without registers: capacitance straight to counts, for the whole skin at once.

The same sequencer, law and noise as `emulator.ad7147`, worked out over arrays: twelve stages
follow each other, a result is taken when its conversion has ended, its noise is drawn when it
is first read. Given the same capacitances at the same times and the same generators, both
kinds of chip answer the same words.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from emulator import ad7147_map as reg
from emulator.firmware.arithmetic import ABSENT, TAXELS
from emulator.firmware.chips import SLOTS, StageMap, Words, set_up_bursts

#: Noise is drawn for so many reads of a chip at a time.
NOISE_BLOCK = 32
_STAGES = np.arange(reg.N_STAGES)

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


class SignalSkin:
    """The chips of a whole robot.

    Args:
        rngs: a generator for each of the n chips, used as `AD7147` uses its own.
        input_noise_ff: float64[n, 12], noise of each pad (fF rms).
        q_ff: capacitance of one code.
        quiet: no noise at all; the generators are not used.

    Attributes:
        t_ns: the present; `SignalChips` reads the chips at this time.
        forced: int32[n], the word that a chip answers whatever it measures, or -1.
    """

    def __init__(
        self,
        rngs: Sequence[np.random.Generator],
        input_noise_ff: Floats,
        q_ff: float = 0.36,
        *,
        quiet: bool = False,
    ) -> None:
        n = len(rngs)
        self.t_ns = 0
        self.forced = np.full(n, -1, np.int32)
        self._rngs = rngs
        self._q_ff = q_ff
        self._quiet = quiet
        self._noise_ff = input_noise_ff
        self._capacitance_ff = np.zeros((n, reg.N_CINS))
        self._stage_map: list[StageMap | None] = [None] * n
        self._weights: dict[StageMap, Floats] = {}
        self._offset_ff = np.zeros((n, reg.N_STAGES))
        self._power: list[reg.PowerControl] = [reg.PowerControl.of(0)] * n
        self._n_stages = np.ones(n, np.int64)
        self._stage_ns = np.full(n, reg.STAGE_NS[0], np.int64)
        self._start_ns = np.zeros(n, np.int64)
        self._taken = np.zeros(n, np.int64)
        self._ideal = np.zeros((n, reg.N_STAGES))
        self._clean = np.zeros((n, reg.N_STAGES))
        self._unseen = np.zeros((n, reg.N_STAGES), bool)
        self._held = np.zeros((n, reg.N_STAGES), bool)
        self._sigma = np.zeros((n, reg.N_STAGES))
        self._results = np.zeros((n, reg.N_STAGES), np.uint16)
        self._noise = np.zeros((n, NOISE_BLOCK, reg.N_STAGES))
        self._drawn = np.full(n, NOISE_BLOCK, np.int64)

    def set_capacitance_ff(self, chips: Ints, values: Floats) -> None:
        """Change the inputs of some chips from now on: float64[k, 12] (fF)."""
        self._take(chips)
        self._capacitance_ff[chips, :TAXELS] = values
        self._update_ideal(chips)

    def set_input_noise_ff(self, chips: Ints, values: Floats) -> None:
        """Change the noise of the pads of some chips, float64[k, 12] (fF rms)."""
        self._noise_ff[chips] = values
        for chip in chips:
            self._update_sigma(int(chip))

    def hold_results(self, chip: int, held: NDArray[np.bool_]) -> None:
        """Results bool[12] of a chip that show no noise at all, not even the converter's own."""
        self._held[chip] = held
        self._update_sigma(chip)

    def configure(
        self, chips: Iterable[int], stages: StageMap, cdc_offset: int, power_control: int
    ) -> None:
        """What the set-up bursts of the firmware do to the chips."""
        power = reg.PowerControl.of(power_control)
        bank_2 = np.zeros((reg.N_STAGES, reg.STAGE_WORDS), np.uint16)
        for first, words in set_up_bursts(stages, cdc_offset, power_control):
            if first >= reg.BANK_2:
                bank_2[(first - reg.BANK_2) // reg.STAGE_WORDS] = words
        weights, offset_ff = reg.decode_stages(bank_2)
        self._weights[stages] = weights
        rows = np.fromiter(chips, np.intp)
        self._take(rows)
        for chip in rows:
            self._stage_map[chip] = stages
            self._offset_ff[chip] = offset_ff
            if self._power[chip] != power:
                self._power[chip] = power
                self._n_stages[chip] = power.n_stages
                self._stage_ns[chip] = power.stage_ns
                self._start_ns[chip] = self.t_ns
                self._taken[chip] = 0
            self._update_sigma(chip)
        self._update_ideal(rows)

    def read(self, chips: Ints) -> Words:
        """The twelve results of some chips, uint16[k, 12]."""
        forced = self.forced[chips]
        if (forced >= 0).any():
            # A chip that is gone is not read: its sequencer and its noise go on later.
            there = forced < 0
            words = np.repeat(forced[:, None], TAXELS, axis=1).astype(np.uint16)
            words[there] = self.read(chips[there])
            return words
        self._take(chips)
        unseen = self._unseen[chips]
        fresh = unseen.any(axis=1)
        if fresh.any():
            rows = chips[fresh]
            codes = self._clean[rows]
            if not self._quiet:
                codes = codes + self._sigma[rows] * self._draw(rows)
            codes = np.clip(np.rint(codes), 0, reg.FULL_SCALE)
            unseen = unseen[fresh]
            self._results[rows] = (
                codes if unseen.all() else np.where(unseen, codes, self._results[rows])
            )
            self._unseen[rows] = False
        return self._results[chips]

    def _draw(self, chips: Ints) -> Floats:
        """The next twelve standard normals of each of some chips."""
        for chip in chips[self._drawn[chips] == NOISE_BLOCK]:
            self._noise[chip] = self._rngs[chip].standard_normal((NOISE_BLOCK, reg.N_STAGES))
            self._drawn[chip] = 0
        noise: Floats = self._noise[chips, self._drawn[chips]]
        self._drawn[chips] += 1
        return noise

    def _take(self, chips: Ints) -> None:
        """Hold the noise-free results of the conversions that have ended since the last look."""
        stages, stage_ns = self._n_stages[chips], self._stage_ns[chips]
        sequences, rest_ns = np.divmod(self.t_ns - self._start_ns[chips], stages * stage_ns)
        ended = sequences * stages + rest_ns // stage_ns
        taken = self._taken[chips]
        new = ended - taken
        self._taken[chips] = ended
        if new.min(initial=reg.N_STAGES) >= reg.N_STAGES == stages.min(initial=reg.N_STAGES):
            self._clean[chips] = self._ideal[chips]
            self._unseen[chips] = True
        elif new.any():
            done = (_STAGES - taken[:, None]) % stages[:, None] < new[:, None]
            done &= stages[:, None] > _STAGES
            self._clean[chips] = np.where(done, self._ideal[chips], self._clean[chips])
            self._unseen[chips] |= done

    def _update_ideal(self, chips: Ints) -> None:
        difference_ff = self._capacitance_ff[chips, :TAXELS] - self._offset_ff[chips]
        for row, chip in enumerate(chips):
            stages = self._stage_map[chip]
            if stages is not None and stages is not StageMap.SINGLE:
                total_ff = self._weights[stages] @ self._capacitance_ff[chip]
                difference_ff[row] = total_ff - self._offset_ff[chip]
        self._ideal[chips] = reg.MID_SCALE + difference_ff / self._q_ff

    def _update_sigma(self, chip: int) -> None:
        stages = self._stage_map[chip]
        if stages is None:
            return
        squares = np.zeros(reg.N_CINS)
        squares[:TAXELS] = np.square(self._noise_ff[chip] / self._q_ff)
        own = reg.NOISE_CODES_RMS[self._power[chip].decimation]
        sigma = np.sqrt(own**2 + np.square(self._weights[stages]) @ squares)
        self._sigma[chip] = sigma * ~self._held[chip]


class SignalChips:
    """The chips of one board in a `SignalSkin`, as its firmware sees them.

    Args:
        skin: the whole robot's chips.
        chip_of_slot: intp[20], the chip at each slot of the board, -1 where there is none.
    """

    def __init__(self, skin: SignalSkin, chip_of_slot: Ints) -> None:
        self._skin = skin
        self.chip_of_slot = chip_of_slot

    def configure(
        self, slots: Iterable[int], stages: StageMap, cdc_offset: int, power_control: int
    ) -> None:
        """Set up the chips that are there."""
        own = self.chip_of_slot[list(slots)]
        own = own[own >= 0]
        chips = own[self._skin.forced[own] < 0].tolist()
        if chips:
            self._skin.configure(chips, stages, cdc_offset, power_control)

    def read(self) -> Words:
        """The twelve results of every slot, uint16[20, 12]; 0xFFFF where nothing is."""
        words = np.full((SLOTS, TAXELS), ABSENT, np.uint16)
        fitted = self.chip_of_slot >= 0
        if fitted.any():
            words[fitted] = self._skin.read(self.chip_of_slot[fitted])
        return words
