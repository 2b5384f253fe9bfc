"""Localisation error: methods against probes, pressing, noise and foam, with their cost."""

import time
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from emulator.probes.foam import Drive, Foam, FoamLayer
from emulator.probes.pads import UNIT_FF, Disc, Pads
from emulator.probes.viscoelastic import FoamTruth
from skin_host.layout import builtin_kinds
from skin_host.processing.localization import (
    PROBES_MM,
    Localizer,
    Method,
    make_localizer,
    separate,
)

Floats = NDArray[np.float64]

METHODS: tuple[Method, ...] = get_args(Method)
PITCH_MM, RADIUS_MM, FOAM_MM = 5.0, 2.1, 2.0
#: Far enough for a pad to touch the same thing as another (`layout.NEIGHBOUR_PITCHES`).
NEIGHBOUR_MM = 1.6 * PITCH_MM


@dataclass(frozen=True, slots=True)
class Case:
    """A press: probe, activation of a pad that it covers, noise, and the foam's cover.

    `membrane_mm` is how far the foam's surface is drawn down around the probe; 0 is a layer of
    independent springs, as the template assumes.
    """

    probe_mm: float
    units: float = 57.0
    noise_units: float = 0.4
    membrane_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class Errors:
    """Radial errors and estimated standard errors [n] of a method, mm; its time per contact."""

    error_mm: Floats
    said_mm: Floats
    ns: float

    @property
    def rms_mm(self) -> float:
        """Root of the mean square error."""
        return float(np.sqrt((self.error_mm**2).mean()))


def touched_above(noise_units: float) -> float:
    """Activation that counts as a touch: 95th percentile of the noise and 2 units."""
    return 2.0 + 1.645 * noise_units


def triangle_patch() -> Floats:
    """Pads of a triangle and of all that share an edge or a corner with it, [156, 2], mm."""
    kind = builtin_kinds()["triangle"]
    pads, outline = np.array(kind.pads_mm), np.array(kind.outline_mm)
    triangles = [pads]
    for corner in outline:
        for turn in range(1, 6):
            angle = np.deg2rad(60.0 * turn)
            cos, sin = np.cos(angle), np.sin(angle)
            turned = (pads - corner) @ np.array([[cos, sin], [-sin, cos]]) + corner
            apart = [np.linalg.norm(turned.mean(0) - other.mean(0)) for other in triangles]
            if min(apart) > 3.0:
                triangles.append(turned)
    return np.concatenate(triangles)


def among_the_pads(rng: np.random.Generator) -> Floats:
    """A place on the triangle that the outermost pads of the middle triangle span, mm."""
    low, high = np.sort(rng.uniform(size=2))
    corners = np.array([[-10.0, -5.774], [10.0, -5.774], [0.0, 11.547]])
    place: Floats = np.array([low, high - low, 1.0 - high]) @ corners
    return place


class PressedSkin:
    """The patch under the emulator's foam, pads and noise; new foam for every press."""

    def __init__(self, rng: np.random.Generator, membrane_mm: float = 0.0) -> None:
        self.centre_mm = triangle_patch()
        apart = np.linalg.norm(self.centre_mm[:, None] - self.centre_mm[None], axis=2)
        near = (apart > 0.0) & (apart < NEIGHBOUR_MM)
        self.neighbours = [np.flatnonzero(row).tolist() for row in near]
        self._rng = rng
        self._pads = Pads(self.centre_mm, RADIUS_MM, FOAM_MM, membrane_mm=membrane_mm)

    def read(self, probes: list[tuple[Floats, float, float]], noise_units: float) -> Floats:
        """Activation in whole units float64[n], half a second after the press.

        Args:
            probes: place mm [2], diameter mm, and units of a pad that the probe covers.
            noise_units: of each reading, before rounding.
        """
        n = len(self.centre_mm)
        foam = FoamLayer(Foam.drawn(n, self._rng, FOAM_MM), FoamTruth("S", n, rng=self._rng))
        footprint = self._pads.footprint(
            [Disc(float(place[0]), float(place[1]), size) for place, size, _ in probes]
        )
        rise_ff = np.array([units * UNIT_FF for _, _, units in probes])
        c0_ff = float(self._pads.c0_ff[0])
        depth = Drive.by_depth(FOAM_MM * rise_ff / (c0_ff + rise_ff))
        foam.step(footprint, depth, 0.02)
        felt = foam.step(footprint, depth, 0.5)
        units = self._pads.rise_ff(felt, footprint) / UNIT_FF
        noisy = units + noise_units * self._rng.normal(size=n)
        return np.clip(np.round(noisy), 0.0, 255.0)

    def contacts(self, units: Floats, noise_units: float) -> list[list[int]]:
        """Connected groups of touched taxels, the one with the strongest first."""
        left = set(np.flatnonzero(units > touched_above(noise_units)).tolist())
        groups = []
        while left:
            group = [left.pop()]
            for taxel in group:  # grows during the loop
                near = left.intersection(self.neighbours[taxel])
                left -= near
                group.extend(near)
            groups.append(sorted(group))
        return sorted(groups, key=lambda group: -units[group].max())


