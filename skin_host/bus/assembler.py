"""Assembles frames into sweeps: one assembler per bus.

A sweep is one board's values of one period. The frames have no sequence number and no guaranteed
order, so the end of a sweep is inferred: a slot (triangle and half) that comes twice, a pause, the
age of the sweep's first frame, or the first frame after late ones of the sweep before starts a new
one. A sweep is returned as soon as every awaited triangle is complete. A triangle that has been
missing for a while is no longer awaited, so that it causes no delay, until it sends again.

A board usually sends its frames in the same order. Once that order is known, a sweep or a run of
frames in it is recognised by one comparison of bytes and copied as a whole; all other frames are
taken one by one, with the same result.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.classes import BoardClasses, FrameCounters, FrameForms
from skin_host.bus.order import SHORTEST_RUN, BoardOrder
from skin_host.bus.periods import SET_BACK_NS, BoardPeriods
from skin_host.bus.wire import (
    ALL_TRIANGLES,
    HEAD_BYTES,
    NO_STATUS,
    NS_PER_S,
    TAXELS,
    TRIANGLES,
    VALUES_A,
    FrameBatch,
    MessageClass,
    Records,
)
from skin_host.layout import BoardLayout

#: A triangle is awaited until it was missing in this many sweeps in a row.
PATIENCE_SWEEPS = 3
#: Expands a triangle's bit in a mask of triangles to its A and B bits in a mask of halves.
_BOTH = 1 << TRIANGLES | 1
#: The bytes of a frame after its header.
_PAYLOAD = 7
_NOTHING = bytes(_PAYLOAD)
_NO_STATUS = bytes(2 * TRIANGLES)
_NUMBERS = np.arange(TRIANGLES)
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
        unread: mask of triangles that are not configured and were sent since the sweep before.
    """

    board: int
    raw: NDArray[np.uint8]
    status: NDArray[np.uint16]
    present: int
    t_ns: int
    missed: int
    crowded: bool = False
    unread: int = 0


class Assembled(NamedTuple):
    """Sweeps and answers from the frames of a batch.

    Attributes:
        sweeps: those that were completed; for each board in order of time.
        answers: (identifier, payload) of frames of the classes in which boards answer.
    """

    sweeps: list[Sweep]
    answers: list[tuple[int, bytes]]


@dataclass(slots=True)
class AssemblerCounters(FrameCounters):
    """Counts all frames that did not become part of a sweep, and everything that was missing."""

    #: Frames of a triangle that was no longer awaited, too late for their sweep, and those that had
    #: waited for them.
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


