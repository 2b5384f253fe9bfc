"""The pages of the documentation: their blocks of code, and the commands in them."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {
    str(path.relative_to(ROOT)): path
    for path in [*ROOT.glob("*.md"), *sorted((ROOT / "docs").glob("*.md"))]
}
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"`(skin [^`]+)`")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, the line it begins in, what stands before it."""

    language: str
    text: str
    line: int
    before: str


@dataclass(frozen=True)
class Command:
    """One line for the shell: its words without comment, and what a `console` shows of it."""

    line: int
    words: list[str]
    output: list[str]


def blocks(page: str) -> list[Block]:
    text = PAGES[page].read_text()
    return [
        Block(match[1], match[2], text[: match.start()].count("\n") + 1, text[: match.start()])
        for match in _FENCE.finditer(text)
    ]


def commands(block: Block) -> Iterator[Command]:
    """The commands of a `sh` or `console` block.

    Blocks without a language show what programs print, but for lines that begin as a command
    of this project does.
    """
    if block.language not in {"", "sh", "console"}:
        return
    lines = block.text.replace("\\\n", " ").splitlines()
    for i, line in enumerate(lines):
        if block.language == "console":
            if not line.startswith("$ "):
                continue
            output = []
            for shown in lines[i + 1 :]:
                if shown.startswith("$ "):
                    break
                output.append(shown)
            yield Command(block.line + i + 1, _words(line[2:]), output)
        elif words := _words(line) if block.language == "sh" or _OURS.match(line) else []:
            yield Command(block.line + i + 1, words, [])


_OURS = re.compile(r"(sudo )?(skin|make) [a-z-]+( |$)")


def mentioned(page: str) -> list[list[str]]:
    """What the text says of commands in passing: `skin check CONFIG`."""
    text = _FENCE.sub("", PAGES[page].read_text())
    return [shlex.split(" ".join(match.split())) for match in _INLINE.findall(text)]


def _words(line: str) -> list[str]:
    """One command's words; of a pipe the first command's, of `eval` what is evaluated."""
    words = shlex.split(line, comments=True)
    if words[:1] == ["eval"]:
        words = words[1].removeprefix("$(").removesuffix(")").split()
    for stop in ("|", ">", "&&"):
        if stop in words:
            words = words[: words.index(stop)]
    return words[1:] if words[:1] == ["sudo"] else words
