"""`skin calibrate` from recordings: the foam's relaxation, and the pressure curve of each taxel."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skin_host.cli.calibration_file import path_to_write, write
from skin_host.cli.common import Progress, load_skin, positive, print_json, warn
from skin_host.config.relaxation import FITTED
from skin_host.errors import RequestError

if TYPE_CHECKING:
    from skin_host.config.settings import Settings
    from skin_host.layout import Layout
    from skin_host.processing.calibration import Calibration
    from skin_host.processing.curves import Curves
    from skin_host.processing.fitting.course import GainFit
    from skin_host.processing.fitting.hold import Fit, HoldRecord
    from skin_host.recording import fitting


def add_fits(calibrate: argparse.ArgumentParser) -> None:
    """Add the options of `skin calibrate` that work on a recording instead of the skin."""
    log = calibrate.add_mutually_exclusive_group()
    log.add_argument(
        "--relaxation",
        type=Path,
        metavar="LOG",
        help="fit the relaxation models to a recorded hold and release, untouched at first",
    )
    log.add_argument(
        "--pressure",
        type=Path,
        metavar="LOG",
        help="fit each taxel's pressure curve to a recording under uniform pressure, untouched at "
        "first: any course of it, with --load, or a few --levels",
    )
    calibrate.add_argument(
        "--model", choices=FITTED, default=None, help="with --relaxation: keep this one's fit"
    )
    calibrate.add_argument(
        "--load",
        type=Path,
        metavar="CSV",
        help="the known pressure, lines of time in s (of the recording, or from its start) and "
        "kPa: time_s,pressure_kpa",
    )
    calibrate.add_argument(
        "--weight-kpa",
        type=positive,
        metavar="P",
        help="with --relaxation: a dead weight of this pressure was laid on and taken off",
    )
    calibrate.add_argument(
        "--levels",
        type=positive,
        nargs="+",
        metavar="KPA",
        help="with --pressure, without --load: the known pressures in kPa in their order",
    )


def fit(arguments: argparse.Namespace) -> int:
    """Fit what `arguments` ask for, `relaxation` or `pressure`; return the exit status.

    Raises:
        SkinError: a file is wrong, or shows too little.
    """
    return _relaxation(arguments) if arguments.relaxation is not None else _pressure(arguments)


def _relaxation(arguments: argparse.Namespace) -> int:
    from skin_host.config.relaxation import RELAXATION_SCHEMA
    from skin_host.files import refuse_newer, whole_file
    from skin_host.processing.pressure import PressureCurve
    from skin_host.recording import fitting
    from skin_host.recording.load_table import check_course, read_table

    settings, layout = load_skin(arguments.config)
    load = None if arguments.load is None else read_table(arguments.load)
    if load is not None:
        check_course(load)
    model = arguments.model or settings.processing.relaxation.model
    if model == "none":
        raise RequestError('the configured model is "none"; choose one to fit with --model')
    path = arguments.output or arguments.config.with_suffix(".relaxation.json")
    refuse_newer(path, RELAXATION_SCHEMA, "relaxation")
    samples = _read_samples(arguments.relaxation, settings, layout, arguments.seconds)
    pressure = settings.processing.pressure
    curve = PressureCurve(
        layout.unit_ff / layout.sensitivity, 1.0, pressure.a_kpa_per_ff2, pressure.b_kpa_per_ff
    )
    record = fitting.hold_record(samples, curve, load, arguments.weight_kpa)
    fits = fitting.fit_relaxation(record, FITTED)
    (chosen,) = [found for found in fits if found.model == model]
    with whole_file(path) as growing:
        fitting.save_relaxation(growing, chosen, settings, record)
    if arguments.json:
        print_json(
            {
                "file": str(path),
                "model": model,
                "hold_s": record.hold_s,
                "rest_s": record.rest_s,
                "level_kpa": record.level_kpa,
                "unit_rms_kpa": record.unit_rms_kpa,
                "lag_s": None if load is None else record.lag_s,
                "fits": [
                    {
                        "model": found.model,
                        "rms_hold_kpa": fitting.finite(found.rms_hold_kpa),
                        "rms_rest_kpa": fitting.finite(found.rms_rest_kpa),
                        "uncertain": found.uncertain,
                    }
                    for found in fits
                ],
                "remarks": list(chosen.remarks),
            }
        )
    else:
        print(_describe(fits, model, record))
        if load is not None:
            print(f"the table's clock is {record.lag_s:+.2f} s ahead")
        print(f'kept in {path}; to use it: [processing.relaxation] file = "{path.name}"')
    return 0


def _pressure(arguments: argparse.Namespace) -> int:
    from skin_host.config.settings import skin_hash
    from skin_host.daemon.memory import kept_calibration, share_pressures
    from skin_host.processing.calibration.file import find_calibration
    from skin_host.recording import fitting
    from skin_host.recording.load_table import check_course, read_table

    if (arguments.load is None) == (not arguments.levels):
        raise RequestError(
            "--pressure needs --load CSV, the pressure throughout the recording, or --levels, the "
            "steady pressures in kPa in their order; one of the two"
        )
    settings, layout = load_skin(arguments.config)
    path = path_to_write(arguments, settings)
    before = None
    if arguments.output is None:
        before = kept_calibration(settings, layout, arguments.node)
    before = before or find_calibration(path, layout, skin_hash(settings))
    load = None if arguments.load is None else read_table(arguments.load)
    if load is not None:
        check_course(load)
    samples = _read_samples(arguments.pressure, settings, layout, arguments.seconds, before)
    fitted: fitting.Fitted[Any]
    show_fit: Callable[[dict[str, list[int]]], None]
    if load is None:
        fitted = gains = fitting.fit_pressures(samples, settings, layout, arguments.levels, before)
        show_fit = partial(_show_levels, arguments, path, samples, gains)
    else:
        fitted = curves = fitting.fit_curves(samples, settings, layout, load, before)
        show_fit = partial(_show_course, arguments, path, layout, curves)
    write(arguments, path, fitted.calibration, layout)
    shares = []
    if arguments.output is None:
        shares = share_pressures(settings, layout, arguments.node, fitted.calibration)
    show_fit(_kept(fitted, samples, layout, arguments.pressure, path, before))
    if shares and not arguments.json:
        print(f"gains and curves kept for {', '.join(shares)}, too")
    return 0


def _show_levels(
    arguments: argparse.Namespace,
    path: Path,
    samples: "fitting.Samples",
    fitted: "fitting.Fitted[GainFit]",
    kept: dict[str, list[int]],
) -> None:
    found, fit = fitted.calibration, fitted.found
    counts = {
        "fitted": int(fit.fitted.sum()),
        "bent": int(fit.bent.sum()),
        "not_fitted": int((samples.usable & fitted.pressed & ~fit.fitted).sum()),
    }
    if arguments.json:
        print_json(
            {
                "file": str(path),
                "id": found.id,
                **counts,
                "rms_before_kpa": fit.rms_before_kpa,
                "rms_after_kpa": fit.rms_after_kpa,
                "ratio_to_curve": fitted.ratio,
                "kept": kept,
            }
        )
        return
    gains = fit.gain[fit.fitted]
    print(
        f"{counts['fitted']} taxels fitted, {counts['bent']} of them with their own bend, "
        f"{counts['not_fitted']} could not be"
    )
    print(
        f"gains {gains.min():.2f} to {gains.max():.2f}, "
        f"error {fit.rms_before_kpa:.2f} -> {fit.rms_after_kpa:.2f} kPa RMS"
    )
    print(f"calibration {found.id} kept in {path}")


def _show_course(
    arguments: argparse.Namespace,
    path: Path,
    layout: "Layout",
    fitted: "fitting.Fitted[Curves]",
    kept: dict[str, list[int]],
) -> None:
    import numpy as np

    from skin_host.health.diagnosis import named
    from skin_host.processing.curves import CurveVerdict
    from skin_host.recording import fitting

    found, curves = fitted.calibration, fitted.found
    verdicts = curve_verdicts(curves, layout)
    counts = {
        verdict.name.lower(): sum(len(taxels[verdict.name.lower()]) for taxels in verdicts.values())
        for verdict in CurveVerdict
    }
    error = curves.error_kpa[curves.own]
    middle, worst = np.quantile(error, (0.5, 0.95)).tolist() if len(error) else (None, None)
    if arguments.json:
        print_json(
            {
                "file": str(path),
                "id": found.id,
                "lag_s": curves.lag_s,
                "highest_kpa": curves.highest_kpa,
                "ratio_to_curve": fitted.ratio,
                "hysteresis_known": fitted.unloads,
                "hysteresis_kept": fitted.memory_kept,
                "memory": {
                    "radius_kpa": list(curves.memory.radius_kpa),
                    "weight": list(curves.memory.weight),
                },
                "counts": counts,
                "median_error_kpa": middle,
                "p95_error_kpa": worst,
                "parts": {
                    part.name: {
                        "verdict": [
                            CurveVerdict(number).name.lower()
                            for number in curves.verdict[part.start : part.stop]
                        ],
                        "error_kpa": [
                            fitting.finite(float(kpa))
                            for kpa in curves.error_kpa[part.start : part.stop]
                        ],
                    }
                    for part in layout.parts
                },
                "kept": kept,
            }
        )
        return
    plays = ", ".join(
        f"{weight:.2f} within {radius:.0f} kPa"
        for radius, weight in zip(curves.memory.radius_kpa, curves.memory.weight, strict=True)
    )
    print(f"0 to {curves.highest_kpa:.0f} kPa; the table's clock is {curves.lag_s:+.2f} s ahead")
    print(f"{fitted.ratio:.2g} times the pressures of the configured curve")
    whose = f", kept from {path} with curves" if fitted.memory_kept else ""
    print(f"hysteresis of the foam: {plays or ('none' if fitted.unloads else 'not known')}{whose}")
    print(", ".join(f"{count} {name}" for name, count in counts.items() if count))
    if len(error):
        of = "the good" if fitted.unloads else "the good while loading"
        print(f"expected error of {of}: median {middle:.1f} kPa, 95 % below {worst:.1f} kPa")
    for part, taxels in verdicts.items():
        for name, numbers in taxels.items():
            if name not in ("good", "unknown") and numbers:
                print(f"{part}: {name}: {named(numbers)}")
    print(f"calibration {found.id} kept in {path}")


def _kept(
    fitted: "fitting.Fitted[Any]",
    samples: "fitting.Samples",
    layout: "Layout",
    log: Path,
    path: Path,
    before: "Calibration | None",
) -> dict[str, list[int]]:
    """Return by part the pressure taxels that keep what was known of them.

    Warns of them, of pressures that may be in another unit, and of a course that does not unload.
    """
    from skin_host.health.diagnosis import named_by_part
    from skin_host.processing.calibration import by_part
    from skin_host.recording.plausibility import DOUBTFUL_RATIO, describe_ratio

    if fitted.ratio > DOUBTFUL_RATIO:
        warn(f"{log}: {describe_ratio(fitted.ratio)}")
    if not fitted.unloads:
        widest_kpa = max(fitted.found.memory.radius_kpa, default=0.0)
        beyond = f" beyond {widest_kpa:.0f} kPa" if widest_kpa else ""
        warn(
            f"{log}: the pressure does not go down again far enough for a tenth of the time: the "
            f"foam's hysteresis{beyond} is not known, and pressures that go down read too high"
        )

    if before is None:
        what = "they have neither gains nor curves of their own"
    else:
        what = f"they keep zero, gains and curves of {path}"
    unpressed = ~fitted.pressed
    for taxels, why in (
        (unpressed & samples.received, f"not pressed in {log}"),
        (unpressed & ~samples.received, f"not in {log}"),
    ):
        if found := by_part(taxels, layout):
            warn(f"{named_by_part(found)}: {why}; {what}")
    if found := by_part(fitted.unshown, layout):
        warn(
            f"{named_by_part(found)}: moved too little in {log} to show a curve; they keep the one "
            "that they have, if any"
        )
    return by_part(unpressed | fitted.unshown, layout)


def curve_verdicts(curves: "Curves", layout: "Layout") -> dict[str, dict[str, list[int]]]:
    """Numbers of the pressure taxels of each part, by the verdict on their curve."""
    import numpy as np

    from skin_host.layout import PadKind
    from skin_host.processing.curves import CurveVerdict

    pressure = layout.pad_kind == PadKind.PRESSURE
    return {
        part.name: {
            verdict.name.lower(): np.flatnonzero(
                (curves.verdict == verdict)[part.start : part.stop]
                & pressure[part.start : part.stop]
            ).tolist()
            for verdict in CurveVerdict
        }
        for part in layout.parts
    }


def _read_samples(
    log: Path,
    settings: "Settings",
    layout: "Layout",
    seconds: float,
    before: "Calibration | None" = None,
) -> "fitting.Samples":
    """Read a recording, and warn of doubtful zeros in it.

    Taxels that are not in it have another zero if there is a calibration `before`.
    """
    from dataclasses import replace

    import numpy as np

    from skin_host.processing.calibration import Verdict
    from skin_host.recording.fitting import read_samples
    from skin_host.recording.replay import doubts

    progress = Progress(f"reading {log.name}")
    try:
        samples = read_samples(
            log,
            settings,
            layout,
            seconds,
            lambda minutes: progress.update(0.0, f"{minutes:.0f} min"),
        )
    finally:
        progress.close()
    zero = samples.calibration
    if before is not None:
        verdict = np.where(samples.received, zero.verdict, np.uint8(Verdict.OK))
        zero = replace(zero, verdict=verdict)
    for doubt in doubts(zero, settings, layout):
        warn(f"{log}: {doubt}")
    return samples


def _describe(fits: list["Fit"], model: str, record: "HoldRecord") -> str:
    hold = f"hold of {record.hold_s:.0f} s at {record.level_kpa:.0f} kPa"
    lines = [
        f"{hold}, rest of {record.rest_s:.0f} s",
        "model              hold kPa  rest kPa  (RMS)",
    ]
    lines += [
        f"{'>' if found.model == model else ' '} {found.model:<17}"
        f"{found.rms_hold_kpa:>8.2f}  {found.rms_rest_kpa:>8.2f}"
        for found in fits
    ]
    (chosen,) = [found for found in fits if found.model == model]
    lines.append(f"of that, readings in whole units leave up to {record.unit_rms_kpa:.2f} kPa")
    lines += [f"not known from this record: {remark}" for remark in chosen.remarks]
    lines += [
        f"not known from this record: {name}, only within a factor of {factor:g}"
        for name, factor in chosen.uncertain.items()
    ]
    return "\n".join(lines)
