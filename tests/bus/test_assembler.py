"""Frames to sweeps: pairing, completeness, and an account of everything that went wrong."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.bus import wire
from skin_host.bus.assembler import PATIENCE_SWEEPS
from skin_host.bus.wire import FrameBatch
from tests.support.sweeps import (
    MS,
    PERIOD,
    feed,
    feed_in_parts,
    frames,
    has_nothing_else,
    learnt,
    make,
    values,
)


def test_a_whole_sweep_is_handed_on_with_its_last_frame():
    raw = values(4)
    sent = frames(raw, t_ns=PERIOD)
    assembler = make()
    assert feed(assembler, sent[:-1]) == []
    (sweep,) = feed(assembler, sent[-1:])
    np.testing.assert_array_equal(sweep.raw[:4], raw)
    assert sweep.present == 0b1111
    assert sweep.t_ns == sent[-1][2]


def test_the_first_sweep_of_a_clock_that_begins_at_zero_is_not_late() -> None:
    assembler = make()
    assert len(feed(assembler, frames(values(4), t_ns=0))) == 1
    assert assembler.counters.late == 0


@given(order=st.permutations(range(8)), cut=st.integers(1, 8))
@settings(max_examples=60)
def test_the_order_of_frames_and_the_size_of_batches_do_not_matter(order, cut):
    raw = values(4)
    sent = frames(raw, t_ns=PERIOD)
    times = [t for _, _, t in sent]
    shuffled = [(*sent[i][:2], t) for i, t in zip(order, times, strict=True)]
    assembler = make()
    sweeps = feed(assembler, shuffled[:cut]) + feed(assembler, shuffled[cut:])
    assert len(sweeps) == 1
    np.testing.assert_array_equal(sweeps[0].raw[:4], raw)


def test_a_lost_frame_costs_its_triangle_and_is_counted():
    sent = frames(values(4), t_ns=PERIOD)
    del sent[3]
    assembler = make()
    assert feed(assembler, sent) == []
    (sweep,) = assembler.expire(PERIOD * 2)
    assert sweep.present == 0b1101
    assert not sweep.raw[1].any()
    assert assembler.counters.incomplete == 1
    feed(assembler, frames(values(4), t_ns=2 * PERIOD))
    assert assembler.counters.halves == 1


def test_halves_of_two_sweeps_are_not_joined_where_a_late_frame_hides_the_pause() -> None:
    """The last frame of the first sweep is late, and the next comes early: the period scatters."""
    first, second = values(4, 1), values(4, 2)
    sent = frames(first, PERIOD)
    lost = sent.pop(0)
    sent[-1] = (*sent[-1][:2], PERIOD + 7 * MS)
    sent += frames(second, PERIOD + 29 * MS)
    assert sent[7][0] == lost[0]
    one, two = feed(make(), sent)
    assert one.present == 0b1110
    np.testing.assert_array_equal(two.raw[:4], second)


@pytest.mark.parametrize(
    "order", [list(range(8)), [7, 6, 5, 4, 3, 2, 1, 0], [0, 2, 4, 6, 1, 3, 5, 7]]
)
@pytest.mark.parametrize("at_once", [1, 3, 1000])
@pytest.mark.parametrize("late", [0.51, 0.7, 0.9])
def test_a_frame_that_is_late_by_most_of_a_period_joins_no_other_sweep(
    order: list[int], at_once: int, late: float
) -> None:
    """It begins a sweep, which the usual first frame ends. The sweep of that is whole."""
    assembler = make()
    sent: list[tuple[int, bytes, int]] = []
    numbers = range(1, 60)
    for number in numbers:
        swept = frames(values(4, number), number * PERIOD)
        times = [t_ns for _, _, t_ns in swept]
        # None of the first four, and then the second half of a triangle, or two frames.
        if number > 4 and number % 2:
            for place in (5, 6)[: 1 + number % 4 // 2]:
                times[place] += round(late * PERIOD)
        sent += [(*swept[i][:2], t_ns) for i, t_ns in zip(order, times, strict=True)]
    sent.sort(key=lambda frame: frame[2])
    sweeps = feed_in_parts(assembler, sent, at_once)
    sweeps += assembler.flush()
    whole = []
    for sweep in sweeps:
        has_nothing_else(sweep, values(4, sweep.t_ns // PERIOD))
        whole += [sweep.t_ns // PERIOD] if sweep.present == 0b1111 else []
    assert whole == [number for number in numbers if number <= 4 or not number % 2]
    counters = assembler.counters
    used = 2 * sum(sweep.present.bit_count() for sweep in sweeps)
    assert counters.frames == used + counters.halves
    assert counters.late == counters.missed == 0


@pytest.mark.parametrize("at_once", [1, 3, 1000])
@pytest.mark.parametrize("late", [0.51, 0.7, 0.9])
@pytest.mark.parametrize("lost", [False, True])
def test_a_late_frame_joins_no_sweep_of_which_the_first_frame_is_late_or_lost(
    at_once: int, late: float, lost: bool
) -> None:
    """The second begins that sweep: the one before had it, and more time has passed than a sweep
    lasts.
    """
    assembler = make()
    sent: list[tuple[int, bytes, int]] = []
    for number in range(1, 60):
        swept = frames(values(4, number), number * PERIOD)
        place = {0: 5, 1: 0}.get(number % 4) if number > 5 else None
        if place is not None:
            swept[place] = (*swept[place][:2], swept[place][2] + round(late * PERIOD))
        if lost and place == 0:
            del swept[0]
        sent += swept
    sent.sort(key=lambda frame: frame[2])
    sweeps = feed_in_parts(assembler, sent, at_once)
    sweeps += assembler.flush()
    for sweep in sweeps:
        number = sweep.t_ns // PERIOD
        has_nothing_else(sweep, values(4, number))
        cut = {0: 0b1011, 1: 0b1110}.get(number % 4, 0b1111) if number > 5 else 0b1111
        assert sweep.present == cut
    assert len(sweeps) == 59
    counters = assembler.counters
    used = 2 * sum(sweep.present.bit_count() for sweep in sweeps)
    assert counters.frames == used + counters.halves
    assert counters.late == counters.missed == 0


@pytest.mark.parametrize("at_once", [1, 3, 1000])
@pytest.mark.parametrize("cut", [1, 2, 5, 6, 7])
@pytest.mark.parametrize("come", [1, 2, 7])
def test_the_rest_of_a_sweep_that_a_full_bus_held_up_joins_no_sweep_that_follows_at_once(
    at_once: int, cut: int, come: int
) -> None:
    """More urgent boards had the bus in its middle, and of its end only some fitted the queue."""
    assembler = make()
    sent: list[tuple[int, bytes, int]] = []
    for number in range(1, 60):
        swept = frames(values(4, number), number * PERIOD)
        if number > 4:
            ends_ns = (number + 1) * PERIOD - 60_000
            rest = [
                (*frame[:2], ends_ns - 116_000 * (7 - place)) for place, frame in enumerate(swept)
            ]
            swept[cut:] = rest[cut : cut + come]
        sent += swept
    sweeps = feed_in_parts(assembler, sent, at_once)
    sweeps += assembler.flush()
    for sweep in sweeps:
        has_nothing_else(sweep, values(4, sweep.t_ns // PERIOD))
    counters = assembler.counters
    used = 2 * sum(sweep.present.bit_count() for sweep in sweeps)
    assert counters.frames == used + counters.halves + counters.late
    assert used >= 2 * (cut // 2) * 55


@pytest.mark.parametrize("order", [list(range(8)), [7, 6, 5, 4, 3, 2, 1, 0]])
@pytest.mark.parametrize("cut", [1, 3, 4, 7])
def test_sweeps_are_whole_on_a_free_bus_whatever_was_taken_for_their_first_frame(
    order: list[int], cut: int
) -> None:
    """A full bus divided each from the first one on: one began with the rest of that before."""
    assembler = make()
    sweeps = []
    for number in range(1, 40):
        swept = frames(values(4, number), number * PERIOD)
        times = [t_ns for _, _, t_ns in swept]
        if number < 20:
            times[cut:] = [(number + 1) * PERIOD - 116_000 * (8 - i) for i in range(cut, 8)]
        sent = [(*swept[i][:2], t_ns) for i, t_ns in zip(order, times, strict=True)]
        sweeps = feed(assembler, sent if number > 1 else sent[cut:])
    (sweep,) = sweeps
    assert sweep.present == 0b1111
    np.testing.assert_array_equal(sweep.raw[:4], values(4, 39))


@pytest.mark.parametrize("triangles", [1, 2])
def test_a_board_that_changes_its_order_loses_nothing_however_slowly_it_sends(
    triangles: int,
) -> None:
    """Its usual first frame comes amid a sweep of another order, and ends it not."""
    assembler = make(f"0-{triangles - 1}")
    for number in range(1, 40):
        raw = values(triangles, number)
        sent = frames(raw, number * PERIOD, spacing_ns=8 * MS)
        if number % 3 == 0:
            times = [t_ns for _, _, t_ns in sent]
            sent = [(*sent[i][:2], t_ns) for i, t_ns in zip([1, 0, 2, 3], times, strict=False)]
        (sweep,) = [one for frame in sent for one in feed(assembler, [frame])]
        np.testing.assert_array_equal(sweep.raw[:triangles], raw)


@pytest.mark.parametrize(
    ("order", "spacing_ns"),
    [([1, 0, 2, 3, 4, 5, 6, 7], 125_000), ([1, 2, 0, 3, 4, 5, 6, 7], 3 * MS)],
)
def test_a_board_that_changes_its_order_after_it_lost_a_frame_loses_no_other(
    order: list[int], spacing_ns: int
) -> None:
    assembler = make()
    for number in range(1, 40):
        raw = values(4, number)
        sent = frames(raw, number * PERIOD, spacing_ns=spacing_ns)
        if number % 3 == 0:
            times = [t_ns for _, _, t_ns in sent]
            sent = [(*sent[i][:2], t_ns) for i, t_ns in zip(order, times, strict=True)]
        if number % 3 == 2:
            del sent[1]
        sweeps = feed(assembler, sent) + assembler.expire((number + 1) * PERIOD - MS)
        assert [sweep.present for sweep in sweeps] == [0b1111 if number % 3 != 2 else 0b1110]


@pytest.mark.parametrize("ahead_ms", [30, 45, 60, 90, 150, 3_600_000])
@pytest.mark.parametrize("at_once", [1, 3, 1000])
def test_a_stamp_that_is_ahead_of_its_time_joins_no_two_sweeps(ahead_ms: int, at_once: int) -> None:
    """It begins a sweep. The next frame shows when that began; the sweep after it is whole."""
    assembler = make()
    sent: list[tuple[int, bytes, int]] = []
    for number in range(1, 42):
        swept = frames(values(4, number), number * PERIOD)
        if number > 4 and number % 4 == 1:
            place = number // 4 % 8
            swept[place] = (*swept[place][:2], swept[place][2] + ahead_ms * MS)
        sent += swept
    sweeps = feed_in_parts(assembler, sent, at_once)
    sweeps += assembler.flush()
    raws = [values(4, number) for number in range(1, 42)]
    whole = 0
    for sweep in sweeps:
        for triangle in range(4):
            if sweep.present >> triangle & 1:
                assert any((sweep.raw[triangle] == raw[triangle]).all() for raw in raws)
        whole += sweep.present == 0b1111
    # That of which the first stamp is wrong is whole, too.
    assert whole == 41 - 10 + 1
    counters = assembler.counters
    used = 2 * sum(sweep.present.bit_count() for sweep in sweeps)
    assert counters.frames == used + counters.halves
    assert counters.late == counters.missed == 0


@pytest.mark.parametrize("at_once", [1, 3, 16])
@pytest.mark.parametrize("lost", range(1, 8))
def test_a_sweep_whose_first_stamp_is_ahead_ends_in_time_however_it_is_read(
    at_once: int, lost: int
) -> None:
    """In the known order, frames that follow the first are taken together. What that sweep lacks
    is the first that comes of the next.
    """
    assembler = learnt("0-3", 4)
    sent = frames(values(4, 5), 5 * PERIOD)
    sent[0] = (*sent[0][:2], sent[0][2] + 60 * MS)
    del sent[lost]
    sent += frames(values(4, 6), 6 * PERIOD)[lost:]
    sweeps = feed_in_parts(assembler, sent, at_once)
    sweeps += assembler.flush()
    for sweep in sweeps:
        has_nothing_else(sweep, values(4, sweep.t_ns // PERIOD))
    whole = 0b1111 & ~(1 << lost // 2)
    after = [0b1111 >> (lost + 1) // 2 << (lost + 1) // 2] if lost < 7 else []
    assert [sweep.present for sweep in sweeps] == [whole, *after]


def test_a_status_word_comes_without_the_other_half_of_its_triangle() -> None:
    """It may be the only one that says that the chip does not answer."""
    words = np.array([0x0001, 0x0002, 0x0010, 0x0001], np.uint16)
    sent = frames(values(4), PERIOD, status=words)
    # The first loses its A frame, the second its B frame, the last both.
    assembler = make()
    feed(assembler, [sent[1], sent[2], *sent[4:6]])
    (sweep,) = assembler.expire(2 * PERIOD)
    assert sweep.present == 0b0100
    assert sweep.status[:4].tolist() == [1, 0, 0x10, 0]
    assert not sweep.raw[[0, 1, 3]].any()


@pytest.mark.parametrize("dlc", [6, 7])
def test_frames_of_old_firmware_without_status_make_whole_sweeps(dlc: int) -> None:
    assembler = make()
    for number in range(1, 4):
        raw = values(4, number)
        sent = [
            (can_id, data[:dlc] if data[0] == wire.HEADER_B else data, t_ns)
            for can_id, data, t_ns in frames(raw, number * PERIOD)
        ]
        (sweep,) = feed(assembler, sent)
        np.testing.assert_array_equal(sweep.raw[:4], raw)
        assert sweep.present == 0b1111
        assert not sweep.status.any()
    assert assembler.counters.incomplete == 0


#: All A and then all B, or the reverse.
@pytest.mark.parametrize("order", [[0, 2, 4, 6, 1, 3, 5, 7], [1, 3, 5, 7, 0, 2, 4, 6]])
@pytest.mark.parametrize("cut", [1, 3, 6])
def test_frames_that_were_held_up_until_their_sweep_was_closed_are_late_not_lost(
    cut: int, order: list[int]
) -> None:
    sent = [frames(values(4), PERIOD, spacing_ns=1000)[place] for place in order]
    assembler = make()
    feed(assembler, sent[:cut])
    sweeps = assembler.expire(2 * PERIOD)
    assert feed(assembler, sent[cut:]) == []
    sweeps += feed(assembler, frames(values(4, 2), 2 * PERIOD))
    counters = assembler.counters
    used = 2 * sum(sweep.present.bit_count() for sweep in sweeps)
    # Also those that waited for what was held up: each frame is counted.
    assert (counters.incomplete, counters.late, counters.halves) == (1, counters.frames - used, 0)


def test_what_is_missing_from_the_last_sweep_of_a_recording_is_counted() -> None:
    assembler = make()
    feed(assembler, frames(values(4), PERIOD)[:-1])
    assembler.flush()
    assert assembler.counters.halves == 1


def test_halves_of_different_periods_are_never_paired():
    first, second = frames(values(4, 1), PERIOD), frames(values(4, 2), 2 * PERIOD)
    del first[7]  # B of triangle 3
    del second[6]  # A of triangle 3
    assembler = make()
    sweeps = feed(assembler, first + second) + assembler.flush()
    assert [sweep.present for sweep in sweeps] == [0b0111, 0b0111]


@pytest.mark.parametrize("together", [False, True])
def test_halves_from_before_and_after_a_clock_was_set_back_are_never_paired(
    together: bool,
) -> None:
    """The end of a sweep is lost, and the beginning of the next."""
    assembler = make("0")
    first, second, third = (values(1, seed) for seed in (1, 2, 3))
    known = [frame for i in range(20) for frame in frames(values(1, 10 + i), i * PERIOD)]
    feed(assembler, known)
    t_ns = 20 * PERIOD
    before = frames(first, t_ns)[:1]
    after = frames(second, t_ns + PERIOD - 2_000 * MS)[1:]
    last = frames(third, t_ns + 2 * PERIOD - 2_000 * MS)
    sweeps = []
    for batch in [before + after + last] if together else [before, after, last]:
        sweeps += feed(assembler, batch)
    mixed = np.concatenate([first[0, :7], second[0, 7:]])
    assert sweeps
    assert not any((sweep.raw[0] == mixed).all() for sweep in sweeps)
    assert (sweeps[-1].raw[0] == third[0]).all()
    counters = assembler.counters
    assert counters.frames == 2 * sum(s.present.bit_count() for s in sweeps) + 40 + (
        counters.halves + counters.late + counters.doubled
    )


def test_a_slot_that_comes_twice_starts_a_new_sweep():
    # The boards of one period run together with those of the next: a reader that was late.
    first = frames(values(4, 1), PERIOD, spacing_ns=10)[:-1]
    second = frames(values(4, 2), PERIOD + 100, spacing_ns=10)
    sweeps = feed(make(), first + second)
    assert [sweep.present for sweep in sweeps] == [0b0111, 0b1111]


@pytest.mark.parametrize("place", [0, 3, 7])
def test_a_frame_that_comes_twice_in_a_row_changes_nothing_and_is_counted(place: int) -> None:
    raw = values(4)
    sent = frames(raw, PERIOD)
    assembler = make()
    sweeps = feed(assembler, [*sent[: place + 1], *sent[place:], *frames(raw, 2 * PERIOD)])
    assert [sweep.present for sweep in sweeps] == [0b1111, 0b1111]
    np.testing.assert_array_equal(sweeps[0].raw[:4], raw)
    counters = assembler.counters
    assert (counters.doubled, counters.incomplete, counters.halves) == (1, 0, 0)


def test_an_absent_triangle_soon_costs_no_delay_and_is_awaited_when_it_returns():
    assembler = make()
    for period in range(1, PATIENCE_SWEEPS + 1):
        assert feed(assembler, frames(values(3), period * PERIOD)) == []
        assert len(assembler.expire(period * PERIOD + PERIOD)) == 1
    period = PATIENCE_SWEEPS + 1
    (sweep,) = feed(assembler, frames(values(3), period * PERIOD))
    assert sweep.present == 0b0111
    for period in range(PATIENCE_SWEEPS + 2, PATIENCE_SWEEPS + 4):
        sweeps = feed(assembler, frames(values(4), period * PERIOD))
    assert [sweep.present for sweep in sweeps] == [0b1111]
    assert assembler.counters.late == 2


def test_status_words_are_kept_and_missing_ones_read_zero():
    ids, data = wire.encode_sweep(
        1, np.arange(4), values(4), np.array([0, 0x2000, 2, 0xFFF1], np.uint16)
    )
    sent = [
        (int(i), row.tobytes(), PERIOD + k)
        for k, (i, row) in enumerate(zip(ids, data, strict=True))
    ]
    sent[7] = (sent[7][0], sent[7][1][:6], sent[7][2])
    (sweep,) = feed(make(), sent)
    assert sweep.status[:4].tolist() == [0, 0x2000, 2, 0]


def test_a_full_bus_of_fourteen_boards_is_kept_apart():
    assembler = make("0-15", boards=14)
    raws = [values(16, seed) for seed in range(14)]
    sent = [frames(raw, PERIOD, board=1 + i) for i, raw in enumerate(raws)]
    mixed = [frame for group in zip(*sent, strict=True) for frame in group]
    sweeps = feed(assembler, mixed)
    assert sorted(sweep.board for sweep in sweeps) == list(range(14))
    for sweep in sweeps:
        np.testing.assert_array_equal(sweep.raw, raws[sweep.board])


@given(
    seed=st.integers(0, 1000),
    loss=st.sampled_from([0.0, 0.05, 0.3]),
    jitter_ms=st.sampled_from([0, 5, 15]),
)
@settings(max_examples=40)
def test_batches_and_single_frames_give_the_same_sweeps(seed, loss, jitter_ms):
    rng = np.random.default_rng(seed)
    sent = []
    for period in range(1, 12):
        start = period * PERIOD + int(rng.integers(0, jitter_ms * MS + 1))
        for board in (1, 2):
            burst = frames(values(4, seed + period), start, board)
            if rng.random() < 0.3:
                times = [t for _, _, t in burst]
                burst = [(*frame[:2], t) for frame, t in zip(burst[::-1], times, strict=True)]
            sent += [frame for frame in burst if rng.random() >= loss]
    sent.sort(key=lambda frame: frame[2])
    results = []
    for size in (1, 5, 40, len(sent)):
        assembler = make(boards=2)
        sweeps = []
        for i in range(0, len(sent), size):
            sweeps += feed(assembler, sent[i : i + size])
        sweeps += assembler.flush()
        by_board = sorted(sweeps, key=lambda sweep: (sweep.board, sweep.t_ns))
        results.append(
            [
                (s.board, s.t_ns, s.present, s.raw.tobytes(), s.status.tobytes(), s.missed)
                for s in by_board
            ]
        )
    assert results[1:] == results[:-1]


def test_an_early_sweep_is_whole_though_its_first_frame_was_lost_from_the_one_before() -> None:
    assembler = make()
    feed(assembler, frames(values(4, 1), PERIOD))
    feed(assembler, frames(values(4, 2), 2 * PERIOD)[1:])
    early = values(4, 3)
    *_, whole = feed(assembler, frames(early, 2 * PERIOD + 30 * MS))
    np.testing.assert_array_equal(whole.raw[:4], early)
    assert assembler.counters.late == 0


def test_a_sweep_that_two_reads_divide_loses_no_triangle() -> None:
    """An adapter without time stamps, read every 30 ms: its end seems to come too late."""
    assembler = make()
    feed(assembler, frames(values(4, 1), PERIOD))
    sent = frames(values(4, 2), 2 * PERIOD, spacing_ns=0)
    sent[4:] = [(*one[:2], one[2] + 30 * MS) for one in sent[4:]]
    sweeps = feed(assembler, sent) + assembler.expire(4 * PERIOD)
    assert [sweep.present for sweep in sweeps] == [0b0011, 0b1100]
    assert assembler.counters.late == 0


def test_answers_are_handed_on_with_the_bytes_that_they_have() -> None:
    sent = [
        (wire.identifier(wire.MessageClass.ANALOG_COMMAND, 1, 0), b"\x1c\x02\x03", PERIOD),
        (wire.identifier(wire.MessageClass.MANAGEMENT, 1, 0), bytes(range(8)), PERIOD),
        (wire.identifier(wire.MessageClass.MANAGEMENT, 1, 0), b"", PERIOD),
        (wire.identifier(wire.MessageClass.MOTOR_STREAM, 1, 0), b"\x01", PERIOD),
        (wire.identifier(wire.MessageClass.INERTIAL_STREAM, 1, 0), b"\x01", PERIOD),
    ]
    assembler = make()
    assert assembler.feed(FrameBatch.of(sent)).answers == [(one, data) for one, data, _ in sent[:3]]
    assert assembler.counters.other == 5


def test_the_most_frequent_motor_frame_is_named_when_these_are_most_of_what_comes() -> None:
    def after(motors: list[int], others: int) -> int | None:
        assembler = make()
        sent = [(one, b"\x01", PERIOD) for one in motors]
        feed(assembler, sent + frames(values(4), PERIOD)[:others])
        return assembler.stranger_id

    assert after([0x0A5, 0x123, 0x123], others=2) == 0x123
    assert after([0x0A5, 0x123], others=2) is None
    assert after([0x1FF], others=0) == 0x1FF
    assert after([0x200], others=0) is None


def test_a_sweep_expires_once_it_is_older_than_its_share_of_a_period() -> None:
    assembler = make()
    feed(assembler, frames(values(4), PERIOD)[:-1])
    assert assembler.expire(PERIOD + 45 * MS) == []
    (sweep,) = assembler.expire(PERIOD + 45 * MS + 1)
    assert sweep.present == 0b0111
    assert assembler.expire(10 * PERIOD) == []


@pytest.mark.parametrize("ahead_ns", [0, 3600 * 1000 * MS])
@pytest.mark.parametrize("first", [0, 5])
def test_what_began_before_a_pause_comes_before_what_began_after_it(
    first: int, ahead_ns: int
) -> None:
    """A reader that was held up joins boards' sweeps as they come, whatever it reads at once. A
    sweep that was stamped an hour ahead changes nothing about that.
    """
    assembler = make(boards=2)
    for number in range(1, 4):
        for board in (1, 2):
            stamp_ns = number * PERIOD + (ahead_ns if (number, board) == (2, 2) else 0)
            feed(assembler, frames(values(4), stamp_ns, board))
    before, after = 4 * PERIOD, 24 * PERIOD
    sent = [*frames(values(4), before, 1)[:5], *frames(values(4), after, 2)]
    sent += frames(values(4), after + 5 * MS, 1)
    sweeps = feed(assembler, sent[:first]) + feed(assembler, sent[first:])
    assert [(one.board, one.t_ns // PERIOD) for one in sweeps] == [(0, 4), (1, 24), (0, 24)]
    assert [one.present for one in sweeps] == [0b0011, 0b1111, 0b1111]


def test_two_boards_at_one_address_crowd_it_and_one_that_is_early_does_not() -> None:
    def crowded(apart_ms: float) -> list[bool]:
        assembler = make("0")
        starts = PERIOD, PERIOD + round(apart_ms * MS), 2 * PERIOD + 20 * MS
        sweeps = [one for at in starts for one in feed(assembler, frames(values(1, at), at))]
        assert assembler.counters.sweeps == 3
        return [sweep.crowded for sweep in sweeps]

    found = [crowded(apart_ms) for apart_ms in (1.0, 24.0, 25.0, 40.0)]
    assert found == [[False, second, False] for second in (True, True, False, False)]


@pytest.mark.parametrize("triangles", [1, 4])
def test_two_boards_whose_sweeps_were_stamped_by_one_read_crowd_their_address(
    triangles: int,
) -> None:
    """By libraries that stamp frames as they are read, two boards at an address were not found."""
    assembler = make(f"0-{triangles - 1}")
    found = []
    for period in range(1, 20):
        sent = [
            frame
            for board in range(2)
            for frame in frames(values(triangles, 2 * period + board), period * PERIOD, 1, 0)
        ]
        found += [sweep.crowded for sweep in feed(assembler, sent)]
    assert found == [False, True] * 19


def test_a_sweep_after_one_that_came_too_soon_and_without_a_whole_triangle_is_crowded() -> None:
    assembler = make("0-3")
    sent = frames(values(4), PERIOD)
    feed(assembler, sent)
    # Half a triangle of another board, which is no sweep.
    assert feed(assembler, frames(values(4, 9), PERIOD + 13 * MS)[:1]) == []
    (sweep,) = feed(assembler, frames(values(4), 2 * PERIOD))
    assert sweep.crowded
    (sweep,) = feed(assembler, frames(values(4), 3 * PERIOD))
    assert not sweep.crowded


def test_a_slot_that_repeats_its_bytes_a_period_later_was_sent_again() -> None:
    """A board of which one frame comes, always the same: each is a sweep of its own."""

    def counted(apart_ns: int) -> tuple[int, int]:
        assembler = make("0-1")
        first = frames(values(2), PERIOD)[0]
        feed(assembler, [first])
        feed(assembler, [(*first[:2], PERIOD + apart_ns)])
        assembler.flush()
        return assembler.counters.doubled, assembler.counters.halves

    assert counted(0) == counted(25 * MS) == (1, 1)
    assert counted(25 * MS + 1) == counted(PERIOD) == counted(-1) == (0, 2)


@pytest.mark.parametrize("value", [99, 101])
def test_a_slot_that_comes_at_once_with_other_bytes_was_not_doubled(value: int) -> None:
    assembler = make()
    raw = np.full((4, 12), 100, np.uint8)
    other = np.full_like(raw, value)
    feed(assembler, [frames(raw, PERIOD)[0], frames(other, PERIOD)[0]])
    assembler.flush()
    assert (assembler.counters.doubled, assembler.counters.halves) == (0, 2)


def test_a_doubled_last_frame_is_told_from_the_next_sweeps_first() -> None:
    """With one triangle of one frame missing, the last slot of a sweep is the next one's first."""

    def counted(apart_ns: int) -> int:
        assembler = make("0")
        (first, second) = frames(values(1), PERIOD)
        feed(assembler, [first, second, (*second[:2], first[2] + apart_ns)])
        return assembler.counters.doubled

    assert counted(25 * MS) == 1
    assert counted(25 * MS + 1) == 0


