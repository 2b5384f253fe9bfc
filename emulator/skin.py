"""The skin of a robot: probes in, capacitance of every pad out, and the truth beside it.

Mechanics runs for contacts and for foam that still recovers; a pad that nobody touches keeps
its capacitance and costs nothing.
"""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from emulator.firmware.arithmetic import TAXELS
from emulator.foam import Drive, Foam, FoamLayer, Footprint
from emulator.pads import Disc, Pads, Rectangle, draw_noise_ff, draw_resting_ff
from emulator.scene import Moment, Probe, Scene, Script, resolve, tangents
from emulator.viscoelastic import FoamTruth
from skin_host.bus.protocol.compensation import GAIN, GAIN_V2
from skin_host.errors import ConfigurationError
from skin_host.layout import Layout, PadKind

#: Change of a thermal pad with temperature (fF per degree): some ten codes.
THERMAL_FF_PER_C = 3.6
#: Change of the other pads relative to the thermal one, where the firmware compensates it.
THERMAL_SPREAD = 0.05
#: Without thermal pads beside them, pads drift about half as much.
PLAIN_SHARE = 0.5
REFERENCE_C = 25.0
#: A probe reaches only pads that face it, and not through the body.
FACING = 0.3
REACH_MM = 15.0
#: Temperature is passed on in steps of this size.
STEP_C = 0.01
#: While drives change, mechanics is worked out this often; all its times are multiples of it.
MOVING_NS = 5_000_000
#: While probes are held, foam recovers or the temperature moves, this is enough, after a time.
HOLDING_NS = 50_000_000
SETTLING_SHARE = 10
NEVER_NS = 1 << 62

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


