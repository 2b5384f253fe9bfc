"""Joins what the files of several nodes hold into what one of them remembers. Pure.

`skin run --workers N` makes N nodes of one; another N others, and without it they are one again.
The configuration may give a part to another node, too. Each keeps files of its own, so that what is
known of a part lies in the files of the node that had it last. Calibration, zeros and what
operators changed belong together: without the zeros a pressed taxel would look untouched.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from skin_host.config.settings import Settings
from skin_host.daemon.state import NodeState, Zeros, seconds_of, written_after
from skin_host.layout import Layout, PadKind, PartLayout
from skin_host.processing.calibration import Calibration, Verdict, Zero, identified, with_curves

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NodeMemory:
    """What a node starts with.

    Attributes:
        calibration: None takes a new one.
        state: what operators changed.
        zeros: of the parts of the node, with this calibration: what is to be doubted is in
            `unknown`, and only baselines of this calibration are left.
        from_others: some of it was in the files of other nodes only.
        unkept: which files could not be given it, and why.
        others_s: when other nodes that had its parts wrote their zeros last, s since 1970.
    """

    calibration: Calibration | None
    state: NodeState
    zeros: Zeros
    from_others: bool = False
    unkept: Mapping[str, str] = field(default_factory=dict)
    others_s: float = 0.0


@dataclass(frozen=True, eq=False)
class NodeFiles:
    """What the files of one node hold; None where there is none."""

    node: str
    calibration: Calibration | None
    state: NodeState | None
    #: Without the id of a calibration: the file is there, and cannot be read.
    zeros: Zeros | None
    #: When the zeros were written, s since 1970, and when their file was.
    last_s: tuple[float, float]

    def had(self, name: str, *, by_default: bool) -> bool:
        """Return whether the zeros are those of the node that had a part or fingertip.

        Args:
            name: of the part or fingertip.
            by_default: what holds of a file of an older version that names no part at all.
        """
        if self.zeros is None:
            return False
        if not self.zeros.calibration:
            return True  # any may have been pressed
        names = self.zeros.parts
        if names is None:
            names = [*self.zeros.baselines]
        return name in names if names else by_default

    def names(self, name: str) -> bool:
        """Return whether the zeros show that the node had a part or fingertip."""
        known = self.zeros is not None and bool(self.zeros.calibration)
        return known and self.had(name, by_default=False)

    def lacked(self, name: str) -> bool:
        """Return whether the zeros show that the node did not have a part or fingertip when its
        calibration was taken, which may hold an older one of it.
        """
        names = None if self.zeros is None else self.zeros.parts
        return bool(names) and name not in (names or ()) and self.taken_s() <= self.last_s[0]

    def taken_s(self) -> float:
        """Return when the calibration was taken, s since 1970."""
        return seconds_of(self.calibration.time if self.calibration else "") or 0.0


class Memories:
    """The files of a node, first, of those that it is a share of or shared with, and of other
    nodes, which may have had its parts before.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        node: str,
        whole: str,
        found: list[NodeFiles],
        former: list[NodeFiles],
    ) -> None:
        self._layout = layout
        self._parts = [part for part in layout.parts if settings.parts[part.name].node == node]
        self._tips = [name for name, tip in settings.fingertips.items() if tip.node == node]
        self._own = found[0]
        self._whole = whole
        self._found = found
        self._former = former
        #: By part and fingertip: whether a calibration has measured it.
        self._measured = {
            **{part.name: _measured(part) for part in self._parts},
            **{tip: _zeroed(tip) for tip in self._tips},
        }

    def joined(self) -> NodeMemory:
        """Join what is known of the node's parts and fingertips."""
        chosen = {part.name: self._calibration(part.name) for part in self._parts}
        tips = {tip: self._calibration(tip) for tip in self._tips}
        calibration = self._joined_calibration(chosen, tips)
        state, from_others = self._state()
        zeros = Zeros(
            calibration="" if calibration is None else calibration.id,
            robot=self._layout.robot,
            parts=[*chosen, *tips],
        )
        for part in self._parts:
            self._add_zeros(zeros, part, chosen[part.name])
        holders = [self._holder(name) for name in (*chosen, *tips)]
        sources = [*holders, *chosen.values(), *tips.values()]
        from_others |= any(one not in (None, self._own) for one in sources)
        known = [one for one in holders if one is not None and one.zeros is not None]
        newest = max(known, key=lambda one: one.last_s, default=None)
        if newest is not None and newest.zeros is not None:
            zeros.written = newest.zeros.written
        had = [one for name in (*chosen, *tips) for one in self._that_had(name)]
        others_s = max((one.last_s[0] for one in had if one is not self._own), default=0.0)
        if from_others and others_s:
            zeros.written = written_after(seconds_of(zeros.written) or 0.0, others_s)
        return NodeMemory(calibration, state, zeros, from_others, others_s=others_s)

    def _holder(self, name: str) -> NodeFiles | None:
        """Return the files of the node that had a part or fingertip last; None if none shows it."""
        return max(self._that_had(name), key=lambda one: one.last_s, default=None)

    def _that_had(self, name: str) -> list[NodeFiles]:
        return [
            one
            for one in self._that_may_know(name)
            if one.had(name, by_default=one.node in (self._own.node, self._whole))
        ]

    def _that_may_know(self, name: str) -> list[NodeFiles]:
        """Return the files that may hold what is known of a part or fingertip: of another node
        those which show that it had this, or any if nothing else is known of it.
        """
        found = [*self._found, *(one for one in self._former if one.names(name))]
        measured = self._measured[name]
        is_known = any(
            one.names(name) or (one.calibration is not None and measured(one.calibration))
            for one in found
        )
        return found if is_known else [*self._found, *self._former]

    def _calibration(self, name: str) -> NodeFiles | None:
        """Return the files with the calibration of a part or fingertip; None if there are none.

        It is that of the node which had it last, or one that was taken later.
        """
        found, having = self._that_may_know(name), self._that_had(name)
        measured = self._measured[name]
        # A node that has taken something over has copies of the parts of others, and zeros.
        entitled = [
            one
            for one in found
            if one.calibration is not None
            and (
                one in having
                or (one.node == self._whole and not one.lacked(name))
                or one.zeros is None
                or not having
            )
            and measured(one.calibration)
        ]
        newest = max(entitled, key=NodeFiles.taken_s, default=None)
        own = None if self._own.calibration is None else self._own
        holder = self._holder(name)
        if holder is None:
            first = {one.node: one for one in entitled}
            return first.get(self._own.node) or first.get(self._whole) or newest or own
        if newest is not None and newest.taken_s() > max(holder.last_s[0], holder.taken_s()):
            return newest
        if holder.calibration is not None:
            return holder
        for one in found:
            if one.calibration and holder.zeros and holder.zeros.are_of(one.calibration.id):
                return one
        return None if holder is self._own else newest

    def _joined_calibration(
        self, parts: Mapping[str, NodeFiles | None], tips: Mapping[str, NodeFiles | None]
    ) -> Calibration | None:
        """Return one calibration of what several hold of parts and fingertips, by name."""
        known = [one.calibration for one in parts.values() if one is not None and one.calibration]
        if not known:
            return None
        first = known[0]
        sources = [*parts.values(), *(one for one in tips.values() if one is not None)]
        if all(one and one.calibration and one.calibration.id == first.id for one in sources):
            return first
        arrays = {
            key: getattr(first, key).copy()
            for key in ("baseline", "percentile", "noise", "spread", "gain", "bend", "verdict")
        }
        for part in self._parts:
            mine = slice(part.start, part.stop)
            files = parts[part.name]
            if files is None or files.calibration is None:
                arrays["verdict"][mine] = Verdict.ABSENT
                continue
            for key, array in arrays.items():
                array[mine] = getattr(files.calibration, key)[mine]
        zeros: dict[str, Zero] = {
            **{name: zero for name, zero in first.zeros.items() if name not in tips},
            **{
                name: one.calibration.zeros[name]
                for name, one in tips.items()
                if one is not None and one.calibration and name in one.calibration.zeros
            },
        }
        # No part was measured before this.
        oldest = min(known, key=lambda one: seconds_of(one.time) or 0.0)
        joined = identified(replace(first, time=oldest.time, zeros=zeros, **arrays))
        curves = next((one.curves for one in known if one.curves is not None), None)
        return joined if curves is None else with_curves(joined, curves)

    def _add_zeros(self, zeros: Zeros, part: PartLayout, chosen: NodeFiles | None) -> None:
        """Add what is known of the zeros of a part whose calibration is the chosen one."""
        holder = self._holder(part.name)
        kept = None if holder is None else holder.zeros
        calibration = None if chosen is None else chosen.calibration
        pressure = self._layout.pad_kind[part.start : part.stop] == PadKind.PRESSURE
        all_taxels = np.flatnonzero(pressure).tolist()
        unknown: list[int] = []
        touched: list[int] = []
        if kept is None:
            # Who has kept no zeros yet has lost none; what is another's should have come with some.
            shown = [self._own] if chosen is self._own else self._that_may_know(part.name)
            last_s = [one.last_s[0] for one in shown if one.zeros is not None]
            if chosen is not None and last_s and chosen.taken_s() <= max(last_s):
                unknown = all_taxels
        elif not kept.calibration:
            unknown = all_taxels
        elif calibration is None or kept.are_of(calibration.id):
            unknown = kept.unknown.get(part.name, [])
            touched = kept.touched.get(part.name, [])
            if part.name in kept.baselines:
                zeros.baselines[part.name] = kept.baselines[part.name]
        elif not kept.are_older_than(calibration.time):
            unknown = kept.unknown.get(part.name, []) if chosen is holder else all_taxels
            touched = kept.touched.get(part.name, [])
        if touched:
            zeros.touched[part.name] = touched
        if unknown:
            zeros.unknown[part.name] = unknown
        # Whatever calibration is in use: it is the chip's fault.
        if kept is not None and part.name in kept.stuck:
            zeros.stuck[part.name] = kept.stuck[part.name]

    def _state(self) -> tuple[NodeState, bool]:
        """Return what operators changed, and whether some of it is another node's."""
        by_node = {one.node: one for one in self._found}
        fallback = [self._own, by_node.get(self._whole)]
        disabled, thresholds, sources = [], None, []
        for part in self._parts:
            candidates = [self._holder(part.name), *fallback]
            source = next((one for one in candidates if one is not None and one.state), None)
            if source is None or source.state is None:
                continue
            sources.append(source)
            if part.name in source.state.disabled:
                disabled.append(part.name)
            if thresholds is None:
                thresholds = source.state.thresholds
            elif thresholds != source.state.thresholds:
                log.warning(
                    "the thresholds of %s are those of %s from now on, not of %s",
                    part.name,
                    sources[0].node,
                    source.node,
                )
        state = NodeState(robot=self._layout.robot, disabled=disabled)
        if thresholds is not None:
            state.thresholds = thresholds
        return state, any(one is not self._own for one in sources)


def _measured(part: PartLayout) -> Callable[[Calibration], bool]:
    mine = slice(part.start, part.stop)
    return lambda calibration: bool((calibration.verdict[mine] != Verdict.ABSENT).any())


def _zeroed(tip: str) -> Callable[[Calibration], bool]:
    return lambda calibration: tip in calibration.zeros
