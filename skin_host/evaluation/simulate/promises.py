"""What must always hold, checked while it happens against the emulator's own truth.

The daemon's outputs are looked at where they leave the core (every frame, touch, contact and
health record) and where subscribers get them from the broker. The first promise that is broken
ends the run.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.evaluation.simulate.troubles import Trouble
from skin_host.evaluation.simulate.world import Life, World
from skin_host.layout import PadKind
from skin_host.processing.events import TouchEvent
from skin_host.processing.pipeline import PressureFrame

NS = 1_000_000_000
#: Truth is sampled this often, and so many samples are looked back on.
SAMPLE_S = 0.25
SAMPLES = 8
#: What comes of a board is valid for no longer than so many of its periods after its last frame.
STALE_PERIODS = 8
#: Pads that press at least so much and read less than that are felt wrong, and the reverse.
PRESSED_KPA, FELT_KPA = 25.0, 2.0
UNTOUCHED_KPA = 25.0
#: A fault may be reported this long after it ended: past events are reported for a minute.
ACCUSED_NS = 75 * NS
#: Codes that need no cause: pads differ, and long touches are reported.
ALWAYS = {"taxel_decides_late", "taxel_held", "part_not_calibrated", "taxel_drifting"}
#: A pad is pressed at all; and so long after it began, a touch may not be decided yet.
TOUCHING_KPA = 0.2
DECIDED_NS = NS // 2
MOST_TASKS = 100

Mask = NDArray[np.bool_]


class _Event(msgspec.Struct):
    event: str
    id: int
    count: int


class Promises:
    """Watches a world.

    Attributes:
        broken: what was broken first, or None.
        named: kinds of trouble that health had to name, and did.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.broken: str | None = None
        self.stopped = asyncio.Event()
        self.named: set[str] = set()
        self.touches = 0
        layout = world.layout
        self._parts = {part.name: part for part in layout.parts}
        self._open: dict[str, set[int]] = {}
        self._last_id: dict[str, int] = {}
        self._seq: dict[str, int] = {}
        self._codes: dict[str, set[str]] = {}
        self._troubles: list[tuple[Trouble, int, int | None]] = []
        self._spoiled_ns = -(1 << 62)
        self._exempt = np.zeros(layout.n_taxels, np.bool_)
        #: When each taxel began to be pressed, when its board was last received, and since when
        #: what presses it may be in its zero.
        self._pressed = np.zeros(layout.n_taxels, np.bool_)
        self._pressed_ns = np.zeros(layout.n_taxels, np.int64)
        self._felt_ns = np.zeros(layout.n_taxels, np.int64)
        self._unfelt_ns = np.zeros(layout.n_taxels, np.int64)
        self._zeros: dict[int, object] = {}
        self._wrong_since_ns: dict[str, int] = {}
        self._truth: deque[tuple[int, NDArray[np.float64]]] = deque(maxlen=SAMPLES)
        self._frames: dict[str, PressureFrame] = {}
        self._periods_ns = np.zeros(layout.n_taxels, np.int64)
        self._ids = np.zeros(layout.n_taxels, np.int64)
        self._bus_of: dict[str, NDArray[np.intp]] = {}
        self._triangle_of = layout.triangle_of
        self._blind_since: dict[tuple[str, int], int] = {}
        buses = np.empty(layout.n_taxels, object)
        for board in layout.boards:
            own = board.settings
            for number in board.triangles:
                taxels = board.taxel_index[number]
                taxels = taxels[taxels >= 0]
                self._periods_ns[taxels] = own.period_ms * 1_000_000
                self._ids[taxels] = 0x400 | own.address << 4 | number
                buses[taxels] = own.bus
        for bus in world.cables:
            self._bus_of[bus] = np.flatnonzero(buses == bus)
        #: Of each count of touches that subscribers got, in this life of the daemon.
        self._counts: dict[str, dict[int, bytes]] = {}
        self._put: dict[str, int] = {}
        #: Calibrations in the order in which they were taken, and the last that was surely kept.
        self._calibrations: list[str] = []
        self._kept = -1
        world.broker.listeners.append(self._hear)

    # ------------------------------------------------------------------  its input

    def break_(self, what: str) -> None:
        """A promise is broken."""
        if self.broken is None:
            self.broken = what
            self._world.note(f"BROKEN: {what}")
            self.stopped.set()

    def begin(self, trouble: Trouble) -> None:
        """A trouble begins."""
        now_ns = self._now_ns()
        over = None if trouble.lasts_s[1] else now_ns
        self._troubles = [
            one
            for one in self._troubles
            if one[0].lingers or one[2] is None or now_ns - one[2] < ACCUSED_NS
        ]
        self._troubles.append((trouble, now_ns, over))
        for triangle in trouble.blind:
            self._blind_since.setdefault(triangle, now_ns)

    def end(self, trouble: Trouble) -> None:
        """A trouble ends."""
        now_ns = self._now_ns()
        self._troubles = [
            (one, began, now_ns if one is trouble else over) for one, began, over in self._troubles
        ]
        for triangle in trouble.blind:
            self._blind_since.pop(triangle, None)
        if trouble.spoils:
            self._spoiled_ns = now_ns

    def calibrated_at_rest(self) -> None:
        """A calibration of the whole untouched skin was taken."""
        self._exempt[:] = False

    def watch(self, life: Life) -> None:
        """Look at what a daemon puts out from its start on."""
        self._open.clear()
        self._last_id.clear()
        self._seq.clear()
        self._counts.clear()
        self._put.clear()
        self._frames.clear()
        publisher: Any = life.daemon.publisher
        for name, look in (
            ("put_touch", self._touch),
            ("put_frame", self._frame),
            ("put_health", self._health),
        ):
            setattr(publisher, name, _after(life, look, getattr(publisher, name)))

    def over(self, life: Life, *, whole: bool) -> None:
        """A life has ended; `whole`: as it was asked to."""
        if whole:
            for part, ids in self._open.items():
                if ids:
                    self.break_(f"{part}: touches {sorted(ids)} have no end at the daemon's end")
        self.account(life)

    # ------------------------------------------------------------------ where things leave the core

    def _touch(self, event: TouchEvent) -> None:
        now = self._open.setdefault(event.part, set())
        self.touches += 1
        self._put[event.part] = self._put.get(event.part, 0) + 1
        if event.event == "begin":
            if event.id <= self._last_id.get(event.part, -1):
                self.break_(f"{event.part}: touch {event.id} begins again")
            self._last_id[event.part] = event.id
            now.add(event.id)
        elif event.id not in now:
            self.break_(f"{event.part}: touch {event.id} has a {event.event} without a begin")
        if event.event == "end":
            now.discard(event.id)
        elif not event.taxels:
            self.break_(f"{event.part}: touch {event.id} has no taxel")

    def _frame(self, frame: PressureFrame) -> None:
        name = frame.part
        if frame.seq <= self._seq.get(name, -1):
            self.break_(f"{name}: frame {frame.seq} after {self._seq[name]}")
        self._seq[name] = frame.seq
        self._frames[name] = frame
        part = self._parts[name]
        mine = slice(part.start, part.stop)
        pressure = frame.pressure_kpa
        if not np.isfinite(pressure).all() or pressure.min() < 0:
            self.break_(f"{name}: a pressure is negative or no number")
        if pressure[~frame.valid].any() or (frame.touched & ~frame.valid).any():
            self.break_(f"{name}: taxels that are not valid are touched, or have a pressure")
        age_ns = self._now_ns() - self._heard_ns(mine)
        old = frame.valid & (age_ns > STALE_PERIODS * self._periods_ns[mine])
        if old.any():
            taxel = int(np.flatnonzero(old)[0])
            self.break_(
                f"{name}: taxel {taxel} is valid, and its board last sent "
                f"{age_ns[taxel] / NS:.2f} s ago"
            )
        for (board, triangle), since_ns in self._blind_since.items():
            if self._now_ns() - since_ns < NS:
                continue
            taxels = self._taxels(board, triangle)
            taxels = taxels[(taxels >= part.start) & (taxels < part.stop)] - part.start
            if frame.valid[taxels].any():
                self.break_(f"{name}: triangle {board}/{triangle} is valid, and has no chip")

    def _health(self, part: str, record: Any) -> None:
        codes = {fault["code"] for fault in record["faults"]}
        if codes == self._codes.get(part):
            return
        self._codes[part] = codes
        now_ns = self._now_ns()
        allowed = set(ALWAYS)
        for trouble, _, over in self._troubles:
            if over is None or now_ns - over < ACCUSED_NS or trouble.lingers:
                allowed |= trouble.may
        wrong = codes - allowed
        if wrong:
            says = [
                text
                for fault, text in zip(record["faults"], record["sentences"], strict=True)
                if fault["code"] in wrong
            ]
            self.break_(f"{part}: accused without a cause: {'; '.join(says)}")

    # ------------------------------------------------------------------ subscribers

    def _hear(self, topic: str, payload: bytes) -> None:
        """What a subscriber that is always there gets of the broker."""
        if topic.endswith("/replies/operator"):
            self._note_answer(payload)
            return
        if not topic.endswith("/touch"):
            return
        event = msgspec.json.decode(payload, type=_Event)
        seen = self._counts.setdefault(topic, {})
        before = seen.get(event.count)
        if before is not None:
            if before != payload:
                self.break_(f"{topic}: two events have the count {event.count}")
            return
        last = max(seen, default=0)
        if event.count < last:
            self.break_(f"{topic}: count {event.count} comes first after {last}")
        seen[event.count] = payload

    def _note_answer(self, payload: bytes) -> None:
        """What the daemon reports as kept is on the disk from then on."""
        answer = msgspec.json.decode(payload)
        result = answer.get("result") or {}
        if answer["ok"] and answer["command"] == "calibrate" and result["kept"]:
            self._note_calibration(result["id"])
            self._kept = len(self._calibrations) - 1

    def _note_calibration(self, name: str) -> None:
        if name in self._calibrations:
            return
        self._calibrations.append(name)

    def started(self, life: Life) -> None:
        """A daemon has started, with the calibration that it found."""
        found = life.daemon.engine.calibration
        if self._kept < 0:
            return
        kept = self._calibrations[self._kept]
        if found is None:
            self.break_(f"calibration {kept} was kept, and there is none at the next start")
        elif found.id in self._calibrations[: self._kept]:
            self.break_(f"calibration {kept} was kept, and the next start has {found.id}")
        elif found.id not in self._calibrations:
            self._note_calibration(found.id)

    def account(self, life: Life) -> None:
        """Every frame and every event of a life is accounted for."""
        daemon = life.daemon
        for name, port in daemon.link.ports.items():
            fate = self._world.cables[name].fate
            counters = port.counters
            if life.dead:
                continue
            if counters.frames != fate.read or counters.dropped != fate.dropped:
                self.break_(
                    f"bus {name}: {fate.read} frames were read and {fate.dropped} dropped; counted "
                    f"are {counters.frames} and {counters.dropped}"
                )
            assembled = daemon.engine.assemblers[name].counters.frames
            if assembled != counters.frames:
                self.break_(f"bus {name}: {assembled} of {counters.frames} frames were taken")
        known = daemon.publisher.counters
        waiting = sum(
            1
            for event in daemon.publisher._outbox.events
            if event.is_touch  # what waits at the end was counted as dropped
        )
        put = sum(self._put.values())
        ended = life.task.done()
        kept = known.touches_sent + known.touches_dropped + (0 if ended else waiting)
        if not life.dead and put != kept:
            self.break_(f"{put} touch events were put, {kept} are accounted for")
        gaps = sum(max(seen, default=0) - len(seen) for seen in self._counts.values())
        if not life.dead and gaps > known.touches_dropped + waiting:
            self.break_(f"{gaps} counts are missing, {known.touches_dropped} events were dropped")
        got = sum(len(seen) for seen in self._counts.values())
        if not life.dead and got < known.touches_sent:
            self.break_(f"{known.touches_sent} events were acknowledged, {got} arrived")

    # ------------------------------------------------------------------ truth

    def _heard_ns(self, taxels: slice) -> NDArray[np.int64]:
        found = np.full(taxels.stop - taxels.start, -(1 << 62), np.int64)
        ids = self._ids[taxels]
        for bus, cable in self._world.cables.items():
            mine = self._bus_of[bus]
            mine = mine[(mine >= taxels.start) & (mine < taxels.stop)] - taxels.start
            found[mine] = cable.read_ns[ids[mine]]
        return found

    def _taxels(self, board: str, triangle: int) -> NDArray[np.intp]:
        layout = self._world.layout
        number = next(i for i, one in enumerate(layout.boards) if one.name == board)
        row = layout.boards[number].taxel_index[triangle]
        taxels: NDArray[np.intp] = row[row >= 0].astype(np.intp)
        return taxels

    def sample(self) -> None:
        """Compare what was reported last with the truth."""
        world = self._world
        now_ns = self._now_ns()
        world.move()
        truth = world.robot.skin.true_pressure_kpa().copy()
        self._truth.append((now_ns, truth))
        life = world.life
        if life is not None and life.daemon.engine.calibrating:
            # Touched taxels are calibrated anyway, with that verdict.
            self._exempt |= truth > TOUCHING_KPA
        if life is not None:
            self._exempt_zeroed(life, truth)
            if life.daemon.engine.calibration is not None:
                self._note_calibration(life.daemon.engine.calibration.id)
        if life is None or life.dead or len(self._truth) < SAMPLES:
            return
        spoiled = now_ns - self._spoiled_ns < 60 * NS or any(
            over is None and trouble.spoils for trouble, _, over in self._troubles
        )
        lately = np.array([values for _, values in list(self._truth)[-4:]])
        longer = np.array([values for _, values in self._truth])
        least, most = lately.min(axis=0), longer.max(axis=0)
        pads = world.layout.pad_kind == PadKind.PRESSURE
        for name, frame in self._frames.items():
            part = self._parts[name]
            mine = slice(part.start, part.stop)
            wall_ns = world.clock.now_ns()
            if abs(wall_ns - frame.t_ns) > NS // 2 or not frame.computed:
                continue
            fit = frame.valid & pads[mine] & ~self._exempt[mine]
            if spoiled:
                continue
            missed = fit & (least[mine] > PRESSED_KPA) & (frame.pressure_kpa < FELT_KPA)
            if missed.any():
                taxel = int(np.flatnonzero(missed)[0])
                self.break_(
                    f"{name}: taxel {taxel} is valid and reads {frame.pressure_kpa[taxel]:.1f} kPa "
                    f"while it is pressed with {truth[part.start + taxel]:.1f} kPa"
                )
            false = fit & (most[mine] < 0.01) & (frame.pressure_kpa > UNTOUCHED_KPA)
            if false.any():
                taxel = int(np.flatnonzero(false)[0])
                self.break_(
                    f"{name}: taxel {taxel} is valid and reads {frame.pressure_kpa[taxel]:.1f} kPa "
                    "while nothing presses it"
                )
        self._named()
        if len(asyncio.all_tasks()) > MOST_TASKS:
            self.break_(f"{len(asyncio.all_tasks())} tasks run")

    def _exempt_zeroed(self, life: Life, truth: NDArray[np.float64]) -> None:
        """What its board did not feel before it took a zero is in that zero: nobody can know."""
        now_ns = self._now_ns()
        pressed = truth > TOUCHING_KPA
        self._pressed_ns[pressed & ~self._pressed] = now_ns
        self._pressed = pressed
        layout = self._world.layout
        engine = life.daemon.engine
        for board, rezero in engine._rezeros.items():
            taxels = layout.boards[board].taxel_index
            taxels = taxels[taxels >= 0]
            if self._zeros.get(board) is not rezero:
                self._zeros[board] = rezero
                own = layout.boards[board].settings
                boards = life.daemon.link.boards[own.bus]
                record = boards.records[own.address]
                felt = record.configurations > 0 or boards._is_in_use(record)
                last_ns = int(self._felt_ns[taxels].max()) if felt else -(1 << 62)
                self._unfelt_ns[taxels] = last_ns - DECIDED_NS
            self._exempt[taxels] |= pressed[taxels] & (
                self._pressed_ns[taxels] > self._unfelt_ns[taxels]
            )
        whole = slice(0, layout.n_taxels)
        self._felt_ns = self._heard_ns(whole)

    def contacts(self) -> None:
        """What the broker keeps of a part is no lie: `OFF` means that nothing presses it."""
        world = self._world
        life = world.life
        if life is None or life.dead or not life.daemon.publisher.counters.connected:
            return
        if len(self._truth) < SAMPLES or world.broker.frozen:
            return
        if self._now_ns() - self._spoiled_ns < 60 * NS:
            return
        lately = np.array([values for _, values in list(self._truth)[-6:]])
        pads = (world.layout.pad_kind == PadKind.PRESSURE) & ~self._exempt
        pressed = (lately.min(axis=0) > PRESSED_KPA) & pads
        for name, part in self._parts.items():
            topic = life.daemon.publisher.topics.part("contact", name)
            wrong = world.broker.retained.get(topic) == b"OFF"
            if not wrong or not pressed[part.start : part.stop].any():
                self._wrong_since_ns.pop(name, None)
            # A chip or a board that has just come back takes some sweeps to decide.
            elif self._now_ns() - self._wrong_since_ns.setdefault(name, self._now_ns()) > NS // 2:
                self.break_(f"{name}: the broker keeps OFF, and it has been pressed for 2 s")

    def _named(self) -> None:
        """Health reports the required codes of lasting troubles."""
        now_ns = self._now_ns()
        said = set().union(*self._codes.values()) if self._codes else set()
        for trouble, began_ns, over in self._troubles:
            if trouble.must is None or over is not None:
                continue
            if trouble.must in said:
                self.named.add(trouble.name)
            elif now_ns - began_ns > trouble.within_s * NS and self._is_plain(trouble, began_ns):
                self.break_(
                    f"{trouble.about}: health lacks {trouble.must} after {trouble.within_s:g} s"
                )

    def _is_plain(self, trouble: Trouble, began_ns: int) -> bool:
        """Whether nothing else can hide a trouble: no other, and a daemon that works."""
        life = self._world.life
        if life is None or life.dead or began_ns - life.began_ns < 15 * NS:
            return False
        engine = life.daemon.engine
        if engine.calibration is None or engine.calibrating or engine.disabled:
            return False
        return not any(
            one is not trouble and (over is None or began_ns - over < 10 * NS)
            for one, _, over in self._troubles
        )

    def _now_ns(self) -> int:
        return self._world.clock.monotonic_ns()


def _after(life: Life, look: Callable[..., None], do: Callable[..., None]) -> Callable[..., None]:
    """Do something, then look at it."""

    def both(*args: Any) -> None:
        if not life.dead:
            look(*args)
        do(*args)

    return both
