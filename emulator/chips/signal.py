"""Chips without registers: capacitance straight to counts, for the whole skin at once.

The same sequencer, law and noise as `emulator.chips.ad7147`, worked out over arrays: twelve stages
follow each other, a result is taken when its conversion has ended, its noise is drawn when it
is first read. Given the same capacitances at the same times and the same generators, both
kinds of chip answer the same words.
"""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from emulator.boards.arithmetic import ABSENT, TAXELS
from emulator.boards.chip_access import SLOTS, StageMap, Words, set_up_bursts
from emulator.chips import ad7147_map as reg
from emulator.chips.noise import ChipNoise

_STAGES = np.arange(reg.N_STAGES)
_NO_SET_UP = np.zeros((reg.N_STAGES, reg.STAGE_WORDS), np.uint16)
#: So many changes of the inputs are remembered before they are worked out.
_MOST_CHANGES = 64
#: Of so many sets of chips it is remembered how they are indexed.
_MOST_SETS = 4096
#: And so many arrays of their numbers.
_MOST_KEYS = 64
#: A sequence that never comes to its end.
_STOPPED_NS = 1 << 58
#: The results of so many reads are foreseen together, of no more chips: of many, a read costs what
#: its numbers cost and not what its calls do.
_READS_AHEAD = 16
_MOST_CHIPS_AHEAD = 64

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(slots=True)
class Ahead:
    """What chips that are read together at an interval answer at their next reads.

    Attributes:
        results: uint16[m, k, 12], if no input changes.
        row: of the last read in `results`.
        revision: changes when inputs have changed, and `results` from `row` on with them.
        last_ns: when the chips were last read.
        interval_ns: since the read before.
        noise_version, ideal_version: of what the noise, and what the results depend on.
        noise: float64[m, k, 12] (codes); None without any.
    """

    results: Words
    row: int
    revision: int
    last_ns: int
    interval_ns: int
    noise_version: int
    ideal_version: int
    noise: Floats | None


