"""Contents of data frames that a board does not compute by itself.

`Bursts` computes together the frames of boards that read their chips in the same millisecond.

A `Recording` is the data of a board at fidelity "replay": the firmware runs as usual (discovery,
configuration, start and stop, periods), and only the content of its data frames comes from a log,
sweep by sweep, and starts again at the end of the log.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.boards.arithmetic import ABSENT, TAXELS, Bytes, Words
from emulator.boards.mtb import Burst, Mtb, join
from emulator.chips.converters import Converters
from emulator.chips.signal import Ahead
from skin_host.bus.logs import read_channels
from skin_host.bus.wire import FrameBatch, find_skin_frames
from skin_host.errors import ConfigurationError, LogError
from skin_host.layout import Layout

Ints = NDArray[np.intp]


@dataclass(slots=True)
class _Known:
    """A burst of several boards as they were at `versions`.

    Attributes:
        chips: all chips of these boards.
        row: intp[k], where in `chips` that of each triangle is, `len(chips)` for none; None if each
            is where its triangle is.
        is_whole: no triangle is without a chip.
        frames_of: which of the frames go to which bus.
        ahead, revision: the reads that `contents` was made of.
        contents: uint8[m, 2 k, 8], what the frames of these reads hold, or None.
    """

    versions: list[int]
    burst: Burst
    chips: Ints
    row: Ints | None
    is_whole: bool
    frames_of: list[tuple[str, slice]]
    ahead: Ahead | None = None
    revision: int = 0
    contents: Bytes | None = None

    def sent(self, raw: Words) -> Words:
        """Of what the chips answer, uint16[..., n, 12], that of each triangle."""
        if self.row is None:
            return raw
        if self.is_whole:
            return raw[..., self.row, :]
        nothing = np.full((*raw.shape[:-2], 1, TAXELS), ABSENT, np.uint16)
        return np.concatenate([raw, nothing], axis=-2)[..., self.row, :]

    def foresee(self, ahead: Ahead) -> Bytes | None:
        """Return what the frames of a foreseen read hold, or None if that cannot be foreseen."""
        if self.ahead is not ahead or self.revision != ahead.revision:
            self.ahead, self.revision = ahead, ahead.revision
            self.contents = self.burst.contents(self.sent(ahead.results))
        return None if self.contents is None else self.contents[ahead.row].copy()


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
        raw, ahead = self._converters.signal.read_ahead(known.chips)
        # The first of some reads may be the only one.
        data = known.foresee(ahead) if ahead is not None and ahead.row else None
        if data is None:
            batch = known.burst.frames(known.sent(raw), t_ns)
        else:
            batch = known.burst.batch(data, t_ns)
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
        n = len(chips)
        row = np.array([np.searchsorted(chips, one) if one >= 0 else n for one in sent], np.intp)
        is_whole = not (row == n).any()
        straight = np.array_equal(row, np.arange(n))
        frames_of: list[tuple[str, slice]] = []
        start = 0
        for bus, of_bus in groupby(self._bus_of[board] for board in of_board):
            stop = start + 2 * len(list(of_bus))
            frames_of.append((bus, slice(start, stop)))
            start = stop
        made = self._known[tuple(numbers)] = _Known(
            versions, burst, chips, None if straight else row, is_whole, frames_of
        )
        return made


class Recording:
    """The sweeps of one board in a log.

    Args:
        path: any log that `skin replay` reads (candump's .log, .asc, .blf ...).
        address: the board's address in the log.

    Attributes:
        sweeps: frames of each sweep, in the order of the log.

    Raises:
        LogError: unreadable, or without data frames of this board.
    """

    def __init__(self, path: Path, address: int) -> None:
        batch = join([frames for _, frames in read_channels(path)])
        found = find_skin_frames(batch)
        mine = np.flatnonzero(found.board == address)
        if not len(mine):
            raise LogError(f"{path}: holds no data frames of a board with address {address}")
        row, triangle, half = found.row[mine], found.triangle[mine], found.half[mine]
        self.sweeps: list[FrameBatch] = []
        self._next = 0
        seen: set[tuple[int, int]] = set()
        start = 0
        keys = list(zip(triangle.tolist(), half.tolist(), strict=True))
        for end, key in enumerate([*keys, keys[0]]):
            # A half of a triangle that was there already begins the next sweep.
            if key in seen or end == len(keys):
                rows = row[start:end]
                self.sweeps.append(
                    FrameBatch(batch.id[rows], batch.dlc[rows], batch.data[rows], batch.t_ns[rows])
                )
                seen.clear()
                start = end
            seen.add(key)

    def frames(self, address: int, t_ns: int) -> FrameBatch:
        """The frames of the next sweep, sent by a board at `address` at `t_ns`."""
        sweep = self.sweeps[self._next]
        self._next = (self._next + 1) % len(self.sweeps)
        ids = (sweep.id & ~np.uint32(0xF0)) | np.uint32(address << 4)
        times_ns = np.full(len(sweep), t_ns, np.int64)
        return FrameBatch(ids, sweep.dlc.copy(), sweep.data.copy(), times_ns)


def load_recordings(layout: Layout, paths: Mapping[str, Path]) -> dict[int, Recording]:
    """The recordings of a robot's boards, by their index, from logs by the board's name.

    Raises:
        ConfigurationError: there is no such board.
        LogError: a log is unreadable or holds nothing of its board.
    """
    names = [board.name for board in layout.boards]
    unknown = set(paths) - set(names)
    if unknown:
        raise ConfigurationError(f'recordings: no board "{min(unknown)}"')
    return {
        names.index(name): Recording(path, layout.boards[names.index(name)].settings.address)
        for name, path in paths.items()
    }
