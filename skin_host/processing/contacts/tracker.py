"""Follows the contacts of a part from frame to frame, and reports what changes."""

import math

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings
from skin_host.layout import Layout
from skin_host.processing.contacts.former import Decision, Former
from skin_host.processing.contacts.grouping import Followed, Grouping, Homes
from skin_host.processing.contacts.held import Held
from skin_host.processing.contacts.neighbours import Near, Unfelt
from skin_host.processing.contacts.places import Places
from skin_host.processing.curves import common_curve
from skin_host.processing.events import Reason, Touch, Vector
from skin_host.processing.frame import PressureFrame
from skin_host.processing.localization_centroid import GEOMETRY_PITCHES
from skin_host.processing.masks import Mask, all_of, any_of

Floats = NDArray[np.float64]

#: Smallest change for another `move` event.
MOVED_M = 0.2e-3
PRESSED_KPA = 2.0
PRESSED_SHARE = 0.1
#: A contact without changes is reported this often, so that subscribers know that it lasts.
ALIVE_NS = 1_000_000_000
#: Below this peak a contact has almost ended and its place is mostly noise; above it an untouched
#: taxel may become touched soon. In fine units it is so many of them: touches begin at 1.5 or more.
FELT_KPA = 2.0
FELT_UNITS = 1.25
#: Pieces of a contact become separate contacts when they have been apart for this long.
PARTED_NS = 150_000_000
#: A piece that feels less than this share of what the contact felt is a remainder of it: noisy
#: taxels release late. The contact's own value fades in the second time, which is longer than foam
#: that is not fitted takes to recover to `FELT_KPA`: it keeps up to 7 % of a hard press at first.
PIECE_SHARE = 0.2
FADES_NS = 10_000_000_000
#: Contacts that have grown together become one after this time: a taxel between two may flicker.
MERGED_NS = 1_000_000_000


