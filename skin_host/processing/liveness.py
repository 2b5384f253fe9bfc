"""Detects triangles whose chip has died although they send, and noisy pads.

A chip that died can go on sending for ever: after it died, the board's firmware sends one constant
value with no error in its status word (reference of the wire, section 4.5). It differs from an
untouched triangle in its noise. The least noise of a working pad changes its byte now and then,
twelve pads change some byte nearly every time, and a byte that repeats for longer than chance
explains does not come from a working chip.

How often a byte changes is known from the calibration and followed afterwards, because it depends
on where between two bytes the reading lies: an hour of warming moves a lively taxel into the quiet
middle of a byte. The decision is then one of probability. After c changes in n samples a run of k
without one has the probability B(c, n - c + k) / B(c, n - c), the beta-binomial of Bayes' rule,
which is (1 - c/n)^k where n is large. At a probability of one in `TRIANGLE_ODDS` the run is no
longer taken for chance. A quiet triangle is therefore given more time than a noisy one.

There are other reasons for repeated bytes. While an iCub's hand holds an object its bytes repeat
much longer than those of the open hand (the IROS 2012 recordings: some pads for 44 sweeps, a whole
fingertip for 19), so repeats count for less while the board feels a touch.

Single pads are judged in `stuck`. Where most pads of a triangle are stuck, it is the chip: after a
failure of its supply, or wrong bits in a set-up, it goes on with one conversion of twelve.

A pad is noisy when it jumps up and down. So does one that a hand taps, for boards that send too
seldom to see more than two readings of a tap. There what most pads of a triangle do in one
direction is no jump: what presses moves them together, while the pads of a broken chip read what
they like. Where most pads of a chip are noisy although it is known how noisy they are under
pressure, its connection is broken, as in `erratic`, which sees that where sweeps come faster than
15 times a second.

Much of what a step costs is that its code is found cold. So a sweep by which no decision can change
waits until the second or third one after it, and then they are taken one after the other.

Only conversions count (`conversions`): a board that sends more often repeats its values. What a pad
does in successive conversions may be some sweeps apart then.
"""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.compensation import NO_GAIN, THERMAL_TAXEL
from skin_host.processing.conversions import CONVERSION_S, YOUNG_S
from skin_host.processing.erratic import CALM_S, FASTEST_HZ, most_of
from skin_host.processing.masks import Mask, all_of, any_of, count_of
from skin_host.processing.stuck import (
    MOST_RATE,
    TOUCHED_PACE,
    Encoding,
    Repeats,
    Rows,
    StuckPads,
    TouchedPads,
    inside,
    longest_run,
)

Floats = NDArray[np.float64]

PADS = 12

