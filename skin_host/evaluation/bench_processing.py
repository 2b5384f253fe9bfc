"""`skin bench processing`: bytes to kPa, every relaxation model, and frames to events.

Frames to events is the whole processing of a sweep: from CAN frames to the events of contacts. Ten
boards of 192 taxels send one after the other, and each board's frames are one read, as with boards
that do not send at once. Each read, and the judgement of the chips after it, is timed alone, and
the faster quarter of many periods counts, because other programs interrupt the rest.
"""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS, TRIANGLES, RecordBatch, encode_sweep
from skin_host.evaluation import speed
from skin_host.evaluation.machine import machine
from skin_host.evaluation.rig import flat_skin
from skin_host.processing.core import Engine

BOARDS = 10
#: Names of the scenes, and which of the n taxels are touched.
SCENES: dict[str, slice] = {
    "untouched": slice(0),
    "hand": slice(9 * TAXELS),
    "all": slice(None),
    "147 scattered": slice(0, 147 * 13, 13),
}
_PERIOD_NS = 50_000_000
_FRAME_NS = 125_000
_START_NS = 1_700_000_000_000_000_000
_CALIBRATION_S = 5.0
_SETTLE = 20
#: Periods of silence from touch between scenes.
_REST = 40

Row = dict[str, Any]


def run(*, quick: bool = False) -> dict[str, Any]:
    """Time the models alone, the pipeline, and everything from frames to events.

    Returns:
        `machine`, and rows: `models` and `pipeline`, each with its ratio to a copy of as many
        numbers in memory, timed in the same run; and `frames_to_events`.
    """
    models = speed.models(0.02 if quick else 0.2)
    pipeline = speed.pipeline(0.1 if quick else 1.0)
    whole = frames_to_events(5.0 if quick else 20.0)
    return {"machine": machine()} | with_ratios(models, pipeline) | {"frames_to_events": whole}


def with_ratios(models: list[Row], pipeline: list[Row]) -> dict[str, list[Row]]:
    """The rows with their ratio to a copy in memory."""
    copies = {
        (row["dtype"], row["taxels"]): row["ns_per_taxel_step"]
        for row in models
        if row["model"] == "memory_copy"
    }

    def ratio(row: Row, dtype: str) -> Row:
        return row | {"ratio_to_copy": row["ns_per_taxel_step"] / copies[dtype, row["taxels"]]}

    return {
        "models": [ratio(row, row["dtype"]) for row in models],
        "pipeline": [ratio(row, "float32") for row in pipeline],
    }


def frames_to_events(seconds: float) -> list[Row]:
    """us a sweep of 1920 taxels, a row for each scene: in all, reads (`feed`) and judgements.

    Args:
        seconds: of the stream, measured in each scene.
    """
    settings, layout = flat_skin(BOARDS)
    engine = Engine(settings, layout, [0])
    stream = _Stream(layout.n_taxels)
    engine.begin_calibration(_CALIBRATION_S)
    while engine.calibration_progress() < 1.0:
        _feed(engine, stream.period(slice(0)))
    engine.use(engine.end_calibration("1970-01-01T00:00:00Z"))
    rows = []
    for name, touched in SCENES.items():
        for _ in range(_SETTLE):
            _feed(engine, stream.period(touched))
        n = max(1, round(seconds * 1e9 / _PERIOD_NS))
        times_ns = [_feed(engine, stream.period(touched)) for _ in range(n)]
        feed_us, judge_us = (np.percentile(times_ns, 25, axis=0).sum(axis=0) * 1e-3).tolist()
        rows.append(
            {
                "taxels": layout.n_taxels,
                "touched": name,
                "us_per_sweep": round(feed_us + judge_us, 1),
                "feed_us": round(feed_us, 1),
                "judge_us": round(judge_us, 1),
            }
        )
        for _ in range(_REST):
            _feed(engine, stream.period(slice(0)))
    return rows


def _feed(engine: Engine, batches: list[RecordBatch]) -> list[tuple[int, int]]:
    """How long each read and each judgement takes, ns."""
    times_ns = []
    for batch in batches:
        began_ns = time.perf_counter_ns()
        engine.feed("can0", batch)
        fed_ns = time.perf_counter_ns()
        engine.judge()
        times_ns.append((fed_ns - began_ns, time.perf_counter_ns() - fed_ns))
    return times_ns


class _Stream:
    """Frames of the boards, period by period, with noise; a touch presses up and down."""

    def __init__(self, n: int) -> None:
        self._rng = np.random.default_rng(1)
        self._resting = self._rng.uniform(200.0, 240.0, n)
        self._number = 0

    def period(self, touched: slice) -> list[RecordBatch]:
        """The next period, a batch for each board."""
        level = self._resting + 0.45 * self._rng.standard_normal(len(self._resting))
        level[touched] -= 20.0 + 5.0 * np.sin(0.1 * np.pi * self._number)
        raw = np.clip(np.rint(level), 0.0, 255.0).astype(np.uint8)
        start_ns = _START_NS + self._number * _PERIOD_NS
        self._number += 1
        return [
            _batch(board, of_board, start_ns + board * _PERIOD_NS // BOARDS)
            for board, of_board in enumerate(raw.reshape(BOARDS, TRIANGLES, TAXELS))
        ]


def _batch(board: int, raw: NDArray[np.uint8], start_ns: int) -> RecordBatch:
    ids, data = encode_sweep(board + 1, np.arange(TRIANGLES), raw, np.zeros(TRIANGLES, np.uint16))
    n = len(ids)
    t_ns = start_ns + _FRAME_NS * np.arange(n, dtype=np.int64)
    return RecordBatch(ids.astype(np.uint32), np.full(n, 8, np.uint8), data, t_ns)


def describe(document: dict[str, Any]) -> str:
    """The rows as text."""
    lines = ["model             states        type       taxels  ns/taxel-step  times a copy"]
    lines += [
        f"{row['model']:<17} {_states(row['update_s']):<13} {row['dtype']:<8} {row['taxels']:>8,} "
        f"{row['ns_per_taxel_step']:>14.2f} {row['ratio_to_copy']:>13.1f}"
        for row in document["models"]
    ]
    lines += ["", "bytes to kPa: taxels  touched  pressures  ns/taxel-step  us/sweep  times a copy"]
    lines += [
        f"{row['taxels']:>20,} {row['touched']:>8,} "
        f"{'wanted' if row['pressures_wanted'] else 'not':>10} {row['ns_per_taxel_step']:>14.2f} "
        f"{row['ns_per_taxel_step'] * row['taxels'] * 1e-3:>9.1f} {row['ratio_to_copy']:>13.1f}"
        for row in document["pipeline"]
    ]
    lines += ["", "frames to events: taxels        touched  us/sweep  reads  judging chips"]
    lines += [
        f"{row['taxels']:>24,} {row['touched']:>14} {row['us_per_sweep']:>9.0f} "
        f"{row['feed_us']:>6.0f} {row['judge_us']:>14.0f}"
        for row in document["frames_to_events"]
    ]
    return "\n".join(lines)


def _states(update_s: float) -> str:
    return "every sample" if update_s == 0.0 else f"every {update_s:g} s"