def test_what_is_no_longer_awaited_makes_no_sweep_incomplete_and_comes_late_within_a_pause() -> (
    None
):
    assembler = make("0-1")
    for period in range(1, PATIENCE_SWEEPS + 3):
        feed(assembler, frames(values(1, period), period * PERIOD))
        assembler.expire((period + 1) * PERIOD)
    assert assembler.counters.incomplete == PATIENCE_SWEEPS
    assert assembler.counters.halves == 0
    start = 10 * PERIOD
    feed(assembler, frames(values(1), start))
    *_, first, second = frames(values(2), start)
    feed(assembler, [(*first[:2], start + 25 * MS)])
    assert assembler.counters.late == 1
    # From then on it is awaited; what comes after a pause begins a sweep.
    feed(assembler, [(*second[:2], start + 25 * MS + 1)])
    assert assembler.counters.late == 1
    sweeps = assembler.counters.sweeps
    assembler.flush()
    assert assembler.counters.sweeps == sweeps + 1


@pytest.mark.parametrize("triangles", [2, 4])
def test_a_triangle_is_awaited_until_it_was_missing_so_often_in_a_row(triangles: int) -> None:
    """Whole sweeps begin that again, also those that are taken as a whole."""
    assembler = make(f"0-{triangles - 1}")
    for period in range(1, 40):
        whole = period % (PATIENCE_SWEEPS + 1) >= PATIENCE_SWEEPS - 1
        sent = frames(values(triangles - (not whole), period), period * PERIOD)
        assert len(feed(assembler, sent)) == whole
        assembler.expire((period + 1) * PERIOD - 1)


def test_a_board_that_only_sends_halves_is_awaited_in_whole_again() -> None:
    assembler = make("0-1")
    for period in range(1, 12):
        feed(assembler, frames(values(2, period), period * PERIOD)[::2])
        assert assembler.expire((period + 1) * PERIOD) == []
    (sweep,) = feed(assembler, frames(values(2), 12 * PERIOD))
    assert assembler.counters.halves == 2 * (assembler.counters.sweeps - 1) == 22
    assert sweep.present == 0b11
