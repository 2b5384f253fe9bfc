"""The paper's test rig (section VI): a palm on a platform, a Cartesian robot, a load cell.

The robot pushes flat round probes of 2 to 6 mm into the foam and reads, at 25 Hz, the force of the
load cell and the palm's bytes, which are converted to femtofarads at 2.88 fF a unit. The foam, the
pads and the arithmetic of the board are the emulator's; no host is involved. Each contact of a
recording presses on a separate palm, so that thousands of positions can be computed together, as
the paper's robot had hours to let the foam recover between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.boards.arithmetic import TAXELS, transmit_32
from emulator.chips.converters import Q_FF
from emulator.probes.foam import Drive, Foam, FoamLayer, Footprint
from emulator.probes.pads import UNIT_FF, Disc, Pads, draw_noise_ff, draw_resting_ff
from emulator.probes.viscoelastic import FoamTruth, TruthKind
from skin_host.layout import builtin_kinds

SAMPLE_HZ = 25.0
#: The skin of the paper's experiments keeps bits 3 to 10 of the 16-bit readings.
SHIFT = 3
NO_LOAD = 240
FOAM_MM = 2.0
#: The load cell gives way; read as an eighth of the way into the foam under a 6 mm probe.
COMPLIANCE_MM_PER_N = 0.03
#: Noise of the load cell, 0.04 % of its 5 N (chosen).
FORCE_NOISE_N = 0.002
CALIBRATION_SAMPLES = 125
CHUNK_SAMPLES = 2048
_NO_GAIN = np.zeros((1, TAXELS), np.int32)
_NO_THERMAL = np.zeros(0, np.intp)
#: The pads called 1, 2 and 3 in Fig. 11, neighbours in the middle of the palm, and how much
#: stiffer their foam grows than the emulator's mean. Fitted: 2 so that presses with a 6 mm
#: probe follow eq. (1), whose measurements had relaxed for half a second; 1 and 3 to Fig. 11.
NAMED_PADS = {1: 28, 2: 32, 3: 33}
STIFFENING = {1: 0.935, 2: 1.09, 3: 1.28}

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Motion:
    """True forces and capacitances under the probes: m times, c contacts, the k pads that they
    cover.

    Attributes:
        t_s: float64[m].
        force_n: float64[m, c], true force. area_mm2: float64[c].
        rise_ff: float64[m, k], capacitance above rest.
        pad: intp[k], pad of the palm. contact: intp[k], which contact covers it.
    """

    t_s: Floats
    force_n: Floats
    area_mm2: Floats
    rise_ff: Floats
    pad: Ints
    contact: Ints

    def at(self, t_s: Floats) -> "Motion":
        """Return the same at other times, interpolated linearly."""
        low = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        length_s = self.t_s[low + 1] - self.t_s[low]
        share = np.clip((t_s - self.t_s[low]) / length_s, 0.0, 1.0)[:, None]
        force_n = self.force_n[low] * (1 - share) + self.force_n[low + 1] * share
        rise_ff = self.rise_ff[low] * (1 - share) + self.rise_ff[low + 1] * share
        return Motion(t_s, force_n, self.area_mm2, rise_ff, self.pad, self.contact)


@dataclass(frozen=True, slots=True)
class RigRecording:
    """What the rig recorded: m samples of c contacts and of the k pads that they cover.

    Attributes:
        t_s: float64[m].
        pressure_kpa: float64[m, c], force of the load cell over the probe's area.
        s_ff: float64[m, k], readings above baseline.
        pad: intp[k], pad of the palm. contact: intp[k], which contact covers it.
    """

    t_s: Floats
    pressure_kpa: Floats
    s_ff: Floats
    pad: Ints
    contact: Ints

    def of(self, contact: int, pad: int) -> Floats:
        """Readings [m] of a pad under a contact; zeros if the contact does not cover it."""
        column = np.flatnonzero((self.contact == contact) & (self.pad == pad))
        return self.s_ff[:, column[0]] if len(column) else np.zeros(len(self.t_s))


class PalmRig:
    """The rig with one palm.

    Args:
        seed: of foam, pads and noise.
        truth: how the foam relaxes, see `emulator.probes.viscoelastic`. "A" unloads slowly and
            loses as much in the first second at every pressure, as the paper's foam did.
        membrane_mm: decay length of the palm's surface around a probe; 0 is Winkler's.

    Attributes:
        pads, foam: of the palm, 48 each.
        rng: of the noise.
    """

    def __init__(self, seed: int = 1, truth: TruthKind = "A", membrane_mm: float = 0.0) -> None:
        kind = builtin_kinds()["palmr"]
        n = len(kind.pads_mm)
        self.rng = np.random.default_rng([seed, 6])
        self._truth: TruthKind = truth
        self.pads = Pads(kind.pads_mm, kind.radius_mm, FOAM_MM, membrane_mm=membrane_mm)
        self.pads.c0_ff[kind.thermal] = 0.0
        self.foam = Foam.drawn(n, self.rng, FOAM_MM)
        mean = Foam.uniform(n, FOAM_MM)
        for name, pad in NAMED_PADS.items():
            self.foam.e0_kpa[pad] = mean.e0_kpa[pad]
            self.foam.stiffening[pad] = STIFFENING[name] * mean.stiffening[pad]
        self._resting_ff = draw_resting_ff(n, self.rng)
        self._noise_ff = draw_noise_ff(n, self.rng)

    def centre_mm(self, name: int) -> tuple[float, float]:
        """Where the pad called `name` in Fig. 11 lies on the palm."""
        x_mm, y_mm = self.pads.centre_mm[NAMED_PADS[name]]
        return float(x_mm), float(y_mm)

    def follow(self, discs: Sequence[Disc], t_s: Floats, depth_mm: ArrayLike) -> Motion:
        """Move probes to given depths.

        Args:
            discs: c probes, each on a palm of its own.
            t_s: float64[m], times that the mechanics is worked out at.
            depth_mm: float64[m] or [m, c], where the robot is then; 0 is off the foam.
        """
        single = [self.pads.footprint([disc]) for disc in discs]
        pad = np.concatenate([one.taxel for one in single])
        contact = np.repeat(np.arange(len(discs)), [len(one.taxel) for one in single])
        footprint = Footprint(
            np.arange(len(pad)),
            contact,
            np.concatenate([one.covered for one in single]),
            np.concatenate([one.share for one in single]),
            np.concatenate([one.weight for one in single]),
            np.concatenate([one.area_mm2 for one in single]),
            np.concatenate([one.edge for one in single]),
        )
        own_pads = Pads(self.pads.centre_mm[pad], self.pads.radius_mm[pad], FOAM_MM)
        own_pads.c0_ff[:] = self.pads.c0_ff[pad]
        layer = FoamLayer(self.foam.take(pad), FoamTruth(self._truth, len(pad)))
        depth = np.broadcast_to(np.reshape(depth_mm, (len(t_s), -1)), (len(t_s), len(discs)))
        force_n = np.zeros((len(t_s), len(discs)))
        rise_ff = np.zeros((len(t_s), len(pad)))
        for row, dt_s in enumerate(np.diff(t_s, prepend=t_s[0])):
            drive = Drive.by_depth(depth[row], COMPLIANCE_MM_PER_N)
            felt = layer.step(footprint, drive, float(dt_s))
            force_n[row] = layer.force_n
            rise_ff[row] = own_pads.rise_ff(felt, footprint)
        return Motion(t_s, force_n, footprint.area_mm2, rise_ff, pad, contact)

    def record(self, motion: Motion) -> RigRecording:
        """Readings of the load cell and the palm for a motion."""
        force_n = motion.force_n
        force_n = force_n + FORCE_NOISE_N * self.rng.standard_normal(force_n.shape)
        return RigRecording(
            motion.t_s,
            force_n * 1e3 / motion.area_mm2,
            self.read_ff(motion.rise_ff, motion.pad),
            motion.pad,
            motion.contact,
        )

    def read_ff(self, rise_ff: Floats, pad: Ints) -> Floats:
        """Readings [m, k] above baseline (fF) of pads [k] whose capacitance has risen.

        The baseline is the mean of 5 s of readings without contact, as a host would take it.
        """
        untouched = self.read(np.zeros((CALIBRATION_SAMPLES, len(pad))), pad).mean(axis=0)
        result: Floats = (untouched - self.read(rise_ff, pad)) * UNIT_FF
        return result

    def read(self, rise_ff: Floats, pad: Ints) -> NDArray[np.uint8]:
        """The bytes [m, k] that the board sends for pads [k] whose capacitance has risen."""
        m, k = rise_ff.shape
        n_triangles = -(-k // TAXELS)
        resting = np.zeros(n_triangles * TAXELS)
        resting[:k] = self._resting_ff[pad] / Q_FF
        base = np.rint(resting).astype(np.int32).reshape(-1, TAXELS)
        values = np.empty((m, k), np.uint8)
        for start in range(0, m, CHUNK_SAMPLES):
            rows = slice(start, min(start + CHUNK_SAMPLES, m))
            n = rows.stop - start
            codes = np.zeros((n, len(resting)))
            codes[:, :k] = self.rng.standard_normal((n, k), np.float32)
            codes[:, :k] *= self._noise_ff[pad] / Q_FF
            codes[:, :k] += rise_ff[rows] / Q_FF
            codes += resting
            raw = np.clip(np.rint(codes), 0, 0xFFFF).astype(np.uint16).reshape(-1, TAXELS)
            sent, _ = transmit_32(
                raw,
                np.tile(base, (n, 1)),
                np.full(len(raw), SHIFT, np.int32),
                np.full(len(raw), NO_LOAD, np.int32),
                _NO_GAIN,
                _NO_THERMAL,
            )
            values[rows] = sent.reshape(n, -1)[:, :k]
        return values
