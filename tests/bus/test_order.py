"""Sweeps in their board's usual order are taken as a whole, with the same result."""

import struct
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.bus.assembler import PATIENCE_SWEEPS, Assembler
from skin_host.bus.wire import FrameBatch, Records
from tests.support.sweeps import MS, PERIOD, feed, frames, learnt, make, values


class PaddedBatch(FrameBatch):
    """Frames of which more lies in memory, as it does where the kernel wrote them."""

    def records(self) -> Records:
        octets, form, head = FrameBatch.records(self)
        padding = np.full((len(octets), 1), 0xAA, np.uint8)
        padded = struct.Struct(f"=x{form.format.removeprefix('=')}x")
        return Records(np.hstack([padding, octets, padding]), padded, head + 1)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_frames_in_the_usual_order_are_taken_together_with_the_same_result(data):
    """Orders, losses, repeats, times and what batches divide vary."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    harm = data.draw(st.sampled_from([0.0, 0.01, 0.05]))
    order = rng.permutation(16) if data.draw(st.booleans()) else np.arange(16)
    n_boards = data.draw(st.integers(1, 2))
    sent: list[tuple[int, bytes, int]] = []
    for number in range(30):
        for board in range(1, n_boards + 1):
            words = rng.integers(0, 2, 8, np.uint16) if rng.random() < 0.5 else None
            start = number * PERIOD + board * 3 * MS
            swept = frames(values(8, number), start, board=board, status=words)
            times = [t_ns for _, _, t_ns in swept]
            if rng.random() < harm:
                times[rng.integers(16)] += int(rng.integers(-60, 60)) * MS
            came = [swept[i] for i in order]
            sent += [
                (one, payload, t_ns) for (one, payload, _), t_ns in zip(came, times, strict=True)
            ]
    sent = [frame for frame in sent if rng.random() >= harm]
    sent = [again for frame in sent for again in [frame] * (1 + (rng.random() < harm))]
    sent = [
        frame
        if rng.random() >= harm
        else (int(rng.choice([0x310, 0x610])) | frame[0] & 15, *frame[1:])
        for frame in sent
    ]
    alone, together = make("0-7", n_boards), make("0-7", n_boards)
    alone._take_sweep = alone._take_run = lambda *_: 0  # type: ignore[method-assign]
    expected = [sweep for frame in sent for sweep in feed(alone, [frame])]
    cuts = sorted(rng.integers(0, len(sent), data.draw(st.integers(0, 40))).tolist())
    found = [
        sweep
        for begin, end in pairwise([0, *cuts, len(sent)])
        for sweep in feed(together, sent[begin:end])
    ]
    assert together.counters == alone.counters
    for mine, its in zip(found, expected, strict=True):
        assert all(map(np.array_equal, mine, its))


@pytest.mark.parametrize("batch", [FrameBatch, PaddedBatch])
@pytest.mark.parametrize("n", [4, 16])
@pytest.mark.parametrize("reverse", [False, True])
def test_a_whole_board_of_known_order_keeps_every_byte_in_its_place(
    batch: type[FrameBatch], n: int, reverse: bool
) -> None:
    order = [*range(n, 2 * n), *range(n)] if reverse else list(range(2 * n))
    assembler = learnt(f"0-{n - 1}", n, order)
    rng = np.random.default_rng(n)
    for period in range(5, 9):
        raw = values(n, period)
        words = rng.integers(0, 1 << 16, n, np.uint16) if period % 2 else np.zeros(n, np.uint16)
        swept = frames(raw, period * PERIOD, status=words)
        times = [t_ns for _, _, t_ns in swept]
        sent = [(*swept[i][:2], t_ns) for i, t_ns in zip(order, times, strict=True)]
        (sweep,) = feed(assembler, sent, batch)
        np.testing.assert_array_equal(sweep.raw[:n], raw)
        assert sweep.status.tolist() == [*words, *[0] * (16 - n)]
        assert not sweep.raw[n:].any()
        assert (sweep.present, sweep.t_ns, sweep.missed) == ((1 << n) - 1, times[-1], 0)


@pytest.mark.parametrize("first", [0, 1])
def test_the_end_of_a_sweep_of_known_order_may_come_in_time_and_not_later(first: int) -> None:
    """A pause of more than half a period ends a sweep, however its frames were read."""
    for late_ms, present in ((24, [0b1111]), (26, [0b0111, 0b1000])):
        assembler = learnt("0-3", 4)
        sent = frames(values(4, 9), 5 * PERIOD, spacing_ns=0)
        sent[6:] = [(*one[:2], one[2] + late_ms * MS) for one in sent[6:]]
        sweeps = feed(assembler, sent[:first]) + feed(assembler, sent[first:])
        assert [sweep.present for sweep in sweeps + assembler.flush()] == present


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many frames are taken as a whole, each time."""
    found: list[int] = []

    def watched(take: Callable[..., int]) -> Callable[..., int]:
        def note(*args: object) -> int:
            n = take(*args)
            found.extend([n] if n else [])
            return n

        return note

    for name in ("_take_sweep", "_take_run"):
        monkeypatch.setattr(Assembler, name, watched(getattr(Assembler, name)))
    return found


