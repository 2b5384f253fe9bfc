"""One CAN bus: who sends when. Frames wait for the bus, the lowest identifier goes first.

Boards have short queues. What does not fit is lost: an MTB4 drops the newest frames, an MTB3
drops its whole stack and reports that.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from emulator.boards.board import join
from skin_host.bus.answers import TX_OVERFLOW_TYPE
from skin_host.bus.wire import FrameBatch, MessageClass, identifier

#: A standard frame without its data, with interframe space; and the mean of stuffed bits,
#: which are 0 to 24 in a frame of 8 bytes (recorded skin frames have 5).
OVERHEAD_BITS = 47
STUFF_BITS = 5
#: Frames that a board can have waiting.
QUEUE_FRAMES = 48


class Wire:
    """The frames on their way over one bus.

    Args:
        bitrate: of the bus.
        stack_size: for each sender (address) whose queue is a stack, its size.

        rng: for what is left to chance.

    Attributes:
        lost: frames that boards had to drop because the bus was too slow for them.
        off: nothing passes.
        loss_share, error_share: of the frames, lost on the way or with one data bit wrong.
    """

    def __init__(
        self, bitrate: int, stack_size: Callable[[int], int | None], rng: np.random.Generator
    ) -> None:
        self._bit_ns = 1e9 / bitrate
        self._stack_size = stack_size
        self._rng = rng
        self._waiting = FrameBatch.of([])
        self._free_ns = 0
        self._babble_every_ns = 0
        self._babbled_ns = 0
        self.lost = 0
        self.off = False
        self.loss_share = 0.0
        self.error_share = 0.0

    def babble(self, share: float, t_ns: int) -> None:
        """From `t_ns` on a node fills `share` of the bus with frames of identifier 0."""
        frame_ns = (OVERHEAD_BITS + STUFF_BITS + 64) * self._bit_ns
        self._babble_every_ns = round(frame_ns / share) if share else 0
        self._babbled_ns = t_ns

    def put(self, batch: FrameBatch) -> None:
        """Frames that became ready at their `t_ns`, in the order their board sends them."""
        if len(batch):
            self._waiting = join([self._waiting, batch]) if len(self._waiting) else batch

    def until(self, t_ns: int) -> FrameBatch:
        """The frames whose transmission has ended by `t_ns`, stamped with that moment."""
        if self._babble_every_ns:
            self._add_babble(t_ns)
        if not len(self._waiting):
            return self._waiting
        if self.off:
            self.lost += len(self._waiting)
            self._waiting = FrameBatch.of([])
            return self._waiting
        sent = self._pass(t_ns)
        return self._spoil(sent) if self.loss_share or self.error_share else sent

    def _add_babble(self, t_ns: int) -> None:
        times_ns = np.arange(self._babbled_ns, t_ns, self._babble_every_ns)
        self._babbled_ns += len(times_ns) * self._babble_every_ns
        self.put(FrameBatch.of([(0, bytes(8), int(time_ns)) for time_ns in times_ns]))

    def _pass(self, t_ns: int) -> FrameBatch:
        waiting = self._waiting
        if not waiting.rising:
            waiting = _rows(waiting, np.argsort(waiting.t_ns, kind="stable"))
        times_ns = waiting.t_ns
        turns = np.flatnonzero(times_ns[1:] != times_ns[:-1]) + 1
        done: list[FrameBatch] = []
        backlog, first = FrameBatch.of([]), 0
        for start, stop in pairwise([0, *turns.tolist(), len(waiting)]):
            ready_ns = int(times_ns[start])
            if ready_ns > t_ns:
                break
            next_ns = min(t_ns, int(times_ns[stop])) if stop < len(waiting) else t_ns
            backlog = self._admit(backlog, _rows(waiting, slice(start, stop)))
            sent, backlog = self._transmit(backlog, ready_ns, next_ns)
            done.append(sent)
            first = stop
        # What waits still was ready before; it keeps its place in line.
        self._waiting = join([backlog, _rows(waiting, slice(first, None))])
        return join(done) if done else FrameBatch.of([])

    def _spoil(self, sent: FrameBatch) -> FrameBatch:
        n = len(sent)
        wrong = np.flatnonzero(self._rng.random(n) < self.error_share)
        bit = self._rng.integers(0, 64, len(wrong))
        sent.data[wrong, bit // 8] ^= (1 << bit % 8).astype(np.uint8)
        return _rows(sent, self._rng.random(n) >= self.loss_share)

    def _admit(self, backlog: FrameBatch, group: FrameBatch) -> FrameBatch:
        if not len(backlog):
            return group
        senders = backlog.id >> 4 & 0xF
        keep = np.ones(len(backlog), bool)
        notices: list[tuple[int, bytes, int]] = []
        for sender in np.unique(group.id >> 4 & 0xF):
            queued = int(np.count_nonzero(senders == sender))
            new = group.id >> 4 & 0xF == sender
            room = QUEUE_FRAMES - queued
            if queued and self._stack_size(int(sender)) is not None:
                keep &= senders != sender
                self.lost += queued
                notice = identifier(MessageClass.MANAGEMENT, int(sender), TX_OVERFLOW_TYPE)
                notices.append((notice, b"", int(group.t_ns[0])))
            elif np.count_nonzero(new) > room:
                over = np.flatnonzero(new)[max(0, room) :]
                self.lost += len(over)
                group = _rows(group, ~np.isin(np.arange(len(group)), over))
        return join([_rows(backlog, keep), FrameBatch.of(notices), group])

    def _transmit(
        self, backlog: FrameBatch, ready_ns: int, until_ns: int
    ) -> tuple[FrameBatch, FrameBatch]:
        # Class and sender decide the arbitration; a sender's own frames stay in its order.
        priority = backlog.id >> 4
        if (priority[1:] < priority[:-1]).any():
            backlog = _rows(backlog, np.argsort(priority, kind="stable"))
        bits = OVERHEAD_BITS + STUFF_BITS + 8 * backlog.dlc.astype(np.int64)
        start_ns = max(self._free_ns, ready_ns)
        end_ns = start_ns + np.round(np.cumsum(bits) * self._bit_ns).astype(np.int64)
        n = int(np.searchsorted(end_ns, until_ns, side="right"))
        if n:
            self._free_ns = int(end_ns[n - 1])
        sent = _rows(backlog, slice(n))
        sent.t_ns = end_ns[:n]
        rest = _rows(backlog, slice(n, None))
        rest.t_ns = np.full(len(rest), ready_ns, np.int64)
        return sent, rest


def _rows(batch: FrameBatch, rows: NDArray[np.generic] | slice) -> FrameBatch:
    return FrameBatch(batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows])
