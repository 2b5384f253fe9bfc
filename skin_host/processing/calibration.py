"""What each taxel reads when nothing touches it, and whether it can be trusted.

The paper (section V-A) takes some seconds of untouched skin and keeps, per taxel, the
mean and the 95th percentile. The readings are bytes, so a histogram of 256 counts holds
all there is to know, at a constant size whatever the length.

An activation is `no_load - raw`: it rises with pressure. All numbers here are in units
of the transmitted byte.
"""

import hashlib
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.errors import CalibrationError, OtherSkinError
from skin_host.files import read_document, write_atomic
from skin_host.layout import Layout, PadKind

SCHEMA = "skin.calibration/1"
#: A taxel with more noise than this is told of; its threshold rises with its noise.
NOISY_UNITS = 1.5
#: With more than this share of its samples at the ends of the scale, a taxel is out of range.
SATURATED_SHARE = 0.05
#: Fewer samples than this say neither where a taxel rests nor how noisy it is.
FEWEST_SAMPLES = 10
#: Samples whose means are compared to see a touch come or go during calibration.
BLOCK = 10
#: A step from sample to sample is a touch that comes or goes, not noise, if it is larger than
#: this and than so many times the median step (four standard deviations).
JUMP_UNITS = 8
JUMP_MEDIANS = 6
#: The means of blocks may differ by this much, and by five standard errors.
STEADY_UNITS = 1.5

#: Of a force/torque board.
CHANNELS = 6

Floats = NDArray[np.float64]


class Verdict(IntEnum):
    """What the calibration says of a taxel. From STUCK on its readings are not used."""

    OK = 0
    NOISY = 1
    TOUCHED = 2
    STUCK = 3
    OUT_OF_RANGE = 4
    ABSENT = 5
    TOO_FEW = 6


@dataclass(frozen=True, slots=True)
class Zero:
    """What an unloaded force/torque board sends: mean and sd, float64[6], N and N m."""

    offset: Floats
    noise: Floats


