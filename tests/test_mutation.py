"""The table of `make mutation` names what exists."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = tomllib.loads((ROOT / "tests/support/mutation.toml").read_text())


def test_files_of_the_core_and_their_tests_exist() -> None:
    for core in TABLE["core"]:
        for name in (core["file"], *core["tests"]):
            assert (ROOT / name).is_file(), name


def test_lines_of_which_a_change_is_equivalent_are_still_there() -> None:
    files = {core["file"] for core in TABLE["core"]}
    for one in TABLE["equivalent"]:
        assert one["file"] in files
        text = (ROOT / one["file"]).read_text()
        assert "".join(one["line"].split()) in "".join(text.split()), one
        assert one["reason"]
