"""One board: what is known of it, and the commands that set it up."""

import asyncio
from collections import deque
from dataclasses import dataclass, field
from functools import reduce
from operator import or_

import numpy as np

from skin_host.bus.protocol.commands import BoardType, Message, SetBoardConfig, SetTriangleConfig
from skin_host.layout import BoardLayout, TriangleLayout

MTB3_GAP_PERIODS = 2.5
GAP_S = 0.01
#: A period that is off by more than this share is not the one that was set.
WRONG_PERIOD = 0.25
#: A board's own intervals, but for the longest and shortest fifth, lie within this share.
UNEVEN = 0.1
PERIOD_SWEEPS = 16
#: Triangles must be missing in so many sweeps in a row: single frames get lost, sweeps get cut.
MISSING_SWEEPS = 5


@dataclass(slots=True)
class BoardRecord:
    """What is known of one board; part of the health record.

    Attributes:
        started: it has been set up and told to send.
        alive: it sends.
        configurations: how often it was set up.
        silences: how often it fell silent.
        resets: how often it had started anew by itself when it was asked.
        lost_set_ups: how often it sent something else than it was set up to.
        tx_overflows: how often it said that it had to drop frames.

    Times ending in `_at_ns`, and `answered_ns`, are monotonic; the others are on the clock of
    `Boards`, which stands still while nobody reads the bus.
    """

    index: int
    layout: BoardLayout
    board_type: int | None = None
    firmware: tuple[int, int, int] | None = None
    in_bootloader: bool = False
    started: bool = False
    alive: bool = False
    configurations: int = 0
    configured_ns: int = 0
    configured_at_ns: int = 0
    silences: int = 0
    resets: int = 0
    lost_set_ups: int = 0
    tx_overflows: int = 0
    life_s: float | None = None
    answered_ns: int = 0
    last_sweep_ns: int = 0
    sweep_times_ns: deque[int] = field(default_factory=lambda: deque(maxlen=PERIOD_SWEEPS + 1))
    presents: deque[int] = field(default_factory=lambda: deque(maxlen=MISSING_SWEEPS))
    wrong: str = ""
    wrong_since_ns: int = 0
    wrong_tries: int = 0
    wrong_retry_ns: int = 0
    retry_at_ns: int = 0
    retries: int = 0
    commands: list[Message] = field(default_factory=list)
    busy: "asyncio.Task[None] | None" = None

    @property
    def missing(self) -> int:
        """Mask of the triangles that it was told to send and has stopped sending."""
        if len(self.presents) < MISSING_SWEEPS:
            return 0
        return self.layout.enabled & ~reduce(or_, self.presents)

    @property
    def wrong_period_ns(self) -> float | None:
        """Median of its last intervals if the board was set to another period, else None.

        A board's timer is regular whatever it was set to. What comes unevenly, in bunches or
        after pauses is held up somewhere, and setting the board up again would mend nothing.
        """
        if len(self.sweep_times_ns) < PERIOD_SWEEPS // 2:
            return None
        intervals = np.diff(np.array(self.sweep_times_ns, np.int64))
        low_ns, usual_ns, high_ns = np.percentile(intervals, (20, 50, 80)).tolist()
        period_ns = self.layout.settings.period_ms * 1_000_000
        regular = high_ns - low_ns < UNEVEN * usual_ns
        wrong = abs(usual_ns - period_ns) > WRONG_PERIOD * period_ns
        return usual_ns if regular and wrong else None

    @property
    def is_mtb3(self) -> bool:
        """By its own answer, or by the configuration where it did not answer."""
        if self.board_type is None:
            return self.layout.settings.model == "mtb3"
        return self.board_type == BoardType.SKIN

    @property
    def gap_s(self) -> float:
        """How far apart its commands must be."""
        if self.is_mtb3:
            return MTB3_GAP_PERIODS * self.layout.settings.period_ms * 1e-3
        return GAP_S


def configuration(board: BoardLayout, triangles: list[TriangleLayout]) -> list[Message]:
    """Commands 4D and 50 that set up a board; runs of equal triangles share one command."""
    settings = board.settings
    commands: list[Message] = [
        SetBoardConfig(settings.skin_type, settings.period_ms, settings.no_load)
    ]
    run: SetTriangleConfig | None = None
    for triangle in sorted(triangles, key=lambda triangle: triangle.number):
        alike = (
            run is not None
            and run.last + 1 == triangle.number
            and (run.shift, run.cdc_offset) == (triangle.shift, triangle.cdc_offset)
        )
        first = run.first if run is not None and alike else triangle.number
        if run is not None and not alike:
            commands.append(run)
        run = SetTriangleConfig(
            first, triangle.number, triangle.shift, cdc_offset=triangle.cdc_offset
        )
    if run is not None:
        commands.append(run)
    return commands
