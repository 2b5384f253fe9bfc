"""Assembles frames into sweeps: one assembler per bus.

A sweep is one board's values of one period. The frames have no sequence number and no guaranteed
order, so the end of a sweep is inferred: a slot (triangle and half) that comes twice, a pause, the
age of the sweep's first frame, or the usual first frame after late ones of the sweep before starts
a new one. A sweep is returned as soon as every awaited triangle is complete. A triangle that has
been missing for a while is no longer awaited, so that it causes no delay, until it sends again.

A board usually sends its frames in the same order. Once that order is known, a sweep or a run of
frames in it is recognised by one comparison of bytes and copied as a whole; all other frames are
taken one by one, with the same result.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import (
    HEAD_BYTES,
    HEADER_A,
    HEADER_B,
    MAIS_TYPES,
    MAX_STANDARD_ID,
    NS_PER_S,
    TAXELS,
    TRIANGLES,
    VALUES_A,
    FrameBatch,
    MessageClass,
    Records,
)
from skin_host.layout import BoardLayout

_T = TypeVar("_T", bound=np.generic)

#: A board sends the frames of a sweep in a burst, so a frame begins the next sweep that comes later
#: than this share of the period after the first of a sweep, and ...
PAUSE_PERIODS = 0.5
#: ... than this one after the last: measured from the last alone, a late frame would hide a pause.
GAP_PERIODS = 1 / 3
#: A triangle is awaited until it was missing in this many sweeps in a row.
PATIENCE_SWEEPS = 3
#: Expands a triangle's bit in a mask of triangles to its A and B bits in a mask of halves.
_BOTH = 1 << TRIANGLES | 1
#: The bytes of a frame after its header.
_PAYLOAD = 7
_NOTHING = bytes(_PAYLOAD)
_NO_STATUS = bytes(2 * TRIANGLES)
_ALL_TRIANGLES = (1 << TRIANGLES) - 1
#: The status words of a sweep without any.
NO_STATUS = np.zeros(TRIANGLES, np.uint16)
NO_STATUS.flags.writeable = False
_NUMBERS = np.arange(TRIANGLES)
_SMALLEST_DLC_B = 6
#: Fewer frames are taken one by one: that costs no more. At a batch's end any number is a run, so
#: that the rest of the sweep, with which the next batch begins, is one.
_SHORTEST_RUN = 5
#: What is stamped so much earlier than its sweep's first frame came after the clock was set back.
_SET_BACK_NS = 100_000_000
#: Where a frame's head has its length.
_DLC_AT = 4
#: Up to here heads identify a frame; then follows what is not read, and the header.
_PAD_AT = 5
#: After so many sweeps in another order than the known one, which lost frames cause too, the order
#: is learnt again, after a pause of so many sweeps.
_MOST_STRAY_SWEEPS = 4
_LEARN_AFTER_SWEEPS = 64
#: In which classes a board sends its A and its B frames, by the class that shows it: the stream,
#: the legacy stream, and a special firmware, whose A frames are as those of the stream.
_CLASSES: dict[int, tuple[MessageClass, MessageClass]] = {
    MessageClass.SKIN_STREAM: (MessageClass.SKIN_STREAM, MessageClass.SKIN_STREAM),
    MessageClass.ANALOG_STREAM: (MessageClass.ANALOG_STREAM, MessageClass.ANALOG_STREAM),
    MessageClass.BATTERY_STREAM: (MessageClass.SKIN_STREAM, MessageClass.BATTERY_STREAM),
}
#: By the header of a frame, its half.
_HALVES = {HEADER_A: 0, HEADER_B: 1}
#: A board that has sent nothing for so many periods may send in the legacy class from then on. It
#: pauses for fewer while it zeroes itself.
_LEFT_PERIODS = 10
_NEVER_NS = -(1 << 62)
#: Classes in which boards answer.
_ANSWERS = (MessageClass.ANALOG_COMMAND, MessageClass.MANAGEMENT)


class Sweep(NamedTuple):
    """One board's values of one period.

    Attributes:
        board: index into `Layout.boards`.
        raw: uint8[16, 12]; rows of missing triangles are 0.
        status: uint16[16], S0 << 8 | S1; 0 where no B frame came, or one without status bytes.
            Where only the B frame came it is there, and the triangle is not present.
        present: mask of triangles whose two frames came.
        t_ns: time of the sweep's last frame.
        missed: whole periods without any frame since the sweep before.
        crowded: it, or a part of one since the last, began within half a period of the one before,
            with a frame that was already in that: no board sends like that, but two at one address
            do.
    """

    board: int
    raw: NDArray[np.uint8]
    status: NDArray[np.uint16]
    present: int
    t_ns: int
    missed: int
    crowded: bool = False


class Assembled(NamedTuple):
    """Sweeps and answers from the frames of a batch.

    Attributes:
        sweeps: those that were completed; for each board in order of time.
        answers: (identifier, payload) of frames of the classes in which boards answer.
    """

    sweeps: list[Sweep]
    answers: list[tuple[int, bytes]]


@dataclass(slots=True)
class AssemblerCounters:
    """Counts all frames that did not become part of a sweep, and everything that was missing."""

    frames: int = 0
    #: Frames outside the skin stream, as answers, other sensors and unconfigured nodes, also those
    #: at a board's address in a class in which it does not send, and skin frames of boards that
    #: others read.
    other: int = 0
    #: Of the configured force/torque boards.
    force_torque: int = 0
    wrong_header: int = 0
    short: int = 0
    #: Skin frames of a board that is not configured on this bus.
    unknown_board: int = 0
    #: Skin frames of a triangle that is not configured.
    unknown_triangle: int = 0
    #: Frames of a triangle that was no longer awaited, too late for their sweep.
    late: int = 0
    #: Frames that came twice in a row.
    doubled: int = 0
    sweeps: int = 0
    #: Sweeps returned without a triangle that was awaited.
    incomplete: int = 0
    #: Triangles of which only one frame arrived before the board's next sweep.
    halves: int = 0
    #: Whole periods without a frame from a board that had been sending.
    missed: int = 0


class _Order(NamedTuple):
    """The order in which a board sends the frames of its sweeps.

    Attributes:
        heads: of all frames, `HEAD_BYTES` each.
        places: of each frame, its place among the board's values.
        first: the half of the first frame.
        missing: masks of the halves that are missing before each frame, and after the last.
        keys: what of the heads identifies the frames: identifier, DLC, and the data's header.
        n: how many frames.
        values: where `gathers` have the values: after the keys, before the status words.
        no_status: the status words of a sweep without any.
        triangles: those that it sends, in rising order; None for all.
        gathers: by the size of a record and the place of its head, the places of the keys of all
            frames, and of the values and then the status words of all triangles, among the octets
            of a sweep.
    """

    heads: bytes
    places: list[int]
    first: int
    missing: list[int]
    keys: bytes
    n: int
    values: slice
    no_status: bytes
    triangles: NDArray[np.intp] | None
    gathers: dict[tuple[int, int], NDArray[np.intp]]

    @classmethod
    def of(cls, heads: Sequence[bytes], places: Sequence[int], missing: Sequence[int]) -> "_Order":
        triangles = np.array(sorted({place // 2 for place in places}), np.intp)
        n = len(places)
        keys = b"".join(head[:_PAD_AT] + head[-1:] for head in heads)
        return cls(
            b"".join(heads),
            list(places),
            1 << places[0] // 2 + places[0] % 2 * TRIANGLES,
            [*missing, 0],
            keys,
            n,
            slice(len(keys), len(keys) + n // 2 * TAXELS),
            bytes(n),
            None if len(triangles) == TRIANGLES else triangles,
            {},
        )

    def gather(self, size: int, head: int) -> NDArray[np.intp]:
        """Return the one of `gathers` for records of this form."""
        found = self.gathers.get((size, head))
        if found is None:
            data = head + HEAD_BYTES
            begins = {place: number * size for number, place in enumerate(self.places)}
            triangles = sorted({place // 2 for place in self.places})
            places: list[int] = []
            for number in range(len(self.places)):
                begin = number * size + head
                places += [*range(begin, begin + _PAD_AT), begin + HEAD_BYTES - 1]
            for triangle in triangles:
                for half, count in enumerate((VALUES_A, TAXELS - VALUES_A)):
                    begin = begins[2 * triangle + half] + data
                    places += range(begin, begin + count)
            for triangle in triangles:
                begin = begins[2 * triangle + 1] + data + TAXELS - VALUES_A
                places += begin, begin + 1
            found = self.gathers[size, head] = np.array(places, np.intp)
        return found


@dataclass(slots=True)
class _BoardState:
    """One board's sweep in progress; masks have bits 0-15 for A frames, 16-31 for B frames.

    Attributes:
        wanted: halves that the configured triangles send.
        classes: of its A and of its B frames.
        without_b: sweeps in succession that had A frames alone; of the first ones, one is enough.
        awaited: halves without which a sweep is not complete.
        missing: halves of `awaited` that have not arrived; 0 between sweeps.
        values: received bytes of each triangle, A and B in turn.
        order: in which it sends, once that is known.
        came: (head, place, missing before it) of the frames of a sweep from which it is learnt.
        lone: halves of the last sweep of which the other has not come.
        done: frames of the sweep that came in this order; the next has the place `expected`, which
            is -1 while runs are not looked for.
        begun: the frames so far, as records, of a sweep that batches divide and that came in this
            order from its first frame; their payloads are not among `values` yet.
        stray: sweeps in succession with frames in another order.
        learn_after: so many sweeps pass before the order is learnt.
        crowded: see `Sweep`, since the last one that was returned.
        first: the half with which the sweep began.
        usual: that of the last sweep of which no half was missing; 0 while there is none.
        amid: whether the sweep began with another half than the usual one.
        sent_last_ns, sent_before_ns: time of the last frame of the last sweep, and of the one
            before.
        missed: see `Sweep`, of the last sweep.
        set_ns: by how much the clock was set since the last sweep before that.
    """

    index: int
    period_ns: int
    pause_ns: int
    gap_ns: int
    close_ns: int
    wanted: int
    awaited: int
    classes: tuple[MessageClass, MessageClass] = _CLASSES[MessageClass.SKIN_STREAM]
    without_b: int = PATIENCE_SWEEPS - 1
    missing: int = 0
    first_ns: int = 0
    last_ns: int = _NEVER_NS
    certain_until_ns: int = 0
    sent: int = 0
    lone: int = 0
    sent_first_ns: int = _NEVER_NS
    sent_last_ns: int = 0
    sent_before_ns: int = 0
    missed: int = 0
    set_ns: int = 0
    last_place: int = -1
    values: list[bytes] = field(default_factory=lambda: [_NOTHING] * 2 * TRIANGLES)
    absent_for: list[int] = field(default_factory=lambda: [0] * TRIANGLES)
    any_absent: bool = False
    order: _Order | None = None
    came: list[tuple[bytes, int, int]] | None = None
    done: int = 0
    expected: int = -1
    begun: bytes = b""
    stray: int = 0
    learn_after: int = 1
    crowded: bool = False
    first: int = 0
    usual: int = 0
    amid: bool = False

    def unpack(self) -> None:
        """Take the payloads of the frames in `begun`."""
        if self.order is not None and self.begun:
            size = len(self.begun) // self.done
            for number, place in enumerate(self.order.places[: self.done], 1):
                self.values[place] = self.begun[number * size - _PAYLOAD : number * size]
        self.begun = b""


class Assembler:
    """Assembles the frames of one bus's boards into sweeps.

    Args:
        boards: (index in `Layout.boards`, board) of the boards on this bus.
        close_periods: a sweep is closed when its first frame is this many periods old.
        force_torque: identifiers of the data of the configured force/torque boards.
        others: addresses of the configured boards of this bus that another node reads.

    Attributes:
        stranger_id: the most frequent identifier among motor frames, when these were last more than
            half of a batch; otherwise None.
        unconfigured: frames of the skin stream by address of a board that is not configured.
    """

    def __init__(
        self,
        boards: list[tuple[int, BoardLayout]],
        close_periods: float,
        force_torque: frozenset[int] = frozenset(),
        others: frozenset[int] = frozenset(),
    ) -> None:
        self.counters = AssemblerCounters()
        self.stranger_id: int | None = None
        self.unconfigured: Counter[int] = Counter()
        self._force_torque = force_torque
        self._others = others
        self._states: dict[int, _BoardState] = {}
        # For identifier << 8 | header byte of each frame that a configured triangle sends, in the
        # classes of its board: the board, the place among its values, and the bit in its masks.
        self._slots: dict[int, tuple[_BoardState, int, int]] = {}
        #: By the head of the frame with which they usually begin a sweep: boards of known order.
        self._first: dict[bytes, _BoardState] = {}
        #: The board whose sweep in known order the last batch has cut.
        self._cut: _BoardState | None = None
        #: No sweep in progress is too old up to here, on the clock of the frames.
        self._none_old_until_ns = _NEVER_NS
        for index, board in boards:
            period_ns = board.settings.period_ms * 1_000_000
            wanted = 0
            for triangle in board.triangles:
                wanted |= _BOTH << triangle
            state = _BoardState(
                index,
                period_ns,
                int(PAUSE_PERIODS * period_ns),
                int(GAP_PERIODS * period_ns),
                int(close_periods * period_ns),
                wanted,
                wanted,
            )
            self._states[board.settings.address] = state
            self._add_slots(board.settings.address, state)
        closes_ns = [state.close_ns for state in self._states.values()]
        self._longest_close_ns = max(closes_ns, default=0)

    def feed(self, batch: FrameBatch) -> Assembled:
        """Process the frames of a batch; this is the only loop over them."""
        # One frame after the other: for the thirty to hundred frames of a read, this costs less
        # than masks and scatters over arrays, and a batch may span several sweeps.
        sweeps: list[Sweep] = []
        answers: list[tuple[int, bytes]] = []
        motors: list[int] = []
        if not batch:
            return Assembled(sweeps, answers)
        slots = self._slots
        records = batch.records()
        octets, form, head_at = records
        n = len(octets)
        self.counters.frames += n
        text = octets.tobytes()
        size = form.size
        heads = b""
        rising = batch.rising
        at = 0
        while at < n:
            if rising:
                taken = 0
                cut, self._cut = self._cut, None
                if cut is not None:
                    taken = self._take_sweep(cut, records, text, at, sweeps)
                if not taken:
                    begin = at * size + head_at
                    known = self._first.get(text[begin : begin + HEAD_BYTES])
                    if known is not None:
                        taken = self._take_sweep(known, records, text, at, sweeps)
                if taken:
                    at += taken
                    continue
            if not heads:
                heads = octets[:, head_at : head_at + HEAD_BYTES].tobytes()
            left = form.iter_unpack(memoryview(text)[at * size :])
            for seconds, nanoseconds, identifier, dlc, header, payload in left:
                at += 1
                slot = slots.get(identifier << 8 | header)
                if slot is None or dlc < 8:
                    t_ns = seconds * NS_PER_S + nanoseconds
                    if not self._usable(identifier, dlc, header, t_ns, sweeps):
                        message_class = identifier >> 8
                        if message_class in _ANSWERS:
                            answers.append((identifier, (bytes((header,)) + payload)[:dlc]))
                        elif message_class < MessageClass.ANALOG_COMMAND:
                            motors.append(identifier)
                        continue
                    slot = slots[identifier << 8 | header]
                    if dlc < 8:
                        # Old firmware sends no status; the bytes after the DLC are not defined.
                        payload = payload[: TAXELS - VALUES_A] + b"\0\0"  # noqa: PLW2901
                state, place, bit = slot
                if state.begun:
                    state.unpack()
                t_ns = seconds * NS_PER_S + nanoseconds
                if place == state.expected and rising and state.first_ns <= t_ns:
                    taken = self._take_run(state, records, heads, at - 1, sweeps)
                    if taken:
                        at += taken - 1
                        break
                if place == state.last_place and self._is_doubled(state, bit, payload, t_ns):
                    continue
                if (
                    bit & state.missing and state.first_ns <= t_ns <= state.certain_until_ns
                ) or self._belongs(state, bit, t_ns, sweeps):
                    if state.came is not None:
                        head = heads[(at - 1) * HEAD_BYTES : at * HEAD_BYTES]
                        state.came.append((head, place, state.missing))
                    state.values[place] = payload
                    state.last_place = place
                    state.last_ns = t_ns
                    state.missing ^= bit
                    if not state.missing:
                        self._close(state, sweeps)
        if 2 * len(motors) > n:
            ((self.stranger_id, _),) = Counter(motors).most_common(1)
        return Assembled(sweeps, answers)

    def expire(self, now_ns: int) -> list[Sweep]:
        """Return the sweeps whose time has passed, complete or not.

        Args:
            now_ns: the time, on the clock of the frames' time stamps.
        """
        sweeps: list[Sweep] = []
        for state in self._states.values():
            if state.missing and now_ns - state.first_ns > state.close_ns:
                self._close(state, sweeps)
        return sweeps

    def clock_set(self, step_ns: int) -> None:
        """Take no sweeps for missed in time that passed only on the clock of the time stamps.

        Args:
            step_ns: by how much it was set, negative if back. Frames of the time before may follow.
        """
        for state in self._states.values():
            state.set_ns += step_ns

    def flush(self) -> list[Sweep]:
        """Return all sweeps in progress, at the end of a recording."""
        sweeps = self.expire(1 << 62)
        for state in self._states.values():
            self._count_lone(state)
        return sweeps

    def _add_slots(self, address: int, state: _BoardState) -> None:
        for triangle in range(TRIANGLES):
            if state.wanted >> triangle & 1:
                for header, half in _HALVES.items():
                    key = (state.classes[half] << 8 | address << 4 | triangle) << 8 | header
                    bit = 1 << triangle + half * TRIANGLES
                    self._slots[key] = state, 2 * triangle + half, bit

    def _usable(
        self, identifier: int, dlc: int, header: int, t_ns: int, sweeps: list[Sweep]
    ) -> bool:
        """Count a frame that is not a complete one of a configured triangle in its board's classes.

        Returns whether it is a configured triangle's after all: a B frame that only lacks its
        status, or the first in a class in which its board sends from now on.
        """
        counters = self.counters
        message_class = identifier >> 8
        is_skin = message_class == MessageClass.SKIN_STREAM
        half = _HALVES.get(header)
        if identifier in self._force_torque:
            counters.force_torque += 1
        elif dlc == 0 or identifier > MAX_STANDARD_ID:
            counters.other += 1
        elif is_skin and half is None:
            counters.wrong_header += 1
        elif is_skin and dlc < (_SMALLEST_DLC_B if half else 8):
            counters.short += 1
        elif (
            half is None
            or message_class not in _CLASSES
            or message_class != _CLASSES[message_class][half]
            # Other sensors use the legacy class too, most with fewer bytes.
            or (dlc < 8 and not is_skin)
            or self._may_be_mais(identifier)
        ):
            counters.other += 1
        else:
            return self._is_of_skin(identifier, half, t_ns, sweeps)
        return False

    def _may_be_mais(self, identifier: int) -> bool:
        """Whether a frame may be of joints: no skin board is configured at its address."""
        legacy = identifier >> 8 == MessageClass.ANALOG_STREAM and identifier & 0xF in MAIS_TYPES
        return legacy and identifier >> 4 & 0xF not in self._states

    def _is_of_skin(self, identifier: int, half: int, t_ns: int, sweeps: list[Sweep]) -> bool:
        """Return whether a frame with the form of a half is that of a configured triangle, in whose
        class its board then sends; count it otherwise.
        """
        address, triangle = identifier >> 4 & 0xF, identifier & 0xF
        state = self._states.get(address)
        if state is None:
            if address in self._others:
                self.counters.other += 1
            else:
                self.counters.unknown_board += 1
                self.unconfigured[address] += 1
        elif not self._may_send_in(state, identifier >> 8, half, t_ns):
            self.counters.other += 1
        elif not state.wanted >> triangle & 1:
            self.counters.unknown_triangle += 1
        else:
            if identifier >> 8 != state.classes[half]:
                self._change_classes(address, identifier >> 8, sweeps)
            return True
        return False

    @staticmethod
    def _may_send_in(state: _BoardState, message_class: int, half: int, t_ns: int) -> bool:
        """Return whether a frame of this class, which other sensors use too, may be of a board.

        Nothing else sends in the class of the stream. So a board that does so is of the special
        firmware only if all its B frames are missing there, and of the legacy stream only if
        nothing comes there.
        """
        if message_class in (state.classes[half], MessageClass.SKIN_STREAM):
            return True
        if message_class == MessageClass.ANALOG_STREAM:
            return abs(t_ns - state.last_ns) > _LEFT_PERIODS * state.period_ns
        came = state.awaited & ~state.missing if state.missing else 0
        return (
            state.classes[0] == MessageClass.SKIN_STREAM
            and state.without_b >= PATIENCE_SWEEPS
            and not came >> TRIANGLES
        )

    def _change_classes(self, address: int, message_class: int, sweeps: list[Sweep]) -> None:
        """A board sends in other classes from now on: nothing that came before joins it."""
        state = self._states[address]
        if message_class != MessageClass.BATTERY_STREAM:
            if state.missing:
                self._close(state, sweeps)
            self._count_lone(state)
            state.sent_first_ns, state.last_place = _NEVER_NS, -1
        state.order = state.came = None
        state.expected, state.stray, state.learn_after = -1, 0, 1
        for key in [key for key, (of, _, _) in self._slots.items() if of is state]:
            del self._slots[key]
        state.classes = _CLASSES[message_class]
        self._add_slots(address, state)

    def _is_doubled(self, state: _BoardState, bit: int, payload: bytes, t_ns: int) -> bool:
        """Count the frame that the board sent last, if it comes once more.

        A receiver that saw an error in the last bit of a frame gets it again, as do two
        gateways in parallel. The board itself sends the same slot a period later.
        """
        first_ns = state.first_ns if state.missing else state.sent_first_ns
        same = not bit & state.missing and state.values[state.last_place] == payload
        if not same or not 0 <= t_ns - first_ns <= state.pause_ns:
            return False
        self.counters.doubled += 1
        return True

    @staticmethod
    def _expect_order(state: _BoardState) -> None:
        """A sweep begins: expect its frames in the known order, or learn the order from it."""
        state.came = None
        if state.order is not None:
            state.done, state.expected = 1, state.order.places[1]
        elif state.learn_after:
            state.learn_after -= 1
        elif state.awaited == state.wanted:
            state.came = []

    def _take_sweep(
        self, state: _BoardState, records: Records, text: bytes, at: int, sweeps: list[Sweep]
    ) -> int:
        """Take frames of a sweep that begins at `at` in the board's order, or continues after the
        frames in `begun`, up to its end or that of the batch; return their number.

        They are taken if the sweep before was whole, too, and no frame would need a closer look
        alone.

        Args:
            state: of the board.
            records: of the batch.
            text: their octets.
            at: number of the first frame.
            sweeps: what is extended by the sweep.
        """
        order = state.order
        if order is None:
            return 0
        octets, form, head = records
        places, size = order.places, form.size
        done = state.done if state.begun else 0
        n = order.n - done
        begin, end = at * size, (at + n) * size
        if end > len(text):
            end = len(text)
            n = end // size - at
        seconds, nanoseconds, _, _, _, payload = form.unpack_from(text, end - size)
        last_ns = seconds * NS_PER_S + nanoseconds
        if done:
            first_ns = state.first_ns
            seconds, nanoseconds, *_ = form.unpack_from(text, begin)
            # What is older than the first frame needs a closer look.
            if (
                not first_ns
                <= seconds * NS_PER_S + nanoseconds
                <= last_ns
                <= state.certain_until_ns
            ):
                return 0
            if len(state.begun) != done * size:
                return 0
        else:
            seconds, nanoseconds, *_ = form.unpack_from(text, begin)
            first_ns = seconds * NS_PER_S + nanoseconds
            if (
                state.missing
                or state.sent != state.awaited
                or order.missing[0] != state.awaited
                or last_ns - first_ns > min(state.pause_ns, state.close_ns)
                or 0 < 2 * (first_ns - state.sent_first_ns) < state.period_ns
                or state.last_place == places[0]
            ):
                return 0
        if done + n < order.n:
            heads = octets[at:, head : head + HEAD_BYTES].tobytes()
            if heads != order.heads[done * HEAD_BYTES : (done + n) * HEAD_BYTES]:
                return 0
            if not done:
                self._close_old(first_ns, sweeps)
                state.first_ns = first_ns
                state.first, state.amid = order.first, False
                state.certain_until_ns = first_ns + min(state.pause_ns, state.close_ns)
            done += n
            state.begun += text[begin:]
            state.done, state.expected = done, places[done]
            state.missing = order.missing[done]
            state.last_place, state.last_ns = places[done - 1], last_ns
            state.stray = 0
            self._cut = state
            return n
        if done:
            frames = np.frombuffer(state.begun + text[begin:end], np.uint8)
        else:
            frames = np.frombuffer(text, np.uint8, end - begin, begin)
        # One call of numpy for all that is needed of the frames.
        got = frames[order.gather(size, head)]
        line = got.tobytes()
        if not line.startswith(order.keys):
            return 0
        raw = got[order.values].reshape(-1, TAXELS)
        status = NO_STATUS
        if not line.endswith(order.no_status):
            status = got[order.values.stop :].view(">u2").astype(np.uint16)
        if order.triangles is not None:
            raw = _spread(raw, order.triangles)
            if status is not NO_STATUS:
                status = _spread(status, order.triangles)
        state.values[places[-1]] = payload
        state.last_place = places[-1]
        state.usual = order.first
        state.stray = 0
        if done:
            state.begun, state.missing, state.expected = b"", 0, -1
        else:
            self._close_old(first_ns, sweeps)
        missed = self._count_sweep(state, last_ns)
        if state.any_absent:
            state.absent_for = [0] * TRIANGLES
            state.any_absent = False
        present = state.awaited & _ALL_TRIANGLES
        sweeps.append(Sweep(state.index, raw, status, present, last_ns, missed, state.crowded))
        state.crowded = False
        state.first_ns = state.sent_first_ns = first_ns
        state.last_ns = last_ns
        return n

    def _take_run(
        self, state: _BoardState, records: Records, heads: bytes, at: int, sweeps: list[Sweep]
    ) -> int:
        """Take the frames from `at` on that come in the board's order; return how many.

        They are taken if none of them would need a closer look alone.
        """
        order = state.order
        assert order is not None
        done = state.done
        left = len(records.octets) - at
        n = min(len(order.places) - done, left)
        begin, end = done * HEAD_BYTES, (done + n) * HEAD_BYTES
        state.expected = -1
        if state.missing != order.missing[done] or not heads.startswith(
            order.heads[begin:end], at * HEAD_BYTES
        ):
            self._note_stray(state)
            return 0
        if n < _SHORTEST_RUN and n < left:
            return 0
        size = records.form.size
        last = records.form.unpack_from(records.octets.data, (at + n - 1) * size)
        t_ns = last[0] * NS_PER_S + last[1]
        if t_ns > state.certain_until_ns:
            return 0
        payload = records.octets[at : at + n, records.head + HEAD_BYTES : size].tobytes()
        places = order.places[done : done + n]
        for number, place in enumerate(places):
            state.values[place] = payload[number * _PAYLOAD : (number + 1) * _PAYLOAD]
        done += n
        state.last_place = places[-1]
        state.last_ns = t_ns
        state.missing = order.missing[done]
        state.stray = 0
        if state.missing:
            state.done, state.expected = done, order.places[done]
        else:
            self._close(state, sweeps)
        return n

    @staticmethod
    def _note_stray(state: _BoardState) -> None:
        """A sweep did not come in the known order."""
        state.stray += 1
        if state.stray == _MOST_STRAY_SWEEPS:
            state.order, state.stray, state.learn_after = None, 0, _LEARN_AFTER_SWEEPS

    def _belongs(self, state: _BoardState, bit: int, t_ns: int, sweeps: list[Sweep]) -> bool:
        """Handle a frame that is not the next one of a sweep in progress.

        It may begin a sweep, which ends the one before, or belong to a triangle that was not
        awaited. Returns False if it came too late for its sweep.
        """
        came = state.awaited & ~state.missing if state.missing else 0
        begins = state.amid and bit == state.usual and self._is_after_late(state, came, t_ns)
        if (
            came.bit_count() == 1
            and max(state.sent_last_ns, state.sent_before_ns) <= t_ns < state.first_ns
        ):
            # The first frame's stamp was ahead. By that, the sweep would last into the next one.
            state.first_ns = state.last_ns = t_ns
        if state.missing and (
            begins
            or came & bit
            or t_ns > self._ends_ns(state, state.first_ns, state.last_ns)
            or t_ns < state.first_ns - _SET_BACK_NS
        ):
            self._close(state, sweeps)
        if not bit & state.awaited:
            triangle = (bit.bit_length() - 1) % TRIANGLES
            both = _BOTH << triangle
            state.awaited |= both
            state.absent_for[triangle] = 0
            if state.missing:
                state.missing |= both
        if not state.missing:
            since_ns = t_ns - state.sent_first_ns
            is_near = -_SET_BACK_NS <= since_ns <= state.pause_ns
            if not (bit & state.sent or begins) and is_near:
                # Its sweep was returned without it: the triangle was not awaited, or the frame was
                # held up for longer than a sweep is waited for.
                self.counters.late += 1
                state.lone &= ~(bit << TRIANGLES | bit >> TRIANGLES)
                return False
            if bit & state.sent and 0 < 2 * (t_ns - state.sent_first_ns) < state.period_ns:
                state.crowded = True
            if state.lone:
                self._count_lone(state)
            self._close_old(t_ns, sweeps)
            state.missing = state.awaited
            state.first_ns = t_ns
            state.first, state.amid = bit, state.usual not in (0, bit)
            self._expect_order(state)
        ends_ns = self._ends_ns(state, state.first_ns, t_ns)
        if state.amid:
            # Until then the usual first frame begins no other.
            came = state.awaited & ~state.missing | bit
            ends_ns = min(ends_ns, state.first_ns + self._slowest_ns(state, came))
        state.certain_until_ns = ends_ns
        return True

    def _is_after_late(self, state: _BoardState, came: int, t_ns: int) -> bool:
        """Return whether the halves that came of a sweep in progress are of the one before, and
        late, or stamped as if they were: that lacks them all, and no board sends so slowly.
        """
        if not came or came & state.sent:
            return False
        return abs(t_ns - state.first_ns) > self._slowest_ns(state, came)

    @staticmethod
    def _slowest_ns(state: _BoardState, came: int) -> int:
        """Return how long the slowest board, whose sweeps take all of a period, sends so many."""
        return came.bit_count() * state.period_ns // (2 * TRIANGLES)

    @staticmethod
    def _ends_ns(state: _BoardState, first_ns: int, last_ns: int) -> int:
        """Return until when frames belong to a sweep with such a first and last frame."""
        paused_ns = max(first_ns + state.pause_ns, last_ns + state.gap_ns)
        return min(paused_ns, first_ns + state.close_ns)

    def _close_old(self, now_ns: int, sweeps: list[Sweep]) -> None:
        """End sweeps whose time has passed when another begins, which may be read much later.

        A bus keeps the order of its frames. So what began before a pause of the reader, or of the
        bus, comes before what began after it.
        """
        # One stamp that is far ahead does not show that none is old until then.
        if 0 <= self._none_old_until_ns - now_ns <= self._longest_close_ns:
            return
        sweeps += self.expire(now_ns)
        self._none_old_until_ns = min(
            (state.first_ns if state.missing else now_ns) + state.close_ns
            for state in self._states.values()
        )

    def _count_lone(self, state: _BoardState) -> None:
        """Count the lone frames of the last sweep: what was held up has come by now."""
        self.counters.halves += state.lone.bit_count()
        state.lone = 0

    def _close(self, state: _BoardState, sweeps: list[Sweep]) -> None:
        """End a sweep."""
        if state.begun:
            state.unpack()
        got = state.awaited & ~state.missing
        state.without_b = 0 if got >> TRIANGLES else state.without_b + 1
        present = got & got >> TRIANGLES
        missed = self._count_sweep(state, state.last_ns)
        values = np.frombuffer(bytearray().join(state.values), np.uint8)
        triangles = values.reshape(TRIANGLES, 2 * _PAYLOAD)
        if state.expected >= 0:
            # The second frame of the known order came first, or not at all.
            self._note_stray(state)
            state.expected = -1
        if got != state.wanted:
            self.counters.incomplete += state.missing != 0
            state.lone = got ^ present * _BOTH
            triangles[_without(present), :TAXELS] = 0
            # A status word is whole without the other half of its triangle.
            triangles[_without(got >> TRIANGLES), TAXELS:] = 0
            self._note_absent(state, present)
        else:
            if state.any_absent:
                state.absent_for = [0] * TRIANGLES
                state.any_absent = False
            state.usual = state.first
            if state.came is not None:
                self._learn_order(state, state.came)
        if present:
            raw, status = triangles[:, :TAXELS], NO_STATUS
            if triangles[:, TAXELS:].tobytes() != _NO_STATUS:
                status = triangles[:, TAXELS:].copy().view(">u2")[:, 0].astype(np.uint16)
            t_ns = state.last_ns
            sweeps.append(Sweep(state.index, raw, status, present, t_ns, missed, state.crowded))
            state.crowded = False
        state.sent = got
        state.sent_first_ns = state.first_ns
        state.missing = 0

    def _count_sweep(self, state: _BoardState, last_ns: int) -> int:
        """Count a sweep and those missed since the board's last one; return the latter."""
        missed = 0
        passed_ns = last_ns - state.sent_last_ns
        if abs(passed_ns) > _SET_BACK_NS:
            # A time that is far from those before and after it, which are near each other, is a
            # damaged stamp: no time passed up to it, or from it on.
            since_ns = last_ns - state.sent_before_ns
            if abs(since_ns) < min(abs(passed_ns), abs(passed_ns - since_ns)):
                self.counters.missed -= state.missed
                passed_ns, state.sent_last_ns = since_ns, state.sent_before_ns
        state.sent_before_ns, state.sent_last_ns = state.sent_last_ns, last_ns
        if state.set_ns:
            unset_ns = passed_ns - state.set_ns
            # Not so while sweeps follow that were stamped before the clock was set.
            if abs(unset_ns - state.period_ns) < abs(passed_ns - state.period_ns):
                passed_ns, state.set_ns = unset_ns, 0
        if state.sent_before_ns and 2 * passed_ns >= 3 * state.period_ns:
            missed = round(passed_ns / state.period_ns) - 1
            self.counters.missed += missed
        state.missed = missed
        self.counters.sweeps += 1
        return missed

    def _learn_order(self, state: _BoardState, came: list[tuple[bytes, int, int]]) -> None:
        """Note the order of a complete sweep, if its frames are of full length."""
        state.came = None
        heads, places, missing = zip(*came, strict=True)
        if len(places) < _SHORTEST_RUN or any(head[_DLC_AT] < 8 for head in heads):
            state.learn_after = _LEARN_AFTER_SWEEPS
            return
        state.order = _Order.of(heads, places, missing)
        self._first[heads[0]] = state

    @staticmethod
    def _note_absent(state: _BoardState, present: int) -> None:
        for triangle in range(TRIANGLES):
            if present >> triangle & 1:
                state.absent_for[triangle] = 0
            elif state.wanted >> triangle & 1:
                state.absent_for[triangle] += 1
                state.any_absent = True
                if state.absent_for[triangle] >= PATIENCE_SWEEPS:
                    state.awaited &= ~(_BOTH << triangle)
        if not state.awaited:
            state.awaited = state.wanted


def _without(bits: int) -> NDArray[np.bool_]:
    """Return which triangles bool[16] have no bit in a mask."""
    missing: NDArray[np.bool_] = bits >> _NUMBERS & 1 == 0
    return missing


def _spread(array: NDArray[_T], triangles: NDArray[np.intp]) -> NDArray[_T]:
    """Return the rows of some triangles [m, ...] among those of all, [16, ...]; others are 0."""
    spread = np.zeros((TRIANGLES, *array.shape[1:]), array.dtype)
    spread[triangles] = array
    return spread
