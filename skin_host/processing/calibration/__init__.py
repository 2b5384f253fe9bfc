"""What a calibration knows of each taxel: its untouched reading, its noise, whether it is usable.

`calibrator` takes one from some seconds of untouched skin, `file` keeps it. All numbers here are in
units of the transmitted byte; an activation is `no_load - raw`: it rises with pressure.
"""

import hashlib
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from skin_host.layout import Layout, PadKind
from skin_host.processing.curves import Curves
from skin_host.processing.masks import Mask

#: A pad with this much noise does not send the same byte for seconds.
LIVELY_UNITS = 0.6
#: Of a byte: no activation is larger.
SCALE_UNITS = 255.0
#: Nearly all boards send units of this shift.
USUAL_SHIFT = 2

Floats = NDArray[np.float64]


class Verdict(IntEnum):
    """Result of the calibration of a taxel. The readings of STUCK and the following are not used.

    NOISY decides slowly, and on more pressure than others (`levels`). SATURATES rests so near 0
    that a press is cut off before its pressure curve ends. TOUCHED was touched for a part of the
    calibration, or for all of it, or when its board was zeroed, as far as known. TOO_NOISY is not
    used: no realistic press would be detected.
    """

    OK = 0
    NOISY = 1
    SATURATES = 2
    TOUCHED = 3
    STUCK = 4
    OUT_OF_RANGE = 5
    TOO_NOISY = 6
    ABSENT = 7
    TOO_FEW = 8


@dataclass(frozen=True, slots=True)
class Zero:
    """Load that an unloaded force/torque board sends: mean and sd, float64[6], N and N m.

    Attributes:
        touched: something touched the fingertip meanwhile, by the zero before.
        full_scale: float64[6], of the board that sent it (N, N m), if it is known. With other ones
            it is another board, which has another zero.
    """

    offset: Floats
    noise: Floats
    touched: bool = False
    full_scale: Floats | None = None


