"""What is concluded from the sweeps of boards: silence, period, what is missing."""

from functools import cache
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from skin_host.bus.assembler import Assembler, Sweep
from skin_host.bus.ledger import (
    ALONE_NS,
    LONGEST_PAUSE_NS,
    MOST_OFTEN,
    MOST_WAITING_NS,
    TWICE_NS,
    BoardLedger,
)
from skin_host.bus.wire import FrameBatch, StatusError, encode_sweep, triangles_in
from skin_host.config.settings import Board, Bus, Part, Patch, Settings, load
from skin_host.layout import BoardLayout, build_layout
from tests.support.stack import ROOT

CONFIG = ROOT / "config" / "demo.toml"
MS = 1_000_000
PERIOD = 50 * MS
SILENT_PERIODS = 4.0
T0 = 1_700_000_000_000_000_000
HAND, OUTER = 0, 1


@cache
def boards() -> list[tuple[int, BoardLayout]]:
    return list(enumerate(build_layout(load(CONFIG), CONFIG.parent).boards))


def ledger(poll_ms: float = 0.0) -> BoardLedger:
    return BoardLedger(boards(), SILENT_PERIODS, poll_ms)


def enabled(board: int) -> int:
    return boards()[board][1].enabled


def sweep(
    board: int,
    t_ns: int,
    present: int | None = None,
    status: int = 0,
    crowded: bool = False,
) -> Sweep:
    mask = enabled(board) if present is None else present
    words = np.full(16, status, np.uint16)
    return Sweep(board, np.zeros((16, 12), np.uint8), words, mask, t_ns, 0, crowded)


LOST = [0, 0, 0, 0, 0, 0, 240, 0, 0, 255, 240, 0]
PRESSED = [0, 0, 0, 0, 0, 0, 240, 0, 0, 0, 240, 0]


def sends(
    known: BoardLedger,
    number: int,
    *triangle: list[int],
    present: int | None = None,
    status: NDArray[np.uint16] | None = None,
) -> int:
    """A sweep, without status words or with these, whose first triangles read this and whose others
    rest.
    """
    one = sweep(HAND, T0 + number * PERIOD, present)
    raw = np.zeros((16, 12), np.uint8)
    raw[triangles_in(one.present)] = 240
    for index, pads in enumerate(triangle):
        raw[index] = pads
    return known.note(one._replace(raw=raw, status=one.status if status is None else status))


def test_a_chip_that_is_lost_shows_without_status_words() -> None:
    """As on recordings of real skin: its pads read beyond all pressures, and one of them below."""
    known = ledger()
    sends(known, 0)
    for number in range(1, 4):
        row = sends(known, number, LOST)
        assert np.flatnonzero(known.error[row] == StatusError.NOT_CONNECTED).tolist() == [0]
        assert known.far[row, 0].all() and not known.far[row, 1:].any()
        assert known.flagged[row]
        assert not known.answered(row)[0]
    row = sends(known, 4)
    assert known.answered(row)[0] and not known.flagged[row]


def test_a_chip_that_is_lost_from_the_first_is_found_at_once() -> None:
    known = ledger()
    assert not known.answered(sends(known, 0, LOST))[0]


@pytest.mark.parametrize("first", [[240] * 9 + [255] + [240] * 2, [180] * 9 + [255] + [240] * 2])
def test_a_hard_press_beside_a_pad_that_is_out_of_range_is_no_lost_chip(first: list[int]) -> None:
    known = ledger()
    sends(known, 0, first)
    for number in range(1, 4):
        assert not known.flagged[sends(known, number, LOST)]


def test_what_a_board_marks_is_not_judged_by_its_bytes() -> None:
    known = ledger()
    sends(known, 0)
    marked = np.full(16, 1 << 4, np.uint16)
    row = sends(known, 1, LOST, status=marked)
    assert not known.error[row].any()


def test_a_press_beyond_the_scale_is_no_lost_chip() -> None:
    known = ledger()
    sends(known, 0)
    assert not known.flagged[sends(known, 1, PRESSED, PRESSED)]


def test_triangles_that_are_missing_are_no_lost_chips() -> None:
    known = ledger()
    sends(known, 0)
    row = sends(known, 1, present=0b10)
    assert not known.flagged[row]


def after(intervals_ms: list[float]) -> BoardLedger:
    """A board set to 50 ms whose sweeps came so far apart."""
    known = ledger()
    for t_ms in accumulate(intervals_ms, initial=0.0):
        known.note(sweep(HAND, T0 + round(t_ms * 1e6)))
    return known


