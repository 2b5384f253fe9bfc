"""What is kept of the zeros of an engine, and how an engine goes on from that. Pure."""

import numpy as np

from skin_host.daemon.state import Zeros, baselines_of, kept_or, taxels_of
from skin_host.layout import PadKind
from skin_host.processing.core import Engine
from skin_host.processing.masks import Mask, any_of

#: Baselines are kept again once most pads of a part have drifted by so many units: by more, noise
#: would touch pads at the start after a crash, until their boards are set up.
DRIFTED_UNITS = 0.5


def go_on_from(zeros: Zeros, engine: Engine) -> Mask:
    """Let an engine that was just made go on from zeros that were kept; return the taxels bool[n]
    that something may touch.
    """
    layout = engine.layout
    touched = taxels_of(layout, zeros.touched)
    engine.zeros.expect_touched(touched)
    doubted = np.zeros_like(touched)
    if engine.pipeline is not None:
        # Boards send with the zeros that they had.
        for part, kept in baselines_of(layout, zeros.baselines):
            engine.pipeline.set_zero(np.arange(part.start, part.stop, dtype=np.int32), kept)
        doubted = taxels_of(layout, zeros.unknown)
        engine.zeros.doubt(doubted)
    # Whatever calibration is in use: it is the chip's fault.
    engine.expect_stuck(taxels_of(layout, zeros.stuck))
    engine.zeros.hold(engine.boards)
    return doubted | touched


def zeros_of(
    engine: Engine,
    before: Zeros,
    lasting: Mask,
    *,
    ends: bool = False,
    found: bool = False,
    replaced: str = "",
    doubted: Mask | bool = False,
) -> Zeros:
    """Return what is to be kept of the zeros of an engine that has a calibration.

    Args:
        engine: whose zeros they are.
        before: what is kept until now.
        lasting: bool[n], touches that have lasted.
        ends: the daemon ends, and what is touched now will not be known.
        found: zeros were found since.
        replaced: id of another calibration, if that may be the one that a start finds.
        doubted: bool[n], taxels whose zero was not known by that one.
    """
    calibration, pipeline = engine.calibration, engine.pipeline
    assert calibration is not None
    assert pipeline is not None
    parts = [engine.layout.parts[part] for part in engine.parts]

    def numbers(taxels: Mask) -> dict[str, list[int]]:
        by_part = {
            part.name: np.flatnonzero(taxels[part.start : part.stop]).tolist() for part in parts
        }
        return {name: mine for name, mine in by_part.items() if mine}

    baselines = before.baselines
    is_other = before.calibration != calibration.id
    if ends or found or replaced or (baselines and is_other) or _have_drifted(engine, before):
        baselines = {
            part.name: np.round(pipeline.baseline[part.start : part.stop], 2).tolist()
            for part in parts
        }
    return Zeros(
        calibration=calibration.id,
        before=replaced,
        unknown=numbers(engine.zeros.at_risk(ends) | doubted),
        touched=numbers(engine.zeros.pressed() | (engine.zeros.touched() if ends else lasting)),
        stuck=numbers(engine.stuck()),
        baselines=baselines,
        written=before.written,
        robot=before.robot,
        parts=before.parts,
    )


def _have_drifted(engine: Engine, before: Zeros) -> bool:
    """Return whether most pads of a part rest elsewhere than a start would believe by what is kept
    of the calibration in use.
    """
    calibration, pipeline, layout = engine.calibration, engine.pipeline, engine.layout
    assert calibration is not None
    assert pipeline is not None
    kept_units = kept_or(calibration.baseline, layout, before.baselines)
    pads = calibration.usable & (layout.pad_kind == PadKind.PRESSURE)
    moved_units = np.abs(pipeline.baseline - kept_units)
    for part in (layout.parts[index] for index in engine.parts):
        mine = slice(part.start, part.stop)
        if any_of(pads[mine]) and np.median(moved_units[mine][pads[mine]]) >= DRIFTED_UNITS:
            return True
    return False
