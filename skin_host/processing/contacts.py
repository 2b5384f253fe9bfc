"""Touched taxels that lie together are one contact, and a contact has a life."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skin_host.layout import Layout, PadKind
from skin_host.processing.localization import Localizer, make_localizer, separate
from skin_host.processing.localization_centroid import GEOMETRY_PITCHES
from skin_host.processing.pipeline import PressureFrame
from skin_host.processing.pressure import PressureCurve
from skin_host.settings import Settings

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: What must change before another `move` is worth a message.
MOVED_M = 0.2e-3
PRESSED_KPA = 2.0
PRESSED_SHARE = 0.1
#: A contact in which nothing changes says so this often: it is still there.
ALIVE_NS = 1_000_000_000
#: Below this peak a contact is all but gone, and where it is only noise would tell; above it
#: an untouched taxel may be about to be touched.
FELT_KPA = 2.0
#: Pieces of a contact are contacts of their own when they have been apart for so long.
PARTED_NS = 150_000_000
#: A touched taxel of which nothing is heard for less than this is taken to be touched still.
LOST_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class Load:
    """What a force/torque board says of the contact on its fingertip.

    Attributes:
        verdict: whether one push on the surface gives this force and torque.
        force_n, torque_nm: of what touches on the fingertip, about the origin of its frame.
        shear_n: the share of the force along the surface; None without a place.
        flags: of the finger, see `fingertip.grasp.Flags`, in lower case.
    """

    verdict: Literal["contact", "no_single_contact", "several_contacts", "saturated"]
    force_n: list[float]
    torque_nm: list[float]
    shear_n: list[float] | None
    flags: list[str]


@dataclass(frozen=True, slots=True)
class TouchEvent:
    """A contact begins, moves or ends.

    Taxels are numbered within their part. Positions are in the part's frame. `sigma_m` is the
    radial standard error of `centroid_m`, in the skin; None where the place is not known. `end`
    tells where the contact was last, and its pressures are 0. Without skin, on a fingertip that
    has nothing but a force/torque board, area and pressures are NaN; `load` is told there only.
    """

    event: Literal["begin", "move", "end"]
    id: int
    seq: int
    t_ns: int
    part: str
    taxels: list[int]
    centroid_m: list[float] | None
    normal: list[float] | None
    area_mm2: float
    peak_kpa: float
    mean_kpa: float
    force_n: float
    sigma_m: float | None = None
    load: Load | None = None

    def ended(self, seq: int, t_ns: int) -> "TouchEvent":
        """The contact's end: where it was last; what is known of its pressures is 0."""
        nothing_kpa = math.nan if math.isnan(self.area_mm2) else 0.0
        return replace(
            self,
            event="end",
            seq=seq,
            t_ns=t_ns,
            peak_kpa=nothing_kpa,
            mean_kpa=nothing_kpa,
            force_n=0.0,
        )


@dataclass(slots=True)
class _Contact:
    taxels: frozenset[int]
    said: TouchEvent
    heard_ns: int
    #: Since when it has been in pieces.
    parted_ns: int | None = None


