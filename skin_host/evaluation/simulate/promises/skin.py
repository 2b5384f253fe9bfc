"""What is reported of the skin, compared with what presses it."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.promises.chance import Chance
from skin_host.evaluation.simulate.promises.excuses import Excuses
from skin_host.evaluation.simulate.promises.limits import (
    AGAIN_NS,
    CAUSE_NS,
    DEAF_SAMPLES,
    FELT_KPA,
    FELT_SAMPLES,
    KEPT,
    LASTS_NS,
    LASTS_PAUSE_NS,
    LONG_AGO_NS,
    NS,
    PAUSE_NS,
    PRESSED_KPA,
    RELAXED_NS,
    SAMPLES,
    SIGMAS,
    TOUCHING_KPA,
    UNTOUCHED_KPA,
    Mask,
)
from skin_host.evaluation.simulate.world import Life, World
from skin_host.layout import PadKind
from skin_host.processing.events import Touch
from skin_host.processing.pipeline import PressureFrame


@dataclass(slots=True)
class _Open:
    """A touch that has begun and not ended.

    Attributes:
        taxels: [k] those of the part that it touches, as reported last.
        unsaid_ns: time of frames that felt it since then.
    """

    taxels: NDArray[np.intp]
    unsaid_ns: int = 0


class SkinCheck:
    """Frames and touches of all parts against the true pressure.

    Args:
        world: to watch.
        excuses: which taxels are not judged, and when each was pressed.

    Attributes:
        chance: touches by noise alone.
        open: by part the touches that have begun and not ended, by their identities.
        valid_ns: when each taxel was last valid [n].
    """

    def __init__(self, world: World, excuses: Excuses) -> None:
        self._world, self._excuses = world, excuses
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
        #: When each taxel was last seen not to be pressed between two samples.
        self._paused_ns = np.full(n, LONG_AGO_NS, np.int64)
        #: The hardest press of each taxel since it last had time to recover (kPa).
        self._hardest_kpa = np.zeros(n)
        #: What presses each taxel (kPa) at the last samples.
        self._truth: deque[NDArray[np.float64]] = deque(maxlen=SAMPLES)

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
        else:
            now[event.id] = _Open(np.asarray(event.taxels, np.intp))
            if not event.taxels and part in self._parts:
                return f"{part}: touch {event.id} has no taxel"
        return None

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

    def note_pause(self) -> None:
        """Something is about to be pressed; what was lifted just before has not been sampled."""
        rests = self._world.robot.skin.true_pressure_kpa() <= PRESSED_KPA
        self._paused_ns[rests] = self._now_ns()

    def note_truth(self, true_kpa: NDArray[np.float64]) -> None:
        """Take a sample of what presses each taxel [n]."""
        self._truth.append(true_kpa)
        recovered = self._now_ns() - self._excuses.touched_ns > RELAXED_NS
        self._hardest_kpa[recovered] = 0.0
        np.maximum(self._hardest_kpa, true_kpa, out=self._hardest_kpa)

    def note_valid(self, true_kpa: NDArray[np.float64]) -> None:
        """Note which taxels [n] are valid, and which are pressed and are not."""
        now_ns = self._now_ns()
        for name, frame in self._frames.items():
            part = self._parts[name]
            self.valid_ns[part.start : part.stop][frame.valid] = now_ns
        self._unheard_ns[(true_kpa > TOUCHING_KPA) & (self.valid_ns < now_ns)] = now_ns

    @property
    def sampled(self) -> bool:
        """Enough samples were taken to look back on."""
        return len(self._truth) == SAMPLES

    def pressed(self) -> Mask:
        """Return which taxels [n] have been pressed for some samples."""
        lately = np.array(list(self._truth)[-FELT_SAMPLES:])
        pressed: Mask = lately.min(axis=0) > PRESSED_KPA
        return pressed

    def wrong(self, life: Life) -> str | None:
        """Return a part whose last frame is wrong by the samples of the truth, or None."""
        spoiled = self._excuses.spoiled()
        longer = np.array(list(self._truth))
        least, most = longer[-4:].min(axis=0), longer.max(axis=0)
        pressed = self.pressed()
        rested = self._now_ns() - self._excuses.touched_ns > RELAXED_NS
        rested[self.chance.lately(self._now_ns())] = False
        judged = self._pads & ~self._excuses.exempt & ~spoiled
        wall_ns = self._world.clock.now_ns()
        for name, frame in self._frames.items():
            part = self._parts[name]
            mine = slice(part.start, part.stop)
            if abs(wall_ns - frame.t_ns) > NS // 2:
                continue
            fit = frame.valid & judged[mine]
            wrong = self._wrong_touched(life, frame, mine, fit, pressed, rested)
            if wrong is None and frame.computed:
                wrong = self._wrong_pressure(life, frame, mine, fit, least, most)
            if wrong is not None:
                return f"{name}: {wrong}"
        return None

    def _wrong_touched(
        self, life: Life, frame: PressureFrame, mine: slice, fit: Mask, pressed: Mask, rested: Mask
    ) -> str | None:
        lasts = fit & frame.touched & rested[mine]
        if lasts.any():
            return f"taxels {np.flatnonzero(lasts).tolist()} are still touched, and nothing presses"
        deaf = fit & pressed[mine] & ~frame.touched
        if deaf.any():
            deaf &= self.decides_kpa(life, frame.part) < PRESSED_KPA
        self._deaf[mine] = np.where(deaf, self._deaf[mine] + 1, 0)
        if self._deaf[mine].max() <= DEAF_SAMPLES:
            return None
        taxel = int(self._deaf[mine].argmax())
        true_kpa = self._truth[-1][mine][taxel]
        return f"taxel {taxel} is valid and not touched while it is pressed with {true_kpa:.1f} kPa"

    def _wrong_pressure(
        self,
        life: Life,
        frame: PressureFrame,
        mine: slice,
        fit: Mask,
        least: NDArray[np.float64],
        most: NDArray[np.float64],
    ) -> str | None:
        missed = fit & (least[mine] > PRESSED_KPA) & (frame.pressure_kpa < FELT_KPA)
        missed &= self._now_ns() - self._paused_ns[mine] > PAUSE_NS
        if missed.any():
            taxel = int(np.flatnonzero(missed)[0])
            return (
                f"taxel {taxel} is valid and reads {frame.pressure_kpa[taxel]:.1f} kPa while it is "
                f"pressed with {self._truth[-1][mine][taxel]:.1f} kPa"
            )
        kept_kpa = KEPT * self._hardest_kpa[mine]
        untouched_kpa = np.maximum(UNTOUCHED_KPA, kept_kpa)
        false = fit & (most[mine] < 0.01) & (frame.pressure_kpa > untouched_kpa)
        if false.any():
            # What foam kept has noise too.
            false &= frame.pressure_kpa > kept_kpa + self._noise_kpa(life, frame.part)
        if not false.any():
            return None
        taxel = int(np.flatnonzero(false)[0])
        return (
            f"taxel {taxel} is valid and reads {frame.pressure_kpa[taxel]:.1f} kPa while nothing "
            "presses it"
        )

    def _noise_kpa(self, life: Life, name: str) -> NDArray[np.float64]:
        """Return how far noise alone may move each taxel [m] of a part."""
        engine, part = life.daemon.engine, self._parts[name]
        if engine.calibration is None or engine.pipeline is None:
            return np.zeros(part.n_taxels)
        units = SIGMAS * engine.calibration.spread[part.start : part.stop]
        index = list(self._parts).index(name)
        found: NDArray[np.float64] = engine.pipeline._parts[index]._curve.kpa(units)
        return found

    def decides_kpa(self, life: Life, name: str) -> NDArray[np.float64]:
        """Return what pressure each taxel [m] of a part detects within a second."""
        pipeline = life.daemon.engine.pipeline
        if pipeline is None:
            return np.full(self._parts[name].n_taxels, np.inf)
        rules = pipeline._parts[list(self._parts).index(name)]._rules
        found: NDArray[np.float64] = rules.curve.kpa(
            np.where(rules.usable, rules.levels.decides, 0.0)
        )
        return found

    def _now_ns(self) -> int:
        return self._world.clock.monotonic_ns()
