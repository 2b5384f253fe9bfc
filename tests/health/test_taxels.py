"""Zeros of taxels that go astray over minutes are told, with what to do about them."""

from dataclasses import replace

import numpy as np
import pytest

from emulator.probes.scene import Air, Fault, Place, Probe, Scene
from skin_host.bus.compensation import thermal_gains
from skin_host.health.describe import Describer
from skin_host.health.diagnosis import diagnose
from skin_host.layout import PadKind
from skin_host.processing.calibration import Verdict, with_gains
from tests.support.fault_bench import CONFIG, FaultBench


def pressing(diameter_mm: float, start_s: float, *pressure_kpa: tuple[float, float]) -> Scene:
    """Something presses the forearm by so much, kPa, from so long after its start on."""
    probe = Probe(
        "left_forearm",
        Place(taxel=27),
        diameter_mm=diameter_mm,
        pressure_kpa=[*pressure_kpa],
        start_s=start_s,
    )
    return Scene(spread=False, probe=[probe])


def codes(bench: FaultBench, part: str) -> set[str]:
    return {fault["code"] for fault in bench.records[part]["faults"]}


@pytest.fixture
def close_limit(bench: FaultBench) -> FaultBench:
    """A robot whose baselines may move by two units only."""
    bench.reload({"processing.drift.limit_units": 2.0})
    bench.run(2.0)
    return bench


def test_a_zero_that_drifts_is_told_and_told_again_when_it_can_follow_no_farther(
    close_limit: FaultBench,
) -> None:
    bench = close_limit
    assert not codes(bench, "left_hand") & {"taxel_drifting", "taxel_at_limit"}
    # In steps: what a large one touches is followed slowly.
    for more_c in (1.0, 2.0, 3.0):
        bench.robot.inject(Fault(name="temperature_step", value=more_c))
        bench.run(8.0)
    for _ in range(60):
        bench.run(1.0)
        if "taxel_at_limit" in codes(bench, "left_hand"):
            break
    first = {code: since_s for (code, part), since_s in bench.first_told.items()}
    assert first["taxel_drifting"] < first["taxel_at_limit"]
    record = bench.records["left_hand"]
    assert set(record["baseline_at_limit"]) <= set(record["taxel_faults"]["drifting"])
    (says,) = (line for line in record["sentences"] if "cannot follow any farther" in line)
    assert "calibrate" in says


def test_a_touch_that_never_ends_hides_a_zero_and_that_is_told() -> None:
    bench = FaultBench(scene=pressing(3.0, 12.0, (0.0, 0.0), (0.2, 100.0), (600.0, 100.0)))
    bench.reload({"processing.drift.frozen_report_s": 4.0})
    while bench.t_s < 14.0:
        bench.run(0.5)
    assert "taxel_held" not in codes(bench, "left_forearm")
    bench.run(4.0)
    assert "taxel_held" in codes(bench, "left_forearm")
    assert 27 in bench.records["left_forearm"]["baseline_frozen"]
    # It is touched all the same, and believed.
    assert bench.touched["left_forearm"][27]
    assert bench.valid["left_forearm"][27]


def test_what_a_load_of_the_calibration_presses_again_is_in_doubt_until_it_is_lifted() -> None:
    """The zero followed when it was lifted. What reads as high as before may be that load, or a pad
    that was pulled and is free: the first time no reading shows which.
    """
    # 60 kPa for 30 s, and twice for 15 s, with pauses of 15 s.
    holds_s = ((0.0, 30.0), (45.0, 60.0), (75.0, 90.0))
    course = [
        point
        for begin_s, end_s in holds_s
        for point in ((begin_s, 0.0), (begin_s + 0.2, 60.0), (end_s, 60.0), (end_s + 0.2, 0.0))
    ]
    bench = FaultBench(3.0, scene=pressing(12.0, 7.0, *course), settle_s=3.0)
    pressed = np.flatnonzero(_after(bench, 15.0).touched["left_forearm"])
    assert len(pressed) == 7
    bench.calibrate(3.0)
    assert not _after(bench, 45.0).touched["left_forearm"].any()
    assert "taxel_returned" not in codes(bench, "left_forearm")

    _after(bench, 66.0)
    assert not bench.valid["left_forearm"][pressed].any()
    record = bench.records["left_forearm"]
    assert record["state"] == "degraded"
    assert record["taxel_faults"]["returned"] == pressed.tolist()
    (sentence,) = (line for line in record["sentences"] if "was before it fell" in line)
    assert "skin command calibrate" in sentence

    _after(bench, 81.0)
    assert "taxel_returned" not in codes(bench, "left_forearm")
    assert bench.valid["left_forearm"][pressed].all()
    assert np.array_equal(np.flatnonzero(_after(bench, 96.0).touched["left_forearm"]), pressed)