#: A run of repeats with a probability below 1/odds is not chance.
TRIANGLE_ODDS = 1e9
#: However lively it was, a triangle is not called frozen in less than nine conversions (0.45 s at
#: 20 Hz).
MOST_TRIANGLE_RATE = 0.9
#: A triangle that changed at all during the calibration is expected to change at least this often.
LEAST_TRIANGLE_RATE = 0.02
#: Rates follow the observed ones over about this time, in steps of about this many samples.
RATE_MEMORY_S = 10.0
#: A calibration counts as this much observation.
CALIBRATED_S = 5.0
RATE_SAMPLES = 20
#: After this many changes a triangle that was frozen, or had an error, is valid again; and one of
#: which nothing is known, because the daemon has just begun. A set-up may change a dead one once.
PROBATION_CHANGES = 3
FIRST_CHANGES = 2
#: Assumed noise of the pads (units) before the calibration.
USUAL_NOISE_UNITS = 0.5
#: A byte jumps when it goes up and down by more than this many units, and more than this multiple
#: of the calibrated noise.
NOISY_UNITS = 3.0
NOISY_SIGMAS = 5.0
#: A taxel is noisy when its jumps, as multiples of that limit (at most this large), exceed this on
#: average over all conversions; and calm again below. Large jumps are rarer by chance than many.
MOST_JUMP = 2.0
NOISY_MEAN = 0.5
CALM_MEAN = 0.1
NOISE_MEMORY_CONVERSIONS = 8
#: Boards that send more seldom than this read a hand's fastest taps less than three times each.
SLOW_S = 1.0 / (3.0 * FASTEST_HZ)
#: Where the rise and the fall of such a tap may be as near to each other as those of a jump, a step
#: is a press, or its end, if so many pads of the triangle make one two thirds as far in its
#: direction, and so many times as many as in the other: the pad that is pressed hardest may be
#: alone. Ten pads that read what they like do that in one step of ten.
TOGETHER_PADS = 3
TOGETHER_RATIO = 4
#: A pad has jumped lately while that mean is above this: for some 25 conversions.
LATELY_MEAN = 0.01
#: So many sweeps may wait where no step is far: a jump takes two far steps, and noise two jumps.
MOST_WAITING = 2
#: A spike is one sweep off by more than this many units, and this multiple of the noise, and back
#: where it was but for the noise: a press after a release ends elsewhere. A spike of a pad that has
#: jumped lately, or jumps again so soon, is a fault of the pad, not of the bus.
SPIKE_UNITS = 7.0
SPIKE_SIGMAS = 8.0
#: A spike that has not been counted when so many conversions could not be compared, in a silence or
#: one here and one there, is over: what is counted is what happens now.
SPIKE_CONVERSIONS = 25
#: What is kept whole, or follows from the rest.
RENEWED = {"spikes", "doubted", "lifeless", "halted"}
#: Bytes on both sides of a gap of so many sweeps are of one zero, and show whether a chip lives. In
#: a longer one the board may have restarted.
FEW_MISSED = 5


def change_rate(noise_units: Floats) -> Floats:
    """Return how often successive bytes differ, given their standard deviation in units.

    Up to half a unit the byte has two values and differs in 2 variance of all cases; above,
    the collision probability of a normal distribution is 1 / (2 sqrt(pi) sigma).
    """
    above = 1.0 - 1.0 / (2.0 * math.sqrt(math.pi) * np.maximum(noise_units, 0.5))
    rate: Floats = np.where(noise_units <= 0.5, 2.0 * noise_units**2, np.maximum(above, 0.5))
    return rate


