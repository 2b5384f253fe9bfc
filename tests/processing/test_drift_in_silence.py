"""A board that was away while the skin became warmer or colder feels what touches it then."""

from pathlib import Path

import numpy as np
import pytest

from emulator.probes.scene import Air, Place, Probe, Scene, Temperature
from tests.support.fault_bench import FaultBench

CONFIGS = Path(__file__).parents[2] / "config"
HAND, ROBOT = CONFIGS / "icub_hand.toml", CONFIGS / "demo.toml"
CALIBRATED_S = 12.0
SILENT_S = 240.0
PART = "left_hand"


def away(
    warmer_c: float,
    *,
    before_c: float = 0.0,
    probe: list[Probe] | None = None,
    air: list[Air] | None = None,
    config: Path = HAND,
    board: str = PART,
) -> FaultBench:
    """A hand that was not received for some minutes, in which it became warmer.

    It became warmer by `before_c` in as long a time before, which its zeros followed.
    """
    lost_s = CALIBRATED_S + SILENT_S * (before_c != 0.0)
    warm_c = 25.0 + before_c
    course_c = [(CALIBRATED_S, 25.0), (lost_s, warm_c), (lost_s + SILENT_S, warm_c + warmer_c)]
    scene = Scene(
        temperature=Temperature(keyframes_c=sorted(set(course_c))), probe=probe or [], air=air or []
    )
    bench = FaultBench(scene=scene, config=config)
    bench.run(lost_s - CALIBRATED_S, look_every=20)
    mend = bench.inject("board_silent", board=board)
    bench.run(SILENT_S, look_every=20)
    mend()
    return bench


@pytest.mark.parametrize(
    ("before_c", "warmer_c"),
    [(0.0, -4.0), (0.0, -1.5), (0.0, 1.5), (0.0, 4.0), (-3.0, 2.0), (3.0, -2.0)],
)
def test_what_drifted_while_a_board_was_away_is_no_touch(before_c: float, warmer_c: float) -> None:
    """Most pads would be touched, and stay it, because a touch hides drift."""
    bench = away(warmer_c, before_c=before_c)
    touched = bench.touched_meanwhile(PART, 10.0)
    assert max(touched) <= 1
    assert touched[-1] == 0
    assert np.count_nonzero(bench.valid[PART]) > 90


@pytest.mark.parametrize(
    ("fault", "silent_s"), [("board_silent", 60.0), ("board_silent", 600.0), ("chip_gone", 60.0)]
)
def test_a_part_that_was_released_while_it_was_away_rests_as_before(
    fault: str, silent_s: float
) -> None:
    """Its foam recovers meanwhile. As if it were still pressed, the model took 10 kPa too much off
    what it read afterwards: the zeros fell by 3 units, then all pads seemed to come back.
    """
    part, kpa = "left_finger", [(0.0, 0.0), (0.5, 50.0), (10.5, 50.0), (11.5, 0.0)]
    air = [Air(part=part, pressure_kpa=kpa, start_s=CALIBRATED_S)]
    bench = FaultBench(scene=Scene(air=air), config=CONFIGS / "gripper.toml")
    bench.run(8.0)
    assert bench.touched[part].all()
    triangle = {"triangle": 0} if fault == "chip_gone" else {}
    mend = bench.inject(fault, board="palm", **triangle)
    bench.run(silent_s, look_every=20)
    mend()
    bench.run(25.0)
    assert bench.valid[part].all()
    assert not bench.touched[part].any()


@pytest.mark.parametrize("shift", [0, 1])
def test_what_drifted_in_fine_units_is_no_touch_nor_a_zero(shift: int, tmp_path: Path) -> None:
    """The same warmth is four or eight times as many units as at the hand's usual shift of 3."""
    fine = tmp_path / "fine.toml"
    fine.write_text(HAND.read_text().replace("shift = 3", f"shift = {shift}"))
    bench = away(4.0, config=fine)
    assert max(bench.touched_meanwhile(PART, 10.0)) == 0
    assert np.count_nonzero(bench.valid[PART]) > 90
    assert ("board_rezeroed", PART) not in bench.told


def test_what_came_on_some_pads_meanwhile_is_a_touch_of_these() -> None:
    press = Probe(
        part=PART,
        at=Place(triangle=4),
        diameter_mm=9,
        force_n=[(0.0, 0.0), (1.0, 4.0), (1000.0, 4.0)],
        start_s=CALIBRATED_S + SILENT_S / 2,
    )
    bench = away(2.0, probe=[press])
    bench.run(2.0)
    pressed = bench.robot.true_pressure_kpa(PART) > 20.0
    assert np.count_nonzero(pressed) >= 2
    np.testing.assert_array_equal(bench.touched[PART], pressed & bench.valid[PART])


def test_what_came_on_all_pads_while_it_became_no_warmer_is_no_drift() -> None:
    """All pads read what a few degrees make, but for temperature pads."""
    course = [(0.0, 0.0), (60.0, 6.0), (1000.0, 6.0)]
    air = [Air(part=PART, pressure_kpa=course, start_s=CALIBRATED_S + SILENT_S)]
    bench = away(0.0, before_c=3.0, air=air, config=ROBOT, board="hand")
    bench.run(2.0)
    reported_untouched = bench.valid[PART] & ~bench.touched[PART]
    assert np.count_nonzero(reported_untouched) < 50


def test_a_board_that_is_set_up_in_vain_goes_on_by_a_calibration_of_the_others() -> None:
    """Nothing is known of its pads but what was before; its new zero shows when it is back."""
    bench = FaultBench(config=ROBOT)
    mend = bench.inject("board_silent", board="hand")
    bench.run(5.0)
    bench.engine.zeros.rezero(0)
    bench.calibrate(5.0)
    mend()
    bench.engine.zeros.rezero(0)
    bench.robot.bring_up()
    bench.run(0.5)
    assert not bench.valid[PART].any()
    assert max(bench.touched_meanwhile(PART, 10.0)) == 0
    assert np.count_nonzero(bench.valid[PART]) > 90
