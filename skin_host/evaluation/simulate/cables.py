"""Buses in memory: the emulated robot at one end, the daemon's port at the other.

A cable is asked, not waited for: the robot moves on when the port is read or sends, so nothing
polls. What happens to frames between the two ends is drawn frame by frame. What passed is kept for
a while (`Sent`), so that what the daemon has can be traced back to it.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import can
import numpy as np
from numpy.typing import NDArray

from emulator.boards.board import join
from skin_host.bus.port import ERROR_FLAG, LinkState, Port
from skin_host.bus.wire import HEADER_A, HEADER_B, TAXELS, FrameBatch, MessageClass
from skin_host.clock import Clock
from skin_host.config.settings import Bus
from skin_host.errors import BusError
from skin_host.evaluation.simulate.trace import Trace
from skin_host.health.describe import FEWEST_INTERVALS, SIGMA

#: Frames that wait to be read; more are dropped and counted, as a socket does.
BUFFER_FRAMES = 4000
#: Most frames of one read.
CAPACITY = 1024
#: A second board at an address sends this long after the first.
TWIN_NS = 20_000_000
#: Two halves of which the second came first, those of two sweeps, are taken for one if they are no
#: further apart: a bus that was full passes sweeps close together.
PAIR_NS = 12_000_000
#: A longer pause separates two sweeps of a board, half of its period as for the daemon. Boards of
#: more urgent identifiers may hold up the rest of a sweep for nearly as long.
PAUSE_NS = 24_000_000
#: Frames of sweeps that passed close together have come after this time.
CROWDED_NS = 100_000_000
#: The part of a status word that names an error.
ERROR = 0xF
#: Sweeps of a triangle that are kept: those of two boards at one address while the computer stalls.
KEPT = 256
_STREAMS = {int(MessageClass.SKIN_STREAM), int(MessageClass.ANALOG_STREAM)}
#: First bytes of the frames of a sweep: of 16 triangles at most.
_HEADERS = bytes([HEADER_A, HEADER_B]) * 16
#: Where the twelve values are among the 16 bytes of a triangle's two frames.
_VALUES = np.array([*range(1, 8), *range(9, 14)])
_NOTHING = FrameBatch.of([])


@dataclass(slots=True)
class Mischief:
    """Shares of the frames that something happens to between the boards and this computer."""

    lost: float = 0.0
    late: float = 0.0
    doubled: float = 0.0
    swapped: float = 0.0
    damaged: float = 0.0
    #: How late the late ones come.
    late_ns: int = 3_000_000
    #: A second board sends at this address.
    twin: int | None = None

    def any(self) -> bool:
        """Whether anything happens to any frame."""
        return bool(self.lost or self.late or self.doubled or self.swapped or self.damaged)

    def second_board(self, batch: FrameBatch) -> FrameBatch:
        """Return what a second board at the address sends after these frames."""
        mine = (batch.id >> 8 == MessageClass.SKIN_STREAM) & (batch.id >> 4 & 0xF == self.twin)
        other = _rows(batch, mine)
        other.t_ns = other.t_ns + TWIN_NS
        return other


@dataclass(frozen=True, slots=True)
class _Sweep:
    """One whole sweep of a board.

    Attributes:
        octets: of its frames.
        values: of its triangles, 12 bytes each.
        answered: whether all chips did.
        t_ns: when each frame passed, int64[2 k].
    """

    octets: bytes
    values: bytes
    answered: bool
    t_ns: NDArray[np.int64]


class Sent:
    """The last sweeps of every triangle of a bus, as they passed over it.

    The two frames of a triangle's sweep leave its board one after the other, so the two that are
    close together in time belong to one sweep. Every byte of a triangle that is reported as valid
    must come from one such pair, of a chip that answered.

    Args:
        stacks: addresses of boards that send the second frame first (MTB3).

    Attributes:
        bursts: by address, how many sweeps began.
        begun_ns: by address, when the last ones began.
        crowded_ns: when two sweeps of a board last passed close together.
    """

    def __init__(self, stacks: frozenset[int] = frozenset()) -> None:
        self._stacks = stacks
        self.crowded_ns = -(1 << 62)
        self._half: dict[int, tuple[int, bytes, int]] = {}
        #: By address and triangle: (12 bytes, status, time in ns).
        self._whole: dict[int, deque[tuple[bytes, int, int]]] = {}
        #: By address, the keys (address and triangle) of its whole sweeps, and those of them that
        #: are not yet in `_whole`: nearly always nobody asks for a single triangle.
        self._sweeps: dict[int, tuple[tuple[int, ...], deque[_Sweep]]] = {}
        #: Identifiers and lengths of the last batches, the arrays themselves, and the keys of the
        #: sweep that they are, if they are one.
        self._known: dict[
            int, tuple[NDArray[np.uint32], NDArray[np.uint8], tuple[int, ...] | None]
        ] = {}
        self.bursts: dict[int, int] = {}
        self.begun_ns: dict[int, deque[int]] = {}
        self._last_ns: dict[int, int] = {}

    def note(self, batch: FrameBatch) -> None:
        """Take frames in the order in which they passed, stamped with the robot's time."""
        if not self._note_sweep(batch):
            self._note_frames(batch)

    def _note_sweep(self, batch: FrameBatch) -> bool:
        """Take the frames of one whole sweep of one board; False if they are not that."""
        keys = self._keys_of(batch.id, batch.dlc)
        if keys is None:
            return False
        octets = batch.data.tobytes()
        if octets[::8] != _HEADERS[: 2 * len(keys)]:
            return False
        address = keys[0] >> 4
        first_ns, last_ns = int(batch.t_ns[0]), int(batch.t_ns[-1])
        if first_ns - self._last_ns.get(address, -PAUSE_NS) < PAUSE_NS:
            return False
        if last_ns - first_ns > PAIR_NS:
            return False
        self._note_begin(address, first_ns)
        self._last_ns[address] = last_ns
        known = self._sweeps.get(address)
        if known is None or known[0] != keys:
            self._spread(address)
            known = self._sweeps[address] = keys, deque(maxlen=KEPT)
        values = batch.data.reshape(-1, 16)[:, _VALUES].tobytes()
        answered = not any(octets[15::16]) or not any(octet & ERROR for octet in octets[15::16])
        known[1].append(_Sweep(octets, values, answered, batch.t_ns))
        return True

    def _note_begin(self, address: int, t_ns: int) -> None:
        self.bursts[address] = self.bursts.get(address, 0) + 1
        begun_ns = self.begun_ns.get(address)
        if begun_ns is None:
            begun_ns = self.begun_ns[address] = deque(maxlen=KEPT)
        begun_ns.append(t_ns)

    def scatter_ms(self, address: int, since_ns: int) -> float:
        """Return the scatter of a board's intervals since a time, a standard deviation from their
        median deviation; 0 if there are few.
        """
        begun_ns = [t_ns for t_ns in self.begun_ns.get(address, ()) if t_ns >= since_ns]
        intervals_ms = np.diff(begun_ns) / 1e6
        if len(intervals_ms) < FEWEST_INTERVALS:
            return 0.0
        return float(SIGMA * np.median(np.abs(intervals_ms - np.median(intervals_ms))))

    def _keys_of(
        self, ids: NDArray[np.uint32], lengths: NDArray[np.uint8]
    ) -> tuple[int, ...] | None:
        """Return the keys of a sweep with these identifiers, None if they are not of one."""
        known = self._known.get(id(ids))
        if known is not None and known[0] is ids and known[1] is lengths:
            return known[2]
        if len(self._known) >= KEPT:
            self._known.clear()
        numbers = ids.tolist()
        heads = numbers[::2]
        is_sweep = (
            numbers[1::2] == heads
            and len(set(heads)) == len(heads)
            and heads[0] >> 8 in _STREAMS
            and all(head >> 4 == heads[0] >> 4 for head in heads)
            and lengths.tobytes().count(8) == len(numbers)
        )
        keys = tuple(head & 0xFF for head in heads) if is_sweep else None
        self._known[id(ids)] = ids, lengths, keys
        return keys

    def _spread(self, address: int) -> None:
        """Take the whole sweeps of a board triangle by triangle."""
        keys, sweeps = self._sweeps.pop(address, ((), ()))
        for sweep in sweeps:
            octets = sweep.octets
            for at, (key, t_ns) in enumerate(zip(keys, sweep.t_ns[1::2].tolist(), strict=True)):
                pair = octets[16 * at : 16 * at + 16]
                self._half[key] = HEADER_B, pair[9:], t_ns
                whole = self._whole.get(key)
                if whole is None:
                    whole = self._whole[key] = deque(maxlen=KEPT)
                whole.append((pair[1:8] + pair[9:14], pair[14] << 8 | pair[15], t_ns))

    def _note_frames(self, batch: FrameBatch) -> None:
        for seconds, nanoseconds, identifier, dlc, header, payload in batch.frames():
            if identifier >> 8 not in _STREAMS or dlc != 8:
                continue
            key = identifier & 0xFF
            t_ns = seconds * 1_000_000_000 + nanoseconds
            address = key >> 4
            if address in self._sweeps:
                self._spread(address)
            if t_ns - self._last_ns.get(address, -PAUSE_NS) >= PAUSE_NS:
                self._note_begin(address, t_ns)
            self._last_ns[address] = t_ns
            half = self._half.get(key)
            # A bus that was full passes sweeps close together, and one may have lost its first
            # half: this frame may be the first of the next.
            self._half[key] = header, payload, t_ns
            if half is None:
                continue
            apart_ns = t_ns - half[2]
            if (half[0], header) == (HEADER_A, HEADER_B) and apart_ns <= PAUSE_NS:
                first, second = half[1], payload
            elif (half[0], header) == (HEADER_B, HEADER_A) and (
                apart_ns <= PAIR_NS or (address in self._stacks and apart_ns <= PAUSE_NS)
            ):
                first, second = payload, half[1]
                self.crowded_ns = t_ns
            else:
                continue
            whole = self._whole.get(key)
            if whole is None:
                whole = self._whole[key] = deque(maxlen=KEPT)
            whole.append((first + second[:5], second[5] << 8 | second[6], t_ns))

    def find(self, address: int, triangle: int, raw: bytes) -> Iterable[tuple[bool, int]]:
        """Yield, newest first, whether the chip answered and when, of sweeps with these bytes."""
        self._spread(address)
        for sent, status, t_ns in reversed(self._whole.get(address << 4 | triangle, ())):
            if sent == raw:
                yield not status & ERROR, t_ns

    def find_together(self, keys: tuple[int, ...], raw: bytes) -> int | None:
        """Return when the newest sweep began that has these bytes at once, of chips that answered.

        Args:
            keys: address and number of triangles of one board, in the order of its frames.
            raw: 12 bytes of each.

        Returns None if they may have passed otherwise, see `find`.
        """
        sent, sweeps = self._sweeps.get(keys[0] >> 4, ((), ()))
        if keys[0] not in sent:
            return None
        first = sent.index(keys[0])
        if sent[first : first + len(keys)] != keys:
            return None
        mine = slice(TAXELS * first, TAXELS * (first + len(keys)))
        for sweep in reversed(sweeps):
            if sweep.answered and sweep.values[mine] == raw:
                return int(sweep.t_ns[0])
        return None

    def forget(self) -> None:
        """Count from here."""
        self.bursts = {}