def _after(bench: FaultBench, t_s: float) -> FaultBench:
    """The same, at this time."""
    bench.run(t_s - bench.t_s)
    return bench


def test_taxels_that_rest_at_the_end_of_the_scale_as_they_were_pressed_are_to_be_set_up_again(
    bench: FaultBench,
) -> None:
    """A lower threshold, which mends others, would not let them feel anything."""
    calibration = bench.engine.calibration
    assert calibration is not None
    part = bench.layout.part("left_hand")
    baseline, verdict = calibration.baseline.copy(), calibration.verdict.copy()
    percentile = calibration.percentile.copy()
    baseline[part.start + 3] = percentile[part.start + 3] = 239.0
    verdict[part.start + 3] = Verdict.TOUCHED
    pressed = replace(calibration, baseline=baseline, percentile=percentile, verdict=verdict)
    bench.engine.use(pressed)
    bench.run(0.5)
    record = bench.records["left_hand"]
    assert record["taxel_verdicts"]["unreached"] == [3]
    (sentence,) = (line for line in record["sentences"] if "no press would be felt" in line)
    assert "set the boards up again" in sentence
    assert "margin_units" not in sentence


def test_taxels_that_no_press_reaches_are_named_with_the_reason_and_what_mends_it(
    bench: FaultBench,
) -> None:
    def sentence() -> str:
        bench.run(0.5)
        faults = bench.records["left_hand"]["faults"]
        (at,) = [n for n, fault in enumerate(faults) if fault["code"] == "taxel_unreached"]
        return bench.records["left_hand"]["sentences"][at]

    calibration = bench.engine.calibration
    assert calibration is not None
    part = bench.layout.part("left_hand")
    flat = [part.start + 3, part.start + 5]
    bend = calibration.bend.copy()
    bend[flat] = 1e4
    bench.engine.use(with_gains(calibration, calibration.gain, bend))
    said = sentence()
    assert said.startswith("taxels 3, 5 of left_hand: not valid: ")
    for words in ("gain and bend", "processing.pressure", "skin calibrate --pressure"):
        assert words in said
    assert "margin_units" not in said
    assert bench.records["left_hand"]["taxel_verdicts"]["flat"] == [3, 5]

    bench.reload({"processing.touch.margin_units": 240.0})
    said = sentence()
    assert "; of taxels 3, 5 the curve" in said and "skin calibrate --pressure" in said
    assert "margin_units" in said and "skin command thresholds" in said

    bench.engine.use(calibration)
    said = sentence()
    assert "skin command thresholds" in said and "curve" not in said


def test_a_part_that_is_degraded_always_says_why(bench: FaultBench) -> None:
    bench.run(1.0)
    record = bench.records["left_hand"]
    # A pad that failed under pressure: no board, triangle or taxel fault tells of it.
    without = diagnose({**record, "state": "degraded", "invalid": [7], "faults": []})
    (fault,) = (fault for fault in without if fault.code == "taxel_unproven")
    assert fault.sentence.startswith("taxel 7 of left_hand: not valid")
    bench.inject("chip_gone", board="hand", triangle=2)
    bench.run(2.0)
    codes_now = codes(bench, "left_hand")
    assert bench.records["left_hand"]["state"] == "degraded"
    assert "taxel_unproven" not in codes_now
    assert codes_now


