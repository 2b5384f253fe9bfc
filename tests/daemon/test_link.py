"""Between the buses and the core: every sweep counts, however it was closed."""

from pathlib import Path

import numpy as np
import pytest

from skin_host.bus import wire
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Board, Bus, Part, Patch, Settings
from skin_host.daemon.link import Link
from skin_host.layout import build_layout
from skin_host.processing.core import Engine, Output
from tests.support.ports import StillPort

MS = 1_000_000
PERIOD = 50 * MS
T0 = 1_700_000_000_000_000_000
TRIANGLES = 4


class Reader:
    """A link with one board on its bus, in time that the test steps."""

    def __init__(self) -> None:
        settings = Settings(
            robot="r",
            buses={"can0": Bus()},
            boards={"b": Board(bus="can0", address=1)},
            parts={"p": Part(patches=[Patch(board="b", triangles=f"0-{TRIANGLES - 1}")])},
        )
        self.engine = Engine(settings, build_layout(settings, Path()), [0])
        self.link = Link(self.engine, open_port=StillPort)
        self.rng = np.random.default_rng(1)
        self.outputs: list[Output] = []
        self.now_ns = T0
        self.turn()
        # Between the end of a sweep's time and the next sweep, the link looks at every second.
        self.now_ns += 12 * MS

    def turn(self) -> None:
        self.link.turn(self.now_ns, self.outputs.append)

    def period(self, keep: np.ndarray) -> None:
        """The board sends the frames with these numbers; then a period passes."""
        port = self.link.ports["can0"]
        assert isinstance(port, StillPort)
        values = self.rng.integers(200, 250, (TRIANGLES, 12), np.uint8)
        ids, data = wire.encode_sweep(
            1, np.arange(TRIANGLES), values, np.zeros(TRIANGLES, np.uint16)
        )
        sent = [(int(ids[i]), data[i].tobytes(), self.now_ns + 100 * int(i)) for i in keep]
        port.waiting.append(FrameBatch.of(sent))
        for _ in range(50):
            self.turn()
            self.now_ns += MS


@pytest.fixture
def reader() -> Reader:
    return Reader()


def test_sweeps_that_time_closes_reach_the_supervision_of_their_board(reader: Reader) -> None:
    for _ in range(200):
        lost = reader.rng.random(2 * TRIANGLES) < 0.05
        reader.period(np.flatnonzero(~lost))
    sweeps = [sweep for output in reader.outputs for sweep in output.sweeps]
    assert len(sweeps) == 200
    assert reader.engine.ledger.sweeps.tolist() == [200]
