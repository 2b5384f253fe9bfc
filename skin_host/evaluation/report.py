"""`skin report`: the table of speed against error, and what else a skin engineer asks.

One command computes everything again: truths and seeds are fixed, fits are made on the
spot. Errors are worked out in as many processes as there are cores; then, alone on the
machine, what is timed, in the same run as a copy of the same numbers in memory.
"""

import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, as_completed
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from emulator.probes.viscoelastic import TruthKind
from skin_host.config.relaxation import MODELS
from skin_host.evaluation import accuracy, force_trials, page, real, speed, tables, touching
from skin_host.evaluation.accuracy import DEFAULT, HistoryPlan, Variant
from skin_host.evaluation.document import as_text
from skin_host.evaluation.goals import goal
from skin_host.evaluation.histories import TRUTHS
from skin_host.evaluation.localization_trials import Case, errors, localizer_for
from skin_host.evaluation.machine import machine
from skin_host.evaluation.steps import show_step
from skin_host.processes import Processes

Row = dict[str, Any]
Report = dict[str, Any]

SCHEMA = "skin.report/1"
#: Truths that are cycled to the last.
CYCLED_TRUTHS: tuple[TruthKind, ...] = ("F", "S")
PROBES_MM = (3.0, 6.0, 10.0)
#: The models that are cycled.
CYCLED = tuple(model for model in MODELS if model != "none")
RULES = ("paper", "proportional")
#: How many cycles on the truths that are cycled, in a quick report, and on the other truths.
LAST_CYCLE, LAST_CYCLE_QUICK, LAST_CYCLE_OTHERS = 100_000, 3_000, 10_000
#: By this cycle truths and models repeat themselves.
SETTLED = 10_000
#: Rates at which untouched skin with measured noise is looked at.
NOISE_HZ = (25.0, 50.0, 100.0)


def run(quick: bool, output: Path | None, recordings: Path | None = None) -> Report:
    """Work out the report, and write it to a folder if one is given.

    Args:
        quick: shorter histories at 5 Hz and the truths that are in no family.
        output: folder for report.json, report.html, accuracy.md and the plots; needs
            matplotlib.
        recordings: folder of recordings of real skin; see `real.run`.

    Raises:
        RequestError: `recordings` has none.
        LogError: one of them is damaged.
        OSError: the folder cannot be written.
    """
    start_s, here = time.perf_counter(), machine()
    real_skin = real.run(quick, None, recordings, with_emulation=not quick, may_be_absent=True)
    found, seconds_of = _worked_out(jobs_of(quick))
    report: Report = {
        "schema": SCHEMA,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": here,
        "quick": quick,
        "default": key_of(DEFAULT),
        "real_skin": real_skin,
        "rows": [row for rows in found["errors"] for row in rows],
        "noise_draws": [row for rows in found["noise draws"] for row in rows],
        "fits": [row for rows in found["fits"] for row in rows],
        "cycles": [row for rows in found["cycles"] for row in rows],
        "unwatched": found["unwatched"][0],
        "false_touches": [row for rows in found["false touches"] for row in rows],
        "detection": found["delays"][0],
        "drift": [row for rows in found["drift"] for row in rows],
        "holds": found["long holds"],
        "hard_cases": [row for rows in found["hard cases"] for row in rows],
        "localization": found["localisation"][0],
        "force": [row for rows in found["force"] for row in rows],
    }
    show_step("speed of models")
    report["speed"], seconds_of["speed"] = _timed(speed.models, (0.02 if quick else 0.15,))
    show_step("speed of the pipeline")
    report["pipeline"], seconds_of["pipeline"] = _timed(speed.pipeline, (0.1 if quick else 0.6,))
    show_step("speed of own curves")
    report["own_curves"], seconds_of["own curves"] = _timed(
        speed.own_curves, (0.1 if quick else 5.0,)
    )
    report["summary"] = summary(report)
    report["goals"] = goals(report)
    report["cycle_evidence"] = cycle_evidence(report)
    report["cpu_seconds_of"] = {name: round(seconds, 1) for name, seconds in seconds_of.items()}
    report["seconds"] = round(time.perf_counter() - start_s, 1)
    if output is not None:
        page.write(report, output)
    return report


