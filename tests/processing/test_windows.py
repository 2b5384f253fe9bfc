"""Sums over the samples of a part, also for sweeps that were skipped."""

import numpy as np

from skin_host.processing.windows import IDLE_UPDATE_S, ROWS, Windows

M = 3
DRIFT_S = 1.0
#: Of which sums are exact.
DT_S = 1 / 16
KPA_PER_UNIT = np.array([0.5, 1.0, 2.0])
NONE = np.zeros(M, np.uint8)


def make(relax_s: float = DRIFT_S) -> Windows:
    windows = Windows(M, DRIFT_S, lambda rows, sums_kpa: None)
    windows.relax_in(relax_s)
    return windows


def add(windows: Windows, kpa: float, raw: np.ndarray = NONE, quiet: bool = True) -> bool:
    windows.row[:] = kpa
    return windows.add(raw, DT_S, KPA_PER_UNIT if quiet else None)


def test_a_sample_stands_for_the_sweeps_that_were_skipped_before_it() -> None:
    """They differ from it by their bytes: a pad that reads less has a higher pressure."""
    windows = make()
    for raw in (10, 12):
        windows.skip(np.full(M, raw, np.uint8), DT_S)
    assert windows.unseen_s == 2 * DT_S
    add(windows, 4.0, np.full(M, 11, np.uint8))
    windows.end_piece(early=True)
    assert windows.drifting.samples == 3
    assert windows.drifting.skipped == 0
    assert windows.drifting.elapsed_s == 3 * DT_S
    # One unit more and one less than in the sample.
    assert windows.drifting.sum_kpa.tolist() == [12.0, 12.0, 12.0]
    assert windows.unseen_s == 0.0


def test_bytes_of_skipped_sweeps_count_by_the_slope_of_each_taxel() -> None:
    windows = make()
    windows.skip(np.full(M, 8, np.uint8), DT_S)
    add(windows, 0.0, np.full(M, 10, np.uint8))
    windows.end_piece(early=True)
    assert windows.drifting.sum_kpa.tolist() == [1.0, 2.0, 4.0]


def test_what_was_skipped_before_a_touch_is_in_no_sum() -> None:
    windows = make()
    windows.skip(NONE, DT_S)
    add(windows, 4.0, quiet=False)
    windows.end_piece(early=True)
    assert windows.drifting.samples == 1
    assert windows.drifting.skipped == 1
    assert windows.drifting.sum_kpa.tolist() == [4.0, 4.0, 4.0]


def test_an_idle_part_is_sampled_now_and_then_and_at_the_end_of_a_piece() -> None:
    windows = make(relax_s=6 * DT_S)
    sampled = []
    for _ in range(6):
        sampled.append(windows.due(DT_S))
        if sampled[-1]:
            add(windows, 1.0)
        else:
            windows.skip(NONE, DT_S)
    assert 3 * DT_S < IDLE_UPDATE_S < 4 * DT_S
    assert sampled == [False, False, False, True, False, True]


def test_a_piece_ends_with_the_window_that_ends_first() -> None:
    windows = make(relax_s=6 * DT_S)
    ends = []
    for number in range(1, 25):
        if add(windows, 1.0):
            drifted, relaxed = windows.end_piece(early=False)
            ends.append((number, drifted, relaxed))
            if drifted:
                assert windows.drifting.samples == 16
                windows.drifting.clear()
            if relaxed:
                assert windows.relaxing.samples == 6
                windows.relaxing.clear()
            windows.begin_piece()
    baselines, relaxation = (True, False), (False, True)
    assert ends == [
        (6, *relaxation),
        (12, *relaxation),
        (16, *baselines),
        (18, *relaxation),
        (24, *relaxation),
    ]


def test_without_a_sample_no_window_ends_early() -> None:
    windows = make()
    windows.skip(NONE, DT_S)
    assert windows.end_piece(early=True) == (False, False)
    assert windows.drifting.skipped == 1


def test_the_lowest_mean_is_that_of_successive_samples() -> None:
    windows = make()
    for kpa in [4.0] * ROWS + [1.0, 3.0] * (ROWS // 2) + [0.0] * (ROWS - 1):
        add(windows, kpa)
    windows.end_piece(early=True)
    assert windows.drifting.lowest_kpa.tolist() == [2.0, 2.0, 2.0]


def test_stored_samples_are_passed_on_once_each() -> None:
    passed: list[tuple[int, float]] = []
    windows = Windows(M, DRIFT_S, lambda rows, sums: passed.append((len(rows), float(sums[0]))))
    for _ in range(ROWS + 2):
        add(windows, 1.0)
    windows.fold()
    windows.fold()
    assert passed == [(ROWS, float(ROWS)), (2, 2.0)]


def test_what_is_forgotten_of_a_taxel_is_in_no_sum() -> None:
    windows = make()
    for _ in range(ROWS + 1):
        add(windows, 5.0)
    windows.forget(np.array([True, False, False]))
    windows.end_piece(early=True)
    assert windows.drifting.sum_kpa.tolist() == [0.0, 5.0 * (ROWS + 1), 5.0 * (ROWS + 1)]
    assert windows.drifting.lowest_kpa.tolist() == [np.inf, 5.0, 5.0]


def test_skipped_sweeps_of_a_new_zero_count_as_its_untouched_byte() -> None:
    windows = make()
    for _ in range(2):
        windows.skip(np.full(M, 8, np.uint8), DT_S)
    windows.begin_anew(np.array([True, False, False]), np.full(M, 10, np.uint8))
    add(windows, 0.0, np.full(M, 10, np.uint8))
    windows.end_piece(early=True)
    assert windows.drifting.sum_kpa.tolist() == [0.0, 4.0, 8.0]
