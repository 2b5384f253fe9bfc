"""Computes together the frames of boards that read their chips in the same millisecond."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from emulator.boards.mtb import Burst, Mtb
from emulator.chips.converters import Converters, read_rows
from skin_host.bus.wire import FrameBatch

Ints = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class _Known:
    """A burst of several boards as they were at `versions`.

    Attributes:
        chips: all chips of these boards.
        row: intp[k], where in `chips` that of each triangle is, -1 for none.
        frames_of: which of the frames go to which bus.
    """

    versions: list[int]
    burst: Burst
    chips: Ints
    row: Ints
    frames_of: list[tuple[str, slice]]


class Bursts:
    """What boards send, by any set of them that is due; gathered again only if one has changed.

    Args:
        boards: all of the robot, with chips at fidelity "signal".
        bus_of: the bus of each.
        converters: their chips.
    """

    def __init__(self, boards: list[Mtb], bus_of: list[str], converters: Converters) -> None:
        self._boards = boards
        self._bus_of = bus_of
        self._converters = converters
        self._known: dict[tuple[int, ...], _Known] = {}

    def frames(self, numbers: list[int], t_ns: int) -> Iterator[tuple[str, FrameBatch]]:
        """Yield, by bus, the frames of these boards at `t_ns`.

        Args:
            numbers: of boards with the same arithmetic, those of a bus one after the other.
            t_ns: now.
        """
        known = self._of(numbers)
        raw = read_rows(self._converters.signal, known.chips, known.row)
        batch = known.burst.frames(raw, t_ns)
        if len(known.frames_of) == 1:
            yield known.frames_of[0][0], batch
            return
        for bus, rows in known.frames_of:
            yield (
                bus,
                FrameBatch(batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows]),
            )

    def _of(self, numbers: list[int]) -> _Known:
        boards = [self._boards[number] for number in numbers]
        versions = [board.version for board in boards]
        known = self._known.get(tuple(numbers))
        if known is not None and known.versions == versions:
            return known
        burst = Burst(boards)
        chip_of_slot = self._converters.chip_of_slot
        # A board reads all its chips, whether their triangles are enabled or not.
        wired = np.concatenate([chip_of_slot[number] for number in numbers])
        chips = np.sort(wired[wired >= 0])
        of_board = np.array(numbers, np.intp)[burst.board]
        sent = [chip_of_slot[board][slot] for board, slot in zip(of_board, burst.slot, strict=True)]
        row = np.array([np.searchsorted(chips, one) if one >= 0 else -1 for one in sent], np.intp)
        frames_of: list[tuple[str, slice]] = []
        start = 0
        for bus, of_bus in groupby(self._bus_of[board] for board in of_board):
            stop = start + 2 * len(list(of_bus))
            frames_of.append((bus, slice(start, stop)))
            start = stop
        made = self._known[tuple(numbers)] = _Known(versions, burst, chips, row, frames_of)
        return made
