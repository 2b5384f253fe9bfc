"""Reads the skin display's ini files: the kind and the place of each unit, in two dimensions.

A line is `type id x y orientation gain lrMirror layoutNum`; `id` counts triangles through the
boards of the part, 16 each. The file's `cardid` names the boards' addresses, but is out of date in
many files, so it is checked against the boards of the configuration.
"""

import math
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import msgspec

from skin_host.config.settings import (
    TRIANGLES_PER_BOARD,
    Part,
    Patch,
    PlaceSettings,
    Settings,
    format_triangles,
    parse_triangles,
)
from skin_host.errors import ConfigurationError
from skin_host.importing.report import Findings, integer, part_name, read_source, with_part
from skin_host.layout import TAXELS_PER_TRIANGLE, builtin_kinds

LARGEST_FILE = 1_000_000
#: The display accepts ids below this.
MAX_ID = 128
KINDS = {
    "triangle": "triangle",
    "triangle_10pad": "triangle_10pad",
    "fingertip": "fingertip",
    "fingertip2L": "fingertip2l",
    "fingertip2R": "fingertip2r",
    "fingertip3L": "fingertip3l",
    "fingertip3R": "fingertip3r",
    "fingertipMID": "fingertip_mid",
    "palmL": "palml",
    "palmR": "palmr",
}
#: The display never mirrors these, whatever the file states.
NEVER_MIRRORED = ("fingertip2R", "fingertip3R")
#: Known keys before the units; all but the first two describe the window.
KEYS = ("robotPart", "cardid")


@dataclass(frozen=True, slots=True)
class Unit:
    """One unit; `slot` is its triangle number, counted through the part's boards."""

    line: int
    slot: int
    kind: str
    place: PlaceSettings

    @property
    def n_triangles(self) -> int:
        """Return how many triangles the unit covers."""
        return len(builtin_kinds()[self.kind].pads_mm) // TAXELS_PER_TRIANGLE


