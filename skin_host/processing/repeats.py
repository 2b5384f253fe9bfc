"""Does a pad repeat itself? Bytes that one and the same word of its chip explains say nothing new.

Without temperature compensation that is: the same byte as before. With it the board takes
the noise of a thermal pad from every byte, so a pad that is stuck goes on moving. But the
thermal pad's own byte tells what was taken, up to its rounding: each byte gives bounds of
the chip's word, and a run of bytes is a repetition as long as one word lies in all of them.
The thermal pad's noise even helps: words that shift against the bytes' edges leave a working
pad less room than a byte does.
"""

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.protocol.compensation import THERMAL_TAXEL, drift_of

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


#: So many bits may be left out for the words that a byte stands for to fit into 64 bits.
MOST_SHIFT = 4


class Repeats:
    """Watches the words behind the bytes of the k triangles of one board.

    Args:
        gains: of each triangle, x128 per taxel, `compensation.thermal_gains`.
        shifts: of each triangle, bits that its bytes leave out.
        no_load: the byte of an untouched pad.
        truncates: how the board rounds, see `compensation.drift_of`.
    """

    def __init__(
        self, gains: list[tuple[int, ...]], shifts: list[int], no_load: int, *, truncates: bool
    ) -> None:
        self._gain = np.array(gains) / 128
        # Coarser bytes hide what compensation does to them.
        self._compensated = bool(self._gain.any()) and max(shifts) <= MOST_SHIFT
        if not self._compensated:
            return
        kinds = sorted(set(zip(gains, shifts, strict=True)))
        tables = [_words(gain, shift, no_load, truncates) for gain, shift in kinds]
        self._lowest = np.concatenate([lowest for lowest, _ in tables])
        self._pattern = np.concatenate([pattern for _, pattern in tables])
        # At an end of its scale the thermal pad does not tell what was taken.
        scale = np.arange(256)
        tells = [((scale > 0) & (scale < 255)) | (not any(gain)) for gain, _ in kinds]
        self._tells = np.concatenate(tells)[:, None]
        self._kind = np.array([256 * kinds.index(kind) for kind in zip(gains, shifts, strict=True)])
        self._shift = np.array(shifts, np.int64)[:, None]
        self._base = np.zeros(self._gain.shape, np.int64)
        self._possible = np.zeros(self._gain.shape, np.uint64)

    @property
    def shifted(self) -> Mask:
        """bool[k, 12], pads whose words compensation moves against the edges of their bytes."""
        return (self._gain > 0.0) & self._compensated

    def own_noise(self, noise_units: Floats) -> Floats:
        """Noise float64[k, 12] of the words, given that of the bytes (standard deviations)."""
        taken = self._gain * noise_units[:, THERMAL_TAXEL, None]
        # The difference of two estimates may be anything where much was taken.
        own: Floats = np.sqrt(np.maximum(noise_units**2 - taken**2, noise_units**2 / 4))
        return own

    def step(self, raw: NDArray[np.uint8], changed: Mask, within: Mask) -> tuple[Mask, Mask]:
        """Take one sweep.

        Args:
            raw: uint8[k, 12].
            changed: bool[k, 12], bytes that differ from those before.
            within: bool[k, 12], bytes that came, now and before, from within their scale.

        Returns:
            moved: bool[k, 12], no word explains this byte and all those since the last move.
            told: bool[k, 12], whether there was anything to tell.
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
        return moved, told


def _words(
    gain: tuple[int, ...], shift: int, no_load: int, truncates: bool
) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
    """Which words a byte may stand for, given the byte of the thermal pad.

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
