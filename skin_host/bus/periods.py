"""The periods of a board: until when its frames are of one sweep, and how many were missed between
two sweeps.

A board sends the frames of a sweep in a burst, once a period. The only times are the stamps of the
frames: some are late, single ones are damaged, and their clock may be set.
"""

from dataclasses import dataclass

from skin_host.bus.wire import TRIANGLES

#: A frame begins the next sweep that comes later than this share of the period after the first of a
#: sweep, and ...
PAUSE_PERIODS = 0.5
#: ... than this one after the last: measured from the last alone, a late frame would hide a pause.
GAP_PERIODS = 1 / 3
#: What is stamped so much earlier than its sweep's first frame came after the clock was set back.
SET_BACK_NS = 100_000_000


@dataclass(slots=True)
class BoardPeriods:
    """When the sweeps of one board end, and the times of the last ones.

    Attributes:
        period_ns: as configured.
        pause_ns, gap_ns: see `PAUSE_PERIODS` and `GAP_PERIODS`.
        close_ns: so long after its first frame a sweep is closed.
        sure_ns: so long after the first frame of a sweep no frame begins the next.
        last_ns, before_ns: time of the last frame of the last sweep, and of the one before.
        missed: whole periods without any frame between these two.
        set_ns: by how much the clock was set since the last sweep before that.
    """

    period_ns: int
    pause_ns: int
    gap_ns: int
    close_ns: int
    sure_ns: int
    last_ns: int = 0
    before_ns: int = 0
    missed: int = 0
    set_ns: int = 0

    @classmethod
    def of(cls, period_ns: int, close_periods: float) -> "BoardPeriods":
        pause_ns, close_ns = int(PAUSE_PERIODS * period_ns), int(close_periods * period_ns)
        gap_ns = int(GAP_PERIODS * period_ns)
        return cls(period_ns, pause_ns, gap_ns, close_ns, min(pause_ns, close_ns))

    def ends_ns(self, first_ns: int, last_ns: int) -> int:
        """Return until when frames belong to a sweep with such a first and last frame."""
        paused_ns = max(first_ns + self.pause_ns, last_ns + self.gap_ns)
        return min(paused_ns, first_ns + self.close_ns)

    def slowest_ns(self, n: int) -> int:
        """Return how long the slowest board, whose sweeps take all of a period, sends n frames."""
        return n * self.period_ns // (2 * TRIANGLES)

    def note(self, last_ns: int) -> int:
        """Take in the time of the last frame of a sweep, and count the periods that were missed.

        Returns:
            By how much that changes the number of all missed periods. It may fall: later times show
            that a stamp was damaged.
        """
        change = 0
        passed_ns = last_ns - self.last_ns
        if abs(passed_ns) > SET_BACK_NS:
            # A time that is far from those before and after it, which are near each other, is a
            # damaged stamp: no time passed up to it, or from it on.
            since_ns = last_ns - self.before_ns
            if abs(since_ns) < min(abs(passed_ns), abs(passed_ns - since_ns)):
                change -= self.missed
                passed_ns, self.last_ns = since_ns, self.before_ns
        self.before_ns, self.last_ns = self.last_ns, last_ns
        if self.set_ns:
            unset_ns = passed_ns - self.set_ns
            # Not so while sweeps follow that were stamped before the clock was set.
            if abs(unset_ns - self.period_ns) < abs(passed_ns - self.period_ns):
                passed_ns, self.set_ns = unset_ns, 0
        self.missed = 0
        if self.before_ns and 2 * passed_ns >= 3 * self.period_ns:
            self.missed = round(passed_ns / self.period_ns) - 1
        return change + self.missed