@pytest.mark.parametrize("period_ms", [20.0, 37.0, 50.0, 100.0])
def test_a_regular_period_is_recognised(period_ms: float) -> None:
    assert after([period_ms] * 16).regular_period_ns(HAND) == pytest.approx(period_ms * 1e6)


@pytest.mark.parametrize(
    "intervals_ms",
    [
        # Too few to say anything.
        [20.0] * 6,
        # Held up now and then, and sent in bunches.
        [140.0, 5.0, 5.0] * 5,
        # One long pause.
        [20.0] * 15 + [3000.0],
    ],
)
def test_sweeps_that_are_held_up_have_no_regular_period(intervals_ms: list[float]) -> None:
    assert after(intervals_ms).regular_period_ns(HAND) is None


def test_jitter_does_not_hide_the_period() -> None:
    assert after([49.0, 51.5] * 8).regular_period_ns(HAND) == pytest.approx(50e6, rel=0.03)


@pytest.mark.parametrize("n", [3, 16, 17, 40])
def test_intervals_are_known_in_their_order(n: int) -> None:
    came = [50.0 + k for k in range(n)]
    assert (after(came).intervals_ns(HAND) / MS).tolist() == came[-16:]


def test_triangles_that_never_come_are_missing_and_those_of_cut_sweeps_are_not() -> None:
    known, all_of = ledger(), enabled(HAND)
    lowest = all_of & -all_of
    times = (T0 + turn * PERIOD for turn in range(100))
    for turn in range(8):
        known.note(sweep(HAND, next(times), all_of & ~lowest if turn % 2 else lowest))
        assert known.missing(HAND) == 0
    for _ in range(8):
        known.note(sweep(HAND, next(times), all_of & ~lowest))
    assert known.missing(HAND) == lowest
    known.set_up(HAND)
    assert known.missing(HAND) == 0


def test_a_board_is_silent_after_its_periods_and_no_other() -> None:
    known = ledger()
    for turn in range(20):
        for board in (HAND, OUTER) if turn < 10 else (HAND,):
            known.note(sweep(board, T0 + turn * PERIOD))
        quiet = max(0, turn - 9)
        assert known.silent.tolist()[:2] == [False, quiet > SILENT_PERIODS]
        assert known.is_silent(OUTER) == (quiet > SILENT_PERIODS)


@pytest.mark.parametrize("jump_s", [-86_400, -3600, -2, 3600, 86_400])
def test_a_clock_that_is_set_makes_nobody_silent_nor_alive(jump_s: int) -> None:
    known = ledger()
    now_ns = T0
    for _ in range(8):
        now_ns += PERIOD
        known.look(now_ns)
        known.note(sweep(HAND, now_ns))
    assert known.silent.tolist()[:2] == [False, True]
    now_ns += jump_s * 1_000_000_000
    known.look(now_ns)
    assert known.silent.tolist()[:2] == [False, True]
    for _ in range(10):
        now_ns += PERIOD
        known.look(now_ns)
    assert known.silent.all()


@given(
    st.lists(
        st.one_of(
            st.integers(-(10**15), 10**15),
            st.integers(-30 * MS, 60 * MS),
        )
    )
)
def test_the_ledgers_clock_never_runs_back_nor_faster_than_its_limit(steps: list[int]) -> None:
    known = ledger()
    t_ns = T0
    for step in steps:
        t_ns += step
        before = known.now_ns
        known.look(t_ns)
        assert 0 <= known.now_ns - before <= LONGEST_PAUSE_NS


def test_time_stamps_of_two_buses_that_are_read_in_turn_are_not_counted_twice() -> None:
    known = ledger()
    for turn in range(10):
        for board in (HAND, OUTER):
            for part in range(5):
                known.note(sweep(board, T0 + (5 * turn + part) * PERIOD))
    assert known.now_ns <= 50 * PERIOD


def test_status_words_stand_until_the_next_sweep() -> None:
    known = ledger()
    assert not known.flagged[HAND]
    known.note(sweep(HAND, T0, status=0x8011))
    assert known.flagged[HAND]
    assert set(known.error[HAND].tolist()) == {1}
    assert np.flatnonzero(known.far[HAND, 3]).tolist() == [0, 11]
    known.note(sweep(HAND, T0 + PERIOD))
    assert not known.flagged[HAND]
    assert not known.error.any()
    assert not known.far.any()