class Skin:
    """All pads of a robot under a scene.

    Attributes:
        capacitance_ff: float64[n], what each pad measures now.
        resting_ff: float64[n], what it measures untouched at 25 degrees C.
        held_ff: float64[n], what a stuck pad measures instead, else NaN.
        noise_ff: float64[n], rms noise of each pad.
        probes: the scene's probes on skin, then the live ones.
        numbers: of the former, in the scene.

    Args:
        layout: of the skin.
        scene: what happens to it.
        bare: names of fingertips without skin; the probes on them are none of ours.
    """

    def __init__(self, layout: Layout, scene: Scene, bare: Collection[str] = ()) -> None:
        n = layout.n_taxels
        self._t_ns = 0
        rng = np.random.default_rng([scene.seed, 1])
        self._layout = layout
        self._position_mm = layout.position_m * 1e3
        thickness_mm = np.repeat(
            [part.foam_mm for part in layout.parts], [part.n_taxels for part in layout.parts]
        )
        cover = np.repeat(
            [part.covered for part in layout.parts], [part.n_taxels for part in layout.parts]
        )
        self._thickness_mm = thickness_mm
        self._membrane_mm = scene.membrane_mm
        self._pads = Pads(np.zeros((n, 2)), layout.radius_mm, thickness_mm, cover=cover)
        self._pads.c0_ff[layout.pad_kind == PadKind.THERMAL] = 0.0
        if scene.spread:
            foam = Foam.drawn(n, rng, thickness_mm)
            truth = FoamTruth(scene.foam, n, rng)
            self.resting_ff = draw_resting_ff(n, rng)
            spread = 1 + THERMAL_SPREAD * rng.standard_normal(n)
        else:
            foam = Foam.uniform(n, thickness_mm)
            truth = FoamTruth(scene.foam, n)
            self.resting_ff = np.full(n, 7800.0)
            spread = np.ones(n)
        self.noise_ff = draw_noise_ff(n, rng) if scene.noise else np.zeros(n)
        self._ff_per_c = THERMAL_FF_PER_C * _thermal_gain(layout) * spread
        self._ff_per_c[layout.pad_kind == PadKind.THERMAL] = THERMAL_FF_PER_C
        self._foam = FoamLayer(foam, truth)
        self._times_s = [t_s for t_s, _ in scene.temperature.keyframes_c]
        self._degrees_c = [c for _, c in scene.temperature.keyframes_c]
        self._shift_c = 0.0
        self._none = self._touched = self._felt = np.zeros(0, np.intp)
        self._all = np.arange(n)
        self._covered = np.zeros(n)
        self.capacitance_ff = self.resting_ff.copy()
        self.held_ff = np.full(n, np.nan)
        self._set_probes(scene.probe, bare)
        self.temperature_step_c = 0.0

    def _set_probes(self, probes: list[Probe], bare: Collection[str]) -> None:
        self.probes: list[Probe] = []
        self.numbers = [i for i, probe in enumerate(probes) if probe.part not in bare]
        self._script = Script([probes[i] for i in self.numbers])
        self._places: list[tuple[Floats, Floats, slice]] = []
        for number in self.numbers:
            probe = probes[number]
            try:
                self._place_probe(probe)
            except ConfigurationError as error:
                raise ConfigurationError(f"probe[{number}].{error}") from None
        self._gather()
        self._active = np.zeros(0, np.intp)
        self._rows: dict[int, Footprint] = {}
        self._offset_mm = np.zeros((0, 2))
        self._footprint = _joined([])
        self._by_depth_now = np.zeros(0, bool)
        self._idle = True
        self._still_until_s = 0.0
        self._changed_ns = self._t_ns

    def _place_probe(self, probe: Probe) -> None:
        point_m, normal = resolve(probe.at, probe.part, self._layout)
        part = self._layout.part(probe.part)
        self._places.append((point_m * 1e3, normal, slice(part.start, part.stop)))
        self.probes.append(probe)

    def _gather(self) -> None:
        self._by_depth = np.array([probe.by_depth for probe in self.probes], bool)
        self._compliance = np.array([probe.compliance_mm_per_n for probe in self.probes])
        self._grounded = np.array([probe.kind == "grounded" for probe in self.probes], bool)

    def add_live(self, probe: Probe) -> int:
        """Add a probe that `set_live` moves; its number. Its keyframes are not used.

        Raises:
            ConfigurationError: there is no such part, triangle or taxel.
        """
        self._place_probe(probe)
        self._gather()
        return self._script.add_live()

    def set_live(self, number: int, drive: float, x_mm: float = 0.0, y_mm: float = 0.0) -> None:
        """Press with a live probe: force (N), or depth (mm) if it has `depth_mm` keyframes."""
        self._script.set_live(number, drive, x_mm, y_mm)
        self._changed_ns = self._t_ns

    @property
    def due_ns(self) -> int:
        """When the mechanics has to be worked out again: a time of its own grid."""
        if self._changed_ns == self._t_ns:
            return self._t_ns + MOVING_NS
        quiet = not len(self._active) and self._idle and self._t_ns * 1e-9 >= self._times_s[-1]
        due_ns = NEVER_NS if quiet else self._t_ns + self._holding_ns
        if np.isfinite(self._still_until_s):
            change_ns = round(self._still_until_s * 1e9)
            due_ns = min(due_ns, max(change_ns, self._t_ns + 1))
        return -(-max(due_ns, self._t_ns + 1) // MOVING_NS) * MOVING_NS

    @property
    def _holding_ns(self) -> int:
        """Foam relaxes fastest after a change, so the steps grow with the time since then."""
        return min(HOLDING_NS, (self._t_ns - self._changed_ns) // SETTLING_SHARE)

    def true_pressure_kpa(self) -> Floats:
        """True pressure of each pad, float64[n]: mean over the pad's whole area (kPa)."""
        return self._foam.pressure_kpa * self._covered

    def contact_force_n(self) -> dict[int, float]:
        """Force (N) of each probe that is in contact now, by its number in `probes`."""
        return dict(zip(self._active.tolist(), self._foam.force_n.tolist(), strict=True))

    def step(self, t_ns: int) -> Ints:
        """Go on to `t_ns`.

        Returns:
            The taxels whose capacitance may have changed; the same array as at the last step
            if they are the same.
        """
        dt_s = (t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        t_s = t_ns * 1e-9
        warmed = self._warm(t_s)
        touched = self._none
        moment = self._script.at(t_s)
        self._still_until_s = self._script.still_until_s(t_s)
        if self._still_until_s <= t_s:
            self._changed_ns = t_ns
        if len(moment.number) or not self._idle:
            touched = self._press(moment, dt_s)
        return self._all if warmed else touched

    def _warm(self, t_s: float) -> bool:
        now_c = float(np.interp(t_s, self._times_s, self._degrees_c))
        shift_c = now_c + self.temperature_step_c - REFERENCE_C
        if abs(shift_c - self._shift_c) < STEP_C:
            return False
        self.capacitance_ff += self._ff_per_c * (shift_c - self._shift_c)
        self._shift_c = shift_c
        return True

    def _press(self, moment: Moment, dt_s: float) -> Ints:
        number = moment.number
        if not np.array_equal(number, self._active) or (moment.offset_mm != self._offset_mm).any():
            self._place(moment)
        by_depth = self._by_depth_now
        felt = self._foam.step(
            self._footprint,
            Drive(
                np.where(by_depth, moment.drive, 0.0),
                np.where(by_depth, np.nan, moment.drive),
                self._compliance[number],
            ),
            dt_s,
        )
        rise_ff = self._pads.rise_ff(felt, self._footprint, self._grounded[number])
        if not np.array_equal(felt.taxel, self._felt):
            self._touched = np.union1d(felt.taxel, self._felt)
            self._felt = felt.taxel
        elif len(self._touched) > len(self._felt):
            self._touched = np.unique(self._felt)
        touched = self._touched
        self._idle = len(felt.taxel) == 0
        drifted_ff = self._ff_per_c[touched] * self._shift_c
        self.capacitance_ff[touched] = self.resting_ff[touched] + rise_ff[touched] + drifted_ff
        return touched

    def _place(self, moment: Moment) -> None:
        """Find out anew what the probes cover, for those that came or slid."""
        before = dict(zip(self._active.tolist(), self._offset_mm.tolist(), strict=True))
        for number, offset_mm in zip(
            moment.number.tolist(), moment.offset_mm.tolist(), strict=True
        ):
            if before.get(number) != offset_mm:
                self._rows[number] = self._cover(number, np.array(offset_mm))
        self._active, self._offset_mm = moment.number, moment.offset_mm
        self._by_depth_now = self._by_depth[moment.number]
        self._footprint = _joined([self._rows[number] for number in moment.number.tolist()])
        under = self._footprint.bears_mm2 > 0
        self._covered = np.bincount(
            self._footprint.taxel[under], self._footprint.covered[under], self._layout.n_taxels
        ).astype(np.float64)

    def _cover(self, number: int, offset_mm: Floats) -> Footprint:
        """What a probe covers, found among the pads of its part that face it."""
        probe = self.probes[number]
        point_mm, normal, part = self._places[number]
        along = tangents(normal)
        apart_mm = self._position_mm[part] - (point_mm + offset_mm @ along)
        facing = self._layout.normal[part] @ normal > FACING
        near = np.flatnonzero(facing & (np.abs(apart_mm @ normal) < REACH_MM)) + part.start
        pads = Pads(
            apart_mm[near - part.start] @ along.T,
            self._layout.radius_mm[near],
            self._thickness_mm[near],
            membrane_mm=self._membrane_mm,
        )
        if probe.size_mm is None:
            footprint = pads.footprint([Disc(0.0, 0.0, probe.diameter_mm)])
        else:
            footprint = pads.footprint([Rectangle(0.0, 0.0, *probe.size_mm, probe.turn_deg)])
        return Footprint(
            near[footprint.taxel],
            footprint.contact,
            footprint.covered,
            footprint.share,
            footprint.bears_mm2,
            footprint.area_mm2,
            footprint.edge,
        )


def _thermal_gain(layout: Layout) -> Floats:
    """How much each pad drifts with temperature, relative to a thermal pad.

    Pads beside thermal ones drift as the gains in the firmware say, for which they were
    measured; elsewhere nobody published a figure.
    """
    gain = np.full(layout.n_taxels, PLAIN_SHARE)
    for triangle in layout.triangles:
        taxels = slice(triangle.first, triangle.first + TAXELS)
        if (layout.pad_kind[taxels] == PadKind.THERMAL).any():
            skin_type = layout.boards[triangle.board].settings.skin_type
            gain[taxels] = np.array(GAIN if skin_type == 0 else GAIN_V2) / 128
    return gain


def _joined(footprints: list[Footprint]) -> Footprint:
    """Footprints of one contact each as one of several."""
    none, nobody = np.zeros(0), np.zeros(0, np.intp)
    return Footprint(
        np.concatenate([nobody, *(one.taxel for one in footprints)]),
        np.repeat(np.arange(len(footprints)), [len(one.taxel) for one in footprints]),
        np.concatenate([none, *(one.covered for one in footprints)]),
        np.concatenate([none, *(one.share for one in footprints)]),
        np.concatenate([none, *(one.bears_mm2 for one in footprints)]),
        np.concatenate([none, *(one.area_mm2 for one in footprints)]),
        np.concatenate([none, *(one.edge for one in footprints)]),
    )
