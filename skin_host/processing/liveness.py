"""Is a triangle that sends still alive, and is a taxel that reads still a sensor?

A chip that died can go on sending for ever: after it, the board's firmware sends one
constant value with no error in its status word (reference of the wire, section 4.5). What
tells it from an untouched triangle is noise. The least noise of a working pad moves its
byte now and then, twelve pads move some byte nearly every time, and a byte that repeats for
so long that chance does not explain it comes from no sensor.

How often a byte moves is known from the calibration and followed afterwards, because it
depends on where between two bytes the reading lies: a warm hour moves a lively taxel into
the quiet middle of a byte. The question is then one of odds. After c changes in n samples
a run of k without one has the probability B(c, n - c + k) / B(c, n - c), the beta-binomial
of Bayes' rule, which is (1 - c/n)^k where n is large. At odds of one in `TRIANGLE_ODDS`
nobody believes in the run any more. A quiet triangle is given longer than a noisy one, by
just so much.

What holds still may have a reason. While an iCub's hand holds an object its bytes repeat much
longer than those of the open hand (the IROS 2012 recordings: some pads for 44 sweeps, a whole
fingertip for 19), so repeats count for less while the board feels a touch.

Single pads are judged in `stuck`.

Only conversions count: a chip needs 36.9 ms for its twelve stages (AD7147, decimation 256),
and a board that sends more often repeats itself.
"""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.protocol.compensation import NO_GAIN
from skin_host.processing.masks import Mask, any_of
from skin_host.processing.repeats import Repeats
from skin_host.processing.stuck import (
    MOST_RATE,
    TOUCHED_PACE,
    StuckPads,
    inside,
    longest_run,
)

Floats = NDArray[np.float64]

PADS = 12

CONVERSION_S = 0.0369
#: A run of repeats with a probability below 1/odds is not chance.
TRIANGLE_ODDS = 1e9
#: However lively it was, a triangle is not given up in less than nine conversions (0.45 s at
#: 20 Hz).
MOST_TRIANGLE_RATE = 0.9
#: A triangle that the calibration saw move at all is expected to move so often at least.
LEAST_TRIANGLE_RATE = 0.02
#: Rates follow what is seen over about this time, in steps of about this many samples.
RATE_MEMORY_S = 10.0
#: So much of it a calibration is taken for.
CALIBRATED_S = 5.0
RATE_SAMPLES = 20
#: So many changes make what was frozen, or had an error, believable again.
PROBATION_CHANGES = 3
#: Without a calibration, pads are taken to have this much noise (units).
USUAL_NOISE_UNITS = 0.5
#: A byte jumps when it goes up and down by more than this many units, and more than so many
#: times the noise that was calibrated.
NOISY_UNITS = 3.0
NOISY_SIGMAS = 5.0
#: A taxel is noisy when its jumps, as multiples of that and at most so large, are this in the
#: mean over all samples; and calm again below that. Large ones are rarer by chance than many.
MOST_JUMP = 2.0
NOISY_MEAN = 0.4
CALM_MEAN = 0.1
NOISE_MEMORY_SAMPLES = 8
#: A spike is one sweep off by more than this many units, and so many times the noise.
SPIKE_UNITS = 7.0
SPIKE_SIGMAS = 8.0


def change_rate(noise_units: Floats) -> Floats:
    """How often successive bytes differ, given their standard deviation in units.

    Up to half a unit the byte has two values and differs in 2 variance of all cases; above,
    the collision probability of a normal distribution is 1 / (2 sqrt(pi) sigma).
    """
    above = 1.0 - 1.0 / (2.0 * math.sqrt(math.pi) * np.maximum(noise_units, 0.5))
    rate: Floats = np.where(noise_units <= 0.5, 2.0 * noise_units**2, np.maximum(above, 0.5))
    return rate