def test_a_board_is_overdue_one_nanosecond_after_its_periods_and_not_before_it_could_send() -> None:
    known = ledger()
    known.look(T0)
    known.note(sweep(HAND, T0))
    limit_ns = int(SILENT_PERIODS * PERIOD)
    for passed_ns in (*range(50 * MS, limit_ns + 1, 50 * MS), limit_ns + 1):
        known.look(T0 + passed_ns)
        assert known.is_silent(HAND) is (passed_ns > limit_ns)
        assert known.silent[HAND] == known.is_silent(HAND)
        assert known.any_silent is bool(known.silent.any())
    assert not known.overdue(HAND, 1)
    known.note(sweep(HAND, T0))
    assert not known.is_silent(HAND)
    assert known.received_ns[HAND] == known.now_ns
    assert known.sweeps.tolist()[:2] == [2, 0]


@given(st.lists(st.tuples(st.sets(st.sampled_from(range(5))), st.integers(1, 90))))
def test_any_board_is_silent_exactly_when_one_of_them_is(turns: list[tuple[set[int], int]]) -> None:
    """At first all send in time; then some miss a turn."""
    known, now_ns = ledger(), T0
    for quiet, passed_ms in [(set[int](), 50)] * 10 + turns:
        now_ns += passed_ms * MS
        known.look(now_ns)
        for board in known.row.keys() - quiet:
            known.note(sweep(board, now_ns))
        assert known.any_silent == bool(known.silent.any())


@pytest.mark.parametrize("looks", [False, True])
@pytest.mark.parametrize(
    ("missed", "pauses", "may_be_zeroed"),
    [(2, True, False), (3, True, True), (7, True, True), (7, False, False)],
)
def test_a_board_that_pauses_where_it_zeroes_itself_may_have_done_so_from_three_periods_on(
    looks: bool, missed: int, pauses: bool, may_be_zeroed: bool
) -> None:
    known = ledger()
    if pauses:
        known.expect_pauses(HAND)
    if looks:
        known.look(T0)
    known.note(sweep(HAND, T0))
    quiet_ns = (missed + 1) * PERIOD
    if looks:
        for turn in range(1, missed + 2):
            known.look(T0 + turn * PERIOD)
    after = sweep(HAND, T0 + quiet_ns)._replace(missed=missed)
    assert known.zeroing_ns(after) == (quiet_ns if may_be_zeroed else 0)


def test_a_clock_that_is_set_is_no_pause_in_which_a_board_zeroes_itself() -> None:
    known = ledger()
    known.expect_pauses(HAND)
    known.look(T0)
    known.note(sweep(HAND, T0))
    known.look(T0 + PERIOD)
    assert known.zeroing_ns(sweep(HAND, T0 + 100 * PERIOD)._replace(missed=99)) == 0


def test_a_pause_counts_for_no_more_than_the_limit_and_the_poll() -> None:
    for poll_ms in (0.0, 40.0):
        known = ledger(poll_ms)
        known.look(T0)
        assert known.now_ns == 0
        known.look(T0 + 3_600_000_000_000)
        assert known.now_ns == LONGEST_PAUSE_NS + poll_ms * MS


def test_who_sent_in_a_pause_whose_frames_are_read_at_once_is_not_silent() -> None:
    """The clock counts a tenth of a second of it, which may be more than a board may be silent."""
    known = BoardLedger(boards(), 1.0)
    known.look(T0)
    for row in (HAND, OUTER):
        known.note(sweep(row, T0 + 5 * MS))
    known.look(T0 + 10 * MS)
    for number in range(1, 21):
        known.note(sweep(HAND, T0 + number * PERIOD))
    known.look(T0 + 1010 * MS)
    assert not known.is_silent(HAND)
    assert known.is_silent(OUTER)
    known.look(T0 + 1010 * MS + LONGEST_PAUSE_NS + 1)
    assert known.is_silent(HAND)


def test_time_goes_by_the_reader_once_it_looks() -> None:
    known = ledger()
    known.note(sweep(HAND, T0))
    known.note(sweep(HAND, T0 + 7 * MS))
    assert known.now_ns == 7 * MS
    known.look(T0 + 10 * MS)
    known.note(sweep(HAND, T0 + 90 * MS))
    assert known.now_ns == 10 * MS


@pytest.mark.parametrize(("back_ns", "passed_ms"), [(999_999_999, 0), (1_000_000_000, 5)])
def test_a_step_back_by_a_second_is_a_clock_that_was_set(back_ns: int, passed_ms: int) -> None:
    known = ledger()
    for t_ns in (T0, T0 - back_ns, T0 - back_ns + 5 * MS):
        known.look(t_ns)
    assert known.now_ns == passed_ms * MS


