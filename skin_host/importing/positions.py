"""Reads files of taxel positions in three dimensions, in both of their forms.

The newer form has a head (`name`, `spatial_sampling`, `taxel2Repr ( ... )`, `[calibration]`)
before the rows `x y z nx ny nz`; the older form has only rows. There are 192 rows per board, with
zeros where there is no taxel. In many triangles only some taxels were ever measured: the others
repeat the position of the taxel that represents them, and temperature pads have no position. These
get positions by fitting the flat unit to the measured taxels, and each such triangle is reported.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import (
    TRIANGLES_PER_BOARD,
    KindSettings,
    Patch,
    Settings,
    format_triangles,
    parse_triangles,
)
from skin_host.errors import ConfigurationError
from skin_host.importing.report import Findings, integer, part_name, read_source, with_part
from skin_host.layout import TAXELS_PER_TRIANGLE, builtin_kinds
from skin_host.layout.geometry import LARGEST_NUMBER, fit_unit

LARGEST_FILE = 2_000_000
TAXELS_PER_BOARD = TAXELS_PER_TRIANGLE * TRIANGLES_PER_BOARD
#: Temperature pads of the triangle with ten pads.
THERMAL_PADS = (6, 10)
#: A fit worse than this is reported: the skin is bent, or its taxels are in another order.
LARGE_RMS_M = 2.5e-3
#: A normal farther than this (cosine) from the plane of its taxels is reported.
OBLIQUE = 0.5
#: Normals whose mean is shorter than this share of the longest of them have no common direction.
CANCELLED = 1e-3

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Table:
    """One file: `rows` [n, 6] in m, the file's line of each, its `taxel2Repr` or None."""

    file: Path
    rows: Floats
    lines: list[int]
    represented_by: NDArray[np.int64] | None

    def present(self, triangle: int) -> bool:
        """Whether the file has a position for any taxel of this triangle of the part."""
        mine = slice(TAXELS_PER_TRIANGLE * triangle, TAXELS_PER_TRIANGLE * (triangle + 1))
        return bool(np.any(self.rows[mine, :3]))


def read_table(path: Path, findings: Findings) -> Table:
    """Read one positions file of either form.

    Raises:
        ConfigurationError: it cannot be read or holds no rows.
    """
    text = read_source(path, LARGEST_FILE)
    rows: list[list[float]] = []
    lines: list[int] = []
    represented: NDArray[np.int64] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith(("#", "%", "[")):
            continue
        if words[0] == "taxel2Repr":
            entries = re.findall(r"(?<![\w.])-?[0-9]{1,6}(?![\w.])", line)
            numbers = map(integer, entries)
            represented = np.array([one for one in numbers if one is not None], np.int64)
        elif words[0] == "spatial_sampling":
            if words[1:] != ["taxel"]:
                findings.dropped(
                    (path, number), f"spatial_sampling {' '.join(words[1:])}: not used"
                )
        elif words[0][0].isalpha() and words[0].lower() not in ("nan", "inf"):
            findings.dropped((path, number), f"{' '.join(words)[:40]}: not used")
        else:
            rows.append(_row(path, number, words, findings))
            lines.append(number)
    if not rows:
        raise ConfigurationError(f"{path}: no rows x y z nx ny nz")
    table = np.array(rows)
    missing = -len(table) % TAXELS_PER_TRIANGLE
    if missing:
        findings.odd((path, lines[-1]), f"{len(table)} rows, not twelve a triangle; zeros added")
        table = np.concatenate([table, np.zeros((missing, 6))])
        lines += [lines[-1]] * missing
    if represented is not None and len(represented) != len(table):
        n = len(represented)
        use = f"the first {len(table)} are used" if n > len(table) else "not used"
        findings.odd((path, 0), f"taxel2Repr has {n} entries for {len(table)} rows; {use}")
        represented = represented[: len(table)] if n > len(table) else None
    return Table(path, table, lines, represented)


def _row(path: Path, number: int, words: list[str], findings: Findings) -> list[float]:
    """Return six numbers; zeros, with a finding, where the row does not hold six numbers."""
    try:
        row = [float(word) for word in words]
    except ValueError:
        row = []
    if len(row) != 6 or not (np.abs(row) <= LARGEST_NUMBER).all():
        seen = " ".join(words)[:60]
        findings.odd((path, number), f'seen "{seen}", wanted x y z nx ny nz; taken as no place')
        return [0.0] * 6
    return row


