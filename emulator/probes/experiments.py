"""The experiments of the paper's section VI, run on the rig of `emulator.probes.bench`.

Each returns plain arrays; their processing by a host, and the comparison with the paper's
figures, is in `skin_host.evaluation`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.probes.bench import FOAM_MM, NAMED_PADS, SAMPLE_HZ, PalmRig
from emulator.probes.pads import Disc

SAMPLE_S = 1 / SAMPLE_HZ
#: The robot pushes slowly to scan, and as fast as it can to hold.
SCAN_MM_PER_S = 0.5
DEEPEST_MM = 0.92 * FOAM_MM
SCAN_PROBE_MM = 3.0
WINDOW_KPA = (150.0, 160.0)
#: A long hold is computed in growing steps, up to this one.
LONGEST_STEP_S = 10.0
STEP_GROWTH = 1.1
READ_TOGETHER = 20_000
#: Contacts computed together; more would not fit the caches.
TOGETHER = 500

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scan:
    """Responses to one pressure at p positions of the probe.

    Attributes:
        x_mm, y_mm: float64[p]. s_ff, sd_ff: float64[p, 48], mean and standard deviation of
            what each pad read while the pressure was in the window; NaN where it never was.
    """

    x_mm: Floats
    y_mm: Floats
    s_ff: Floats
    sd_ff: Floats


def scan(rig: PalmRig, x_mm: Floats, y_mm: Floats, passes: int = 2) -> Scan:
    """Push at every position and keep what is read at 150-160 kPa on the way down (VI-B)."""
    n_pads = len(rig.pads)
    total, square = np.zeros((2, len(x_mm), n_pads))
    count = np.zeros((len(x_mm), 1))
    for _ in range(passes):
        for start in range(0, len(x_mm), TOGETHER):
            part = slice(start, min(start + TOGETHER, len(x_mm)))
            _scan_some(rig, x_mm[part], y_mm[part], total[part], square[part], count[part])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / count
        variance = np.maximum(square / count - mean**2, 0.0)
    return Scan(x_mm, y_mm, mean, np.sqrt(variance))


def _scan_some(
    rig: PalmRig, x_mm: Floats, y_mm: Floats, total: Floats, square: Floats, count: Floats
) -> None:
    """Add the samples of one push at each of some positions to the sums."""
    t_s = np.arange(0.0, DEEPEST_MM / SCAN_MM_PER_S, SAMPLE_S)
    # The robot's samples fall at other depths in every push.
    late_s = rig.rng.uniform(0.0, SAMPLE_S, len(x_mm))
    depth_mm = SCAN_MM_PER_S * np.maximum(t_s[:, None] - late_s, 0.0)
    discs = [Disc(x, y, SCAN_PROBE_MM) for x, y in zip(x_mm, y_mm, strict=True)]
    recording = rig.record(rig.follow(discs, t_s, depth_mm))
    inside = (recording.pressure_kpa > WINDOW_KPA[0]) & (recording.pressure_kpa < WINDOW_KPA[1])
    count += inside.sum(axis=0)[:, None]
    kept = np.where(inside[:, recording.contact], recording.s_ff, 0.0)
    np.add.at(total, (recording.contact, recording.pad), kept.sum(axis=0))
    np.add.at(square, (recording.contact, recording.pad), np.square(kept).sum(axis=0))


@dataclass(frozen=True, slots=True)
class Presses:
    """Presses of 2 s to ever greater depths (VI-C to VI-E), p of them for each contact.

    Attributes:
        pad, diameter_mm: of each contact, [c]; `pad` by its name in Fig. 11.
        pressure_kpa, s_ff, sd_ff: float64[p, c], mean and standard deviation over the first
            second of each press.
    """

    pad: list[int]
    diameter_mm: list[float]
    pressure_kpa: Floats
    s_ff: Floats
    sd_ff: Floats

    def curve(self, pad: int, diameter_mm: float) -> tuple[Floats, Floats, Floats]:
        """Pressure, mean and standard deviation of one pad under one probe, by pressure."""
        column = next(
            number
            for number, contact in enumerate(zip(self.pad, self.diameter_mm, strict=True))
            if contact == (pad, diameter_mm)
        )
        order = np.argsort(self.pressure_kpa[:, column])
        return (
            self.pressure_kpa[order, column],
            self.s_ff[order, column],
            self.sd_ff[order, column],
        )

    def at(self, pad: int, diameter_mm: float, pressure_kpa: float) -> float:
        """Reading (fF) of a pad under a probe at a pressure, between the presses."""
        pressure, s_ff, _ = self.curve(pad, diameter_mm)
        return float(np.interp(pressure_kpa, pressure, s_ff))


def deepening_presses(
    rig: PalmRig, contacts: list[tuple[int, float]], cycles: int = 3, step_mm: float = 0.1
) -> Presses:
    """Press for 2 s, rest for 20 s, go 0.1 mm deeper, to the deepest point; three cycles.

    Args:
        rig: the palm.
        contacts: pad (by its name in Fig. 11) and probe diameter (mm) of each contact.
        cycles: how often it begins again.
        step_mm: how much deeper each press goes.
    """
    hold_s = np.concatenate([np.arange(1, 26) * SAMPLE_S, np.arange(1.25, 2.01, 0.25)])
    rest_s = np.concatenate([[SAMPLE_S], np.arange(1.0, 20.0, 1.0), [20.0]])
    depths_mm = np.tile(np.arange(step_mm, DEEPEST_MM, step_mm), cycles)
    press_s = np.concatenate([hold_s, hold_s[-1] + rest_s])
    period_s = press_s[-1]
    t_s = np.concatenate([[0.0]] + [i * period_s + press_s for i in range(len(depths_mm))])
    depth_mm = np.concatenate(
        [[0.0]] + [np.where(press_s <= hold_s[-1], depth, 0.0) for depth in depths_mm]
    )
    discs = [Disc(*rig.centre_mm(pad), diameter) for pad, diameter in contacts]
    recording = rig.record(rig.follow(discs, t_s, depth_mm))
    first_second = 1 + len(press_s) * np.arange(len(depths_mm))[:, None] + np.arange(25)
    pressure = recording.pressure_kpa[first_second].mean(axis=1)
    s_ff = np.stack(
        [
            recording.of(number, NAMED_PADS[pad])[first_second]
            for number, (pad, _) in enumerate(contacts)
        ],
        axis=-1,
    )
    return Presses(
        [pad for pad, _ in contacts],
        [diameter for _, diameter in contacts],
        pressure,
        s_ff.mean(axis=1),
        s_ff.std(axis=1),
    )


@dataclass(frozen=True, slots=True)
class Hold:
    """A long history of one probe on pad 2, sampled at 25 Hz (VI-G).

    Attributes:
        t_s: float64[m]. pressure_kpa: float64[m], P*: load cell over area.
        s_ff: float64[m], readings of pad 2 above its baseline.
        palm: uint8[m, 48], the bytes of the whole palm.
    """

    t_s: Floats
    pressure_kpa: Floats
    s_ff: Floats
    palm: NDArray[np.uint8]


def hold(rig: PalmRig, depths: list[tuple[float, float]], diameter_mm: float = 6.0) -> Hold:
    """Go to depths (mm) as fast as possible, each for some seconds, and read the whole palm.

    The mechanics is worked out finely after each move and ever more coarsely after that.
    """
    times, depth_mm, begin_s = [np.zeros(1)], [np.zeros(1)], 0.0
    for depth, seconds in depths:
        steps = np.minimum(SAMPLE_S * STEP_GROWTH ** np.arange(200), LONGEST_STEP_S)
        after_s = np.cumsum(steps)
        after_s = np.append(after_s[after_s < seconds - SAMPLE_S], seconds)
        times.append(begin_s + after_s)
        depth_mm.append(np.full(len(after_s), depth))
        begin_s += seconds
    t_s = np.concatenate(times)
    disc = Disc(*rig.centre_mm(2), diameter_mm)
    coarse = rig.follow([disc], t_s, np.concatenate(depth_mm))
    motion = coarse.at(np.arange(0.0, begin_s, SAMPLE_S))
    palm = np.empty((len(motion.t_s), len(rig.pads)), np.uint8)
    for start in range(0, len(palm), READ_TOGETHER):
        part = slice(start, start + READ_TOGETHER)
        rise_ff = np.zeros((len(palm[part]), len(rig.pads)))
        rise_ff[:, motion.pad] = motion.rise_ff[part]
        palm[part] = rig.read(rise_ff, np.arange(len(rig.pads)))
    recording = rig.record(motion)
    return Hold(motion.t_s, recording.pressure_kpa[:, 0], recording.of(0, NAMED_PADS[2]), palm)
