"""The file that keeps a calibration: JSON, schema skin.calibration/1."""

import math
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from skin_host.config.settings import TouchSettings
from skin_host.errors import CalibrationError, OtherSkinError, visible
from skin_host.files import read_document, write_document
from skin_host.layout import Layout
from skin_host.processing.calibration import (
    SCALE_UNITS,
    Calibration,
    Floats,
    Verdict,
    Zero,
)
from skin_host.processing.curves import KNOTS_UNITS, Curves, CurveVerdict, Memory, rising
from skin_host.processing.touch import levels

SCHEMA = "skin.calibration/1"
#: Channels of a force/torque board.
CHANNELS = 6

#: Of the numbers of a file. Beyond them a pad would feel nothing, or anything, and be valid.
_BOUNDS = {
    "baseline": (-SCALE_UNITS, SCALE_UNITS),
    "percentile": (-SCALE_UNITS, SCALE_UNITS),
    "noise": (0.0, SCALE_UNITS),
    # Of pads that are not used it may be any, where jumps last.
    "spread": (0.0, 1e6),
    "gain": (0.01, 100.0),
    "bend": (0.01, 100.0),
}
#: A curve reaches at least this much where it was measured; a pad with less would feel nothing.
LEAST_REACH_KPA = 2.0
#: Loads (N, N m), pressures (kPa) and numbers derived from them.
MOST = 1e6
_Label = Annotated[str, msgspec.Meta(max_length=64, pattern=r"^[ -~]*(?!\n)$")]


class _PartFile(msgspec.Struct, forbid_unknown_fields=True):
    baseline: list[float]
    percentile: list[float]
    noise: list[float]
    gain: list[float]
    verdict: list[str]
    #: Files of older versions do not have it.
    bend: list[float] | None = None
    spread: list[float] | None = None


class _ZeroFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    offset: list[float]
    noise: list[float]
    touched: bool = False
    #: Files of older versions do not have it.
    full_scale: list[float] | None = None


class _PartCurves(msgspec.Struct, forbid_unknown_fields=True):
    """Curves of the taxels of one part; null where a taxel has no own curve."""

    kpa: list[list[float] | None]
    beyond_units: list[float | None]
    noise_units: list[float]
    error_kpa: list[float | None]
    verdict: list[str]


class _CurvesFile(msgspec.Struct, forbid_unknown_fields=True):
    #: Activations at which the curves are given.
    units: list[float]
    highest_kpa: float
    lag_s: float
    radius_kpa: list[float]
    weight: list[float]
    parts: dict[str, _PartCurves]