class Liveness:
    """Watches the bytes of the k triangles of some boards, 12 pads each, all at once.

    Args:
        k: triangles, those of one board after those of another, equally many of each.
        noise_units: float64[k, 12], calibrated noise, NaN of pads that were received too rarely,
            or None without a calibration. No noise of any pad in a triangle means that it was
            constant during the calibration, or absent: it is not valid before it changes often
            enough. Another is not before its second change.
        period_s: how often each board sends, [boards] or the same for all.
        repeats: finds which pads send something new; without it, those whose byte changes.
        boards: how many boards.
        fitted: bool[k], triangles that there are, all by default; nothing of others is received.
        pressed_units: float64[k, 12], noise as measured under pressure, NaN where it is not known.
            Real pads jump more then, and do not count as noisy for that.

    Attributes:
        frozen: bool[k], triangles that repeat their bytes for longer than chance explains.
        unproven: bool[k], triangles that had an error, or were frozen, and have not changed
            enough since; at first all.
        silenced: bool[k], those of them whose last reason was an error.
        halted: bool[k], triangles most of whose pads are stuck, but for those that were constant
            when calibrated: the chip is not set up any more, and what the others read is no
            measure.
        noisy: bool[k, 12], pads that jump up and down much more than when calibrated, and those of
            chips of slow boards whose connection is broken.
        doubted: bool[k, 12], pads that are not valid, or None if all are. Of a noisy temperature
            pad those that its board compensates with it are not.
        lifeless: bool[k, 12], doubted pads whose bytes show nothing of the skin, or None if none
            are: not those that are only noisy.
        spikes: int64[k, 12], how often each pad, alone in its triangle, was off for one sweep and
            back in the next, and did not jump in some 25 conversions before and after: a damaged
            frame does that, a sensor at rest does not. One is counted when that is known, if
            nothing touched the triangle until then: real pads jump under pressure.
    """

    def __init__(
        self,
        k: int,
        noise_units: Floats | None,
        period_s: float | Floats,
        repeats: Repeats | None = None,
        boards: int = 1,
        fitted: Mask | None = None,
        pressed_units: Floats | None = None,
    ) -> None:
        shape = (k, PADS)
        self._boards = boards
        period_s = np.repeat(np.broadcast_to(np.float64(period_s), boards), k // boards)
        conversion_s = np.maximum(period_s, CONVERSION_S)
        repeats = repeats or Repeats([Encoding(NO_GAIN, 0, 0, truncates=False)] * k)
        calibrated = noise_units is not None
        if noise_units is None:
            noise_units = np.full(shape, USUAL_NOISE_UNITS)
        measured = ~np.isnan(noise_units)
        noise_units = np.where(measured, noise_units, 0.0)
        self._share: Floats = np.minimum(1.0, period_s / CONVERSION_S)
        self._weight: Floats = RATE_SAMPLES * period_s / RATE_MEMORY_S
        self._memory: Floats = RATE_MEMORY_S / conversion_s
        self._seen: Floats = CALIBRATED_S / conversion_s
        self._repeats = repeats
        self._compensated = repeats.compensated
        self._pads = StuckPads(noise_units, self._share, period_s, repeats, boards, fitted)
        fitted = np.ones(k, np.bool_) if fitted is None else fitted
        self._every = fitted.copy()
        self._none = np.zeros(k, np.bool_)
        self._fitted = fitted.tobytes()
        self._rows = None if all_of(fitted) else np.flatnonzero(fitted)
        self._rate: Floats = np.minimum(change_rate(noise_units), MOST_RATE)
        self._triangle_rate: Floats = 1.0 - np.prod(1.0 - self._rate, axis=1)
        self._moves: Mask = noise_units > 0.0
        self._constant = constant = ~np.any(noise_units > 0.0, axis=1) & fitted
        # Without a calibration, or if a pad was absent from it or its triangle constant, it is not
        # known how much noise is too much.
        known = ~constant[:, None] & measured & calibrated
        most = noise_units if pressed_units is None else np.fmax(noise_units, pressed_units)
        self._jump = np.where(known, np.maximum(NOISY_UNITS, NOISY_SIGMAS * most), np.inf)
        #: Steps are whole units, at most 255.
        self._jump_units = np.minimum(np.floor(self._jump), 255.0).astype(np.uint8)
        self._together_units = (2.0 / 3.0 * self._jump_units).astype(np.uint8)
        self._slow: Mask = period_s > SLOW_S
        self._any_slow = any_of(self._slow)
        #: A step may be followed by the next one after so many sweeps of repeats.
        step_sweeps = np.ceil(YOUNG_S / period_s).clip(1, 255)
        self._seldom: Mask = (step_sweeps + 1.0) * period_s > SLOW_S
        self._any_seldom = any_of(self._seldom)
        #: Pads whose steps show what presses. A board takes the noise of the other off them.
        self._feels: Mask = np.ones(shape, np.bool_)
        self._feels[:, THERMAL_TAXEL] = ~self._compensated.any(axis=1)
        #: Pads whose noise under pressure is known, and how many noisy ones show a broken chip;
        #: for how many sweeps it is then taken for broken, and how many of them are left.
        self._judged: Mask = known & (pressed_units is not None)
        if pressed_units is not None:
            self._judged &= ~np.isnan(pressed_units)
        self._enough = most_of(count_of(self._judged))
        self._calm_sweeps: Floats = CALM_S / period_s
        self._broken_left = np.zeros(k)
        self._spike = np.maximum(SPIKE_UNITS, SPIKE_SIGMAS * noise_units)

        self._raw = np.zeros(shape, np.uint8)
        #: Triangles whose last bytes show what has changed by the next ones.
        self._present = np.zeros(k, np.bool_)
        self._all_present = False
        self._step_sweeps = np.repeat(step_sweeps.astype(np.uint8), PADS).reshape(shape)
        self._most_step_sweeps = int(step_sweeps.max(initial=1))
        #: The last far step of each pad: for how many sweeps it still counts, its size and whether
        #: it went up; and for how many sweeps any counts at most.
        self._step_left, self._step_size = (np.zeros(shape, np.uint8) for _ in range(2))
        self._step_up = np.zeros(shape, np.bool_)
        self._any_step_left = 0
        self._jumping = np.zeros(shape)
        forget = np.repeat(self._share / NOISE_MEMORY_CONVERSIONS, PADS)
        self._jumping_kept: Floats = 1.0 - forget.reshape(shape)
        self._spike_sweeps: Floats = SPIKE_CONVERSIONS / self._share
        self._any_jumping = False
        #: Pads with a spike that are not known yet to stay calm.
        self._spiked = np.zeros(shape, np.bool_)
        #: How many sweeps of each triangle could not be compared since its last spike.
        self._uncompared = np.zeros(k, np.int64)
        #: How many sweeps each triangle has missed since it was received.
        self._missed = np.zeros(k, np.int64)
        #: Triangles whose next step is one over a short gap, and whether there are any.
        self._over_gap = np.zeros(k, np.bool_)
        self._any_over_gap = False
        self._felt: TouchedPads | None = None
        self._surprise = np.zeros(k)
        self._any_surprise = False
        # Counts up to `RATE_SAMPLES`.
        self._changes = np.zeros(shape, np.int8)
        self._alive = np.zeros(k, np.int8)
        self._samples = np.zeros(k, np.int8)
        #: No triangle has enough samples before so many more steps.
        self._until_learning = RATE_SAMPLES
        # Work arrays. A triangle has changed if any of its three words has.
        self._changed = np.zeros(shape, np.bool_)
        self._words = list(self._changed.view(np.uint32).T)
        self._any_word = np.zeros(k, np.uint32)
        self._now_alive = np.zeros(k, np.bool_)
        self._size, self._least = (np.zeros(shape, np.uint8) for _ in range(2))
        self._far = np.zeros(shape, np.bool_)
        self._to_show = np.where(constant, PROBATION_CHANGES, FIRST_CHANGES) * fitted
        self.frozen: Mask = np.zeros(k, np.bool_)
        self.unproven: Mask = self._to_show > 0
        self._any_to_show = any_of(self.unproven)
        self.silenced: Mask = np.zeros(k, np.bool_)
        self.halted: Mask = np.zeros(k, np.bool_)
        self.noisy: Mask = np.zeros(shape, np.bool_)
        self._any_noisy = False
        #: The pads that are noisy themselves.
        self._jumps: Mask = np.zeros(shape, np.bool_)
        self.doubted: Mask | None = None
        self.lifeless: Mask | None = None
        self.spikes = np.zeros(shape, np.int64)
        #: Sweeps of all boards that wait, with the touched pads; and how many may wait.
        self._waiting: list[tuple[NDArray[np.uint8], Mask | None]] = []
        self._room = 0
        self._pad_expected = np.zeros(shape)
        self._expected = np.zeros(k)
        self._renew_limits(slice(None))
        self._doubt()

    @property
    def stuck(self) -> Mask:
        """Return single pads that repeat their byte in a living triangle, bool[k, 12]."""
        return self._pads.stuck

    def expect_stuck(self, pads: Mask) -> None:
        """Some single pads, bool[k, 12], were stuck before a restart; nothing was received yet."""
        self._pads.expect_stuck(pads)
        self._doubt()

    def step(
        self,
        raw: NDArray[np.uint8],
        present: Mask,
        erring: Mask,
        touched: Mask | None = None,
        came: Mask | None = None,
    ) -> None:
        """Take one sweep of some boards.

        Args:
            raw: uint8[k, 12], the bytes.
            present: bool[k], triangles that were received, without an error in their status.
            erring: bool[k], triangles whose status word has an error.
            touched: bool[k, 12], recently touched pads, if there are any.
            came: bool[boards], boards whose sweep this is, all by default. Nothing of the others is
                present.
        """
        if (
            len(self._waiting) < self._room
            and came is None
            and present.tobytes() == self._fitted
            and not any_of(erring)
        ):
            self._waiting.append((raw.copy(), touched))
            return
        self.catch_up()
        self._take(raw, present, erring, touched, came)
        self._room = self._room_left()

    def catch_up(self) -> None:
        """Take the sweeps that wait."""
        for raw, touched in self._waiting:
            self._take(raw, self._every, self._none, touched, None)
        self._waiting.clear()
        self._room = 0

    def _room_left(self) -> int:
        """Return how many sweeps of all boards may now wait: whatever they are, if no status word
        has an error, none of them causes a doubt.
        """
        if self.doubted is not None or self._any_jumping or not self._all_present:
            return 0
        room = min(1 if self._any_step_left else MOST_WAITING, self._pads.steps_without_decision)
        if room > 0 and self._any_surprise:
            most = float((self._surprise + room * self._expected).max())
            return room if most < math.log(TRIANGLE_ODDS) else 0
        return room

    def _take(
        self,
        raw: NDArray[np.uint8],
        present: Mask,
        erring: Mask,
        touched: Mask | None,
        came: Mask | None,
    ) -> None:
        """Take one sweep; see `step`."""
        #: Usually every triangle came, now and before.
        all_present = present.tobytes() == self._fitted
        whole = all_present and self._all_present
        compared = present if whole else present & self._present
        changed = np.not_equal(raw, self._raw, out=self._changed)
        if not whole:
            changed &= compared[:, None]
        text = (raw if self._rows is None else raw.take(self._rows, 0)).tobytes()
        all_inside = 0 not in text and 255 not in text
        self._note_jumps(raw, changed, compared, whole)
        if any_of(self._spiked):
            if not whole:
                here = self._every if came is None else np.repeat(came, len(raw) // len(came))
                self._uncompared += here & ~compared
            self._note_spikes(touched)
        felt = None if touched is None else self._what_is_felt(touched)
        self._note_triangles(raw, compared, erring, felt, whole, all_inside)
        within: Mask | None = None
        if not (whole and all_inside):
            within = inside(raw)
            within &= compared[:, None]
        self._pads.step(raw, changed, within, self.unproven, felt, came)
        if whole:
            self._raw[:] = raw
        else:
            np.copyto(self._raw, raw, where=present[:, None])
        if not whole or self._any_over_gap:
            self._note_missed(present, erring, came)
        samples, changes = compared.view(np.int8), changed.view(np.int8)
        if felt is not None:
            samples, changes = samples * felt.calm, changes * felt.calm_pads
        self._samples += samples
        self._changes += changes
        self._until_learning -= 1
        if self._until_learning <= 0:
            if int(np.maximum.reduce(self._samples)) >= RATE_SAMPLES:
                self._learn()
            self._until_learning = RATE_SAMPLES - int(np.maximum.reduce(self._samples))
        self._doubt()

    def _note_missed(self, present: Mask, erring: Mask, came: Mask | None) -> None:
        """See which triangles were not received, or with an error, in a sweep; see `step`.

        The bytes on both sides of a gap are compared, as a bus may lose some in every second sweep.
        """
        here = self._every if came is None else np.repeat(came, len(present) // len(came))
        missed = here & ~present
        self._missed[missed] += 1
        self._missed[missed & erring] = FEW_MISSED + 1
        self._missed[present] = 0
        self._present &= self._missed <= FEW_MISSED
        self._present |= present
        self._all_present = self._present.tobytes() == self._fitted
        self._over_gap &= ~here
        self._over_gap |= missed & self._present
        self._any_over_gap = any_of(self._over_gap)

    def note_gap(self, board: int, missed: int = 0) -> None:
        """Sweeps of a board (its row) were lost, so many if that is known: the next step does not
        follow the last one, and after many, what is received next is not compared with what was
        before them.
        """
        self.catch_up()
        triangles = len(self._raw) // self._boards
        mine = slice(triangles * board, triangles * (board + 1))
        self._step_left[mine] = 0
        self._uncompared[mine] += missed
        if not missed:
            return
        self._missed[mine] += missed
        self._present[mine] &= self._missed[mine] <= FEW_MISSED
        self._all_present = self._present.tobytes() == self._fitted
        self._over_gap[mine] = self._present[mine]
        self._any_over_gap = any_of(self._over_gap)

    def keep(self, before: "Liveness", boards: Mask) -> None:
        """Take over the state of a predecessor for the same skin, for some boards (bool[boards]).

        Of the other boards, which were calibrated, triangles and pads that had to show that they
        live still have to: a calibration goes on with what was known of those that did not.
        """
        for one in (self, before):
            one.catch_up()
            one._pads.settle()
        self.spikes = before.spikes
        rows = np.repeat(boards, len(self.frozen) // len(boards))
        constant = self._constant & ~rows
        for mine, its in ((self, before), (self._pads, before._pads)):
            for name, array in vars(mine).items():
                if not isinstance(array, np.ndarray) or name in RENEWED:
                    continue
                if len(array) in {len(boards), len(rows)}:
                    chosen = boards if len(array) == len(boards) else rows
                    array[chosen] = getattr(its, name)[chosen]
        self._repeats.keep(before._repeats, rows)
        self._any_step_left = self._most_step_sweeps
        self._any_jumping = any_of(self._jumping > 0.0) or any_of(self._broken_left > 0.0)
        self._any_noisy = any_of(self.noisy)
        # Those that live have shown it to the predecessor.
        self._to_show = np.maximum(np.where(constant, PROBATION_CHANGES, 0), before._to_show)
        self.unproven = self._to_show > 0
        self.frozen = self.frozen | before.frozen
        self.silenced = self.silenced | before.silenced
        self._any_to_show = any_of(self.unproven)
        self._any_surprise = True
        self._any_over_gap = any_of(self._over_gap)
        self._all_present = self._present.tobytes() == self._fitted
        self._until_learning = 0
        self._pads.keep_stuck(before._pads)
        self._doubt()

    def _what_is_felt(self, touched: Mask) -> TouchedPads:
        """Return the consequences of which pads are touched; mostly those of the last sweep."""
        key = touched.tobytes()
        if self._felt is None or self._felt.key != key:
            self._felt = TouchedPads.of(touched, key, self._boards)
        return self._felt

    def _doubt(self) -> None:
        self.halted = self._none
        if not (self._any_to_show or self._pads.any_stuck or self._any_noisy):
            self.doubted = self.lifeless = None
            return
        if self._pads.any_stuck:
            self.halted = count_of(self.stuck) >= most_of(count_of(self._moves | self.stuck))
        self.doubted = self.lifeless = (self.unproven | self.halted)[:, None] | self.stuck
        if self._any_noisy:
            compensated = self._compensated & self.noisy[:, THERMAL_TAXEL, None]
            self.doubted = self.lifeless | self.noisy | compensated

    def _note_triangles(
        self,
        raw: NDArray[np.uint8],
        compared: Mask,
        erring: Mask,
        felt: TouchedPads | None,
        whole: bool,
        all_inside: bool,
    ) -> None:
        one, another, third = self._words
        np.bitwise_or(one, another, out=self._any_word)
        np.bitwise_or(self._any_word, third, out=self._any_word)
        alive = np.not_equal(self._any_word, 0, out=self._now_alive)
        self._alive += (alive if felt is None else alive & felt.calm).view(np.int8)
        all_alive = alive.tobytes() == compared.tobytes()
        if all_alive and not self._any_to_show and not any_of(erring):
            if whole and self._any_surprise:
                self._surprise.fill(0.0)
                self._any_surprise = False
            elif not whole:
                self._surprise[compared] = 0.0
            return
        self._any_surprise = True
        expected = self._expected
        if not all_inside:
            movable = inside(raw)
            # A pad at an end of the scale cannot change, even if it works.
            most = (self._pad_expected * movable).sum(axis=1)
            expected = np.where(movable.any(axis=1), np.minimum(expected, most), 0.0)
        if felt is not None:
            expected = np.where(felt.elsewhere, expected / TOUCHED_PACE, expected)
        self._surprise += np.where(compared, expected, 0.0)
        self._surprise[alive] = 0.0
        self._to_show -= alive & (self._to_show > 0)
        too_long = self._surprise > math.log(TRIANGLE_ODDS)
        self._to_show[too_long | erring] = PROBATION_CHANGES
        self._surprise[erring] = 0.0
        self.unproven = self._to_show > 0
        self._any_to_show = any_of(self.unproven)
        self.frozen = (too_long | self.frozen) & self.unproven & ~erring
        self.silenced = (self.silenced | erring) & self.unproven

    def _note_jumps(
        self, raw: NDArray[np.uint8], changed: Mask, compared: Mask, whole: bool
    ) -> None:
        """A step up followed by a step down is noise; a touch goes in one direction at a time.

        What lies between are repeats, or what the board takes off as its temperature pad moves.
        """
        size = np.maximum(raw, self._raw, out=self._size)
        size -= np.minimum(raw, self._raw, out=self._least)
        far = np.greater(size, self._jump_units, out=self._far)
        if not whole:
            far &= changed
        if self._any_over_gap:
            far[self._over_gap] = False
        any_far = any_of(far)
        jump: Mask | None = None
        if any_far:
            up = raw > self._raw
            if self._any_step_left:
                jump = far & (self._step_left > 0) & (up ^ self._step_up)
                if self._any_seldom:
                    jump &= ~self._moved_together(far, size, up)
        here = None if whole else compared
        if jump is not None and any_of(jump):
            self._count_jumps(jump, size, here)
        elif self._any_jumping:
            self._note_noise(here)
        if self._any_step_left:
            counts = self._step_left > 0
            if whole:
                self._step_left -= counts
                self._any_step_left -= 1
            else:
                self._step_left -= counts & compared[:, None]
                self._any_step_left = int(self._step_left.max())
        if any_far:
            self._any_step_left = self._most_step_sweeps
            np.copyto(self._step_left, self._step_sweeps, where=far)
            np.copyto(self._step_size, size, where=far)
            np.copyto(self._step_up, up, where=far)

    def _moved_together(self, far: Mask, size: NDArray[np.uint8], up: Mask) -> Mask:
        """Return which far steps, bool[k, 12], most pads of a triangle that is read seldom share,
        up or down; of steps of so many units.
        """
        moved = (size > self._together_units) & self._feels
        rise = count_of(moved & up)[:, None]
        fall = count_of(moved)[:, None] - rise
        same, other = np.where(up, rise, fall), np.where(up, fall, rise)
        found: Mask = far & self._feels & self._seldom[:, None]
        found &= (same >= TOGETHER_PADS) & (same >= TOGETHER_RATIO * other)
        return found

    def _count_jumps(self, jump: Mask, size: NDArray[np.uint8], compared: Mask | None) -> None:
        """Take far steps, bool[k, 12], of so many units each, that went back from a far one."""
        both = np.minimum(size, self._step_size)
        # What goes on for longer than one sweep is no damaged frame.
        spike = jump & (both > self._spike) & (self._step_left == self._step_sweeps)
        # The sizes differ by what is left of the two steps.
        spike &= np.maximum(size, self._step_size) - both <= self._jump_units
        spike &= self._jumping < LATELY_MEAN
        self._spiked &= ~jump
        alone = count_of(spike) == 1
        self._spiked |= spike & alone[:, None]
        self._uncompared[alone] = 0
        jumped: Floats = np.minimum(both / self._jump, MOST_JUMP)
        jumped *= jump
        self._note_noise(compared, jumped)

    def _note_spikes(self, touched: Mask | None) -> None:
        """Count the spikes of pads that have stayed calm since, and forget those of touched
        triangles, and of what was not received too often to know that soon.
        """
        self._spiked &= (self._uncompared < self._spike_sweeps)[:, None]
        if touched is not None:
            self._spiked &= (count_of(touched) == 0)[:, None]
        calm = self._spiked & (self._jumping < LATELY_MEAN)
        self.spikes += calm
        self._spiked ^= calm

    def _note_noise(self, compared: Mask | None, jumped: Floats | None = None) -> None:
        """Take the jumps of a sweep, as multiples of the limit, in the mean over conversions.

        Args:
            compared: bool[k], triangles of the sweep; None if all.
            jumped: float64[k, 12], if there are any.
        """
        kept = self._jumping_kept
        self._jumping *= kept if compared is None else np.where(compared[:, None], kept, 1.0)
        if jumped is not None:
            self._jumping += jumped / NOISE_MEMORY_CONVERSIONS
        self._jumping[self._jumping < 1e-3] = 0.0
        self._any_jumping = any_of(self._jumping > 0.0)
        self.noisy = self._jumps = self._jumping > np.where(self._jumps, CALM_MEAN, NOISY_MEAN)
        if self._any_slow:
            self._note_broken(compared)
        self._any_noisy = any_of(self.noisy)

    def _note_broken(self, compared: Mask | None) -> None:
        """Take all pads of a slow board's chip for noisy while most are, and for a time after."""
        passed = 1 if compared is None else compared
        np.maximum(self._broken_left - passed, 0.0, out=self._broken_left)
        broken = self._slow & (count_of(self._jumps & self._judged) >= self._enough)
        np.copyto(self._broken_left, self._calm_sweeps, where=broken)
        broken = self._broken_left > 0.0
        if any_of(broken):
            self._any_jumping = True
            self.noisy = self._jumps | (broken[:, None] & self._feels)

    def _learn(self) -> None:
        """Update the rates of boards with enough samples, for triangles that live."""
        enough = self._samples.reshape(self._boards, -1).max(axis=1) >= RATE_SAMPLES
        rows: Rows = slice(None)
        if not enough.all():
            rows = np.flatnonzero(np.repeat(enough, len(self._samples) // self._boards))
        samples, rate = self._samples[rows].astype(np.int64), self._rate[rows]
        seen = np.maximum(samples, 1)
        weight = self._weight[rows] * (~self.unproven[rows] & (samples >= RATE_SAMPLES // 2))
        self._triangle_rate[rows] += weight * (self._alive[rows] / seen - self._triangle_rate[rows])
        movable = ~self.stuck[rows] & inside(self._raw[rows])
        rate = rate + weight[:, None] * movable * (self._changes[rows] / seen[:, None] - rate)
        self._rate[rows] = rate
        more = self._seen[rows] + self._share[rows] * RATE_SAMPLES
        self._seen[rows] = np.minimum(more, self._memory[rows])
        self._samples[rows] = 0
        self._alive[rows] = 0
        self._changes[rows] = 0
        self._renew_limits(rows)

    def _renew_limits(self, rows: Rows) -> None:
        """Compute how long a pad may repeat, and how much each repeat of a triangle counts."""
        share, rate = self._share[rows], np.minimum(self._rate[rows], MOST_RATE)
        self._pad_expected[rows] = -share[:, None] * np.log1p(-rate)
        together = np.clip(self._triangle_rate[rows], LEAST_TRIANGLE_RATE, MOST_TRIANGLE_RATE)
        run = longest_run(together, self._seen[rows], TRIANGLE_ODDS)
        self._expected[rows] = share * math.log(TRIANGLE_ODDS) / run