@dataclass(slots=True)
class Fate:
    """What became of the frames that the robot put on a bus.

    Attributes:
        sent: by the boards.
        unheard: while no port was open, or the adapter was unplugged or down.
        forgotten: those of them that had passed, and waited to be read when it was.
        lost, damaged, doubled: by mischief.
        dropped: because the buffer was full.
        read: by the daemon.
    """

    sent: int = 0
    unheard: int = 0
    forgotten: int = 0
    lost: int = 0
    damaged: int = 0
    doubled: int = 0
    dropped: int = 0
    read: int = 0


def _babbles(batch: FrameBatch) -> bool:
    """Return whether a node that babbles is among those that sent these frames."""
    return bool((batch.id == 0).any())


class Cable:
    """One bus.

    Args:
        name: of the bus.
        clock: time.
        move: brings the robot to the present, which calls `arrive` of each cable.
        command: gives a frame of the host to the robot.
        passes, loses: whether the bus itself passes frames now, and whether it loses some.
        rng: draws what happens to frames.
        trace: of what the daemon reads and sends.
        stacks: see `Sent`.

    Attributes:
        mischief: what happens to frames.
        state: of the interface, as the port is to find it.
        damaged_ns: when a frame was last damaged.
        blurred_ns: when frames last came late or in another order while a second board sent at
            their address, or a board's sweeps passed close together, or were lost, or held up by a
            node that babbles, while a second board sent: what belongs to which cannot be known
            then.
        fate: what became of the frames since the port was opened.
        sent: what passed over the bus.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        move: Callable[[], None],
        command: Callable[[str, int, bytes], None],
        passes: Callable[[], bool],
        loses: Callable[[], bool],
        rng: np.random.Generator,
        trace: Trace,
        stacks: frozenset[int] = frozenset(),
    ) -> None:
        self.name = name
        self.mischief = Mischief()
        self.state = LinkState.UP
        self.fate = Fate()
        self.sent = Sent(stacks)
        self.damaged_ns = self.blurred_ns = -(1 << 62)
        self.move = move
        self._clock = clock
        self._command = command
        self._passes, self._loses = passes, loses
        self._rng = rng
        self._trace = trace
        self._port: SimulatedPort | None = None
        self._waiting: list[FrameBatch] = []
        self._n_waiting = 0
        self._late: list[FrameBatch] = []
        self._twin: list[FrameBatch] = []
        #: Identifiers of the last batches, the arrays themselves; where in `read_ns` they are, and
        #: as bytes.
        self._ids: dict[int, tuple[NDArray[np.uint32], NDArray[np.intp], bytes]] = {}
        #: When a frame of each standard identifier was last read (ns, stepped time).
        self.read_ns = np.full(0x800, -(1 << 62), np.int64)

    def open(self, port: "SimulatedPort") -> None:
        """What waits for nobody is forgotten; from now on frames are kept for this port."""
        self.move()
        self._port = port
        self._forget()
        self.fate = Fate()
        self.sent.forget()

    def close(self, port: "SimulatedPort") -> None:
        """Frames are not kept any more, if they were kept for this port."""
        if self._port is port:
            self._port = None
            self._forget()

    def _forget(self) -> None:
        self.fate.unheard += self._n_waiting
        self.fate.forgotten += self._n_waiting
        self._waiting.clear()
        self._n_waiting = 0
        self._late.clear()

    def set_state(self, state: LinkState) -> None:
        """The interface goes down, comes up, is unplugged or plugged in."""
        self.move()
        self.state = state
        if state in (LinkState.GONE, LinkState.DOWN):
            self._forget()

    def arrive(self, batch: FrameBatch) -> None:
        """Frames that passed over the bus, stamped with the robot's time."""
        if self.mischief.twin is not None or self._twin:
            batch = self._with_twin(batch)
        n = len(batch)
        if not (n or self._late or self.mischief.twin is not None):
            return
        fate = self.fate
        fate.sent += n
        if self._port is None or self.state in (LinkState.GONE, LinkState.DOWN):
            fate.unheard += n
            return
        if n:
            self.sent.note(batch)
        what = self.mischief
        is_late = what.late or what.swapped or self._late
        if is_late or (what.twin is not None and (what.lost or self._loses() or _babbles(batch))):
            now_ns = self._clock.monotonic_ns()
            if what.twin is not None or now_ns - self.sent.crowded_ns < CROWDED_NS:
                self.blurred_ns = now_ns
        if n and self.mischief.any():
            batch = self._spoil(batch)
        if self._late:
            batch = self._with_late(batch)
        n = len(batch)
        if not n:
            return
        batch.t_ns = batch.t_ns + (self._clock.now_ns() - self._clock.monotonic_ns())
        room = BUFFER_FRAMES - self._n_waiting
        if n > room:
            fate.dropped += n - room
            self._port.counters.dropped += n - room
            batch = _rows(batch, slice(0, room))
            n = room
        self._n_waiting += n
        self._waiting.append(batch)

    def sleep_through(self, batch: FrameBatch) -> None:
        """Frames that passed while this computer was suspended."""
        self.fate.sent += len(batch)
        self.fate.unheard += len(batch)

    def _with_late(self, batch: FrameBatch) -> FrameBatch:
        """Add the frames that come late and have come by now."""
        others = join(self._late)
        due = others.t_ns <= self._clock.monotonic_ns()
        if not due.any():
            return batch
        self._late = [] if due.all() else [_rows(others, ~due)]
        batch = join([_rows(others, due), batch])
        return _rows(batch, np.argsort(batch.t_ns, kind="stable"))

    def _with_twin(self, batch: FrameBatch) -> FrameBatch:
        """Add what a second board at one address sends, in the order of time."""
        if self.mischief.twin is not None and len(batch):
            self._twin.append(self.mischief.second_board(batch))
        waiting = [one for one in self._twin if len(one)]
        self._twin = []
        if not waiting:
            return batch
        other = join(waiting)
        due = other.t_ns <= self._clock.monotonic_ns()
        self._twin = [_rows(other, ~due)]
        batch = join([batch, _rows(other, due)])
        return _rows(batch, np.argsort(batch.t_ns, kind="stable"))

    def _spoil(self, batch: FrameBatch) -> FrameBatch:
        what, rng, fate = self.mischief, self._rng, self.fate
        n = len(batch)
        if what.damaged:
            wrong = np.flatnonzero(rng.random(n) < what.damaged)
            bits = rng.integers(0, 64, len(wrong))
            batch.data[wrong, bits // 8] ^= (1 << bits % 8).astype(np.uint8)
            fate.damaged += len(wrong)
            if len(wrong):
                self.damaged_ns = self._clock.monotonic_ns()
        if what.swapped:
            order = np.arange(n)
            swapped = rng.random(max(n - 1, 0)) < what.swapped
            # After a stall, sweeps that passed one after the other come in one batch.
            swapped &= np.diff(batch.t_ns) < PAIR_NS
            for row in np.flatnonzero(swapped).tolist():
                order[[row, row + 1]] = order[[row + 1, row]]
            t_ns = batch.t_ns
            batch = _rows(batch, order)
            batch.t_ns = t_ns
        if what.doubled:
            times = 1 + (rng.random(n) < what.doubled)
            fate.doubled += int(times.sum()) - n
            batch = _rows(batch, np.repeat(np.arange(n), times))
            n = len(batch)
        if what.late:
            late = rng.random(n) < what.late
            if late.any():
                # They come by then, whenever somebody reads what came.
                others = _rows(batch, late)
                others.t_ns = others.t_ns + what.late_ns
                self._late.append(others)
                batch = _rows(batch, ~late)
                n = len(batch)
        if what.lost:
            kept = rng.random(n) >= what.lost
            fate.lost += n - int(np.count_nonzero(kept))
            batch = _rows(batch, kept)
        return batch

    def take(self) -> FrameBatch:
        """What waits, at most `CAPACITY` frames."""
        if not self._waiting:
            return _NOTHING
        batch = self._waiting[0] if len(self._waiting) == 1 else join(self._waiting)
        if self._n_waiting > CAPACITY:
            self._waiting = [_rows(batch, slice(CAPACITY, None))]
            batch = _rows(batch, slice(0, CAPACITY))
        else:
            self._waiting = []
        n = len(batch)
        self._n_waiting -= n
        self.fate.read += n
        now_ns = self._clock.monotonic_ns()
        ids = batch.id
        known = self._ids.get(id(ids))
        if known is None or known[0] is not ids:
            if len(self._ids) >= KEPT:
                self._ids.clear()
            known = self._ids[id(ids)] = ids, (ids & 0x7FF).astype(np.intp), ids.tobytes()
        self.read_ns[known[1]] = now_ns
        self._trace.data(now_ns, self.name, known[2], batch.data.tobytes())
        return batch

    def send(self, can_id: int, data: bytes) -> bool:
        """A frame of the host; False if nobody acknowledges it."""
        self.move()
        if not self._passes():
            return False
        self._trace.data(self._clock.monotonic_ns(), f"{self.name}<{can_id:03x}", data)
        self._command(self.name, can_id, data)
        return True

    def send_as_other_host(self, can_id: int, data: bytes) -> None:
        """A frame of another program on the bus, which the daemon receives as the boards do."""
        now_ns = self._clock.monotonic_ns()
        if self.send(can_id, data):
            self.arrive(FrameBatch.of([(can_id, data, now_ns)]))


class SimulatedPort(Port):
    """The daemon's end of a cable."""

    capacity = CAPACITY

    def __init__(self, cable: Cable, settings: Bus, clock: Clock) -> None:
        super().__init__(cable.name, settings, None, clock)
        self._cable = cable
        self.dead = False
        self.state = self._logged_state = cable.state
        cable.open(self)

    def read(self) -> FrameBatch:
        if self.dead:
            return _NOTHING
        cable = self._cable
        cable.move()
        if cable.state is not self.state:
            if self.state is LinkState.GONE:
                if not self._time_to_check():
                    return _NOTHING
                self.counters.reopened += 1
            self._enter(cable.state)
        if self.state is not self._logged_state:
            self._log_state()
        batch = cable.take()
        if batch is _NOTHING:
            return batch
        self.counters.frames += len(batch)
        if int(batch.id.max()) & ERROR_FLAG:
            self._note_errors(batch)
        return batch

    def close(self) -> None:
        self._cable.close(self)

    async def _try_send(self, message: can.Message) -> bool:
        if self.dead:
            return True
        if self.state in (LinkState.GONE, LinkState.DOWN):
            raise BusError(f'bus "{self.name}": {self.channel}: cannot send, {self.state}')
        return self._cable.send(message.arbitration_id, bytes(message.data))


def _rows(batch: FrameBatch, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> FrameBatch:
    return FrameBatch(batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows])
