"""Mutation testing of the core: small changes of the code that the tests of its room must notice.

    python -m tests.support.mutation [--places 40] [--seed 1] [FILE ...]

cosmic-ray makes the changes, `mutation_operators.py` some more; the tests run in a copy of the
tree. `mutation.toml` has the files of the core with their tests, and the changes that are
equivalent: nothing that the code promises depends on them. The seed draws so many places of each
file, and one change of each place.
"""

import argparse
import ast
import compileall
import contextlib
import difflib
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis.extra.numpy  # noqa: F401  (loaded once, not by each run of the tests)
import msgspec
import numpy as np  # noqa: F401
import pytest
from cosmic_ray.commands import init
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import OPERATOR_PROVIDERS, get_operator
from cosmic_ray.work_db import WorkDB, use_db

from tests.support.mutation_operators import Provider

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_suffix(".toml")
COPIED = ("skin_host", "emulator", "tests", "config")
#: Failing examples are not made smaller, and every run draws the same ones.
OPTIONS = [
    "-x",
    "-q",
    "-n",
    "0",
    "-p",
    "no:cacheprovider",
    "--assert=plain",
    "--hypothesis-profile=mutation",
]
#: Tests that take so much more CPU time than without a change hang.
SLOWER, SLOWER_S = 2.0, 3.0
#: They are interrupted then, so that they end what they started, and killed so much later.
INTERRUPTED_S = 5
#: So do tests that wait for so long.
LONGEST_S = 600
#: A number that changes by less than a millionth of itself promises nothing.
LARGE = 10**6
#: They make the same of what is only ever compared with None.
SAME = ("ReplaceComparisonOperator_Is_Eq", "ReplaceComparisonOperator_IsNot_NotEq")


class Core(msgspec.Struct, forbid_unknown_fields=True):
    """A file of the core, and the files of tests that have to notice its changes."""

    file: str
    tests: list[str]


