"""The tables of the report: a head, and rows of cells as they are printed."""

from dataclasses import astuple
from typing import Any

from skin_host.evaluation.accuracy import FAMILY, PERFECT, VARIANTS, Variant
from skin_host.evaluation.histories import HISTORIES

Row = dict[str, Any]
Report = dict[str, Any]
Table = tuple[list[str], list[list[str]]]

#: The variants but for their numbers' type.
ALONE = [variant for variant in VARIANTS if variant.dtype == "float64"]
#: What happens to it at every press and release, its plays, is in no model.
STRANGER = "H"
IN_COMMON = {"law": "its law", "cause": "a cause", "none": "nothing"}


def summary(report: Report) -> Table:
    """Error and cost of each variant, the Pareto front starred."""
    head = ["model", "states", "type", "RMS kPa", "worst RMS", "with noise", "ns", "bytes", ""]
    rows = [
        [
            line["model"],
            _states(line["update_s"]),
            line["dtype"],
            f"{line['rms_kpa']:.2f}",
            f"{line['worst_rms_kpa']:.2f}",
            f"{line['noisy_rms_kpa']:.2f}",
            f"{line['ns_per_taxel_step']:.1f}",
            str(line["bytes_per_taxel"]),
            "*" if line["pareto"] else "",
        ]
        for line in report["summary"]
    ]
    return head, rows


def goals(report: Report) -> Table:
    """What was set out to reach, and what was measured."""
    rows = [
        [
            goal["figure"],
            f"{goal['measured']:.3g}",
            f"{goal['must']:g}",
            f"{goal['aim']:g}",
            "aim reached" if goal["aim_reached"] else "reached" if goal["reached"] else "missed",
        ]
        for goal in report["goals"]
    ]
    return ["figure", "measured", "must", "aim", ""], rows


def errors(report: Report, noise: float, measure: str) -> Table:
    """One measure of the errors of all variants on all truths and histories."""
    truths = list(dict.fromkeys(row["truth"] for row in report["rows"]))
    histories = [name for name in HISTORIES if measure != "rest_rms_kpa" or name != "walk"]
    head = ["model", "states"] + [f"{truth} {name}" for truth in truths for name in histories]
    found = {
        (row["model"], row["update_s"], row["dtype"], row["truth"], row["history"]): row[measure]
        for row in report["rows"]
        if row["noise_units"] == noise
    }
    rows = []
    for model, update_s, dtype in [("perfect", 0.0, "float64")] + [
        (variant.model, variant.update_s, variant.dtype) for variant in VARIANTS
    ]:
        if dtype != "float64":
            continue
        cells = [
            found.get((model, update_s, dtype, truth, name))
            for truth in truths
            for name in histories
        ]
        rows.append(
            [model, _states(update_s)] + ["" if cell is None else f"{cell:.2f}" for cell in cells]
        )
    return head, rows


def family(report: Report) -> Table:
    """RMS over the judged histories on each truth, and what model and truth have in common."""
    truths = _truths(report)
    rows = []
    for variant in ALONE:
        cells = []
        for truth in truths:
            cells += [
                f"{_rms(report, variant, truth):.2f}",
                IN_COMMON[FAMILY[variant.model][truth]],
            ]
        overall = f"{_rms(report, variant, *truths):.2f}"
        rows.append([variant.model, _states(variant.update_s), *cells, overall])
    head = ["model", "states"]
    for truth in truths:
        head += [f"{truth}: kPa RMS", "shares"]
    return [*head, "all"], rows


def verdict_of_strangers(report: Report) -> str:
    """In a sentence, how the default stands on the truth that no model is kin to."""
    truths = _truths(report)
    if STRANGER not in truths:
        return f"Truth {STRANGER} is left out of a quick report."
    default = Variant(report["default"]["model"], report["default"]["update_s"])
    others = [variant for variant in ALONE if variant.update_s == default.update_s]
    best = min(others, key=lambda variant: _rms(report, variant, STRANGER))
    said = f"On {STRANGER} the default leaves {_rms(report, default, STRANGER):.2f} kPa RMS"
    if best == default:
        return said + ", less than any other with states as often."
    return said + (
        f" and `{best.model}` {_rms(report, best, STRANGER):.2f}; over all truths it is "
        f"{_rms(report, default, *truths):.2f} and {_rms(report, best, *truths):.2f}."
    )


