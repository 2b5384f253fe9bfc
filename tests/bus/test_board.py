"""What is concluded from the times of one board's sweeps."""

from itertools import accumulate

import pytest

from skin_host.bus.board import BoardRecord
from skin_host.layout import build_layout
from skin_host.settings import load
from tests.support.stack import ROOT

CONFIG = ROOT / "config" / "demo.toml"


def record_of(intervals_ms: list[float]) -> BoardRecord:
    """A board set to 50 ms whose sweeps came so far apart."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    record = BoardRecord(0, layout.boards[0])
    record.sweep_times_ns.extend(round(t * 1e6) for t in accumulate(intervals_ms, initial=0.0))
    return record


@pytest.mark.parametrize("period_ms", [20.0, 37.0, 63.0, 100.0])
def test_another_period_is_recognised(period_ms: float) -> None:
    assert record_of([period_ms] * 16).wrong_period_ns == pytest.approx(period_ms * 1e6)


@pytest.mark.parametrize(
    "intervals_ms",
    [
        [50.0] * 16,
        [49.0, 51.5] * 8,
        # Too few to say anything.
        [20.0] * 6,
        # Held up now and then, and sent in bunches.
        [140.0, 5.0, 5.0] * 5,
        # One long pause.
        [50.0] * 15 + [3000.0],
    ],
)
def test_the_period_that_was_set_stays_it_when_sweeps_are_held_up(
    intervals_ms: list[float],
) -> None:
    assert record_of(intervals_ms).wrong_period_ns is None


def test_triangles_that_never_come_are_missing_and_those_of_cut_sweeps_are_not() -> None:
    record = record_of([])
    enabled = record.layout.enabled
    lowest = enabled & -enabled
    assert record.missing == 0
    for turn in range(8):
        record.presents.append(enabled & ~lowest if turn % 2 else lowest)
    assert record.missing == 0
    for _ in range(8):
        record.presents.append(enabled & ~lowest)
    assert record.missing == lowest
