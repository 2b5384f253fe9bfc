"""The tables of the report: a head, and rows of cells as they are printed."""

from typing import Any

from skin_host.evaluation.accuracy import (
    FAMILY,
    FITTED_FOAM,
    HELD_OUT,
    HINDSIGHT,
    JUDGED_HISTORIES,
    NOISE_DRAWS,
    NOISE_UNITS,
    PERFECT,
    SCENARIOS,
    VARIANTS,
    Variant,
    by_history,
)
from skin_host.evaluation.document import Table
from skin_host.evaluation.histories import HISTORIES

#: RMSE of a pad over a recording, then over usable pads; RMS of the mean over usable pads.
ERRORS_KPA = ("median_rmse_kpa", "p95_rmse_kpa", "skin_rms_kpa")

Row = dict[str, Any]
Report = dict[str, Any]

IN_COMMON = {"law": "its law", "cause": "a cause", "none": "nothing"}


def real(document: Report) -> Table:
    """What was measured on recordings of real skin, and below it what others reach."""
    head = ["recording", "live", "usable", "false begins in 10 s", "at 60 kPa", "at 40 kPa"]
    head += ["begins a pad", "touched 10 s after", "median kPa", "95 % kPa", "mean of the skin kPa"]
    head += ["worst pad kPa", "off by 60 kPa", "valid", "off by 60 kPa, all calibrated"]
    head += ["lag s", "with it: median", "95 %", "mean"]
    head += ["rate", "with both: median", "95 %", "mean"]
    rows = [
        [
            row["recording"],
            str(row["pads_live"]),
            str(row["pads_usable"]),
            str(row["touches_begun_10s"]),
            _number(row["detected_60kpa"], "{:.1%}"),
            _number(row["detected_40kpa"], "{:.1%}"),
            _number(row["begins_per_pad"], "{:.2f}"),
            _number(row["pads_touched_afterwards"], "{:d}"),
            *(_number(row[name], "{:.1f}") for name in ERRORS_KPA),
            _number(row["worst_rmse_kpa"], "{:.1f}"),
            _number(row["far_share"], "{:.2%}"),
            _number(row["valid_share"], "{:.1%}"),
            _number(row["calibrated_far_share"], "{:.2%}"),
            _number(row["lag_s"], "{:.2f}"),
            *(_number(row[f"lagged_{name}"], "{:.1f}") for name in ERRORS_KPA),
            _number(row["rate"], "{:+.1%}"),
            *(_number(row[f"rated_{name}"], "{:.1f}") for name in ERRORS_KPA),
        ]
        for row in document["real"]
    ]
    return head, rows


def hindsight(document: Report) -> Table:
    """What the best possible estimators reach that know something of the true pressure."""
    rows = [
        [
            row["recording"],
            _number(row["zero_kpa"], "{:.1f}"),
            best["known"],
            *(_number(best[name], "{:.1f}") for name in ERRORS_KPA),
        ]
        for row in document["real"]
        for best in row["hindsight"] or ()
    ]
    head = ["recording", "kPa at its zero", "known beside the calibration"]
    return [*head, "median kPa", "95 % kPa", "mean of the skin kPa"], rows


def emulated(document: Report) -> Table:
    """Emulated pads beside recorded ones."""
    rows = [
        [row["figure"], row["unit"], _number(row["recorded"], "{:.2f}"), f"{row['emulated']:.2f}"]
        for row in document["emulated"]
    ]
    return ["figure", "unit", "recorded", "emulated"], rows


def published(document: Report) -> Table:
    """What others reach on the same recordings."""
    rows = [
        [
            row["method"],
            row["recording"],
            str(row["pads"]),
            f"{row['median_rmse_kpa']:.1f}",
            f"{row['p95_rmse_kpa']:.1f}",
            row["source"],
        ]
        for row in document["published"]
    ]
    return ["method", "recording", "pads", "median kPa", "95 % kPa", "source"], rows


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def summary(report: Report) -> Table:
    """Error and cost of each variant, the Pareto front starred."""
    names = [scenario.name for scenario in SCENARIOS]
    head = ["model", "states", "type", *names, "worst RMS", "with noise", "ns", "bytes", ""]
    rows = [
        [
            line["model"],
            _states(line["update_s"]),
            line["dtype"],
            *(_number(line["scenarios"].get(name), "{:.2f}") for name in names),
            f"{line['worst_rms_kpa']:.2f}",
            f"{line['noisy_rms_kpa']:.2f}",
            f"{line['ns_per_taxel_step']:.2f}",
            str(line["bytes_per_taxel"]),
            "*" if line["pareto"] else "",
        ]
        for line in report["summary"]
    ]
    return head, rows