@dataclass(slots=True)
class _BoardState:
    """One board's sweep in progress; masks have bits 0-15 for A frames, 16-31 for B frames.

    Attributes:
        wanted: halves that the configured triangles send.
        awaited: halves without which a sweep is not complete.
        missing: halves of `awaited` that have not arrived; 0 between sweeps.
        values: received bytes of each triangle, A and B in turn.
        came: (head, place, missing before it) of the frames of a sweep from which the order is
            learnt.
        sent: halves of the last sweep that came.
        lone: those of them of which the other has not come.
        done: frames of the sweep that came in the known order; the next has the place `expected`,
            which is -1 while runs are not looked for.
        begun: the frames so far, as records, of a sweep that batches divide and that came in this
            order from its first frame; their payloads are not among `values` yet.
        crowded, unread: see `Sweep`, since the last one that was returned.
        first: the half with which the sweep began.
        usual: that of the last sweep of which no half was missing; 0 while there is none.
        lasted_ns: how long the last such sweep lasted whose frames were not taken together.
        amid: whether the sweep began with another half than the usual one.
        is_rest: whether it may be the end of the sweep before: what came of that is sent before the
            half with which it began.
    """

    index: int
    wanted: int
    awaited: int
    classes: BoardClasses
    periods: BoardPeriods
    order: BoardOrder = field(default_factory=BoardOrder)
    missing: int = 0
    first_ns: int = 0
    last_ns: int = _NEVER_NS
    certain_until_ns: int = 0
    sent: int = 0
    sent_first_ns: int = _NEVER_NS
    lone: int = 0
    last_place: int = -1
    values: list[bytes] = field(default_factory=lambda: [_NOTHING] * 2 * TRIANGLES)
    absent_for: list[int] = field(default_factory=lambda: [0] * TRIANGLES)
    any_absent: bool = False
    came: list[tuple[bytes, int, int]] | None = None
    done: int = 0
    expected: int = -1
    begun: bytes = b""
    crowded: bool = False
    unread: int = 0
    first: int = 0
    usual: int = 0
    lasted_ns: int = 0
    amid: bool = False
    is_rest: bool = False

    def unpack(self) -> None:
        """Take the payloads of the frames in `begun`."""
        order = self.order.known
        if order is not None and self.begun:
            size = len(self.begun) // self.done
            for number, place in enumerate(order.places[: self.done], 1):
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
        self._states: dict[int, _BoardState] = {}
        addresses = frozenset(board.settings.address for _, board in boards)
        self._forms = FrameForms(self.counters, addresses, others, force_torque)
        self.unconfigured = self._forms.unconfigured
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
            address, period_ns = board.settings.address, board.settings.period_ms * 1_000_000
            triangles = sum(1 << triangle for triangle in board.triangles)
            state = _BoardState(
                index,
                triangles * _BOTH,
                triangles * _BOTH,
                BoardClasses(address, triangles, period_ns),
                BoardPeriods.of(period_ns, close_periods),
            )
            self._states[address] = state
            self._add_slots(state)
        closes_ns = [state.periods.close_ns for state in self._states.values()]
        self._longest_close_ns = max(closes_ns, default=0)

    @property
    def elsewhere(self) -> int:
        """How many of the other frames are of boards that another node reads."""
        return self._forms.elsewhere

    def feed(self, batch: FrameBatch) -> Assembled:
        """Process the frames of a batch; this is the only loop over them."""
        # One frame after the other: for the thirty to hundred frames of a read, this costs less
        # than masks and scatters over arrays, and a batch may span several sweeps.
        sweeps: list[Sweep] = []
        answers: list[tuple[int, bytes]] = []
        motors: list[int] = []
        if not batch:
            return Assembled(sweeps, answers)
        slots, half_of = self._slots, self._forms.half_of
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
                    half = half_of(identifier, dlc, header)
                    if half is None or not self._is_of_skin(identifier, half, t_ns, sweeps):
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
            if state.missing and now_ns - state.first_ns > state.periods.close_ns:
                self._close(state, sweeps)
        return sweeps

    def clock_set(self, step_ns: int) -> None:
        """Take no sweeps for missed in time that passed only on the clock of the time stamps.

        Args:
            step_ns: by how much it was set, negative if back. Frames of the time before may follow.
        """
        for state in self._states.values():
            state.periods.set_ns += step_ns

    def flush(self) -> list[Sweep]:
        """Return all sweeps in progress, at the end of a recording."""
        sweeps = self.expire(1 << 62)
        for state in self._states.values():
            self._count_lone(state)
        return sweeps

    def _add_slots(self, state: _BoardState) -> None:
        for key, triangle, half in state.classes.slots():
            self._slots[key] = state, 2 * triangle + half, 1 << triangle + half * TRIANGLES

    def _is_of_skin(self, identifier: int, half: int, t_ns: int, sweeps: list[Sweep]) -> bool:
        """Return whether a frame with the form of a half is that of a configured triangle, in whose
        class its board then sends; count it otherwise.
        """
        state = self._states[identifier >> 4 & 0xF]
        has_b = state.missing != 0 and (state.awaited & ~state.missing) >> TRIANGLES != 0
        quiet_ns = abs(t_ns - state.last_ns)
        if not state.classes.may_be_of(identifier, half, quiet_ns, has_b=has_b):
            self.counters.other += 1
        elif not state.wanted >> (identifier & 0xF) & 1:
            self.counters.unknown_triangle += 1
            state.unread |= 1 << (identifier & 0xF)
        else:
            if identifier >> 8 != state.classes.halves[half]:
                self._change_classes(state, identifier >> 8, sweeps)
            return True
        return False

    def _change_classes(self, state: _BoardState, message_class: int, sweeps: list[Sweep]) -> None:
        """A board sends in other classes from now on: nothing that came before joins it."""
        if message_class != MessageClass.BATTERY_STREAM:
            if state.missing:
                self._close(state, sweeps)
            self._count_lone(state)
            state.sent_first_ns, state.last_place = _NEVER_NS, -1
        state.order, state.came, state.expected = BoardOrder(), None, -1
        for key, _, _ in state.classes.slots():
            del self._slots[key]
        state.classes.change_to(message_class)
        self._add_slots(state)

    def _is_doubled(self, state: _BoardState, bit: int, payload: bytes, t_ns: int) -> bool:
        """Count the frame that the board sent last, if it comes once more.

        A receiver that saw an error in the last bit of a frame gets it again, as do two
        gateways in parallel. The board itself sends the same slot a period later.
        """
        first_ns = state.first_ns if state.missing else state.sent_first_ns
        same = not bit & state.missing and state.values[state.last_place] == payload
        if not same or not 0 <= t_ns - first_ns <= state.periods.pause_ns:
            return False
        self.counters.doubled += 1
        return True

    @staticmethod
    def _expect_order(state: _BoardState) -> None:
        """A sweep begins: expect its frames in the known order, or learn the order from it."""
        state.came = None
        order = state.order
        if order.known is not None:
            state.done, state.expected = 1, order.known.places[1]
        elif order.begin_sweep() and state.awaited == state.wanted:
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
        order = state.order.known
        if order is None:
            return 0
        octets, form, head = records
        periods = state.periods
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
                or last_ns - first_ns > periods.sure_ns
                or 0 <= 2 * (first_ns - state.sent_first_ns) < periods.period_ns
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
                state.first, state.amid, state.is_rest = order.first, False, False
                state.certain_until_ns = first_ns + periods.sure_ns
            done += n
            state.begun += text[begin:]
            state.done, state.expected = done, places[done]
            state.missing = order.missing[done]
            state.last_place, state.last_ns = places[done - 1], last_ns
            state.order.stray = 0
            self._cut = state
            return n
        if done:
            frames = np.frombuffer(state.begun + text[begin:end], np.uint8)
        else:
            frames = np.frombuffer(text, np.uint8, end - begin, begin)
        found = order.values_of(frames, size, head)
        if found is None:
            return 0
        raw, status = found
        state.values[places[-1]] = payload
        state.last_place = places[-1]
        state.usual = order.first
        state.order.stray = 0
        if done:
            state.begun, state.missing, state.expected = b"", 0, -1
        else:
            self._close_old(first_ns, sweeps)
        self.counters.sweeps += 1
        self.counters.missed += periods.note(last_ns)
        present, missed = state.awaited & ALL_TRIANGLES, periods.missed
        since = state.crowded, state.unread
        sweeps.append(Sweep(state.index, raw, status, present, last_ns, missed, *since))
        state.crowded, state.unread = False, 0
        state.first_ns = state.sent_first_ns = first_ns
        state.last_ns = last_ns
        return n

    def _take_run(
        self, state: _BoardState, records: Records, heads: bytes, at: int, sweeps: list[Sweep]
    ) -> int:
        """Take the frames from `at` on that come in the board's order; return how many.

        They are taken if none of them would need a closer look alone.
        """
        order = state.order.known
        assert order is not None
        done = state.done
        left = len(records.octets) - at
        n = min(len(order.places) - done, left)
        begin, end = done * HEAD_BYTES, (done + n) * HEAD_BYTES
        state.expected = -1
        if state.missing != order.missing[done] or not heads.startswith(
            order.heads[begin:end], at * HEAD_BYTES
        ):
            state.order.note_stray()
            return 0
        # At a batch's end any number is a run, so that the rest of the sweep, with which the next
        # batch begins, is one.
        if n < SHORTEST_RUN and n < left:
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
        state.order.stray = 0
        if state.missing:
            state.done, state.expected = done, order.places[done]
        else:
            self._close(state, sweeps)
        return n

    def _belongs(self, state: _BoardState, bit: int, t_ns: int, sweeps: list[Sweep]) -> bool:
        """Handle a frame that is not the next one of a sweep in progress.

        It may begin a sweep, which ends the one before, or belong to a triangle that was not
        awaited. Returns False if it came too late for its sweep.
        """
        periods = state.periods
        came = state.awaited & ~state.missing if state.missing else 0
        # That lacks them all: those that came may be late ones of the sweep before.
        late = state.amid and came and not came & state.sent
        begins = late and (
            (state.is_rest and bit & (state.usual | state.sent) != 0)
            or self._begins_after_late(state, came, bit, t_ns)
        )
        if (
            came.bit_count() == 1
            and max(periods.last_ns, periods.before_ns) <= t_ns < state.first_ns
        ):
            # The first frame's stamp was ahead. By that, the sweep would last into the next one.
            state.first_ns = state.last_ns = t_ns
        if state.missing and (
            begins
            or came & bit
            or t_ns > periods.ends_ns(state.first_ns, state.last_ns)
            or t_ns < state.first_ns - SET_BACK_NS
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
            is_near = -SET_BACK_NS <= since_ns <= periods.pause_ns
            if not (bit & state.sent or begins) and is_near:
                # Its sweep was returned without it: the triangle was not awaited, or the frame was
                # held up for longer than a sweep is waited for.
                other = bit << TRIANGLES | bit >> TRIANGLES
                self.counters.late += 1 + (state.lone & other != 0)
                state.lone &= ~other
                return False
            if bit & state.sent and 0 <= 2 * since_ns < periods.period_ns:
                state.crowded = True
            if state.lone:
                self._count_lone(state)
            self._close_old(t_ns, sweeps)
            state.missing = state.awaited
            state.first_ns = t_ns
            state.first, state.amid = bit, state.usual not in (0, bit)
            state.is_rest = state.amid and state.order.ends(bit, state.sent)
            self._expect_order(state)
        ends_ns = periods.ends_ns(state.first_ns, t_ns)
        if state.is_rest:
            # Any frame may begin the next one.
            ends_ns = state.first_ns - 1
        elif state.amid:
            # Until then the usual first frame begins no other.
            came = state.awaited & ~state.missing | bit
            ends_ns = min(ends_ns, state.first_ns + periods.slowest_ns(came.bit_count()))
        state.certain_until_ns = ends_ns
        return True

    @staticmethod
    def _begins_after_late(state: _BoardState, came: int, bit: int, t_ns: int) -> bool:
        """Return whether a frame begins a sweep, and those that came of one in progress are late
        ones, or stamped as if they were: no board sends so slowly.

        It is the usual first one or, where that is late as well, one that the sweep before had, if
        more time passed than a sweep lasts.
        """
        passed_ns = abs(t_ns - state.first_ns)
        if passed_ns <= state.periods.slowest_ns(came.bit_count()):
            return False
        return bit == state.usual or (bit & state.sent != 0 and passed_ns > state.lasted_ns)

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
            (state.first_ns if state.missing else now_ns) + state.periods.close_ns
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
        state.classes.note_sweep(has_b=got >> TRIANGLES != 0)
        present = got & got >> TRIANGLES
        self.counters.sweeps += 1
        self.counters.missed += state.periods.note(state.last_ns)
        values = np.frombuffer(bytearray().join(state.values), np.uint8)
        triangles = values.reshape(TRIANGLES, 2 * _PAYLOAD)
        if state.expected >= 0:
            # The second frame of the known order came first, or not at all.
            state.order.note_stray()
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
            state.lasted_ns = state.last_ns - state.first_ns
            if state.came is not None:
                order = state.order.learn(state.came)
                if order is not None:
                    self._first[order.heads[:HEAD_BYTES]] = state
                state.came = None
        if present:
            raw, status = triangles[:, :TAXELS], NO_STATUS
            if triangles[:, TAXELS:].tobytes() != _NO_STATUS:
                status = triangles[:, TAXELS:].copy().view(">u2")[:, 0].astype(np.uint16)
            t_ns, missed = state.last_ns, state.periods.missed
            since = state.crowded, state.unread
            sweeps.append(Sweep(state.index, raw, status, present, t_ns, missed, *since))
            state.crowded, state.unread = False, 0
        state.sent = got
        state.sent_first_ns = state.first_ns
        state.missing = 0

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