Job = tuple[str, Callable[..., Any], tuple[Any, ...]]


def jobs_of(quick: bool) -> list[Job]:
    """What can be worked out in any process: name, function, arguments. The longest first."""
    plan = HistoryPlan(0.25, 5.0) if quick else HistoryPlan()
    truths = accuracy.HELD_OUT if quick else TRUTHS
    jobs: list[Job] = []
    for kind in truths:
        last = LAST_CYCLE if kind in CYCLED_TRUTHS else LAST_CYCLE_OTHERS
        jobs.append(
            ("cycles", accuracy.cycles, (kind, LAST_CYCLE_QUICK if quick else last, CYCLED))
        )
        jobs.append(("fits", accuracy.fit_rows, (kind,)))
        if kind in accuracy.HELD_OUT:
            jobs.append(("noise draws", accuracy.noise_draws, (kind, plan)))
        jobs += [
            ("errors", accuracy.score, (kind, scenario, plan))
            for scenario in accuracy.SCENARIOS
            if kind in accuracy.HELD_OUT or scenario == accuracy.FITTED_FOAM
        ]
    jobs += [("long holds", touching.long_hold, case) for case in touching.hold_cases(quick)]
    jobs += [("hard cases", case, (asked,)) for case, asked in touching.hard_cases(quick)]
    jobs += [
        ("false touches", touching.false_touches, (0.02 if quick else 0.25, (2,), (None,), 4, hz))
        for hz in NOISE_HZ
    ]
    hours, votes = (0.02, (1, 2)) if quick else (0.5, (1, 2, 3))
    jobs += [
        ("false touches", touching.false_touches, (hours, votes, (noise,)))
        for noise in touching.NOISES
    ]
    jobs += [("drift", touching.drift_lags, (1.0 if quick else 10.0, rule)) for rule in RULES]
    jobs.append(("delays", touching.detection_delays, ()))
    jobs.append(("localisation", localization, (50 if quick else 400,)))
    jobs += [
        ("force", force_trials.force, (kind, 20 if quick else 200)) for kind in force_trials.KINDS
    ]
    jobs.append(("unwatched", speed.cost_of_glancing, (30.0 if quick else 300.0,)))
    return jobs


def _worked_out(jobs: list[Job]) -> tuple[dict[str, list[Any]], dict[str, float]]:
    """Results of all jobs by their name, in their order, and what they cost in CPU seconds."""
    with Processes() as processes:
        running: list[Future[tuple[Any, float]]] = [
            processes.submit(_timed, function, arguments) for _, function, arguments in jobs
        ]
        for done, future in enumerate(as_completed(running), 1):
            future.result()
            show_step(f"{done} of {len(jobs)} parts")
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


