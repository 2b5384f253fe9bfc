"""Reads the robot descriptions' skinSpec files: boards, triangles and their set-up.

Two files belong together: the device's own (`left_arm-...-skin.xml`: groups of CAN addresses, one
per bus) and the specification that it includes (`...-skinSpec.xml`: defaults and sets). Either may
be given; a specification that is included is looked for beside the device file.

Known irregularities of such files: comments within comments (here, as in the robot's own reader,
both end at the first -->), `fasle`, set names used twice, more sets than announced or than the
robot's own hosts read (20), sets that have been commented out, templates with prose instead of
values. Each is reported with its line, and the rest is read.
"""

import re
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from xml.parsers import expat

import msgspec

from skin_host.config.settings import Board, Part, Patch, Settings, format_triangles
from skin_host.errors import ConfigurationError
from skin_host.importing.report import (
    Findings,
    Place,
    check_new_part,
    integer,
    new_bus,
    read_source,
    with_boards,
)

#: The robot's own hosts ignore special sets beyond these numbers, with only a warning.
HOSTS_READ_TRIANGLE_SETS = 20
TRIANGLES = range(16)
ADDRESSES = range(1, 15)
#: Without 7, a test mode in which boards send no measure of pressure.
SKIN_TYPES = (0, 1, 2, 3, 8)
PERIODS_MS = range(10, 210)
SHIFTS = range(9)
#: Boards of these types correct their values with a temperature pad: their triangles have ten pads.
TEN_PAD_TYPES = (0, 3, 8)
LARGEST_FILE = 4_000_000


@dataclass(frozen=True, slots=True)
class Entry:
    """One `param`: where it is, and its content."""

    at: Place
    name: str
    words: list[str]


class Document:
    """The groups of one XML file, as far as it can be read."""

    def __init__(self, path: Path, findings: Findings) -> None:
        self.path = path
        self.findings = findings
        self.robot = ""
        self.includes: list[tuple[int, str]] = []
        self.groups: dict[str, list[Entry]] = {}
        self._group = ""
        self._entry: tuple[int, str] | None = None
        self._text: list[str] = []
        self._read()

    def take(self, other: "Document") -> None:
        """Add the groups of an included file."""
        self.robot = self.robot or other.robot
        for name, entries in other.groups.items():
            self.groups.setdefault(name, []).extend(entries)

    def group(self, name: str) -> list[Entry]:
        """The params of a group; none where there is no such group."""
        return self.groups.get(name, [])

    def find(self, group: str, name: str) -> Entry | None:
        """Return the first param of this name in a group."""
        return next((entry for entry in self.group(group) if entry.name == name), None)

    def _read(self) -> None:
        text = self._without_comments(read_source(self.path, LARGEST_FILE))
        # The text is already decoded, so it must not name another encoding.
        text = re.sub(r"^\s*<\?xml[^>]*\?>", "", text)
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._characters
        parser.EntityDeclHandler = self._entity
        self._parser = parser
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            self.findings.odd(
                (self.path, error.lineno),
                f"not valid XML from here: {expat.ErrorString(error.code)}; the rest is not read",
            )

    def _without_comments(self, text: str) -> str:
        """Blank the comments as the robot's own reader ends them: at the first -->."""
        result = []
        rest, line = 0, 1  # of what is not read yet
        while (start := text.find("<!--", rest)) >= 0:
            result.append(text[rest:start])
            end = text.find("-->", start + 4)
            line += text.count("\n", rest, start)
            if end < 0:
                self.findings.odd((self.path, line), "a comment without an end; it takes the rest")
                return "".join(result)
            inner = text.find("<!--", start + 4, end)
            if inner >= 0:
                self.findings.odd(
                    (self.path, line + text.count("\n", start, inner)),
                    f"a comment within the comment of line {line}; both end at the first -->, "
                    f"line {line + text.count(chr(10), start, end)}",
                )
            if "triangleSetCfg" in text[start:end]:
                self.findings.odd(
                    (self.path, line), "a comment with sets of triangles in it; they are not read"
                )
            n_lines = text.count("\n", start, end)
            result.append("\n" * n_lines)
            rest, line = end + 3, line + n_lines
        result.append(text[rest:])
        return "".join(result)

    def _entity(self, *_declaration: object) -> None:
        # No such file needs entities, and a few that refer to each other can fill the memory.
        raise ConfigurationError(f"{self.path}: declares entities; such files are not read")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line = self._parser.CurrentLineNumber
        if tag in ("params", "devices", "device"):
            self.robot = self.robot or attributes.get("robot", "")
        elif tag == "group":
            self._group = attributes.get("name", "")
        elif tag == "param":
            self._entry = (line, attributes.get("name", ""))
            self._text = []
        elif tag == "xi:include":
            self.includes.append((line, attributes.get("href", "")))

    def _characters(self, text: str) -> None:
        if self._entry is not None:
            self._text.append(text)

    def _end(self, tag: str) -> None:
        if tag == "group":
            self._group = ""
        elif tag == "param" and self._entry is not None:
            line, name = self._entry
            words = "".join(self._text).replace("(", " ").replace(")", " ").split()
            entry = Entry((self.path, line), name, words)
            self.groups.setdefault(self._group, []).append(entry)
            self._entry = None


