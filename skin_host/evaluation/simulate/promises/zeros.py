"""What presses a pad when its board is zeroed: if nobody felt it begin, it is in the zero."""

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.promises.excuses import Excuses
from skin_host.evaluation.simulate.promises.limits import (
    DECIDED_NS,
    LONG_AGO_NS,
    PRESSED_KPA,
    SURE_PADS,
    TOUCHING_KPA,
    UNHEARD_PERIODS,
)
from skin_host.evaluation.simulate.promises.truth import Truth
from skin_host.evaluation.simulate.world import Life, World
from skin_host.processing.rezero import Rezero


class ZeroCheck:
    """Follows the zeros that boards take, and those that the daemon observes.

    Args:
        world: to watch.
        excuses: where taxels are exempt whose zero nobody can know.
        truth: what pressure each taxel detects in time: noisy ones only a firm press.
    """

    def __init__(self, world: World, excuses: Excuses, truth: Truth) -> None:
        self._world, self._excuses = world, excuses
        self._truth = truth
        n = world.layout.n_taxels
        #: When each taxel began to be pressed, or firmly so, when its board was last received, and
        #: since when what presses it may be in its zero.
        self._pressed = np.zeros(n, np.bool_)
        self._firmly = np.zeros(n, np.bool_)
        self._pressed_ns = np.zeros(n, np.int64)
        self._unfelt_ns = np.zeros(n, np.int64)
        #: When the chip of each taxel last did not answer, and when it last had answered for so
        #: long that what presses the taxel is felt.
        self._deaf_ns = np.full(n, LONG_AGO_NS, np.int64)
        self._answered_ns = np.zeros(n, np.int64)
        self._rezeros: dict[int, Rezero] = {}
        #: By board: the zero that it has itself, at the sample before.
        self._bases = [board.base.copy() for board in world.robot.boards.values()]
        #: By board: the time of the first sweep that its zero was observed in, and when that was.
        self._observed: dict[int, tuple[int | None, int]] = {}
        #: The daemon's present life, and boards whose zero it has not found yet.
        self._life: Life | None = None
        self._unfound: set[int] = set()

    def note_taken(
        self, true_kpa: NDArray[np.float64], felt_ns: NDArray[np.int64], *, alone: bool
    ) -> None:
        """A board that zeroes itself while no daemon runs has what presses it in its zero. So has a
        small one that does it unheard: how its few pads rest hardly shows it. Note also which chips
        answer.

        Args:
            true_kpa: what presses each taxel [n].
            felt_ns: when each was last received, as known at the sample before [n].
            alone: no daemon has run all the time since the sample before.
        """
        boards, now_ns = self._world.robot.boards, self._world.clock.monotonic_ns()
        answers = self._world.robot.converters.signal.forced < 0
        self._deaf_ns[~answers[self._world.layout.triangle_of]] = now_ns
        self._answered_ns[now_ns - self._deaf_ns > DECIDED_NS] = now_ns
        spoiled = self._excuses.spoiled()
        for board, base in zip(self._world.layout.boards, self._bases, strict=True):
            now = boards[board.name].base
            if np.array_equal(base, now):
                continue
            base[:] = now
            taxels = board.taxel_index[board.taxel_index >= 0]
            quiet_ns = now_ns - int(felt_ns[taxels].max())
            unheard = quiet_ns > UNHEARD_PERIODS * board.settings.period_ms * 1_000_000
            if alone:
                # The next daemon measures by the zero before, so that they may look touched.
                self._excuses.zeroed_touched[taxels] = True
            if alone or (unheard and len(taxels) < SURE_PADS):
                pressed = (true_kpa[taxels] > TOUCHING_KPA) | self._pressed[taxels]
                self._excuses.exempt[taxels] |= pressed | (spoiled[taxels] & unheard)

    def note_observed(
        self,
        life: Life,
        true_kpa: NDArray[np.float64],
        valid_ns: NDArray[np.int64],
        felt_ns: NDArray[np.int64],
    ) -> None:
        """What a board did not feel before it took a zero is in that zero: nobody can know.

        Args:
            life: the daemon's.
            true_kpa: what presses each taxel [n].
            valid_ns: when each was last valid [n].
            felt_ns: when each was last received, as known at the sample before [n].
        """
        now_ns, wall_ns = self._world.clock.monotonic_ns(), self._world.clock.now_ns()
        spoiled = self._excuses.spoiled()
        pressed, firmly = true_kpa > TOUCHING_KPA, true_kpa > PRESSED_KPA
        # What pressed hardly before, and was not felt, may press firmly now.
        self._pressed_ns[(pressed & ~self._pressed) | (firmly & ~self._firmly)] = now_ns
        self._pressed, self._firmly = pressed, firmly
        layout = self._world.layout
        if life is not self._life:
            # What these send is measured by the zero before, so that they may look touched.
            for board in self._unfound:
                taxels = layout.boards[board].taxel_index
                self._excuses.zeroed_touched[taxels[taxels >= 0]] = True
            self._life, self._unfound = life, set()
        for board, rezero in life.daemon.engine.zeros.rezeros.items():
            taxels = layout.boards[board].taxel_index
            taxels = taxels[taxels >= 0]
            before = self._rezeros.get(board)
            if before is not rezero:
                self._rezeros[board] = rezero
                self._excuses.note_zeroed(taxels)
                own = layout.boards[board].settings
                boards = life.daemon.link.boards[own.bus]
                record = boards.records[own.address]
                felt = record.configurations > 0 or boards._is_in_use(record)
                last_ns = int(felt_ns[taxels].max()) if felt else LONG_AGO_NS
                answered_ns = np.minimum(self._answered_ns[taxels], last_ns)
                self._unfelt_ns[taxels] = answered_ns - DECIDED_NS
                if before is None or before.settled(wall_ns):
                    # Its chip has sent nothing valid since, and not because of the zero before.
                    since_ns = valid_ns[taxels] - DECIDED_NS
                    self._unfelt_ns[taxels] = np.minimum(self._unfelt_ns[taxels], since_ns)
            if rezero._since_ns != self._observed.get(board, (None, 0))[0]:
                self._observed[board] = rezero._since_ns, now_ns
            if rezero.settled(wall_ns):
                self._unfound.discard(board)
            else:
                self._unfound.add(board)
            # Whatever begins to press while the zero is observed, or later, is felt.
            finds = np.ones(len(taxels), np.bool_)
            if rezero.settled(wall_ns):
                unsettled = rezero.unsettled(wall_ns)
                fitted = (layout.boards[board].taxel_index >= 0).ravel()
                finds = np.zeros_like(finds) if unsettled is None else unsettled[fitted]
            unfelt = pressed[taxels] & (self._pressed_ns[taxels] > self._unfelt_ns[taxels])
            if rezero.begun:
                unfelt &= self._pressed_ns[taxels] <= self._observed[board][1]
            if finds.any():
                unfelt |= pressed[taxels] & (true_kpa < self._truth.felt_kpa)[taxels]
            self._excuses.exempt[taxels] |= finds & (unfelt | spoiled[taxels])