def import_positions(
    files: list[Path], base: Settings | None, part: str | None, folder: str, findings: Findings
) -> tuple[Settings, dict[str, bytes]]:
    """Give the triangles of `base` the positions in the files, one file per part.

    Without `base` the configuration is made from the files. `part` is that of a single file; by
    default the part whose name the file name begins with. Positions files are written to `folder`,
    beside the configuration.

    Returns:
        The settings, and the positions files that they refer to, by name.

    Raises:
        ConfigurationError: a file cannot be read, or its part is not known.
    """
    if part is not None and len(files) > 1:
        raise ConfigurationError(f"one part ({part}) for {len(files)} files; import each alone")
    settings = base or Settings(robot="robot", buses={}, boards={}, parts={})
    written: dict[str, bytes] = {}
    for file in files:
        table = read_table(file, findings)
        if base is None:
            name = part_name(part or file.stem)
            settings = _with_boards(settings, name, table, findings)
        else:
            name = part or _part_of(file, settings)
        if name not in settings.parts:
            known = ", ".join(settings.parts)
            raise ConfigurationError(f'{file}: no part "{name}"; there are: {known}')
        settings = _locate(settings, name, table, folder, written, findings)
    return settings, written


def _part_of(file: Path, settings: Settings) -> str:
    """Return the part whose name the file name begins with; the longest, if there are several."""
    stem = file.stem.lower()
    names = [name for name in settings.parts if stem.startswith(name) or f"_{name}" in stem]
    if not names:
        known = ", ".join(settings.parts)
        raise ConfigurationError(
            f"{file}: no part's name is in the file's; choose one with --part, there are: {known}"
        )
    return max(names, key=len)


