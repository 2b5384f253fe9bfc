"""Connected sets of touched taxels. Pure.

Few touched taxels are walked through from neighbour to neighbour. Where many are touched most of
them lie in the midst of others, so the skin is cut into blocks of connected taxels beforehand: one
that is touched as a whole is one step of the walk.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Taxels of a block, at most; and where so many are touched, blocks are looked at.
BLOCK = 16
MANY = 64


class Patches:
    """Finds the patches of one part.

    Args:
        neighbours: of each taxel.
    """

    def __init__(self, neighbours: Sequence[Sequence[int]]) -> None:
        self._neighbours = neighbours
        self._block_of = [-1] * len(neighbours)
        self._blocks: list[list[int]] = []
        for first in range(len(neighbours)):
            if self._block_of[first] < 0:
                self._grow(first)
        #: Of each block: the blocks next to it, and which of their taxels are.
        self._next: list[list[tuple[int, list[int]]]] = []
        for number, block in enumerate(self._blocks):
            near: dict[int, set[int]] = {}
            for taxel in block:
                for other in neighbours[taxel]:
                    if self._block_of[other] != number:
                        near.setdefault(self._block_of[other], set()).add(other)
            self._next.append([(one, sorted(taxels)) for one, taxels in near.items()])
        self._block = np.array(self._block_of, np.intp)
        self._sizes = np.array([len(block) for block in self._blocks])

    def _grow(self, first: int) -> None:
        """Make a block of a taxel and the nearest that are in none."""
        number = len(self._blocks)
        block = [first]
        self._block_of[first] = number
        for taxel in block:  # grows while it is walked
            for other in self._neighbours[taxel]:
                if len(block) < BLOCK and self._block_of[other] < 0:
                    self._block_of[other] = number
                    block.append(other)
        self._blocks.append(block)

    def find(self, touched: NDArray[np.intp]) -> list[frozenset[int]]:
        """Connected sets of touched taxels, in the order of their lowest number.

        Args:
            touched: in rising order.
        """
        if len(touched) < MANY:
            return self._walk(touched.tolist())
        counts = np.bincount(self._block[touched], minlength=len(self._blocks))
        full = counts == self._sizes
        single = set(touched[~full[self._block[touched]]].tolist())
        return self._walk_blocks(full.tolist(), single)

    def _walk(self, touched: list[int]) -> list[frozenset[int]]:
        left = set(touched)
        patches = []
        for first in touched:
            if first not in left:
                continue
            left.remove(first)
            patch = [first]
            for taxel in patch:  # grows while it is walked
                for other in self._neighbours[taxel]:
                    if other in left:
                        left.remove(other)
                        patch.append(other)
            patches.append(frozenset(patch))
        return patches

    def _walk_blocks(self, full: list[bool], single: set[int]) -> list[frozenset[int]]:
        """The same by blocks that are touched as a whole, and the single taxels of all others."""
        block_of = self._block_of
        unseen = full.copy()
        patches = []
        whole = [(block, -1) for block, is_full in enumerate(full) if is_full]
        for first_block, first in whole + [(-1, taxel) for taxel in sorted(single)]:
            taxels: list[int] = []
            blocks: list[int] = []
            if first < 0 and unseen[first_block]:
                unseen[first_block] = False
                blocks.append(first_block)
            elif first in single:
                single.remove(first)
                taxels.append(first)
            else:
                continue
            at = at_block = 0
            while at < len(taxels) or at_block < len(blocks):
                for block in blocks[at_block:]:
                    for near, border in self._next[block]:
                        if unseen[near]:
                            unseen[near] = False
                            blocks.append(near)
                        elif not full[near] and not single.isdisjoint(border):
                            found = single.intersection(border)
                            single -= found
                            taxels += found
                    at_block += 1
                for taxel in taxels[at:]:
                    for other in self._neighbours[taxel]:
                        near = block_of[other]
                        if unseen[near]:
                            unseen[near] = False
                            blocks.append(near)
                        elif other in single:
                            single.remove(other)
                            taxels.append(other)
                    at += 1
            for block in blocks:
                taxels += self._blocks[block]
            patches.append(frozenset(taxels))
        return sorted(patches, key=min) if len(patches) > 1 else patches