class Equivalent(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A change that no test can notice: a line, what it becomes, and why that is the same."""

    file: str
    line: str
    becomes: str
    reason: str


class Table(msgspec.Struct, forbid_unknown_fields=True):
    """See the module."""

    core: list[Core]
    equivalent: list[Equivalent]


def read_table() -> Table:
    return msgspec.toml.decode(TABLE.read_bytes(), type=Table)


@contextlib.contextmanager
def copied_tree() -> Iterator[Path]:
    """A copy of what tests need, for as long as it is used."""
    with tempfile.TemporaryDirectory(prefix="skin-mutation-") as name:
        folder = Path(name)
        for entry in ROOT.iterdir():
            if entry.name in COPIED:
                shutil.copytree(entry, folder / entry.name)
                compileall.compile_dir(folder / entry.name, quiet=1)
            elif not entry.name.startswith("."):
                (folder / entry.name).symlink_to(entry)
        with contextlib.chdir(folder):
            yield folder


def drawn(source: str, items: list[Any], places: int, seed: int) -> list[Any]:
    """Return one change for each of so many places; a change elsewhere in the file changes few."""
    lines = source.splitlines()
    typed = [
        (node.lineno, node.col_offset, node.end_lineno, node.end_col_offset)
        for node in _annotations(ast.parse(source))
    ]

    def order(item: Any) -> bytes:
        (change,) = item.mutations
        row, column = change.start_pos
        text = f"{seed} {lines[row - 1]} {column} {change.operator_name} {change.occurrence}"
        return blake2b(text.encode()).digest()

    found: dict[tuple[int, int], Any] = {}
    for item in sorted(items, key=order):
        (change,) = item.mutations
        row, column = change.start_pos
        is_type = any((a, b) <= (row, column) < (c, d) for a, b, c, d in typed)
        number = re.match(r"\d[\d_]*(\.\d+)?(e\d+)?", lines[row - 1][column:])
        is_large = number is not None and float(number[0]) >= LARGE
        if not is_type and not is_large and not change.operator_name.endswith(SAME):
            found.setdefault(change.start_pos, item)
    return list(found.values())[:places]


def _annotations(tree: ast.Module) -> Iterator[Any]:
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign | ast.arg) and node.annotation is not None:
            yield node.annotation
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.returns is not None:
            yield node.returns


def changed(source: str, becomes: str) -> tuple[str, str]:
    """Return the line that was changed, and what it became."""
    lines = list(difflib.ndiff(source.splitlines(), becomes.splitlines()))
    before = [line[2:].strip() for line in lines if line.startswith("- ")]
    after = [line[2:].strip() for line in lines if line.startswith("+ ")]
    return " ".join(before), " ".join(after)


def identity(file: str, line: str, becomes: str) -> tuple[str, str, str]:
    """Return a change without its spaces: cosmic-ray leaves some that nobody would write."""
    return file, *("".join(text.split()) for text in (line, becomes))


def is_same(line: str, becomes: str) -> bool:
    """Whether the same is made of a change.

    To numpy any negative number stands for a size to find; `strict` finds only other mistakes.
    """
    becomes = re.sub(r"(reshape\((?:\w+,)?)(?:-2|~1)\b", r"\1-1", becomes)
    return line == becomes.replace("strict=False", "strict=True")


class Quickest:
    """Runs the quickest tests first: most changes are noticed before the slow ones begin.

    Args:
        times: a file in which a first run notes the tests in that order.
    """

    def __init__(self, times: Path) -> None:
        self._times = times
        self._took_s: dict[str, float] = {}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        if self._times.exists():
            order = self._times.read_text().splitlines()
            items.sort(key=lambda item: order.index(item.nodeid))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        took_s = self._took_s.get(report.nodeid, 0.0) + report.duration
        self._took_s[report.nodeid] = took_s

    def pytest_sessionfinish(self) -> None:
        if not self._times.exists():
            order = sorted(self._took_s, key=lambda test: self._took_s[test])
            self._times.write_text("\n".join(order))


def passes(tests: list[str], times: Path, limit_s: float | None = None) -> bool:
    """Whether tests pass, in a child of this process: what they import is compiled, most is loaded.

    Args:
        tests: files.
        times: see `Quickest`.
        limit_s: CPU time that they may take.
    """
    child = os.fork()
    if not child:
        sys.dont_write_bytecode = True  # two changes within a second look alike to its cache
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        for number in (signal.SIGXCPU, signal.SIGALRM):
            signal.signal(number, signal.default_int_handler)
        if limit_s is not None:
            soft_s = int(limit_s) + 1
            resource.setrlimit(resource.RLIMIT_CPU, (soft_s, soft_s + INTERRUPTED_S))
            signal.alarm(LONGEST_S)
        os._exit(pytest.main([*OPTIONS, *tests], plugins=[Quickest(times)]))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def children_s() -> float:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


class Counts(NamedTuple):
    """How many changes of a file were noticed, and how many were not."""

    killed: int
    lived: int

    def __str__(self) -> str:
        drawn = self.killed + self.lived
        return f"{self.killed} of {drawn} noticed ({100 * self.killed / max(drawn, 1):.0f} %)"


def score(core: Core, equivalents: set[tuple[str, str, str]], places: int, seed: int) -> Counts:
    """Run a file's changes, and print those that nobody noticed."""
    path = Path(core.file)
    source = path.read_text()
    before_s = children_s()
    times = Path(f"{path.name}.times")
    if not passes(core.tests, times):
        sys.exit(f"{core.file}: its tests fail without a change: pytest {' '.join(core.tests)}")
    limit_s = SLOWER * (children_s() - before_s) + SLOWER_S
    with use_db(":memory:", WorkDB.Mode.create) as work:
        init([path], work, {})
        items = list(work.work_items)
    killed = lived = same = 0
    for item in drawn(source, items, places, seed):
        (change,) = item.mutations
        becomes = mutate_code(source, get_operator(change.operator_name)(), change.occurrence)
        assert becomes is not None
        line = changed(source, becomes)
        change_made = identity(core.file, *line)
        if change_made in equivalents or is_same(*change_made[1:]):
            same += 1
            continue
        path.write_text(becomes)
        if passes(core.tests, times, limit_s):
            lived += 1
            print(
                f"  {core.file}:{change.start_pos[0]}\n    - {line[0]}\n    + {line[1]}", flush=True
            )
        else:
            killed += 1
    path.write_text(source)
    counts = Counts(killed, lived)
    print(f"{core.file}: {counts}; {same} equivalent; {len(items)} possible", flush=True)
    return counts


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--places", type=int, default=40, help="of each file (default 40)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("files", nargs="*", metavar="FILE", help="of the core (default: all)")
    arguments = parser.parse_args()
    table = read_table()
    unknown = set(arguments.files) - {core.file for core in table.core}
    if unknown:
        parser.error(f"not in {TABLE.name}: {', '.join(sorted(unknown))}")
    OPERATOR_PROVIDERS["statements"] = Provider()
    equivalents = {identity(one.file, one.line, one.becomes) for one in table.equivalent}
    with copied_tree():
        counts = [
            score(core, equivalents, arguments.places, arguments.seed)
            for core in table.core
            if not arguments.files or core.file in arguments.files
        ]
    print(f"all: {Counts(*map(sum, zip(*counts, strict=True)))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
