"""What must always hold, checked while it happens against the emulator's own truth.

The daemon's outputs are looked at where they leave the core (every frame, touch, contact and
health record) and where subscribers get them from the broker. The first promise that is broken
ends the run.
"""

import asyncio
import gc
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS, TRIANGLES
from skin_host.daemon.daemon import Daemon
from skin_host.evaluation.simulate.accusations import Accusations
from skin_host.evaluation.simulate.troubles import Trouble, damaged_set_up
from skin_host.evaluation.simulate.world import Life, Triangle, World
from skin_host.fingertip.events import FingertipEvent
from skin_host.layout import Layout, PadKind
from skin_host.processing.events import Touch
from skin_host.processing.pipeline import PressureFrame
from skin_host.processing.rezero import Rezero

NS = 1_000_000_000
#: Truth is sampled this often, and so many samples are looked back on.
SAMPLE_S = 0.25
SAMPLES = 8
#: Sweeps of a board that may be under way, or be cut off, at the two ends of a life.
SLACK = 3
#: What comes of a board is valid for no longer than so many of its periods after its last frame.
STALE_PERIODS = 8
#: Pads that press at least so much and read less than that are felt wrong, and the reverse.
PRESSED_KPA, FELT_KPA = 25.0, 2.0
UNTOUCHED_KPA = 25.0
#: So many standard deviations of the noise of sums of a pad's readings are no press either.
SIGMAS = 4.0
#: A pad is pressed at all; and so long after it began, a touch may not be decided yet.
TOUCHING_KPA = 0.2
DECIDED_NS = NS // 2
#: A press is felt after so many samples, and is not for so many more where a chip has just come
#: back.
FELT_SAMPLES, DEAF_SAMPLES = 6, 3
#: A press that began longer ago must be felt.
PAUSE_NS = round(0.75 * NS)
#: A touch that begins is of something that presses, or did no longer ago.
CAUSE_NS = 3 * NS
#: Foam that was pressed still relaxes for so long.
RELAXED_NS = 60 * NS
#: A touch that lasted through a silence begins again within this time.
AGAIN_NS = 3 * NS // 2
#: A calibration at rest began no longer ago when it is noted.
RESTING_NS = 8 * NS
#: A fingertip is loaded from a small force on, and must be felt from a larger one on.
LOADED_N, FELT_N = 0.05, 1.0
#: A board that is set up has so many tasks, and all else no more than this.
TASKS_OF_BOARD = 2
MOST_TASKS = 60
#: Topics of events that are numbered.
EVENTS = {"touch", "slip", "over"}
#: So many objects may live more than after the first calm: histories that are bounded.
MORE_OBJECTS = 60_000
#: A sweep reaches the end of the core within so many of its periods, and this.
FRESH_PERIODS, FRESH_NS = 3, 80_000_000
#: What is retained is at the broker so long after it changed, or a connection began.
RETAINED_NS = 2 * NS
#: The broker keeps no `OFF` of a part without a valid taxel for longer.
UNKNOWN_NS = NS

Mask = NDArray[np.bool_]


class _Event(msgspec.Struct):
    event: str
    id: int
    count: int


@dataclass(frozen=True, slots=True)
class _Run:
    """Triangles of a part that their board sends one after the other.

    Attributes:
        bus, period_ns: of the board.
        keys: address and number of each.
        start, stop: taxels of the part.
    """

    bus: str
    period_ns: int
    keys: tuple[int, ...]
    start: int
    stop: int


def _runs(layout: Layout, first: int, last: int) -> list[_Run]:
    """Return the triangles of the part that has these taxels."""
    runs: list[_Run] = []
    for one in layout.triangles:
        board = layout.boards[one.board]
        start = int(board.taxel_index[one.number].min())
        if not first <= start < last:
            continue
        own = board.settings
        key = own.address * TRIANGLES + one.number
        begin, stop = start - first, start - first + TAXELS
        before = runs[-1] if runs else None
        goes_on = (
            before is not None
            and before.bus == own.bus
            and before.stop == begin
            and before.keys[-1] < key < (own.address + 1) * TRIANGLES
            and before.keys[-1] // TRIANGLES == own.address
        )
        if before is not None and goes_on:
            keys = (*before.keys, key)
            runs[-1] = _Run(own.bus, before.period_ns, keys, before.start, stop)
        else:
            runs.append(_Run(own.bus, own.period_ms * 1_000_000, (key,), begin, stop))
    return runs