def _with_boards(settings: Settings, name: str, table: Table, findings: Findings) -> Settings:
    """Make a bus, boards and a part for the triangles that have positions."""
    n_boards = -(-len(table.rows) // TAXELS_PER_BOARD)
    boards = {}
    for first in range(0, len(table.rows) // TAXELS_PER_TRIANGLE, TRIANGLES_PER_BOARD):
        slots = range(first, min(first + TRIANGLES_PER_BOARD, len(table.rows) // 12))
        on = [slot for slot in slots if table.present(slot)]
        if on:
            numbers = [slot - first for slot in on]
            boards[first // TRIANGLES_PER_BOARD + 1] = numbers, _kind(table, on)
    if not boards or n_boards > 14:
        raise ConfigurationError(
            f"{table.file}: rows of {n_boards} boards, {len(boards)} with places; wanted 1 to 14"
        )
    return with_part(settings, table.file, name, boards, findings)


def _kind(table: Table, triangles: list[int]) -> str:
    """Return the kind of unit: ten pads, if exactly the temperature pads have no position."""
    pads = [TAXELS_PER_TRIANGLE * t + pad for t in triangles for pad in THERMAL_PADS]
    return "triangle" if np.any(table.rows[pads, :3]) else "triangle_10pad"


def _locate(
    settings: Settings,
    name: str,
    table: Table,
    folder: str,
    written: dict[str, bytes],
    findings: Findings,
) -> Settings:
    """Replace the patches of a part by patches with positions, where the file has them."""
    part = settings.parts[name]
    kinds = builtin_kinds() | settings.kinds
    boards = list(dict.fromkeys(patch.board for patch in part.patches))
    placed = [patch.board for patch in part.patches if patch.places or patch.positions]
    n_boards = -(-len(table.rows) // TAXELS_PER_BOARD)
    if n_boards != len(boards):
        boards = list(dict.fromkeys(placed))  # drops boards without any position
    if n_boards != len(boards):
        raise ConfigurationError(
            f'{table.file}: {len(table.rows)} rows are {n_boards} board(s), part "{name}" has '
            f"{len(boards)}: {', '.join(boards)}"
        )
    if len({settings.boards[board].bus for board in boards}) > 1:
        findings.assumed(
            (table.file, 0),
            f'part "{name}": its boards are on several buses; taken in this order: '
            f"{', '.join(boards)}",
        )
    patches: list[Patch] = []
    used: set[int] = set()
    for patch in part.patches:
        if patch.board not in boards:
            patches.append(patch)
            continue
        kind = kinds[patch.kind]
        per_unit = len(kind.pads_mm) // TAXELS_PER_TRIANGLE
        numbers = parse_triangles(patch.triangles)
        first = TRIANGLES_PER_BOARD * boards.index(patch.board)
        located: list[int] = []
        blocks: list[Floats] = []
        left: list[int] = []
        for unit in range(0, len(numbers), per_unit):
            members = numbers[unit : unit + per_unit]
            slots = [first + number for number in members]
            used.update(slots)
            if all(TAXELS_PER_TRIANGLE * slot < len(table.rows) for slot in slots) and any(
                table.present(slot) for slot in slots
            ):
                located += members
                blocks.append(_unit(table, slots, kind, patch, findings))
            else:
                left += members
        if left:
            findings.odd(
                (table.file, 0),
                f'no places for triangles {format_triangles(left)} of board "{patch.board}"; they '
                "keep theirs, in a frame of their own",
            )
            keep = patch.places if not located else []
            patches.append(
                msgspec.structs.replace(patch, triangles=format_triangles(left), places=keep)
            )
        if located:
            file = f"{folder}/{name}_{len(patches)}.txt"
            written[file] = _text(np.concatenate(blocks), table, patch, located)
            patches.append(
                msgspec.structs.replace(
                    patch, triangles=format_triangles(located), places=[], positions=file
                )
            )
    extra = [
        slot
        for slot in range(len(table.rows) // TAXELS_PER_TRIANGLE)
        if slot not in used and table.present(slot)
    ]
    for slot in extra:
        findings.odd(
            (table.file, table.lines[TAXELS_PER_TRIANGLE * slot]),
            f"places for triangle {slot % TRIANGLES_PER_BOARD} of board "
            f'"{boards[slot // TRIANGLES_PER_BOARD]}", which is not on; not used',
        )
    if not any(patch.positions for patch in patches):
        raise ConfigurationError(f'{table.file}: no place for any triangle of part "{name}"')
    new = msgspec.structs.replace(part, patches=patches)
    return msgspec.structs.replace(settings, parts=settings.parts | {name: new})


def _unit(
    table: Table, slots: list[int], kind: KindSettings, patch: Patch, findings: Findings
) -> Floats:
    """Return the rows [n, 6] of one unit: measured positions kept, the others fitted."""
    index = np.concatenate(
        [np.arange(TAXELS_PER_TRIANGLE) + TAXELS_PER_TRIANGLE * slot for slot in slots]
    )
    rows: Floats = table.rows[index].copy()
    line = table.lines[int(index[0])]
    label = f'triangle {slots[0] % TRIANGLES_PER_BOARD} of board "{patch.board}"'
    placed = _placed(rows)
    measured = _own_places(table, index, rows)
    if measured is not None and not measured.any():
        findings.odd(
            (table.file, line),
            f"{label}: by taxel2Repr none of its places is its own; those that differ are taken",
        )
        measured = None
    if measured is None:
        measured = _single_places(rows)
    normal = rows[placed, 3:].mean(axis=0)
    longest = np.linalg.norm(rows[placed, 3:], axis=1).max()
    if np.linalg.norm(normal) <= CANCELLED * longest:
        why = "its normals cancel each other" if longest else "no normals"
        findings.odd((table.file, line), f"{label}: {why}; taken: +z")
        normal = np.array([0.0, 0.0, 1.0])
        rows[:, 3:] = normal
    normal /= np.linalg.norm(normal)
    pads = np.array(kind.pads_mm)
    fit = fit_unit(pads[measured], rows[measured, :3], normal)
    if not measured.all():
        rows[~measured, :3] = fit.place(pads[~measured])
        rows[~measured, 3:] = normal
    n_fitted = int((~measured & _pressure(kind)).sum())
    n_measured = int((measured & _pressure(kind)).sum())
    remarks = []
    if n_fitted:
        how = f"{n_fitted} taxels without a place, fitted to the other {n_measured}"
        remarks.append(how if n_measured >= 3 else how + ", too few to determine the rotation")
    if n_measured >= 3:
        if n_fitted or fit.rms_m > LARGE_RMS_M:
            remarks.append(f"rms {fit.rms_m * 1e3:.1f} mm from a flat {patch.kind}")
        across = np.cross(fit.axes[:, 0], fit.axes[:, 1])
        if abs(across @ normal) < OBLIQUE:
            remarks.append("its normal is oblique to the plane of its taxels")
    if remarks:
        findings.odd((table.file, line), f"{label}: {'; '.join(remarks)}")
    return rows


def _own_places(table: Table, index: NDArray[np.intp], rows: Floats) -> NDArray[np.bool_] | None:
    """Return which rows hold a place that is not a copy of their representative's; None if the file
    does not have these.
    """
    if table.represented_by is None:
        return None
    by = table.represented_by[index]
    valid = (by >= 0) & (by < len(table.rows))
    source = np.where(valid, by, index)
    copied = (table.rows[source, :3] == rows[:, :3]).all(axis=1) & (source != index)
    own = _placed(rows)
    own[copied | ~valid] = False
    return own


def _single_places(rows: Floats) -> NDArray[np.bool_]:
    """Return which rows hold a place that no other row has; if none does, one of each place."""
    _, first, place, copies = np.unique(
        rows[:, :3], axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    single, placed = _placed(rows), _placed(rows)
    # When several taxels share one position, it is unknown which of them was measured.
    single[copies[place] > 1] = False
    if not single.any():
        single[first] = placed[first]
    return single


def _placed(rows: Floats) -> NDArray[np.bool_]:
    """Return which rows have a place: without a taxel there are zeros."""
    return np.asarray(rows[:, :3].any(axis=1))


def _pressure(kind: KindSettings) -> NDArray[np.bool_]:
    pressure = np.ones(len(kind.pads_mm), bool)
    pressure[kind.thermal] = False
    return pressure


def _text(rows: Floats, table: Table, patch: Patch, triangles: list[int]) -> bytes:
    """The positions file of a patch: `#` and what it is, then the rows."""
    head = (
        f"# {patch.board}, triangles {format_triangles(triangles)}, of {table.file.name}: "
        "x y z (m), normal\n"
    )
    body = "".join(" ".join(f"{value:.5f}" for value in row) + "\n" for row in rows + 0.0)
    return (head + body).encode()