def summary(report: Report) -> list[Row]:
    """One row per variant: errors over the judged histories of truths in no family, and cost.

    `pareto` marks those that no other beats in both; `rms_kpa` is of fitted foam, exact readings.
    """
    lines: list[Row] = []
    for variant in accuracy.VARIANTS:
        key = key_of(variant)
        mine = [row for row in select(report["rows"], **key) if _is_judged(row)]
        fitted = select(mine, scenario=accuracy.FITTED_FOAM.name)
        clean = [row["rms_kpa"] for row in fitted if row["noise_units"] == 0.0]
        noisy = [row["rms_kpa"] for row in fitted if row["noise_units"] > 0.0]
        (timed,) = select(report["speed"], **key, taxels=1920, dtype=variant.dtype)
        lines.append(
            key
            | {
                "dtype": variant.dtype,
                "rms_kpa": _rms(clean),
                "worst_rms_kpa": max(clean),
                "noisy_rms_kpa": _rms(noisy),
                "scenarios": {
                    scenario.name: _rms([row["rms_kpa"] for row in found])
                    for scenario in accuracy.SCENARIOS
                    if (found := select(mine, scenario=scenario.name, noise_units=0.0))
                },
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
    lines = real.goals(report["real_skin"])
    default = report["default"]
    mine = [row for row in select(report["rows"], **default) if _is_judged(row)]
    for scenario, must, aim in SCENARIO_GOALS:
        rms = {
            truth: _rms(
                [
                    row["rms_kpa"]
                    for row in select(mine, scenario=scenario, truth=truth, noise_units=0.0)
                ]
            )
            for truth in accuracy.HELD_OUT
        }
        worst = max(rms, key=lambda truth: rms[truth])
        name = f"default model on foam in no model's family, {scenario}, on {worst}, kPa RMS"
        lines.append(goal(name, rms[worst], must, aim))
    fitted = accuracy.FITTED_FOAM.name
    floor = [
        row["rms_kpa"]
        for row in select(report["rows"], model="perfect", scenario=fitted)
        if _is_judged(row) and row["noise_units"] > 0.0
    ]
    name = (
        f"with 0.4 units of noise and 8-bit steps, {accuracy.NOISE_DRAWS} draws of the noise, "
        f"worst truth and history (a perfect model: {max(floor):.2f}), kPa RMS"
    )
    lines.append(goal(name, worst_of_draws(report["noise_draws"]), 1.1, 0.9))
    growth, last = growth_of_error(select(report["cycles"], model=default["model"]))
    lines.append(goal(f"growth of the error from cycle 100 to {last:,}, kPa", growth, 0.0, 0.0))
    for hz in NOISE_HZ:
        (row,) = select(report["false_touches"], noise_units=None, hz=hz, votes=2)
        name = f"false touches per taxel-hour, noise as measured on real skin, {hz:g} Hz"
        lines.append(goal(name, row["touches_per_taxel_hour"], 0.01, 0.0))
    for noise, must, aim in ((0.4, 0.01, 0.0), (1.0, 1.0, 0.1)):
        (row,) = select(report["false_touches"], noise_units=noise, votes=2)
        name = f"false touches per taxel-hour at {noise} units of white noise"
        lines.append(goal(name, row["touches_per_taxel_hour"], must, aim))
    lines += _hold_goals(report["holds"])
    lines += report["hard_cases"]
    for touched in (0, 12):
        (row,) = select(report["pipeline"], taxels=1920, touched=touched, pressures_wanted=True)
        name = f"pipeline from bytes to kPa, 1920 taxels, {touched} touched, ns per taxel-step"
        lines.append(goal(name, row["ns_per_taxel_step"], 9.0, 3.0))
    name = "pipeline, pads with own curves against equation (1), both with the foam's memory"
    ratio = max(
        _cost_of_own_curves(report, touched, speed.EQUATION_1_AND_MEMORY) for touched in (0, 12)
    )
    lines.append(goal(name, ratio, 1.1, 1.0))
    (line,) = select(report["summary"], **default)
    name = f"default relaxation alone, 1920 taxels, {line['dtype']}, ns per taxel-step"
    lines.append(goal(name, line["ns_per_taxel_step"], 2.0, 1.0))
    return lines


#: Of the default model, worst of the truths in no family: (scenario, must, aim) in kPa.
SCENARIO_GOALS = (
    ("fitted", 0.5, 0.3),
    ("temperature", 0.8, 0.5),
    ("spread of losses", 1.2, 0.8),
    ("spread of losses and curves", 1.2, 0.8),
    ("not fitted", 2.0, 1.0),
    ("not fitted, 15 % of loss", 2.0, 1.0),
    ("not fitted, 40 % of loss", 2.0, 1.0),
)


def _cost_of_own_curves(report: Report, touched: int, against: str) -> float:
    """The cost of a pipeline with own curves, as a multiple of another's."""
    own, other = (
        select(report["own_curves"], touched=touched, curve=curve)[0]["ns_per_taxel_step"]
        for curve in (speed.OWN_CURVES, against)
    )
    return float(own / other)


def _hold_goals(holds: list[Row]) -> list[Row]:
    """Long holds: is a touch reported after it has ended, and is 8 h of drift bounded."""
    lines = []
    worst = max(row["ghost_s_per_taxel"] for row in select(holds, all_pressed=False))
    lines.append(goal("false contact after long holds, neighbours untouched, s", worst, 3.0, 0.0))
    worst = max(row["ghost_s_per_taxel"] for row in select(holds, all_pressed=True, hold_s=600.0))
    name = "false contact after 10 min, the whole part pressed, s"
    lines.append(goal(name, worst, 3.0, 0.0))
    long = select(holds, all_pressed=True, case=touching.LONGEST_CASE)
    if long:
        name = "8 h, the whole part pressed, drift of 0.001 units/s: "
        ghost = max(row["ghost_s_per_taxel"] for row in long)
        lines.append(goal(f"{name}false contact after it, s", ghost, 3.0, 0.0))
        error = max(abs(row["end_of_hold_error_kpa"]) for row in long)
        lines.append(goal(f"{name}error at its end, kPa", error, 5.0, 2.0))
    return lines


def select(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Rows whose fields have these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def describe(report: Report) -> str:
    """Real skin, the goals and the summary as text for a terminal."""
    head, rows = tables.summary(report)
    lines = [real.describe(report["real_skin"]), "", as_text(head, rows), ""]
    lines += [f"{line[0]}: {' '.join(line[1:4])}: {line[4]}" for line in tables.goals(report)[1]]
    lines.append(f"in {report['seconds']} s on {report['machine']['processor']}")
    return "\n".join(lines)


def worst_of_draws(rows: list[Row]) -> float:
    """The RMS error over all draws of the noise, in kPa, on the worst truth and history."""
    return max(_rms(values) for values in accuracy.by_history(rows).values())


def growth_of_error(cycles: list[Row]) -> tuple[float, int]:
    """How much the size of a model's error grows from cycle 100 to the last, at worst.

    Returns:
        The growth on the worst truth in kPa, below 0 if it shrinks; and which cycle was its last.
    """
    growths = []
    for truth in sorted({row["truth"] for row in cycles}):
        mine = {
            row["cycles"]: abs(row["unclamped_error_kpa"]) for row in select(cycles, truth=truth)
        }
        last = max(mine)
        growths.append((float(mine[last] - mine[100]), last))
    return max(growths)


def cycle_evidence(report: Report) -> list[Row]:
    """Why the default's error moves between cycle 100 and the last, a row for each truth.

    The truth's own relaxation at both, the error at both, and what changes after SETTLED.
    """
    rows = []
    for truth in dict.fromkeys(row["truth"] for row in report["cycles"]):
        cycles = select(report["cycles"], truth=truth)
        last = max(row["cycles"] for row in cycles)
        model = report["default"]["model"]
        true = [_lost(cycles, cycle, accuracy.PERFECT.model) for cycle in (100, last)]
        mine = [_lost(cycles, cycle, model) for cycle in (100, last)]
        settled = abs(_lost(cycles, SETTLED, model) - mine[1]) if last > SETTLED else None
        rows.append(
            {
                "truth": truth,
                "last_cycle": last,
                "true_relaxation_kpa": true,
                "error_kpa": [its - own for its, own in zip(true, mine, strict=True)],
                "change_since_settled_kpa": settled,
            }
        )
    return rows


def _lost(cycles: list[Row], cycle: int, model: str) -> float:
    """Relaxation at the end of the press of a cycle."""
    (row,) = select(cycles, cycles=cycle, model=model)
    relaxation: float = row["relaxation_kpa"]
    return relaxation


def _is_judged(row: Row) -> bool:
    return row["history"] in accuracy.JUDGED_HISTORIES and row["truth"] in accuracy.HELD_OUT


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def localization(presses: int) -> list[Row]:
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


def key_of(variant: Variant) -> Row:
    return {"model": variant.model, "update_s": variant.update_s}