def localizer_for(method: Method, probe_mm: float | None, noise_units: float = 0.4) -> Localizer:
    """A localiser of the patch; `probe_mm` None leaves the template's sizes open."""
    centre = triangle_patch()
    n = len(centre)
    return make_localizer(
        method,
        1e-3 * np.column_stack([centre, np.zeros(n)]),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
        np.full(n, RADIUS_MM),
        probe_mm=PROBES_MM if probe_mm is None else probe_mm,
        noise_units=float(np.hypot(noise_units, 1.0 / np.sqrt(12.0))),
    )


def errors(
    case: Case,
    localizers: dict[str, Localizer],
    rng: np.random.Generator,
    presses: int,
    *,
    timed: bool = True,
) -> dict[str, Errors]:
    """Errors of several localisers on the same presses. Presses that touch nothing are left out.

    The time is that of a contact whose table is laid down, the least mean of five runs.
    """
    skin = PressedSkin(rng, case.membrane_mm)
    usable = np.ones(len(skin.centre_mm), bool)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in localizers}
    contacts: list[tuple[NDArray[np.intp], Floats]] = []
    for _ in range(presses):
        place = among_the_pads(rng)
        units = skin.read([(place, case.probe_mm, case.units)], case.noise_units)
        groups = skin.contacts(units, case.noise_units)
        if not groups:
            continue
        touched = np.array(groups[0])
        contacts.append((touched, units))
        for name, localizer in localizers.items():
            location = localizer.locate(touched, units, usable)
            if location is not None:
                off_mm = 1e3 * location.position_m[:2] - place
                found[name].append((float(np.hypot(*off_mm)), 1e3 * location.sigma_m))
    result = {}
    for name, localizer in localizers.items():
        table = np.array(found[name]).reshape(-1, 2)
        ns = _cost_ns(localizer, contacts[:50], usable) if timed else float("nan")
        result[name] = Errors(table[:, 0], table[:, 1], ns)
    return result


def _cost_ns(
    localizer: Localizer,
    contacts: list[tuple[NDArray[np.intp], Floats]],
    usable: NDArray[np.bool_],
) -> float:
    best = float("inf")
    for _ in range(5):
        start = time.perf_counter_ns()
        for touched, units in contacts:
            localizer.locate(touched, units, usable)
        best = min(best, (time.perf_counter_ns() - start) / len(contacts))
    return best


def separation(
    rng: np.random.Generator, apart_mm: float, presses: int, probe_mm: float = 8.0
) -> tuple[float, float]:
    """Two probes side by side, and one alone: shares of presses reported as two.

    The second probe presses at 70 % of the first's activation, in a random direction.
    """
    skin = PressedSkin(rng)
    told = np.zeros(2)
    for _ in range(presses):
        place, turn = among_the_pads(rng), rng.uniform(0.0, 2.0 * np.pi)
        other = place + apart_mm * np.array([np.cos(turn), np.sin(turn)])
        one = (place, probe_mm, 57.0)
        for case, probes in enumerate(([one, (other, probe_mm, 40.0)], [one])):
            units = skin.read(probes, 0.4)
            groups = skin.contacts(units, 0.4)
            told[case] += sum(len(separate(group, units, skin.neighbours)) for group in groups) == 2
    both, alone = told / presses
    return float(both), float(alone)
