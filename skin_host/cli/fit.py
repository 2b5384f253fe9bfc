"""`skin calibrate` from recordings: the foam's relaxation, the pressure curve of each taxel."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from skin_host.cli.common import Progress, load_skin, print_json
from skin_host.errors import RequestError
from skin_host.relaxation_settings import FITTED

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from skin_host import fit_recording
    from skin_host.layout import Layout
    from skin_host.processing.fitting import Fit, HoldRecord
    from skin_host.settings import Settings


def add_arguments(calibrate: argparse.ArgumentParser) -> None:
    """The options of `skin calibrate` that work on a recording in place of the skin."""
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
        help="fit each taxel's pressure curve to recorded levels of uniform pressure",
    )
    calibrate.add_argument(
        "--model", choices=FITTED, default=None, help="with --relaxation: keep this one's fit"
    )
    calibrate.add_argument(
        "--load",
        type=Path,
        metavar="CSV",
        help="with --relaxation: the load cell, lines of time in s and pressure in kPa",
    )
    calibrate.add_argument(
        "--weight-kpa",
        type=float,
        metavar="P",
        help="with --relaxation: a dead weight of this pressure was laid on and taken off",
    )
    calibrate.add_argument(
        "--levels",
        type=float,
        nargs="+",
        metavar="KPA",
        help="with --pressure: the known pressures in the order in which they were given",
    )


def run(arguments: argparse.Namespace) -> int:
    """Fit what was asked for and keep it."""
    return _relaxation(arguments) if arguments.relaxation is not None else _pressure(arguments)


def _relaxation(arguments: argparse.Namespace) -> int:
    from skin_host import fit_recording
    from skin_host.processing.pressure import PressureCurve

    settings, layout = load_skin(arguments.config)
    load = None if arguments.load is None else _read_load(arguments.load)
    if load is not None and arguments.weight_kpa is not None:
        raise RequestError("--load and --weight-kpa exclude each other")
    model = arguments.model or settings.processing.relaxation.model
    if model == "none":
        raise RequestError('the configured model is "none"; say which to fit with --model')
    samples = _read_samples(arguments.relaxation, settings, layout, arguments.seconds)
    pressure = settings.processing.pressure
    curve = PressureCurve(
        layout.unit_ff / layout.sensitivity, 1.0, pressure.a_kpa_per_ff2, pressure.b_kpa_per_ff
    )
    record = fit_recording.hold_record(samples, curve, load, arguments.weight_kpa)
    # With and without bleed the published model has the same parameters.
    models = [name for name in FITTED if name != "published_bleed" or name == model]
    fits = fit_recording.fit_relaxation(record, models)
    (chosen,) = [found for found in fits if found.model == model]
    path = arguments.output or arguments.config.with_suffix(".relaxation.json")
    fit_recording.save_relaxation(path, chosen, settings, record)
    if arguments.json:
        print_json(
            {
                "file": str(path),
                "model": model,
                "hold_s": record.hold_s,
                "rest_s": record.rest_s,
                "level_kpa": record.level_kpa,
                "unit_rms_kpa": record.unit_rms_kpa,
                "fits": [_as_record(found) for found in fits],
                "remarks": list(chosen.remarks),
            }
        )
    else:
        print(_describe(fits, model, record))
        print(f'kept in {path}; to use it: [processing.relaxation] file = "{path.name}"')
    return 0


def _pressure(arguments: argparse.Namespace) -> int:
    from skin_host import fit_recording
    from skin_host.calibrate import calibration_path
    from skin_host.processing import calibration as calibrations

    if not arguments.levels or min(arguments.levels) <= 0.0:
        raise RequestError("--pressure needs --levels: the known pressures in kPa, above 0")
    settings, layout = load_skin(arguments.config)
    samples = _read_samples(arguments.pressure, settings, layout, arguments.seconds)
    found, fit = fit_recording.fit_pressures(samples, settings, layout, arguments.levels)
    path = arguments.output or calibration_path(settings, arguments.node)
    calibrations.save(path, found, layout)
    counts = {
        "fitted": int(fit.fitted.sum()),
        "bent": int(fit.bent.sum()),
        "not_fitted": int((samples.usable & ~fit.fitted).sum()),
    }
    if arguments.json:
        print_json(
            {
                "file": str(path),
                "id": found.id,
                **counts,
                "rms_before_kpa": fit.rms_before_kpa,
                "rms_after_kpa": fit.rms_after_kpa,
            }
        )
        return 0
    gains = fit.gain[fit.fitted]
    print(
        f"{counts['fitted']} taxels fitted, {counts['bent']} of them with a bend of their own, "
        f"{counts['not_fitted']} could not be"
    )
    if len(gains):
        print(
            f"gains {gains.min():.2f} to {gains.max():.2f}, "
            f"error {fit.rms_before_kpa:.2f} -> {fit.rms_after_kpa:.2f} kPa RMS"
        )
    print(f"calibration {found.id} kept in {path}")
    return 0


def _read_samples(
    log: Path, settings: "Settings", layout: "Layout", seconds: float
) -> "fit_recording.Samples":
    from skin_host.fit_recording import read_samples

    progress = Progress(f"reading {log.name}")
    try:
        return read_samples(
            log,
            settings,
            layout,
            seconds,
            lambda minutes: progress.update(0.0, f"{minutes:.0f} min"),
        )
    finally:
        progress.close()


def _read_load(path: Path) -> tuple["NDArray[np.float64]", "NDArray[np.float64]"]:
    import numpy as np

    wanted = "rising times in s and pressures in kPa, parted by commas"
    try:
        table = np.loadtxt(path, delimiter=",", ndmin=2, comments=("#", "t"))
    except OSError as error:
        raise RequestError(f"{path}: {error.strerror}; wanted {wanted}") from None
    except ValueError as error:
        raise RequestError(f"{path}: {error}; wanted {wanted}") from None
    if table.shape[1] != 2 or len(table) < 2 or np.any(np.diff(table[:, 0]) <= 0.0):
        raise RequestError(
            f"{path}: {table.shape[0]} lines of {table.shape[1]} numbers; wanted {wanted}"
        )
    return table[:, 0], table[:, 1]


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


def _as_record(found: "Fit") -> dict[str, object]:
    return {
        "model": found.model,
        "rms_hold_kpa": _number(found.rms_hold_kpa),
        "rms_rest_kpa": _number(found.rms_rest_kpa),
        "uncertain": found.uncertain,
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
