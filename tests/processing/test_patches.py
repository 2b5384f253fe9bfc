"""Connected sets are the same whether they are walked through one by one or by blocks."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.processing.patches import MANY, Patches

ICUB = Path(__file__).parents[2] / "config" / "icub.toml"


@pytest.fixture(scope="module")
def neighbours() -> list[list[int]]:
    layout = build_layout(load(ICUB), ICUB.parent)
    part = max(layout.parts, key=lambda part: part.n_taxels)
    start = layout.neighbour_start[part.start : part.stop + 1].tolist()
    near = (layout.neighbour - part.start).tolist()
    return [near[begin:end] for begin, end in pairwise(start)]


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8, 0.95, 0.99, 1.0])
def test_blocks_change_nothing(neighbours: list[list[int]], share: float) -> None:
    rng = np.random.default_rng(round(100 * share))
    patches = Patches(neighbours)
    for _ in range(20):
        touched = np.flatnonzero(rng.random(len(neighbours)) < share)
        assert len(touched) >= MANY
        assert patches.find(touched) == patches._walk(touched.tolist())


def test_a_part_without_neighbours_is_as_many_patches_as_taxels() -> None:
    patches = Patches([[] for _ in range(2 * MANY)])
    touched = np.arange(1, 2 * MANY)
    assert patches.find(touched) == [frozenset([taxel]) for taxel in touched.tolist()]
    assert patches.find(touched[:0]) == []