class ContactTracker:
    """Finds the contacts of one part in each frame and follows them over time.

    With the part's `localization` left at `centroid`, a connected patch of touched taxels is one
    contact at its mean weighted by force. With any other, a patch with several clear maxima is
    several contacts, and each is located from activations. The template's table of a pad is
    computed when the pad is first the strongest, which takes some 10 ms once (at most a second).

    Args:
        layout: the skin.
        part_index: which part.
        settings: how contacts are found.
        before: the tracker of this part that this one replaces: it continues with its contacts.
    """

    def __init__(
        self,
        layout: Layout,
        part_index: int,
        settings: Settings,
        before: "ContactTracker | None" = None,
    ) -> None:
        part = layout.parts[part_index]
        mine = slice(part.start, part.stop)
        self._name = part.name
        near = Near.of(layout, mine)
        if before is not None and before._near.is_same(near):
            near = before._near
        self._near: Near = near
        self._neighbours, self._patches = near.lists, near.patches
        self._pitch_m = near.usual_pitch_m
        unit_kpa = common_curve(layout, settings.processing.pressure).linear[mine][near.pads]
        self._felt_kpa = float((FELT_UNITS * unit_kpa[unit_kpa > 0.0]).min(initial=FELT_KPA))
        self._position_m = layout.position_m[mine]
        self._normal = layout.normal[mine]
        self._area_mm2 = layout.area_mm2[mine]
        self._shortest_ns = int(1e9 / settings.processing.touch.move_hz)
        self._places: Places | None = None
        if settings.parts[part.name].localization != "centroid":
            self._places = Places(layout, part_index, settings, near.pitch_m)
        self._contacts: dict[int, Followed] = {} if before is None else before._contacts
        self._next_id: int = 1 if before is None else before._next_id
        self._elapsed_ns: int = 0 if before is None else before._elapsed_ns
        self._held: Held = Held(part.n_taxels) if before is None else before._held
        self._former: Former = Former(part.n_taxels) if before is None else before._former
        self._unfelt = Unfelt.of(np.ones(part.n_taxels, np.bool_), near, None)
        self._known = Grouping.of([], [], Homes({}, 0), self._area_mm2, self._position_m)
        self._seen: bytes | None = None

    def step(self, frame: PressureFrame) -> list[Touch]:
        """Return the events since the last frame: ends first, then moves and begins."""
        if not self._contacts and not any_of(frame.touched):
            self._held.forget()
            return []
        felt = self._held.complete(frame)
        if self._former.names:
            self._former.step(felt, frame.valid)
        found = self._grouping(felt, frame.valid)
        known = set(found.names)
        events = [
            self._closed(name, frame.seq, frame.t_ns, self._reason(name, felt, frame.valid))
            for name in list(self._contacts)
            if name not in known
        ]
        return events + self._reported(found, felt, frame.valid)

    def note_former(self, former: "Decision", now: "Decision") -> None:
        """Note how the touches that there are were decided, if it is another way from now on.

        A contact that ends although it would still be a touch has been stopped, not released.

        Args:
            former: how a touch ended.
            now: how one begins from now on. What it finds is its own.
        """
        self._former.begin(self._taxels_of_contacts(), former, now)

    def note_zeroed(self, taxels: Mask) -> None:
        """Note that what some taxels [m] read now has become their zero, whatever presses them."""
        self._former.zero(self._taxels_of_contacts(), taxels)

    def _taxels_of_contacts(self) -> dict[int, list[int]]:
        return {
            name: [*contact.taxels, *contact.unseen] for name, contact in self._contacts.items()
        }

    def end_all(self, seq: int, t_ns: int) -> list[Touch]:
        """End every contact, because no data of the part will come for a while."""
        self._seen = None
        self._held.forget()
        return [self._closed(name, seq, t_ns, "stopped") for name in list(self._contacts)]

    def _grouping(self, felt: PressureFrame, received: Mask) -> "Grouping":
        """Return the contacts of this frame, or those of the last frame if nothing has changed.

        Args:
            felt: the frame, see `Held.complete`.
            received: bool[m], which taxels are valid without being held.
        """
        seen = felt.touched.tobytes()
        if seen == self._seen:
            return self._known
        touched = np.flatnonzero(felt.touched)
        groups = self._patches.find(touched)
        as_before = self._are_as_before(groups)
        groups = self._joined(groups, felt)
        if self._places is not None:
            lightly = set(np.flatnonzero(self._feels(felt) & ~felt.touched).tolist())
            reached = [self._reach(group, lightly) for group in groups]
            groups = self._places.look(felt, groups, reached, self._neighbours)
        home = Homes(self._contacts, len(self._neighbours))
        if len(groups) == 1:
            home.note(groups[0], touched)
        groups = self._kept_apart(groups, home, felt)
        groups = self._kept_whole(groups, home, felt, received)
        names = self._identify(groups, home)
        self._known = Grouping.of(names, groups, home, self._area_mm2, self._position_m)
        # Whether contacts are kept together or apart, or are split by pressure, can change with any
        # frame.
        self._seen = seen if as_before and self._places is None else None
        return self._known

    def _joined(self, groups: list[frozenset[int]], frame: PressureFrame) -> list[frozenset[int]]:
        """Return the groups; a new group is joined with those that it will grow together with.

        When an object lands on the skin, the taxels pass their thresholds one by one. Those between
        two that have passed already feel some pressure.
        """
        if len(groups) < 2 or self._are_as_before(groups):
            return groups
        known = set().union(*(contact.taxels for contact in self._contacts.values()))
        if not any(known.isdisjoint(group) for group in groups):
            return groups
        felt = set(np.flatnonzero(self._feels(frame)).tolist()).union(*groups)
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
        """Return whether each group is a contact that had the same taxels."""
        return {contact.taxels for contact in self._contacts.values()}.issuperset(groups)

    def _feels(self, frame: PressureFrame) -> Mask:
        """Return which taxels may become touched soon, or are."""
        feels: Mask = frame.pressure_kpa >= self._felt_kpa
        return feels

    def _reach(self, group: frozenset[int], among: set[int]) -> set[int]:
        """Return the taxels that a group is connected with through others of a set."""
        reached = set(group)
        way = list(group)
        for taxel in way:  # grows during the loop
            for other in self._neighbours[taxel]:
                if other in among and other not in reached:
                    reached.add(other)
                    way.append(other)
        return reached

    def _kept_apart(
        self, groups: list[frozenset[int]], home: "Homes", felt: PressureFrame
    ) -> list[frozenset[int]]:
        """Return the groups, with contacts kept apart that have only just grown together.

        Each keeps its taxels; a new one belongs to the contact that it is next to.
        """
        if self._are_as_before(groups):
            for contact in self._contacts.values():
                contact.merged_ns = None
            return groups
        kept = []
        for group in groups:
            largest, *others = [name for name, _ in home.overlaps(group)] or [0]
            if not others:
                if largest:
                    self._contacts[largest].merged_ns = None
                kept.append(group)
                continue
            owner: dict[int, int] = {}
            for name in (largest, *others):
                contact = self._contacts[name]
                if contact.merged_ns is None:
                    contact.merged_ns = felt.elapsed_ns
                is_apart = name != largest and felt.elapsed_ns - contact.merged_ns < MERGED_NS
                owner.update(dict.fromkeys(group & contact.taxels, name if is_apart else largest))
            self._spread(owner, group, felt.pressure_kpa)
            shares: dict[int, list[int]] = {}
            for taxel in group:
                shares.setdefault(owner.get(taxel, largest), []).append(taxel)
            kept += map(frozenset, shares.values())
        return sorted(kept, key=min) if len(kept) > 1 else kept

    def _spread(
        self, owner: dict[int, int], group: frozenset[int], kpa: NDArray[np.float32]
    ) -> None:
        """Give the taxels of a group that have no owner that of their neighbours, from these on:
        of several the one of the hardest pressed.

        Args:
            owner: of taxels. Of equal neighbours that of the first counts.
            group: the taxels. Those that are not connected with any owner get none.
            kpa: of all taxels.
        """
        reached = list(owner)
        while reached:
            ring: dict[int, int] = {}
            for taxel in reached:
                for other in self._neighbours[taxel]:
                    if other not in group or other in owner:
                        continue
                    if other not in ring or kpa[taxel] > kpa[ring[other]]:
                        ring[other] = taxel
            owner |= {taxel: owner[beside] for taxel, beside in ring.items()}
            reached = list(ring)

    def _kept_whole(
        self,
        groups: list[frozenset[int]],
        home: "Homes",
        felt: PressureFrame,
        received: Mask,
    ) -> list[frozenset[int]]:
        """Return the groups, with the pieces of one contact joined that have only just come apart.

        While a contact begins or releases, its taxels pass their thresholds one by one, and for a
        moment it is in pieces. Pieces that feel very little never become contacts, and one that is
        not received becomes none before it is.
        """
        if self._are_as_before(groups):
            for contact in self._contacts.values():
                contact.parted_ns = None
            return groups
        pieces: dict[int, list[frozenset[int]]] = {name: [] for name in self._contacts}
        kept = []
        for group in groups:
            overlaps = home.overlaps(group)
            if overlaps:
                pieces[overlaps[0][0]].append(group)
            else:
                kept.append(group)
        for name, parts in pieces.items():
            contact = self._contacts[name]
            if len(parts) < 2:
                contact.parted_ns = None
                kept += parts
                continue
            least_kpa = max(self._felt_kpa, PIECE_SHARE * contact.firm_kpa)
            strong = [part for part in parts if felt.pressure_kpa[list(part)].max() >= least_kpa]
            if len(strong) < 2:
                # What noise lifts for a moment is a remainder all the same.
                contact.parted_ns = None
                kept.append(frozenset().union(*parts))
                continue
            if contact.parted_ns is None:
                contact.parted_ns = felt.elapsed_ns
            if felt.elapsed_ns - contact.parted_ns < PARTED_NS or not all(
                any_of(received[list(part)]) for part in strong
            ):
                kept.append(frozenset().union(*parts))
            else:
                strong.sort(key=len)
                kept += [*strong[:-1], strong[-1].union(*(set(parts) - set(strong)))]
        return sorted(kept, key=min) if len(kept) > 1 else kept

    def _identify(self, groups: list[frozenset[int]], home: "Homes") -> list[int]:
        """Give each group the name of the contact that it continues, or a new one.

        The largest overlap decides; among equal ones the older contact. A group next to the place
        of a contact, or one taxel farther, continues it too, if nothing overlaps that contact: it
        slid, and what it has left is released some sweeps late.
        """
        names: dict[int, int] = {}
        reached = dict(enumerate(groups))
        for _ in range(3):
            claims = [
                (-count, name, number)
                for number, taxels in reached.items()
                for name, count in home.overlaps(taxels)
            ]
            taken = set(names.values())
            for _, name, number in sorted(claims):
                if number not in names and name not in taken:
                    names[number] = name
                    taken.add(name)
                    del reached[number]
            if len(taken) == len(self._contacts):
                break
            for number, taxels in reached.items():
                reached[number] = taxels.union(*(self._neighbours[taxel] for taxel in taxels))
        for number in range(len(groups)):
            if number not in names:
                names[number] = self._next_id
                self._next_id += 1
        return [names[number] for number in range(len(groups))]

    def _reported(self, found: "Grouping", felt: PressureFrame, received: Mask) -> list[Touch]:
        """Return the events of the contacts of a frame, and update the contacts.

        A contact of which nothing was received is not reported.
        """
        if not found.names:
            return []
        order, starts = found.order, found.starts
        pressure = felt.pressure_kpa.take(order).astype(np.float64)
        weight = pressure * found.share_mm2
        total = np.add.reduceat(weight, starts)
        moments = np.add.reduceat(weight[:, None] * found.position_m, starts).tolist()
        peaks = np.maximum.reduceat(pressure, starts).tolist()
        is_received = [True] * len(starts)
        if not all_of(received):
            is_received = np.logical_or.reduceat(received.take(order), starts).tolist()
        unfelt = self._unfelt = Unfelt.of(felt.valid, self._near, self._unfelt)
        is_beside = [False] * len(starts)
        if unfelt.any:
            is_beside = np.logical_or.reduceat(unfelt.beside.take(order), starts).tolist()
        is_beyond = [False] * len(starts)
        if any_of(felt.beyond_range):
            is_beyond = np.logical_or.reduceat(felt.beyond_range.take(order), starts).tolist()
        totals = total.tolist()
        now_ns = felt.elapsed_ns
        fading = math.exp((self._elapsed_ns - now_ns) / FADES_NS)
        self._elapsed_ns = now_ns
        events = []
        for number, (name, taxels) in enumerate(zip(found.names, found.groups, strict=True)):
            known = self._contacts.get(name)
            before = None
            silent_ns = 0
            if known is not None:
                if known.unseen or known.taxels is not taxels:
                    gone = (known.taxels | known.unseen) - taxels
                    known.unseen = frozenset(
                        one for one in gone if not received[one] and not felt.touched[one]
                    )
                    known.taxels, known.order = taxels, found.order[found.spans[number]]
                before = known.reported
                known.firm_kpa = max(peaks[number], known.firm_kpa * fading)
                silent_ns = now_ns - known.reported_ns
                if not is_received[number] or silent_ns < self._shortest_ns:
                    continue
            peak, mean = peaks[number], totals[number] / found.area_mm2[number]
            index = found.taxels[number]
            centroid, sigma = None, None
            kept = before is not None and peak < self._felt_kpa
            if before is not None and kept:
                centroid, sigma = before.centroid_m, before.sigma_m
            elif totals[number] > 0.0:
                if self._places is not None:
                    centroid, sigma = self._places.locate(index)
                else:
                    x, y, z = moments[number]
                    whole = totals[number]
                    centroid = x / whole, y / whole, z / whole
                    # Noise adds little to the uncertainty from the coarse pads.
                    sigma = GEOMETRY_PITCHES * self._pitch_m / math.sqrt(len(index))
            unseen: frozenset[int] = frozenset() if known is None else known.unseen
            partial = is_beside[number] or bool(unseen)
            if (
                before is not None
                and before.partial is partial
                and before.beyond >= is_beyond[number]
                and not _worth_reporting(before, silent_ns, index, (peak, mean), centroid)
            ):
                continue
            if partial and not kept and centroid is not None and sigma is not None:
                away_m = self._unfelt_m(found, number, unseen, centroid, peak, totals[number])
                sigma = math.hypot(sigma, away_m)
            normal = before.normal if before is not None and kept else None
            if not kept and totals[number] > 0.0:
                span = found.spans[number]
                normal = self._mean_normal(weight[span], found.order[span], totals[number])
            event = Touch(
                event="begin" if before is None else "move",
                id=name,
                seq=felt.seq,
                t_ns=felt.t_ns,
                part=self._name,
                taxels=index,
                centroid_m=centroid,
                normal=normal,
                area_mm2=found.area_mm2[number],
                peak_kpa=peak,
                mean_kpa=mean,
                force_n=totals[number] * 1e-3,  # kPa mm2 is mN
                sigma_m=sigma,
                partial=partial,
                beyond=is_beyond[number],
            )
            events.append(event)
            if known is None:
                own = found.order[found.spans[number]]
                self._contacts[name] = Followed(taxels, own, event, now_ns, peak)
            else:
                known.reported, known.reported_ns = event, now_ns
        return events

    def _unfelt_m(
        self,
        found: "Grouping",
        number: int,
        unseen: frozenset[int],
        place_m: Vector,
        peak_kpa: float,
        total_mn: float,
    ) -> float:
        """How far from its place a contact may be because of pads that are not valid, m.

        That is how far they would move its centroid if they felt its peak, on as much skin as the
        contact is felt on. Nothing is known of them, so this is how uncertain the place is.

        Args:
            found: the contacts of the frame, and which of them this one is.
            unseen: taxels that it had before they were not received.
            place_m: where it is felt.
            peak_kpa, total_mn: its peak pressure, and its force.
        """
        unfelt = self._unfelt.pads
        ring: set[int] = set(unseen) | {
            other
            for taxel in found.taxels[number]
            for other in self._neighbours[taxel]
            if unfelt[other]
        }
        reached = set(ring)
        area_mm2 = self._area_mm2[list(ring)].sum()
        while ring and area_mm2 < found.area_mm2[number]:
            ring = {
                other
                for taxel in ring
                for other in self._neighbours[taxel]
                if unfelt[other] and other not in reached
            }
            reached |= ring
            area_mm2 += self._area_mm2[list(ring)].sum()
        pads = sorted(reached)
        weight = peak_kpa * self._area_mm2[pads]
        moment = weight @ (self._position_m[pads] - place_m)
        return float(np.linalg.norm(moment) / (total_mn + weight.sum()))

    def _mean_normal(self, weight: Floats, taxels: NDArray[np.intp], total: float) -> Vector | None:
        direction = weight @ self._normal[taxels]
        length = math.sqrt(direction.dot(direction))
        if length <= 1e-9 * total:  # all round a finger
            return None
        x, y, z = (direction / length).tolist()
        return x, y, z

    def _reason(self, name: int, felt: PressureFrame, received: Mask) -> Reason:
        """A contact is released only if each of its taxels is valid and untouched, or in another
        contact; and by the rules by which it was found, if those are others now.
        """
        contact = self._contacts[name]
        mine = np.array([*contact.taxels, *contact.unseen], np.intp)
        if not all_of(received[mine] | felt.touched[mine]):
            return "lost"
        if name in self._former.names and self._former.keeps(mine[~felt.touched[mine]]):
            return "stopped"
        return "released"

    def _closed(self, name: int, seq: int, t_ns: int, reason: Reason) -> Touch:
        self._former.names.discard(name)
        return self._contacts.pop(name).reported.ended(seq, t_ns, reason)


def _worth_reporting(
    reported: Touch,
    silent_ns: int,
    taxels: list[int],
    kpa: tuple[float, float],
    centroid_m: Vector | None,
) -> bool:
    """Return whether a contact has changed since its last event, or its next event is due.

    Its pressures are peak and mean: a pad at the end of its scale hides how hard others press.
    """
    if taxels != reported.taxels or silent_ns >= ALIVE_NS:
        return True
    for now_kpa, before_kpa in zip(kpa, (reported.peak_kpa, reported.mean_kpa), strict=True):
        reported_kpa = before_kpa or 0.0
        if abs(now_kpa - reported_kpa) > max(PRESSED_KPA, PRESSED_SHARE * reported_kpa):
            return True
    if centroid_m is None or reported.centroid_m is None:
        return centroid_m is not reported.centroid_m
    return math.dist(centroid_m, reported.centroid_m) > MOVED_M
