"""Noise of pads as it is on real skin: its spread from pad to pad, and what pads pick up.

Measured on untouched insoles of triangles of ten pads (Belli et al., Sensors 2023, 23(9), 4501:
the first 5 s of `left_calibration`; units as they are sent):

- The standard deviation of what is sent is 0.69, 0.82, 1.04, 1.41 and 5.3 units for 5, 25, 50,
  75 and 95 % of the pads, and white: one conversion has nothing in common with the next.
- A third of the triangles have pads that pick up something periodic, which each conversion
  catches at another phase (kurtosis 1.5, as of a sine's values; a normal variable has 3). Such
  a pad jumps between levels 10 to 15 units apart. They are one in twenty; one in ten less so.
- Fingertips have none of these: the standard deviation of 60 untouched pads of an iCub's five is
  0.2 to 1.8 units (the first 6 s of the iCub Grasp Dataset; Soh, Su and Demiris, IROS 2012).
- What the pads of a triangle have in common goes with the gains of the boards' temperature
  compensation (skin type 0: correlation of the covariances 0.6 to 0.7, without gains 0.4): it
  is the noise of the thermal pad, 0.70 units. Triangles share nothing (0.0002 units^2).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from emulator.chips import ad7147_map as reg
from skin_host.bus.compensation import GAIN

TAXELS = 12
#: One unit of boards at shift 2, as nearly all robots have them (fF).
SENT_UNIT_FF = 1.44

#: Shares of the pads, and rms of the normal part of what they pick up, up to there (units).
#: The ends lie closer together than measured: five seconds spread what they find.
_STEADY = ((0.0, 0.05, 0.25, 0.5, 0.75, 0.92, 1.0), (0.5, 0.57, 0.67, 0.81, 1.04, 1.45, 1.7))
#: The same of the periodic part, of disturbed pads.
_WAVE = ((0.0, 0.33, 0.5, 0.58, 1.0), (1.7, 2.4, 3.6, 5.0, 6.0))
DISTURBED_TRIANGLES = 0.37
DISTURBED_PADS = 0.43
#: rms of thermal pads, least and most (units). They are small, and none is disturbed.
THERMAL_UNITS = (0.5, 0.9)

#: Draws in the tables that all chips share.
DRAWS = 1 << 18
_STAGES = np.arange(TAXELS)
#: For each number of stages that a pass has reached: which stages are of the one before.
_IS_BEFORE = np.arange(TAXELS + 1)[:, None] <= _STAGES

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PadNoise:
    """Noise of the pads of k triangles, float64[k, 12] each.

    Attributes:
        rms_units: what a pad picks up.
        wave: share of it that is periodic; the rest is normal. Their squares add up to 1.
    """

    rms_units: Floats
    wave: Floats

    @classmethod
    def drawn(cls, thermal: Mask, rng: np.random.Generator, calm: Mask | None = None) -> "PadNoise":
        """Pads as different as real ones are.

        Args:
            thermal: bool[k, 12], the temperature pads.
            rng: for chance.
            calm: bool[k], triangles without pads that pick up something periodic; none by default.
        """
        shape = thermal.shape
        steady = np.interp(rng.random(shape), *_STEADY)
        steady = np.where(thermal, rng.uniform(*THERMAL_UNITS, shape), steady)
        disturbed = rng.random((len(thermal), 1)) < DISTURBED_TRIANGLES
        disturbed = disturbed & (rng.random(shape) < DISTURBED_PADS) & ~thermal
        if calm is not None:
            disturbed &= ~calm[:, None]
        wave = np.where(disturbed, np.interp(rng.random(shape), *_WAVE), 0.0)
        rms = np.hypot(steady, wave)
        return cls(rms, wave / rms)

    @classmethod
    def normal(cls, triangles: int) -> "PadNoise":
        """Normal noise; its strength is set elsewhere."""
        return cls(np.zeros((triangles, TAXELS)), np.zeros((triangles, TAXELS)))

    def of(self, triangles: Ints | slice) -> "PadNoise":
        """Return the noise of some triangles only."""
        return PadNoise(self.rms_units[triangles], self.wave[triangles])

    def variates(self, shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
        """So many conversions of all pads, float64[*shape, k, 12], in units of each pad's rms."""
        shape = (*shape, *self.wave.shape)
        noise: Floats = rng.standard_normal(shape)
        if self.wave.any():
            noise *= np.sqrt(1 - self.wave**2)
            noise += np.sqrt(2.0) * self.wave * np.cos(2 * np.pi * rng.random(shape))
        return noise