def test_a_press_on_the_whole_part_is_no_change_of_its_temperature() -> None:
    air = Air(part="left_hand", pressure_kpa=[(0, 0), (9, 0), (10, 40), (60, 40)])
    bench = FaultBench(2.0, Scene(quiet=True, air=[air]), settle_s=3.0)
    bench.run(9.0)
    assert bench.touched["left_hand"].sum() > 60
    assert "part_temperature" not in codes(bench, "left_hand")


def test_an_even_load_that_only_noisy_pads_do_not_feel_is_no_change_of_temperature() -> None:
    air = Air(part="left_lower_arm", pressure_kpa=[(0, 0), (15, 0), (15.1, 8), (60, 8)])
    scene = Scene(quiet=False, seed=1, air=[air])
    bench = FaultBench(5.0, scene, config=CONFIG.with_name("nao.toml"), settle_s=9.0)
    bench.run(4.0)
    assert bench.touched["left_lower_arm"].sum() > 180
    assert "part_temperature" not in {code for code, _ in bench.first_told}


def test_a_temperature_that_one_sweep_shows_is_none(bench: FaultBench) -> None:
    """What a chip sends that has just stopped answering may look like one. A board that is being
    set up sends nothing, however often health looks.
    """
    bench.run(1.0)
    part = next(i for i, one in enumerate(bench.layout.parts) if one.name == "left_hand")
    layout = bench.layout.parts[part]
    thermal = bench.layout.pad_kind[layout.start : layout.stop] == PadKind.THERMAL
    watch = bench.health._watch.parts[part]
    assert watch.raw is not None

    def look(shift_units: int, later_ns: int = 50_000_000) -> set[str]:
        watch.raw = np.where(thermal, raw - shift_units, raw)
        watch.sample_ns += later_ns
        return {
            fault["code"] for fault in bench.health.record(part, bench.now_ns, {}, {})["faults"]
        }

    raw = watch.raw.astype(np.int64)
    assert "part_temperature" not in look(0)
    assert "part_temperature" not in look(12)
    assert "part_temperature" not in look(0)
    assert "part_temperature" not in look(12)
    assert "part_temperature" not in look(12, later_ns=0)
    assert "part_temperature" in look(12)
    assert "part_temperature" in look(12, later_ns=0)
    # A configuration that is read again, or a command, makes a new one.
    bench.health._describer = Describer(bench.engine, bench.health._watch)
    bench.health._held.clear()
    assert "part_temperature" not in look(12)
    assert "part_temperature" in look(12)


def test_a_temperature_pad_that_is_stuck_is_named(bench: FaultBench) -> None:
    layout = bench.layout
    index = int(np.flatnonzero(layout.pad_kind == PadKind.THERMAL)[0])
    triangle = layout.triangles[int(layout.triangle_of[index])]
    board = layout.boards[triangle.board]
    (taxel,) = np.flatnonzero(board.taxel_index[triangle.number] == index).tolist()
    bench.inject("stuck_taxel", board=board.name, triangle=triangle.number, taxel=taxel)
    bench.run(10.0)
    part = layout.parts[triangle.part]
    assert bench.records[part.name]["taxel_faults"] == {"stuck": [index - part.start]}
    assert "taxel_stuck" in codes(bench, part.name)


def test_a_noisy_temperature_pad_makes_the_pads_invalid_that_its_board_takes_it_off(
    bench: FaultBench,
) -> None:
    layout = bench.layout
    triangle = next(
        one
        for one in layout.triangles
        if any(thermal_gains(layout.boards[one.board].settings.skin_type, one.number)[0])
    )
    board, part = layout.boards[triangle.board], layout.parts[triangle.part]
    gain, thermal = thermal_gains(board.settings.skin_type, triangle.number)
    first = triangle.first - part.start
    where = {"board": board.name, "triangle": triangle.number, "taxel": thermal}
    mend = bench.inject("noisy_taxel", **where)
    bench.run(4.0)
    depend = [first + taxel for taxel in range(12) if gain[taxel]]
    assert first + thermal in bench.records[part.name]["taxel_faults"]["noisy"]
    assert bench.records[part.name]["invalid"] == depend
    assert codes(bench, part.name) == {"taxel_noisy"}
    mend()
    bench.run(8.0)
    assert not bench.records[part.name]["invalid"]
