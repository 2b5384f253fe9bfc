"""The paper's rig: what its section VI states, on the emulated palm."""

import numpy as np
import pytest

from emulator.probes.bench import NAMED_PADS, NO_LOAD, PalmRig
from emulator.probes.experiments import Presses, deepening_presses, hold, scan
from emulator.probes.pads import Disc


@pytest.fixture(scope="module")
def presses() -> Presses:
    contacts = [(2, size) for size in (2.0, 3.0, 4.0, 5.0, 6.0)] + [(1, 3.0), (3, 3.0)]
    return deepening_presses(PalmRig(), contacts)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_maxima_of_three_pads_at_155_kpa_are_those_of_figure_11(seed: int) -> None:
    rig = PalmRig(seed)
    for name, paper_ff in ((1, 200.5), (2, 165.5), (3, 139.0)):
        x_mm, y_mm = rig.centre_mm(name)
        area = scan(rig, x_mm + np.array([-0.5, 0.0, 0.5]), np.full(3, y_mm), passes=4)
        assert np.nanmax(area.s_ff[:, NAMED_PADS[name]]) == pytest.approx(paper_ff, rel=0.03)


def test_a_pad_answers_in_a_bell_without_crosstalk() -> None:
    rig = PalmRig()
    x_mm, y_mm = rig.centre_mm(2)
    along_mm = np.arange(-6.0, 6.01, 0.5)
    line = scan(rig, x_mm + along_mm, np.full(len(along_mm), y_mm), passes=3)
    response = line.s_ff[:, NAMED_PADS[2]]
    assert np.abs(along_mm[np.nanargmax(response)]) <= 0.5
    assert np.nanmax(response[np.abs(along_mm) > 3.7]) < 1.0
    half_way = response[np.abs(np.abs(along_mm) - 2.5) < 0.01]
    assert (half_way > 0.2 * np.nanmax(response)).all()


@pytest.mark.parametrize(
    ("size", "low", "high"),
    [(5.0, 0.97, 1.03), (4.0, 0.86, 0.95), (3.0, 0.45, 0.55), (2.0, 0.2, 0.25)],
)
def test_smaller_probes_are_felt_less_as_in_figure_13(
    presses: Presses, size: float, low: float, high: float
) -> None:
    assert low < presses.at(2, size, 155.0) / presses.at(2, 6.0, 155.0) < high


def test_pads_differ_at_high_pressure_and_agree_at_low_as_in_figure_14(presses: Presses) -> None:
    for pressure_kpa, low, high in ((30.0, 0.95, 1.1), (155.0, 1.35, 1.5)):
        ratio = presses.at(1, 3.0, pressure_kpa) / presses.at(3, 3.0, pressure_kpa)
        assert low < ratio < high


def test_the_first_presses_follow_equation_1_below_130_kpa() -> None:
    first = deepening_presses(PalmRig(), [(2, 6.0)], cycles=1)
    pressure, s_ff, _ = first.curve(2, 6.0)
    below = pressure < 130
    c_kpa = -0.001132 * s_ff**2 + 0.8141 * s_ff
    error = (c_kpa - pressure)[below]
    assert np.sqrt(np.mean(error**2)) < 2.0


def test_five_kpa_are_told_apart_in_a_second(presses: Presses) -> None:
    _, _, sd_ff = presses.curve(2, 6.0)
    step_ff = presses.at(2, 6.0, 20.0) - presses.at(2, 6.0, 15.0)
    assert step_ff > 3 * np.median(sd_ff) / 5


def test_a_held_probe_feels_the_foam_give_way_while_the_reading_stays() -> None:
    held = hold(PalmRig(), [(1.05, 600.0), (0.0, 300.0)])
    start, end = held.t_s.searchsorted([2.0, 599.0])
    assert held.pressure_kpa[end] < 0.85 * held.pressure_kpa[start]
    assert held.s_ff[end] == pytest.approx(held.s_ff[start], abs=15)
    # After the release the load cell is free and the foam keeps an imprint for a while.
    after = held.t_s.searchsorted(602.0)
    assert held.pressure_kpa[after] == pytest.approx(0.0, abs=1.0)
    assert held.s_ff[after] > 5.0
    assert held.s_ff[-1] < held.s_ff[after]


def test_the_whole_palm_is_read_and_only_pads_under_the_probe_answer() -> None:
    held = hold(PalmRig(), [(1.05, 20.0)])
    assert held.palm.shape == (500, 48)
    moved = np.flatnonzero(np.abs(np.median(held.palm[100:], axis=0) - NO_LOAD) > 3)
    assert moved.tolist() == [NAMED_PADS[2]]


def test_a_probe_between_the_pads_is_borne_by_the_foam_and_not_felt() -> None:
    rig = PalmRig()
    x_mm, y_mm = rig.centre_mm(2)
    t_s = np.arange(0.0, 1.0, 0.04)
    motion = rig.follow([Disc(x_mm + 2.5, y_mm - 8.0, 0.5)], t_s, 1.0 * t_s)
    assert motion.force_n[-1, 0] > 0
    assert len(motion.pad) == 0


def test_the_same_seed_gives_the_same_recording() -> None:
    one, two, other = (hold(PalmRig(seed), [(0.8, 5.0)]) for seed in (1, 1, 2))
    assert (one.palm == two.palm).all()
    assert (one.palm != other.palm).any()