def goals(report: Report) -> Table:
    """Return the goals and the measured values."""
    rows = [
        [
            goal["figure"],
            "not measured" if goal["measured"] is None else f"{goal['measured']:.3g}",
            f"{'at least ' if goal['at_least'] else ''}{goal['must']:g}",
            f"{goal['aim']:g}",
            "aim reached" if goal["aim_reached"] else "reached" if goal["reached"] else "missed",
        ]
        for goal in report["goals"]
    ]
    return ["figure", "measured", "must", "aim", ""], rows


def errors(report: Report, noise: float, measure: str) -> Table:
    """One measure of the errors of all variants on all truths and histories, foam as fitted."""
    truths = _truths(report)
    histories = [name for name in HISTORIES if measure != "rest_rms_kpa" or name != "walk"]
    head = ["model", "states"] + [f"{truth} {name}" for truth in truths for name in histories]
    found = {
        (row["model"], row["update_s"], row["truth"], row["history"]): row[measure]
        for row in report["rows"]
        if row["noise_units"] == noise and row["scenario"] == FITTED_FOAM.name
    }
    rows = []
    for variant in (PERFECT, *VARIANTS):
        cells = [
            found.get((variant.model, variant.update_s, truth, name))
            for truth in truths
            for name in histories
        ]
        numbers = ["" if cell is None else f"{cell:.2f}" for cell in cells]
        rows.append([variant.model, _states(variant.update_s), *numbers])
    return head, rows


def noise_draws(report: Report) -> Table:
    """Errors of real readings with each draw of the noise, the default on foam as fitted."""
    rows = [
        [truth, history, *(f"{value:.2f}" for value in values)]
        for (truth, history), values in by_history(report["noise_draws"]).items()
    ]
    return ["truth", "history", *(f"draw {number + 1}" for number in range(NOISE_DRAWS))], rows


def family(report: Report) -> Table:
    """RMS over the judged histories on each truth, and what model and truth have in common."""
    truths = _truths(report)
    rows = []
    for variant in VARIANTS:
        cells = []
        for truth in truths:
            cells += [
                f"{_rms(report, variant, truth):.2f}",
                IN_COMMON[FAMILY[variant.model][truth]],
            ]
        rows.append([variant.model, _states(variant.update_s), *cells])
    head = ["model", "states"]
    for truth in truths:
        head += [f"{truth}: kPa RMS", "shares"]
    return head, rows


def _truths(report: Report) -> list[str]:
    return list(dict.fromkeys(row["truth"] for row in report["rows"]))


def _rms(report: Report, variant: Variant, *truths: str) -> float:
    """RMS over the judged histories on some truths, exact readings, foam as fitted."""
    squares = [
        row["rms_kpa"] ** 2
        for row in report["rows"]
        if (row["model"], row["update_s"]) == (variant.model, variant.update_s)
        and row["truth"] in truths
        and row["scenario"] == FITTED_FOAM.name
        and row["noise_units"] == 0.0
        and row["history"] in JUDGED_HISTORIES
    ]
    return float((sum(squares) / len(squares)) ** 0.5)


def scenarios(report: Report) -> Table:
    """What the default leaves on each truth that no model is kin to, foam by foam."""
    default = report["default"]
    truths = [truth for truth in _truths(report) if truth in HELD_OUT]
    rows = []
    for scenario in SCENARIOS:
        for truth in truths:
            mine = [
                row
                for row in report["rows"]
                if row["truth"] == truth and row["scenario"] == scenario.name
            ]
            cells = [scenario.name, truth]
            none, perfect = {"model": "none", "update_s": 1.0}, {"model": PERFECT.model}
            for key in (default, none, perfect, {"model": HINDSIGHT.model}):
                for noise in (0.0, NOISE_UNITS):
                    found = [
                        row["rms_kpa"] ** 2
                        for row in mine
                        if all(row[name] == value for name, value in key.items())
                        and row["noise_units"] == noise
                        and row["history"] in JUDGED_HISTORIES
                    ]
                    if found:
                        cells.append(f"{(sum(found) / len(found)) ** 0.5:.2f}")
            rows.append(cells)
    head = ["foam", "truth", "default", "with noise", "no model", "with noise"]
    return [*head, "perfect model", "with noise", "best factor a pad"], rows


def cycles(report: Report) -> Table:
    """Errors after ever more cycles; first the relaxation of the truths themselves."""
    marks = sorted({row["cycles"] for row in report["cycles"]})
    found: dict[tuple[str, str], dict[int, float]] = {}
    for row in report["cycles"]:
        true = row["model"] == PERFECT.model
        value = row["relaxation_kpa"] if true else row["unclamped_error_kpa"]
        found.setdefault((row["truth"], row["model"]), {})[row["cycles"]] = value
    rows = [
        [truth, "relaxation of the truth" if model == PERFECT.model else model]
        + [f"{values[mark]:.2f}" if mark in values else "" for mark in marks]
        for (truth, model), values in found.items()
    ]
    return ["truth", "model"] + [f"{mark:,}" for mark in marks], rows