@dataclass(frozen=True)
class Calibration:
    """The calibration of a whole skin: flat arrays in the order of its layout.

    Attributes:
        configuration: hash of the configuration it belongs to.
        id: identifies the numbers; equal numbers, equal id.
        time: when it was taken, ISO 8601 in UTC.
        baseline: float64[n], mean activation.
        percentile: float64[n], its 95th percentile (or what was asked for).
        noise: float64[n], standard deviation.
        gain: float64[n], pressure of the taxel over that of the common curve.
        bend: float64[n], its quadratic part over that of the common curve, the gain apart.
        verdict: uint8[n], see `Verdict`.
        zeros: of the fingertips on force/torque boards, by name.
    """

    configuration: str
    id: str
    time: str
    baseline: Floats
    percentile: Floats
    noise: Floats
    gain: Floats
    bend: Floats
    verdict: NDArray[np.uint8]
    zeros: dict[str, Zero] = field(default_factory=dict)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which taxels [n] may be believed."""
        return self.verdict < Verdict.STUCK


class Calibrator:
    """Collects sweeps of untouched skin; `finish` turns them into a calibration."""

    def __init__(self, layout: Layout, percentile: float = 0.95) -> None:
        n = layout.n_taxels
        self._layout = layout
        self._percentile = percentile
        self._counts = np.zeros((n, 256), dtype=np.int64)
        self._last = np.full(n, -1, dtype=np.int16)
        self._steps = np.zeros((n, 256), dtype=np.int32)
        self._block_sum = np.zeros(n)
        self._block_count = np.zeros(n, dtype=np.int64)
        self._lowest = np.full(n, np.inf)
        self._highest = np.full(n, -np.inf)

    def add(self, part_index: int, raw: NDArray[np.uint8], present: NDArray[np.bool_]) -> None:
        """Count one sweep of a part: bytes [m], and which of them [m] were received."""
        part = self._layout.parts[part_index]
        taxels = np.arange(part.start, part.stop)[present]
        seen = raw[present]
        self._counts[taxels, seen] += 1
        value = seen.astype(np.int16)
        known = self._last[taxels] >= 0
        self._steps[taxels[known], np.abs(value - self._last[taxels])[known]] += 1
        self._last[taxels] = value
        self._block_sum[taxels] += value
        self._block_count[taxels] += 1
        full = taxels[self._block_count[taxels] == BLOCK]
        mean = self._block_sum[full] / BLOCK
        self._lowest[full] = np.minimum(self._lowest[full], mean)
        self._highest[full] = np.maximum(self._highest[full], mean)
        self._block_sum[full] = 0.0
        self._block_count[full] = 0

    def finish(self, configuration: str, time: str) -> Calibration:
        """Return the calibration of what has been added, at `time` (ISO 8601, UTC)."""
        counts = self._counts
        samples = counts.sum(axis=1)
        some = np.maximum(samples, 1)
        codes = np.arange(256.0)
        mean_raw = counts @ codes / some
        variance = np.maximum(counts @ codes**2 / some - mean_raw**2, 0.0)
        no_load = self._layout.no_load.astype(np.float64)
        baseline = no_load - mean_raw
        # Activation falls as raw rises: count from the top of the scale.
        cumulative = np.cumsum(counts[:, ::-1], axis=1)
        wanted = np.ceil(self._percentile * samples - 1e-9)
        from_top = np.argmax(cumulative >= wanted[:, np.newaxis], axis=1)
        percentile = no_load - (255.0 - from_top)
        noise = np.sqrt(variance)

        steady_noise = _steady_noise(self._steps)
        moved = np.where(np.isfinite(self._lowest), self._highest - self._lowest, 0.0)
        touched = moved > STEADY_UNITS + 5.0 * steady_noise / np.sqrt(BLOCK)
        # The least activation seen is the nearest to an untouched taxel that there is.
        baseline = np.where(touched, no_load - self._highest, baseline)
        percentile = np.where(touched, baseline + 1.645 * steady_noise, percentile)
        noise = np.where(touched, steady_noise, noise)

        ends = counts[:, 0] + counts[:, 255]
        verdict = np.full(len(samples), Verdict.OK, dtype=np.uint8)
        verdict[noise > NOISY_UNITS] = Verdict.NOISY
        verdict[touched] = Verdict.TOUCHED
        verdict[ends > SATURATED_SHARE * samples] = Verdict.OUT_OF_RANGE
        verdict[(counts[:, 0] == samples) | (counts[:, 255] == samples)] = Verdict.STUCK
        verdict[samples < FEWEST_SAMPLES] = Verdict.TOO_FEW
        verdict[samples == 0] = Verdict.ABSENT
        absent = samples == 0
        for array in (baseline, percentile, noise):
            array[absent] = 0.0
        return _identified(
            Calibration(
                configuration,
                "",
                time,
                baseline,
                percentile,
                noise,
                np.ones(len(samples)),
                np.ones(len(samples)),
                verdict,
            )
        )


def with_gains(calibration: Calibration, gain: Floats, bend: Floats) -> Calibration:
    """Return the calibration with gains and bends [n] fitted to known pressures."""
    return _identified(replace(calibration, gain=gain, bend=bend))


def with_zeros(calibration: Calibration, zeros: dict[str, Zero]) -> Calibration:
    """Return the calibration with the zeros of force/torque boards, by name of the fingertip."""
    return _identified(replace(calibration, zeros=zeros))


def with_gains_of(calibration: Calibration, path: Path, layout: Layout) -> Calibration:
    """Return the calibration with the gains of the one in `path`, if there is one that fits.

    Zero and noise are taken anew at every start; gains belong to pad and foam, and stay.
    """
    try:
        before = load(path, layout, calibration.configuration)
    except CalibrationError:
        return calibration
    return with_gains(calibration, before.gain, before.bend)


def merge(
    old: Calibration, new: Calibration, renewed: NDArray[np.bool_], *, zeros: bool = True
) -> Calibration:
    """Return `old` with the taxels `renewed` [n] taken from `new`; their gains stay.

    Zeros of fingertips are taken from `new`, if so wished, as far as it has them.
    """
    return _identified(
        replace(
            new,
            baseline=np.where(renewed, new.baseline, old.baseline),
            percentile=np.where(renewed, new.percentile, old.percentile),
            noise=np.where(renewed, new.noise, old.noise),
            gain=old.gain,
            bend=old.bend,
            verdict=np.where(renewed, new.verdict, old.verdict),
            zeros=old.zeros | new.zeros if zeros else old.zeros,
        )
    )


def _steady_noise(steps: NDArray[np.int32]) -> Floats:
    """Standard deviation [n] that steps from sample to sample tell, a touch's left out.

    Args:
        steps: int32[n, 256], how often each size of step was seen.
    """
    sizes = np.arange(256.0)
    cumulative = np.cumsum(steps, axis=1)
    median = np.argmax(2 * cumulative >= cumulative[:, -1:], axis=1)
    noise = sizes <= np.maximum(JUMP_UNITS, JUMP_MEDIANS * median)[:, np.newaxis]
    squares = np.sum(steps * sizes**2, axis=1, where=noise)
    variance: Floats = squares / np.maximum(cumulative[:, -1], 1) / 2.0
    return np.sqrt(variance)


def _identified(calibration: Calibration) -> Calibration:
    digest = hashlib.sha256(calibration.configuration.encode())
    for array in (
        calibration.baseline,
        calibration.percentile,
        calibration.noise,
        calibration.gain,
        calibration.bend,
        calibration.verdict,
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    for name, zero in sorted(calibration.zeros.items()):
        digest.update(name.encode() + zero.offset.tobytes() + zero.noise.tobytes())
    return replace(calibration, id=digest.hexdigest()[:12])


def summary(calibration: Calibration, layout: Layout) -> dict[str, dict[str, int]]:
    """Return how many pressure taxels of each part got each verdict (those above 0)."""
    pressure = layout.pad_kind == PadKind.PRESSURE
    result: dict[str, dict[str, int]] = {}
    for part in layout.parts:
        mine = slice(part.start, part.stop)
        verdicts = calibration.verdict[mine][pressure[mine]]
        counted = {verdict.name.lower(): int((verdicts == verdict).sum()) for verdict in Verdict}
        result[part.name] = {name: count for name, count in counted.items() if count}
    return result


class _PartFile(msgspec.Struct, forbid_unknown_fields=True):
    baseline: list[float]
    percentile: list[float]
    noise: list[float]
    gain: list[float]
    verdict: list[str]
    #: Files from before it was fitted have none.
    bend: list[float] | None = None


class _ZeroFile(msgspec.Struct, forbid_unknown_fields=True):
    offset: list[float]
    noise: list[float]


class _File(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    schema: str
    id: str
    time: str
    robot: str
    configuration: str
    parts: dict[str, _PartFile]
    fingertips: dict[str, _ZeroFile] = {}


def save(path: Path, calibration: Calibration, layout: Layout) -> None:
    """Write a calibration file, whole or not at all (JSON, schema skin.calibration/1).

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
            verdict=[Verdict(number).name.lower() for number in calibration.verdict[mine]],
        )
    zeros = {
        # Forces of coarse and of fine boards alike: not rounded.
        name: _ZeroFile(zero.offset.tolist(), zero.noise.tolist())
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
    )
    write_atomic(path, msgspec.json.format(msgspec.json.encode(content), indent=1) + b"\n")


