"""Pads whose chip was not read while the skin became warmer feel what touches them then."""

from pathlib import Path

import numpy as np
import pytest

from emulator.probes.scene import Place, Probe, Scene, Temperature
from tests.support.fault_bench import FaultBench

#: Each finger is a part of one triangle: no other pad of the part shows what it drifts by.
GRIPPER = Path(__file__).parents[2] / "config" / "gripper.toml"
CALIBRATED_S = 12.0
UNREAD_S = 240.0
PART = "left_finger"


def unread(
    warmer_c: float,
    *,
    config: Path = GRIPPER,
    unread_s: float = UNREAD_S,
    probe: list[Probe] | None = None,
) -> FaultBench:
    """A robot one of whose chips was not read for some time, in which it became warmer."""
    course_c = [(CALIBRATED_S, 25.0), (CALIBRATED_S + unread_s, 25.0 + warmer_c)]
    scene = Scene(temperature=Temperature(keyframes_c=course_c), probe=probe or [])
    bench = FaultBench(scene=scene, config=config)
    mend = bench.inject("chip_gone", board="palm", triangle=0)
    bench.run(unread_s, look_every=20)
    assert not bench.valid[PART].any()
    mend()
    return bench


def press(diameter_mm: float, start_s: float) -> Probe:
    """A probe that presses the finger from then on."""
    return Probe(
        part=PART,
        at=Place(triangle=0),
        diameter_mm=diameter_mm,
        force_n=[(0.0, 0.0), (1.0, 2.0), (1000.0, 2.0)],
        start_s=start_s,
    )


@pytest.mark.parametrize("warmer_c", [-4.0, 1.5, 2.0])
def test_what_drifted_while_a_chip_was_not_read_is_no_touch(warmer_c: float) -> None:
    """All pads would be touched, and stay it, because a touch hides drift."""
    bench = unread(warmer_c)
    touched = bench.touched_meanwhile(PART, 10.0)
    assert max(touched) == 0
    assert np.count_nonzero(bench.valid[PART]) == 12


def test_a_plug_whose_contact_flickers_as_it_comes_back_is_compared_all_the_same() -> None:
    bench = unread(2.0)
    for _ in range(5):
        bench.run(0.15)
        mend = bench.inject("chip_gone", board="palm", triangle=0)
        bench.run(0.5)
        assert not bench.valid[PART].any()
        mend()
    bench.run(5.0)
    assert np.count_nonzero(bench.valid[PART]) == 12
    assert not bench.touched[PART].any()


def test_what_came_on_some_pads_meanwhile_is_a_touch_of_these() -> None:
    bench = unread(1.5, probe=[press(4, CALIBRATED_S + UNREAD_S / 2)])
    bench.run(2.0)
    pressed = bench.robot.true_pressure_kpa(PART) > 20.0
    assert pressed.any()
    assert bench.touched[PART][pressed].all()


def test_pads_of_other_chips_are_read_as_before_meanwhile() -> None:
    bench = unread(2.0)
    for _ in range(20):
        bench.run(0.05)
        assert bench.valid["right_finger"].all()


def test_a_chip_that_comes_back_soon_is_read_at_once() -> None:
    bench = unread(0.5, unread_s=20.0)
    bench.run(0.3)
    assert bench.valid[PART].all()


def test_a_calibration_without_a_chip_does_not_show_what_its_pads_drifted_by() -> None:
    """They go on as before, so that they are touched if that is not noticed."""
    course_c = [(CALIBRATED_S, 25.0), (CALIBRATED_S + UNREAD_S, 27.0)]
    scene = Scene(temperature=Temperature(keyframes_c=course_c))
    bench = FaultBench(scene=scene, config=GRIPPER)
    mend = bench.inject("chip_gone", board="palm", triangle=0)
    bench.run(UNREAD_S - 20.0, look_every=20)
    bench.calibrate(5.0)
    bench.run(14.7)
    mend()
    assert max(bench.touched_meanwhile(PART, 10.0)) == 0
    assert np.count_nonzero(bench.valid[PART]) == 12


def test_a_calibration_without_a_chip_does_not_show_that_its_pads_are_released() -> None:
    """A restart of the board would hide the press for as long as it lasts."""
    scene = Scene(quiet=True, probe=[press(6, CALIBRATED_S)])
    bench = FaultBench(scene=scene, config=GRIPPER)
    bench.run(5.0)
    touched = bench.touched[PART]
    assert touched.any()
    mend = bench.inject("chip_gone", board="palm", triangle=0)
    bench.calibrate(5.0)
    mend()
    bench.engine.zeros.rezero(0)
    bench.robot.bring_up()
    bench.run(5.0)
    assert not bench.valid[PART][touched].any()
    bench.calibrate(5.0)
    bench.run(1.0)
    assert ("taxel_pressed", PART) in bench.told


def test_pads_of_a_chip_that_does_not_answer_are_not_compared_with_far_presses() -> None:
    """A chip may be gone for years: each sweep would take three times as long."""
    bench = FaultBench(config=GRIPPER, settle_s=0.5)
    bench.inject("chip_gone", board="palm", triangle=0)
    bench.run(1.0)
    assert not bench.engine.intake.far_presses.watches(0)
