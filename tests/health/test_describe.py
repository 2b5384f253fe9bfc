"""What the records of parts are made of."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skin_host.health.describe import _age_ms, _period, common_shift, enough_rest
from skin_host.health.diagnosis import COMMON_UNITS
from skin_host.health.watch import FOAM_NS, PartWatch
from skin_host.processing.calibration import Verdict
from skin_host.processing.core import Step
from skin_host.processing.frame import PressureFrame
from tests.support.fault_bench import CONFIG, FaultBench

TRIANGLES = np.repeat(np.arange(3), 10)
MS = 1_000_000


def test_what_moves_all_triangles_is_a_common_shift() -> None:
    rests = np.ones(30, np.bool_)
    noise = np.random.default_rng(1).normal(0.0, 0.8, 30)
    assert common_shift(2.0 + noise, rests, TRIANGLES) == pytest.approx(2.0, abs=0.5)
    rests[:8] = False
    assert common_shift(-3.0 + noise, rests, TRIANGLES) == pytest.approx(-3.0, abs=0.5)


@pytest.mark.parametrize("units", [-16.0, 16.0])
def test_what_moves_most_pads_of_some_triangles_only_is_none(units: float) -> None:
    """A press that a board took for its zero has lifted, or something lies on the part."""
    shift = np.random.default_rng(2).normal(0.0, 0.8, 30)
    shift[:18] += units
    assert common_shift(shift, np.ones(30, np.bool_), TRIANGLES) == 0.0


@pytest.mark.parametrize(("pads", "moved"), [(7, False), (10, True)])
def test_what_moves_only_most_pads_of_a_part_of_one_triangle_is_none(
    pads: int, moved: bool
) -> None:
    shift = np.where(np.arange(12) < pads, -5.0, 0.0)
    assert (common_shift(shift, np.ones(12, np.bool_), np.zeros(12, np.int64)) != 0.0) is moved


def test_a_pause_among_the_first_sweeps_is_no_longer_period() -> None:
    assert _period(np.array([50] * 7 + [200]) * MS, 50) == (None, None)
    assert _period(np.array([50] * 8 + [200]) * MS, 50) == (50.0, 0.0)
    assert _period(np.array([90] * 8) * MS, 50) == (90.0, 0.0)


def test_a_pad_that_was_pressed_does_not_rest_until_its_foam_has_recovered() -> None:
    """After many presses most pads of a part read too much together, as if it became warmer."""
    watch = PartWatch(late_samples=3)
    n, valid = 12, np.arange(12) > 0

    def rests_at(elapsed_ns: int, touched: int | None = None, t_ns: int = 0) -> list[int]:
        raw, none = np.full(n, 240, np.uint8), np.zeros(n, np.bool_)
        kpa, touches = np.zeros(n, np.float32), np.arange(n) == touched
        frame = PressureFrame("arm", 0, t_ns, raw, kpa, touches, valid, none, elapsed_ns=elapsed_ns)
        watch.note(Step(0, frame, []), None)
        rests = watch.rests()
        assert rests is not None
        return np.flatnonzero(~rests).tolist()

    assert rests_at(0) == [0]
    assert rests_at(1_000 * MS, touched=3) == [0, 3]
    assert rests_at(2_000 * MS) == [0, 3]
    # A clock that is set lets no foam recover.
    assert rests_at(3_000 * MS, t_ns=3600_000 * MS) == [0, 3]
    assert rests_at(4_000 * MS, t_ns=-3600_000 * MS) == [0, 3]
    assert rests_at(1_000 * MS + FOAM_NS) == [0]


def test_a_small_part_with_a_refused_pad_shows_its_temperature() -> None:
    """All others move together: neither noise nor a press does that."""
    bench = FaultBench(config=CONFIG.with_name("fingertips.toml"))
    calibration = bench.engine.calibration
    assert calibration is not None
    verdict = calibration.verdict.copy()
    verdict[bench.layout.parts[0].start + 4] = Verdict.TOO_NOISY
    bench.engine.use(replace(calibration, verdict=verdict))
    bench.run(8.0)
    assert "part_temperature" not in {code for code, _ in bench.told}
    bench.inject("temperature_step", value=-3.0)
    bench.run(3.0)
    assert "part_temperature" in {code for code, _ in bench.told}


def test_a_fall_of_temperature_is_named_though_the_baselines_have_followed_it() -> None:
    """They do within a second or two, and no two looks would agree on it."""
    bench = FaultBench(config=CONFIG.with_name("fingertips.toml"))
    bench.run(8.0)
    part = bench.layout.parts[0]
    watch, pipeline = bench.health._watch.parts[0], bench.engine.pipeline
    assert watch.raw is not None
    assert pipeline is not None

    def fallen() -> bool:
        watch.sample_ns += 1_000 * MS
        warmth = bench.health.record(0, bench.now_ns, {}, {})["warmth"]
        return warmth is not None and warmth["common_units"] < -COMMON_UNITS

    def fall(units: int) -> None:
        assert watch.raw is not None
        watch.raw = watch.raw + np.uint8(units)
        pipeline.baseline[part.start : part.stop] -= units

    assert not fallen()
    fall(4)
    assert [fallen() for _ in range(6)] == [False, True, True] + 3 * [False]
    bench.engine.zeros.changes += 1
    fall(4)
    # A board that was zeroed again has other baselines.
    assert not any(fallen() for _ in range(4))
    watch.touched = np.arange(part.stop - part.start) == 3
    watch.any_touched = True
    fallen()
    fall(4)
    # Pads beside a press read less.
    assert not any(fallen() for _ in range(4))


HAND = CONFIG.with_name("icub_hand.toml").read_text()
#: Two triangles without temperature pads, which their board does not compensate.
PLAIN = """
robot = "plain"
[buses.can0]
[boards.arm]
bus = "can0"
address = 14
skin_type = 1
[[parts.arm.patches]]
board = "arm"
triangles = "0"
kind = "triangle"
shift = 3
[[parts.arm.patches]]
board = "arm"
triangles = "1"
kind = "triangle"
places = [{ x_mm = 40 }]
shift = 3
"""


@pytest.mark.parametrize(
    ("text", "shifts", "warmer_c", "named"),
    [
        (HAND, (3, 3), 3.5, True),
        (HAND, (3, 3), -3.5, True),
        (HAND, (3, 3), 2.5, False),
        (HAND, (1, 1), 3.5, True),
        (HAND, (1, 1), -3.5, True),  # to the end of the scale, and beyond
        (HAND, (1, 1), 2.5, False),
        (HAND, (3, 1), 2.5, False),
        (PLAIN, (3, 3), -3.5, True),
        (PLAIN, (3, 1), -3.5, True),
        (PLAIN, (1, 1), -3.5, True),
        (PLAIN, (0, 0), -0.4, False),
    ],
)
def test_a_temperature_is_the_same_on_finer_and_on_coarser_bytes(
    tmp_path: Path, text: str, shifts: tuple[int, int], warmer_c: float, named: bool
) -> None:
    first, *others = text.split("shift = 3")
    of_patches = zip(shifts, others, strict=True)
    config = tmp_path / "robot.toml"
    config.write_text(first + "".join(f"shift = {shift}{rest}" for shift, rest in of_patches))
    bench = FaultBench(config=config)
    bench.inject("temperature_step", value=warmer_c)
    bench.run(3.0)
    assert ("part_temperature" in {code for code, _ in bench.first_told}) == named


@pytest.mark.parametrize(
    ("resting", "valid", "enough"),
    [
        (100, 200, True),
        (99, 200, False),
        (12, 24, True),
        (12, 16, True),
        (11, 16, False),
        (11, 11, True),
        (10, 11, False),
        (8, 8, True),
        (7, 7, False),
    ],
)
def test_of_a_part_half_of_the_pads_and_twelve_must_rest_or_all_of_a_small_one(
    resting: int, valid: int, enough: bool
) -> None:
    pads = np.arange(300)
    assert enough_rest(pads < resting, pads < valid) == enough


def test_nothing_is_younger_than_now() -> None:
    """Not even by a clock that was set back, nor by one of another computer."""
    assert str(_age_ms(5 * MS, 5 * MS + 1)) == "0.0"
    assert _age_ms(5 * MS, 900 * MS) == 0.0
    assert _age_ms(900 * MS, 5 * MS) == 895.0
    assert _age_ms(5 * MS, None) is None
