"""What a node remembers of its skin, whichever node had that skin before: reads the files of all
that may have had it, and gives a node files of its own.
"""

import logging
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from skin_host.config.settings import Settings, skin_hash
from skin_host.daemon import service
from skin_host.daemon.calibrate import keep_former, stored_calibration
from skin_host.daemon.joining import Memories, NodeFiles, NodeMemory
from skin_host.daemon.state import (
    NodeState,
    Zeros,
    is_there,
    kept_or,
    kept_path,
    load_kept,
    seconds_of,
    taxels_of,
)
from skin_host.errors import OtherRobotError, OtherSkinError, SkinError
from skin_host.files import read_document, refuse_other_robot, write_document
from skin_host.layout import Layout, parts_of
from skin_host.processing.calibration import Calibration, with_pressures_of
from skin_host.processing.calibration.calibrator import Known
from skin_host.processing.calibration.file import (
    find_calibration,
    load_calibration,
    save_calibration,
)

log = logging.getLogger(__name__)


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
    memory = Memories(settings, layout, node, whole, found, former).joined()
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
        memories[name] = Memories(share, layout, name, whole, mine, former).joined()
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
    return Memories(settings, layout, node, node, found, []).joined()


def kept_calibration(settings: Settings, layout: Layout, node: str) -> Calibration | None:
    """Return the calibration that a node would start with, whose shares may have kept it; None if
    there is none of this skin.

    Raises:
        OtherRobotError, NewerFileError, BusyFileError: see `remembered`.
    """
    found, former, _ = _found(settings, layout, [node], node)
    return Memories(settings, layout, node, node, found, former).joined().calibration


def share_pressures(
    settings: Settings, layout: Layout, node: str, calibration: Calibration
) -> list[str]:
    """Give the shares of a node the gains and curves of a calibration; return their names.

    They have newer zeros than a recording, so that they would not take its calibration.

    Raises:
        OSError: a file cannot be written.
        NewerFileError, BusyFileError: see `remembered`.
    """
    written = []
    family, _ = _others(settings, [node], node)
    nodes = {part.node for part in settings.parts.values()}
    for name in [one for one in family if one not in nodes]:
        path = kept_path(settings, name, "calibration")
        theirs = find_calibration(path, layout, skin_hash(settings))
        if theirs is not None:
            save_calibration(path, with_pressures_of(theirs, calibration), layout)
            written.append(name)
    return written


def known_of(calibration: Calibration, zeros: Zeros, layout: Layout) -> Known:
    """Return what is known of a skin by a kept calibration and what has become of its zeros.

    The zeros of taxels that were touched when a daemon ended are in doubt: the set-up of their
    board has taken what touched them into its zero.
    """
    kept = zeros.baselines if zeros.are_of(calibration.id) else {}
    baseline = kept_or(calibration.baseline, layout, kept)
    doubted = taxels_of(layout, zeros.unknown) | taxels_of(layout, zeros.touched)
    return Known(calibration, baseline, ~doubted)


def _found(
    settings: Settings, layout: Layout, nodes: list[str], whole: str
) -> tuple[list[NodeFiles], list[NodeFiles], OtherSkinError | None]:
    """Read the files of nodes that start, and of the whole one and its shares, which may be those
    of another robot and are passed over then; and of all other nodes. Return also why a calibration
    was refused.
    """
    family, foreign = _others(settings, nodes, whole)
    found: list[NodeFiles] = []
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


def _files_of_former(settings: Settings, layout: Layout, node: str) -> NodeFiles | None:
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
    return NodeFiles(node, calibration, kept["state"], kept["zeros"], last_s)


def _keep(settings: Settings, layout: Layout, node: str, memory: NodeMemory) -> dict[str, str]:
    """Write what a node remembers to files of its own; return what could not be written, and why.

    The zeros come last: as the newest file they make it the node that had these parts last.
    """
    unkept = {}
    calibration = memory.calibration
    documents: dict[str, Callable[[Path], None]] = {}
    if calibration is not None:

        def write_calibration(path: Path) -> None:
            keep_former(path, layout, skin_hash(settings))
            save_calibration(path, calibration, layout)

        documents["calibration"] = write_calibration
    documents["state"] = lambda path: write_document(path, memory.state)
    if calibration is not None:
        documents["zeros"] = lambda path: write_document(path, memory.zeros)
    for what, write in documents.items():
        path = kept_path(settings, node, what)
        try:
            write(path)
        except (OSError, SkinError) as error:
            reason = f"{path}: {error.strerror}" if isinstance(error, OSError) else str(error)
            unkept[what] = reason
            log.error("%s not kept: %s", what, reason)
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


def _files(settings: Settings, node: str, calibration: Calibration | None) -> NodeFiles:
    path = {what: kept_path(settings, node, what) for what in ("state", "zeros")}
    there = {what: is_there(one) for what, one in path.items()}
    state = load_kept(path["state"], NodeState, settings.robot)
    zeros = load_kept(path["zeros"], Zeros, settings.robot)
    return NodeFiles(
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
    written_s = seconds_of(zeros.written)
    return (changed_s if written_s is None else written_s, changed_s)