class SignalSkin:
    """The chips of a whole robot.

    Args:
        noise: of the n chips; None is no noise at all.
        input_noise_ff: float64[n, 12], noise of each pad (fF rms).
        q_ff: capacitance of one code.

    Attributes:
        t_ns: the present; `SignalChips` reads the chips at this time.
        forced: int32[n], the word that a chip answers whatever it measures, or -1.
    """

    def __init__(
        self,
        noise: ChipNoise | None,
        input_noise_ff: Floats,
        q_ff: float = 0.36,
    ) -> None:
        n = len(input_noise_ff)
        self.t_ns = 0
        self.forced = np.full(n, -1, np.int32)
        self._is_any_forced = False
        self._q_ff = q_ff
        self._noise = noise
        self._noise_ff = input_noise_ff
        self._capacitance_ff = np.zeros((n, reg.N_CINS))
        self._bank_2: list[NDArray[np.uint16]] = [np.zeros_like(_NO_SET_UP)] * n
        self._weights: list[Floats | None] = [None] * n
        #: Stage s measures only pad s, the usual case.
        self._plain = np.ones(n, np.bool_)
        self._offset_ff = np.zeros((n, reg.N_STAGES))
        self._power: list[reg.PowerControl] = [reg.PowerControl.of(0)] * n
        self._n_stages = np.ones(n, np.int64)
        self._stage_ns = np.full(n, reg.STAGE_NS[0], np.int64)
        self._start_ns = np.zeros(n, np.int64)
        self._taken = np.zeros((n, 1), np.int64)
        self._ideal = np.zeros((n, reg.N_STAGES))
        self._clean = np.zeros((n, reg.N_STAGES))
        self._unseen = np.zeros((n, reg.N_STAGES), bool)
        self._held = np.zeros((n, reg.N_STAGES), bool)
        self._sigma = np.zeros((n, reg.N_STAGES))
        self._results = np.zeros((n, reg.N_STAGES), np.uint16)
        #: When the pass began that last converted each stage.
        self._began_ns = np.zeros((n, reg.N_STAGES), np.int64)
        #: Chips whose inputs have changed, when, and to what, since they were last worked out; and
        #: where in `_changed` each of them is.
        self._changed = np.zeros(0, np.intp)
        self._is_changed = np.zeros(n, np.bool_)
        self._place = np.zeros(n, np.intp)
        self._changed_ns: list[int] = []
        self._changes: list[Floats] = []
        #: By the numbers of chips that are read together: the start, the stages and the time of a
        #: stage that all of them have, or None.
        self._pace_of: dict[bytes, tuple[int, int, int] | None] = {}
        #: By the same numbers: as an index.
        self._rows_of: dict[bytes, Ints | slice] = {}
        #: By the object of these numbers: they, and their bytes.
        self._keys: dict[int, tuple[Ints, bytes]] = {}
        #: The chips whose registers were read last, and when.
        self._settled: set[int] = set()
        self._settled_ns = 0
        #: By the numbers of chips that are read together; what changes with their noise and with
        #: what they convert, and the latter when each chip last changed.
        self._ahead: dict[bytes, Ahead] = {}
        self._noise_version = 0
        self._ideal_version = 0
        self._ideal_versions = np.zeros(n, np.int64)

    def set_capacitance_ff(self, chips: Ints, values: Floats) -> None:
        """Change the inputs of some chips from now on: float64[k, 12] (fF).

        Changes of the same chips (the same array) are worked out together, when it matters.
        """
        if chips is not self._changed or len(self._changes) == _MOST_CHANGES:
            self._work_out()
            if not self._plain[chips].all():
                self._take(chips)
                self._capacitance_ff[chips, :TAXELS] = values
                self._update_ideal(chips)
                return
            self._changed = chips
            self._place[chips] = np.arange(len(chips))
        # Of those that are looked at, only some may really change.
        before = self._changes[-1] if self._changes else self._capacitance_ff[chips, :TAXELS]
        moved = chips[(values != before).any(axis=1)]
        if not len(moved):
            return
        self._is_changed[moved] = True
        self._changed_ns.append(self.t_ns)
        self._changes.append(values.copy())

    def _work_out(self) -> None:
        """Take what was converted while the inputs changed."""
        if self._changes:
            chips = self._changed
            ideals = self._ideal_of(chips, np.stack(self._changes))
            ideals = np.concatenate([self._ideal[chips][None], ideals])
            self._take(chips, np.array(self._changed_ns), ideals)
            self._capacitance_ff[chips, :TAXELS] = self._changes[-1]
            self._set_ideal(chips, ideals[-1])
            self._changes = []
            self._changed_ns = []
        self._is_changed[self._changed] = False
        self._changed = np.zeros(0, np.intp)

    def set_input_noise_ff(self, chips: Ints, values: Floats) -> None:
        """Change the noise of the pads of some chips, float64[k, 12] (fF rms)."""
        self._settle(chips)
        self._noise_ff[chips] = values
        for chip in chips:
            self._update_sigma(int(chip))

    def hold_results(self, chip: int, held: NDArray[np.bool_]) -> None:
        """Results bool[12] of a chip that show no noise at all, not even the converter's own."""
        self._settle(np.array([chip]))
        self._held[chip] = held
        self._update_sigma(chip)

    def configure(
        self, chips: Iterable[int], stages: StageMap, cdc_offset: int, power_control: int
    ) -> None:
        """What the set-up bursts of the firmware do to the chips."""
        bank_2 = _NO_SET_UP.copy()
        for first, words in set_up_bursts(stages, cdc_offset, power_control):
            if first >= reg.BANK_2:
                bank_2[(first - reg.BANK_2) // reg.STAGE_WORDS] = words
        rows = np.fromiter(chips, np.intp)
        self._settle(rows)
        self._set_up(rows, bank_2, reg.PowerControl.of(power_control), plain=stages == 0)

    def bit_by_bit(self) -> list[int]:
        """Return the chips whose registers were written one by one, as on a faulty data line."""
        return np.flatnonzero(~self._plain).tolist()

    def is_set_up(self, chip: int, cdc_offset: int, power_control: int) -> bool:
        """Whether a chip measures each pad alone, as firmware sets it up: bits that were read wrong
        on its data line may have changed its registers.
        """
        wanted = dict(set_up_bursts(StageMap.SINGLE, cdc_offset, power_control))
        measures = all(
            tuple(stage[:3]) == wanted[reg.BANK_2 + reg.STAGE_WORDS * number][:3]
            for number, stage in enumerate(self._bank_2[chip].tolist())
        )
        return measures and self._power[chip] == reg.PowerControl.of(power_control)

    def _set_up(
        self,
        rows: Ints,
        bank_2: NDArray[np.uint16],
        power: reg.PowerControl,
        *,
        plain: bool = False,
    ) -> None:
        """Let settled chips go on with a set-up that they all have."""
        weights, offset_ff = reg.decode_stages(bank_2)
        if not power.excited:
            weights[:], offset_ff[:], plain = 0.0, 0.0, False
        for chip in rows.tolist():
            self._bank_2[chip] = bank_2
            self._weights[chip] = weights
            self._plain[chip] = plain
            self._offset_ff[chip] = offset_ff
            if self._power[chip] != power:
                self._restart(chip, power)
            self._update_sigma(chip)
        self._update_ideal(rows)

    def _restart(self, chip: int, power: reg.PowerControl) -> None:
        self._power[chip] = power
        self._n_stages[chip] = power.n_stages
        self._stage_ns[chip] = _STOPPED_NS if power.mode == reg.SHUTDOWN else power.stage_ns
        self._start_ns[chip] = self.t_ns
        self._taken[chip] = 0
        self._pace_of.clear()
        self._noise_version += 1

    def brown_out(self, chip: int, ram: NDArray[np.uint16]) -> None:
        """Let the supply of a chip fail for a moment, see `AD7147.brown_out`."""
        self._reset(chip, ram[: _NO_SET_UP.size].reshape(_NO_SET_UP.shape))

    def _reset(self, chip: int, bank_2: NDArray[np.uint16]) -> None:
        """Defaults in Bank 1."""
        row = np.array([chip])
        self._settle(row)
        self._results[chip] = self._clean[chip] = 0
        self._unseen[chip] = False
        power = reg.PowerControl.of(0)
        self._set_up(row, bank_2, power)
        self._restart(chip, power)

    def write_register(self, chip: int, address: int, word: int) -> bool:
        """Write a register as far as results depend on it; whether all was acknowledged."""
        row = np.array([chip])
        bank_2, power = self._bank_2[chip], self._power[chip]
        if address == reg.PWR_CONTROL:
            if word & reg.SW_RESET:
                self._reset(chip, bank_2)
                return False
            power = reg.PowerControl.of(word)
        elif address == reg.AMB_COMP_CTRL0:
            if word & reg.CONV_RESET:
                self._settle(row)
                self._restart(chip, power)
            return True
        elif reg.BANK_2 <= address < reg.BANK_3:
            bank_2 = bank_2.copy()
            bank_2[divmod(address - reg.BANK_2, reg.STAGE_WORDS)] = word
        else:
            return True
        self._settle(row)
        self._set_up(row, bank_2, power)
        return True

    def read_register(self, chip: int, address: int) -> int:
        """A register as far as results depend on it; all others read 0."""
        if reg.CDC_RESULT <= address < reg.DEVICE_ID:
            if self.forced[chip] >= 0:
                return int(self.forced[chip])
            if self._settled_ns != self.t_ns or chip not in self._settled:
                one = np.array([chip])
                self._settle(one)
                self.note_settled(one)
            return int(self._results[chip, address - reg.CDC_RESULT])
        if reg.BANK_2 <= address < reg.BANK_3:
            return int(self._bank_2[chip][divmod(address - reg.BANK_2, reg.STAGE_WORDS)])
        return reg.DEVICE_ID_VALUE if address == reg.DEVICE_ID else 0

    def note_settled(self, chips: Ints) -> None:
        """The registers of these chips are as they are at the present."""
        if self._settled_ns != self.t_ns:
            self._settled.clear()
            self._settled_ns = self.t_ns
        self._settled.update(chips.tolist())

    def force(self, chip: int, word: int) -> None:
        """Let a chip answer `word` whatever it measures; -1 ends that."""
        self.forced[chip] = word
        self._is_any_forced = bool((self.forced >= 0).any())

    def read(self, chips: Ints) -> Words:
        """The twelve results of some chips, uint16[k, 12]."""
        return self.read_ahead(chips)[0]

    def read_ahead(self, chips: Ints) -> tuple[Words, Ahead | None]:
        """The same, and what holds the next reads if this one was foreseen."""
        if self._is_any_forced:
            forced = self.forced[chips]
            # A chip that is gone is not read: its sequencer and its noise go on later.
            there = forced < 0
            if not there.all():
                words = np.repeat(forced[:, None], TAXELS, axis=1).astype(np.uint16)
                if there.any():
                    words[there] = self.read(chips[there])
                return words, None
        settled = self._settle(chips)
        if settled is not None:
            return settled
        results: Words = self._results[chips]
        return results, None

    def _settle(self, chips: Ints) -> tuple[Words, Ahead | None] | None:
        """Store the results of the conversions that have ended, with their noise.

        Returns the results, if all are new, and what holds the next ones if they were foreseen.
        """
        changed: NDArray[np.bool_] | None = None
        if self._changes:
            changed = self._is_changed[self._rows(chips)]
            if b"\1" not in changed.tobytes():
                changed = None
        settled = self._settle_in_step(chips, changed)
        if settled is not None:
            return settled
        # What has changed at other chips can wait, for more of it.
        if changed is not None:
            self._work_out()
        self._take(chips)
        fresh = self._unseen[chips].any(axis=1)
        if not fresh.any():
            return None
        rows = self._rows(chips if fresh.all() else chips[fresh])
        codes = self._clean[rows]
        if self._noise is not None:
            noise = self._noise.at(rows, self._began_ns[rows])
            noise *= self._sigma[rows]
            codes = codes + noise
        words = _rounded(codes)
        unseen = self._unseen[rows]
        self._results[rows] = (
            words if unseen.all() else np.where(unseen, words, self._results[rows])
        )
        self._unseen[rows] = False
        return None

    def _settle_in_step(
        self, chips: Ints, changed: NDArray[np.bool_] | None
    ) -> tuple[Words, Ahead | None] | None:
        """Do the same for chips that convert in step, and all of whose stages are new.

        Args:
            chips: which ones.
            changed: bool[k], those of them whose inputs have changed; None if none have.

        Returns None if they are not; then nothing was done.
        """
        pace = self._pace(chips)
        if pace is None:
            return None
        start_ns, stages, stage_ns = pace
        sequences, rest_ns = divmod(self.t_ns - start_ns, stages * stage_ns)
        done = rest_ns // stage_ns
        ended = sequences * stages + done
        rows = self._rows(chips)
        if stages < reg.N_STAGES or ended - int(np.maximum.reduce(self._taken[rows])[0]) < stages:
            return None
        self._taken[rows] = ended
        ahead: Ahead | None = self._foresee(chips, rows, pace)
        assert ahead is not None
        results: Words = ahead.results[ahead.row]
        if changed is not None:
            began_ns = start_ns + sequences * stages * stage_ns
            mine = changed.nonzero()[0]
            # The oldest conversion is of the stage that comes next, the newest of the one before.
            oldest_ns = began_ns + (done + 1 - stages) * stage_ns
            codes = self._ideal_at(
                chips[mine],
                began_ns + _ended(stages, stage_ns)[done],
                oldest_ns,
                began_ns + done * stage_ns,
            )
            if ahead.noise is not None:
                codes = codes + ahead.noise[ahead.row, mine]
            results = results.copy()
            results[mine] = _rounded(codes)
            ahead = None
        self._results[rows] = results
        self._unseen[rows] = False
        return results, ahead

    def _foresee(self, chips: Ints, rows: Ints | slice, pace: tuple[int, int, int]) -> Ahead:
        """What chips that convert in step answer, if their inputs do not change.

        At reads that come at an interval, several are foreseen together.
        """
        m, interval_ns = 1, 0
        is_few = len(chips) <= _MOST_CHIPS_AHEAD
        key = self._key(chips) if is_few else b""
        ahead = self._ahead.get(key) if is_few else None
        if ahead is not None:
            interval_ns = self.t_ns - ahead.last_ns
            if interval_ns == ahead.interval_ns:
                m = _READS_AHEAD
                ahead.row += 1
                if ahead.row < len(ahead.results) and ahead.noise_version == self._noise_version:
                    ahead.last_ns = self.t_ns
                    if ahead.ideal_version != self._ideal_version:
                        self._correct(ahead, chips)
                    return ahead
        noise = None
        codes = self._ideal[rows][None]
        if self._noise is None:
            codes = np.repeat(codes, m, axis=0)
        else:
            start_ns, stages, stage_ns = pace
            pass_ns = stages * stage_ns
            passed_ns = [(self.t_ns - start_ns + interval_ns * i) % pass_ns for i in range(m)]
            began_ns = [self.t_ns + interval_ns * i - passed_ns[i] for i in range(m)]
            both_ns = np.array([(one_ns, one_ns - pass_ns) for one_ns in began_ns])
            reached = [one_ns // stage_ns for one_ns in passed_ns]
            noise = self._noise.in_step(rows, both_ns, reached)
            noise *= self._sigma[rows]
            codes = codes + noise
        versions = self._noise_version, self._ideal_version
        ahead = Ahead(_rounded(codes), 0, 0, self.t_ns, interval_ns, *versions, noise)
        if is_few:
            self._ahead[key] = ahead
        return ahead

    def _correct(self, ahead: Ahead, chips: Ints) -> None:
        """Foresee the results again of chips whose inputs have changed for good."""
        mine = (self._ideal_versions[chips] > ahead.ideal_version).nonzero()[0]
        ahead.ideal_version = self._ideal_version
        if not len(mine):
            return
        codes = self._ideal[chips[mine]][None]
        if ahead.noise is not None:
            codes = codes + ahead.noise[ahead.row :, mine]
        ahead.results[ahead.row :, mine] = _rounded(codes)
        ahead.revision += 1

    def _key(self, chips: Ints) -> bytes:
        """Return the numbers of chips as bytes; boards read the same array again and again."""
        known = self._keys.get(id(chips))
        if known is not None and known[0] is chips:
            return known[1]
        if len(self._keys) >= _MOST_KEYS:
            self._keys.clear()
        key = chips.tobytes()
        self._keys[id(chips)] = chips, key
        return key

    def _pace(self, chips: Ints) -> tuple[int, int, int] | None:
        """Return start, stages and time of a stage, if some chips have all of them in common."""
        key = self._key(chips)
        if key not in self._pace_of:
            paces = {
                (int(self._start_ns[chip]), int(self._n_stages[chip]), int(self._stage_ns[chip]))
                for chip in chips
            }
            self._pace_of[key] = paces.pop() if len(paces) == 1 else None
        return self._pace_of[key]

    def _rows(self, chips: Ints) -> Ints | slice:
        """The same chips; those that follow each other as a slice, which costs no copies."""
        key = self._key(chips)
        rows = self._rows_of.get(key)
        if rows is None:
            follow = len(chips) > 0 and bool((np.diff(chips) == 1).all())
            rows = slice(int(chips[0]), int(chips[-1]) + 1) if follow else chips.copy()
            if len(self._rows_of) >= _MOST_SETS:
                self._rows_of.clear()
            self._rows_of[key] = rows
        return rows

    def _take(
        self,
        chips: Ints,
        changed_ns: NDArray[np.int64] | None = None,
        ideals: Floats | None = None,
    ) -> None:
        """Hold the noise-free results of the conversions that have ended since the last look.

        Args:
            chips: which ones.
            changed_ns: int64[m], when their inputs have changed since then.
            ideals: float64[m + 1, k, 12], what conversions give until the first change, and
                from each change on.
        """
        # Numbers, where all chips have them in common: that saves most of the work. Or int64[k, 1].
        start_ns: int | NDArray[np.int64]
        stages: int | NDArray[np.int64]
        stage_ns: int | NDArray[np.int64]
        start_ns, stages, stage_ns = self._pace(chips) or (
            self._start_ns[chips, None],
            self._n_stages[chips, None],
            self._stage_ns[chips, None],
        )
        sequences, rest_ns = divmod(self.t_ns - start_ns, stages * stage_ns)
        reached = rest_ns // stage_ns
        ended = sequences * stages + reached
        taken = self._taken[chips]
        new = ended - taken
        self._taken[chips] = ended
        # Stages that this pass has not reached yet were converted in the one before.
        last = sequences - (reached <= _STAGES)
        began_ns = start_ns + last * (stages * stage_ns)
        if changed_ns is None or ideals is None:
            ideal = self._ideal[chips]
        else:
            in_force = np.searchsorted(changed_ns, began_ns + (_STAGES + 1) * stage_ns)
            ideal = ideals[in_force, np.arange(len(chips))[:, None], _STAGES]
        if new.min(initial=reg.N_STAGES) >= reg.N_STAGES == np.min(stages, initial=reg.N_STAGES):
            self._clean[chips] = ideal
            self._began_ns[chips] = began_ns
            self._unseen[chips] = True
        elif new.any():
            done = (_STAGES - taken) % stages < new
            done &= stages > _STAGES
            self._clean[chips] = np.where(done, ideal, self._clean[chips])
            self._began_ns[chips] = np.where(done, began_ns, self._began_ns[chips])
            self._unseen[chips] |= done

    def _ideal_at(
        self, chips: Ints, ended_ns: NDArray[np.int64], oldest_ns: int, newest_ns: int
    ) -> Floats:
        """What changed chips converted in stages that ended then, int64[12]: float64[k, 12].

        `oldest_ns` and `newest_ns` are the least and the most of these times.
        """
        times_ns = self._changed_ns
        # Those in force at all of these times: the last one before, and those amid them.
        first = bisect_left(times_ns, oldest_ns) - 1
        last = bisect_left(times_ns, newest_ns)
        if not last:
            return self._ideal[chips]
        place = self._place[chips]
        if first < 0:
            ideal = self._ideal[chips]
        else:
            ideal = self._ideal_of(chips, self._changes[first][place])
            if first == len(times_ns) - 1:
                # Nothing before the last change matters to these chips any more.
                self._capacitance_ff[chips, :TAXELS] = self._changes[-1][place]
                self._set_ideal(chips, ideal)
                self._is_changed[chips] = False
                if not self._is_changed[self._changed].any():
                    self._changes = []
                    self._changed_ns = []
        for number in range(first + 1, last):
            later = self._ideal_of(chips, self._changes[number][place])
            np.copyto(ideal, later, where=ended_ns > times_ns[number])
        return ideal

    def _set_ideal(self, chips: Ints, ideal: Floats) -> None:
        """Change what chips convert from now on, float64[k, 12] (codes)."""
        self._ideal[chips] = ideal
        self._ideal_version += 1
        self._ideal_versions[chips] = self._ideal_version

    def _ideal_of(self, chips: Ints, values: Floats) -> Floats:
        """What plain chips convert such inputs to."""
        ideal: Floats = reg.MID_SCALE + (values - self._offset_ff[chips]) / self._q_ff
        return ideal

    def _update_ideal(self, chips: Ints) -> None:
        difference_ff = self._capacitance_ff[chips, :TAXELS] - self._offset_ff[chips]
        for row in np.flatnonzero(~self._plain[chips]).tolist():
            chip = chips[row]
            weights = self._weights[chip]
            if weights is not None:
                total_ff = weights @ self._capacitance_ff[chip]
                difference_ff[row] = total_ff - self._offset_ff[chip]
        self._set_ideal(chips, reg.MID_SCALE + difference_ff / self._q_ff)

    def _update_sigma(self, chip: int) -> None:
        weights = self._weights[chip]
        if weights is None:
            return
        squares = np.zeros(reg.N_CINS)
        squares[:TAXELS] = np.square(self._noise_ff[chip] / self._q_ff)
        own = reg.NOISE_CODES_RMS[self._power[chip].decimation]
        sigma = np.sqrt(own**2 + np.square(weights) @ squares)
        self._sigma[chip] = sigma * ~self._held[chip]
        self._noise_version += 1


@cache
def _ended(stages: int, stage_ns: int) -> NDArray[np.int64]:
    """When stages were last converted, after the beginning of a pass, int64[stages + 1, 12].

    By how many stages of the pass have been converted; the others were in the pass before.
    """
    is_before = np.arange(stages + 1)[:, None] <= _STAGES
    return ((_STAGES + 1 - stages * is_before) * stage_ns).astype(np.int64)


def _rounded(codes: Floats) -> Words:
    """Codes as a converter gives them."""
    codes = np.rint(codes)
    np.maximum(codes, 0.0, out=codes)
    np.minimum(codes, reg.FULL_SCALE, out=codes)
    return codes.astype(np.uint16)


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

    def read(self, without: int = 0) -> Words:
        """The twelve results of every slot, uint16[20, 12]; 0xFFFF where nothing is."""
        del without  # that a chip is read changes nothing
        words = np.full((SLOTS, TAXELS), ABSENT, np.uint16)
        fitted = self.chip_of_slot >= 0
        if fitted.any():
            chips = self.chip_of_slot[fitted]
            words[fitted] = self._skin.read(chips)
            self._skin.note_settled(chips)
        return words


class SignalPort:
    """A chip of a `SignalSkin` as a bus sees it: connections, offsets, sequence and results.

    Other registers of an AD7147 (status, ambient, low power) are missing: they read 0.
    """

    def __init__(self, skin: SignalSkin, chip: int) -> None:
        self._skin = skin
        self._chip = chip
        #: The boards read their results up to here.
        self.pointer = reg.DEVICE_ID

    def write(self, data: bytes) -> int:
        """Take one write message, as `AD7147.write` does."""
        if len(data) >= 2:
            self.pointer = (data[0] << 8 | data[1]) & 0x3FF
        for at in range(2, len(data) - 1, 2):
            word = data[at] << 8 | data[at + 1]
            if not self._skin.write_register(self._chip, self.pointer, word):
                self.pointer = 0
                return at + 1
            self.pointer = min(self.pointer + 1, max(self.pointer, reg.END_OF_MAP))
        return len(data)

    def read(self, length: int) -> bytes:
        """Answer one read message, as `AD7147.read` does."""
        first = self.pointer
        if length == 2:
            # Word by word, as boards read over lines with a fault.
            self.pointer = max(first, min(first + 1, reg.END_OF_MAP))
            return self._skin.read_register(self._chip, first).to_bytes(2)
        words = [
            self._skin.read_register(self._chip, first + at).to_bytes(2)
            for at in range(-(-length // 2))
        ]
        self.pointer = max(first, min(first + length // 2, reg.END_OF_MAP))
        return b"".join(words)[:length]