class ContactTracker:
    """Finds the contacts of one part in each frame and follows them over time.

    With the part's `localization` left at `centroid`, a connected patch of touched taxels is
    one contact at its mean weighted by force. With any other, a patch with several clear
    maxima is several contacts, and each is located from activations. The template's table of
    a pad is laid down when it is first the strongest, which once takes some 30 ms.
    """

    def __init__(self, layout: Layout, part_index: int, settings: Settings) -> None:
        part = layout.parts[part_index]
        mine = slice(part.start, part.stop)
        self._name = part.name
        start = layout.neighbour_start[part.start : part.stop + 1].tolist()
        neighbour = (layout.neighbour - part.start).tolist()
        self._neighbours = [neighbour[begin:end] for begin, end in pairwise(start)]
        self._position_m = layout.position_m[mine]
        self._normal = layout.normal[mine]
        self._area_mm2 = layout.area_mm2[mine]
        self._shortest_ns = int(1e9 / settings.processing.touch.move_hz)
        self._pitch_m = _pitch_m(self._position_m, self._neighbours)
        self._places: _Places | None = None
        if settings.parts[part.name].localization != "centroid":
            self._places = _Places(layout, part_index, settings)
        self._contacts: dict[int, _Contact] = {}
        self._next_id = 1

    def step(self, frame: PressureFrame) -> list[TouchEvent]:
        """Return what happened since the last frame: ends first, then moves and begins."""
        if not self._contacts and not np.count_nonzero(frame.touched):
            return []
        groups = self._joined(self._groups(self._touched(frame)), frame)
        if self._places is not None:
            groups = self._places.look(frame, groups, self._neighbours)
        groups = self._kept_whole(groups, frame)
        names = self._identify(groups)
        events = [
            self._closed(name, frame.seq, frame.t_ns)
            for name in list(self._contacts)
            if name not in names
        ]
        for name, taxels in zip(names, groups, strict=True):
            known = self._contacts.get(name)
            event = self._described(name, taxels, frame, None if known is None else known.said)
            if known is None:
                self._contacts[name] = _Contact(taxels, event, frame.t_ns)
                events.append(event)
                continue
            known.taxels = taxels
            heard = frame.valid[event.taxels]
            if heard.all():
                known.heard_ns = frame.t_ns
            if heard.any() and self._worth_saying(known.said, event):
                known.said = event
                events.append(event)
        return events

    def end_all(self, seq: int, t_ns: int) -> list[TouchEvent]:
        """End every contact: the part will not be heard of for a while."""
        return [self._closed(name, seq, t_ns) for name in list(self._contacts)]

    def _touched(self, frame: PressureFrame) -> list[int]:
        """Touched taxels in order, with those of a contact of which nothing was received.

        A lost frame is not the end of a touch.
        """
        touched: list[int] = np.flatnonzero(frame.touched).tolist()
        silent = {
            taxel
            for contact in self._contacts.values()
            if 0 <= frame.t_ns - contact.heard_ns < LOST_NS
            for taxel in contact.taxels
            if not frame.valid[taxel]
        }
        return sorted(silent.union(touched)) if silent else touched

    def _groups(self, touched: list[int]) -> list[frozenset[int]]:
        """Connected sets of touched taxels, in the order of their lowest number."""
        left = set(touched)
        groups = []
        for first in touched:
            if first not in left:
                continue
            left.remove(first)
            group = [first]
            for taxel in group:  # grows while it is walked
                for other in self._neighbours[taxel]:
                    if other in left:
                        left.remove(other)
                        group.append(other)
            groups.append(frozenset(group))
        return groups

    def _joined(self, groups: list[frozenset[int]], frame: PressureFrame) -> list[frozenset[int]]:
        """The groups, with each new one joined to those that it will grow together with.

        What lands on the skin passes the thresholds of its taxels one by one. Those between
        two that have passed feel something already.
        """
        if len(groups) < 2 or self._are_as_before(groups):
            return groups
        known = set().union(*(contact.taxels for contact in self._contacts.values()))
        if not any(known.isdisjoint(group) for group in groups):
            return groups
        felt = set(np.flatnonzero(frame.pressure_kpa >= FELT_KPA).tolist()).union(*groups)
        joined: list[frozenset[int]] = []
        left = list(groups)
        while left:
            group = left.pop(0)
            if not group & known:
                reached = self._reach(group, felt)
                near = [other for other in [*joined, *left] if other & reached]
                joined = [other for other in joined if not other & reached]
                left = [other for other in left if not other & reached]
                group = group.union(*near)
            joined.append(group)
        return sorted(joined, key=min)

    def _are_as_before(self, groups: list[frozenset[int]]) -> bool:
        """Whether each group is a contact that had the same taxels."""
        return {contact.taxels for contact in self._contacts.values()}.issuperset(groups)

    def _reach(self, group: frozenset[int], among: set[int]) -> set[int]:
        """Taxels that a group is connected with through others of a set."""
        reached = set(group)
        way = list(group)
        for taxel in way:  # grows while it is walked
            for other in self._neighbours[taxel]:
                if other in among and other not in reached:
                    reached.add(other)
                    way.append(other)
        return reached

    def _kept_whole(
        self, groups: list[frozenset[int]], frame: PressureFrame
    ) -> list[frozenset[int]]:
        """The groups, with pieces of one contact taken together that have just come apart.

        As a contact begins or lets go its taxels pass their thresholds one by one, and for a
        moment it is an archipelago. Pieces that hardly feel anything never become contacts.
        """
        if self._are_as_before(groups):
            for contact in self._contacts.values():
                contact.parted_ns = None
            return groups
        home = {taxel: name for name, contact in self._contacts.items() for taxel in contact.taxels}
        pieces: dict[int, list[frozenset[int]]] = {name: [] for name in self._contacts}
        kept = []
        for group in groups:
            overlaps = Counter(home[taxel] for taxel in sorted(group) if taxel in home)
            if overlaps:
                pieces[overlaps.most_common(1)[0][0]].append(group)
            else:
                kept.append(group)
        for name, parts in pieces.items():
            contact = self._contacts[name]
            if len(parts) < 2:
                contact.parted_ns = None
                kept += parts
                continue
            if contact.parted_ns is None:
                contact.parted_ns = frame.t_ns
            strong = [part for part in parts if frame.pressure_kpa[list(part)].max() >= FELT_KPA]
            if 0 <= frame.t_ns - contact.parted_ns < PARTED_NS or len(strong) < 2:
                kept.append(frozenset().union(*parts))
            else:
                strong.sort(key=len)
                kept += [*strong[:-1], strong[-1].union(*(set(parts) - set(strong)))]
        return sorted(kept, key=min)

    def _identify(self, groups: list[frozenset[int]]) -> list[int]:
        """Give each group the name of the contact that it continues, or a new one.

        The largest overlap decides; of equal ones the older contact. A group next to
        where a contact was continues it too, if nothing overlaps it: it slid.
        """
        claims = []
        for number, group in enumerate(groups):
            reach = group.union(*(self._neighbours[taxel] for taxel in group))
            for name, contact in self._contacts.items():
                overlap = len(group & contact.taxels)
                near = overlap or len(reach & contact.taxels)
                if near:
                    claims.append((not overlap, -near, name, number))
        names: dict[int, int] = {}
        for _, _, name, number in sorted(claims):
            if number not in names and name not in names.values():
                names[number] = name
        for number in range(len(groups)):
            if number not in names:
                names[number] = self._next_id
                self._next_id += 1
        return [names[number] for number in range(len(groups))]

    def _described(
        self, name: int, taxels: frozenset[int], frame: PressureFrame, before: TouchEvent | None
    ) -> TouchEvent:
        index = sorted(taxels)
        pressure = frame.pressure_kpa[index].astype(np.float64)
        area = self._area_mm2[index]
        area_mm2 = float(area.sum())
        weight = pressure * area
        total = float(weight.sum())
        peak = float(pressure.max())
        centroid = normal = sigma = None
        if before is not None and peak < FELT_KPA:
            centroid, normal, sigma = before.centroid_m, before.normal, before.sigma_m
        elif total > 0.0:
            if self._places is not None:
                centroid, sigma = self._places.locate(index)
            else:
                centroid = (weight @ self._position_m[index] / total).tolist()
                # Noise adds little to what the coarse pads leave open.
                sigma = GEOMETRY_PITCHES * self._pitch_m / math.sqrt(len(index))
            direction = weight @ self._normal[index]
            length = float(np.linalg.norm(direction))
            normal = (direction / length).tolist() if length > 1e-9 * total else None
        return TouchEvent(
            "begin" if before is None else "move",
            name,
            frame.seq,
            frame.t_ns,
            self._name,
            index,
            centroid,
            normal,
            area_mm2,
            peak,
            total / area_mm2,
            total * 1e-3,  # kPa mm2 is mN
            sigma,
        )

    def _closed(self, name: int, seq: int, t_ns: int) -> TouchEvent:
        return self._contacts.pop(name).said.ended(seq, t_ns)

    def _worth_saying(self, said: TouchEvent, now: TouchEvent) -> bool:
        if 0 <= now.t_ns - said.t_ns < self._shortest_ns:
            return False
        if now.taxels != said.taxels or now.t_ns - said.t_ns >= ALIVE_NS:
            return True
        change = abs(now.peak_kpa - said.peak_kpa)
        if change > max(PRESSED_KPA, PRESSED_SHARE * said.peak_kpa):
            return True
        if now.centroid_m is None or said.centroid_m is None:
            return now.centroid_m is not said.centroid_m
        moved = np.subtract(now.centroid_m, said.centroid_m)
        return float(np.linalg.norm(moved)) > MOVED_M


