"""What taxels felt before they were not received."""

from dataclasses import replace

import numpy as np

from skin_host.processing.frame import PressureFrame
from skin_host.processing.masks import Mask, any_of

#: A taxel that is not received for less than this time counts as it was last received.
LOST_NS = 500_000_000


class Held:
    """What the taxels of a part last felt, for as long as lost frames do not end a touch.

    It is needed while there are contacts. Frames are not written to, so the last one is kept as it
    is; a taxel is copied from it when it is not received any more.

    Args:
        n: taxels of the part.
    """

    def __init__(self, n: int) -> None:
        self._pressure_kpa = np.zeros(n, np.float32)
        self._touched: Mask = np.zeros(n, np.bool_)
        self._beyond: Mask = np.zeros(n, np.bool_)
        self._received_ns = np.full(n, -LOST_NS, np.int64)
        self._last: PressureFrame | None = None
        #: From when on none is held.
        self._until_ns = 0

    def complete(self, frame: PressureFrame) -> PressureFrame:
        """Return the frame with taxels that are not received as they last were.

        In it a taxel is valid, touched and has its pressure until it has not been received for
        `LOST_NS`. If there is none such it is the frame itself.
        """
        last, self._last = self._last, frame
        now_ns = frame.elapsed_ns
        if last is not None and last.valid is not frame.valid:
            gone = last.valid & ~frame.valid
            if any_of(gone):
                np.copyto(self._pressure_kpa, last.pressure_kpa, where=gone)
                np.copyto(self._touched, last.touched, where=gone)
                np.copyto(self._beyond, last.beyond_range, where=gone)
                self._received_ns[gone] = last.elapsed_ns
                self._until_ns = last.elapsed_ns + LOST_NS
        if now_ns >= self._until_ns:
            return frame
        held = ~frame.valid & (now_ns - self._received_ns < LOST_NS)
        if not any_of(held):
            return frame
        return replace(
            frame,
            pressure_kpa=np.where(held, self._pressure_kpa, frame.pressure_kpa),
            touched=frame.touched | (held & self._touched),
            valid=frame.valid | held,
            beyond_range=frame.beyond_range | (held & self._beyond),
        )

    def forget(self) -> None:
        """Hold nothing of earlier frames."""
        self._last = None
        if self._until_ns:
            self._received_ns.fill(-LOST_NS)
            self._until_ns = 0
