"""Frames of a board, and an assembler that takes them."""

from pathlib import Path

import numpy as np

from skin_host.bus import wire
from skin_host.bus.assembler import Assembler, Sweep
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Board, Bus, Part, Patch, Settings
from skin_host.layout import build_layout

MS = 1_000_000
PERIOD = 50 * MS


def make(
    triangles: str = "0-3",
    boards: int = 1,
    mine: int | None = None,
    force_torque: frozenset[int] = frozenset(),
) -> Assembler:
    """An assembler of the first so many boards, all by default; another node reads the others."""
    names = [f"b{i}" for i in range(boards)]
    skin = build_layout(
        Settings(
            robot="r",
            buses={"can0": Bus()},
            boards={name: Board(bus="can0", address=1 + i) for i, name in enumerate(names)},
            parts={name: Part(patches=[Patch(board=name, triangles=triangles)]) for name in names},
        ),
        Path(),
    )
    others = skin.boards[len(skin.boards) if mine is None else mine :]
    return Assembler(
        list(enumerate(skin.boards[:mine])),
        close_periods=0.9,
        force_torque=force_torque,
        others=frozenset(board.settings.address for board in others),
    )


def values(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, 12), np.uint8)


def frames(
    raw: np.ndarray,
    t_ns: int,
    board: int = 1,
    spacing_ns: int = 125_000,
    status: np.ndarray | None = None,
) -> list[tuple[int, bytes, int]]:
    n = len(raw)
    words = np.zeros(n, np.uint16) if status is None else status
    ids, data = wire.encode_sweep(board, np.arange(n), raw, words)
    return [
        (int(can_id), row.tobytes(), t_ns + i * spacing_ns)
        for i, (can_id, row) in enumerate(zip(ids, data, strict=True))
    ]


def feed(
    assembler: Assembler,
    sent: list[tuple[int, bytes, int]],
    batch: type[FrameBatch] = FrameBatch,
) -> list[Sweep]:
    return assembler.feed(batch.of(sent)).sweeps


def feed_in_parts(
    assembler: Assembler, sent: list[tuple[int, bytes, int]], at_once: int
) -> list[Sweep]:
    """Feed so many frames at once."""
    return [
        sweep
        for at in range(0, len(sent), at_once)
        for sweep in feed(assembler, sent[at : at + at_once])
    ]


def has_nothing_else(sweep: Sweep, raw: np.ndarray) -> None:
    """Assert that the triangles of a sweep that are present are those that were sent in it."""
    for triangle, sent in enumerate(raw):
        if sweep.present >> triangle & 1:
            np.testing.assert_array_equal(sweep.raw[triangle], sent)


def learnt(triangles: str, n: int, order: list[int] | None = None) -> Assembler:
    """An assembler that knows the order of a board's frames."""
    assembler = make(triangles)
    for period in range(1, 5):
        swept = frames(values(n, period), period * PERIOD)
        times = [t_ns for _, _, t_ns in swept]
        came = [swept[i] for i in order or range(2 * n)]
        sent = [(*one[:2], t_ns) for one, t_ns in zip(came, times, strict=True)]
        assert len(feed(assembler, sent)) == 1
    return assembler