def _truths(report: Report) -> list[str]:
    return list(dict.fromkeys(row["truth"] for row in report["rows"]))


def _rms(report: Report, variant: Variant, *truths: str) -> float:
    """RMS over the judged histories on some truths, exact readings."""
    squares = [
        row["rms_kpa"] ** 2
        for row in report["rows"]
        if (row["model"], row["update_s"], row["dtype"]) == astuple(variant)
        and row["truth"] in truths
        and row["noise_units"] == 0.0
        and row["history"] not in ("hold", "walk")
    ]
    return float((sum(squares) / len(squares)) ** 0.5)


def cycles(report: Report) -> Table:
    """Errors after ever more cycles; first the relaxation of the truths themselves."""
    marks = sorted({row["cycles"] for row in report["cycles"]})
    found: dict[tuple[Any, ...], dict[int, float]] = {}
    for row in report["cycles"]:
        true = row["model"] == PERFECT.model
        key = (row["truth"], row["model"], row["update_s"], row["dtype"])
        value = row["relaxation_kpa"] if true else row["unclamped_error_kpa"]
        found.setdefault(key, {})[row["cycles"]] = value
    rows = [
        [
            truth,
            "relaxation of the truth" if model == PERFECT.model else model,
            "" if model == PERFECT.model else _states(update_s),
            "" if model == PERFECT.model else dtype,
        ]
        + [f"{values[mark]:.2f}" if mark in values else "" for mark in marks]
        for (truth, model, update_s, dtype), values in found.items()
    ]
    head = ["truth", "model", "states", "type"] + [f"{mark:,}" for mark in marks]
    return head, sorted(rows, key=lambda row: "ASLH".index(row[0]))


def cycle_evidence(report: Report) -> Table:
    """Why the default's error moves with the cycles."""

    def kpa(value: float | None) -> str:
        return "" if value is None else f"{value:.4f}"

    rows = []
    for row in report["cycle_evidence"]:
        true, error = row["true_relaxation_kpa"], row["error_kpa"]
        shares = [100.0 * abs(wrong) / whole for wrong, whole in zip(error, true, strict=True)]
        rows.append(
            [
                row["truth"],
                f"{row['last_cycle']:,}",
                f"{true[0]:.2f} to {true[1]:.2f}",
                f"{error[0]:.3f} to {error[1]:.3f}",
                f"{shares[0]:.1f} to {shares[1]:.1f} %",
                kpa(row["change_since_settled_kpa"]),
                kpa(row["change_by_float32_and_1_hz_kpa"]),
                kpa(row["fits_differ_kpa"]),
                " and ".join(f"{rms:.2f}" for rms in row["fits_rms_kpa"]),
            ]
        )
    head = ["truth", "last cycle", "relaxation of the truth, 100 to last", "error", "share of it"]
    head += ["change after 10,000", "by float32 and 1 Hz", "two equal fits differ", "their RMS"]
    return head, rows


def speed(report: Report) -> Table:
    """ns per taxel-step of each model alone, by type and number of taxels."""
    sizes = sorted({row["taxels"] for row in report["speed"]})
    columns = [(dtype, n) for dtype in ("float64", "float32") for n in sizes]
    found = {
        (row["model"], row["update_s"], row["dtype"], row["taxels"]): row for row in report["speed"]
    }
    rows = []
    for model, update_s in dict.fromkeys(
        (row["model"], row["update_s"]) for row in report["speed"]
    ):
        cells = [
            f"{found[model, update_s, dtype, n]['ns_per_taxel_step']:.2f}" for dtype, n in columns
        ]
        size = found[model, update_s, "float64", sizes[0]]["bytes_per_taxel"]
        rows.append([model, _states(update_s), *cells, str(size)])
    return ["model", "states"] + [f"{dtype} {n:,}" for dtype, n in columns] + ["bytes"], rows