def test_triangles_are_missing_from_the_fifth_sweep_on_and_until_they_come() -> None:
    known, all_of = ledger(), enabled(HAND)
    highest = 1 << all_of.bit_length() - 1
    found = []
    for turn in range(12):
        present = all_of if turn in (0, 9) else all_of & ~highest
        known.note(sweep(HAND, T0 + turn * PERIOD, present))
        assert known.complete(HAND) is (turn in (0, 9))
        found.append(known.missing(HAND))
    assert found == [0] * 5 + [highest] * 4 + [0] * 3
    # After a set-up so many sweeps are needed again, whatever was missing before.
    for turn in range(12, 18):
        known.note(sweep(HAND, T0 + turn * PERIOD, all_of & ~highest))
    known.set_up(HAND)
    for turn in range(5):
        assert (known.missing(HAND), known.since_set_up(HAND)) == (0, turn)
        known.note(sweep(HAND, T0 + (18 + turn) * PERIOD, all_of & ~highest))
    assert known.missing(HAND) == highest


def test_a_triangle_that_is_not_enabled_is_never_missing() -> None:
    known = ledger()
    lone = enabled(HAND) & -enabled(HAND)
    known._enabled[HAND] = lone
    for turn in range(10):
        known.note(sweep(HAND, T0 + turn * PERIOD, lone))
    assert known.complete(HAND)
    assert known.missing(HAND) == 0


def test_only_intervals_since_the_set_up_and_without_a_pause_count() -> None:
    known = after([20.0] * 7)
    assert known.intervals_ns(HAND).tolist() == [20 * MS] * 7
    assert known.regular_period_ns(HAND) == 20 * MS
    known.set_up(HAND)
    assert known.regular_period_ns(HAND) is None
    t_ns = T0 + 140 * MS
    for interval_ns, kept in ((30 * MS, 0), (30 * MS, 1), (999_999_999, 2), (10**9, 0), (5, 1)):
        t_ns += interval_ns
        known.note(sweep(HAND, t_ns))
        assert len(known.intervals_ns(HAND)) == kept
    known.note(sweep(HAND, t_ns))  # two at one time are no interval
    assert len(known.intervals_ns(HAND)) == 0


def test_the_last_sixteen_intervals_are_kept() -> None:
    known = after([40.0] * 16 + [20.0] * 15)
    assert sorted(known.intervals_ns(HAND).tolist()) == [20 * MS] * 15 + [40 * MS]
    assert len(after([20.0] * 40).intervals_ns(HAND)) == 16


@pytest.mark.parametrize(("spread_ms", "regular"), [(4.5, True), (5.5, False)])
def test_a_period_is_regular_within_a_tenth(spread_ms: float, regular: bool) -> None:
    """All but the longest and shortest fifth of the intervals count."""
    low, high = 50.0 - spread_ms / 2, 50.0 + spread_ms / 2
    known = after([10.0] * 3 + [low] + [50.0] * 7 + [high] + [300.0] * 3)
    found = known.regular_period_ns(HAND)
    assert found == (50 * MS if regular else None)


@pytest.mark.parametrize(("silent_periods", "mtb3_periods"), [(4.0, 6.0), (8.0, 8.0)])
def test_an_mtb3_may_pause_for_six_periods_and_another_board_as_long_as_is_set(
    silent_periods: float, mtb3_periods: float
) -> None:
    """An MTB3 that zeroes itself sends nothing for four."""
    skin = build_layout(
        Settings(
            robot="r",
            buses={"can0": Bus()},
            boards={
                "old": Board(bus="can0", address=1, model="mtb3"),
                "new": Board(bus="can0", address=2, model="mtb4"),
            },
            parts={
                name: Part(patches=[Patch(board=name, triangles="0-1")]) for name in ("old", "new")
            },
        ),
        Path(),
    )
    known = BoardLedger(list(enumerate(skin.boards)), silent_periods)
    period_ns = skin.boards[0].settings.period_ms * MS
    wanted = [mtb3_periods * period_ns, silent_periods * period_ns]
    assert known.silent_after_ns.tolist() == wanted
    known.expect_pauses(1)
    assert known.silent_after_ns.tolist() == [wanted[0]] * 2


