"""When a sweep ends, and how many were missed between two."""

import pytest

from tests.support.sweeps import MS, PERIOD, feed, frames, make, values


def test_the_frames_of_a_slow_burst_are_one_sweep_until_it_is_too_old() -> None:
    """No pause is longer than a third of a period where its first frame is older than half of one,
    and its last frame is 0.9 periods old.
    """
    raw = values(2)

    def cut(*times_ms: float) -> list[int]:
        sent = frames(raw, 0)
        times = [PERIOD + round(t_ms * MS) for t_ms in times_ms]
        late = [(*one[:2], t_ns) for one, t_ns in zip(sent, times, strict=True)]
        assembler = make("0-1")
        alone = [sweep.present for frame in late for sweep in feed(assembler, [frame])]
        assert assembler.counters.doubled == 0
        return alone + [sweep.present for sweep in assembler.flush()]

    assert cut(0, 15, 30, 45) == [0b11]
    assert cut(0, 25, 30, 45) == [0b11]
    assert cut(0, 1, 26.001, 27) == [0b01, 0b10]
    assert cut(0, 20, 36, 45.001) == [0b01]
    assert cut(0, 8.3, 25.001, 26) == [0b01, 0b10]
    # Stamps that step back a little end no sweep.
    assert cut(3, 2, 1, 0) == [0b11]


def test_missed_periods_are_counted():
    assembler = make()
    feed(assembler, frames(values(4), PERIOD))
    (sweep,) = feed(assembler, frames(values(4), 4 * PERIOD))
    assert sweep.missed == 2
    assert assembler.counters.missed == 2


@pytest.mark.parametrize(("apart", "missed"), [(0.6, 0), (1.4, 0), (1.6, 1), (2.4, 1), (10.0, 9)])
def test_periods_without_a_frame_are_rounded(apart: float, missed: int) -> None:
    assembler = make()
    feed(assembler, frames(values(4), PERIOD))
    (sweep,) = feed(assembler, frames(values(4, 1), PERIOD + round(apart * PERIOD)))
    assert sweep.missed == assembler.counters.missed == missed


@pytest.mark.parametrize("step_s", [3600, -3600, 0.2])
@pytest.mark.parametrize("buffered", [0, 2])
@pytest.mark.parametrize("lost", [0, 3])
def test_sweeps_are_not_missed_in_time_that_only_the_clock_passed(
    step_s: float, buffered: int, lost: int
) -> None:
    """Some sweeps may follow that were stamped before it was set; what was lost is counted. The
    period scatters.
    """
    begun_ns, step_ns = 10_000 * 1_000_000_000, round(step_s * 1e9)
    assembler = make()

    def send(number: int, set_ns: int = 0) -> None:
        at_ns = begun_ns + number * PERIOD + number % 2 * MS + set_ns
        feed(assembler, frames(values(4, number), at_ns))

    for number in range(5 + buffered):
        if number == 5:
            assembler.clock_set(step_ns)
        send(number)
    if not buffered:
        assembler.clock_set(step_ns)
    for number in range(5 + buffered + lost, 15):
        send(number, step_ns)
    assert assembler.counters.missed == lost
    assert assembler.counters.sweeps == 15 - lost


@pytest.mark.parametrize("wrong_ns", [3600 * 10**9, -3600 * 10**9, -(10**9), -(1 << 60), 1 << 60])
@pytest.mark.parametrize("place", [0, 3, 7])
@pytest.mark.parametrize("lost", [0, 2])
def test_one_wrong_time_stamp_is_no_time_in_which_sweeps_were_missed(
    wrong_ns: int, place: int, lost: int
) -> None:
    """One that was an hour ahead added 71999 missed periods; what was lost is counted."""
    begun_ns = 10_000 * 1_000_000_000
    assembler = make()
    missed = []
    for number in [*range(5), *range(5 + lost, 12)]:
        sent = frames(values(4, number), begun_ns + number * PERIOD)
        if number == 5 + lost:
            sent[place] = (*sent[place][:2], sent[place][2] + wrong_ns)
        for frame in sent:
            missed += [sweep.missed for sweep in feed(assembler, [frame])]
    assert assembler.counters.missed == lost
    assert sum(missed) == lost
