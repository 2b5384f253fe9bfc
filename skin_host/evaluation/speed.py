"""Speed against error, part two: what models and pipeline cost.

Everything is timed in the same run, next to a copy of the same numbers in memory, in processor
time of this process, and the least of several repeats counts: what is above it is other programs.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.accuracy import VARIANTS
from skin_host.evaluation.rig import Rig
from skin_host.processing.curves import KNOTS_UNITS, Curves, CurveVerdict, Memory
from skin_host.processing.pipeline import Pipeline
from skin_host.processing.pressure import PressureCurve
from skin_host.processing.relaxation import OWN_MEANS, make_model, stand_in

Row = dict[str, Any]

TAXELS = (192, 1920, 100_000)
#: Sweeps come with some jitter, so that nothing can be kept from the last dt.
STEPS_S = (0.02, 0.020013, 0.019988, 0.020007)
#: Steps per repeat: a whole number of windows of 1 s, so that their end has its share.
STEPS = 100
HZ = 50.0
#: What pads get their pressures by, where that is compared.
EQUATION_1 = "equation (1)"
EQUATION_1_AND_MEMORY = "equation (1), the memory of own curves"
OWN_CURVES = "own curves"


def models(seconds: float, sizes: tuple[int, ...] = TAXELS) -> list[Row]:
    """ns per taxel-step of every model alone, `seconds` spent on each row."""
    rows: list[Row] = []
    rng = np.random.default_rng(1)
    for n in sizes:
        for dtype in ("float32", "float64"):
            samples = rng.uniform(0.0, 60.0, (8, n)).astype(dtype)
            out = np.empty(n, dtype)

            def copy(samples: NDArray[Any] = samples, out: NDArray[Any] = out) -> None:
                for step in range(STEPS):
                    np.copyto(out, samples[step % 8])

            rows.append(_row("memory_copy", 0.0, dtype, n, _ns(copy, n, seconds), 0))
            for variant in VARIANTS:
                own_means = variant.model in OWN_MEANS
                model = make_model(
                    variant.model,
                    n,
                    stand_in(variant.model, "mid"),
                    held=own_means and variant.update_s > 0.0,
                    dtype=dtype,
                )
                # The pipeline takes the means of a window anyway, and steps the model by them.
                windowed = variant.update_s > 0.0 and not own_means
                every = round(variant.update_s * HZ) if windowed else 1

                def run(
                    step_once: Callable[..., Any] = model.step,
                    samples: NDArray[Any] = samples,
                    out: NDArray[Any] = out,
                    every: int = every,
                ) -> None:
                    for step in range(0, STEPS, every):
                        step_once(samples[step % 8], every * STEPS_S[step % 4], out)

                ns = _ns(run, n, seconds)
                row = _row(variant.model, variant.update_s, dtype, n, ns, model.bytes_per_taxel)
                rows.append(row)
    return rows


def pipeline(seconds: float, sizes: tuple[int, ...] = (1, 10)) -> list[Row]:
    """ns per taxel-step from bytes to kPa, against how many taxels are touched.

    Args:
        seconds: spent on each row.
        sizes: of the skin, in boards of 192 taxels.
    """
    rows: list[Row] = []
    for boards in sizes:
        n = 192 * boards
        for touched in sorted({0, 12, 96, n // 4, n}):
            for watched in (True, False):
                if touched and not watched:
                    continue  # what is touched is always worked out
                rig = Rig(boards, 0.4, seed=2, hz=HZ)
                activation = np.where(np.arange(n) < touched, 20.0, 0.0)
                sweeps = [rig.read(activation) for _ in range(STEPS)]
                present = np.ones(n, dtype=np.bool_)
                times = np.cumsum(np.resize(STEPS_S, STEPS) * 1e9).astype(np.int64)
                clock = [0]

                def run(
                    rig: Rig = rig,
                    sweeps: list[NDArray[np.uint8]] = sweeps,
                    present: NDArray[np.bool_] = present,
                    times: NDArray[np.int64] = times,
                    clock: list[int] = clock,
                    watched: bool = watched,
                ) -> None:
                    for sweep, t_ns in zip(sweeps, times.tolist(), strict=True):
                        rig.pipeline.step(0, sweep, present, clock[0] + t_ns, watched)
                    clock[0] += int(times[-1])

                rows.append(
                    {
                        "taxels": n,
                        "touched": touched,
                        "pressures_wanted": watched,
                        "ns_per_taxel_step": _ns(run, n, seconds),
                    }
                )
    return rows


def own_curves(seconds: float, boards: int = 10) -> list[Row]:
    """ns per taxel-step from bytes to kPa: pads with equation (1), and with curves of their own.

    A foam's memory, here three plays, comes from the same recording as curves, in place of the
    configured model, with a filter of noise. So equation (1) is measured in both pipelines.

    Args:
        seconds: spent on each figure.
        boards: of 192 taxels.
    """
    rows: list[Row] = []
    for touched in (0, 12):
        rig = Rig(boards, 0.4, seed=2, hz=HZ)
        n = rig.n
        knots_kpa = PressureCurve(2.88).kpa(KNOTS_UNITS[:, np.newaxis])[:, 0]
        curves = Curves(
            kpa=np.tile(knots_kpa, (n, 1)),
            beyond_units=np.full(n, 60.0),
            noise_units=np.full(n, 0.4),
            error_kpa=np.full(n, 1.0),
            verdict=np.full(n, CurveVerdict.GOOD, np.uint8),
            highest_kpa=150.0,
            lag_s=0.0,
            memory=Memory((5.0, 20.0, 60.0), (0.1, 0.1, 0.05)),
        )
        settings = rig.settings.processing
        unknown = np.full(n, CurveVerdict.UNKNOWN, np.uint8)
        pipelines = {
            name: Pipeline(rig.layout, settings, replace(rig.calibration, curves=found))
            for name, found in {
                EQUATION_1: None,
                EQUATION_1_AND_MEMORY: replace(curves, verdict=unknown),
                OWN_CURVES: curves,
            }.items()
        }
        activation = np.where(np.arange(n) < touched, 20.0, 0.0)
        sweeps = [rig.read(activation) for _ in range(STEPS)]
        present = np.ones(n, dtype=np.bool_)
        times = np.cumsum(np.resize(STEPS_S, STEPS) * 1e9).astype(np.int64).tolist()
        runs = []
        for pipeline in pipelines.values():
            start_ns = [0]

            def run(
                pipeline: Pipeline = pipeline,
                sweeps: list[NDArray[np.uint8]] = sweeps,
                start_ns: list[int] = start_ns,
                times: list[int] = times,
                present: NDArray[np.bool_] = present,
            ) -> None:
                for sweep, t_ns in zip(sweeps, times, strict=True):
                    pipeline.step(0, sweep, present, start_ns[0] + t_ns)
                start_ns[0] += times[-1]

            runs.append(run)
        for name, ns in zip(pipelines, _ns_in_turn(runs, n, seconds), strict=True):
            rows.append({"taxels": n, "touched": touched, "curve": name, "ns_per_taxel_step": ns})
    return rows


def cost_of_glancing(seconds: float) -> Row:
    """What is lost where pressures are not wanted: the same skin watched and unwatched.

    A taxel in eight is pressed now and then; frames are compared where both know pressures.
    """
    rng = np.random.default_rng(8)
    watched, unwatched = (Rig(1, 0.4, seed=4, hz=HZ) for _ in range(2))
    n = watched.n
    activation = np.zeros(n)
    worst, disagreements, compared, skipped, sweeps = 0.0, 0, 0, 0, round(seconds * HZ)
    present = np.ones(n, dtype=np.bool_)
    for sweep in range(sweeps):
        if sweep % round(5.0 * HZ) == 0:
            pressed = rng.uniform(size=n) < 0.125 * (sweep // round(5.0 * HZ) % 2)
            activation = np.where(pressed, rng.uniform(5.0, 40.0, n), 0.0)
        raw = watched.read(activation)
        t_ns = round(sweep * 1e9 / HZ)
        one = watched.pipeline.step(0, raw, present, t_ns)
        other = unwatched.pipeline.step(0, raw, present, t_ns, False)
        disagreements += int(np.count_nonzero(one.touched != other.touched))
        if other.computed:
            compared += 1
            worst = max(worst, float(np.max(np.abs(one.pressure_kpa - other.pressure_kpa))))
        else:
            skipped += 1
    return {
        "sweeps": sweeps,
        "skipped_sweeps": skipped,
        "compared_sweeps": compared,
        "touches_that_differ": disagreements,
        "worst_difference_kpa": worst,
    }


def _ns(run: Callable[[], None], n: int, seconds: float) -> float:
    return _ns_in_turn([run], n, seconds)[0]


def _ns_in_turn(runs: Sequence[Callable[[], None]], n: int, seconds: float) -> list[float]:
    """The least of each, `seconds` spent on each: what disturbs one disturbs the others."""
    best = [np.inf] * len(runs)
    end = time.perf_counter() + seconds * len(runs)
    while True:
        for number, run in enumerate(runs):
            start = time.process_time()
            run()
            best[number] = min(best[number], time.process_time() - start)
        if time.perf_counter() > end:
            return [least / STEPS / n * 1e9 for least in best]


def _row(model: str, update_s: float, dtype: str, n: int, ns: float, size: int) -> Row:
    return {
        "model": model,
        "update_s": update_s,
        "dtype": dtype,
        "taxels": n,
        "ns_per_taxel_step": ns,
        "bytes_per_taxel": size,
    }
