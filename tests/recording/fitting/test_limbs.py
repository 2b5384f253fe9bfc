"""A robot of several limbs is fitted limb by limb: one bag of air is not as large as a robot."""

import json
from pathlib import Path

import numpy as np
import pytest

from skin_host.config.settings import load
from skin_host.daemon.calibrate import calibration_path
from skin_host.processing.calibration import (
    Calibration,
    Verdict,
    Zero,
    identified,
    with_curves,
    with_zeros,
)
from skin_host.processing.curves import CurveVerdict, Memory
from tests.support.limbs import (
    ARM,
    BOARDS,
    HZ,
    LEG,
    PADS,
    calibrate,
    keep,
    pressed,
    ramp,
    staircase,
    stored,
    with_levels,
    write_config,
    write_log,
)


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    return write_config(tmp_path)


@pytest.fixture
def kept(bench: Path) -> Path:
    """Where the calibration is kept."""
    return calibration_path(load(bench), "main")


def equal(found: Calibration, before: Calibration, limb: slice) -> bool:
    """Whether nothing that is known of a limb has changed."""
    names = "baseline", "percentile", "noise", "spread", "gain", "bend", "verdict"
    same = all(np.array_equal(getattr(found, n)[limb], getattr(before, n)[limb]) for n in names)
    if found.curves is None or before.curves is None:
        return same and found.curves is before.curves
    mine, its = found.curves.arrays(), before.curves.arrays()
    return same and all(np.array_equal(mine[n][limb], its[n][limb], equal_nan=True) for n in mine)


def test_each_limb_has_its_curves_when_one_was_pressed_after_the_other(
    bench: Path, kept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    arm = write_log(bench.with_name("arm.log"), pressed(units, ARM))
    leg = write_log(bench.with_name("leg.log"), pressed(units, LEG), seed=4)
    assert calibrate(bench, arm, table) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"warning: taxels 0-23 of leg: not pressed in {arm}; they have neither gains nor curves of "
        "their own"
    )
    first = stored(bench, kept)
    assert first.curves is not None
    assert (
        first.curves.verdict.tolist() == [CurveVerdict.GOOD] * PADS + [CurveVerdict.UNKNOWN] * PADS
    )
    assert calibrate(bench, leg, table, "--json") == 0
    answer = capsys.readouterr()
    (line,) = answer.err.splitlines()
    assert line == (
        f"warning: taxels 0-23 of arm: not pressed in {leg}; they keep zero, gains and curves of "
        f"{kept}"
    )
    document = json.loads(answer.out)
    assert document["kept"] == {"arm": list(range(PADS))}
    assert document["counts"]["good"] == PADS
    both = stored(bench, kept)
    assert both.curves is not None
    assert both.usable.all()
    assert (both.curves.verdict == CurveVerdict.GOOD).all()
    assert equal(both, first, ARM)
    assert both.id == document["id"] != first.id


@pytest.mark.parametrize("boards", [BOARDS, BOARDS[:1]])
def test_a_limb_that_was_not_pressed_or_not_recorded_keeps_everything(
    bench: Path, kept: Path, capsys: pytest.CaptureFixture[str], boards: tuple[int, ...]
) -> None:
    units, table = ramp(bench)
    both = write_log(bench.with_name("both.log"), units)
    assert calibrate(bench, both, table) == 0
    thumb = {"thumb": Zero(np.arange(6.0), np.ones(6))}
    keep(bench, kept, with_zeros(stored(bench, kept), thumb))
    before = stored(bench, kept)
    arm = write_log(bench.with_name("arm.log"), pressed(0.9 * units, ARM), boards, seed=5)
    capsys.readouterr()
    assert calibrate(bench, arm, table) == 0
    (line,) = capsys.readouterr().err.splitlines()
    why = "not pressed in" if boards == BOARDS else "not in"
    assert line.startswith(f"warning: taxels 0-23 of leg: {why} {arm}; they keep zero, gains")
    found = stored(bench, kept)
    assert equal(found, before, LEG)
    assert not equal(found, before, ARM)
    assert found.usable.all()
    assert found.zeros["thumb"].offset.tolist() == before.zeros["thumb"].offset.tolist()


