"""`skin report`: the table of speed against error, and what else a skin engineer asks.

One command works everything out anew: truths and seeds are fixed, fits are made on the
spot. Errors are worked out in as many processes as there are cores; then, alone on the
machine, what is timed, in the same run as a copy of the same numbers in memory.
"""

import os
import platform
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import astuple
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from emulator.viscoelastic import TruthKind
from skin_host.evaluation import accuracy, page, speed, touching
from skin_host.evaluation.accuracy import Plan, Variant
from skin_host.evaluation.histories import TRUTHS
from skin_host.evaluation.localization_trials import Case, errors, localizer_for
from skin_host.relaxation_settings import MODELS, Relaxation

Row = dict[str, Any]
Report = dict[str, Any]

SCHEMA = "skin.report/1"
#: The histories and truths that the goals name.
JUDGED_HISTORIES = ("nine_steps", "multistep", "grasps", "cycling")
JUDGED_TRUTHS: tuple[TruthKind, ...] = ("A", "S")
PROBES_MM = (3.0, 6.0, 10.0)
#: What the pipeline runs unless it is configured otherwise: states once a second in float32.
DEFAULT = Variant(
    Relaxation().model,
    Relaxation().update_s,
    "float32" if Relaxation().update_s > 0.0 else "float64",
)
#: The models that are cycled: each at every sample, and the default as it runs.
CYCLED = (*(Variant(model, 0.0) for model in MODELS if model != "none"), DEFAULT)
RULES = ("paper", "proportional")
QUICKLY_CYCLED = (Variant("published", 0.0), Variant(DEFAULT.model, 0.0), DEFAULT)
#: They fit the record of a hold alike; where they part nobody can tell from it who is right.
EQUALLY_GOOD = ("asymmetric_log", "asymmetric_clock")
#: How many cycles on the judged truths, in a quick report, and on the other truths.
LAST_CYCLE, LAST_CYCLE_QUICK, LAST_CYCLE_OTHERS = 100_000, 3_000, 10_000
#: By this cycle truths and models repeat themselves.
SETTLED = 10_000


def run(quick: bool, output: Path | None) -> Report:
    """Work out the report, and write it to a folder if one is given.

    Args:
        quick: shorter histories at 5 Hz and two truths, within a minute.
        output: folder for report.json, report.html, accuracy.md and the plots; needs
            matplotlib.

    Raises:
        OSError: the folder cannot be written.
    """
    start_s, here = time.perf_counter(), machine()
    found, seconds_of = _worked_out(_jobs(quick))
    scored = found["errors"]
    report: Report = {
        "schema": SCHEMA,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": here,
        "quick": quick,
        "default": _key(DEFAULT),
        "rows": [row for rows, _ in scored for row in rows],
        "fits": [row for _, fits in scored for row in fits],
        "cycles": [row for rows in found["cycles"] for row in rows],
        "unwatched": found["unwatched"][0],
        "false_touches": [row for rows in found["false touches"] for row in rows],
        "detection": found["delays"][0],
        "drift": [row for rows in found["drift"] for row in rows],
        "holds": found["long holds"],
        "localization": found["localisation"][0],
    }
    _tell("speed of models")
    report["speed"], seconds_of["speed"] = _timed(speed.models, (0.02 if quick else 0.15,))
    _tell("speed of the pipeline")
    report["pipeline"], seconds_of["pipeline"] = _timed(speed.pipeline, (0.1 if quick else 0.6,))
    _tell("")
    report["summary"] = summary(report)
    report["goals"] = goals(report)
    report["cycle_evidence"] = cycle_evidence(report)
    report["cpu_seconds_of"] = {name: round(seconds, 1) for name, seconds in seconds_of.items()}
    report["seconds"] = round(time.perf_counter() - start_s, 1)
    if output is not None:
        page.write(report, output)
    return report


Job = tuple[str, Callable[..., Any], tuple[Any, ...]]