class _Places:
    """Contacts of one part told apart and located by the method that it is configured with.

    Pressures are turned back into activations of one and the same pad, the part's median:
    pads of other sizes, shifts and strengths then read alike where they are covered alike.
    """

    def __init__(self, layout: Layout, part_index: int, settings: Settings) -> None:
        part = layout.parts[part_index]
        chosen = settings.parts[part.name]
        mine = slice(part.start, part.stop)
        self._localizer: Localizer = make_localizer(
            chosen.localization,
            layout.position_m[mine],
            layout.normal[mine],
            layout.radius_mm[mine],
            probe_mm=chosen.probe_mm,
        )
        pads = layout.pad_kind[mine] == PadKind.PRESSURE
        unit_ff = (layout.unit_ff[mine] / layout.sensitivity[mine])[pads]
        pressure = settings.processing.pressure
        self._curve = PressureCurve(
            np.median(unit_ff) if len(unit_ff) else 1.0,
            a=pressure.a_kpa_per_ff2,
            b=pressure.b_kpa_per_ff,
        )
        self._units: Floats = np.zeros(part.n_taxels)
        self._believed: Mask = np.zeros(part.n_taxels, np.bool_)
        self._free: Mask = np.zeros(part.n_taxels, np.bool_)

    def look(
        self,
        frame: PressureFrame,
        patches: list[frozenset[int]],
        neighbours: Sequence[Sequence[int]],
    ) -> list[frozenset[int]]:
        """Take in a frame and its connected patches; return its contacts."""
        self._units = self._curve.units(frame.pressure_kpa)
        self._free = frame.valid.copy()
        contacts = []
        for patch in patches:
            taxels = sorted(patch)
            self._free[taxels] = False
            contacts += [frozenset(g) for g in separate(taxels, self._units, neighbours)]
        self._believed = frame.valid
        return contacts

    def locate(self, taxels: list[int]) -> tuple[list[float] | None, float | None]:
        """Position in the part's frame and its standard error, m, of one of the contacts."""
        index = np.array(taxels, np.intp)
        usable = self._free.copy()
        usable[index] = self._believed[index]
        location = self._localizer.locate(index, self._units, usable)
        if location is None:
            return None, None
        return location.position_m.tolist(), location.sigma_m


def _pitch_m(position_m: Floats, neighbours: Sequence[Sequence[int]]) -> float:
    """Median distance of taxels to their nearest neighbour; 0 where none has any."""
    nearest = [
        float(np.linalg.norm(position_m[near] - position_m[taxel], axis=1).min())
        for taxel, near in enumerate(neighbours)
        if near
    ]
    return float(np.median(nearest)) if nearest else 0.0