@pytest.mark.parametrize(
    ("interval_ms", "is_easy"),
    [(50.0, True), (62.0, True), (63.0, False), (38.0, True), (37.0, False)],
)
def test_a_board_is_easy_while_each_of_its_last_sweeps_is_near_its_period(
    interval_ms: float, is_easy: bool
) -> None:
    known = after([50.0] * 16 + [interval_ms])
    assert known.is_easy(HAND) is is_easy
    assert not known.is_easy(OUTER)
    known.set_up(HAND)
    assert not known.is_easy(HAND)
    known.note(sweep(HAND, T0 + 900 * MS))
    assert known.is_easy(HAND) is is_easy
    for turn in range(17):
        known.note(sweep(HAND, T0 + (950 + 50 * turn) * MS))
    assert known.is_easy(HAND)


@pytest.mark.parametrize("before", [16, 20, 31])
def test_an_uneven_interval_counts_until_sixteen_even_ones_followed(before: int) -> None:
    for followed in (15, 16):
        known = after([50.0] * before + [63.0] + [50.0] * followed)
        assert known.is_easy(HAND) is (followed == 16)


def test_a_board_that_timed_out_is_not_easy() -> None:
    known = after([50.0] * 16)
    for turn in range(1, 4):
        assert known.is_easy(HAND)
        known.look(T0 + 800 * MS + turn * 90 * MS)
    assert not known.is_easy(HAND)


class Crowd:
    """An address at which sweeps may come too soon."""

    def __init__(self) -> None:
        self.known = ledger()
        self.t_ns = T0
        self._last_ns = 0

    def send(self, seconds: float, apart_ms: float = 0.0) -> None:
        """Send as one board; with `apart_ms` a second one does so, too, that much later."""
        for _ in range(round(seconds * 1e9 / PERIOD)):
            self.t_ns += PERIOD
            self.note(self.t_ns)
            if apart_ms:
                self.note(self.t_ns + round(apart_ms * MS))

    def burst(self, waited: float) -> None:
        """A stalled computer reads and stamps at once what one board sent meanwhile."""
        self.t_ns += round(waited * 1e9)
        for number in range(round(waited * 1e9 / PERIOD)):
            self.note(self.t_ns + number * MS)

    def note(self, t_ns: int) -> None:
        crowded = 0 < 2 * (t_ns - self._last_ns) < PERIOD
        self._last_ns = t_ns
        self.known.note(sweep(HAND, t_ns, crowded=crowded))

    @property
    def twice(self) -> bool:
        return HAND in self.known.twice


@pytest.mark.parametrize("apart_ms", [0.5, 13.0, 24.0, 26.0, 49.0])
def test_two_boards_send_at_an_address_when_sweeps_come_too_soon_for_two_seconds(
    apart_ms: float,
) -> None:
    address = Crowd()
    address.send(5.0)
    address.send(TWICE_NS / 1e9 - 0.1, apart_ms)
    assert not address.twice
    address.send(0.2, apart_ms)
    assert address.twice
    for _ in range(600):
        address.send(0.1, apart_ms)
        assert address.twice
    since_ns = address.known.twice[HAND]
    assert T0 + 5 * 10**9 <= since_ns <= T0 + 5 * 10**9 + 2 * PERIOD


def test_one_board_is_alone_when_none_of_its_sweeps_comes_too_soon_for_a_second() -> None:
    address = Crowd()
    address.send(3.0, 13.0)
    address.send(ALONE_NS / 1e9 - 0.1)
    assert address.twice
    address.send(0.2)
    assert not address.twice
    # The next one is named after two seconds again.
    address.send(1.9, 13.0)
    assert not address.twice
    address.send(0.3, 13.0)
    assert address.twice


def test_two_boards_that_come_half_a_period_apart_for_a_while_are_still_two() -> None:
    """Their clocks differ: then no sweep comes too soon, but twice as many."""
    address = Crowd()
    address.send(3.0, 24.0)
    for _ in range(50):
        address.send(0.1, 25.0)
        assert address.twice


@pytest.mark.parametrize("jump_s", [-3600.0, -0.02, 0.02, 3600.0])
def test_neither_a_silence_nor_a_clock_that_is_set_ends_two_boards(jump_s: float) -> None:
    address = Crowd()
    address.send(3.0, 13.0)
    address.t_ns += round(jump_s * 1e9)
    for _ in range(40):
        address.send(0.1, 13.0)
        assert address.twice
    address.t_ns += round(jump_s * 1e9)
    address.send(2.5)
    assert not address.twice


