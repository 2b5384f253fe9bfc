"""Feeds recorded frames to an engine as a daemon's link feeds what it receives.

A board that stops is noticed by the time in which nothing comes from it: the link looks for that
in every turn (`daemon.link`). Here the recording's own time stamps are the time. Between two frames
that are far apart lies the same silence as on the bus; but a lone time stamp that is far ahead or
behind is damage, and a clock that goes back was set: neither is time in which nothing came.

What the host sent is in a recording too, where a recorder on the bus has made it. A board that it
sets up has another zero from then on, of which a daemon would have informed its engine.
"""

from collections.abc import Iterable, Iterator

from skin_host.bus.commands import cut_where_zeroed
from skin_host.bus.ledger import LONGEST_DISORDER_NS
from skin_host.bus.wire import BROADCAST_ADDRESS, FrameBatch
from skin_host.errors import LogError
from skin_host.processing.core import EXPIRE_NS, Engine, Output

#: After so long without a frame every board is silent, whatever its settings, and all that touched
#: it has ended as lost. The rest of a gap changes nothing more, but what may drift in it.
LONGEST_STEPPED_NS = 60_000_000_000


def fed(
    batches: Iterable[tuple[str, FrameBatch]], engine: Engine, disorder_ns: int
) -> Iterator[tuple[int, Output]]:
    """Feed the batches of a recording to an engine; yield what comes of it, each with its time on
    the clock of the recording: what was received until then has been fed.

    Of a skin on one bus without fingertips each sweep has a result of its own, however long the
    batches are.

    Args:
        batches: name of the bus, and its frames.
        engine: has been fed nothing yet.
        disorder_ns: frames of other buses that are so much older may follow a batch.

    Raises:
        LogError: the recording ends with damage; everything before it has then been fed.
    """
    turns = _Turns(engine, disorder_ns)
    last_ns = 0
    for bus, batch, after_ns in _ahead(batches):
        yield from turns.pass_to(int(batch.t_ns[0]), after_ns)
        last_ns = int(batch.t_ns[-1])
        for piece in turns.commanded(bus, batch):
            if not turns.alone:
                yield last_ns, engine.feed(bus, piece)
                continue
            for sweep in engine.assemblers[bus].feed(piece).sweeps:
                yield from turns.step_to(sweep.t_ns)
                yield sweep.t_ns, engine.take(sweep)
    yield last_ns, engine.flush()


class _Turns:
    """The time of a replay, and what a link does as it passes.

    Attributes:
        alone: the skin has one bus and no fingertips.
    """

    def __init__(self, engine: Engine, disorder_ns: int) -> None:
        self._engine = engine
        self._disorder_ns = disorder_ns
        self.alone = len(engine.settings.buses) == 1 and engine.fingertips is None
        #: Everything older has been fed; None before the first batch.
        self._now_ns: int | None = None
        self._expired_ns = 0
        #: Boards that were set up in the recording.
        self._set_up: set[int] = set()

    def pass_to(self, first_ns: int, after_ns: int | None) -> Iterator[tuple[int, Output]]:
        """Let the time pass up to a batch, before it is fed; yield what has waited too long.

        Args:
            first_ns: time of its first frame.
            after_ns: time of the first frame of the batch after it, if there is one.
        """
        now_ns = first_ns if self._now_ns is None else self._now_ns
        # A damaged time stamp is further away than what comes after it; a gap and a clock that was
        # set go on from there.
        times = (first_ns,) if after_ns is None else (first_ns, after_ns)
        t_ns = min(times, key=lambda one: abs(one - now_ns))
        if self._now_ns is None or t_ns - now_ns < -LONGEST_DISORDER_NS:
            self._now_ns = t_ns - self._disorder_ns
            self._expired_ns = self._now_ns // EXPIRE_NS * EXPIRE_NS
            self._engine.ledger.pass_over(self._now_ns)
            return
        yield from self.step_to(t_ns)

    def step_to(self, t_ns: int) -> Iterator[tuple[int, Output]]:
        """Let the time pass up to a frame's time, as long as that is later."""
        now_ns = t_ns - self._disorder_ns
        if self._now_ns is None or now_ns <= self._now_ns:
            return
        self._now_ns = now_ns
        engine = self._engine
        # At multiples of the step, whenever the recording begins.
        end_ns = min(now_ns, self._expired_ns + LONGEST_STEPPED_NS)
        while self._expired_ns + EXPIRE_NS <= end_ns:
            self._expired_ns += EXPIRE_NS
            output = engine.expire(self._expired_ns)
            if output.sweeps or output.steps or output.grasps:
                yield self._expired_ns, output
        left_ns = now_ns - self._expired_ns
        if left_ns >= EXPIRE_NS:
            engine.ledger.now_ns += left_ns
            engine.ledger.pass_over(now_ns)
            self._expired_ns = now_ns // EXPIRE_NS * EXPIRE_NS
        else:
            engine.ledger.look(now_ns)

    def commanded(self, bus: str, batch: FrameBatch) -> Iterator[FrameBatch]:
        """Yield a batch in pieces, cut where the host gives a board another zero; note that in
        between.
        """
        yield from cut_where_zeroed(batch, lambda address, *_: self._zeroed(bus, address))

    def _zeroed(self, bus: str, address: int) -> None:
        """Inform the engine of another zero of a board, or of all boards of a bus."""
        engine, ledger = self._engine, self._engine.ledger
        for board in engine.boards:
            own = engine.layout.boards[board].settings
            if own.bus != bus or address not in (own.address, BROADCAST_ADDRESS):
                continue
            row = ledger.row[board]
            # Before its first set-up it may send by settings of its own, which read as touches.
            in_use = board in self._set_up or ledger.keeps_period(row) is True
            engine.zeros.rezero(board, in_use)
            ledger.set_up(row)
            self._set_up.add(board)


def _ahead(
    batches: Iterable[tuple[str, FrameBatch]],
) -> Iterator[tuple[str, FrameBatch, int | None]]:
    """Yield batches that have frames, with the time of the first frame of the one after each.

    Raises:
        LogError: see `fed`.
    """
    held: tuple[str, FrameBatch] | None = None
    damage: LogError | None = None
    try:
        for bus, batch in batches:
            if not batch:
                continue
            if held is not None:
                yield *held, int(batch.t_ns[0])
            held = bus, batch
    except LogError as error:
        damage = error
    if held is not None:
        yield *held, None
    if damage is not None:
        raise damage
