"""Detects single stuck pads in a triangle that otherwise works.

A byte has no new information if the same word of its chip explains it. Without temperature
compensation that is the same byte as before. With it the board subtracts the noise of a temperature
pad from every byte, so that the bytes of a stuck pad keep changing. But the temperature pad's own
byte shows what was subtracted, up to its rounding: each byte gives bounds of the chip's word, and a
run of bytes is a repetition as long as one word lies in all of them. The temperature pad's noise
even helps: words that shift against the bytes' edges leave a working pad less room than a byte
does. But where it rests in one byte, and by the board's rounding where it is colder than when the
board was zeroed, one word may lie in several bytes of a pad, and a repetition shows less.

A pad is stuck when it repeats for longer than chance allows. How often the pad moves
in general does not show what chance allows. Of a pad that reads 240 in 6 of 10 samples, 239 and
241 in 2 each, 44 % of all samples repeat the one before. But a long run is spent at 240, where
60 % repeat. So moves are counted out of runs that have begun, and a run of k more repeats, after m
moves in n such samples, has the probability B(m, n - m + k) / B(m, n - m) (Bayes' rule), which is
(1 - m/n)^k where n is large.

This is slow in principle. Per sample a repetition gives the information -ln(p) of the pad's
commonest byte, 0.4 to 0.9 at the noise of a hand's pads (0.4 to 0.8 units), and `ODDS` need 25.3.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.compensation import NO_GAIN, THERMAL_TAXEL, drift_of
from skin_host.processing.masks import Mask, all_of, any_of, count_of

Floats = NDArray[np.float64]


#: At most this many bits may be left out, for the words that a byte stands for to fit into 64 bits.
MOST_SHIFT = 4


class Encoding(NamedTuple):
    """How a triangle's bytes are derived from its chip's words.

    Attributes:
        gain: x128 per taxel, `compensation.thermal_gains`.
        shift: bits that the bytes leave out.
        no_load: the byte of an untouched pad.
        truncates: how the board rounds, see `compensation.drift_of`.
    """

    gain: tuple[int, ...]
    shift: int
    no_load: int
    truncates: bool


class Repeats:
    """Watches the words behind the bytes of k triangles.

    Args:
        encodings: of each triangle.
    """

    def __init__(self, encodings: list[Encoding]) -> None:
        self._gain = np.array([one.gain for one in encodings]) / 128
        # Coarser bytes hide the effect of the compensation on them.
        plain = [one.shift > MOST_SHIFT or not any(one.gain) for one in encodings]
        self._plain = _span(np.flatnonzero(plain))
        self._any_plain = any(plain)
        self._compensated = not all(plain)
        if not self._compensated:
            return
        encodings = [
            Encoding(NO_GAIN, 0, 0, False) if of_bytes else one
            for one, of_bytes in zip(encodings, plain, strict=True)
        ]
        kinds = sorted(set(encodings))
        tables = [_words(*kind) for kind in kinds]
        lowest = np.concatenate([lowest for lowest, _ in tables])
        pattern = np.concatenate([pattern for _, pattern in tables])
        no_load = np.array([one.no_load for one in kinds])
        #: How many words explain a byte of a pad at most, while warm and while cold, by kind.
        widest = np.array(
            [
                (_most_bits(pattern[: at + 1]), _most_bits(pattern[at + 1 :]))
                for at, (_, pattern) in zip(no_load, tables, strict=True)
            ]
        )
        # Half as long where that is enough, for half of the memory's traffic.
        short = int(pattern.max()) <= np.iinfo(np.uint32).max
        of_words: type[np.signedinteger[Any]] = np.int32 if short else np.int64
        self._of_bits: type[np.unsignedinteger[Any]] = np.uint32 if short else np.uint64
        self._lowest, self._pattern = lowest.astype(of_words), pattern.astype(self._of_bits)
        # At an end of its scale the temperature pad does not show what was subtracted, if anything
        # was.
        scale = np.arange(256)
        self._tells = np.concatenate(
            [(scale > 0) & (scale < 255) | (not any(kind.gain)) for kind in kinds]
        )
        kind = np.array([kinds.index(one) for one in encodings])
        self._kind = 256 * kind
        shape = self._gain.shape
        cells = np.array([1 << one.shift for one in encodings], of_words)
        self._cells = np.repeat(cells, shape[1]).reshape(shape)
        self._no_load = no_load[kind]
        self._room_units = [widest[kind, side] / self._cells for side in range(2)]
        #: Which words explain a run of bytes: the lowest that the last byte may stand for, and bit
        #: i: that plus i does.
        self._base = np.zeros(shape, of_words)
        self._possible = np.zeros(shape, self._of_bits)
        # Work arrays. In a step of two thousand pads, arrays of one shape that are written in place
        # cost a third of masks and broadcasts.
        self._all_bits = int(np.iinfo(self._of_bits).max)
        self._zeros = np.zeros(shape, of_words)
        self._none = np.zeros(shape, self._of_bits)
        self._lowered, self._up, self._left = (np.empty(shape, of_words) for _ in range(3))
        self._words = np.empty(shape, self._of_bits)
        self._moved = np.empty(shape, np.bool_)

    @property
    def compensated(self) -> Mask:
        """Return pads of which their board takes a share of the temperature pad, bool[k, 12]."""
        found: Mask = self._gain > 0.0
        return found

    @property
    def shifted(self) -> Mask:
        """Return pads whose words compensation moves against the edges of their bytes, bool[k,
        12].
        """
        shifted = self.compensated
        if self._any_plain:
            shifted[self._plain] = False
        return shifted

    def keep(self, before: "Repeats", rows: Mask) -> None:
        """Take over the state of a predecessor for the same triangles, for some of them
        (bool[k]).
        """
        if self._compensated:
            self._base[rows] = before._base[rows]
            self._possible[rows] = before._possible[rows]

    def own_noise(self, noise_units: Floats) -> Floats:
        """Return the noise float64[k, 12] of the words, given that of the bytes (standard
        deviations).
        """
        taken = self._gain * noise_units[:, THERMAL_TAXEL, None]
        # The difference of two estimates may have any value where much was subtracted.
        own: Floats = np.sqrt(np.maximum(noise_units**2 - taken**2, noise_units**2 / 4))
        return own

    def room_units(self, noise_units: Floats) -> tuple[Floats, Floats]:
        """Return within which limits float64[k, 12] a pad may move and still repeat, in units,
        while it is warmer than when it was zeroed, and colder: 1 without compensation.

        Args:
            noise_units: float64[k, 12], of the bytes.
        """
        if not self._compensated:
            return np.ones(self._gain.shape), np.ones(self._gain.shape)
        # While the temperature pad sends one byte, whole bytes of another have a word in common.
        rests = ~self.dithered(noise_units)
        warm, cold = (np.where(rests, np.ceil(room), room) for room in self._room_units)
        return warm, cold

    def dithered(self, noise_units: Floats) -> Mask:
        """Return pads, bool[k, 12], that the noise of a temperature pad moves against the edges of
        their bytes, given the noise of the bytes: no place keeps such a pad for longer.
        """
        lively: Mask = self.shifted & (noise_units[:, THERMAL_TAXEL, None] >= LIVELY_UNITS)
        return lively

    def is_cold(self, raw: NDArray[np.uint8]) -> Mask | None:
        """Return which compensated triangles, bool[k], are colder than when they were zeroed; None
        if none is.
        """
        if not self._compensated:
            return None
        cold: Mask = raw[:, THERMAL_TAXEL] > self._no_load
        return cold if any_of(cold) else None

    def step(
        self, raw: NDArray[np.uint8], changed: Mask, within: Mask | None
    ) -> tuple[Mask, Mask | None]:
        """Take one sweep.

        Args:
            raw: uint8[k, 12].
            changed: bool[k, 12], bytes that differ from those before.
            within: bool[k, 12], bytes that were, now and before, within their scale; None if all.

        Returns:
            moved: bool[k, 12], no word explains this byte and all those since the last move; the
                array is reused.
            decidable: bool[k, 12], whether the byte could show a move; None if all could.
        """
        if not self._compensated:
            return changed, within
        row = self._kind + raw[:, THERMAL_TAXEL]
        told = within
        if within is not None:
            tells = self._tells.take(row)
            told = within if all_of(tells) else within & tells[:, None]
        lowest, up, left = self._lowered, self._up, self._left
        words, possible = self._words, self._possible
        self._lowest.take(row, 0, lowest, "clip")
        self._pattern.take(row, 0, words, "clip")
        np.copyto(up, raw)
        np.multiply(up, self._cells, out=up)
        np.subtract(lowest, up, out=lowest)
        if told is not None:
            untold = ~told
            np.putmask(lowest, untold, self._base)
            np.putmask(words, untold, self._all_bits)
        # Bits are moved down or up by the way of the lowest word; numpy moves all of them out by as
        # many as there are and more.
        np.subtract(self._base, lowest, out=up)
        np.maximum(up, self._zeros, out=left)
        np.left_shift(possible, left.view(self._of_bits), out=possible)
        np.subtract(left, up, out=left)
        np.right_shift(possible, left.view(self._of_bits), out=possible)
        np.bitwise_and(possible, words, out=possible)
        moved = np.equal(possible, self._none, out=self._moved)
        if told is not None:
            moved &= told
        # No branch that guesses wrong at every other pad, as in a copy with a mask: where it moved,
        # no bit is left.
        np.multiply(words, moved, out=words)
        np.bitwise_or(possible, words, out=possible)
        self._base, self._lowered = lowest, self._base
        if self._any_plain:
            moved[self._plain] = changed[self._plain]
        return moved, told


def _span(rows: NDArray[np.intp]) -> "Rows":
    """Return rising numbers of rows, as a slice where they are successive."""
    if len(rows) and rows[-1] - rows[0] == len(rows) - 1:
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows


def _words(
    gain: tuple[int, ...], shift: int, no_load: int, truncates: bool
) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
    """Return which words a byte may stand for, given the byte of the temperature pad.

    Returns:
        lowest: int64[256, 12], the lowest word, less the byte's own share of it.
        pattern: uint64[256, 12], bit i: the lowest plus i is one of them.
    """
    cell = np.arange(1 << shift, dtype=np.int32)
    change = ((no_load - np.arange(256, dtype=np.int32)) << shift)[:, None] + cell
    drift = drift_of(change.ravel(), gain, truncates=truncates).reshape(256, len(cell), -1)
    lowest = drift.min(axis=1).astype(np.int64)
    block = np.uint64((1 << len(cell)) - 1)
    patterns = block << (drift - lowest[:, None]).astype(np.uint64)
    return (no_load << shift) + lowest, np.bitwise_or.reduce(patterns, axis=1)


def _most_bits(patterns: NDArray[np.uint64]) -> list[int]:
    """Return how many bits the longest pattern of each pad has, of [256, 12]."""
    return [int(of_pad.max()).bit_length() for of_pad in patterns.T]


#: Triangles: all, or their numbers.
Rows = slice | NDArray[np.intp]

#: A run with a probability below 1/odds is not chance. 2000 taxels at 20 Hz begin some 10^11 runs a
#: year.
ODDS = 1e11
#: A run has begun after this many repeats.
BEGUN = 2
#: Moves are counted over about this time, in steps of about this many samples.
MEMORY_S = 300.0
STEP_SAMPLES = 20
#: A calibration counts as this many samples of runs that have begun.
CALIBRATED_SAMPLES = 100
#: The assumed share of samples in which a pad moves is at most this, and its noise at least this.
MOST_RATE = 0.8
LEAST_NOISE_UNITS = 0.1
#: A temperature pad whose bytes have less noise may rest in one byte sooner or later, at whose edge
#: it was calibrated.
LIVELY_UNITS = 0.54
#: A quiet pad at the edge between two bytes moves often until it drifts away from there. Its rate
#: is assumed to be at most this multiple of that of a pad in the middle of a byte.
RESTING_MARGIN = 1.25
#: While something else is touched, this many repeats count as one.
TOUCHED_PACE = 6
#: After this many moves a stuck pad is valid again.
PROBATION_MOVES = 3
#: A step is small up to this: one bit of eight makes a damaged byte such a step. Where boards
#: compensate, bytes move by that, too: up to this multiple of the calibrated noise.
SMALL_UNITS = 1.0
SMALL_SIGMAS = 3.0
LONGEST_RUN = 1e6
NEWTON_STEPS = 8
#: A step that is shorter ends them.
CLOSE_SAMPLES = 1e-6


class TouchedPads(NamedTuple):
    """Consequences of which pads are touched.

    Attributes:
        key: the touched pads, as bytes.
        calm: bool[k], triangles of boards on which nothing is touched.
        elsewhere: bool[k], triangles of boards on which another triangle is touched.
        calm_pads: bool[k, 1], the same as `calm`.
        weight: float64[k, 12], what a repeat of a pad counts.
    """

    key: bytes
    calm: Mask
    elsewhere: Mask
    calm_pads: Mask
    weight: Floats

    @classmethod
    def of(cls, touched: Mask, key: bytes, boards: int) -> "TouchedPads":
        of_triangles = count_of(touched).reshape(boards, -1)
        of_boards = np.add.reduce(of_triangles, axis=1, keepdims=True)
        triangles = of_triangles.shape[1]
        of_board = of_boards.repeat(triangles)
        calm = of_board == 0
        # A touch that only the pad itself feels does not count: the pad may be stuck there.
        slow = of_board[:, None] > touched
        weight = np.where(slow, 1.0 / TOUCHED_PACE, 1.0)
        # A chip that died can look touched itself; only a touch on other triangles counts.
        elsewhere = (of_boards > of_triangles).ravel()
        return cls(key, calm, elsewhere, calm[:, None], weight)


class StuckPads:
    """Watches the pads of the k triangles of some boards, equally many of each.

    Args:
        noise_units: float64[k, 12], calibrated noise of the bytes.
        share: float64[k], how many of the samples are new conversions, 0 to 1.
        period_s: float64[k], how often the board of each triangle sends.
        repeats: finds which pads send something new.
        boards: how many boards.
        fitted: bool[k], triangles that there are, all by default.

    Attributes:
        stuck: bool[k, 12].
        any_stuck: whether any is.
        longest: float64[k, 12], repeats in a row that chance allows now.
    """

    def __init__(
        self,
        noise_units: Floats,
        share: Floats,
        period_s: Floats,
        repeats: Repeats,
        boards: int,
        fitted: Mask | None = None,
    ) -> None:
        shape = noise_units.shape
        share, period_s = share[:, None], period_s[:, None]
        self._repeats = repeats
        self._boards = boards
        self._unfitted = None if fitted is None or all_of(fitted) else np.flatnonzero(~fitted)
        begun = np.ceil(BEGUN / share)
        self._begun: Floats = begun.ravel()[:1] if (begun == begun[0]).all() else begun
        if len(self._begun) > 1:
            self._begun = np.broadcast_to(begun, shape).copy()
        self._before = self._begun - 1.0
        self._forget = STEP_SAMPLES * period_s / MEMORY_S
        own_units = repeats.own_noise(noise_units)
        warm, cold = (rate_in_run(own_units, room) for room in repeats.room_units(noise_units))
        #: What a repeat shows of a pad that is colder than when it was zeroed, as a share of what
        #: it does of a warmer one.
        self._cold_weight = np.ones(shape)
        np.divide(np.log1p(-cold), np.log1p(-warm), self._cold_weight, where=cold < warm)
        resting = share * warm
        most = np.where(repeats.dithered(noise_units), MOST_RATE, RESTING_MARGIN * resting)
        self._most = np.minimum(most, MOST_RATE)
        self._seen = np.full(shape, float(CALIBRATED_SAMPLES))
        self._moved = resting * CALIBRATED_SAMPLES
        self._run = np.zeros(shape)
        #: No run is too long before so many more steps.
        self._slack = 0
        self._to_show = np.zeros(shape, np.int64)
        #: Runs that have ended since rates were learnt; those of a stuck pad since it stuck.
        self._new_seen = np.zeros(shape)
        self._new_moved = np.zeros(shape, np.int8)
        compensated = repeats.compensated.any(axis=1, keepdims=True)
        self._small = np.maximum(SMALL_UNITS, SMALL_SIGMAS * noise_units * compensated)
        # While any pad is stuck: the bytes of the last two sweeps, and which pads went anywhere, or
        # far, in the last.
        self._last, self._earlier = np.zeros(shape, np.int16), np.zeros(shape, np.int16)
        self._went, self._went_far = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
        #: Samples of each board, less those of all boards.
        self._samples = np.zeros(boards, np.int64)
        self._common_samples = 0
        #: No board has enough samples before so many more steps.
        self._until_learning = STEP_SAMPLES
        self._ended, self._stays = (np.zeros(shape, np.bool_) for _ in range(2))
        self._gained = np.zeros(shape)
        self.stuck: Mask = np.zeros(shape, np.bool_)
        self.any_stuck = False
        self.longest = np.zeros(shape)
        self._renew_limits(slice(None))

    def step(
        self,
        raw: NDArray[np.uint8],
        changed: Mask,
        within: Mask | None,
        unproven: Mask,
        felt: TouchedPads | None = None,
        came: Mask | None = None,
    ) -> None:
        """Take one sweep of some boards.

        Args:
            raw: uint8[k, 12].
            changed: bool[k, 12], bytes that differ from those before.
            within: bool[k, 12], bytes of triangles that were received now and before, see `inside`;
                None if all were.
            unproven: bool[k], triangles that are not valid as a whole.
            felt: which pads are touched, if any is.
            came: bool[boards], boards whose sweep this is, all by default.
        """
        moved, told = self._repeats.step(raw, changed, within)
        run = self._run
        # A run counts when it ends: a run without an end may not be chance.
        ended = np.greater_equal(run, self._begun, out=self._ended)
        ended &= moved
        if felt is not None:
            ended &= felt.calm_pads
        if any_of(ended):
            gained = np.subtract(run, self._before, out=self._gained)
            if self.any_stuck:
                np.minimum(gained, self.longest, out=gained)
            gained *= ended
            self._new_seen += gained
            self._new_moved += ended.view(np.int8)
        weight = 1.0 if felt is None else felt.weight
        cold = self._repeats.is_cold(raw)
        if cold is not None:
            weight = np.where(cold[:, None], weight * self._cold_weight, weight)
        run += weight if told is None else told * weight
        run *= np.logical_not(moved, out=self._stays)
        if came is None:
            self._common_samples += 1
        else:
            self._samples += came
        self._until_learning -= 1
        if self._until_learning <= 0:
            self.settle()
            if int(np.maximum.reduce(self._samples)) >= STEP_SAMPLES:
                self._learn(unproven)
            self._until_learning = STEP_SAMPLES - int(np.maximum.reduce(self._samples))
        self._slack -= 1
        if self._slack >= 0 and not self.any_stuck:
            return
        too_long = run > self.longest
        if not self.any_stuck and not any_of(too_long):
            # Each step lengthens a run by one at most.
            self._slack = int(min(float(np.min(self.longest - run)), LONGEST_RUN))
            return
        run[unproven] = 0.0
        too_long &= run > 0.0
        if self.any_stuck:
            self._note_life(raw, moved, told)
        else:
            self._last[:] = self._earlier[:] = raw
            self._went[:] = self._went_far[:] = False
        self._to_show[too_long & ~self.stuck] = PROBATION_MOVES
        self.stuck = self._to_show > 0
        self.any_stuck = any_of(self.stuck)

    def keep_stuck(self, before: "StuckPads") -> None:
        """Go on to watch the pads that a predecessor found stuck: they send what they sent."""
        np.maximum(self._to_show, before._to_show, out=self._to_show)
        self._last, self._earlier = before._last, before._earlier
        self._went, self._went_far = before._went, before._went_far
        self.stuck = self._to_show > 0
        self.any_stuck = any_of(self.stuck)

    def expect_stuck(self, pads: Mask) -> None:
        """Some pads, bool[k, 12], were stuck before a restart: they are until they show life."""
        # The first byte of a pad is compared with none, so that the second looks like a move.
        self._to_show[pads] = PROBATION_MOVES + 1
        self.stuck = self._to_show > 0
        self.any_stuck = any_of(self.stuck)

    @property
    def steps_without_decision(self) -> int:
        """Return in how many more steps no pad can become stuck, and no rate is learnt."""
        return 0 if self.any_stuck else min(self._slack, self._until_learning - 1)

    def settle(self) -> None:
        """Bring the arrays of state up to date."""
        if self._common_samples:
            self._samples += self._common_samples
            self._common_samples = 0
        self._until_learning = 0
        self._slack = 0

    def _note_life(self, raw: NDArray[np.uint8], moved: Mask, told: Mask | None) -> None:
        """Count the moves by which stuck pads show that they live.

        There and back again in two sweeps is one move if it is small, and none otherwise: a damaged
        byte is such a step, and then all moves until then are in doubt.
        """
        here = np.broadcast_to(True, moved.shape) if told is None else told
        shifts = self._repeats.compensated
        far = np.abs(raw - self._last) > self._small
        # What its board takes off a pad is as wrong as the byte of the temperature pad.
        far |= shifts & far[:, THERMAL_TAXEL, None]
        off = np.abs(raw - self._earlier)
        # The byte of a word that is back may be one beside it.
        back = self._went_far & (off <= shifts) | self._went & (off == 0) & ~shifts
        went = moved & ~back
        for lives in (self._went_far & ~back, went & ~far):
            self._to_show -= here & lives & (self._to_show > 0)
        damaged = here & self._went_far & back & self.stuck
        self._to_show[damaged] = PROBATION_MOVES
        self._new_seen[damaged] = 0.0
        self._new_moved[damaged] = 0
        for array, value in (
            (self._earlier, self._last),
            (self._last, raw),
            (self._went, went),
            (self._went_far, went & far),
        ):
            np.copyto(array, value, where=here)

    def _learn(self, unproven: Mask) -> None:
        """Update the rates of boards with enough samples, for pads that work."""
        enough = self._samples >= STEP_SAMPLES
        rows: Rows = slice(None)
        if not enough.all():
            rows = np.flatnonzero(np.repeat(enough, len(unproven) // self._boards))
        stuck, doubted = self.stuck[rows], unproven[rows, None]
        lives = ~stuck & ~doubted
        # A run that goes on replaces nothing: without an end it would always be allowed for longer.
        learns = lives & (self._new_seen[rows] > 0.0)
        keep = np.where(learns, 1.0 - self._forget[rows], 1.0)
        self._seen[rows] = self._seen[rows] * keep + np.where(lives, self._new_seen[rows], 0.0)
        self._moved[rows] = self._moved[rows] * keep + np.where(lives, self._new_moved[rows], 0)
        # What a stuck pad shows counts once it lives.
        waits = stuck & ~doubted
        self._new_seen[rows] *= waits
        self._new_moved[rows] *= waits
        self._samples[enough] = 0
        self._renew_limits(rows)

    def _renew_limits(self, rows: Rows) -> None:
        seen = self._seen[rows]
        rate = np.minimum(self._moved[rows] / np.maximum(seen, 1.0), self._most[rows])
        begun = self._begun if len(self._begun) == 1 else self._begun[rows]
        self.longest[rows] = begun + longest_run(rate, seen, ODDS)
        if self._unfitted is not None:
            self.longest[self._unfitted] = np.inf


def rate_in_run(noise_units: Floats, room_units: Floats | float = 1.0) -> Floats:
    """Return how often a pad leaves the byte in which it rests, given the noise of its bytes
    (units), or the room that it has where one word explains several bytes.

    For a normal distribution in the middle of it, 1 - erf(room / (2 sqrt(2) sigma)): no place
    keeps a pad for longer. Rounding has added 1/12 to the variance.
    """
    sigma = np.sqrt(np.maximum(noise_units**2 - 1.0 / 12.0, LEAST_NOISE_UNITS**2))
    width = 0.5 * room_units / math.sqrt(2.0) / sigma
    return np.array([1.0 - math.erf(one) for one in width.ravel()]).reshape(width.shape)


def longest_run(rate: Floats, samples: Floats | float, odds: float) -> Floats:
    """Return how many samples without a change are less probable than 1/odds.

    Args:
        rate: share of samples with a change.
        samples: number of samples in which it was seen.
        odds: of the run.

    The sum of ln((n + i) / (n - c + i)) over a run is taken as its integral, which is concave in
    the
    run: Newton's method from 0 approaches the root and never exceeds it, exact for runs below 1000
    and to 1 % for the longest. A rate of 0 allows a run without end.
    """
    still = np.maximum((1.0 - rate) * samples, 0.5)
    n = np.maximum(samples, still)
    wanted = math.log(odds)
    first = np.log(n / still)
    # The first step, from 0, where the other logarithms are 0.
    run = np.minimum(wanted / np.maximum(first, wanted / LONGEST_RUN), LONGEST_RUN)
    for _ in range(NEWTON_STEPS - 1):
        of_all, of_still = np.log1p(run / n), np.log1p(run / still)
        slope = first + of_all - of_still
        told = n * of_all - still * of_still + run * slope
        step = (wanted - told) / np.maximum(slope, wanted / LONGEST_RUN)
        run += step
        np.minimum(run, LONGEST_RUN, out=run)
        if float(np.max(step)) < CLOSE_SAMPLES:
            break
    return run


def inside(raw: NDArray[np.uint8]) -> Mask:
    """Return bytes that are not at an end of the scale: at an end, a pad's moves do not show."""
    mask: Mask = raw - np.uint8(1) < np.uint8(254)  # 0 wraps to 255
    return mask