@pytest.mark.parametrize("waited_s", [0.2, 0.5, 0.9, 4.0])
def test_what_waited_while_this_computer_was_busy_is_of_one_board(waited_s: float) -> None:
    address = Crowd()
    address.send(2.0)
    for _ in range(20):
        address.burst(waited_s)
        assert not address.twice


def test_what_comes_too_soon_now_and_then_is_no_second_board() -> None:
    address = Crowd()
    for _ in range(20):
        address.send(0.9)
        address.send(0.1, 13.0)
        assert not address.twice


@pytest.mark.parametrize("period_ms", [10, 20])
def test_a_board_that_sends_too_often_is_one(period_ms: int) -> None:
    address = Crowd()
    for number in range(10_000 // period_ms):
        # Some of its frames wait for those of a more urgent board.
        waits_ms = 5 if number % 5 == 0 else 0
        address.note(T0 + (number * period_ms + waits_ms) * MS)
        assert not address.twice


def test_sweeps_that_two_boards_cut_into_pieces_are_of_two() -> None:
    """Both send at the same moments: each frame begins a sweep, in which one triangle is whole."""
    address = Crowd()
    for _ in range(50):
        address.t_ns += PERIOD
        for number in range(15):
            address.note(address.t_ns + number * MS // 2)
    assert address.twice


@pytest.mark.parametrize("late_ms", [26, 30, 40, 49])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_frames_of_one_board_that_are_late_are_not_of_two(late_ms: int, share: float) -> None:
    """A tenth of the frames, 30 ms late, made a board's readings invalid as of two boards."""
    known, rng = ledger(), np.random.default_rng(1)
    assembler = Assembler(boards()[:1], close_periods=0.9)
    address, triangles = (
        boards()[HAND][1].settings.address,
        np.flatnonzero(triangles_in(enabled(0))),
    )
    sent: list[tuple[int, bytes, int]] = []
    for number in range(400):
        raw = rng.integers(100, 200, (len(triangles), 12), np.uint8)
        ids, data = encode_sweep(address, triangles, raw, np.zeros(len(triangles), np.uint16))
        late_ns = late_ms * MS * (rng.random(len(ids)) < share)
        sent += [
            (int(one), row.tobytes(), T0 + number * PERIOD + place * MS // 8 + int(late))
            for place, (one, row, late) in enumerate(zip(ids, data, late_ns, strict=True))
        ]
    sent.sort(key=lambda frame: frame[2])
    for sweep in assembler.feed(FrameBatch.of(sent)).sweeps:
        known.note(sweep)
        assert not known.twice


def flooded(seconds: float, every_ms: float) -> BoardLedger:
    """After a board has sent so often, while the other one sends in its period."""
    known = ledger()
    due_ns = T0
    for number in range(round(seconds * 1e3 / every_ms)):
        t_ns = T0 + round(number * every_ms * 1e6)
        known.note(sweep(HAND, t_ns, crowded=number > 0 and 2 * every_ms * 1e6 < PERIOD))
        if t_ns >= due_ns:
            due_ns += PERIOD
            known.note(sweep(OUTER, t_ns))
            assert not known.is_excess(1)
    return known


@pytest.mark.parametrize("every_ms", [0.4, 1.0, 9.0])
def test_of_a_board_that_floods_its_bus_so_many_sweeps_are_too_many_and_all_are_counted(
    every_ms: float,
) -> None:
    known = flooded(20.0, every_ms)
    sent = int(known.sweeps[0])
    taken = sent - int(known.excess[0])
    at_once, later = MOST_WAITING_NS / PERIOD, MOST_OFTEN * 20e9 / PERIOD
    assert abs(taken - (at_once + later)) <= 2
    assert known.excess[1] == 0


@pytest.mark.parametrize("every_ms", [10.0, 12.0, 24.0, 26.0, 50.0])
def test_a_board_that_sends_up_to_five_times_as_often_is_processed_whole(every_ms: float) -> None:
    assert not flooded(20.0, every_ms).excess.any()


def test_what_waited_while_a_computer_was_busy_is_not_too_much() -> None:
    address = Crowd()
    for _ in range(5):
        address.send(10.0)
        address.burst(9.0)
    assert not address.known.excess.any()


def test_a_board_that_has_flooded_is_processed_again_when_it_is_over() -> None:
    known = flooded(12.0, 0.5)
    assert known.is_excess(0)
    known.note(sweep(HAND, T0 + 13_000 * MS))
    assert not known.is_excess(0)
    before = int(known.excess[0])
    for number in range(100):
        known.note(sweep(HAND, T0 + 13_050 * MS + number * PERIOD))
    assert known.excess[0] == before