@dataclass(frozen=True)
class Calibration:
    """The calibration of a whole skin: flat arrays in the order of its layout.

    Attributes:
        configuration: hash of the configuration it belongs to.
        id: identifies the numbers; equal numbers, equal id.
        time: when it was taken, ISO 8601 in UTC.
        baseline: float64[n], mean activation.
        percentile: float64[n], its 95th percentile (or the requested one).
        noise: float64[n], standard deviation of a measurement.
        spread: float64[n], the same derived from sums of measurements: larger where noise lasts for
            several measurements, and an upper limit after a short calibration.
        gain: float64[n], pressure of the taxel over that of the common curve.
        bend: float64[n], its quadratic part over that of the common curve, without the gain.
        verdict: uint8[n], see `Verdict`.
        zeros: of the fingertips on force/torque boards, by name.
        curves: of the pads and their foam, from a recording under known pressure, if there was one.
        unchanged: bool[n], taxels of which too little was received and that go on with what was
            known of them; None without a calibration before, and of a stored one.
        damaged: bool[n], taxels of which damaged bytes were left out; None of a stored one.
    """

    configuration: str
    id: str
    time: str
    baseline: Floats
    percentile: Floats
    noise: Floats
    spread: Floats
    gain: Floats
    bend: Floats
    verdict: NDArray[np.uint8]
    zeros: dict[str, Zero] = field(default_factory=dict)
    curves: Curves | None = None
    unchanged: Mask | None = None
    damaged: Mask | None = None

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Which taxels [n] are usable; not to be written to."""
        usable: NDArray[np.bool_] = self.verdict < Verdict.STUCK
        if self.curves is not None:
            usable &= self.curves.usable
        usable.flags.writeable = False
        return usable

    @property
    def gained(self) -> NDArray[np.bool_]:
        """Which taxels [n] a recording under pressure has given a gain or a bend of their own."""
        gained: NDArray[np.bool_] = (self.gain != 1.0) | (self.bend != 1.0)
        return gained


def with_gains(calibration: Calibration, gain: Floats, bend: Floats) -> Calibration:
    """Return the calibration with gains and bends [n] fitted to known pressures."""
    return identified(replace(calibration, gain=gain, bend=bend))


def with_curves(calibration: Calibration, curves: Curves | None) -> Calibration:
    """Return the calibration with these curves, or without any.

    A pad that was noisy under pressure and now always sends the same byte is stuck.
    """
    verdict = calibration.verdict
    if curves is not None:
        frozen = curves.own & (curves.noise_units > LIVELY_UNITS) & (calibration.noise == 0.0)
        stuck = np.uint8(Verdict.STUCK)
        verdict = np.where(frozen & (verdict < stuck), stuck, verdict).astype(np.uint8)
    return identified(replace(calibration, curves=curves, verdict=verdict))


def with_zeros(calibration: Calibration, zeros: dict[str, Zero]) -> Calibration:
    """Return the calibration with the zeros of force/torque boards, by name of the fingertip."""
    return identified(replace(calibration, zeros=zeros))


def with_pressures_of(calibration: Calibration, before: Calibration) -> Calibration:
    """Return the calibration with gains and curves of another one of this skin."""
    return with_curves(with_gains(calibration, before.gain, before.bend), before.curves)


def merge(
    old: Calibration, new: Calibration, renewed: NDArray[np.bool_], *, zeros: bool = True
) -> Calibration:
    """Return `old` with the taxels `renewed` [n] taken from `new`; their gains and curves stay.

    With `zeros`, zeros of fingertips are taken from `new`, as far as it has them.
    """
    merged = identified(
        replace(
            new,
            baseline=np.where(renewed, new.baseline, old.baseline),
            percentile=np.where(renewed, new.percentile, old.percentile),
            noise=np.where(renewed, new.noise, old.noise),
            spread=np.where(renewed, new.spread, old.spread),
            gain=old.gain,
            bend=old.bend,
            verdict=np.where(renewed, new.verdict, old.verdict),
            unchanged=None if new.unchanged is None else new.unchanged & renewed,
            damaged=None if new.damaged is None else new.damaged & renewed,
            zeros=old.zeros | new.zeros if zeros else old.zeros,
        )
    )
    return merged if old.curves is None else with_curves(merged, old.curves)


def identified(calibration: Calibration) -> Calibration:
    """Return the calibration with the id of its numbers."""
    digest = hashlib.sha256(calibration.configuration.encode())
    for array in (
        calibration.baseline,
        calibration.percentile,
        calibration.noise,
        calibration.spread,
        calibration.gain,
        calibration.bend,
        calibration.verdict,
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    for name, zero in sorted(calibration.zeros.items()):
        digest.update(name.encode() + zero.offset.tobytes() + zero.noise.tobytes())
        digest.update(b"touched" * zero.touched)
        digest.update(b"" if zero.full_scale is None else zero.full_scale.tobytes())
    if (curves := calibration.curves) is not None:
        for array in curves.arrays().values():
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(np.array([curves.memory.radius_kpa, curves.memory.weight]).tobytes())
    return replace(calibration, id=digest.hexdigest()[:12])


def fineness(layout: Layout) -> Floats:
    """Return how many of the units of each taxel [n] are one at `USUAL_SHIFT`, at least 1: as many
    times larger are noise and drift in finer units.
    """
    finer = [max(USUAL_SHIFT - triangle.shift, 0) for triangle in layout.triangles]
    found: Floats = np.exp2(np.array(finer))[layout.triangle_of]
    return found


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


def unchanged(calibration: Calibration, layout: Layout) -> dict[str, list[int]]:
    """Return by part the numbers of the pressure taxels that go on as before: see `Calibration`."""
    return by_part(calibration.unchanged, layout)


def damaged(calibration: Calibration, layout: Layout) -> dict[str, list[int]]:
    """Return by part the numbers of the pressure taxels of which bytes were left out."""
    return by_part(calibration.damaged, layout)


def by_part(taxels: Mask | None, layout: Layout) -> dict[str, list[int]]:
    """Return by part the numbers of the pressure taxels among these, bool[n]; parts without are
    left out.
    """
    if taxels is None:
        return {}
    these = taxels & (layout.pad_kind == PadKind.PRESSURE)
    found = {p.name: np.flatnonzero(these[p.start : p.stop]).tolist() for p in layout.parts}
    return {name: numbers for name, numbers in found.items() if numbers}