@dataclass(slots=True)
class BoardSpec:
    """One board: its set-up, and (shift, CDC offset) of each triangle that is on."""

    address: int
    period_ms: int = 50
    skin_type: int = 0
    no_load: int = 240
    triangles: dict[int, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TriangleSet:
    """Some triangles of a board that are on with a set-up (shift, CDC offset), or off: None."""

    entry: Entry
    board: BoardSpec
    triangles: range
    setup: tuple[int, int] | None


@dataclass(slots=True)
class Device:
    """One device: `patches` are its buses, by number, with their boards."""

    name: str
    robot: str
    file: Path
    patches: dict[int, list[BoardSpec]] = field(default_factory=dict)


def import_boards(files: list[Path], base: Settings | None, findings: Findings) -> Settings:
    """Read skinSpec (or device) files; each gives a part, and a bus for each of its patches.

    Raises:
        ConfigurationError: a file cannot be read or describes no board, or a part or a board of it
            exists already.
    """
    base = base or Settings(robot="", buses={}, boards={}, parts={})
    buses, boards, parts = dict(base.buses), dict(base.boards), dict(base.parts)
    robot = base.robot
    for file in files:
        device = read_device(file, findings)
        robot = robot or _robot(device)
        if not device.patches:
            raise ConfigurationError(
                f"{file}: no triangle of any board is on in it; import the device file that "
                "includes it, which names the CAN addresses, or add sets of triangles"
            )
        check_new_part(parts, device.name, file)
        of_patch: dict[int, list[Patch]] = {}
        for number, specs in sorted(device.patches.items()):
            wanted = device.name if len(device.patches) == 1 else f"{device.name}_{number}"
            bus, buses = new_bus(buses, wanted, file, findings)
            findings.assumed(
                (file, 0), f'patch {number} is the bus "{bus}" on channel {buses[bus].channel}'
            )
            named = {f"{bus}_{spec.address}": spec for spec in specs}
            new = {name: _board(bus, spec) for name, spec in named.items()}
            boards = with_boards(boards, new, file)
            of_patch[number] = [
                patch for name, spec in named.items() for patch in _patches(name, spec)
            ]
        # The robot's own vector, and with it tables of positions, has the boards of patch 1 last.
        patches = [patch for number in sorted(of_patch, reverse=True) for patch in of_patch[number]]
        parts[device.name] = Part(patches=patches)
        kinds = sorted({patch.kind for patch in patches})
        findings.assumed(
            (file, 0),
            f"triangles are of the kind {' and '.join(kinds)}, by the type of their boards, and "
            "lie side by side; `skin import skingui` brings kinds and places",
        )
    findings.assumed((files[0], 0), "boards are of the model mtb4")
    return msgspec.structs.replace(
        base, robot=robot or "robot", buses=buses, boards=boards, parts=parts
    )


def _board(bus: str, spec: BoardSpec) -> Board:
    return Board(
        bus=bus,
        address=spec.address,
        period_ms=spec.period_ms,
        skin_type=spec.skin_type,  # type: ignore[arg-type]  # read as one of them
        no_load=spec.no_load,
    )


def _robot(device: Device) -> str:
    text = "".join(c if c.isascii() and c.isalnum() else "-" for c in device.robot.lower())
    return text.strip("-")[:64]


def _patches(board: str, spec: BoardSpec) -> list[Patch]:
    """Return patches of consecutive triangles that have the same set-up."""
    kind = "triangle_10pad" if spec.skin_type in TEN_PAD_TYPES else "triangle"
    ordered = sorted(spec.triangles.items())
    patches = []
    for (shift, offset), group in groupby(ordered, key=lambda item: item[1]):
        numbers = [number for number, _ in group]
        patches.append(
            Patch(
                board=board,
                triangles=format_triangles(numbers),
                kind=kind,
                shift=shift,
                cdc_offset=offset,
            )
        )
    return patches


def read_device(path: Path, findings: Findings) -> Device:
    """Read a skinSpec file, or a device file with the skinSpec file that it includes.

    Raises:
        ConfigurationError: the file cannot be read at all.
    """
    document = Document(path, findings)
    for line, href in document.includes:
        included = path.parent / href
        if not included.name.lower().endswith("skinspec.xml"):
            findings.dropped((path, line), f'includes "{href}"; only skinSpec files are read')
        elif not included.exists():
            findings.odd((path, line), f'includes "{href}", which was not found')
        else:
            document.take(Document(included, findings))
    device = Device(_name(path), document.robot, path)
    for number, boards in _boards(document).items():
        if boards:
            device.patches[number] = boards
    return device


def _name(path: Path) -> str:
    """Return the limb: for "left_arm-eb24-j4_7-skinSpec.xml" it is left_arm."""
    stem = path.stem.lower()
    limb = re.search(r"(left|right)_[a-z]+|torso", stem)
    text = limb[0] if limb else stem.split("-")[0].removesuffix("skinspec")
    return re.sub(r"[^a-z0-9_]", "_", text).strip("_")[:40] or "skin"


def _boards(document: Document) -> dict[int, list[BoardSpec]]:
    """Return the boards of each patch (bus), with their set-up."""
    findings = document.findings
    patches = _addresses(document)
    default = BoardSpec(
        0,
        _number(document, "defaultCfgBoard", "period", 50, PERIODS_MS),
        _number(document, "defaultCfgBoard", "skinType", 0, SKIN_TYPES),
        _number(document, "defaultCfgBoard", "noLoad", 240, range(1, 255)),
    )
    shift = _number(document, "defaultCfgTriangle", "shift", 2, SHIFTS)
    offset = _number(document, "defaultCfgTriangle", "cdcOffset", 0x2200, range(0x10000))
    enabled = _enabled(document)
    diagnostic = document.find("defaultCfgBoard", "diagnostic")
    if diagnostic is not None:
        findings.dropped(diagnostic.at, "diagnostic: status words are always read here")
    triangle_sets = _sets(document, "specialCfgTriangles", "triangleSetCfg", 7)
    for entry, numbers in triangle_sets:
        patch, address = numbers[:2]
        on = [other for other, addresses in patches.items() if address in addresses]
        if patch not in patches and len(on) == 1:
            findings.odd(
                entry.at,
                f"{entry.name}: patch {patch}, but board {address} is on patch {on[0]}; taken as "
                "that",
            )
            numbers[0] = patch = on[0]
        known = patches.setdefault(patch, [])
        if address in ADDRESSES and address not in known:
            known.append(address)
    boards = {
        patch: [
            BoardSpec(address, default.period_ms, default.skin_type, default.no_load)
            for address in addresses
        ]
        for patch, addresses in patches.items()
    }
    for entry, numbers in _sets(document, "specialCfgBoards", "boardSetCfg", 6):
        _set_up_boards(entry, numbers, boards, findings)
    triangles = [
        found
        for entry, numbers in triangle_sets
        if (found := _triangle_set(entry, numbers, boards, findings)) is not None
    ]
    every = [board for boards_of in boards.values() for board in boards_of]
    bare: list[BoardSpec] = []
    named: list[BoardSpec] = []
    for board in every:
        own = [one for one in triangles if one.board is board]
        # Sets that only turn on name the triangles that are fitted; one that turns off takes its
        # triangles from those that are on by default.
        names_all = bool(own) and all(one.setup is not None for one in own)
        if not own:
            bare.append(board)
        elif names_all:
            named.append(board)
        if enabled is not False and not names_all:
            board.triangles = dict.fromkeys(TRIANGLES, (shift, offset))
        _set_up_triangles(own, findings)
    if enabled is None and bare:
        findings.assumed((document.path, 0), f"boards {_list(bare)}: all 16 triangles are on")
    elif enabled:
        if bare:
            findings.odd(
                (document.path, 0),
                f"boards {_list(bare)} have no set of triangles, and all are on by default; all "
                "16 are taken: remove those that are not fitted",
            )
        if named:
            findings.odd(
                (document.path, 0),
                f"boards {_list(named)}: triangles without a set are on by default too; only "
                "those of the sets are taken",
            )
    return {
        patch: [board for board in boards_of if board.triangles]
        for patch, boards_of in boards.items()
    }


def _list(boards: list[BoardSpec]) -> str:
    return ", ".join(str(board.address) for board in boards)


def _addresses(document: Document) -> dict[int, list[int]]:
    """Return the addresses of each patch, from skinCanAddrsPatchN, or skinCanIds of a CAN card."""
    patches: dict[int, list[int]] = {}
    card = document.find("", "canDeviceNum")
    number = (integer(card.words[0]) if card and card.words else None) or 1
    for entry in [*document.group("patches"), *document.group("")]:
        match = re.fullmatch(r"skinCanAddrsPatch([0-9]{1,2})|skinCanIds", entry.name)
        if match is None:
            continue
        addresses = patches.setdefault(int(match[1]) if match[1] else number, [])
        for word in entry.words:
            address = integer(word)
            if address is None or address not in ADDRESSES:
                document.findings.odd(entry.at, f'{entry.name}: "{word}" is no address 1..14')
            elif address in addresses:
                document.findings.odd(entry.at, f"{entry.name}: {address} is there twice")
            else:
                addresses.append(address)
    return patches


def _number(
    document: Document, group: str, name: str, default: int, allowed: range | tuple[int, ...]
) -> int:
    entry = document.find(group, name)
    if entry is None:
        if document.group(group):
            document.findings.odd((document.path, 0), f"{group}: no {name}; taken: {default}")
        else:
            document.findings.assumed((document.path, 0), f"{group}.{name}: {default}")
        return default
    value = integer(entry.words[0]) if entry.words else None
    if value is None or value not in allowed or len(entry.words) > 1:
        seen = " ".join(entry.words)[:40]
        document.findings.odd(entry.at, f'{name}: seen "{seen}"; taken: {default}')
        return default
    return value


def _enabled(document: Document) -> bool | None:
    """Return whether triangles are on by default; any value but true counts as false.

    None if the file has neither defaults nor sets: the oldest form, where all are on.
    """
    entry = document.find("defaultCfgTriangle", "enabled")
    if entry is None:
        told = document.group("defaultCfgTriangle") or document.group("specialCfgTriangles")
        return False if told else None
    word = " ".join(entry.words).lower()
    if word not in ("true", "false", "1", "0"):
        document.findings.odd(
            entry.at,
            f'enabled: seen "{word[:40]}"; taken as false, as the robot\'s own host reads it',
        )
    return word in ("true", "1")


def _sets(
    document: Document, group: str, prefix: str, columns: int
) -> list[tuple[Entry, list[int]]]:
    """Return the readable numbered sets of a group."""
    announced = document.find(group, "numOfSets")
    limit = integer(announced.words[0]) if announced and announced.words else None
    first: dict[str, int] = {}
    sets = []
    for entry in document.group(group):
        match = re.fullmatch(rf"{prefix}([0-9]{{1,4}})", entry.name.strip())
        if match is None:
            if entry.name != "numOfSets":
                document.findings.odd(entry.at, f'"{entry.name}" is no {prefix}N; not read')
            continue
        if entry.name in first:
            document.findings.odd(
                entry.at,
                f"{entry.name} exists already, line {first[entry.name]}; both are taken, "
                "the robot's own host reads the first alone",
            )
        first.setdefault(entry.name, entry.at[1])
        if limit is not None and int(match[1]) > limit:
            document.findings.odd(
                entry.at,
                f"{entry.name}: beyond numOfSets {limit}; taken, the robot's own host does not "
                "read it",
            )
        numbers = [integer(word) for word in entry.words]
        if len(numbers) != columns or None in numbers:
            seen = " ".join(entry.words)[:60]
            document.findings.odd(
                entry.at, f'{entry.name}: seen "{seen}", wanted {columns} numbers; not read'
            )
            continue
        sets.append((entry, [number for number in numbers if number is not None]))
    if limit is not None and announced is not None:
        if limit > len(first):
            document.findings.odd(
                announced.at,
                f"numOfSets {limit}, but there are {len(first)}; the robot's own host refuses that",
            )
        if prefix == "triangleSetCfg" and limit > HOSTS_READ_TRIANGLE_SETS:
            document.findings.odd(
                announced.at,
                f"numOfSets {limit}: the robot's own hosts read {HOSTS_READ_TRIANGLE_SETS} at "
                "most; all are taken",
            )
    return sets


def _set_up_boards(
    entry: Entry, numbers: list[int], boards: dict[int, list[BoardSpec]], findings: Findings
) -> None:
    patch, first, last, period_ms, skin_type, no_load = numbers
    chosen = [board for board in boards.get(patch, []) if first <= board.address <= last]
    if not chosen:
        findings.odd(entry.at, f"{entry.name}: no board {first}..{last} on patch {patch}; not read")
    for column, value, allowed in (
        ("period", period_ms, PERIODS_MS),
        ("skinType", skin_type, SKIN_TYPES),
        ("noLoad", no_load, range(1, 255)),
    ):
        if value not in allowed:
            findings.odd(entry.at, f"{entry.name}: {column} {value}; not read")
            return
    for board in chosen:
        board.period_ms, board.skin_type, board.no_load = period_ms, skin_type, no_load


def _triangle_set(
    entry: Entry, numbers: list[int], boards: dict[int, list[BoardSpec]], findings: Findings
) -> TriangleSet | None:
    """Check a set of triangles; None, with a finding, if it cannot be meant."""
    patch, address, first, last, enabled, shift, offset = numbers
    board = next((b for b in boards.get(patch, []) if b.address == address), None)
    for column, good, seen in (
        ("board", board is not None, address),
        ("first triangle", first in TRIANGLES, first),
        ("last triangle", last in TRIANGLES and last >= first, last),
        ("shift", shift in SHIFTS, shift),
        ("cdcOffset", 0 <= offset <= 0xFFFF, offset),
    ):
        if not good:
            findings.odd(entry.at, f"{entry.name}: {column} {seen}; not read")
            return None
    assert board is not None
    setup = (shift, offset) if enabled == 1 else None
    return TriangleSet(entry, board, range(first, last + 1), setup)


def _set_up_triangles(sets: list[TriangleSet], findings: Findings) -> None:
    """Apply the sets of one board, in their order."""
    turned_on: set[int] = set()
    for one in sets:
        if one.setup is None:
            turned_on.difference_update(one.triangles)
            for number in one.triangles:
                one.board.triangles.pop(number, None)
            continue
        if again := [number for number in one.triangles if number in turned_on]:
            findings.odd(
                one.entry.at,
                f"{one.entry.name}: triangles {again[0]} to {again[-1]} of board "
                f"{one.board.address} were in an earlier set; the later one counts",
            )
        turned_on.update(one.triangles)
        one.board.triangles |= dict.fromkeys(one.triangles, one.setup)
