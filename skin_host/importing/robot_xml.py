"""Reads the XML of robot descriptions: groups of named params, as far as it is readable.

Comments end at the first -->, as in the robot's own reader; every irregularity in such files is
reported with its line.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

from skin_host.errors import ConfigurationError
from skin_host.importing.report import Findings

LARGEST_FILE = 4_000_000


@dataclass(frozen=True, slots=True)
class Entry:
    """One `param`: its position in the file and its content."""

    file: Path
    line: int
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
        self._text = ""
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
        try:
            data = self.path.read_bytes()[: LARGEST_FILE + 1]
        except OSError as error:
            raise ConfigurationError(f"{self.path}: cannot be read: {error.strerror}") from None
        if len(data) > LARGEST_FILE:
            raise ConfigurationError(f"{self.path}: larger than {LARGEST_FILE} bytes")
        text = self._without_comments(data.decode("utf-8", errors="replace"))
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
                self.path,
                error.lineno,
                f"not valid XML from here: {expat.ErrorString(error.code)}; the rest is not read",
            )

    def _without_comments(self, text: str) -> str:
        """Blank the comments as the robot's own reader ends them: at the first -->."""
        result = []
        rest = 0
        while (start := text.find("<!--", rest)) >= 0:
            result.append(text[rest:start])
            end = text.find("-->", start + 4)
            line = text.count("\n", 0, start) + 1
            if end < 0:
                self.findings.odd(self.path, line, "a comment without an end; it takes the rest")
                return "".join(result)
            inner = text.find("<!--", start + 4, end)
            if inner >= 0:
                self.findings.odd(
                    self.path,
                    text.count("\n", 0, inner) + 1,
                    f"a comment within the comment of line {line}; both end at the first -->, "
                    f"line {text.count(chr(10), 0, end) + 1}",
                )
            if "triangleSetCfg" in text[start:end]:
                self.findings.odd(
                    self.path, line, "a comment with sets of triangles in it; they are not read"
                )
            result.append("\n" * text.count("\n", start, end))
            rest = end + 3
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
            self._text = ""
        elif tag == "xi:include":
            self.includes.append((line, attributes.get("href", "")))

    def _characters(self, text: str) -> None:
        self._text += text

    def _end(self, tag: str) -> None:
        if tag == "group":
            self._group = ""
        elif tag == "param" and self._entry is not None:
            line, name = self._entry
            words = self._text.replace("(", " ").replace(")", " ").split()
            entry = Entry(self.path, line, name, words)
            self.groups.setdefault(self._group, []).append(entry)
            self._entry = None


def integer(word: str) -> int | None:
    """A number as the robot's own reader takes it: decimal, or hexadecimal with 0x."""
    match = re.fullmatch(r"([+-]?)(0[xX][0-9a-fA-F]+|[0-9]+)", word)
    if match is None or len(word) > 12:
        return None
    value = int(match[2], 16 if match[2][:2].lower() == "0x" else 10)
    return -value if match[1] == "-" else value