class Liveness:
    """Watches the bytes of the k triangles of one board, 12 pads each.

    Args:
        k: triangles of the board.
        noise_units: float64[k, 12], calibrated noise, or None where nothing is calibrated.
            All zeros in a triangle mean that it was constant already when calibrated: it
            has to prove itself first.
        period_s: how often the board sends.
        repeats: tells which pads say something new; without it, those whose byte changes.

    Attributes:
        frozen: bool[k], triangles that repeat themselves beyond chance.
        unproven: bool[k], triangles that had an error, or were frozen, and have not shown
            since that they live.
        noisy: bool[k, 12], pads that jump up and down much more than when calibrated.
        doubted: bool[k, 12], pads that are not to be believed, or None if all are.
        spikes: how often a single pad of a triangle was off for one sweep and back in the
            next: no sensor does that, a damaged frame does.
    """

    def __init__(
        self,
        k: int,
        noise_units: Floats | None,
        period_s: float,
        repeats: Repeats | None = None,
    ) -> None:
        shape = (k, PADS)
        repeats = repeats or Repeats([NO_GAIN] * k, [0] * k, 0, truncates=False)
        calibrated = noise_units is not None
        if noise_units is None:
            noise_units = np.full(shape, USUAL_NOISE_UNITS)
        self._share = min(1.0, period_s / CONVERSION_S)
        self._weight = min(1.0, RATE_SAMPLES * period_s / RATE_MEMORY_S)
        self._memory = RATE_MEMORY_S / max(period_s, CONVERSION_S)
        self._seen = CALIBRATED_S / max(period_s, CONVERSION_S)
        self._pads = StuckPads(noise_units, self._share, period_s, repeats)
        self._rate: Floats = np.minimum(change_rate(noise_units), MOST_RATE)
        self._triangle_rate: Floats = 1.0 - np.prod(1.0 - self._rate, axis=1)
        # What is too much noise nobody knows before the calibration.
        jump = np.maximum(NOISY_UNITS, NOISY_SIGMAS * noise_units)
        self._jump = jump if calibrated else np.full(shape, np.inf)
        self._spike = np.maximum(SPIKE_UNITS, SPIKE_SIGMAS * noise_units)
        constant = ~np.any(noise_units > 0.0, axis=1)

        self._raw = np.zeros(shape, np.uint8)
        self._present = np.zeros(k, np.bool_)
        self._step = np.zeros(shape, np.int16)
        self._jumping = np.zeros(shape)
        self._any_jumping = False
        self._surprise = np.zeros(k)
        self._changes = np.zeros(shape, np.int64)
        self._alive = np.zeros(k, np.int64)
        self._samples = np.zeros(k, np.int64)
        self._to_show = np.where(constant, PROBATION_CHANGES, 0)
        self.frozen: Mask = np.zeros(k, np.bool_)
        self.unproven: Mask = constant
        self._any_to_show = any_of(constant)
        self.noisy: Mask = np.zeros(shape, np.bool_)
        self.doubted: Mask | None = None
        self.spikes = 0
        self._renew_limits()
        self._doubt()

    @property
    def stuck(self) -> Mask:
        """bool[k, 12], single pads that repeat themselves in a living triangle."""
        return self._pads.stuck

    def step(
        self,
        raw: NDArray[np.uint8],
        present: Mask,
        erring: Mask,
        touched: Mask | None = None,
    ) -> None:
        """Take one sweep.

        Args:
            raw: uint8[k, 12], the bytes.
            present: bool[k], triangles that came, and without an error in their status.
            erring: bool[k], triangles whose status word has an error.
            touched: bool[k, 12], pads that were touched a moment ago, if any was.
        """
        compared = present & self._present
        changed = (raw != self._raw) & compared[:, None]
        self._note_jumps(raw, changed, compared)
        self._note_triangles(raw, changed, compared, erring, touched)
        self._pads.step(raw, changed, compared, self.unproven, touched)
        np.copyto(self._raw, raw, where=present[:, None])
        self._present = present.copy()
        if touched is None:
            self._samples += compared
            self._changes += changed
        if int(self._samples.max()) >= RATE_SAMPLES:
            self._learn()
        self._doubt()

    def _doubt(self) -> None:
        doubts = self._any_to_show or self._pads.any_stuck or any_of(self.noisy)
        self.doubted = self.unproven[:, None] | self.stuck | self.noisy if doubts else None

    def _note_triangles(
        self,
        raw: NDArray[np.uint8],
        changed: Mask,
        compared: Mask,
        erring: Mask,
        touched: Mask | None,
    ) -> None:
        alive = changed.any(axis=1)
        if touched is None:
            self._alive += alive
        all_alive = alive.tobytes() == compared.tobytes()
        if all_alive and not self._any_to_show and not any_of(erring):
            self._surprise[compared] = 0.0
            return
        expected = self._expected
        movable = inside(raw)
        if not movable.all():
            # What stands at an end of the scale cannot move, however well it is.
            most = (self._pad_expected * movable).sum(axis=1)
            expected = np.where(movable.any(axis=1), np.minimum(expected, most), 0.0)
        if touched is not None:
            # A chip that died can look touched itself; only what others feel excuses it.
            felt = np.count_nonzero(touched, axis=1)
            elsewhere = felt.sum() > felt
            expected = np.where(elsewhere, expected / TOUCHED_PACE, expected)
        self._surprise += np.where(compared, expected, 0.0)
        self._surprise[alive] = 0.0
        self._to_show -= alive & (self._to_show > 0)
        too_long = self._surprise > math.log(TRIANGLE_ODDS)
        self._to_show[too_long | erring] = PROBATION_CHANGES
        self._surprise[erring] = 0.0
        self.unproven = self._to_show > 0
        self._any_to_show = any_of(self.unproven)
        self.frozen = (too_long | self.frozen) & self.unproven & ~erring

    def _note_jumps(self, raw: NDArray[np.uint8], changed: Mask, compared: Mask) -> None:
        """A step up followed by a step down is noise; a touch goes one way at a time."""
        step = np.where(changed, np.subtract(raw, self._raw, dtype=np.int16), np.int16(0))
        far = np.abs(step) > self._jump
        if not self._any_jumping and not any_of(far):
            np.copyto(self._step, step, where=compared[:, None])
            return
        jump = far & (np.abs(self._step) > self._jump) & ((step ^ self._step) < 0)
        size = np.minimum(np.abs(step), np.abs(self._step))
        spike = jump & (size > self._spike)
        alone = np.count_nonzero(spike & (self._jumping < CALM_MEAN), axis=1) == 1
        self.spikes += int(np.count_nonzero(alone))
        np.copyto(self._step, step, where=compared[:, None])
        jumped = jump * np.minimum(size / self._jump, MOST_JUMP)
        self._jumping += compared[:, None] * (jumped - self._jumping) / NOISE_MEMORY_SAMPLES
        self._jumping[self._jumping < 1e-3] = 0.0
        self._any_jumping = any_of(self._jumping > 0.0)
        self.noisy = self._jumping > np.where(self.noisy, CALM_MEAN, NOISY_MEAN)

    def _learn(self) -> None:
        """Let the rates follow what was seen of those that live."""
        seen = np.maximum(self._samples, 1)
        weight = self._weight * (~self.unproven & (self._samples >= RATE_SAMPLES // 2))
        self._triangle_rate += weight * (self._alive / seen - self._triangle_rate)
        movable = ~self.stuck & inside(self._raw)
        self._rate += (weight[:, None] * movable) * (self._changes / seen[:, None] - self._rate)
        self._seen = min(self._seen + self._share * RATE_SAMPLES, self._memory)
        self._samples[:] = 0
        self._alive[:] = 0
        self._changes[:] = 0
        self._renew_limits()

    def _renew_limits(self) -> None:
        """How long a pad may repeat itself, and how much each repeat of a triangle tells."""
        self._pad_expected = -self._share * np.log1p(-np.minimum(self._rate, MOST_RATE))
        together = np.clip(self._triangle_rate, LEAST_TRIANGLE_RATE, MOST_TRIANGLE_RATE)
        run = longest_run(together, self._seen, TRIANGLE_ODDS)
        self._expected = self._share * math.log(TRIANGLE_ODDS) / run
