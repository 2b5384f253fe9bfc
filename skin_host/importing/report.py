"""What imports share: reading a file and its numbers, remarks with file and line, a part made from
a file alone.
"""

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Literal

import msgspec

from skin_host.config.settings import Board, Bus, Part, Patch, Settings, format_triangles
from skin_host.errors import ConfigurationError, visible
from skin_host.files import read_whole

#: Most remarks of a grade that are printed, and most characters of one.
MOST, LONGEST = 100, 300
_LONGEST_NUMBER = 12
#: A board's name has its address besides.
_LONGEST_NAME = 60

#: A file and a line of it; 0 means the file as a whole.
Place = tuple[Path, int]
Grade = Literal["odd", "assumed", "dropped"]
GRADES: dict[Grade, str] = {
    "odd": "wrong or unusual in the files, and how it was read",
    "assumed": "not in the files, filled in",
    "dropped": "in the files, but not supported here",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One remark."""

    grade: Grade
    at: Place
    text: str

    def __str__(self) -> str:
        file, line = self.at
        place = f"{file}:{line}" if line else str(file)
        return visible(f"{place}: {self.text}", LONGEST)


@dataclass(slots=True)
class Findings:
    """The remarks on one import, in the order in which they were made."""

    items: list[Finding] = field(default_factory=list)

    def odd(self, at: Place, text: str) -> None:
        """Note something wrong or unusual, and how it was read."""
        self.items.append(Finding("odd", at, text))

    def assumed(self, at: Place, text: str) -> None:
        """Note a value that is missing in the files and was assumed."""
        self.items.append(Finding("assumed", at, text))

    def dropped(self, at: Place, text: str) -> None:
        """Note something that has no counterpart here."""
        self.items.append(Finding("dropped", at, text))

    def table(self) -> str:
        """Return all remarks as text, by grade; empty if there are none."""
        sections = []
        for grade, title in GRADES.items():
            found = [item for item in self.items if item.grade == grade]
            lines = [f"  {item}" for item in found[:MOST]]
            if len(found) > MOST:
                lines.append(f"  and {len(found) - MOST} more")
            if lines:
                sections.append("\n".join([f"{title}:", *lines]))
        return "\n".join(sections)


def read_source(path: Path, most_bytes: int) -> str:
    """Read a file to import: UTF-8, or UTF-16 by its byte order mark; what is neither is replaced.

    Raises:
        ConfigurationError: it cannot be read, or is larger.
    """
    try:
        content = read_whole(path, most_bytes)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from None
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if is_wide else "utf-8-sig", errors="replace")


def integer(word: str) -> int | None:
    """A number as the robot's own readers take it: decimal, or hexadecimal with 0x.

    None for any other word, and for a word longer than any number that such a file needs.
    """
    match = re.fullmatch(r"([+-]?)(0[xX][0-9a-fA-F]+|[0-9]+)", word[: _LONGEST_NUMBER + 1])
    if match is None or len(word) > _LONGEST_NUMBER:
        return None
    value = int(match[2], 16 if match[2][:2].lower() == "0x" else 10)
    return -value if match[1] == "-" else value


def part_name(text: str) -> str:
    """The name of a part made from any text: a file's name, or a key of it."""
    return re.sub(r"[^a-z0-9_-]+", "_", text.lower()).strip("_")[:_LONGEST_NAME] or "skin"


def new_bus(
    buses: dict[str, Bus], wanted: str, file: Path, findings: Findings
) -> tuple[str, dict[str, Bus]]:
    """Add a bus with a name and a channel that no other bus has.

    Returns:
        Its name, which is `wanted` or begins with it, and all buses.
    """
    name = next(one for one in _numbered(wanted) if one not in buses)
    if name != wanted:
        findings.odd((file, 0), f'a bus "{wanted}" exists; the new one is "{name}"')
    taken = {bus.channel for bus in buses.values()}
    numbers = count(len(buses))
    channel = next(one for number in numbers if (one := f"can{number}") not in taken)
    return name, buses | {name: Bus(channel=channel)}


def _numbered(name: str) -> Iterator[str]:
    yield name
    for number in count(2):
        yield f"{name}_{number}"


def with_boards(boards: dict[str, Board], new: dict[str, Board], file: Path) -> dict[str, Board]:
    """Add boards.

    Raises:
        ConfigurationError: one of them has the name of another.
    """
    for name in new:
        if name in boards:
            raise ConfigurationError(f'{file}: a board of this name exists: "{name}"')
    return boards | new


def check_new_part(parts: dict[str, Part], name: str, file: Path) -> None:
    """Check that there is no such part yet.

    Raises:
        ConfigurationError: there is.
    """
    if name in parts:
        raise ConfigurationError(f'{file}: a part of this name exists: "{name}"')


def with_part(
    settings: Settings,
    file: Path,
    name: str,
    boards: dict[int, tuple[list[int], str]],
    findings: Findings,
) -> Settings:
    """Add a part on a bus of its own, with boards of default set-up.

    `boards` are by address their triangles and the kind of these; some have no triangles.

    Raises:
        ConfigurationError: there is such a part, or such a board.
    """
    check_new_part(settings.parts, name, file)
    bus, buses = new_bus(settings.buses, name, file, findings)
    names = {address: f"{bus}_{address}" for address in boards}
    findings.assumed(
        (file, 0),
        f'a bus "{bus}" on channel {buses[bus].channel}; boards {", ".join(names.values())} with '
        "default set-up; `skin import skinspec` brings the robot's own",
    )
    patches = [
        Patch(board=names[address], triangles=format_triangles(triangles), kind=kind)
        for address, (triangles, kind) in boards.items()
        if triangles
    ]
    return msgspec.structs.replace(
        settings,
        buses=buses,
        boards=with_boards(
            settings.boards,
            {names[address]: Board(bus=bus, address=address) for address in boards},
            file,
        ),
        parts=settings.parts | {name: Part(patches=patches)},
    )