def pipeline(report: Report) -> Table:
    """Cost of the whole pipeline against what is touched."""
    copies = {
        row["taxels"]: row["ns_per_taxel_step"]
        for row in report["speed"]
        if (row["model"], row["dtype"]) == ("memory_copy", "float32")
    }
    rows = [
        [
            f"{row['taxels']:,}",
            f"{row['touched']:,}",
            "yes" if row["pressures_wanted"] else "no",
            f"{row['ns_per_taxel_step']:.2f}",
            f"{row['ns_per_taxel_step'] * row['taxels'] * 1e-3:.1f}",
            f"{row['ns_per_taxel_step'] / copies[row['taxels']]:.0f}",
        ]
        for row in report["pipeline"]
    ]
    head = ["taxels", "touched", "pressures wanted", "ns per taxel-step", "us per sweep", "copies"]
    return head, rows


def false_touches(report: Report) -> Table:
    """False touches against noise and votes."""
    votes = sorted({row["votes"] for row in report["false_touches"]})
    rows = []
    for noise in sorted({row["noise_units"] for row in report["false_touches"]}):
        mine = {row["votes"]: row for row in report["false_touches"] if row["noise_units"] == noise}
        rows.append(
            [f"{noise:g}"]
            + [f"{mine[vote]['touches_per_taxel_hour']:.3g}" for vote in votes]
            + [f"{mine[votes[0]]['taxel_hours']:.0f}"]
        )
    return ["noise"] + [f"{vote} of 3" for vote in votes] + ["taxel-hours"], rows


def detection(report: Report) -> Table:
    """Delays against the height of a press."""
    rows = [
        [
            f"{row['height_units']:g}",
            f"{row['height_kpa']:.1f}",
            f"{row['told_within_2_s']:.2f}",
            "" if row["median_sweeps"] is None else f"{row['median_sweeps']:g}",
            "" if row["p95_sweeps"] is None else f"{row['p95_sweeps']:g}",
        ]
        for row in report["detection"]
    ]
    return ["units", "kPa", "told within 2 s", "median sweeps", "95 % within sweeps"], rows


def drift(report: Report) -> Table:
    """Lag of the baselines against the rate of drift."""
    rows = [
        [
            row["rule"],
            f"{row['rate_units_per_s']:g}",
            f"{row['lag_units']:.2f}",
            f"{row['touched_share']:.2g}",
        ]
        for row in report["drift"]
    ]
    return ["rule", "units per s", "lag, units", "share told as touched"], rows


def holds(report: Report) -> Table:
    """What long holds came to."""
    rows = [
        [
            row["truth"],
            row["case"],
            "all" if row["all_pressed"] else "some",
            f"{row['touched_share_in_hold']:.3f}",
            f"{row['rms_in_hold_kpa']:.2f}",
            f"{row['end_of_hold_error_kpa']:.2f}",
            f"{row['ghost_s_per_taxel']:.2f}",
            f"{row['rest_rms_kpa']:.2f}",
        ]
        for row in report["holds"]
    ]
    head = [
        "truth",
        "case",
        "pressed",
        "told",
        "RMS kPa",
        "error at end",
        "ghost s",
        "rest RMS kPa",
    ]
    return head, rows


def localization(report: Report) -> Table:
    """Errors of place against the size of the probe."""
    rows = [
        [row["method"], f"{row['probe_mm']:g}", f"{row['rms_mm']:.2f}", f"{row['p95_mm']:.2f}"]
        for row in report["localization"]
    ]
    return ["method", "probe mm", "RMS mm", "95 % within mm"], rows


def fits(report: Report) -> Table:
    """The parameters that the fits found."""

    def numbers(values: list[float], digits: int) -> str:
        return " ".join(f"{value:.{digits}f}" for value in values)

    rows = [
        [
            row["model"],
            row["truth"],
            f"{row['rms_hold_kpa']:.2f} / {row['rms_rest_kpa']:.2f}",
            numbers(row["beta"], 3),
            numbers(row["tau_s"], 1),
            numbers(row["beta_unload"], 3) if row["model"].startswith("published") else "",
            numbers(row["tau_unload_s"], 1),
            "" if row["clock_kpa"] is None else f"{row['clock_kpa']:.0f}",
            " ".join(row["uncertain"]),
        ]
        for row in report["fits"]
    ]
    head = ["model", "truth", "RMS hold / rest", "beta", "tau s", "beta unload", "tau unload s"]
    return [*head, "clock kPa", "not known"], rows


def _states(update_s: float) -> str:
    return "every sample" if update_s == 0.0 else f"every {update_s:g} s"