def _rounded(values: Floats) -> list[float]:
    rounded: list[float] = np.round(values, 6).tolist()
    return rounded


def load(path: Path, layout: Layout, configuration: str) -> Calibration:
    """Read a calibration file of this very skin.

    Raises:
        CalibrationError: unreadable, damaged, of another schema or configuration; one line
            that ends with the command that mends it.
    """

    def refused(what: str) -> CalibrationError:
        return CalibrationError(f"{path}: {what}; take a new one with: skin calibrate CONFIG")

    content = read_document(path, _File, SCHEMA, "calibration", refused)
    if content.configuration != configuration:
        raise OtherSkinError(
            f"{path}: belongs to configuration {content.configuration} "
            f'(robot "{content.robot}"), this one is {configuration}; take a new one with: '
            "skin calibrate CONFIG"
        )
    n = layout.n_taxels
    arrays = {name: np.zeros(n) for name in ("baseline", "percentile", "noise", "gain", "bend")}
    verdict = np.full(n, Verdict.ABSENT, dtype=np.uint8)
    for part in layout.parts:
        stored = content.parts.get(part.name)
        if stored is None:
            raise refused(f'no part "{part.name}"')
        mine = slice(part.start, part.stop)
        for name, array in arrays.items():
            values = (
                np.ones(part.n_taxels)
                if stored.bend is None and name == "bend"
                else np.array(getattr(stored, name))
            )
            if values.shape != (part.n_taxels,) or not np.all(np.isfinite(values)):
                raise refused(f"parts.{part.name}.{name}: wanted {part.n_taxels} finite numbers")
            array[mine] = values
        try:
            verdict[mine] = [Verdict[name.upper()] for name in stored.verdict]
        except (KeyError, ValueError) as error:
            raise refused(f"parts.{part.name}.verdict: {error}") from None
        for name in ("gain", "bend"):
            if np.any(arrays[name][mine] <= 0.0):
                raise refused(f"parts.{part.name}.{name}: every number must be positive")
    zeros = {}
    for name, zero in content.fingertips.items():
        offset, noise = np.array(zero.offset), np.array(zero.noise)
        fits = offset.shape == noise.shape == (CHANNELS,)
        if not fits or not np.isfinite([offset, noise]).all() or (noise < 0.0).any():
            raise refused(f"fingertips.{name}: wanted twice {CHANNELS} finite numbers")
        zeros[name] = Zero(offset, noise)
    return Calibration(
        content.configuration, content.id, content.time, verdict=verdict, zeros=zeros, **arrays
    )