@dataclass(slots=True)
class Display:
    """One file: a part, the addresses that it names, its units."""

    file: Path
    part: str
    addresses: list[int]
    units: list[Unit]

    @property
    def n_boards(self) -> int:
        """Return how many boards the units cover."""
        last = max(unit.slot + unit.n_triangles for unit in self.units)
        return -(-last // TRIANGLES_PER_BOARD)

    def slots_of(self, board: int) -> set[int]:
        """Return the triangle numbers that are placed on this board of the part, counted from 0."""
        every = {unit.slot + i for unit in self.units for i in range(unit.n_triangles)}
        return {
            slot % TRIANGLES_PER_BOARD for slot in every if slot // TRIANGLES_PER_BOARD == board
        }


def read_display(path: Path, findings: Findings) -> Display:
    """Read one ini file.

    Raises:
        ConfigurationError: it cannot be read, or places nothing.
    """
    text = read_source(path, LARGEST_FILE)
    keys: dict[str, list[str]] = {}
    units: list[Unit] = []
    taken: dict[int, int] = {}
    gains: set[str] = set()
    within = ""
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split("%")[0].split()
        if not words:
            continue
        if words[0].startswith("["):
            within = words[0].strip("[]")
        elif within != "SENSORS":
            _key(path, number, words, keys, findings)
        else:
            unit = _unit(path, number, words, gains, findings)
            if unit is None:
                continue
            slots = range(unit.slot, unit.slot + unit.n_triangles)
            twin = next((taken[slot] for slot in slots if slot in taken), None)
            if twin is not None:
                findings.odd((path, number), f"id {unit.slot} is placed in line {twin}; not read")
                continue
            taken |= dict.fromkeys(slots, number)
            units.append(unit)
    if not units:
        raise ConfigurationError(f"{path}: contains no unit; wanted lines after [SENSORS]")
    if gains:
        findings.dropped((path, 0), f"gain {', '.join(sorted(gains))}: brightness of the display")
    part = part_name((keys.get("robotPart") or [path.stem])[0])
    numbers = map(integer, keys.get("cardid", []))
    addresses = [address for address in numbers if address is not None]
    return Display(path, part, addresses, units)


def _key(
    path: Path, number: int, words: list[str], keys: dict[str, list[str]], findings: Findings
) -> None:
    if words[0] in KEYS:
        if words[0] in keys:
            findings.odd((path, number), f"{words[0]} a second time; the first one is used")
        keys.setdefault(words[0], words[1:])
    else:
        findings.dropped((path, number), f"{words[0]}: of the display's window or its CAN card")


def _unit(
    path: Path, number: int, words: list[str], gains: set[str], findings: Findings
) -> Unit | None:
    """One line of [SENSORS], or None with a finding."""
    if words[0] not in KINDS:
        findings.odd((path, number), f'"{words[0]}" is not a known kind of unit; not read')
        return None
    numbers = [_float(word) for word in words[1:]]
    if len(numbers) < 4 or None in numbers:
        seen = " ".join(words)[:60]
        findings.odd((path, number), f'seen "{seen}", wanted a type and 4 to 7 numbers; not read')
        return None
    slot, x_mm, y_mm, turn_deg, *more = [n for n in numbers if n is not None]
    gains.update(words[5:6])
    mirror, layout = [*more[1:], 0.0, 0.0][:2]
    if slot != int(slot) or not 0 <= slot < MAX_ID:
        findings.odd((path, number), f"id {words[1]}; wanted 0 to {MAX_ID - 1}; not read")
        return None
    if layout == 1:
        findings.odd(
            (path, number), "layoutNum 1 reverses the taxels, which is not supported; not reversed"
        )
    mirrored = mirror == 1
    if mirrored and words[0] in NEVER_MIRRORED:
        findings.odd((path, number), f"lrMirror 1: the display itself never mirrors a {words[0]}")
        mirrored = False
    place = PlaceSettings(x_mm=x_mm, y_mm=y_mm, turn_deg=turn_deg, mirror=mirrored)
    return Unit(number, int(slot), KINDS[words[0]], place)


def _float(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def import_places(files: list[Path], base: Settings | None, findings: Findings) -> Settings:
    """Place the triangles of `base` as the display does; each file gives a part.

    A triangle moves from its part to the part that the file names. Without `base` the boards are
    made from `cardid`, with default set-up.

    Raises:
        ConfigurationError: a file cannot be read, or its boards are not known.
    """
    settings = base or Settings(robot="robot", buses={}, boards={}, parts={})
    for file in files:
        display = read_display(file, findings)
        if base is None:
            settings = _with_boards(settings, display, findings)
            boards = list(settings.boards)[-display.n_boards :]
        else:
            boards = _boards(settings, display, findings)
        settings = _place(settings, display, boards, findings)
    return settings


def _with_boards(settings: Settings, display: Display, findings: Findings) -> Settings:
    """Add the boards that a file names, with all units on and default set-up."""
    n = display.n_boards
    addresses = display.addresses[:n]
    if len(addresses) < n or len(set(addresses)) < n or not all(1 <= a <= 14 for a in addresses):
        addresses = list(range(1, n + 1))
        findings.odd(
            (display.file, 0),
            f"cardid {display.addresses} does not name the {n} boards that the ids need; taken: "
            f"addresses 1 to {n}",
        )
    slots = {address: sorted(display.slots_of(i)) for i, address in enumerate(addresses)}
    boards = {address: (numbers, "triangle") for address, numbers in slots.items()}
    return with_part(settings, display.file, display.part, boards, findings)


def _place(settings: Settings, display: Display, boards: list[str], findings: Findings) -> Settings:
    set_up = {
        (patch.board, number): patch
        for name, part in settings.parts.items()
        for patch in part.patches
        if name == display.part or not (patch.places or patch.positions)
        for number in parse_triangles(patch.triangles)
    }
    patches: list[Patch] = []
    placed: set[tuple[str, int]] = set()
    for unit in sorted(display.units, key=lambda unit: unit.slot):
        board = boards[unit.slot // TRIANGLES_PER_BOARD]
        first = unit.slot % TRIANGLES_PER_BOARD
        numbers = range(first, first + unit.n_triangles)
        missing = [number for number in numbers if (board, number) not in set_up]
        if missing:
            findings.odd(
                (display.file, unit.line),
                f'triangle {format_triangles(missing)} of board "{board}" is not on; not placed',
            )
            continue
        placed |= {(board, number) for number in numbers}
        _append(patches, set_up[board, first], list(numbers), unit)
    if not patches:
        raise ConfigurationError(f"{display.file}: none of its units is on in the configuration")
    parts = _without(settings.parts, placed, display, findings)
    old = settings.parts.get(display.part)
    new = msgspec.structs.replace(old, patches=patches) if old else Part(patches=patches)
    if display.part in parts:
        new.patches.extend(parts[display.part].patches)
    return msgspec.structs.replace(settings, parts=parts | {display.part: new})


def _append(patches: list[Patch], old: Patch, numbers: list[int], unit: Unit) -> None:
    """Add a unit to the last patch if that has the same set-up, otherwise to a new one."""
    last = patches[-1] if patches else None
    if (
        last is not None
        and (last.board, last.kind) == (old.board, unit.kind)
        and (last.shift, last.cdc_offset) == (old.shift, old.cdc_offset)
    ):
        triangles = [*parse_triangles(last.triangles), *numbers]
        patches[-1] = msgspec.structs.replace(
            last, triangles=format_triangles(triangles), places=[*last.places, unit.place]
        )
        return
    patches.append(
        msgspec.structs.replace(
            old,
            triangles=format_triangles(numbers),
            kind=unit.kind,
            places=[unit.place],
            positions=None,
        )
    )


def _without(
    parts: dict[str, Part], placed: set[tuple[str, int]], display: Display, findings: Findings
) -> dict[str, Part]:
    """Return the parts without the placed triangles, and report what is left of their boards."""
    touched = {board for board, _ in placed}
    result = {}
    for name, part in parts.items():
        patches = []
        for patch in part.patches:
            numbers = parse_triangles(patch.triangles)
            left = [number for number in numbers if (patch.board, number) not in placed]
            if left == numbers:
                patches.append(patch)
            elif left:
                patches.append(
                    msgspec.structs.replace(
                        patch, triangles=format_triangles(left), places=[], positions=None
                    )
                )
            if left and patch.board in touched:
                findings.odd(
                    (display.file, 0),
                    f'triangles {format_triangles(left)} of board "{patch.board}" are on but not '
                    f'placed; they stay in part "{name}", side by side: remove them if they are '
                    "not fitted",
                )
        if patches:
            result[name] = msgspec.structs.replace(part, patches=patches)
    return result


def _boards(settings: Settings, display: Display, findings: Findings) -> list[str]:
    """Return the boards that a file's ids count through, the most probable choice.

    The candidates are the boards of one bus that `cardid` names, in the order of the configuration
    (the order of the values on the robot's own ports), in the order of `cardid` or reversed; and
    the boards of the part of the same name. The choice is the bus whose name shares the longest
    beginning with the part's name, and on it the order that fits the triangles that are on and not
    yet placed.
    """
    n = display.n_boards
    free: dict[str, set[int]] = {}
    for name, part in settings.parts.items():
        for patch in part.patches:
            if name == display.part or not (patch.places or patch.positions):
                free.setdefault(patch.board, set()).update(parse_triangles(patch.triangles))
    own = settings.parts.get(display.part)
    choices = [list(dict.fromkeys(patch.board for patch in own.patches))] if own else []
    for bus in settings.buses:
        at = {board.address: name for name, board in settings.boards.items() if board.bus == bus}
        named = [at[address] for address in display.addresses if address in at]
        choices += [[name for name in at.values() if name in named], named, named[::-1]]
    choices = [boards for boards in choices if len(boards) == n]
    if not choices:
        raise ConfigurationError(
            f"{display.file}: its ids need {n} board(s); no bus of the configuration has so many "
            f'of cardid {display.addresses}, and no part "{display.part}" has {n}'
        )

    def misfit(boards: list[str]) -> tuple[int, int]:
        missing = sum(
            len(display.slots_of(i) - free.get(board, set())) for i, board in enumerate(boards)
        )
        return -_common(settings.boards[boards[0]].bus, display.part), missing

    best = min(choices, key=misfit)
    addresses = [settings.boards[board].address for board in best]
    if addresses != display.addresses:
        findings.odd(
            (display.file, 0),
            f"cardid {display.addresses} are not the boards whose triangles are on, in their "
            f'order; taken: {addresses} on bus "{settings.boards[best[0]].bus}"',
        )
    return best


def _common(first: str, second: str) -> int:
    """Return the length of the common beginning of two names."""
    pairs = zip(first, second, strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