def cycle_evidence(report: Report) -> Table:
    """Why the default's error moves with the cycles."""
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
                _number(row["change_since_settled_kpa"], "{:.4f}"),
            ]
        )
    head = ["truth", "last cycle", "relaxation of the truth, 100 to last", "error", "share of it"]
    return [*head, "change after 10,000"], rows


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


def own_curves(report: Report) -> Table:
    """Cost of the whole pipeline with curves of the pads' own."""
    return _by_columns(
        report["own_curves"],
        {
            "pressure by": ("curve", ""),
            "taxels": ("taxels", ","),
            "touched": ("touched", ","),
            "ns per taxel-step": ("ns_per_taxel_step", ".2f"),
        },
    )


def false_touches(report: Report) -> Table:
    """False touches against white noise and votes."""
    white = [row for row in report["false_touches"] if row["noise_units"] is not None]
    votes = sorted({row["votes"] for row in white})
    rows = []
    for noise in sorted({row["noise_units"] for row in white}):
        mine = {row["votes"]: row for row in white if row["noise_units"] == noise}
        rows.append(
            [f"{noise:g}"]
            + [f"{mine[vote]['touches_per_taxel_hour']:.3g}" for vote in votes]
            + [f"{mine[votes[0]]['taxel_hours']:.0f}"]
        )
    return ["noise"] + [f"{vote} of 3" for vote in votes] + ["taxel-hours"], rows


def measured_noise(report: Report) -> Table:
    """False touches with noise as it was measured on real skin, by rate."""
    return _by_columns(
        [row for row in report["false_touches"] if row["noise_units"] is None],
        {
            "sweeps a second": ("hz", "g"),
            "touches begun per taxel-hour": ("touches_per_taxel_hour", ".3g"),
            "touched samples per taxel-hour": ("samples_per_taxel_hour", ".3g"),
            "usable taxels": ("usable_share", ".1%"),
            "taxel-hours": ("taxel_hours", ".0f"),
        },
    )


def detection(report: Report) -> Table:
    """Delays against the height of a press."""
    return _by_columns(
        report["detection"],
        {
            "units": ("height_units", "g"),
            "kPa": ("height_kpa", ".1f"),
            "reported within 2 s": ("told_within_2_s", ".2f"),
            "median sweeps": ("median_sweeps", "g"),
            "95 % within sweeps": ("p95_sweeps", "g"),
        },
    )


def drift(report: Report) -> Table:
    """Lag of the baselines against the rate of drift."""
    return _by_columns(
        report["drift"],
        {
            "rule": ("rule", ""),
            "units per s": ("rate_units_per_s", "g"),
            "lag, units": ("lag_units", ".2f"),
            "share reported as touched": ("touched_share", ".2g"),
        },
    )


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
        "reported",
        "RMS kPa",
        "error at end",
        "false contact s",
        "rest RMS kPa",
    ]
    return head, rows


def localization(report: Report) -> Table:
    """Errors of place against the size of the probe."""
    return _by_columns(
        report["localization"],
        {
            "method": ("method", ""),
            "probe mm": ("probe_mm", "g"),
            "RMS mm": ("rms_mm", ".2f"),
            "95 % within mm": ("p95_mm", ".2f"),
        },
    )


def force(report: Report) -> Table:
    """Reported over true force against the size of the probe and its place."""
    return _by_columns(
        report["force"],
        {
            "kind": ("kind", ""),
            "place": ("where", ""),
            "probe mm": ("probe_mm", "g"),
            "true N": ("true_n", ".2f"),
            "median": ("median_ratio", ".2f"),
            "mean": ("mean_ratio", ".2f"),
            "5 %": ("p5_ratio", ".2f"),
            "95 %": ("p95_ratio", ".2f"),
            "no contact": ("unseen_share", ".0%"),
            "centroid, RMS mm": ("centroid_rms_mm", ".2f"),
        },
    )


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
            " ".join(row["uncertain"]),
        ]
        for row in report["fits"]
    ]
    head = ["model", "truth", "RMS hold / rest", "beta", "tau s", "beta unload", "tau unload s"]
    return [*head, "not known"], rows


def _by_columns(rows: list[Row], columns: dict[str, tuple[str, str]]) -> Table:
    """A line for each row: under each heading a key's value in a format, nothing for None."""
    return list(columns), [
        ["" if row[key] is None else format(row[key], form) for key, form in columns.values()]
        for row in rows
    ]


def _states(update_s: float) -> str:
    return "every sample" if update_s == 0.0 else f"every {update_s:g} s"