def _jobs(quick: bool) -> list[Job]:
    """What can be worked out in any process: name, function, arguments. The longest first."""
    plan = Plan(0.25, 5.0, 2) if quick else Plan()
    jobs: list[Job] = []
    for kind in JUDGED_TRUTHS:
        cycled = QUICKLY_CYCLED if quick else CYCLED
        last = LAST_CYCLE_QUICK if quick else LAST_CYCLE
        jobs.append(("cycles", accuracy.cycles, (kind, last, cycled)))
    for kind in JUDGED_TRUTHS if quick else TRUTHS:
        jobs.append(("errors", accuracy.score, (kind, plan)))
        if kind not in JUDGED_TRUTHS:
            jobs.append(("cycles", accuracy.cycles, (kind, LAST_CYCLE_OTHERS, CYCLED)))
    jobs += [("long holds", touching.long_hold, case) for case in touching.hold_cases(quick)]
    hours, votes = (0.02, (1, 2)) if quick else (0.5, (1, 2, 3))
    jobs += [
        ("false touches", touching.false_touches, (hours, votes, (noise,)))
        for noise in touching.NOISES
    ]
    jobs += [("drift", touching.drift_lags, (1.0 if quick else 10.0, rule)) for rule in RULES]
    jobs.append(("delays", touching.detection_delays, ()))
    jobs.append(("localisation", _localization, (50 if quick else 400,)))
    jobs.append(("unwatched", speed.cost_of_glancing, (30.0 if quick else 300.0,)))
    return jobs


def _worked_out(jobs: list[Job]) -> tuple[dict[str, list[Any]], dict[str, float]]:
    """Results of all jobs by their name, in their order, and what they cost in CPU seconds."""
    # Fresh processes: the parent may run threads, which a fork would not survive.
    with ProcessPoolExecutor(_cores(), mp_context=get_context("spawn")) as pool:
        running: list[Future[tuple[Any, float]]] = [
            pool.submit(_timed, function, arguments) for _, function, arguments in jobs
        ]
        try:
            for done, future in enumerate(as_completed(running), 1):
                future.result()
                _tell(f"{done} of {len(jobs)} parts")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    found: dict[str, list[Any]] = {}
    seconds_of: dict[str, float] = {}
    for (name, _, _), future in zip(jobs, running, strict=True):
        result, seconds = future.result()
        found.setdefault(name, []).append(result)
        seconds_of[name] = seconds_of.get(name, 0.0) + seconds
    return found, seconds_of


def _timed(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, float]:
    since_s = time.process_time()
    return function(*arguments), time.process_time() - since_s


def machine() -> Row:
    """What the times were measured on."""
    return {
        "processor": _processor(),
        "cores": _cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "load": round(_load(), 2),
    }


def summary(report: Report) -> list[Row]:
    """One row per variant: errors over the judged histories, and cost at 1920 taxels.

    `pareto` marks those that no other beats in both.
    """
    lines: list[Row] = []
    for variant in accuracy.VARIANTS:
        key = _key(variant)
        judged = [row for row in select(report["rows"], **key) if _is_judged(row)]
        if not judged:
            continue
        clean = [row["rms_kpa"] for row in judged if row["noise_units"] == 0.0]
        noisy = [row["rms_kpa"] for row in judged if row["noise_units"] > 0.0]
        (timed,) = select(report["speed"], **key, taxels=1920)
        lines.append(
            key
            | {
                "rms_kpa": float(np.sqrt(np.mean(np.square(clean)))),
                "worst_rms_kpa": max(clean),
                "noisy_rms_kpa": float(np.sqrt(np.mean(np.square(noisy)))),
                "ns_per_taxel_step": timed["ns_per_taxel_step"],
                "bytes_per_taxel": timed["bytes_per_taxel"],
            }
        )
    for line in lines:
        line["pareto"] = not any(
            other["rms_kpa"] <= line["rms_kpa"]
            and other["ns_per_taxel_step"] <= line["ns_per_taxel_step"]
            and other is not line
            for other in lines
        )
    return lines


