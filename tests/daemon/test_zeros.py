"""What is kept of the zeros of an engine is what the next one goes on from."""

import msgspec
import numpy as np
import pytest

from skin_host.daemon.state import Zeros, taxels_of
from skin_host.daemon.zeros import go_on_from, zeros_of
from skin_host.layout import parts_of
from skin_host.processing.core import Engine
from tests.support.fault_bench import FaultBench


def new_engine(bench: FaultBench) -> Engine:
    before = bench.engine
    return Engine(
        before.settings, before.layout, parts_of(before.layout, "main"), before.calibration
    )


@pytest.fixture
def kept(calibrated: FaultBench) -> Zeros:
    found, layout = calibrated.engine.calibration, calibrated.engine.layout
    assert found is not None
    return Zeros(
        calibration=found.id,
        unknown={"left_hand": [1, 4]},
        touched={"left_forearm": [2]},
        stuck={"left_forearm": [3]},
        baselines={part.name: [1.25] * part.n_taxels for part in layout.parts},
        written="2026-01-01T00:00:00+00:00",
        robot="demo",
        parts=["left_hand", "left_forearm"],
    )


def test_a_restart_changes_nothing_of_it(calibrated: FaultBench, kept: Zeros) -> None:
    engine = new_engine(calibrated)
    lasting = taxels_of(engine.layout, kept.touched)
    doubted = go_on_from(kept, engine)
    assert (doubted == lasting | taxels_of(engine.layout, kept.unknown)).all()
    assert zeros_of(engine, kept, lasting) == kept


def test_at_the_end_what_is_touched_is_not_known(calibrated: FaultBench, kept: Zeros) -> None:
    engine = new_engine(calibrated)
    go_on_from(kept, engine)
    nothing = np.zeros(engine.layout.n_taxels, np.bool_)
    found = zeros_of(engine, kept, nothing, ends=True)
    assert found.unknown == {"left_hand": [1, 4], "left_forearm": [2]}
    assert msgspec.structs.replace(found, unknown=kept.unknown) == kept


def test_the_baselines_of_another_calibration_are_not_kept(
    calibrated: FaultBench, kept: Zeros
) -> None:
    engine = new_engine(calibrated)
    pipeline = engine.pipeline
    assert pipeline is not None
    near = {
        part.name: (pipeline.baseline[part.start : part.stop] + 0.25).tolist()
        for part in engine.layout.parts
    }
    kept = msgspec.structs.replace(kept, baselines=near)
    other = msgspec.structs.replace(kept, calibration="another")
    nothing = np.zeros(engine.layout.n_taxels, np.bool_)
    for before, is_new in ((kept, False), (other, True)):
        found = zeros_of(engine, before, nothing)
        wanted = np.round(pipeline.baseline, 2) if is_new else pipeline.baseline + 0.25
        assert np.concatenate([found.baselines[one.name] for one in engine.layout.parts]) == (
            pytest.approx(wanted)
        )
    assert zeros_of(engine, Zeros(), nothing).baselines == {}
    assert zeros_of(engine, Zeros(), nothing, found=True).baselines.keys() == kept.baselines.keys()


def test_until_its_file_is_written_the_doubts_by_the_calibration_before_stay(
    calibrated: FaultBench,
) -> None:
    engine = new_engine(calibrated)
    nothing = np.zeros(engine.layout.n_taxels, np.bool_)
    doubted = taxels_of(engine.layout, {"left_hand": [5]})
    found = zeros_of(engine, Zeros(), nothing, replaced="before", doubted=doubted)
    assert found.are_of("before")
    assert found.unknown == {"left_hand": [5]}


@pytest.mark.parametrize(("pads", "is_kept"), [(3, False), (60, True)])
def test_what_most_pads_of_a_part_have_drifted_by_is_kept_for_a_start_after_a_crash(
    calibrated: FaultBench, pads: int, is_kept: bool
) -> None:
    """Baselines were kept at the end alone: after a crash noise touched pads that had warmed up."""
    engine, part = new_engine(calibrated), calibrated.engine.layout.parts[0]
    assert engine.pipeline is not None
    nothing = np.zeros(engine.layout.n_taxels, np.bool_)
    assert zeros_of(engine, Zeros(), nothing).baselines == {}
    taxels = np.arange(part.start, part.start + pads, dtype=np.int32)
    drifted = engine.pipeline.baseline[taxels] + 0.75
    engine.pipeline.set_zero(taxels, drifted)
    kept = zeros_of(engine, Zeros(), nothing)
    assert bool(kept.baselines) is is_kept
    if is_kept:
        assert kept.baselines[part.name][:pads] == pytest.approx(drifted, abs=0.01)
        # It is written once.
        assert zeros_of(engine, kept, nothing) == kept
