"""One CAN bus: who sends when. Frames wait for the bus, the lowest identifier goes first.

A frame whose transmission has begun is not interrupted (ISO 11898-1: arbitration is at its start).
Boards have short queues. What does not fit is lost: an MTB4 drops the newest frames, an MTB3
drops its whole stack and reports that. An MTB3 answers commands between its bursts, so an answer
always finds room.
"""

from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import TypeVar

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
#: A board's bursts have the same identifiers, the same array, until it is set up again; of so many
#: it is remembered how long they take.
_MOST_PASSED = 64
_STREAMS = (MessageClass.ANALOG_STREAM, MessageClass.SKIN_STREAM)
#: So few frames are handed over in plain numbers: numpy takes longer.
FEW = 4
NEVER_NS = 1 << 62
NOTHING = FrameBatch.of([])

Ints = NDArray[np.int64]
_Length = TypeVar("_Length", int, Ints)


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
        #: Frames that their boards have made, `t_ns` when; and those that they have handed over to
        #: the bus, `t_ns` when their transmission ends unless more urgent ones come.
        self._waiting = self._under_way = NOTHING
        #: When all that wait became ready, if that is known to be one moment.
        self._ready_ns: int | None = None
        #: By the object of identifiers in the order of the bus: they, the lengths, and when after
        #: its beginning the transmission of each ends.
        self._passed: dict[int, tuple[NDArray[np.uint32], NDArray[np.uint8], Ints]] = {}
        self._free_ns = 0
        self._babble_every_ns = 0
        self._babbled_ns = 0
        self.lost = 0
        self.off = False
        self.loss_share = 0.0
        self.error_share = 0.0

    def babble(self, share: float, t_ns: int) -> None:
        """From `t_ns` on a node fills `share` of the bus with frames of identifier 0."""
        every_ns = self._babble_frame_ns / share if share else 0.0
        self._babble_every_ns = round(min(every_ns, NEVER_NS))
        self._babbled_ns = t_ns

    def put(self, batch: FrameBatch, ready_ns: int | None = None) -> None:
        """Frames that became ready at their `t_ns`, in the order their board sends them.

        Args:
            batch: the frames.
            ready_ns: their `t_ns`, where it is known that all have the same.
        """
        if not len(batch):
            return
        alone = not len(self._waiting)
        self._waiting = batch if alone else join([self._waiting, batch])
        self._ready_ns = ready_ns if alone else None

    @property
    def passes(self) -> bool:
        """Whether anything passes besides the frames of a babbling node, which may leave no gap."""
        return not (self.off or 0 < self._babble_every_ns <= self._babble_frame_ns)

    @property
    def _babble_frame_ns(self) -> float:
        return _bits(8) * self._bit_ns

    @property
    def silent(self) -> bool:
        """Whether no frame will come until a board sends one."""
        return not (self._babble_every_ns or len(self._waiting) or len(self._under_way))

    @property
    def idle(self) -> bool:
        """Whether no frame waits or is under way."""
        return not len(self._waiting) and not len(self._under_way)

    def until(self, t_ns: int) -> FrameBatch:
        """The frames whose transmission has ended by `t_ns`, stamped with that moment."""
        if self._babble_every_ns:
            self._add_babble(t_ns)
        if self.off:
            self.lost += len(self._waiting) + len(self._under_way)
            self._waiting = self._under_way = NOTHING
        if len(self._waiting):
            self._hand_over(t_ns)
        under_way = self._under_way
        if not len(under_way):
            return under_way
        sent, self._under_way = _split(under_way, _ended(under_way, t_ns))
        if not len(sent):
            return sent
        self._free_ns = int(sent.t_ns[-1])
        return self._spoil(sent) if self.loss_share or self.error_share else sent

    def _add_babble(self, t_ns: int) -> None:
        times_ns = np.arange(self._babbled_ns, t_ns, self._babble_every_ns)
        self._babbled_ns += len(times_ns) * self._babble_every_ns
        self.put(FrameBatch.of([(0, bytes(8), int(time_ns)) for time_ns in times_ns]))

    def _hand_over(self, t_ns: int) -> None:
        """Take what is ready by `t_ns` to the bus, one moment after the other."""
        waiting = self._waiting
        if self._ready_ns is not None and self._ready_ns <= t_ns:
            self._waiting = NOTHING
            self._arbitrate(waiting, self._ready_ns)
            return
        if not waiting.rising:
            waiting = _rows(waiting, np.argsort(waiting.t_ns, kind="stable"))
        times_ns = waiting.t_ns
        if len(times_ns) <= FEW and self._pass_freely(waiting, t_ns):
            return
        if times_ns[0] == times_ns[-1] <= t_ns:
            self._waiting = NOTHING
            self._arbitrate(waiting, int(times_ns[0]))
            return
        taken = int(np.searchsorted(times_ns, t_ns, side="right"))
        turns = np.flatnonzero(times_ns[1:taken] != times_ns[: max(0, taken - 1)]) + 1
        urgent = waiting.id[:taken].tolist()
        first = last = 0
        for start, stop in pairwise([0, *turns.tolist(), taken]):
            if stop - start == 1 and not urgent[start] >> 4:
                last = stop
                continue
            self._let_first(_rows(waiting, slice(first, last)))
            self._arbitrate(_rows(waiting, slice(start, stop)), int(times_ns[start]))
            first = last = stop
        self._let_first(_rows(waiting, slice(first, last)))
        _, self._waiting = _split(waiting, taken)

    def _pass_freely(self, waiting: FrameBatch, t_ns: int) -> bool:
        """Transmit frames one by one, if the bus is free for each that is ready by `t_ns`.

        So send force/torque boards, hundreds of times a second. Otherwise nothing is done.
        """
        under_way = self._under_way
        free_ns = int(under_way.t_ns[-1]) if len(under_way) else self._free_ns
        ends_ns: list[int] = []
        for ready_ns, length in zip(waiting.t_ns.tolist(), waiting.dlc.tolist(), strict=True):
            if free_ns > ready_ns:
                return False
            if ready_ns > t_ns:
                break
            free_ns = ready_ns + round(_bits(length) * self._bit_ns)
            ends_ns.append(free_ns)
        if ends_ns:
            ready, self._waiting = _split(waiting, len(ends_ns))
            sent = FrameBatch(ready.id, ready.dlc, ready.data, np.array(ends_ns, np.int64))
            self._under_way = join([under_way, sent]) if len(under_way) else sent
        return True

    def _spoil(self, sent: FrameBatch) -> FrameBatch:
        n = len(sent)
        wrong = np.flatnonzero(self._rng.random(n) < self.error_share)
        bit = self._rng.integers(0, 64, len(wrong))
        # Of the bits that a frame has; one without data is not changed.
        bits = 8 * sent.dlc[wrong].astype(np.int64)
        wrong, bit = wrong[bits > 0], bit[bits > 0] % bits[bits > 0]
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
            stack_size = self._stack_size(int(sender))
            if stack_size is not None:
                is_burst = np.isin(group.id[new] >> 8, _STREAMS).any()
                fits = queued + np.count_nonzero(new) <= stack_size
                if not queued or fits or not is_burst:
                    continue
                keep &= senders != sender
                self.lost += queued
                notice = identifier(MessageClass.MANAGEMENT, int(sender), TX_OVERFLOW_TYPE)
                notices.append((notice, b"", int(group.t_ns[0])))
            elif np.count_nonzero(new) > room:
                over = np.flatnonzero(new)[max(0, room) :]
                self.lost += len(over)
                group = _rows(group, ~np.isin(np.arange(len(group)), over))
        return join([_rows(backlog, keep), FrameBatch.of(notices), group])

    def _arbitrate(self, group: FrameBatch, ready_ns: int) -> None:
        """Find out when these frames, and those that they delay, are transmitted."""
        under_way = self._under_way
        n = self._begun(under_way, ready_ns)
        begun, backlog = _split(under_way, n)
        free_ns = int(begun.t_ns[-1]) if n else self._free_ns
        group = self._admit(backlog, group)
        known = self._passed.get(id(group.id))
        if known is not None and known[0] is group.id and known[1] is group.dlc:
            passed_ns = known[2]
        else:
            # Class and sender decide the arbitration; a sender's own frames stay in its order.
            priority = group.id >> 4
            is_sorted = not (priority[1:] < priority[:-1]).any()
            if not is_sorted:
                group = _rows(group, np.argsort(priority, kind="stable"))
            bits = np.cumsum(_bits(group.dlc.astype(np.int64)))
            passed_ns = np.round(bits * self._bit_ns).astype(np.int64)
            if is_sorted:
                if len(self._passed) >= _MOST_PASSED:
                    self._passed.clear()
                self._passed[id(group.id)] = group.id, group.dlc, passed_ns
        group.t_ns = max(free_ns, ready_ns) + passed_ns
        self._under_way = join([begun, group]) if n else group

    def _begun(self, under_way: FrameBatch, t_ns: int) -> int:
        """How many of the frames have been transmitted by `t_ns`, the one that is then included."""
        n = _ended(under_way, t_ns)
        if n == len(under_way):
            return n
        takes_ns = round(_bits(int(under_way.dlc[n])) * self._bit_ns)
        return n + (int(under_way.t_ns[n]) - takes_ns < t_ns)

    def _let_first(self, urgent: FrameBatch) -> None:
        """Do what `_arbitrate` does for frames of the highest priority, ready one after the other.

        They come by the thousand, so this is done in plain numbers.
        """
        if not len(urgent):
            return
        under_way = self._under_way
        both = join([under_way, urgent])
        bits = _bits(both.dlc.astype(np.int64)).tolist()
        is_urgent = (both.id >> 4 == 0).tolist()
        ready_ns = urgent.t_ns.tolist()
        n = self._begun(under_way, ready_ns[0])
        order = list(range(n))
        ends_ns: list[int] = under_way.t_ns[:n].tolist()
        free_ns = ends_ns[-1] if n else self._free_ns
        left = deque(range(n, len(under_way)))
        waits = 0  # urgent ones among the first of those that are left
        while waits < len(left) and is_urgent[left[waits]]:
            waits += 1
        for number, (now_ns, next_ns) in enumerate(
            zip(ready_ns, [*ready_ns[1:], NEVER_NS], strict=True), len(under_way)
        ):
            left.insert(waits, number)
            waits += 1
            begin_ns = max(free_ns, now_ns)
            passed_bits, free_ns = 0, begin_ns
            while left and free_ns < next_ns:
                passed_bits += bits[left[0]]
                free_ns = begin_ns + round(passed_bits * self._bit_ns)
                order.append(left.popleft())
                ends_ns.append(free_ns)
                waits -= waits > 0
        rows = np.array(order, np.intp)
        self._under_way = FrameBatch(
            both.id[rows], both.dlc[rows], both.data[rows], np.array(ends_ns, np.int64)
        )


def _bits(length: _Length) -> _Length:
    """Return how many bits a frame with so many bytes has on the bus."""
    return OVERHEAD_BITS + STUFF_BITS + 8 * length


def _ended(under_way: FrameBatch, t_ns: int) -> int:
    """How many of the frames have been transmitted by `t_ns`."""
    ends_ns = under_way.t_ns
    # Nearly always all of them, or none.
    if not len(ends_ns) or ends_ns[0] > t_ns:
        return 0
    return len(ends_ns) if ends_ns[-1] <= t_ns else int(ends_ns.searchsorted(t_ns, side="right"))


def _split(batch: FrameBatch, n: int) -> tuple[FrameBatch, FrameBatch]:
    """The first `n` frames, and the others."""
    if n == len(batch):
        return batch, NOTHING
    if not n:
        return NOTHING, batch
    return _rows(batch, slice(n)), _rows(batch, slice(n, None))


def _rows(batch: FrameBatch, rows: NDArray[np.generic] | slice) -> FrameBatch:
    return FrameBatch(batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows])
