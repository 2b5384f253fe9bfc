"""The skin of a robot: probes in, capacitance of every pad out, and the truth beside it.

Mechanics runs for contacts and for foam that still recovers; a pad that nobody touches keeps
its capacitance and costs nothing.
"""

from bisect import bisect_right
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.boards.arithmetic import TAXELS
from emulator.chips.noise import SENT_UNIT_FF, PadNoise
from emulator.probes.contacts import ContactPads, Contacts, ContactSource, joined
from emulator.probes.coverage import Coverage
from emulator.probes.foam import INFINERGY_LOSS, Drive, Foam, FoamLayer, Footprint, deepest_mm
from emulator.probes.pads import Jumps, Pads, draw_dead, draw_noise_ff, draw_resting_ff
from emulator.probes.scene import Air, AirCourse, Moment, Probe, Scene, Script, read_air
from emulator.probes.viscoelastic import FoamTruth
from skin_host.bus.compensation import GAIN, GAIN_V2
from skin_host.errors import ConfigurationError
from skin_host.layout import Layout, PadKind

#: Change of a thermal pad with temperature (fF per degree): some ten codes.
THERMAL_FF_PER_C = 3.6
#: Change of the other pads relative to the thermal one, where the firmware compensates it.
THERMAL_SPREAD = 0.05
#: Without thermal pads beside them, pads drift about half as much.
PLAIN_SHARE = 0.5
REFERENCE_C = 25.0
#: Temperature is passed on in steps of this size.
STEP_C = 0.01
#: While drives change, mechanics is worked out this often; all its times are multiples of it.
MOVING_NS = 5_000_000
#: While probes are held, foam recovers or the temperature moves, this is enough, after a time.
HOLDING_NS = 50_000_000
#: So many steps of sliding probes are foreseen at most, and so many places of probes.
MOST_FORESEEN = 128
MOST_PLACES = 1 << 17
#: Air changes slowly enough for this.
AIR_NS = 20_000_000
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
        noise: of the pads of each triangle; None is no noise at all.
        noise_ff: float64[n], its rms.
        probes: the scene's probes on skin, then the live ones.
        numbers: of the former, in the scene.
        is_still: nothing that is touched has changed in the last step: only foam recovers.

    Args:
        layout: of the skin.
        scene: what happens to it.
        bare: names of fingertips without skin; the probes on them are none of ours.
        source: contacts that press besides the scene's probes.
    """

    def __init__(
        self,
        layout: Layout,
        scene: Scene,
        bare: Collection[str] = (),
        source: ContactSource | None = None,
    ) -> None:
        n = layout.n_taxels
        self._t_ns = 0
        rng = np.random.default_rng([scene.seed, 1])
        self._layout = layout
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
            truth = _truth(scene, n, rng)
            self.resting_ff = draw_resting_ff(n, rng)
            spread = 1 + THERMAL_SPREAD * rng.standard_normal(n)
        else:
            foam = Foam.uniform(n, thickness_mm)
            truth = _truth(scene, n, None)
            self.resting_ff = np.full(n, 7800.0)
            spread = np.ones(n)
        self._ff_per_c = THERMAL_FF_PER_C * _thermal_gain(layout) * spread
        self._ff_per_c[layout.pad_kind == PadKind.THERMAL] = THERMAL_FF_PER_C
        if scene.foam == "infinergy":
            foam = foam.infinergy()
        self._foam = FoamLayer(foam, truth)
        self._draw_flaws(scene, rng)
        self._times_s = [float(t_s) for t_s, _ in scene.temperature.keyframes_c]
        self._degrees_c = [float(c) for _, c in scene.temperature.keyframes_c]
        self._warmed_s = self._times_s[-1]
        self._shift_c = 0.0
        self._none = self._touched = self._felt = self._jumping = np.zeros(0, np.intp)
        self._is_left = False
        self.is_still = False
        self._set_untouched()
        self._all = np.arange(n)
        self.capacitance_ff = self.resting_ff.copy()
        self.held_ff = np.where(self._dead, self.resting_ff, np.nan)
        self._set_probes(scene.probe, bare)
        self._source = source
        self._contact_pads = ContactPads(layout)
        #: What the source gave last, and when the footprint was last found; which of it is on
        #: skin, and what that covers.
        self._given = self._placed = Contacts.none()
        self._on_skin = np.zeros(0, bool)
        self._pressed = Footprint.empty()
        self._set_air(scene.air)
        self.temperature_step_c = 0.0

    def _draw_flaws(self, scene: Scene, rng: np.random.Generator) -> None:
        """Noise, jumps and dead pads: those of the paper's good skin, or of real robots' skin."""
        n = self._layout.n_taxels
        triangles = n // TAXELS
        self.noise = PadNoise.normal(triangles) if scene.noise else None
        self.noise_ff = np.zeros(n)
        self._jumps, self._dead = Jumps.none(n), np.zeros(n, bool)
        if scene.noise and scene.quiet:
            self.noise_ff = draw_noise_ff(n, rng)
        elif scene.noise:
            rng = np.random.default_rng([scene.seed, 7])
            thermal = self._layout.pad_kind == PadKind.THERMAL
            calm = [unit.kind.startswith("fingertip") for unit in self._layout.triangles]
            self.noise = PadNoise.drawn(thermal.reshape(-1, TAXELS), rng, np.array(calm))
            # Fingertips were measured in their own units, which are finer than those of others.
            unit_ff = np.where(np.repeat(calm, TAXELS), self._layout.unit_ff, SENT_UNIT_FF)
            self.noise_ff = unit_ff * self.noise.rms_units.reshape(-1)
            self._jumps = Jumps.drawn(thermal.reshape(-1, TAXELS), rng)
            self._dead = draw_dead(n, rng) & ~thermal

    def _set_probes(self, probes: list[Probe], bare: Collection[str]) -> None:
        self.probes: list[Probe] = []
        self.numbers = [i for i, probe in enumerate(probes) if probe.part not in bare]
        self._script = Script([probes[i] for i in self.numbers])
        self._coverage = Coverage(self._layout, self._thickness_mm, self._membrane_mm)
        for number in self.numbers:
            probe = probes[number]
            try:
                self._place_probe(probe)
                self._check_depth(probe)
            except ConfigurationError as error:
                raise ConfigurationError(f"probe[{number}].{error}") from None
        self._gather()
        moment = self._script.at(0.0)
        self._active = np.zeros(0, np.intp)
        #: How probes slid when they were placed last, and when that was.
        self._slide, self._placed_s = moment.slide, 0.0
        self._footprint = Footprint.empty()
        #: Footprints of the next steps of sliding probes, the next one last, and its time.
        self._foreseen: list[Footprint] = []
        self._foreseen_ns = 0
        self._came_true = 0
        self._by_depth_now = np.zeros(0, bool)
        self._compliance_now = np.zeros(0)
        self._grounded_now = np.zeros(0, bool)
        self._of_probes = self._footprint
        self._idle = True
        self._still_until_s = 0.0
        self._changed_ns = self._t_ns

    def _set_air(self, airs: list[Air]) -> None:
        """Where air presses, and its courses."""
        self._air_kpa = np.zeros(self._layout.n_taxels)
        self._air: list[tuple[AirCourse, Ints]] = []
        for number, air in enumerate(airs):
            try:
                part = self._layout.part(air.part)
                keyframes = read_air(Path(air.file)) if air.file else air.pressure_kpa
            except KeyError:
                known = ", ".join(one.name for one in self._layout.parts)
                what = f'no part "{air.part}"; there are: {known}'
                raise ConfigurationError(f"air[{number}].part: {what}") from None
            except ConfigurationError as error:
                raise ConfigurationError(f"air[{number}].file: {error}") from None
            course = AirCourse.of(keyframes, air.start_s)
            self._air.append((course, np.arange(part.start, part.stop)))
        taxels = [taxels for _, taxels in self._air]
        self._under_air = np.concatenate([np.zeros(0, np.intp), *taxels])
        self._air_shows = False

    def _place_probe(self, probe: Probe) -> None:
        self._coverage.add(probe)
        self.probes.append(probe)

    def _check_depth(self, probe: Probe) -> None:
        """Refuse keyframes that drive a probe deeper than the foam of its part."""
        if probe.depth_mm is None:
            return
        foam_mm = self._layout.part(probe.part).foam_mm
        most_mm = deepest_mm(foam_mm, probe.area_mm2, probe.compliance_mm_per_n)
        if (depth_mm := max(depth for _, depth in probe.depth_mm)) > most_mm:
            raise ConfigurationError(
                f'depth_mm: {depth_mm:g} mm on "{probe.part}", whose foam is {foam_mm:g} mm; '
                f"wanted up to {most_mm:.3g} mm"
            )

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
        if self._changed_ns == self._t_ns or self._source is not None:
            return self._t_ns + MOVING_NS
        quiet = not len(self._active) and self._idle and self._t_ns * 1e-9 >= self._warmed_s
        due_ns = NEVER_NS if quiet else self._t_ns + self._holding_ns
        if self._still_until_s < np.inf:
            change_ns = round(self._still_until_s * 1e9)
            due_ns = min(due_ns, max(change_ns, self._t_ns + 1))
        due_ns = min(due_ns, self._air_due_ns)
        return -(-max(due_ns, self._t_ns + 1) // MOVING_NS) * MOVING_NS

    @property
    def _air_due_ns(self) -> int:
        """When air has to be worked out again."""
        if not self._air:
            return NEVER_NS
        t_s = self._t_ns * 1e-9
        if self._air_shows or any(course.start_s <= t_s < course.end_s for course, _ in self._air):
            return self._t_ns + AIR_NS
        starts_s = [course.start_s for course, _ in self._air if course.start_s > t_s]
        return round(min(starts_s) * 1e9) if starts_s else NEVER_NS

    @property
    def _holding_ns(self) -> int:
        """Foam relaxes fastest after a change, so the steps grow with the time since then."""
        return min(HOLDING_NS, (self._t_ns - self._changed_ns) // SETTLING_SHARE)

    def true_pressure_kpa(self) -> Floats:
        """True pressure of each pad, float64[n]: mean over the pad's whole area (kPa)."""
        return self._foam.mean_kpa() + self._air_kpa

    def contact_force_n(self) -> dict[int, float]:
        """Force (N) of each probe that is in contact now, by its number in `probes`."""
        return dict(zip(self._active.tolist(), self._foam.force_n.tolist(), strict=False))

    @property
    def contacts(self) -> Contacts:
        """The source's contacts that are on skin now."""
        return self._given.take(self._on_skin)

    @property
    def contacts_beside(self) -> Contacts:
        """The source's contacts that meet a part's body where it has no skin now."""
        return self._given.take(~self._on_skin)

    def source_force_n(self) -> Floats:
        """Force (N) with which each of `contacts` presses the foam, float64[c]."""
        return self._foam.force_n[len(self._active) :]

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
        self.is_still = False
        moment = self._script.at(t_s)
        self._still_until_s = self._script.still_until_s(t_s)
        if self._still_until_s <= t_s:
            self._changed_ns = t_ns
        given = self._given if self._source is None else self._source.at(t_ns)
        if len(moment.number) or len(given) or not self._idle:
            touched = self._press(moment, given, dt_s)
        if self._air and self._blow(t_s, dt_s):
            touched = (
                np.concatenate([touched, self._under_air]) if len(touched) else self._under_air
            )
        if not warmed:
            return touched
        self.is_still = False
        return self._all

    def _blow(self, t_s: float, dt_s: float) -> bool:
        """Let air press; whether anything is, or was until now, squeezed by it."""
        before, self._air_shows = self._air_shows, False
        truth = self._foam.truth
        for course, taxels in self._air:
            kpa = course.kpa_at(t_s)
            if not (kpa or before):
                continue
            elastic_kpa = truth.step_pressure(np.full(len(taxels), kpa), dt_s, taxels)
            shows = kpa > 0 or bool((elastic_kpa >= self._foam.RESIDUAL_OVER_KPA).any())
            if not shows:
                truth.reset(taxels)
                elastic_kpa = np.zeros(len(taxels))
            self._air_shows |= shows
            self._air_kpa[taxels] = kpa
            strain = self._foam.foam.take(taxels).strain(elastic_kpa)
            rise_ff = np.where(self._pads.cover[taxels], self._pads.c0_ff[taxels], 0.0)
            rise_ff *= strain / (1 - strain)
            rise_ff += self._jumps.step_ff(taxels, self._air_kpa[taxels])
            drifted_ff = self._ff_per_c[taxels] * self._shift_c
            self.capacitance_ff[taxels] = self.resting_ff[taxels] + rise_ff + drifted_ff
        return before or self._air_shows

    def _warm(self, t_s: float) -> bool:
        now_c = self._degrees_c[-1]
        if t_s < self._warmed_s:
            times_s, degrees_c = self._times_s, self._degrees_c
            after = bisect_right(times_s, t_s)
            now_c = degrees_c[0]
            if after:
                began_s, began_c = times_s[after - 1], degrees_c[after - 1]
                slope = (degrees_c[after] - began_c) / (times_s[after] - began_s)
                now_c = slope * (t_s - began_s) + began_c
        shift_c = now_c + self.temperature_step_c - REFERENCE_C
        if abs(shift_c - self._shift_c) < STEP_C:
            return False
        self.capacitance_ff += self._ff_per_c * (shift_c - self._shift_c)
        self._shift_c = shift_c
        self._set_untouched()
        return True

    def _press(self, moment: Moment, given: Contacts, dt_s: float) -> Ints:
        number = moment.number
        same = number is self._active or np.array_equal(number, self._active)
        still = given is self._placed or given.is_still(self._placed)
        self._given = given
        slide = moment.slide
        if slide.moves or slide is not self._slide or not (same and still):
            self._place(moment, same=same, still=still)
        value = moment.drive
        if len(self._pressed.area_mm2):
            value = np.append(value, given.force_n[self._on_skin])
        drive = Drive(value, self._by_depth_now, self._compliance_now)
        felt = self._foam.step(self._footprint, drive, dt_s)
        if self._foam.is_still and felt.taxel is self._felt and not (self._is_left or self._air):
            self.is_still = True
            return self._touched
        if felt.taxel is not self._felt or self._is_left:
            self._touch(felt.taxel)
        touched = self._touched
        rise_ff = self._pads.row_rise_ff(felt, self._footprint, self._grounded_now)
        is_alone = touched is felt.taxel
        if not is_alone:
            of_pad_ff = np.bincount(felt.taxel, rise_ff, self._layout.n_taxels)
            rise_ff = of_pad_ff[touched].astype(np.float64, copy=False)
        if len(self._jumping):
            pads = touched[self._jumping]
            # Foam that nothing presses any more is under no pressure, however it was covered.
            if is_alone and not self._membrane_mm:
                pressure_kpa = self._foam.pressure_kpa[pads] * felt.covered[self._jumping]
            else:
                pressure_kpa = self._foam.mean_kpa()[pads]
            rise_ff[self._jumping] += self._jumps.step_ff(pads, pressure_kpa)
        self.capacitance_ff[touched] = self._untouched_ff + rise_ff
        return touched

    def _touch(self, felt: Ints) -> None:
        """Take over which pads are felt; those that were felt until now change once more."""
        self._idle = len(felt) == 0
        was_felt, is_felt = np.zeros((2, self._layout.n_taxels), bool)
        was_felt[self._felt] = is_felt[felt] = True
        self._felt = felt
        touched, left = np.flatnonzero(is_felt), np.flatnonzero(was_felt & ~is_felt)
        is_twice = len(touched) < len(felt)
        self._is_left = len(left) > 0
        if self._is_left:
            touched = np.concatenate([touched, left])
        elif not is_twice:
            touched = felt
        self._touched = touched
        self._jumping = np.flatnonzero(self._jumps.can[self._touched])
        self._set_untouched()

    def _set_untouched(self) -> None:
        """What the touched pads would measure untouched."""
        pads = self._touched
        self._untouched_ff = self.resting_ff[pads] + self._ff_per_c[pads] * self._shift_c

    def _place(self, moment: Moment, *, same: bool, still: bool) -> None:
        """Find out what is covered, when something came, went or slid.

        `same` are the probes; `still` are the source's contacts.
        """
        number = moment.number
        of_probes = self._cover(moment, same=same)
        self._active, self._slide, self._placed_s = number, moment.slide, moment.t_s
        if still and of_probes is self._of_probes:
            return
        self._of_probes = of_probes
        if not still:
            self._placed = self._given
            self._on_skin, self._pressed = self._contact_pads.place(self._given)
        if not (same and still):
            none = np.zeros(len(self._pressed.area_mm2))
            self._by_depth_now = np.append(self._by_depth[number], none > 0)
            self._compliance_now = np.append(self._compliance[number], none)
            self._grounded_now = np.append(self._grounded[number], none > 0)
        self._footprint = joined(of_probes, self._pressed)

    def _cover(self, moment: Moment, *, same: bool) -> Footprint:
        """What the probes cover, the `same` as in the last step; as it was foreseen, if it was."""
        slide = moment.slide
        if self._foreseen and slide is self._slide and self._t_ns == self._foreseen_ns:
            self._came_true += 1
            self._foreseen_ns += MOVING_NS
            return self._foreseen.pop()
        offset_mm = moment.offset_mm
        if same and np.array_equal(offset_mm, self._slide.offset_mm(self._placed_s)):
            return self._of_probes
        if not slide.moves:
            return self._coverage.footprint(moment.number, offset_mm)
        # Twice as far ahead as what was foreseen came true, and not beyond the next keyframe.
        until_end = (self._script.next_keyframe_s - moment.t_s) / (MOVING_NS * 1e-9)
        ahead = min(2 * self._came_true, MOST_FORESEEN, MOST_PLACES // len(moment.number))
        steps = max(1, int(min(ahead, np.ceil(until_end))))
        self._came_true = 1
        step_mm = slide.mm_per_s.T * (MOVING_NS * 1e-9)
        now, *self._foreseen = self._coverage.footprints(moment.number, offset_mm, step_mm, steps)
        self._foreseen.reverse()
        self._foreseen_ns = self._t_ns + MOVING_NS
        return now


def _truth(scene: Scene, n: int, rng: np.random.Generator | None) -> FoamTruth:
    """The foam's memory under n taxels, drawn if there is a generator."""
    if scene.foam == "infinergy":
        return FoamTruth("F", n, rng, loss=INFINERGY_LOSS)
    return FoamTruth(scene.foam, n, rng)


def _thermal_gain(layout: Layout) -> Floats:
    """How much each pad drifts with temperature, relative to a thermal pad.

    Pads beside thermal ones drift by the gains in the firmware, for which they were
    measured; elsewhere nobody published a figure.
    """
    gain = np.full(layout.n_taxels, PLAIN_SHARE)
    for triangle in layout.triangles:
        taxels = slice(triangle.first, triangle.first + TAXELS)
        if (layout.pad_kind[taxels] == PadKind.THERMAL).any():
            skin_type = layout.boards[triangle.board].settings.skin_type
            gain[taxels] = np.array(GAIN if skin_type == 0 else GAIN_V2) / 128
    return gain
