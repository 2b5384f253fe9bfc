"""Frames of force/torque boards."""

import numpy as np
from numpy.typing import ArrayLike

from skin_host.bus.strain import (
    ZERO_WORD,
    StrainType,
    Wrench,
    WrenchAssembler,
    parse_strain,
)
from skin_host.bus.wire import FrameBatch, MessageClass, identifier


def samples_of(assembler: WrenchAssembler, batch: FrameBatch) -> list[Wrench]:
    """The samples that a batch of the bus completes."""
    return assembler.take(parse_strain(batch), batch.t_ns)


def encode_strain(
    board: int, kind: StrainType, value: ArrayLike, *, overflow: int = 0
) -> tuple[int, bytes]:
    """Return one frame (identifier and payload) with three values in -32768..32767.

    Raises:
        ValueError: a value does not fit its word.
    """
    words = np.asarray(value, np.int64) + ZERO_WORD
    if words.shape != (3,) or words.min() < 0 or words.max() > 0xFFFF:
        raise ValueError(f"{value!r}: wanted three values in -32768..32767")
    payload = words.astype("<u2").tobytes() + (bytes([overflow]) if overflow else b"")
    return identifier(MessageClass.ANALOG_STREAM, board, kind), payload