def test_what_keeps_its_curves_keeps_the_hysteresis_of_the_foam_with_them(
    bench: Path, kept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = f"hysteresis of the foam: 0.10 within 12 kPa, kept from {kept} with curves"
    units, table = ramp(bench)
    assert calibrate(bench, write_log(bench.with_name("both.log"), units), table) == 0
    before = stored(bench, kept)
    assert before.curves is not None
    foam = Memory((12.0,), (0.1,))
    other = with_curves(before, type(before.curves)(**vars(before.curves) | {"memory": foam}))
    keep(bench, kept, other)
    arm = write_log(bench.with_name("arm.log"), pressed(units, ARM))
    capsys.readouterr()
    assert calibrate(bench, arm, table) == 0
    assert said in capsys.readouterr().out
    found = stored(bench, kept).curves
    assert found is not None
    assert found.memory == foam
    # With all limbs in one recording nothing is kept.
    assert calibrate(bench, bench.with_name("both.log"), table) == 0
    assert "kept from" not in capsys.readouterr().out
    found = stored(bench, kept).curves
    assert found is not None
    assert found.memory != foam


def test_a_hysteresis_that_was_not_known_is_not_kept_as_none(
    bench: Path, kept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units, table = ramp(bench)
    rising = units[: round(48.0 * HZ)]
    assert calibrate(bench, write_log(bench.with_name("both.log"), rising), table) == 0
    arm = write_log(bench.with_name("arm.log"), pressed(rising, ARM))
    capsys.readouterr()
    assert calibrate(bench, arm, table) == 0
    answer = capsys.readouterr()
    assert f"hysteresis of the foam: not known, kept from {kept} with curves" in answer.out
    assert "expected error of the good while loading" in answer.out
    assert "pressures that go down read too high" in answer.err


def test_pads_of_a_pressed_board_that_do_not_move_are_dead(bench: Path, kept: Path) -> None:
    units, table = ramp(bench)
    assert calibrate(bench, write_log(bench.with_name("both.log"), units), table) == 0
    units = pressed(units, ARM)
    units[:, 5] = 0.0
    assert calibrate(bench, write_log(bench.with_name("arm.log"), units), table) == 0
    curves = stored(bench, kept).curves
    assert curves is not None
    assert np.flatnonzero(curves.verdict == CurveVerdict.DEAD).tolist() == [5]


def test_levels_on_one_limb_leave_the_gains_and_curves_of_others(
    bench: Path, kept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gain = np.random.default_rng(5).uniform(0.7, 1.4, 2 * PADS)
    units = staircase(gain)
    assert with_levels(bench, write_log(bench.with_name("both.log"), units)) == 0
    before = stored(bench, kept)
    keep(bench, kept, with_zeros(before, {"thumb": Zero(np.arange(6.0), np.ones(6))}))
    arm = write_log(bench.with_name("arm.log"), pressed(units, ARM), seed=6)
    capsys.readouterr()
    assert with_levels(bench, arm, "--json") == 0
    answer = capsys.readouterr()
    assert answer.err.startswith(f"warning: taxels 0-23 of leg: not pressed in {arm}; they keep")
    assert json.loads(answer.out)["not_fitted"] == 0
    found = stored(bench, kept)
    assert equal(found, before, LEG)
    assert found.gain[ARM] == pytest.approx(gain[ARM], rel=0.15)
    assert list(found.zeros) == ["thumb"]
    # Curves of the limb that has gains now are gone, those of the other stay.
    air, table = ramp(bench)
    assert calibrate(bench, write_log(bench.with_name("air.log"), air), table) == 0
    assert with_levels(bench, arm) == 0
    curves = stored(bench, kept).curves
    assert curves is not None
    assert (curves.verdict[ARM] == CurveVerdict.UNKNOWN).all()
    assert (curves.verdict[LEG] == CurveVerdict.GOOD).all()
    assert with_levels(bench, bench.with_name("both.log")) == 0
    assert stored(bench, kept).curves is None


def test_one_limb_of_many_is_enough_for_levels(bench: Path, kept: Path) -> None:
    """The median over the whole skin would be that of the limbs that are not pressed."""
    units = pressed(staircase(np.ones(2 * PADS)), slice(0, 20))
    assert with_levels(bench, write_log(bench.with_name("arm.log"), units)) == 0
    assert stored(bench, kept).gain[:20] == pytest.approx(np.ones(20), rel=0.15)


def test_a_pad_that_was_stuck_keeps_that_until_it_is_pressed(bench: Path, kept: Path) -> None:
    units, table = ramp(bench)
    both = write_log(bench.with_name("both.log"), units)
    assert calibrate(bench, both, table) == 0
    verdict = stored(bench, kept).verdict.copy()
    verdict[[2, PADS + 2]] = Verdict.STUCK
    before = stored(bench, kept)
    keep(bench, kept, identified(type(before)(**vars(before) | {"verdict": verdict})))
    arm = write_log(bench.with_name("arm.log"), pressed(units, ARM))
    assert calibrate(bench, arm, table) == 0
    found = stored(bench, kept).verdict
    assert (found[2], found[PADS + 2]) == (Verdict.OK, Verdict.STUCK)