class Promises:
    """Watches a world.

    Attributes:
        broken: what was broken first, or None.
        touches: events so far.
        kept: number of the last calibration that the daemon reported as kept, -1 before.
        accusations: what health reports against the troubles.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.broken: str | None = None
        self.stopped = asyncio.Event()
        self.touches = 0
        self.accusations = Accusations(world)
        layout = world.layout
        self._parts = {part.name: part for part in layout.parts}
        self._open: dict[str, set[int]] = {}
        #: Of each part, which taxels its last frame has as touched; and for how many samples each
        #: taxel has been pressed without that.
        self._felt: dict[str, Mask] = {}
        self._deaf = np.zeros(layout.n_taxels, np.int64)
        self._last_id: dict[str, int] = {}
        self._seq: dict[str, int] = {}
        #: Taxels whose values may be wrong: now, and until when.
        self._spoiling: list[Trouble] = []
        #: Chips that do not measure what they should.
        self._damaged: dict[Triangle, Trouble] = {}
        #: Those of `_spoiling` of which health has reported that two boards send at one address.
        self._known_twice: list[Trouble] = []
        self._spoiled_until_ns = np.full(layout.n_taxels, -(1 << 62), np.int64)
        self._exempt = np.zeros(layout.n_taxels, np.bool_)
        #: When each taxel began to be pressed, when its board was last received, and since when
        #: what presses it may be in its zero.
        self._pressed = np.zeros(layout.n_taxels, np.bool_)
        self._pressed_ns = np.zeros(layout.n_taxels, np.int64)
        self._felt_ns = np.zeros(layout.n_taxels, np.int64)
        self._unfelt_ns = np.zeros(layout.n_taxels, np.int64)
        #: When each taxel was last valid.
        self._valid_ns = np.full(layout.n_taxels, -(1 << 62), np.int64)
        #: When each taxel was last pressed, and when a calibration may last have seen it pressed.
        self._touched_ns = np.full(layout.n_taxels, -(1 << 62), np.int64)
        self._calibrated_touched_ns = np.full(layout.n_taxels, -(1 << 62), np.int64)
        #: When each taxel was last pressed while it was not valid; when it was last not valid, and
        #: whether it was touched just before.
        self._unheard_ns = np.full(layout.n_taxels, -(1 << 62), np.int64)
        self._blind_ns = np.full(layout.n_taxels, -(1 << 62), np.int64)
        self._lost = np.zeros(layout.n_taxels, np.bool_)
        self._zeros: dict[int, Rezero] = {}
        #: By board: the zero that it has itself, at the sample before.
        self._bases = [board.base.copy() for board in world.robot.boards.values()]
        #: By board: the time of the first sweep that its zero was observed in, and when that was.
        self._observed: dict[int, tuple[int | None, int]] = {}
        self._wrong_since_ns: dict[str, int] = {}
        self._truth: deque[tuple[int, NDArray[np.float64]]] = deque(maxlen=SAMPLES)
        self._frames: dict[str, PressureFrame] = {}
        self._periods_ns = np.zeros(layout.n_taxels, np.int64)
        self._blind_since: dict[tuple[str, int], int] = {}
        ids = np.zeros(layout.n_taxels, np.int64)
        buses = np.empty(layout.n_taxels, object)
        for board in layout.boards:
            own = board.settings
            for number in board.triangles:
                taxels = board.taxel_index[number]
                taxels = taxels[taxels >= 0]
                self._periods_ns[taxels] = own.period_ms * 1_000_000
                ids[taxels] = 0x400 | own.address << 4 | number
                buses[taxels] = own.bus
        #: Of the whole skin (None) and of each part: on which bus which of the taxels are sent, and
        #: by which identifiers.
        self._senders: dict[str | None, list[tuple[str, Mask, NDArray[np.int64]]]] = {
            name: [(bus, buses[mine] == bus, ids[mine][buses[mine] == bus]) for bus in world.cables]
            for name, mine in [
                (None, slice(None)),
                *((part.name, slice(part.start, part.stop)) for part in layout.parts),
            ]
        }
        #: Of each part, on which bus which identifiers are sent.
        self._ids = {
            part.name: [
                (bus, np.unique(of_bus))
                for bus, _, of_bus in self._senders[part.name]
                if of_bus.size
            ]
            for part in layout.parts
        }
        #: Frames in the sweeps of each bus, in this life of the daemon.
        self._swept: dict[str, int] = {}
        self._bus_of_board = [board.settings.bus for board in layout.boards]
        #: Retained topics as the daemon puts them, and when.
        self._said: dict[str, tuple[bytes, int]] = {}
        #: Topics of contacts, and of what.
        self._contacts: dict[str, str] = {}
        self._connected_ns: int | None = None
        self._connection = 0
        self._blank_since: dict[str, int] = {}
        self._clock_set_ns = self._stalled_ns = -(1 << 62)
        self._objects: int | None = None
        #: Of each part the triangles that a board sends one after the other.
        self._runs = {part.name: _runs(layout, part.start, part.stop) for part in layout.parts}
        #: The least period of the boards of each part.
        self._fastest_ns = {
            part.name: int(self._periods_ns[part.start : part.stop].min()) for part in layout.parts
        }
        #: Of each count of touches that subscribers got, in this life of the daemon.
        self._counts: dict[str, dict[int, bytes]] = {}
        self._put: dict[str, int] = {}
        #: Calibrations in the order in which they were taken, and the last that was surely kept.
        self._calibrations: list[str] = []
        self.kept = -1
        #: When each fingertip on a force/torque board was last loaded, and was not loaded firmly.
        self._loaded_ns = dict.fromkeys(world.settings.fingertips, -(1 << 62))
        self._eased_ns = dict.fromkeys(world.settings.fingertips, -(1 << 62))
        #: When each taxel was last seen not to be pressed between two samples.
        self._paused_ns = np.full(layout.n_taxels, -(1 << 62), np.int64)
        world.before_press = self._note_pause
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
        self.accusations.begin(trouble)
        for triangle in trouble.blind:
            self._blind_since.setdefault(triangle, now_ns)
        if trouble.spoils is not None:
            self._spoiling.append(trouble)
            if not trouble.lasts_s[1]:
                self._recover(trouble)
                self._spoiling.remove(trouble)
        if trouble.name == "clock_set":
            self._clock_set_ns = now_ns
        if trouble.name == "stall":
            self._stalled_ns = now_ns

    def end(self, trouble: Trouble) -> None:
        """A trouble ends."""
        self.accusations.end(trouble)
        for triangle in trouble.blind:
            self._blind_since.pop(triangle, None)
        if trouble in self._spoiling:
            self._recover(trouble)
            self._spoiling.remove(trouble)
        if trouble in self._known_twice:
            self._known_twice.remove(trouble)

    def _recover(self, trouble: Trouble) -> None:
        assert trouble.spoils is not None
        until_ns = self._now_ns() + int(trouble.recovers_s * NS)
        wrong = self._spoiled_until_ns
        wrong[trouble.spoils] = np.maximum(wrong[trouble.spoils], until_ns)

    def _spoiled(self) -> Mask:
        """Return the taxels bool[n] whose values may be wrong now.

        A pad of real skin that has been stuck since before its calibration cannot be distinguished
        from a quiet one.
        """
        spoiled: Mask = self._spoiled_until_ns > self._now_ns()
        spoiled |= ~np.isnan(self._world.robot.skin.held_ff)
        for trouble in self._spoiling:
            assert trouble.spoils is not None
            if trouble not in self._known_twice:
                spoiled |= trouble.spoils
        return spoiled

    def calibrated_at_rest(self) -> None:
        """A calibration of the whole untouched skin was taken."""
        long_ago = self._calibrated_touched_ns < self._now_ns() - RESTING_NS
        self._calibrated_touched_ns[long_ago] = -(1 << 62)
        self._exempt[:] = False
        self.accusations.loaded.clear()
        self._spoiled_until_ns[:] = self._now_ns()
        self.accusations.repaired()

    def watch(self, life: Life) -> None:
        """Look at what a daemon puts out from its start on."""
        self._open.clear()
        self._felt.clear()
        self._last_id.clear()
        self._seq.clear()
        self._counts.clear()
        self._put.clear()
        self._frames.clear()
        self._known_twice.clear()
        self.accusations.restarted()
        self._swept = dict.fromkeys(self._world.cables, 0)
        self._said = {}
        topics = life.daemon.publisher.topics
        self._contacts = {
            topics.part("contact", name): name
            for name in (*self._parts, *self._world.settings.fingertips)
        }
        self._blank_since.clear()
        self._connected_ns = None
        outbox: Any = life.daemon.publisher._outbox
        outbox.put_state = _after(life, self._retain, outbox.put_state)
        daemon: Any = life.daemon
        daemon._deliver = _after(life, self._output, daemon._deliver)
        publisher: Any = life.daemon.publisher
        for name, look in (
            ("put_touch", self._touch),
            ("put_frame", self._frame),
            ("put_health", self._health),
        ):
            setattr(publisher, name, _after(life, look, getattr(publisher, name)))

    def forget(self, daemon: Daemon, *, touched: bool = False) -> None:
        """A daemon is over: the doubts that the disk refused, or had not taken yet, are lost.

        Args:
            daemon: it.
            touched: it was asked to end, so what is touched then is in doubt, too.
        """
        keeping = daemon._keeping
        if "zeros" in daemon.unkept or (keeping is not None and not keeping.done()):
            self._exempt |= daemon.engine.zero_at_risk(touched)

    def over(self, life: Life, *, whole: bool) -> None:
        """A life has ended; `whole`: as it was asked to."""
        if whole:
            for part, ids in self._open.items():
                if ids:
                    self.break_(f"{part}: touches {sorted(ids)} have no end at the daemon's end")
            self.forget(life.daemon, touched=True)
        self.account(life)

    # ------------------------------------------------------------------ where things leave the core

    def _touch(self, event: FingertipEvent) -> None:
        self._put[event.part] = self._put.get(event.part, 0) + 1
        if not isinstance(event, Touch):
            return
        now = self._open.setdefault(event.part, set())
        self.touches += 1
        if event.event == "begin":
            if event.id <= self._last_id.get(event.part, -1):
                self.break_(f"{event.part}: touch {event.id} begins again")
            self._last_id[event.part] = event.id
            now.add(event.id)
            part = event.part
            if part in self._parts and not self._may_begin(part, event.taxels):
                self.break_(
                    f"{part}: touch {event.id} begins at taxels {event.taxels} with "
                    f"{event.peak_kpa:.1f} kPa, and nothing presses there"
                )
        elif event.id not in now:
            self.break_(f"{event.part}: touch {event.id} has a {event.event} without a begin")
        if event.event == "end":
            now.discard(event.id)
        elif not event.taxels and event.part in self._parts:
            self.break_(f"{event.part}: touch {event.id} has no taxel")

    def _may_begin(self, part: str, taxels: Sequence[int]) -> bool:
        """Return whether a touch of some taxels of a part has a cause.

        What a press leaves in the foam looks like a light press to a daemon that did not receive
        the press; and a touch that lasts, as long as foam takes, begins again after a silence.
        """
        if self._has_cause(part, taxels, CAUSE_NS).any():
            return True
        mine = np.asarray(taxels, np.intp) + self._parts[part].start
        now_ns = self._now_ns()
        unheard = now_ns - self._unheard_ns[mine] < RELAXED_NS
        lasts = self._lost[mine] & (now_ns - self._touched_ns[mine] < RELAXED_NS)
        lasts &= now_ns - self._blind_ns[mine] < AGAIN_NS
        return bool((unheard | lasts).any())

    def _has_cause(
        self, part: str, taxels: Sequence[int] | NDArray[np.intp], lately_ns: int
    ) -> Mask:
        """Return whether each of some taxels of a part may be touched, bool[k]: something presses
        it or did so lately, or its value may be wrong without anybody being able to know.
        """
        mine = np.asarray(taxels, np.intp) + self._parts[part].start
        caused: Mask = self._now_ns() - self._touched_ns[mine] < lately_ns
        if not caused.all():
            caused |= self._world.robot.skin.true_pressure_kpa()[mine] > TOUCHING_KPA
            caused |= (self._exempt | self._spoiled())[mine]
        return caused

    def _frame(self, frame: PressureFrame) -> None:
        name = frame.part
        if frame.seq <= self._seq.get(name, -1):
            self.break_(f"{name}: frame {frame.seq} after {self._seq[name]}")
        self._seq[name] = frame.seq
        part = self._parts[name]
        mine = slice(part.start, part.stop)
        before = self._frames.get(name)
        if not frame.valid.all():
            if before is not None:
                lost = before.valid & ~frame.valid
                self._lost[mine][lost] = before.touched[lost]
            self._blind_ns[mine][~frame.valid] = self._now_ns()
        self._frames[name] = frame
        pressure = frame.pressure_kpa
        valid = frame.valid.tobytes()
        # Neither comparison holds for what is no number.
        if not (pressure.min() >= 0 and pressure.max() < np.inf):
            self.break_(f"{name}: a pressure is negative or no number")
        if b"\0" in valid and (
            pressure[~frame.valid].any() or (frame.touched & ~frame.valid).any()
        ):
            self.break_(f"{name}: taxels that are not valid are touched, or have a pressure")
        if self._now_ns() - self._least_heard_ns(name) > STALE_PERIODS * self._fastest_ns[name]:
            age_ns = self._now_ns() - self._heard_ns(name)
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
            taxels = self._world.taxels((board, triangle))
            taxels = taxels[(taxels >= part.start) & (taxels < part.stop)] - part.start
            if frame.valid[taxels].any():
                self.break_(f"{name}: triangle {board}/{triangle} is valid, and has no chip")
        for trouble in self._known_twice:
            assert trouble.spoils is not None
            taxels = np.flatnonzero(frame.valid & trouble.spoils[mine])
            if len(taxels):
                self.break_(
                    f"{name}: taxels {taxels.tolist()} are valid, and two boards send at the "
                    f"address of {trouble.twice}"
                )
        if frame.touched is not self._felt.get(name):
            begun = np.flatnonzero(frame.touched & ~self._felt.get(name, False))
            self._felt[name] = frame.touched
            without = begun[~self._has_cause(name, begun, RELAXED_NS)]
            if len(without):
                self.break_(f"{name}: taxels {without.tolist()} are touched, and nothing presses")
        if b"\1" in valid:
            self._blank_since.pop(name, None)
        else:
            self._blank_since.setdefault(name, self._now_ns())
        self._trace_back(frame, valid)

    def _trace_back(self, frame: PressureFrame, valid: bytes) -> None:
        """What is valid was sent so, lately, in one sweep, by a chip that answers."""
        world = self._world
        raw = frame.raw.tobytes()
        now_ns = self._now_ns()
        clock_was_set = now_ns - self._clock_set_ns < 5 * NS
        taken_ns = frame.t_ns - (world.clock.now_ns() - now_ns)
        for run in self._runs[frame.part]:
            if b"\1" not in valid[run.start : run.stop]:
                continue
            cable = world.cables[run.bus]
            wrong_ns = max(cable.damaged_ns, cable.blurred_ns)
            if cable.mischief.damaged or now_ns - wrong_ns < 2 * NS:
                continue
            longest_ns = FRESH_PERIODS * run.period_ns + FRESH_NS
            t_ns = cable.sent.find_together(run.keys, raw[run.start : run.stop])
            if t_ns is not None and (clock_was_set or taken_ns - t_ns <= longest_ns):
                continue
            for at, key in zip(range(run.start, run.stop, TAXELS), run.keys, strict=True):
                address, number = divmod(key, TRIANGLES)
                if b"\1" not in valid[at : at + TAXELS]:
                    continue
                found = "no sweep of it"
                for answered, t_ns in cable.sent.find(address, number, raw[at : at + TAXELS]):
                    age_ns = taken_ns - t_ns
                    if not answered:
                        found = "a chip that did not answer"
                    elif age_ns > longest_ns and not clock_was_set:
                        found = f"a sweep {age_ns / NS:.2f} s before it"
                    else:
                        break
                else:
                    self.break_(
                        f"{frame.part}: triangle {address}/{number} of frame {frame.seq} is valid, "
                        f"and its bytes are of {found}"
                    )
                    return

    def _output(self, output: Any) -> None:
        for sweep in output.sweeps:
            self._swept[self._bus_of_board[sweep.board]] += 2 * sweep.present.bit_count()

    def _retain(self, topic: str, payload: bytes) -> None:
        before = self._said.get(topic)
        if before is None or before[0] != payload:
            self._said[topic] = payload, self._now_ns()
        if payload == b"ON" and not self._open.get(self._contacts.get(topic, topic)):
            self.break_(f"{topic}: ON without a touch")

    def _health(self, part: str, record: Any) -> None:
        wrong = self.accusations.note(part, record) or self.accusations.unnamed()
        if wrong is not None:
            self.break_(wrong)
        if part not in self._parts:
            return
        for trouble in self._spoiling:
            named = {"code": "board_twice", "where": trouble.twice} in record["faults"]
            if named and trouble not in self._known_twice:
                self._known_twice.append(trouble)
                self._recover(trouble)
        touched = np.array(record["taxel_verdicts"].get("touched", []), np.intp)
        false = touched[self._calibrated_touched_ns[touched + self._parts[part].start] < 0]
        if len(false):
            self.break_(f"{part}: taxels {false.tolist()} rested when they were calibrated")

    # ------------------------------------------------------------------ subscribers

    def _hear(self, topic: str, payload: bytes) -> None:
        """What a subscriber that is always there gets of the broker."""
        if topic.endswith("/replies/operator"):
            self._note_answer(payload)
            return
        if topic.rpartition("/")[2] not in EVENTS:
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
            self.kept = len(self._calibrations) - 1

    def _note_calibration(self, name: str) -> None:
        # Calibrations of the same content, of boards that are not received, have the same name.
        if self._calibrations[-1:] != [name]:
            self._calibrations.append(name)

    def started(self, life: Life) -> None:
        """A daemon has started, with the calibration that it found."""
        found = life.daemon.engine.calibration
        if self.kept < 0:
            return
        kept = self._calibrations[self.kept]
        if found is None:
            self.break_(f"calibration {kept} was kept, and there is none at the next start")
        elif found.id in set(self._calibrations) - set(self._calibrations[self.kept :]):
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
            self._account_frames(life, name, daemon.engine.assemblers[name], fate.dropped)
        known = daemon.publisher.counters
        waiting = sum(
            1
            for event in daemon.publisher._outbox.events
            if event.is_touch  # what waits at the end was counted as dropped
        )
        put = sum(self._put.values())
        ended = life.task.done()
        kept = known.touches_sent + known.touches_dropped + known.moves_replaced
        kept += 0 if ended else waiting
        if not life.dead and put != kept:
            self.break_(f"{put} touch events were put, {kept} are accounted for")
        gaps = sum(max(seen, default=0) - len(seen) for seen in self._counts.values())
        if not life.dead and gaps > known.touches_dropped + waiting:
            self.break_(f"{gaps} counts are missing, {known.touches_dropped} events were dropped")
        got = sum(len(seen) for seen in self._counts.values())
        if not life.dead and got < known.touches_sent:
            self.break_(f"{known.touches_sent} events were acknowledged, {got} arrived")

    def _account_frames(self, life: Life, bus: str, assembler: Any, dropped: int) -> None:
        """Each frame is in a sweep, waits to be, or is counted; each sweep came or is counted,
        until the daemon was asked to end.
        """
        counters = assembler.counters
        states = assembler._states.values()
        waiting = sum(
            (state.awaited & ~state.missing).bit_count() for state in states if state.missing
        )
        # A lone frame of the last sweep waits for its other half.
        waiting += sum(state.lone.bit_count() for state in states)
        told = (
            counters.other
            + counters.force_torque
            + counters.wrong_header
            + counters.short
            + counters.unknown_board
            + counters.unknown_triangle
            + counters.late
            + counters.doubled
            + counters.halves
        )
        if counters.frames != told + self._swept[bus] + waiting:
            self.break_(
                f"bus {bus}: {counters.frames} frames came; {self._swept[bus]} are in sweeps, "
                f"{waiting} wait, {told} are counted otherwise"
            )
        bursts = (life.sent_before_end or {}).get(bus, self._world.cables[bus].sent.bursts)
        known = {board.settings.address for board in self._world.layout.boards}
        sent = sum(count - SLACK for address, count in bursts.items() if address in known)
        came = counters.sweeps + counters.missed
        if self._clock_set_ns >= life.began_ns:
            # If it was set back, time stamps do not show how many sweeps the dropped frames were.
            boards = [one for one in self._world.layout.boards if one.settings.bus == bus]
            came += dropped // (2 * min((len(one.triangles) for one in boards), default=1))
        if sent > came:
            self.break_(f"bus {bus}: {sent} sweeps were sent; {came} came or are counted as missed")

    def grown(self) -> None:
        """At the end of a calm: what lives does not become more and more."""
        count = len(gc.get_objects())
        if self._objects is None:
            self._objects = count
        elif count > self._objects + MORE_OBJECTS:
            self.break_(f"{count} objects live, {self._objects} did after the first calm")

    # ------------------------------------------------------------------ truth

    def _heard_ns(self, part: str | None = None) -> NDArray[np.int64]:
        """Return when each taxel of a part, or of the whole skin, was last received (ns)."""
        senders = self._senders[part]
        found = np.full(len(senders[0][1]), -(1 << 62), np.int64)
        for bus, mine, ids in senders:
            found[mine] = self._world.cables[bus].read_ns[ids]
        return found

    def _least_heard_ns(self, part: str) -> int:
        """Return when any triangle of a part was last received, the one longest ago (ns)."""
        cables = self._world.cables
        return min(int(cables[bus].read_ns[ids].min()) for bus, ids in self._ids[part])

    def sample(self) -> None:
        """Compare what was reported last with the truth."""
        world = self._world
        now_ns = self._now_ns()
        world.move()
        truth = world.robot.skin.true_pressure_kpa().copy()
        self._truth.append((now_ns, truth))
        self._note_set_ups()
        life = world.life
        self._exempt_zeroed_alone(life, truth)
        self._touched_ns[truth > TOUCHING_KPA] = now_ns
        if life is not None and life.daemon.engine.calibrating:
            # Touched taxels are calibrated anyway, with that verdict.
            self._exempt |= (truth > TOUCHING_KPA) | self._spoiled()
            relaxing = now_ns - self._touched_ns < RELAXED_NS
            self._calibrated_touched_ns[self._exempt | relaxing] = now_ns
        if life is not None:
            for name, frame in self._frames.items():
                part = self._parts[name]
                self._valid_ns[part.start : part.stop][frame.valid] = now_ns
            self._unheard_ns[(truth > TOUCHING_KPA) & (self._valid_ns < now_ns)] = now_ns
            self._exempt_zeroed(life, truth)
            if life.daemon.engine.calibration is not None:
                self._note_calibration(life.daemon.engine.calibration.id)
        self._note_loads(life, now_ns)
        if life is None or life.dead or len(self._truth) < SAMPLES:
            return
        spoiled = self._spoiled()
        longer = np.array([values for _, values in self._truth])
        least, most = longer[-4:].min(axis=0), longer.max(axis=0)
        pressed = longer[-FELT_SAMPLES:].min(axis=0) > PRESSED_KPA
        rested = now_ns - self._touched_ns > RELAXED_NS
        pads = world.layout.pad_kind == PadKind.PRESSURE
        for name, frame in self._frames.items():
            part = self._parts[name]
            mine = slice(part.start, part.stop)
            wall_ns = world.clock.now_ns()
            if abs(wall_ns - frame.t_ns) > NS // 2:
                continue
            fit = frame.valid & pads[mine] & ~self._exempt[mine] & ~spoiled[mine]
            lasts = fit & frame.touched & rested[mine]
            if lasts.any():
                taxels = np.flatnonzero(lasts).tolist()
                self.break_(f"{name}: taxels {taxels} are still touched, and nothing presses")
            deaf = fit & pressed[mine] & ~frame.touched
            if deaf.any():
                deaf &= self._decides_kpa(life, name) < PRESSED_KPA
            self._deaf[mine] = np.where(deaf, self._deaf[mine] + 1, 0)
            if self._deaf[mine].max() > DEAF_SAMPLES:
                taxel = int(self._deaf[mine].argmax())
                self.break_(
                    f"{name}: taxel {taxel} is valid and not touched while it is pressed with "
                    f"{truth[part.start + taxel]:.1f} kPa"
                )
            if not frame.computed:
                continue
            missed = fit & (least[mine] > PRESSED_KPA) & (frame.pressure_kpa < FELT_KPA)
            missed &= now_ns - self._paused_ns[mine] > PAUSE_NS
            if missed.any():
                taxel = int(np.flatnonzero(missed)[0])
                self.break_(
                    f"{name}: taxel {taxel} is valid and reads {frame.pressure_kpa[taxel]:.1f} kPa "
                    f"while it is pressed with {truth[part.start + taxel]:.1f} kPa"
                )
            false = fit & (most[mine] < 0.01) & (frame.pressure_kpa > UNTOUCHED_KPA)
            if false.any():
                false &= frame.pressure_kpa > self._noise_kpa(life, name)
            if false.any():
                taxel = int(np.flatnonzero(false)[0])
                self.break_(
                    f"{name}: taxel {taxel} is valid and reads {frame.pressure_kpa[taxel]:.1f} kPa "
                    "while nothing presses it"
                )
        if not life.stop.is_set():  # a daemon that ends reads no more, and stops the boards
            self._fingertips(life, now_ns)
            self._missed_boards(now_ns)
        unnamed = self.accusations.unnamed()
        if unnamed is not None:
            self.break_(unnamed)
        if len(asyncio.all_tasks()) > MOST_TASKS + TASKS_OF_BOARD * len(world.layout.boards):
            self.break_(f"{len(asyncio.all_tasks())} tasks run")

    def _note_set_ups(self) -> None:
        """Note which chips do not measure what they should: their board is to be switched off and
        on.
        """
        now = self._world.damaged_set_ups()
        for place in sorted(now - self._damaged.keys()):
            self._damaged[place] = trouble = damaged_set_up(self._world, place)
            self._world.note(trouble.about)
            self._world.unpowered.add(place[0])
            self.begin(trouble)
        for place in sorted(self._damaged.keys() - now):
            self.end(self._damaged.pop(place))

    def _note_loads(self, life: Life | None, now_ns: int) -> None:
        """Note which fingertips are loaded, and which zeros may be of a load."""
        tips = self._world.robot.fingertips
        calibrating = life is not None and life.daemon.engine.calibrating
        for name in self._loaded_ns:
            force_n = float(np.linalg.norm(tips.force_n(name, now_ns)))
            if force_n > LOADED_N:
                self._loaded_ns[name] = now_ns
            if force_n < FELT_N:
                self._eased_ns[name] = now_ns
            if calibrating and now_ns - self._loaded_ns[name] < NS:
                self.accusations.loaded.add(name)

    def _fingertips(self, life: Life, now_ns: int) -> None:
        """A fingertip whose zero is of no load is touched while it is loaded, and only then."""
        engine = life.daemon.engine.fingertips
        for name, state in ({} if engine is None else engine.tips).items():
            if name in self.accusations.loaded or self.accusations.may_damage(name):
                continue
            # What it sent lately waits to be read after a stall.
            if not state.tip.feels or abs(self._world.clock.now_ns() - state.last_ns) > NS // 2:
                continue
            if state.tip.touched and now_ns - self._loaded_ns[name] > CAUSE_NS:
                self.break_(f"{name}: still touched, and nothing presses")
            threshold_n = state.tip.threshold_n
            if not state.tip.touched and now_ns - self._eased_ns[name] > PAUSE_NS:
                self.break_(f"{name}: not touched while it is pressed, from {threshold_n:.2f} N on")

    def _note_pause(self) -> None:
        """Something is about to be pressed; what was lifted just before has not been sampled."""
        rests = self._world.robot.skin.true_pressure_kpa() <= PRESSED_KPA
        self._paused_ns[rests] = self._now_ns()

    def _noise_kpa(self, life: Life, name: str) -> NDArray[np.float64]:
        """Return how far noise alone may move each taxel [m] of a part."""
        engine, part = life.daemon.engine, self._parts[name]
        if engine.calibration is None or engine.pipeline is None:
            return np.zeros(part.n_taxels)
        units = SIGMAS * engine.calibration.spread[part.start : part.stop]
        index = list(self._parts).index(name)
        found: NDArray[np.float64] = engine.pipeline._parts[index]._curve.kpa(units)
        return found

    def _decides_kpa(self, life: Life, name: str) -> NDArray[np.float64]:
        """Return what pressure each taxel [m] of a part detects within a second."""
        pipeline = life.daemon.engine.pipeline
        if pipeline is None:
            return np.full(self._parts[name].n_taxels, np.inf)
        rules = pipeline._parts[list(self._parts).index(name)]._rules
        found: NDArray[np.float64] = rules.curve.kpa(
            np.where(rules.usable, rules.levels.decides, 0.0)
        )
        return found

    def _missed_boards(self, now_ns: int) -> None:
        """A board that nothing keeps silent is received: the daemon itself brings it back."""
        for board in self._world.layout.boards:
            taxels = board.taxel_index[board.taxel_index >= 0]
            quiet_ns = now_ns - int(self._felt_ns[taxels].max())
            if quiet_ns < STALE_PERIODS * board.settings.period_ms * 1_000_000:
                continue
            if not self.accusations.may_be_silent(board.name):
                self.break_(
                    f"board {board.name} was last received {quiet_ns / NS:.1f} s ago, and nothing "
                    "keeps it silent"
                )

    def _exempt_zeroed_alone(self, life: Life | None, truth: NDArray[np.float64]) -> None:
        """A board that zeroes itself while no daemon runs has what presses it in its zero."""
        before_ns = self._truth[-2][0] if len(self._truth) > 1 else 0
        alone = life is None or life.began_ns >= before_ns
        layout = self._world.layout
        boards = self._world.robot.boards
        for board, base in zip(layout.boards, self._bases, strict=True):
            now = boards[board.name].base
            if np.array_equal(base, now):
                continue
            base[:] = now
            if alone:
                taxels = board.taxel_index[board.taxel_index >= 0]
                self._exempt[taxels] |= (truth[taxels] > TOUCHING_KPA) | self._pressed[taxels]

    def _exempt_zeroed(self, life: Life, truth: NDArray[np.float64]) -> None:
        """What its board did not feel before it took a zero is in that zero: nobody can know."""
        now_ns, wall_ns = self._now_ns(), self._world.clock.now_ns()
        spoiled = self._spoiled()
        pressed = truth > TOUCHING_KPA
        self._pressed_ns[pressed & ~self._pressed] = now_ns
        self._pressed = pressed
        layout = self._world.layout
        engine = life.daemon.engine
        for board, rezero in engine._rezeros.items():
            taxels = layout.boards[board].taxel_index
            taxels = taxels[taxels >= 0]
            before = self._zeros.get(board)
            if before is not rezero:
                self._zeros[board] = rezero
                own = layout.boards[board].settings
                boards = life.daemon.link.boards[own.bus]
                record = boards.records[own.address]
                felt = record.configurations > 0 or boards._is_in_use(record)
                last_ns = int(self._felt_ns[taxels].max()) if felt else -(1 << 62)
                self._unfelt_ns[taxels] = last_ns - DECIDED_NS
                if before is None or before.settled(wall_ns):
                    # Its chip has sent nothing valid since, and not because of the zero before.
                    valid_ns = self._valid_ns[taxels] - DECIDED_NS
                    self._unfelt_ns[taxels] = np.minimum(self._unfelt_ns[taxels], valid_ns)
            if rezero._since_ns != self._observed.get(board, (None, 0))[0]:
                self._observed[board] = rezero._since_ns, now_ns
            # Whatever begins to press while the zero is observed, or later, is felt.
            finds = np.ones(len(taxels), np.bool_)
            if rezero.settled(wall_ns):
                unsettled = rezero.unsettled(wall_ns)
                fitted = (layout.boards[board].taxel_index >= 0).ravel()
                finds = np.zeros_like(finds) if unsettled is None else unsettled[fitted]
            unfelt = pressed[taxels] & (self._pressed_ns[taxels] > self._unfelt_ns[taxels])
            if rezero.begun:
                unfelt &= self._pressed_ns[taxels] <= self._observed[board][1]
            self._exempt[taxels] |= finds & (unfelt | spoiled[taxels])
        self._felt_ns = self._heard_ns()

    def contacts(self) -> None:
        """What the broker keeps of a part is no lie: `OFF` means that nothing presses it."""
        world = self._world
        life = world.life
        if life is None or life.dead or not life.daemon.publisher.counters.connected:
            self._connected_ns = None
            return
        if world.broker.frozen:
            self._connected_ns = None
            return
        now_ns = self._now_ns()
        connections = life.daemon.publisher.counters.connections
        if self._connected_ns is None or self._connection != connections:
            self._connection, self._connected_ns = connections, now_ns
        if not life.stop.is_set():  # Then `offline` is the last of all.
            self._retained(now_ns)
        for name, since_ns in self._blank_since.items():
            topic = life.daemon.publisher.topics.part("contact", name)
            long = now_ns - max(since_ns, self._connected_ns) > UNKNOWN_NS
            if long and world.broker.retained.get(topic) == b"OFF":
                self.break_(f"{name}: the broker keeps OFF, and no taxel is valid")
        if len(self._truth) < SAMPLES:
            return
        lately = np.array([values for _, values in list(self._truth)[-6:]])
        pads = (world.layout.pad_kind == PadKind.PRESSURE) & ~self._exempt & ~self._spoiled()
        calibration = life.daemon.engine.calibration
        if calibration is not None:
            # A part whose other pads are valid has a contact, and health names those without one.
            pads &= calibration.usable & ~life.daemon.engine.cut_off()
        pressed = (lately.min(axis=0) > PRESSED_KPA) & pads
        for name, part in self._parts.items():
            topic = life.daemon.publisher.topics.part("contact", name)
            wrong = world.broker.retained.get(topic) == b"OFF"
            if not wrong or not pressed[part.start : part.stop].any():
                self._wrong_since_ns.pop(name, None)
            # A chip or a board that has just come back takes some sweeps to decide.
            elif self._now_ns() - self._wrong_since_ns.setdefault(name, self._now_ns()) > NS // 2:
                self.break_(f"{name}: the broker keeps OFF, and it has been pressed for 2 s")

    def _retained(self, now_ns: int) -> None:
        """The broker keeps what the daemon wants it to keep."""
        assert self._connected_ns is not None
        for topic, (payload, put_ns) in self._said.items():
            # What was put just before a stall leaves after it.
            if now_ns - max(put_ns, self._connected_ns, self._stalled_ns) < RETAINED_NS:
                continue
            kept = self._world.broker.retained.get(topic)
            if kept != payload:
                self.break_(f"{topic}: the broker keeps {kept!r:.60}, put was {payload!r:.60}")
                return

    def _now_ns(self) -> int:
        return self._world.clock.monotonic_ns()


def _after(life: Life, look: Callable[..., None], do: Callable[..., None]) -> Callable[..., None]:
    """Do something, then look at it."""

    def both(*args: Any) -> None:
        if not life.dead:
            look(*args)
        do(*args)

    return both
