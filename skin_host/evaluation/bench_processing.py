"""`skin bench processing`: bytes to kPa, every relaxation model, and frames to events."""

from typing import Any

from skin_host.evaluation import frames_to_events, speed
from skin_host.evaluation.machine import machine

Row = dict[str, Any]


def run(*, quick: bool = False) -> dict[str, Any]:
    """Time the models alone, the pipeline, and everything from frames to events.

    Returns:
        `machine`, and rows: `models` and `pipeline`, each with its ratio to a copy of as many
        numbers in memory, timed in the same run; and `frames_to_events`.
    """
    models = speed.models(0.02 if quick else 0.2)
    pipeline = speed.pipeline(0.1 if quick else 1.0)
    whole = frames_to_events.measure(5.0 if quick else 20.0)
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
