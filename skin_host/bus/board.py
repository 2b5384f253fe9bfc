"""One board: its record, and the commands that set it up."""

import asyncio
from dataclasses import dataclass, field

from skin_host.bus.answers import Discovered, DiscoveredBootloader
from skin_host.bus.commands import (
    SKIN_BOARD_TYPES,
    BoardType,
    Message,
    SetBoardConfig,
    SetTriangleConfig,
)
from skin_host.bus.compensation import ERGO_HAND
from skin_host.bus.wire import TRIANGLES
from skin_host.layout import BoardLayout, TriangleLayout

MTB3_GAP_PERIODS = 2.5
GAP_S = 0.01


@dataclass(slots=True)
class BoardRecord:
    """State of one board; part of the health record.

    Attributes:
        index, row: in the layout, and in the ledger.
        started: it has been set up and commanded to send.
        alive: it sends.
        configurations: how often it was set up.
        configured_from_ns, configured_at_ns: when its last set-up began and ended.
        queried_at_ns: when it was last asked for its uptime.
        booted_at_ns: when it started at the earliest, by its last answer to that.
        unanswered: queries in a row to which it sent no answer.
        stopped_sweeps: how many sweeps of it had been received when it answered a query that
            nobody waits for, another program's or one that waited for the bus: an MTB3 has stopped.
        asked: how often it was asked what it is.
        claim: its last answer, if that was that it is in its bootloader or reads no skin, with
            `asked` at that time.
        claimed_ns: when such an answer was last believed.
        set_up_otherwise: another program has set it up since, and not as this one does.

    Times ending in `_at_ns` or `_from_ns`, and `answered_ns`, are monotonic; the others are on the
    clock of the ledger, which stands still while the bus is not read.
    """

    index: int
    row: int
    layout: BoardLayout
    board_type: int | None = None
    firmware: tuple[int, int, int] | None = None
    in_bootloader: bool = False
    started: bool = False
    alive: bool = False
    configurations: int = 0
    configured_ns: int = 0
    configured_from_ns: int = 0
    configured_at_ns: int = 0
    queried_at_ns: int = 0
    booted_at_ns: int | None = None
    answered_ns: int = 0
    unanswered: int = 0
    stopped_sweeps: int | None = None
    asked: int = 0
    claim: tuple[Message, int] | None = None
    claimed_ns: int = 0
    set_up_otherwise: bool = False
    wrong: str = ""
    wrong_since_ns: int = 0
    wrong_tries: int = 0
    wrong_retry_ns: int = 0
    retry_at_ns: int = 0
    retries: int = 0
    warned_at_ns: int | None = None
    commands: list[Message] = field(default_factory=list)
    busy: "asyncio.Task[None] | None" = None

    @property
    def is_mtb3(self) -> bool:
        """By its own answer, or by the configuration if it did not answer."""
        if self.board_type is None:
            return self.layout.settings.model == "mtb3"
        return self.board_type == BoardType.SKIN

    @property
    def may_be_mtb3(self) -> bool:
        """Whether it has not answered that it is none: a wrong model in the configuration would
        silence it.
        """
        return self.board_type in {None, BoardType.SKIN}

    @property
    def is_wrong_model(self) -> bool:
        """Whether it has answered that it is an MTB3, and is not configured as one, or the reverse:
        the two compute different values.
        """
        return self.board_type in SKIN_BOARD_TYPES and not self._is_of_model(self.board_type)

    def _is_of_model(self, board_type: int) -> bool:
        return (board_type == BoardType.SKIN) == (self.layout.settings.model == "mtb3")

    @property
    def was_reset(self) -> bool:
        """Whether it has started since its last set-up began: that is lost, or parts of it."""
        return self.booted_at_ns is not None and self.booted_at_ns > self.configured_from_ns

    @property
    def sends_by_itself(self) -> bool:
        """Whether it started before its last set-up ended: it sends, by settings of its own."""
        return self.was_reset and (self.booted_at_ns or 0) <= self.configured_at_ns

    @property
    def is_wrong_type(self) -> bool:
        """Whether it has answered that it reads no skin."""
        return self.board_type is not None and self.board_type not in SKIN_BOARD_TYPES

    @property
    def claims(self) -> bool:
        """Whether its last answer was that it cannot send skin values."""
        return self.in_bootloader or self.is_wrong_type

    def believes(self, answer: Discovered | DiscoveredBootloader) -> bool:
        """Return whether an answer to a query counts. One that it cannot send skin values, or is
        of another model than configured, counts when the next query is answered alike: damaged
        bytes make such an answer.
        """
        kind = answer.board_type if isinstance(answer, Discovered) else None
        if kind in SKIN_BOARD_TYPES and (kind == self.board_type or self._is_of_model(kind)):
            self.claim = None
            return True
        before, self.claim = self.claim, (answer, self.asked)
        if before is None or before[0] != answer:
            return False
        # The same frame may have come twice.
        return self.claims or before[1] != self.asked

    def disclaim(self) -> None:
        """That answer is not valid any more."""
        self.in_bootloader = False
        if self.is_wrong_type:
            self.board_type = None

    @property
    def gap_s(self) -> float:
        """Return the necessary pause between commands to it."""
        if self.may_be_mtb3:
            return MTB3_GAP_PERIODS * self.layout.settings.period_ms * 1e-3
        return GAP_S


def configuration(board: BoardLayout, triangles: list[TriangleLayout]) -> list[Message]:
    """Return the commands 4D and 50 that set up a board; runs of equal triangles share one
    command.

    An ergoCub hand that has run since it was switched on keeps the settings of a triangle with
    another one, and shifts a triangle's values as that other one is set up. So all get the
    same first, also those that are not fitted.
    """
    settings = board.settings
    commands: list[Message] = [
        SetBoardConfig(settings.skin_type, settings.period_ms, settings.no_load)
    ]
    if settings.effective_skin_type == ERGO_HAND and triangles:
        usual = triangles[0]
        commands.append(SetTriangleConfig(0, TRIANGLES - 1, usual.shift, 0, usual.cdc_offset))
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
