"""What a node remembers of its skin, whichever node had that skin before.

`skin run --workers N` makes N nodes of one; another N others, and without it they are one again.
The configuration may give a part to another node, too. Each keeps files of its own, so that what is
known of a part lies in the files of the node that had it last. Calibration, zeros and what
operators changed belong together: without the zeros a pressed taxel would look untouched.
"""

import logging
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.config.settings import Settings, skin_hash
from skin_host.daemon import service
from skin_host.daemon.calibrate import stored_calibration
from skin_host.daemon.state import (
    NodeState,
    Zeros,
    baselines_of,
    is_there,
    kept_path,
    load_kept,
    taxels_of,
)
from skin_host.errors import OtherRobotError, OtherSkinError, SkinError
from skin_host.files import read_document, refuse_other_robot, write_document
from skin_host.layout import Layout, PadKind, PartLayout, parts_of
from skin_host.processing.calibration import Calibration, Verdict, Zero, identified, with_curves
from skin_host.processing.calibration.calibrator import Known
from skin_host.processing.calibration.file import load_calibration, save_calibration

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
    """

    calibration: Calibration | None
    state: NodeState
    zeros: Zeros
    from_others: bool = False
    unkept: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Files:
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
        return _seconds(self.calibration.time if self.calibration else "") or 0.0


def remembered(
    settings: Settings,
    layout: Layout,
    node: str,
    whole: str | None = None,
    *,
    take_new: bool = False,
) -> NodeMemory:
    """Return what a node remembers: of each part and fingertip what the node that had it last kept.

    What comes from the files of others is in those of this node, too, from then on.

    Args:
        settings, layout: of the robot, as this node has them.
        node: which parts are ours.
        whole: the node of which it is a share; None: it is none.
        take_new: a calibration is taken anyway, so that none is needed.

    Raises:
        ConfigurationError: no part belongs to the node.
        OtherSkinError: there are calibrations of other configurations only.
        OtherRobotError: the node's own files are another robot's.
        NewerFileError: a newer version has written one of the files.
        BusyFileError: another program is writing one of them.
    """
    whole = whole or node
    parts_of(layout, node)
    found, former, refused = _found(settings, layout, [node], whole)
    memory = _Memories(settings, layout, node, whole, found, former).joined()
    if memory.calibration is None and refused is not None and not take_new:
        raise refused
    if memory.from_others:
        memory = replace(memory, unkept=_keep(settings, layout, node, memory))
    return replace(memory, calibration=None) if take_new else memory


def hand_over(
    settings: Settings, layout: Layout, whole: str, shares: Mapping[str, Settings]
) -> None:
    """Give each share of a node files of its own, before one starts and changes what another is to
    find in its files.

    Args:
        settings, layout: of the robot.
        whole: the node.
        shares: settings by the name of the share, see `workers.share_of`.

    Raises:
        OtherRobotError, NewerFileError, BusyFileError: see `remembered`.
    """
    found, former, _ = _found(settings, layout, [*shares], whole)
    by_node = {one.node: one for one in found}
    memories = {}
    for name, share in shares.items():
        others = [one for one in found if one.node != name]
        mine = [by_node[name], *others]
        memories[name] = _Memories(share, layout, name, whole, mine, former).joined()
    for name, memory in memories.items():
        if memory.from_others:
            _keep(settings, layout, name, memory)


def remembered_with(
    settings: Settings, layout: Layout, node: str, calibration: Calibration | None
) -> NodeMemory:
    """Return what a node's own files hold, to be used with a calibration that need not be theirs.

    Raises:
        ConfigurationError, OtherRobotError, NewerFileError, BusyFileError: see `remembered`.
    """
    found = [_files(settings, node, calibration)]
    return _Memories(settings, layout, node, node, found, []).joined()


def known_of(calibration: Calibration, zeros: Zeros, layout: Layout) -> Known:
    """Return what is known of a skin by a kept calibration and what has become of its zeros.

    The zeros of taxels that were touched when a daemon ended are in doubt: the set-up of their
    board has taken what touched them into its zero.
    """
    baseline = calibration.baseline.copy()
    if zeros.are_of(calibration.id):
        for part, kept in baselines_of(layout, zeros.baselines):
            baseline[part.start : part.stop] = kept
    doubted = taxels_of(layout, zeros.unknown) | taxels_of(layout, zeros.touched)
    return Known(calibration, baseline, ~doubted)


def _found(
    settings: Settings, layout: Layout, nodes: list[str], whole: str
) -> tuple[list[_Files], list[_Files], OtherSkinError | None]:
    """Read the files of nodes that start, and of the whole one and its shares, which may be those
    of another robot and are passed over then; and of all other nodes. Return also why a calibration
    was refused.
    """
    family, foreign = _others(settings, nodes, whole)
    found: list[_Files] = []
    refused: OtherSkinError | None = None
    for name in (*nodes, *family):
        calibration = None
        try:
            try:
                calibration = stored_calibration(settings, layout, name)
            except OtherSkinError as error:
                refused = refused or error
            found.append(_files(settings, name, calibration))
        except OtherRobotError:
            if name in nodes:
                raise
    former = [_files_of_former(settings, layout, name) for name in foreign]
    return found, [one for one in former if one is not None], refused


def _files_of_former(settings: Settings, layout: Layout, node: str) -> _Files | None:
    """Read the files of a node that may have had a part before; None if one of them cannot be used,
    as it is damaged or another robot's: that node reports it.
    """
    kept: dict[str, Any] = {}
    calibration = None
    try:
        for what, kind in (("state", NodeState), ("zeros", Zeros), ("calibration", None)):
            path = kept_path(settings, node, what)
            kept[what] = None
            if not is_there(path):
                continue
            refuse_other_robot(path, settings.robot, what)
            if kind is not None:
                kept[what] = read_document(path, kind, kind().schema, what, ValueError)
                continue
            with suppress(OtherSkinError):
                calibration = load_calibration(path, layout, skin_hash(settings))
    except (SkinError, ValueError):
        return None
    last_s = _last_s(kept_path(settings, node, "zeros"), kept["zeros"] or Zeros())
    return _Files(node, calibration, kept["state"], kept["zeros"], last_s)


def _keep(settings: Settings, layout: Layout, node: str, memory: NodeMemory) -> dict[str, str]:
    """Write what a node remembers to files of its own; return what could not be written, and why.

    The zeros come last: as the newest file they make it the node that had these parts last.
    """
    unkept = {}
    calibration = memory.calibration
    documents: dict[str, Callable[[Path], None]] = {}
    if calibration is not None:
        documents["calibration"] = lambda path: save_calibration(path, calibration, layout)
    documents["state"] = lambda path: write_document(path, memory.state)
    if calibration is not None:
        documents["zeros"] = lambda path: write_document(path, memory.zeros)
    for what, write in documents.items():
        path = kept_path(settings, node, what)
        try:
            write(path)
        except OSError as error:
            unkept[what] = f"{path}: {error.strerror}"
            log.error("%s not kept: %s", what, unkept[what])
    return unkept


def _others(settings: Settings, nodes: list[str], whole: str) -> tuple[list[str], list[str]]:
    """Return the nodes besides these that have files here: the whole one, and its shares; and the
    others, of which some may be another robot's.
    """
    named = re.compile(
        rf"{re.escape(f'{settings.robot}-')}([a-z0-9_-]+)\.(?:calibration|state|zeros)\.json"
    )
    of_whole = re.compile(rf"{re.escape(whole)}(?:-[1-9][0-9]*)?")
    try:
        names = sorted(
            path.name
            for path in service.state_directory(settings.service.state_directory).iterdir()
        )
    except OSError:
        return [], []
    found = dict.fromkeys(match[1] for match in map(named.fullmatch, names) if match is not None)
    others = [one for one in found if one not in nodes]
    family = [one for one in others if of_whole.fullmatch(one)]
    return family, [one for one in others if one not in family]


def _files(settings: Settings, node: str, calibration: Calibration | None) -> _Files:
    path = {what: kept_path(settings, node, what) for what in ("state", "zeros")}
    there = {what: is_there(one) for what, one in path.items()}
    state = load_kept(path["state"], NodeState, settings.robot)
    zeros = load_kept(path["zeros"], Zeros, settings.robot)
    return _Files(
        node,
        calibration,
        state if there["state"] else None,
        zeros if there["zeros"] else None,
        _last_s(path["zeros"], zeros),
    )


def _last_s(path: Path, zeros: Zeros) -> tuple[float, float]:
    """Return when zeros were written, and when their file was, s since 1970."""
    changed_s = 0.0
    with suppress(OSError):
        changed_s = path.lstat().st_mtime
    written_s = _seconds(zeros.written)
    return (changed_s if written_s is None else written_s, changed_s)


def _seconds(time: str) -> float | None:
    """Return an ISO 8601 time with its zone in s since 1970; None if it is none."""
    try:
        moment = datetime.fromisoformat(time)
        return moment.timestamp() if moment.tzinfo is not None else None
    except (ValueError, OverflowError):
        return None


class _Memories:
    """The files of a node, first, of those that it is a share of or shared with, and of other
    nodes, which may have had its parts before.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        node: str,
        whole: str,
        found: list[_Files],
        former: list[_Files],
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
        return NodeMemory(calibration, state, zeros, from_others)

    def _holder(self, name: str) -> _Files | None:
        """Return the files of the node that had a part or fingertip last; None if none shows it."""
        return max(self._that_had(name), key=lambda one: one.last_s, default=None)

    def _that_had(self, name: str) -> list[_Files]:
        return [
            one
            for one in self._that_may_know(name)
            if one.had(name, by_default=one.node in (self._own.node, self._whole))
        ]

    def _that_may_know(self, name: str) -> list[_Files]:
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

    def _calibration(self, name: str) -> _Files | None:
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
        newest = max(entitled, key=_Files.taken_s, default=None)
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
        self, parts: Mapping[str, _Files | None], tips: Mapping[str, _Files | None]
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
        oldest = min(known, key=lambda one: _seconds(one.time) or 0.0)
        joined = identified(replace(first, time=oldest.time, zeros=zeros, **arrays))
        curves = next((one.curves for one in known if one.curves is not None), None)
        return joined if curves is None else with_curves(joined, curves)

    def _add_zeros(self, zeros: Zeros, part: PartLayout, chosen: _Files | None) -> None:
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
