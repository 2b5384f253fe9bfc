"""Branch coverage of the core, of branches alone: `python -m tests.support.branches COVERAGE_JSON`.

coverage's own share counts statements and branches together. A branch is one of the ways on from a
line that has several, and is covered when some test goes that way.
"""

import sys
from collections import Counter
from pathlib import Path

import msgspec

#: Of all branches of the core, at least so many per cent are taken by the tests.
LEAST_PERCENT = 95.0


class Summary(msgspec.Struct):
    """Numbers of branches of a file."""

    num_branches: int
    covered_branches: int


class File(msgspec.Struct):
    """A file of the report; the lines from and to which no test went, -n is the end of line n."""

    summary: Summary
    missing_branches: list[tuple[int, int]]


class Report(msgspec.Struct):
    """What `coverage json` writes."""

    files: dict[str, File]


def main(report: Path) -> int:
    """Print each branch that was not taken and the share of each folder; fail below the least."""
    files = msgspec.json.decode(report.read_bytes(), type=Report).files
    taken: Counter[str] = Counter()
    total: Counter[str] = Counter()
    for name, file in sorted(files.items()):
        for begin, end in file.missing_branches:
            print(f"{name}:{begin}: never goes on to {'its end' if end < 0 else f'line {end}'}")
        for of in (str(Path(name).parent), "together"):
            taken[of] += file.summary.covered_branches
            total[of] += file.summary.num_branches
    for of in sorted(total):
        print(f"{of}: {taken[of]} of {total[of]} branches ({100 * taken[of] / total[of]:.1f} %)")
    return int(100 * taken["together"] < LEAST_PERCENT * total["together"])


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
