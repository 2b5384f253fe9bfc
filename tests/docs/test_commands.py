"""Every command that the documentation shows is one that there is."""

import argparse
import re
import tomllib
from pathlib import Path

import pytest

from skin_host.cli import build_parser
from tests.support.pages import PAGES, ROOT, blocks, commands, mentioned

CONFIGURATION = PAGES["docs/configuration.md"].read_text()
SHOWN = [
    pytest.param(command.words, id=f"{page}:{command.line}")
    for page in PAGES
    for block in blocks(page)
    for command in commands(block)
]
OURS = [case for case in SHOWN if case.values[0][0] == "skin"]
MADE = [case for case in SHOWN if case.values[0][0] == "make"]
MENTIONED = [
    pytest.param(words, id=f"{page}: {' '.join(words)}")
    for page in PAGES
    for words in mentioned(page)
]


PARSER = build_parser()


def parsers() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command."""
    for action in PARSER._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    raise AssertionError("no commands")


@pytest.mark.parametrize("words", OURS)
def test_a_shown_command_can_be_parsed(words: list[str]) -> None:
    PARSER.parse_args(words[1:])


@pytest.mark.parametrize("words", MENTIONED)
def test_a_mentioned_command_and_its_options_exist(words: list[str]) -> None:
    parser = parsers()[words[1]]
    known = {option for action in parser._actions for option in action.option_strings}
    assert {word for word in words[2:] if word.startswith("-")} <= known
    # One with a file can be typed as it stands; placeholders are in capitals.
    if any(re.search(r"[a-z]\.[a-z]+$", word) for word in words[2:]):
        PARSER.parse_args(words[1:])


@pytest.mark.parametrize("command", parsers())
def test_the_example_of_a_command_can_be_parsed(command: str) -> None:
    example = (parsers()[command].epilog or "").partition("Example: ")[2]
    words = example.partition(", in ")[0].split()
    assert words[:2] == ["skin", command]
    PARSER.parse_args(words[1:])


@pytest.mark.parametrize("words", MADE)
def test_a_shown_target_of_make_exists(words: list[str]) -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {word for word in words[1:] if "=" not in word} <= set(targets)


def test_every_command_is_explained_somewhere() -> None:
    named = {case.values[0][1] for case in [*OURS, *MENTIONED]}
    # `make demo` is how the demo is started.
    assert set(parsers()) - named <= {"demo"}


def test_the_kinds_of_the_configuration_page_are_those_that_are_built_in() -> None:
    (row,) = re.findall(r"^\| `kind` .*built in are ([^|]*)\|", CONFIGURATION, re.MULTILINE)
    kinds = tomllib.loads((ROOT / "skin_host/layout/kinds.toml").read_text())
    assert row.strip().split(", ") == list(kinds)


def test_every_page_has_its_place_on_the_site() -> None:
    placed = set(re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert {Path(page).name for page in PAGES if page.startswith("docs/")} <= placed


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    path = PAGES[page]
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, heading = target.partition("#")
        linked = path.parent / file if file else path
        assert linked.exists(), target
        if heading:
            headings = re.findall(r"^#+ (.*)$", linked.read_text(), re.MULTILINE)
            slugs = [re.sub(r"[^\w -]", "", one).lower().replace(" ", "-") for one in headings]
            assert heading in slugs, target
