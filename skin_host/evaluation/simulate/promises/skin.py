"""What is reported of the skin, compared with what presses it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.promises.chance import Chance
from skin_host.evaluation.simulate.promises.contacts import ContactCheck, Known
from skin_host.evaluation.simulate.promises.excuses import Excuses
from skin_host.evaluation.simulate.promises.limits import (
    AGAIN_NS,
    CAUSE_NS,
    DEAF_SAMPLES,
    FELT_NS,
    LASTS_NS,
    LASTS_PAUSE_NS,
    LONG_AGO_NS,
    LOOKED_BACK_NS,
    NS,
    RELAXED_NS,
    TOUCHING_KPA,
    Mask,
)
from skin_host.evaluation.simulate.promises.truth import Floats, Truth
from skin_host.evaluation.simulate.world import World
from skin_host.layout import PadKind
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame


@dataclass(slots=True)
class _Open:
    """A touch that has begun and not ended.

    Attributes:
        taxels: [k] those of the part that it touches, as reported last.
        known: of its place, for parts with skin.
        unsaid_ns: time of frames that felt it since then.
    """

    taxels: NDArray[np.intp]
    known: Known | None = None
    unsaid_ns: int = 0


class SkinCheck:
    """Frames and touches of all parts against the true pressure.

    Args:
        world: to watch.
        excuses: which taxels are not judged, and when each was pressed.
        truth: what presses.

    Attributes:
        chance: touches by noise alone.
        open: by part the touches that have begun and not ended, by their identities.
        valid_ns: when each taxel was last valid [n].
    """

    def __init__(self, world: World, excuses: Excuses, truth: Truth) -> None:
        self._world, self._excuses, self._truth = world, excuses, truth
        self._contacts = ContactCheck(world, truth)
        self.chance = Chance()
        layout = world.layout
        n = layout.n_taxels
        self._parts = {part.name: part for part in layout.parts}
        self._pads: Mask = layout.pad_kind == PadKind.PRESSURE
        self.open: dict[str, dict[int, _Open]] = {}
        self._last_id: dict[str, int] = {}
        self._seq: dict[str, int] = {}
        self._frames: dict[str, PressureFrame] = {}
        self._frame_ns: dict[str, int] = {}
        #: Of each part, which taxels its last frame has as touched; and for how many samples each
        #: taxel has been pressed without that.
        self._felt: dict[str, Mask] = {}
        self._deaf = np.zeros(n, np.int64)
        self.valid_ns = np.full(n, LONG_AGO_NS, np.int64)
        #: When each taxel was last pressed while it was not valid; when it was last not valid, and
        #: whether it was touched just before.
        self._unheard_ns = np.full(n, LONG_AGO_NS, np.int64)
        self._blind_ns = np.full(n, LONG_AGO_NS, np.int64)
        self._lost = np.zeros(n, np.bool_)

    def begin(self) -> None:
        """A life of the daemon begins."""
        self.open.clear()
        for known in (self._last_id, self._seq, self._frames, self._frame_ns, self._felt):
            known.clear()

    # ------------------------------------------------------------------ touches

    def touch(self, event: Touch) -> str | None:
        """A touch event was put; return what is wrong with it, or None."""
        part = event.part
        now = self.open.setdefault(part, {})
        if event.event == "begin":
            again = event.id <= self._last_id.get(part, -1)
            self._last_id[part] = event.id
            if again:
                return f"{part}: touch {event.id} begins again"
            if part in self._parts and not self._may_begin(part, event.taxels):
                return (
                    f"{part}: touch {event.id} begins at taxels {event.taxels} with "
                    f"{event.peak_kpa:.1f} kPa, and nothing presses there"
                )
        elif event.id not in now:
            return f"{part}: touch {event.id} has a {event.event} without a begin"
        if event.event == "end":
            now.pop(event.id, None)
            return None
        taxels = np.asarray(event.taxels, np.intp)
        before = now.get(event.id)
        now[event.id] = _Open(taxels)
        if part not in self._parts:
            return None
        if not event.taxels:
            return f"{part}: touch {event.id} has no taxel"
        known = None if before is None else before.known
        ever = taxels if known is None else np.union1d(known.taxels, taxels)
        now[event.id].known = Known(ever, event.centroid_m)
        fit = self._judged() & self._truth.reads
        if abs(self._world.clock.now_ns() - event.t_ns) > NS // 2:
            fit[:] = False  # it waited to be read, or the time of day was set
        return self._contacts.wrong(event, self._parts[part], known, ever, fit)

    def endless(self) -> str | None:
        """Return a part with touches that have no end; the daemon has ended."""
        return next(
            (
                f"{part}: touches {sorted(ids)} have no end at the daemon's end"
                for part, ids in self.open.items()
                if ids
            ),
            None,
        )

    def _may_begin(self, part: str, taxels: Sequence[int] | NDArray[np.intp]) -> bool:
        """Return whether a touch of some taxels of a part has a cause.

        What a press leaves in the foam looks like a light press to a daemon that did not receive
        the press; and a touch that lasts, as long as foam takes, begins again after a silence, or
        when the computer was suspended, or is a piece of one that comes apart. Noise touches a
        single pad at times.
        """
        taxels = np.asarray(taxels, np.intp)
        mine = taxels + self._parts[part].start
        if self._excuses.of_touches(mine, CAUSE_NS).any():
            return True
        now_ns = self._now_ns()
        unheard = now_ns - self._unheard_ns[mine] < RELAXED_NS
        lasts = self._lost[mine] & (now_ns - self._excuses.touched_ns[mine] < RELAXED_NS)
        lasts &= now_ns - self._blind_ns[mine] < AGAIN_NS
        before = self._frames.get(part)
        piece = before is not None and before.touched[taxels].any()
        if piece or (unheard | lasts).any():
            return True
        return len(mine) == 1 and self.chance.explains(int(mine[0]), now_ns)

    # ------------------------------------------------------------------ frames

    def frame(self, frame: PressureFrame, valid: bytes) -> str | None:
        """A frame was put; return what is wrong with it, or None.

        Args:
            frame: of a part.
            valid: its `valid`, a byte for each taxel.
        """
        name = frame.part
        last_seq, self._seq[name] = self._seq.get(name, -1), frame.seq
        if frame.seq <= last_seq:
            return f"frame {frame.seq} after {last_seq}"
        part = self._parts[name]
        mine = slice(part.start, part.stop)
        before = self._frames.get(name)
        if before is not None and abs(frame.t_ns - before.t_ns) > NS:
            # Suspended, or another time of day: every touch begins again.
            self._lost[mine] = before.touched | (self._lost[mine] & ~before.valid)
            self._blind_ns[mine] = self._now_ns()
        if not frame.valid.all():
            if before is not None:
                lost = before.valid & ~frame.valid
                self._lost[mine][lost] = before.touched[lost]
            self._blind_ns[mine][~frame.valid] = self._now_ns()
        self._frames[name] = frame
        self.chance.measurements += valid.count(b"\1")
        pressure = frame.pressure_kpa
        # Neither comparison holds for what is no number.
        if not (pressure.min() >= 0 and pressure.max() < np.inf):
            return "a pressure is negative or no number"
        if b"\0" in valid and (
            pressure[~frame.valid].any() or (frame.touched & ~frame.valid).any()
        ):
            return "taxels that are not valid are touched, or have a pressure"
        return (
            self._valid_in_vain(frame, mine) or self._touched_in_vain(frame) or self._unsaid(frame)
        )

    def _unsaid(self, frame: PressureFrame) -> str | None:
        """Return a touch that a frame feels and that has not been reported for too long.

        Subscribers take it for over then. The time is that of the frames: the time of day may be
        set, and what waited in a stall comes at once.
        """
        name, now_ns = frame.part, self._now_ns()
        passed_ns = min(now_ns - self._frame_ns.get(name, now_ns), LASTS_PAUSE_NS)
        self._frame_ns[name] = now_ns
        for number, touch in self.open.get(name, {}).items():
            if not frame.valid[touch.taxels].any():
                continue
            touch.unsaid_ns += passed_ns
            if touch.unsaid_ns > LASTS_NS:
                return (
                    f"touch {number} lasts, and was not reported for {touch.unsaid_ns / NS:.1f} s"
                )
        return None

    def _valid_in_vain(self, frame: PressureFrame, mine: slice) -> str | None:
        """Return taxels of a frame that are valid without a chip, or of two boards."""
        excuses = self._excuses
        for (board, triangle), since_ns in excuses.blind_since.items():
            if self._now_ns() - since_ns < NS:
                continue
            taxels = self._world.taxels((board, triangle))
            taxels = taxels[(taxels >= mine.start) & (taxels < mine.stop)] - mine.start
            if frame.valid[taxels].any():
                return f"triangle {board}/{triangle} is valid, and has no chip"
        for trouble in excuses.known_twice:
            assert trouble.spoils is not None
            taxels = np.flatnonzero(frame.valid & trouble.spoils[mine])
            if len(taxels):
                return (
                    f"taxels {taxels.tolist()} are valid, and two boards send at the address of "
                    f"{trouble.twice}"
                )
        return None

    def _touched_in_vain(self, frame: PressureFrame) -> str | None:
        """Return taxels that are reported as touched and that nothing has pressed."""
        name = frame.part
        felt = self._felt.get(name)
        if frame.touched is felt:
            return None
        begun = np.flatnonzero(frame.touched if felt is None else frame.touched & ~felt)
        self._felt[name] = frame.touched
        start = self._parts[name].start
        caused = self._excuses.of_touches(begun + start, RELAXED_NS)
        if caused.all():
            return None
        (vain,) = np.nonzero(~caused)
        if len(vain) == 1 and self.chance.explains(int(begun[vain[0]]) + start, self._now_ns()):
            return None
        return f"taxels {begun[~caused].tolist()} are touched, and nothing presses"

    # ------------------------------------------------------------------ samples of the truth

    def note_recovered(self) -> None:
        """Note whose foam has recovered."""
        self._truth.recover(self._now_ns() - self._excuses.touched_ns > RELAXED_NS)

    def note_valid(self, true_kpa: NDArray[np.float64]) -> None:
        """Note which taxels [n] are valid, and which are pressed and are not."""
        now_ns = self._now_ns()
        for name, frame in self._frames.items():
            part = self._parts[name]
            self.valid_ns[part.start : part.stop][frame.valid] = now_ns
        self._unheard_ns[(true_kpa > TOUCHING_KPA) & (self.valid_ns < now_ns)] = now_ns

    def wrong(self) -> str | None:
        """Return a part whose last frame is wrong by the samples of the truth, or None."""
        judged = self._judged()
        bounds_kpa = self._truth.bounds_kpa(LOOKED_BACK_NS)
        firm = self._truth.firm(FELT_NS)
        rested = self._now_ns() - self._excuses.touched_ns > RELAXED_NS
        rested[self.chance.lately(self._now_ns())] = False
        wall_ns = self._world.clock.now_ns()
        for name, frame in self._frames.items():
            part = self._parts[name]
            mine = slice(part.start, part.stop)
            if abs(wall_ns - frame.t_ns) > NS // 2:
                continue
            fit = frame.valid & judged[mine]
            wrong = self._wrong_touched(frame, mine, fit, firm[mine], rested[mine])
            if wrong is None and frame.computed:
                wrong = self._wrong_pressure(frame, mine, fit & self._truth.reads[mine], bounds_kpa)
            if wrong is not None:
                return f"{name}: {wrong}"
        return None

    def _judged(self) -> Mask:
        """Return the pads bool[n] whose values have no excuse."""
        judged: Mask = self._pads & ~self._excuses.exempt & ~self._excuses.spoiled()
        return judged

    def _wrong_touched(
        self, frame: PressureFrame, mine: slice, fit: Mask, firm: Mask, rested: Mask
    ) -> str | None:
        lasts = fit & frame.touched & rested
        if lasts.any():
            return f"taxels {np.flatnonzero(lasts).tolist()} are still touched, and nothing presses"
        deaf = fit & firm & ~frame.touched
        self._deaf[mine] = np.where(deaf, self._deaf[mine] + 1, 0)
        if self._deaf[mine].max() <= DEAF_SAMPLES:
            return None
        taxel = int(self._deaf[mine].argmax())
        true_kpa = self._truth.kpa[mine][taxel]
        return f"taxel {taxel} is valid and not touched while it is pressed with {true_kpa:.1f} kPa"

    def _wrong_pressure(
        self, frame: PressureFrame, mine: slice, fit: Mask, bounds_kpa: tuple[Floats, Floats]
    ) -> str | None:
        least, most = bounds_kpa[0][mine], bounds_kpa[1][mine]
        kpa = frame.pressure_kpa
        wrong = fit & ((kpa < least) | (kpa > most))
        if not wrong.any():
            return None
        taxel = int(np.flatnonzero(wrong)[0])
        return (
            f"taxel {taxel} is valid and reads {kpa[taxel]:.1f} kPa while it is pressed with "
            f"{self._truth.kpa[mine][taxel]:.1f} kPa, which gives {least[taxel]:.1f} to "
            f"{most[taxel]:.1f} kPa"
        )

    def _now_ns(self) -> int:
        return self._world.clock.monotonic_ns()
