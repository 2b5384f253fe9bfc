"""Frames to sweeps: pairing, completeness, and an account of everything that went wrong."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin_host.bus import wire
from skin_host.bus.assembler import PATIENCE_SWEEPS, Assembler, Sweep
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Board, Bus, Part, Patch, Settings
from skin_host.layout import build_layout

MS = 1_000_000
PERIOD = 50 * MS


def make(triangles: str = "0-3", boards: int = 1) -> Assembler:
    names = [f"b{i}" for i in range(boards)]
    skin = build_layout(
        Settings(
            robot="r",
            buses={"can0": Bus()},
            boards={name: Board(bus="can0", address=1 + i) for i, name in enumerate(names)},
            parts={name: Part(patches=[Patch(board=name, triangles=triangles)]) for name in names},
        ),
        Path(),
    )
    return Assembler(list(enumerate(skin.boards)), close_periods=0.9)


def values(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, 12), np.uint8)


def frames(
    raw: np.ndarray, t_ns: int, board: int = 1, spacing_ns: int = 125_000
) -> list[tuple[int, bytes, int]]:
    n = len(raw)
    ids, data = wire.encode_sweep(board, np.arange(n), raw, np.zeros(n, np.uint16))
    return [
        (int(can_id), row.tobytes(), t_ns + i * spacing_ns)
        for i, (can_id, row) in enumerate(zip(ids, data, strict=True))
    ]


def feed(assembler: Assembler, sent: list[tuple[int, bytes, int]]) -> list[Sweep]:
    return assembler.feed(FrameBatch.of(sent)).sweeps


def test_a_whole_sweep_is_handed_on_with_its_last_frame():
    raw = values(4)
    sent = frames(raw, t_ns=PERIOD)
    assembler = make()
    assert feed(assembler, sent[:-1]) == []
    (sweep,) = feed(assembler, sent[-1:])
    np.testing.assert_array_equal(sweep.raw[:4], raw)
    assert sweep.present == 0b1111
    assert sweep.t_ns == sent[-1][2]


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
    assert assembler.counters.halves == 1


def test_halves_of_different_periods_are_never_paired():
    first, second = frames(values(4, 1), PERIOD), frames(values(4, 2), 2 * PERIOD)
    del first[7]  # B of triangle 3
    del second[6]  # A of triangle 3
    assembler = make()
    sweeps = feed(assembler, first + second) + assembler.flush()
    assert [sweep.present for sweep in sweeps] == [0b0111, 0b0111]


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


def test_missed_periods_are_counted():
    assembler = make()
    feed(assembler, frames(values(4), PERIOD))
    (sweep,) = feed(assembler, frames(values(4), 4 * PERIOD))
    assert sweep.missed == 2
    assert assembler.counters.missed == 2


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


def test_strangers_are_counted():
    assembler = make("0-1")
    feed(assembler, frames(values(1), PERIOD, board=9) + frames(values(3), PERIOD))
    assert assembler.counters.unknown_board == 2
    assert assembler.counters.unknown_triangle == 2


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


@pytest.mark.parametrize("garbage", [0xFFFFFFFF, 0x7FF, 0x4F0, 0x400])
def test_any_identifier_is_survived(garbage):
    assembler = make()
    assert feed(assembler, [(garbage, b"\x40" + bytes(7), PERIOD)]) == []
    counters = assembler.counters
    assert counters.other + counters.unknown_board == 1


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_frames_in_the_usual_order_are_taken_together_with_the_same_result(data):
    """Fed one by one no frame is part of a run; orders, losses, repeats and times vary."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    harm = data.draw(st.sampled_from([0.0, 0.01, 0.05]))
    order = rng.permutation(16) if data.draw(st.booleans()) else np.arange(16)
    n_boards = data.draw(st.integers(1, 2))
    sent: list[tuple[int, bytes, int]] = []
    for number in range(30):
        for board in range(1, n_boards + 1):
            swept = frames(values(8, number), number * PERIOD + board * 3 * MS, board=board)
            times = [t_ns for _, _, t_ns in swept]
            if rng.random() < harm:
                times[rng.integers(16)] += int(rng.integers(-60, 60)) * MS
            came = [swept[i] for i in order]
            sent += [
                (one, payload, t_ns) for (one, payload, _), t_ns in zip(came, times, strict=True)
            ]
    sent = [frame for frame in sent if rng.random() >= harm]
    sent = [again for frame in sent for again in [frame] * (1 + (rng.random() < harm))]
    alone, together = make("0-7", n_boards), make("0-7", n_boards)
    expected = [sweep for frame in sent for sweep in feed(alone, [frame])]
    cuts = sorted(rng.integers(0, len(sent), data.draw(st.integers(0, 40))).tolist())
    found = [
        sweep
        for begin, end in pairwise([0, *cuts, len(sent)])
        for sweep in feed(together, sent[begin:end])
    ]
    assert together.counters == alone.counters
    assert together.crowded == alone.crowded
    for mine, its in zip(found, expected, strict=True):
        assert all(map(np.array_equal, mine, its))
