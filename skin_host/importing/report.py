"""Remarks on an import: each irregularity with its file and line."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from skin_host.errors import visible

#: Most remarks of a grade that are printed, and most characters of one.
MOST, LONGEST = 100, 300

Grade = Literal["odd", "assumed", "dropped"]
GRADES: dict[Grade, str] = {
    "odd": "wrong or unusual in the files, and how it was read",
    "assumed": "not in the files, filled in",
    "dropped": "in the files, but not supported here",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One remark; `line` 0 means the file as a whole."""

    grade: Grade
    file: Path
    line: int
    text: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else str(self.file)
        return visible(f"{place}: {self.text}", LONGEST)


@dataclass(slots=True)
class Findings:
    """The remarks on one import, in the order in which they were made."""

    items: list[Finding] = field(default_factory=list)

    def odd(self, file: Path, line: int, text: str) -> None:
        """Note something wrong or unusual, and how it was read."""
        self.items.append(Finding("odd", file, line, text))

    def assumed(self, file: Path, line: int, text: str) -> None:
        """Note a value that is missing in the files and was assumed."""
        self.items.append(Finding("assumed", file, line, text))

    def dropped(self, file: Path, line: int, text: str) -> None:
        """Note something that has no counterpart here."""
        self.items.append(Finding("dropped", file, line, text))

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