def test_a_sweep_of_known_order_that_is_read_in_parts_is_taken_in_parts(taken: list[int]) -> None:
    assembler = learnt("0-3", 4)
    taken.clear()
    for period in range(5, 15):
        raw = values(4, period)
        sent = frames(raw, period * PERIOD)
        assert feed(assembler, sent[:3]) == []
        assert feed(assembler, sent[3:4]) == []
        (sweep,) = feed(assembler, sent[4:])
        np.testing.assert_array_equal(sweep.raw[:4], raw)
    assert taken == [3, 1, 4] * 10


def test_an_order_is_learnt_of_a_sweep_of_which_every_triangle_was_awaited(
    taken: list[int],
) -> None:
    """One of them returns amid the first sweep that is whole."""
    assembler = make()
    for period in range(1, PATIENCE_SWEEPS + 2):
        feed(assembler, frames(values(4), period * PERIOD)[2:])
        assembler.expire((period + 1) * PERIOD - 1)
    for period in range(10, 20):
        sent = frames(values(4, period), period * PERIOD)
        times = [t_ns for _, _, t_ns in sent]
        came = [
            (*sent[i][:2], t_ns) for i, t_ns in zip((2, 0, 1, *range(3, 8)), times, strict=True)
        ]
        assert len(feed(assembler, came)) == 1
    assert taken == [8] * 8


def test_once_a_boards_order_is_known_its_frames_are_taken_as_a_whole(taken: list[int]) -> None:
    """An order that changes for good is learnt again, after a while."""
    assembler = make()

    def run(periods: range, order: list[int]) -> list[int]:
        taken.clear()
        for period in periods:
            swept = frames(values(4, period), period * PERIOD)
            times = [t_ns for _, _, t_ns in swept]
            mixed = [(*swept[i][:2], t_ns) for i, t_ns in zip(order, times, strict=True)]
            assert len(feed(assembler, mixed)) == 1
        return taken.copy()

    assert run(range(1, 11), list(range(8))) == [8] * 8  # the second sweep shows the order
    for first, order in ((11, [7, 6, 5, 4, 3, 2, 1, 0]), (111, [1, 0, 3, 2, 7, 6, 5, 4])):
        # Four sweeps that differ, a pause of 64, and one that shows the order.
        assert run(range(first, first + 69), order) == []
        assert run(range(first + 69, first + 79), order) == [8] * 10


@pytest.mark.parametrize("at_once", [1, 8])
def test_a_triangle_that_returns_is_late_in_its_first_sweep_however_that_is_read(
    at_once: int,
) -> None:
    assembler = learnt("0-3", 4)
    for period in range(5, 9):
        feed(assembler, frames(values(3, period), period * PERIOD))
        assembler.expire((period + 1) * PERIOD - 1)
    sent = frames(values(4), 9 * PERIOD)
    sweeps = [
        sweep for at in range(0, 8, at_once) for sweep in feed(assembler, sent[at : at + at_once])
    ]
    assert [sweep.present for sweep in sweeps] == [0b0111]
    assert assembler.counters.late == 2
    (sweep,) = feed(assembler, frames(values(4), 10 * PERIOD))
    assert sweep.present == 0b1111


def test_what_a_board_of_known_order_lost_is_counted_though_whole_sweeps_follow() -> None:
    assembler = learnt("0-3", 4)
    for period in range(5, 10):
        sent = frames(values(4, period), period * PERIOD)
        if period % 2:
            del sent[3]
        feed(assembler, sent)
        if not period % 2:
            assert assembler.counters.halves == assembler.counters.incomplete == period // 2 - 2
        assembler.expire((period + 1) * PERIOD - 1)


def test_a_short_frame_amid_a_known_order_is_counted_and_is_no_value() -> None:
    assembler = learnt("0-3", 4)
    sent = frames(values(4, 9), 5 * PERIOD)
    sent[5] = (sent[5][0], sent[5][1][:5], sent[5][2])
    sweeps = feed(assembler, sent) + assembler.flush()
    assert [sweep.present for sweep in sweeps] == [0b1011]
    assert assembler.counters.short == 1
