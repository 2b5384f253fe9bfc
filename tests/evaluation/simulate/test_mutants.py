"""The planted faults can still be planted, and a few of them are found at once."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.evaluation.simulate.mutants import MUTANTS, ROOT, Mutant, outcome, plant


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_planted_fault_has_its_place(mutant: Mutant) -> None:
    assert (ROOT / "skin_host" / mutant.file).read_text().count(mutant.line) == 1
    assert mutant.planted != mutant.line


def test_a_planted_fault_is_found(tmp_path: Path) -> None:
    (mutant,) = (one for one in MUTANTS if one.name == "every event has the same count")
    plant(mutant, tmp_path)
    code = f"print(outcome(Path({str(tmp_path)!r}), 5, 30))"
    said = subprocess.run(
        [sys.executable, "-c", f"from {outcome.__module__} import *; {code}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "two events have the count 1" in said.stdout
