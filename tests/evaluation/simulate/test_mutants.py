"""The planted faults can still be planted, and a few of them are found at once."""

import pytest

from tests.evaluation.simulate.mutants import MUTANTS, ROOT, Mutant, find


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_planted_fault_has_its_place(mutant: Mutant) -> None:
    assert (ROOT / "skin_host" / mutant.file).read_text().count(mutant.line) == 1
    assert mutant.planted != mutant.line


def test_a_planted_fault_is_found() -> None:
    (mutant,) = (one for one in MUTANTS if one.name == "every event has the same count")
    assert [seed for _, seed, _ in find([mutant], [5], 30)] == [5]