def goals(report: Report) -> list[Row]:
    """The figures that were set as goals, what was measured, and whether it is enough."""
    default = report["default"]
    mine = select(report["rows"], **default)
    lines = []
    for truth, must, aim in (("A", 0.5, 0.3), ("S", 0.8, 0.4)):
        for history in JUDGED_HISTORIES:
            found = select(mine, truth=truth, history=history, noise_units=0.0)
            name = f"default model, exact readings, {history} on {truth}, kPa RMS"
            lines.append(_goal(name, found[0]["rms_kpa"], must, aim))
    noisy = [row["rms_kpa"] for row in mine if _is_judged(row) and row["noise_units"] > 0.0]
    floor = [
        row["rms_kpa"]
        for row in select(report["rows"], model="perfect")
        if _is_judged(row) and row["noise_units"] > 0.0
    ]
    name = f"with 0.4 units of noise and 8-bit steps, worst (a perfect model: {max(floor):.2f})"
    lines.append(_goal(name + ", kPa RMS", max(noisy), 1.1, 0.9))
    growth, last = growth_of_error(select(report["cycles"], **default))
    lines.append(_goal(f"growth of the error from cycle 100 to {last:,}, kPa", growth, 0.0, 0.0))
    for noise, must, aim in ((0.4, 0.01, 0.0), (1.0, 1.0, 0.1)):
        (row,) = select(report["false_touches"], noise_units=noise, votes=2)
        name = f"false touches per taxel-hour at {noise} units of noise"
        lines.append(_goal(name, row["touches_per_taxel_hour"], must, aim))
    worst = max(row["ghost_s_per_taxel"] for row in select(report["holds"], all_pressed=False))
    lines.append(_goal("ghost touch after long holds, neighbours untouched, s", worst, 3.0, 0.0))
    worst = max(
        row["ghost_s_per_taxel"] for row in select(report["holds"], all_pressed=True, hold_s=600.0)
    )
    lines.append(_goal("ghost touch after 10 min, the whole part pressed, s", worst, 3.0, 0.0))
    for touched in (0, 12):
        (row,) = select(report["pipeline"], taxels=1920, touched=touched, pressures_wanted=True)
        name = f"pipeline from bytes to kPa, 1920 taxels, {touched} touched, ns per taxel-step"
        lines.append(_goal(name, row["ns_per_taxel_step"], 9.0, 3.0))
    (timed,) = select(report["speed"], **default, taxels=1920)
    name = f"default relaxation alone, 1920 taxels, {default['dtype']}, ns per taxel-step"
    lines.append(_goal(name, timed["ns_per_taxel_step"], 2.0, 1.0))
    return lines


