"""`skin report`: the table of speed against error, and what else a skin engineer asks.

One command works everything out anew: truths and seeds are fixed, fits are made on the
spot. What is timed is timed in the same run as a copy of the same numbers in memory.
"""

import os
import platform
import sys
import time
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.evaluation import accuracy, page, speed, touching
from skin_host.evaluation.accuracy import Plan
from skin_host.evaluation.localization_trials import Case, errors, localizer_for
from skin_host.processing.relaxation import MODELS
from skin_host.settings import Relaxation

Row = dict[str, Any]
Report = dict[str, Any]

SCHEMA = "skin.report/1"
#: The histories and truths that the goals name.
JUDGED_HISTORIES = ("nine_steps", "multistep", "grasps", "cycling")
JUDGED_TRUTHS = ("A", "S")
PROBES_MM = (3.0, 6.0, 10.0)
FITTED = tuple(model for model in MODELS if model != "none")
#: What the pipeline runs unless it is configured otherwise: states once a second in float32.
DEFAULT: Row = {
    "model": Relaxation().model,
    "update_s": Relaxation().update_s,
    "dtype": "float32" if Relaxation().update_s > 0.0 else "float64",
}


def run(quick: bool, output: Path | None) -> Report:
    """Work out the report, and write it to a folder if one is given.

    Args:
        quick: shorter histories at 5 Hz and two truths, within a minute.
        output: folder for report.json, report.html, accuracy.md and the plots; needs
            matplotlib.

    Raises:
        OSError: the folder cannot be written.
    """
    plan = Plan(("A", "S"), 0.25, 5.0, 2) if quick else Plan()
    clock = _Clock()
    clock.tell("models on truths")
    rows, fits = accuracy.score(plan)
    clock.tell("cycles")
    cycles = accuracy.cycles(
        plan,
        10_000 if quick else 100_000,
        ("published", DEFAULT["model"]) if quick else FITTED,
    )
    clock.tell("speed of models")
    timed = speed.models(0.02 if quick else 0.15)
    clock.tell("speed of the pipeline")
    pipeline = speed.pipeline(0.1 if quick else 0.6)
    clock.tell("unwatched parts")
    glancing = speed.cost_of_glancing(30.0 if quick else 300.0)
    clock.tell("false touches")
    false_touches = touching.false_touches(*((0.02, (1, 2)) if quick else (0.5, (1, 2, 3))))
    clock.tell("delays")
    detection = touching.detection_delays()
    clock.tell("drift")
    drift = touching.drift_lags(1.0 if quick else 10.0)
    clock.tell("long holds")
    holds = touching.long_holds(quick)
    clock.tell("localisation")
    localization = _localization(50 if quick else 400)
    clock.tell("")
    report: Report = {
        "schema": SCHEMA,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "quick": quick,
        "default": DEFAULT,
        "rows": rows,
        "fits": fits,
        "cycles": cycles,
        "speed": timed,
        "pipeline": pipeline,
        "unwatched": glancing,
        "false_touches": false_touches,
        "detection": detection,
        "drift": drift,
        "holds": holds,
        "localization": localization,
    }
    report["summary"] = summary(report)
    report["goals"] = goals(report)
    report["seconds_of"] = clock.seconds_of
    report["seconds"] = round(sum(clock.seconds_of.values()), 1)
    if output is not None:
        page.write(report, output)
    return report


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
        key = {"model": variant.model, "update_s": variant.update_s, "dtype": variant.dtype}
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
    growth = _growth(select(report["cycles"], model=default["model"]))
    lines.append(_goal("growth of the error from cycle 1e2 to the last, kPa", growth, 0.1, 0.0))
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


def _growth(cycles: list[Row]) -> float:
    """Largest growth of the error from cycle 100 to the last, over the truths."""
    worst = 0.0
    for truth in {row["truth"] for row in cycles}:
        mine = {
            row["cycles"]: abs(row["unclamped_error_kpa"]) for row in select(cycles, truth=truth)
        }
        worst = max(worst, mine[max(mine)] - mine[100])
    return worst


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


class _Clock:
    """Tells on a terminal what is being worked out, and how long each thing took."""

    def __init__(self) -> None:
        self.seconds_of: dict[str, float] = {}
        self._what = ""
        self._since_s = 0.0

    def tell(self, what: str) -> None:
        now_s = time.perf_counter()
        if self._what:
            self.seconds_of[self._what] = round(now_s - self._since_s, 1)
        self._what, self._since_s = what, now_s
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
