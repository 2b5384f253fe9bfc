"""From raw chip words to transmitted bytes, as the firmwares compute them. Pure.

    v = raw - baseline - drift        out = noLoad - (v >> shift), clipped to 0..255
    a taxel twice as far out as the clipping limit gets its bit in the status word

The MTB4 computes in 32 bits; the dsPIC of the MTB3 in 16, where large differences wrap to
the other end. Sources: `fill`, `computedrift` of embot_app_application_theSkin.cpp;
`FillCanMessages8bit` of mtb3/main_V3.c.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import StatusError, status_word

TAXELS = 12
ABSENT = 0xFFFF
LEGACY_NO_LOAD = 244

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Ints = NDArray[np.int32]


def transmit_32(
    raw: Words, base: Ints, shift: Ints, no_load: Ints, gain: Ints, thermal: NDArray[np.intp]
) -> tuple[Bytes, Words]:
    """Values and status words of k triangles as the MTB4 family computes them.

    Args:
        raw: uint16[k, 12], present words of the chips.
        base: int32[k, 12], their words at the last calibration.
        shift, no_load: int32[k].
        gain: int32[k, 12], temperature gains x128.
        thermal: intp[k], the taxel that stands for the temperature.

    Returns:
        values uint8[k, 12] and status words uint16[k].
    """
    change = raw - base
    value = change
    if gain.any():
        dt = change[_rows(len(raw)), thermal]
        # A quarter of it, towards zero.
        size = (dt * 0.25).astype(np.int32)[:, None] * gain
        # The source negates before the last shift, so falling temperatures round down.
        value = change - (size >> 5)
    shift, no_load = shift[:, None], no_load[:, None]
    sent = no_load - (value >> shift)
    is_there = _all_there(raw)
    if is_there and np.maximum.reduce((sent - 1).view(np.uint32), None, initial=0) < 254:
        # Nothing is clipped, so nothing is as far out as that takes: nearly always.
        return sent.astype(np.uint8), np.zeros(len(raw), np.uint16)
    values = np.minimum(np.maximum(sent, 0), 255).astype(np.uint8)
    up, bottom = (255 - no_load) << shift, no_load << shift
    far = (value <= -2 * up) | (value >= 2 * bottom)
    if is_there and not far.any():
        return values, np.zeros(len(raw), np.uint16)
    return values, _status(far, raw, base)


def _all_there(raw: Words) -> bool:
    """Whether no word is 0 or `ABSENT`."""
    return bool(np.maximum.reduce(raw - np.uint16(1), None, initial=0) < ABSENT - 1)


@cache
def _rows(n: int) -> NDArray[np.intp]:
    return np.arange(n)


def _status(far: NDArray[np.bool_], raw: Words, base: Ints) -> Words:
    """Status words of an MTB4."""
    silent = ((raw == 0) & (base != 0)).any(axis=1)
    absent = (raw == ABSENT).all(axis=1)
    error = StatusError.NO_ACK * silent | StatusError.NOT_CONNECTED * absent
    return status_word(far, error.astype(np.uint8))


def transmit_16(
    raw: Words, base: Ints, shift: Ints, no_load: Ints, gain: Ints, thermal: NDArray[np.intp]
) -> tuple[Bytes, Words]:
    """As `transmit_32`, but in the 16-bit arithmetic of the MTB3.

    Differences, limits and the drift product wrap at 16 bits. "Not connected" replaces
    "no acknowledge". With the gains switched off pass zeros.
    """
    signed = raw.astype(np.int16)
    base = base.astype(np.uint16)
    pad = np.take_along_axis(signed, thermal[:, None], axis=1)
    pad_base = np.take_along_axis(base.astype(np.int16), thermal[:, None], axis=1)
    warmer = pad > pad_base
    dt = np.where(warmer, pad - pad_base, pad_base - pad) >> 2
    drift = (dt.astype(np.uint16) * gain.astype(np.uint16) >> 5).astype(np.int16)
    value = (raw - base).astype(np.int16) - np.where(warmer, drift, -drift)
    up = ((255 - no_load) << shift).astype(np.int16)[:, None]
    bottom = (no_load << shift).astype(np.int16)[:, None]
    scaled = no_load[:, None] - (value >> shift[:, None].astype(np.int16))
    values = np.select([value >= bottom, value <= -up], [0, 255], scaled & 0xFF).astype(np.uint8)
    far = (value <= -(up << 1)) | (value >= bottom << 1)
    silent = ((raw == 0) & (base != 0)).any(axis=1)
    absent = (raw == ABSENT).all(axis=1)
    error = np.where(absent, StatusError.NOT_CONNECTED, StatusError.NO_ACK * silent)
    return values, status_word(far, error.astype(np.uint8))


def transmit_legacy(raw: Words, base: Ints, shift: int) -> Bytes:
    """Values of the reduced legacy formats: around 244, clipped to 1..255, without drift.

    Args:
        raw: uint16[k, m], m = 1 (the whole triangle) or 3 (thirds).
        base: int32[k, m].
        shift: SHIFT_ALL or SHIFT_THREE of the board.

    Source: FillCanMessages8bit_all and _three of mtb3/main_V3.c.
    """
    change = raw - base
    less, more = -change >> shift, change >> shift
    values = np.where(
        change <= 0,
        np.where(less >= 10, 255, LEGACY_NO_LOAD + less),
        np.where(more >= 243, 1, LEGACY_NO_LOAD - more),
    )
    return values.astype(np.uint8)