def select(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Rows whose fields have these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def describe(report: Report) -> str:
    """The goals and the summary as text for a terminal."""
    lines = [
        "model             update  type      RMS kPa  worst  noisy  ns/taxel-step  bytes  Pareto"
    ]
    lines += [
        f"{line['model']:<17} {line['update_s']:<7g} {line['dtype']:<8} "
        f"{line['rms_kpa']:>8.2f} {line['worst_rms_kpa']:>6.2f} {line['noisy_rms_kpa']:>6.2f} "
        f"{line['ns_per_taxel_step']:>14.2f} {line['bytes_per_taxel']:>6} "
        f"{'  *' if line['pareto'] else ''}"
        for line in report["summary"]
    ]
    lines.append("")
    for goal in report["goals"]:
        mark = "aim reached" if goal["aim_reached"] else "reached" if goal["reached"] else "MISSED"
        lines.append(
            f"{goal['figure']}: {goal['measured']:.3g} (must {goal['must']:g}, "
            f"aim {goal['aim']:g}): {mark}"
        )
    lines.append(f"in {report['seconds']} s on {report['machine']['processor']}")
    return "\n".join(lines)


def _goal(figure: str, measured: float, must: float, aim: float) -> Row:
    return {
        "figure": figure,
        "measured": measured,
        "must": must,
        "aim": aim,
        "reached": measured <= must,
        "aim_reached": measured <= aim + 1e-9,
    }


def growth_of_error(cycles: list[Row]) -> tuple[float, int]:
    """How much the size of a model's error grows from cycle 100 to the last, at worst.

    Returns:
        The growth on the worst of the judged truths in kPa, below 0 if it shrinks; and which
        cycle was the last.
    """
    worst, last = -np.inf, 0
    for truth in JUDGED_TRUTHS:
        mine = {
            row["cycles"]: abs(row["unclamped_error_kpa"]) for row in select(cycles, truth=truth)
        }
        if mine:
            last = max(mine)
            worst = max(worst, mine[last] - mine[100])
    return float(worst), last


def cycle_evidence(report: Report) -> list[Row]:
    """Why the default's error moves between cycle 100 and the last, a row for each truth.

    The truth's own relaxation at both, the error at both, what changes after SETTLED, what
    float32 and states at 1 Hz change, and by how much two models differ in the end that fit the
    record of the hold equally well.
    """
    rows = []
    for truth in dict.fromkeys(row["truth"] for row in report["cycles"]):
        cycles = select(report["cycles"], truth=truth)
        last = max(row["cycles"] for row in cycles)

        every_sample = Variant(DEFAULT.model, 0.0)
        true = [_lost(cycles, cycle, accuracy.PERFECT) for cycle in (100, last)]
        mine = [_lost(cycles, cycle, DEFAULT) for cycle in (100, last)]
        settled = abs(_lost(cycles, SETTLED, DEFAULT) - mine[1]) if last > SETTLED else None
        cycled = {row["model"] for row in cycles}
        equal = [_lost(cycles, last, Variant(m, 0.0)) for m in EQUALLY_GOOD if m in cycled]
        fits = {row["model"]: row["rms_hold_kpa"] for row in select(report["fits"], truth=truth)}
        rows.append(
            {
                "truth": truth,
                "last_cycle": last,
                "true_relaxation_kpa": true,
                "error_kpa": [its - own for its, own in zip(true, mine, strict=True)],
                "change_since_settled_kpa": settled,
                "change_by_float32_and_1_hz_kpa": abs(_lost(cycles, last, every_sample) - mine[1]),
                "fits_rms_kpa": [fits[model] for model in EQUALLY_GOOD],
                "fits_differ_kpa": abs(equal[0] - equal[1]) if len(equal) == 2 else None,
            }
        )
    return rows


def _lost(cycles: list[Row], cycle: int, variant: Variant) -> float:
    """Relaxation at the end of the press of a cycle."""
    (row,) = select(cycles, cycles=cycle, **_key(variant))
    relaxation: float = row["relaxation_kpa"]
    return relaxation


def _is_judged(row: Row) -> bool:
    return row["history"] in JUDGED_HISTORIES and row["truth"] in JUDGED_TRUTHS


def _localization(presses: int) -> list[Row]:
    rows = []
    for probe_mm in PROBES_MM:
        case = Case(probe_mm)
        methods = {
            str(method): localizer_for(method, probe_mm)
            for method in ("centroid", "half_maximum", "peak", "template")
        }
        found = errors(case, methods, np.random.default_rng(0), presses, timed=False)
        rows += [
            {
                "probe_mm": probe_mm,
                "method": method,
                "rms_mm": result.rms_mm,
                "p95_mm": float(np.percentile(result.error_mm, 95)),
            }
            for method, result in found.items()
        ]
    return rows


def _key(variant: Variant) -> Row:
    return dict(zip(("model", "update_s", "dtype"), astuple(variant), strict=True))


def _tell(what: str) -> None:
    """Say on a terminal what is being worked out."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{what}")
        sys.stderr.flush()


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _load() -> float:
    return os.getloadavg()[0]
