"""Detects pads that repeat: a byte has no new information if the same word of its chip explains it.

Without temperature compensation that is the same byte as before. With it the board subtracts the
noise of a temperature pad from every byte, so that the bytes of a stuck pad keep changing. But the
temperature pad's own byte shows what was subtracted, up to its rounding: each byte gives bounds of
the chip's word, and a run of bytes is a repetition as long as one word lies in all of them. The
temperature pad's noise even helps: words that shift against the bytes' edges leave a working pad
less room than a byte does.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.compensation import NO_GAIN, THERMAL_TAXEL, drift_of

Mask = NDArray[np.bool_]
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
        self._plain = np.flatnonzero(plain)
        self._compensated = not all(plain)
        if not self._compensated:
            return
        encodings = [
            Encoding(NO_GAIN, 0, 0, False) if of_bytes else one
            for one, of_bytes in zip(encodings, plain, strict=True)
        ]
        kinds = sorted(set(encodings))
        tables = [_words(*kind) for kind in kinds]
        self._lowest = np.concatenate([lowest for lowest, _ in tables])
        self._pattern = np.concatenate([pattern for _, pattern in tables])
        # At an end of its scale the temperature pad does not show what was subtracted.
        scale = np.arange(256)
        self._tells = np.tile((scale > 0) & (scale < 255), len(kinds))[:, None]
        self._kind = np.array([256 * kinds.index(one) for one in encodings])
        self._shift = np.array([one.shift for one in encodings], np.int64)[:, None]
        self._base = np.zeros(self._gain.shape, np.int64)
        self._possible = np.zeros(self._gain.shape, np.uint64)

    @property
    def shifted(self) -> Mask:
        """Return pads whose words compensation moves against the edges of their bytes, bool[k,
        12].
        """
        shifted = self._gain > 0.0
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

    def step(self, raw: NDArray[np.uint8], changed: Mask, within: Mask) -> tuple[Mask, Mask]:
        """Take one sweep.

        Args:
            raw: uint8[k, 12].
            changed: bool[k, 12], bytes that differ from those before.
            within: bool[k, 12], bytes that were, now and before, within their scale.

        Returns:
            moved: bool[k, 12], no word explains this byte and all those since the last move.
            decidable: bool[k, 12], whether the byte could show a move.
        """
        if not self._compensated:
            return changed, within
        row = self._kind + raw[:, THERMAL_TAXEL]
        told = within & self._tells[row]
        base = self._lowest[row] - (raw << self._shift)
        words = self._pattern[row]
        up = np.minimum(np.maximum(base - self._base, -63), 63)
        shifted = words << np.maximum(up, 0).view(np.uint64)
        shifted >>= np.maximum(-up, 0).view(np.uint64)
        np.bitwise_and(self._possible, shifted, out=self._possible, where=told)
        moved: Mask = (self._possible == 0) & told
        np.copyto(self._base, base, where=moved)
        np.copyto(self._possible, words, where=moved)
        if len(self._plain):
            moved[self._plain] = changed[self._plain]
            told[self._plain] = within[self._plain]
        return moved, told


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
