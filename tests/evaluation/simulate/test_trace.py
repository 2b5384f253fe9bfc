"""The hash of a run's events, of all and of those before some time."""

from pathlib import Path

from skin_host.evaluation.simulate.outcome import story
from skin_host.evaluation.simulate.run import RunResult
from skin_host.evaluation.simulate.trace import Trace

MS = 1_000_000


def happen(trace: Trace, events: int) -> Trace:
    """Something happens every 10 ms."""
    for number in range(events):
        trace.data(10 * MS * number, "kind", b"%d" % number)
    return trace


def test_a_run_that_ends_early_has_the_hash_that_the_whole_run_has_at_that_time() -> None:
    whole = happen(Trace(), 480)
    assert [second.at_s for second in whole.seconds] == [2, 3, 4]
    for second in whole.seconds:
        early = Trace()
        early.end_at(second.at_s)
        # Whatever else happens at that moment.
        happen(early, 100 * second.at_s + 7)
        assert (early.count, early.digest()) == (second.events, second.digest)
        assert second.events == 100 * second.at_s
    assert whole.count == 480
    assert whole.digest() == happen(Trace(), 480).digest() != whole.seconds[-1].digest


def test_a_run_may_end_within_a_second() -> None:
    early = Trace()
    early.end_at(3.5)
    happen(early, 400)
    assert early.digest() == happen(Trace(), 350).digest()
    assert [second.at_s for second in early.seconds] == [1, 2, 3]


def test_seconds_in_which_nothing_happens_are_passed_over() -> None:
    trace = Trace()
    for at_ms in (100, 4200, 4300, 9000):
        trace.data(at_ms * MS, "kind")
    assert [(second.at_s, second.events) for second in trace.seconds] == [(4, 1), (9, 3)]


def test_a_broken_promise_is_shown_with_the_run_that_ends_a_second_before() -> None:
    trace = happen(Trace(), 480)
    seconds = list(trace.seconds)
    result = RunResult(7, 4.79, events=480, digest=trace.digest(), seconds=seconds, broken="so")
    text = story(result, Path("robot.toml"), 0.03)
    assert "broken at 4.790 s: so" in text
    assert "skin simulate robot.toml --seed 7 --hours 0.03 --until 3\n" in text
    assert f"300 events, hash {seconds[1].digest}" in text
    result.seconds, result.simulated_s = [], 0.3
    assert "--until" not in story(result, Path("robot.toml"), 0.03)