class ChipNoise:
    """The noise of the conversions of some chips, each with a draw of its own.

    A draw depends on the chip and on the time at which its pass over the stages began, and on
    no other input: however often results are read, and at either fidelity, they are the same.

    Args:
        keys: of the n chips; any numbers that differ.
        noise: of their triangles; normal without one.
    """

    def __init__(self, keys: Ints, noise: PadNoise | None = None) -> None:
        self._keys = keys
        self._pads = noise or PadNoise.normal(len(keys))
        self._normal = np.sqrt(1 - self._pads.wave**2)
        self._has_wave = bool(self._pads.wave.any())

    @classmethod
    def of_chip(cls, rng: np.random.Generator, noise: PadNoise | None = None) -> "ChipNoise":
        """The noise of one chip, number 0."""
        return cls(rng.integers(1 << 62, size=1), noise)

    def one(self, chip: int) -> "ChipNoise":
        """Return the noise of one of the chips, as number 0."""
        alone = slice(chip, chip + 1)
        return ChipNoise(self._keys[alone], self._pads.of(alone))

    def at(self, chips: Ints | slice, began_ns: NDArray[np.int64]) -> Floats:
        """The draws of the passes that began then, float64[k, 12], of unit variance.

        Args:
            chips: which ones, intp[k].
            began_ns: int64[k, 12], when the pass began in which each stage was converted.
        """
        keys = self._keys[chips][:, None]
        # Nearly always two passes have all stages: the one that goes on, and the one before.
        ends_ns = began_ns[:, :: TAXELS - 1]
        first = began_ns == ends_ns[:, :1]
        if (first | (began_ns == ends_ns[:, 1:])).all():
            ends = _mixed((keys + ends_ns).astype(np.uint64))
            mixed = np.where(first, ends[:, :1], ends[:, 1:])
        else:
            mixed = _mixed((keys + began_ns).astype(np.uint64))
        return self._drawn(chips, mixed)

    def in_step(
        self, chips: Ints | slice, began_ns: NDArray[np.int64], stages: Sequence[int]
    ) -> Floats:
        """The same at m times, for chips whose passes begin at the same times: float64[m, k, 12].

        Args:
            chips: which ones, intp[k].
            began_ns: int64[m, 2], when the pass began that goes on, and the one before.
            stages: [m], how many stages the first of them has converted.
        """
        passes = _mixed((self._keys[chips][:, None] + began_ns[:, None]).astype(np.uint64))
        is_before = _IS_BEFORE[list(stages)][:, None]
        return self._drawn(chips, np.where(is_before, passes[:, :, 1:], passes[:, :, :1]))

    def _drawn(self, chips: Ints | slice, mixed: NDArray[np.uint64]) -> Floats:
        """The draws of stages whose passes have these numbers, [..., k, 12]."""
        normals, waves = _tables()
        noise: Floats = normals[_normal_at(mixed) + _STAGES]
        if self._has_wave:
            noise *= self._normal[chips]
            noise += self._pads.wave[chips] * waves[_wave_at(mixed) + _STAGES]
        return noise


def _normal_at(mixed: NDArray[np.uint64]) -> Ints:
    """Where in the normal table a pass begins."""
    return (mixed & np.uint64(DRAWS - 1)).astype(np.intp)


def _wave_at(mixed: NDArray[np.uint64]) -> Ints:
    """Where in the table of the wave."""
    return (mixed >> np.uint64(40)).astype(np.intp) & (DRAWS - 1)


@cache
def _tables() -> tuple[Floats, Floats]:
    """Normal draws and those of a wave at random phases, long enough for a pass from any start."""
    rng = np.random.default_rng(7147)
    normals = rng.standard_normal(DRAWS + TAXELS)
    return normals, np.sqrt(2.0) * np.cos(2 * np.pi * rng.random(DRAWS + TAXELS))


def _mixed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Scatter numbers over 64 bits (the finaliser of SplitMix64)."""
    numbers = numbers * np.uint64(0x9E3779B97F4A7C15)
    numbers = (numbers ^ numbers >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    numbers = (numbers ^ numbers >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    return numbers ^ numbers >> np.uint64(31)


class SampledNoise:
    """Noise of untouched pads as boards send it, before it is rounded: for tests without boards.

    A conversion is sent until the next one has ended, and chips convert on their own clocks:
    each triangle's conversions end at times of their own. The boards take the noise of a
    thermal pad off the others, by the gains of skin type 0.

    Args:
        triangles: k, of twelve pads.
        seed: of pads, phases and noise.
        conversion_s: of twelve pads: 36.9 ms at decimation 256, 18.4 at 128, 9.2 at 64.

    Attributes:
        noise: of the pads.
    """

    def __init__(
        self,
        triangles: int,
        seed: int = 0,
        *,
        conversion_s: float = reg.N_STAGES * reg.STAGE_NS[0] * 1e-9,
    ) -> None:
        self._rng = np.random.default_rng([seed, 7])
        self.noise = PadNoise.drawn(np.zeros((triangles, TAXELS), bool), self._rng)
        thermal_units = self._rng.uniform(*THERMAL_UNITS, (triangles, 1))
        self._shared_units = thermal_units * np.array(GAIN) / 128
        self._conversion_ns = round(conversion_s * 1e9)
        self._ahead_ns = self._rng.integers(0, self._conversion_ns, triangles)
        self._converted = np.full(triangles, -1, np.int64)
        self._units = np.zeros((triangles, TAXELS))

    def at(self, t_ns: int) -> Floats:
        """Noise of all pads at a time that is not before the last one, float64[12 k] (units)."""
        converted = (t_ns + self._ahead_ns) // self._conversion_ns
        new = np.flatnonzero(converted != self._converted)
        self._converted = converted
        noise = self.noise.of(new)
        own_units = noise.rms_units * noise.variates((), self._rng)
        shared = self._rng.standard_normal((len(new), 1))
        self._units[new] = own_units - self._shared_units[new] * shared
        units: Floats = self._units.flatten()
        return units