class _File(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    schema: str
    id: _Label
    time: _Label
    robot: str
    configuration: str
    parts: dict[str, _PartFile]
    fingertips: dict[str, _ZeroFile] = {}
    curves: _CurvesFile | None = None


def save_calibration(path: Path, calibration: Calibration, layout: Layout) -> None:
    """Write a calibration file, completely or not at all (JSON, schema skin.calibration/1).

    Raises:
        OSError: it cannot be written.
    """
    parts = {}
    for part in layout.parts:
        mine = slice(part.start, part.stop)
        parts[part.name] = _PartFile(
            baseline=_rounded(calibration.baseline[mine]),
            percentile=_rounded(calibration.percentile[mine]),
            noise=_rounded(calibration.noise[mine]),
            gain=_rounded(calibration.gain[mine]),
            bend=_rounded(calibration.bend[mine]),
            spread=_rounded(calibration.spread[mine]),
            verdict=[Verdict(number).name.lower() for number in calibration.verdict[mine]],
        )
    zeros = {
        # Not rounded, so that it serves for coarse and fine boards.
        name: _ZeroFile(
            zero.offset.tolist(),
            zero.noise.tolist(),
            zero.touched,
            None if zero.full_scale is None else zero.full_scale.tolist(),
        )
        for name, zero in calibration.zeros.items()
    }
    content = _File(
        SCHEMA,
        calibration.id,
        calibration.time,
        layout.robot,
        calibration.configuration,
        parts,
        zeros,
        None if calibration.curves is None else _curves_file(calibration.curves, layout),
    )
    write_document(path, content)


def _curves_file(curves: Curves, layout: Layout) -> _CurvesFile:
    parts = {}
    for part in layout.parts:
        mine = range(part.start, part.stop)
        own = curves.own
        parts[part.name] = _PartCurves(
            kpa=[_rounded(curves.kpa[taxel]) if own[taxel] else None for taxel in mine],
            beyond_units=[_finite(curves.beyond_units[taxel]) for taxel in mine],
            noise_units=_rounded(curves.noise_units[part.start : part.stop]),
            error_kpa=[_finite(curves.error_kpa[taxel]) for taxel in mine],
            verdict=[CurveVerdict(curves.verdict[taxel]).name.lower() for taxel in mine],
        )
    return _CurvesFile(
        KNOTS_UNITS.tolist(),
        curves.highest_kpa,
        curves.lag_s,
        list(curves.memory.radius_kpa),
        list(curves.memory.weight),
        parts,
    )


def _finite(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None


def _rounded(values: Floats) -> list[float]:
    rounded: list[float] = np.round(values, 6).tolist()
    return rounded


def load_calibration(path: Path, layout: Layout, configuration: str) -> Calibration:
    """Read a calibration file of this skin.

    Raises:
        CalibrationError: unreadable, damaged, of another schema, configuration or robot; one
            line that ends with the command that helps.
        NewerFileError: a newer version has written it.
        BusyFileError: another program is writing it.
    """

    def refused(what: str) -> CalibrationError:
        return CalibrationError(f"{path}: {what}; take a new one with: skin calibrate CONFIG")

    content = read_document(path, _File, SCHEMA, "calibration", refused)
    if (content.configuration, content.robot) != (configuration, layout.robot):
        raise OtherSkinError(
            f"{path}: belongs to configuration {content.configuration} "
            f'of robot "{content.robot}", this is {configuration} of robot "{layout.robot}"; '
            "take a new one with: skin calibrate CONFIG"
        )
    n = layout.n_taxels
    names = ("baseline", "percentile", "noise", "spread", "gain", "bend")
    arrays = {name: np.zeros(n) for name in names}
    verdict = np.full(n, Verdict.ABSENT, dtype=np.uint8)
    for part in layout.parts:
        stored = content.parts.get(part.name)
        if stored is None:
            raise refused(f'no part "{part.name}"')
        mine = slice(part.start, part.stop)
        for name, array in arrays.items():
            given = getattr(stored, name)
            if given is None:
                given = stored.noise if name == "spread" else np.ones(part.n_taxels)
            values, (least, most) = np.array(given), _BOUNDS[name]
            wanted = (
                f"parts.{part.name}.{name}: wanted {part.n_taxels} finite numbers "
                f"from {least:g} to {most:g}"
            )
            if len(values) != part.n_taxels:
                raise refused(f"{wanted}, seen {len(values)}")
            wrong = np.flatnonzero(~((values >= least) & (values <= most)))
            if len(wrong):
                raise refused(f"{wanted}, seen {values[wrong[0]]:g} of taxel {wrong[0]}")
            array[mine] = values
        if len(stored.verdict) != part.n_taxels:
            raise refused(
                f"parts.{part.name}.verdict: wanted {part.n_taxels} words, seen "
                f"{len(stored.verdict)}"
            )
        verdict[mine] = _numbers(stored.verdict, Verdict, f"parts.{part.name}.verdict", refused)
        above = arrays["percentile"][mine] - arrays["baseline"][mine]
        decides = levels(above, arrays["spread"][mine], TouchSettings()).decides
        deaf = np.flatnonzero((decides > SCALE_UNITS) & (verdict[mine] < Verdict.STUCK))
        if len(deaf):
            raise refused(
                f"parts.{part.name}: taxel {deaf[0]} has so much noise that it would feel nothing, "
                "and is called usable"
            )
    zeros = {}
    for name, zero in content.fingertips.items():
        offset, noise = np.array(zero.offset), np.array(zero.noise)
        fits = offset.shape == noise.shape == (CHANNELS,)
        if not fits or not (np.abs([offset, noise]) <= MOST).all() or (noise < 0.0).any():
            raise refused(
                f"fingertips.{name}: wanted twice {CHANNELS} finite numbers up to {MOST:g}, "
                "and no noise below 0"
            )
        scale = None if zero.full_scale is None else np.array(zero.full_scale)
        if scale is not None and not (
            scale.shape == (CHANNELS,) and ((scale > 0.0) & (scale <= MOST)).all()
        ):
            raise refused(
                f"fingertips.{name}: wanted {CHANNELS} full scales above 0, up to {MOST:g}"
            )
        zeros[name] = Zero(offset, noise, zero.touched, scale)
    curves = None
    if content.curves is not None:
        curves = _curves_of(content.curves, layout, refused)
    return Calibration(
        content.configuration,
        content.id,
        content.time,
        verdict=verdict,
        zeros=zeros,
        curves=curves,
        unchanged=None,
        damaged=None,
        **arrays,
    )


def _numbers(
    words: list[str],
    kind: type[IntEnum],
    where: str,
    refused: Callable[[str], CalibrationError],
) -> list[int]:
    """Return the verdicts of taxels as numbers; errors are raised through `refused`."""
    known = {verdict.name.lower(): int(verdict) for verdict in kind}
    for taxel, word in enumerate(words):
        if word.lower() not in known:
            raise refused(
                f'{where}: seen "{visible(word[:32])}" of taxel {taxel}, wanted {", ".join(known)}'
            )
    return [known[word.lower()] for word in words]


def find_calibration(path: Path, layout: Layout, configuration: str) -> Calibration | None:
    """Return the calibration of this skin that a file holds; None if it holds none.

    Raises:
        NewerFileError: a newer version has written it; it is not to be replaced.
        BusyFileError: another program is writing it.
    """
    try:
        return load_calibration(path, layout, configuration)
    except CalibrationError:
        return None


def _curves_of(
    content: _CurvesFile, layout: Layout, refused: Callable[[str], CalibrationError]
) -> Curves:
    """Return the curves of a file; errors are raised through `refused`."""
    memory = np.array([*content.radius_kpa, *content.weight])
    lengths_agree = len(content.radius_kpa) == len(content.weight)
    if not lengths_agree or not np.all((memory > 0.0) & (memory <= MOST)):
        raise refused("curves: wanted as many radii as weights, all positive")
    if (taken := math.fsum(content.weight)) >= 1.0:
        raise refused(
            f"curves.weight: they sum to {taken:g}; wanted less than 1, or little is left of a "
            "press"
        )
    if content.units != KNOTS_UNITS.tolist() or not 0.0 < content.highest_kpa <= MOST:
        raise refused("curves.units: not the activations that this version knows")
    n = layout.n_taxels
    kpa = np.zeros((n, len(KNOTS_UNITS)))
    beyond, noise = np.full(n, np.inf), np.zeros(n)
    error = np.full(n, np.nan)
    verdict = np.full(n, CurveVerdict.UNKNOWN, np.uint8)
    for part in layout.parts:
        stored = content.parts.get(part.name)
        where = f"curves.parts.{part.name}"
        if stored is None:
            raise refused(f'curves: no part "{part.name}"')
        if any(len(values) != part.n_taxels for values in msgspec.structs.astuple(stored)):
            raise refused(f"{where}: wanted {part.n_taxels} entries of each kind")
        mine = slice(part.start, part.stop)
        verdict[mine] = _numbers(stored.verdict, CurveVerdict, f"{where}.verdict", refused)
        for taxel, curve in enumerate(stored.kpa, part.start):
            if curve is not None:
                if len(curve) != len(KNOTS_UNITS) or not np.all(np.abs(curve) <= MOST):
                    raise refused(f"{where}.kpa: wanted {len(KNOTS_UNITS)} finite numbers a curve")
                kpa[taxel] = curve
            elif verdict[taxel] == CurveVerdict.GOOD:
                raise refused(f"{where}.kpa: a good taxel without a curve")
        beyond[mine] = [np.inf if units is None else units for units in stored.beyond_units]
        for taxel in np.flatnonzero(verdict[mine] == CurveVerdict.GOOD).tolist():
            own = kpa[part.start + taxel]
            reach_kpa = np.interp(beyond[part.start + taxel], KNOTS_UNITS, own) - own[0]
            if not reach_kpa >= LEAST_REACH_KPA:
                raise refused(
                    f"{where}.kpa: the curve of taxel {taxel} reaches {reach_kpa:g} kPa; wanted "
                    f"{LEAST_REACH_KPA:g} or more"
                )
        error[mine] = [np.nan if kpa is None else kpa for kpa in stored.error_kpa]
        noise[mine] = stored.noise_units
    wild = not np.all((noise >= 0.0) & (noise <= SCALE_UNITS))
    if wild or np.any(np.diff(kpa) < 0.0) or not np.all(beyond > 0.0):
        raise refused("curves: a curve falls, or a noise is negative")
    return Curves(
        rising(kpa),
        beyond,
        noise,
        error,
        verdict,
        content.highest_kpa,
        content.lag_s,
        Memory(tuple(content.radius_kpa), tuple(content.weight)),
    )
