"""Boards whose data is a recording: fidelity "replay".

The firmware runs as usual (discovery, configuration, start and stop, periods); only the content of
its data frames comes from a log, sweep by sweep, and starts again at the end of the log.
"""

from collections.abc import Mapping
from pathlib import Path

import can
import numpy as np

from skin_host.bus.wire import FrameBatch, find_skin_frames
from skin_host.errors import ConfigurationError, LogError
from skin_host.layout import Layout


class Recording:
    """The sweeps of one board in a log.

    Args:
        path: any log that python-can reads (candump's .log, .asc, .blf ...).
        address: the board's address in the log.

    Attributes:
        sweeps: frames of each sweep, in the order of the log.

    Raises:
        LogError: unreadable, or without data frames of this board.
    """

    def __init__(self, path: Path, address: int) -> None:
        try:
            with can.LogReader(path) as reader:
                frames = [
                    (message.arbitration_id, bytes(message.data), 0)
                    for message in reader
                    if not (message.is_extended_id or message.is_error_frame)
                    and message.arbitration_id >> 4 & 0xF == address
                ]
        except (OSError, ValueError) as error:
            raise LogError(f"{path}: cannot be read: {error}") from None
        batch = FrameBatch.of(frames)
        found = find_skin_frames(batch)
        if not len(found.row):
            raise LogError(f"{path}: holds no data frames of a board with address {address}")
        self.sweeps: list[FrameBatch] = []
        self._next = 0
        seen: set[tuple[int, int]] = set()
        start = 0
        keys = list(zip(found.triangle.tolist(), found.half.tolist(), strict=True))
        for end, key in enumerate([*keys, keys[0]]):
            # A half of a triangle that was there already begins the next sweep.
            if key in seen or end == len(keys):
                rows = found.row[start:end]
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
