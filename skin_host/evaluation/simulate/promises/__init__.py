"""What must always hold, checked while it happens against the emulator's own truth.

The daemon's outputs are looked at where they leave the core (every frame, touch, contact and
health record) and where subscribers get them from the broker. The first promise that is broken
ends the run.

- `truth`: what presses the skin, and what may be read of it
- `skin`: frames and touches report what presses the skin
- `contacts`: so do the numbers of touch events: force, place, area, pressures
- `fingertips`: so do those on force/torque boards, and `loads` the numbers of their events
- `received`: what is valid was received lately, in one sweep
- `subscribers`: what the broker keeps and subscribers get is what the daemon put
- `accounts`: every frame and every event is accounted for
- `excuses`, `zeros`: which taxels are not judged, because nobody can know
- `limits`: how far off, how late and how much anything may be
"""

import asyncio
import gc
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from skin_host.daemon.daemon import Daemon
from skin_host.evaluation.simulate.accusations import Accusations
from skin_host.evaluation.simulate.promises.accounts import Accounts
from skin_host.evaluation.simulate.promises.excuses import Excuses
from skin_host.evaluation.simulate.promises.fingertips import FingertipCheck
from skin_host.evaluation.simulate.promises.limits import (
    FELT_NS,
    MORE_OBJECTS,
    MOST_TASKS,
    NS,
    STALE_PERIODS,
    TASKS_OF_BOARD,
    TOUCHING_KPA,
)
from skin_host.evaluation.simulate.promises.received import Received
from skin_host.evaluation.simulate.promises.skin import SkinCheck
from skin_host.evaluation.simulate.promises.subscribers import Subscribers
from skin_host.evaluation.simulate.promises.truth import Truth
from skin_host.evaluation.simulate.promises.zeros import ZeroCheck
from skin_host.evaluation.simulate.troubles.hardware import damaged_set_up
from skin_host.evaluation.simulate.troubles.trouble import Trouble
from skin_host.evaluation.simulate.world import Life, Triangle, World
from skin_host.fingertip.events import FingertipEvent
from skin_host.layout import PadKind
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame


class Promises:
    """Watches a world.

    Attributes:
        broken: what was broken first, or None.
        stopped: set when a promise is broken.
        touches: events so far.
        accusations: what health reports against the troubles.
        excuses: which taxels are not judged.
        subscribers: what is at the broker.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.broken: str | None = None
        self.stopped = asyncio.Event()
        self.touches = 0
        self.accusations = Accusations(world)
        self.excuses = Excuses(world)
        self.subscribers = Subscribers(world)
        self._truth = Truth(world)
        self._skin = SkinCheck(world, self.excuses, self._truth)
        self.chance = self._skin.chance
        self._zeros = ZeroCheck(world, self.excuses, self._truth)
        self._fingertips = FingertipCheck(world, self.accusations)
        self._received = Received(world)
        self._accounts = Accounts(world)
        self._parts = {part.name: part for part in world.layout.parts}
        #: When each taxel was last received, as known at the sample before.
        self._felt_ns = np.zeros(world.layout.n_taxels, np.int64)
        self._sampled_ns = 0
        #: Chips that do not measure what they should.
        self._damaged: dict[Triangle, Trouble] = {}
        self._objects: int | None = None
        world.before_press = self._note_pause
        world.broker.listeners.append(self._hear)

    # ------------------------------------------------------------------ what happens

    def break_(self, what: str) -> None:
        """A promise is broken."""
        if self.broken is None:
            self.broken = what
            self._world.note(f"BROKEN: {what}")
            self.stopped.set()

    def _note_pause(self) -> None:
        self._truth.note()
        self._fingertips.note_pause()

    def _hold(self, wrong: str | None) -> None:
        if wrong is not None:
            self.break_(wrong)

    def begin(self, trouble: Trouble) -> None:
        """A trouble begins."""
        self.accusations.begin(trouble)
        self.excuses.begin(trouble)
        if trouble.name == "clock_set":
            self._received.clock_set_ns = self._now_ns()
        if trouble.name == "stall":
            self.subscribers.stalled_ns = self._received.stalled_ns = self._now_ns()
            self.excuses.note_stall()

    def end(self, trouble: Trouble) -> None:
        """A trouble ends."""
        self.accusations.end(trouble)
        self.excuses.end(trouble)

    def note_thresholds(self, payload: str) -> None:
        """An operator asks for other thresholds."""
        asked = msgspec.json.decode(payload).get("set", {})
        self._truth.note_margin(asked.get("margin_units", 0.0))

    def calibrated_at_rest(self) -> None:
        """A calibration of the whole untouched skin was taken."""
        self.excuses.calibrated_at_rest()
        self.accusations.loaded.clear()
        self.accusations.repaired()

    # ------------------------------------------------------------------ the daemon's lives

    def watch(self, life: Life) -> None:
        """Look at what a daemon puts out from its start on."""
        self._skin.begin()
        self._accounts.begin()
        self.subscribers.begin(life)
        self.excuses.known_twice.clear()
        self.accusations.restarted()
        publisher: Any = life.daemon.publisher
        daemon: Any = life.daemon
        for whose, name, look in (
            (publisher._outbox, "put_state", self._retain),
            (daemon, "_deliver", lambda output: self._accounts.note_sweeps(output.sweeps)),
            (publisher, "put_touch", self._touch),
            (publisher, "put_frame", self._frame),
            (publisher, "put_health", self._health),
        ):
            setattr(whose, name, _after(life, look, getattr(whose, name)))

    def started(self, life: Life) -> None:
        """A daemon has started, with the calibration that it found."""
        self._hold(self.subscribers.lost_calibration(life))

    def forget(self, daemon: Daemon, *, touched: bool = False) -> None:
        """A daemon is over: the doubts that the disk refused, or had not taken yet, are lost.

        Args:
            daemon: it.
            touched: it was asked to end, so what is touched then is in doubt, too.
        """
        if not daemon.keeper.zeros_are_kept:
            self.excuses.exempt |= daemon.engine.zeros.at_risk(touched)

    def over(self, life: Life) -> None:
        """A life has ended as it was asked to."""
        self._hold(self._skin.endless())
        self.forget(life.daemon, touched=True)
        self.account(life)

    def account(self, life: Life) -> None:
        """Every frame and every event of a life is accounted for."""
        if not life.dead:
            clock_set_ns = self._received.clock_set_ns
            self._hold(self._accounts.wrong(life, self.subscribers.counts, clock_set_ns))

    def grown(self) -> None:
        """At the end of a calm: what lives does not become more and more."""
        count = len(gc.get_objects())
        if self._objects is None:
            self._objects = count
        elif count > self._objects + MORE_OBJECTS:
            # Dead daemons that are garbage, and not collected yet, are no growth.
            gc.collect()
            count = len(gc.get_objects())
        if count > self._objects + MORE_OBJECTS:
            self.break_(f"{count} objects live, {self._objects} did after the first calm")

    # ------------------------------------------------------------------ what leaves the core

    def _touch(self, event: FingertipEvent) -> None:
        self._accounts.note_event()
        self._truth.note()
        if isinstance(event, Touch):
            self.touches += 1
            self._hold(self._skin.touch(event))
        self._hold(self._fingertips.reports(event))

    def _frame(self, frame: PressureFrame) -> None:
        self._truth.note()
        valid = frame.valid.tobytes()
        wrong = (
            self._skin.frame(frame, valid)
            or self._received.stale(frame)
            or self._received.untraced(frame, valid)
        )
        self.subscribers.note_blank(frame.part, blank=b"\1" not in valid)
        if wrong is not None:
            self.break_(f"{frame.part}: {wrong}")

    def _retain(self, topic: str, payload: bytes) -> None:
        self.subscribers.note_retained(topic, payload)
        if payload == b"ON" and not self._skin.open.get(self.subscribers.contacts.get(topic, "")):
            self.break_(f"{topic}: ON without a touch")

    def _health(self, part: str, record: Any) -> None:
        self._hold(self.accusations.note(part, record) or self.accusations.unnamed())
        if part not in self._parts:
            return
        for trouble in self.excuses.spoiling:
            if {"code": "board_twice", "where": trouble.twice} in record["faults"]:
                self.excuses.note_twice(trouble)
        touched = np.array(record["taxel_verdicts"].get("touched", []), np.intp)
        calibrated_ns = self.excuses.calibrated_touched_ns[touched + self._parts[part].start]
        false = touched[calibrated_ns < 0]
        if len(false):
            self.break_(f"{part}: taxels {false.tolist()} rested when they were calibrated")

    def _hear(self, topic: str, payload: bytes) -> None:
        self._hold(self.subscribers.hear(topic, payload))

    # ------------------------------------------------------------------ samples of the truth

    def sample(self) -> None:
        """Compare what was reported last with the truth."""
        world, excuses = self._world, self.excuses
        now_ns = self._now_ns()
        world.move()
        self._truth.note()
        true_kpa = self._truth.kpa
        self._skin.note_recovered()
        self._note_set_ups()
        life = world.life
        alone = life is None or life.began_ns >= self._sampled_ns
        self._sampled_ns = now_ns
        self._zeros.note_taken(true_kpa, self._felt_ns, alone=alone)
        excuses.touched_ns[true_kpa > TOUCHING_KPA] = now_ns
        if life is not None:
            if life.daemon.engine.calibrating:
                excuses.note_calibrating(true_kpa)
            self._skin.note_valid(true_kpa)
            self._zeros.note_observed(life, true_kpa, self._skin.valid_ns, self._felt_ns)
            self._felt_ns = self._received.last_ns()
            calibration = life.daemon.engine.calibration
            if calibration is not None:
                self.subscribers.note_calibration(calibration.id, calibration.time)
        self._fingertips.note_loads(life)
        if life is None or life.dead or not self._truth.sampled:
            return
        self._hold(self._skin.wrong())
        if not life.stop.is_set():  # a daemon that ends reads no more, and stops the boards
            self._hold(self._fingertips.wrong(life))
            self._hold(self._unreceived(now_ns))
        self._hold(self.accusations.unnamed())
        if len(asyncio.all_tasks()) > MOST_TASKS + TASKS_OF_BOARD * len(world.layout.boards):
            self.break_(f"{len(asyncio.all_tasks())} tasks run")

    def contacts(self) -> None:
        """What the broker keeps of a part is no lie: `OFF` means that nothing presses it."""
        life = self._world.life
        if not self.subscribers.connected():
            return
        assert life is not None
        if not life.stop.is_set():  # Then `offline` is the last of all.
            self._hold(self.subscribers.not_kept())
        self._hold(self.subscribers.blank_off())
        if not self._truth.sampled:
            return
        pads = self._world.layout.pad_kind == PadKind.PRESSURE
        pads &= ~self.excuses.exempt & ~self.excuses.spoiled()
        usable = life.daemon.engine.usable()
        if usable is not None:
            # A part whose other pads are valid has a contact, and health names those without one.
            pads &= usable
        self._hold(self.subscribers.pressed_off(self._truth.firm(FELT_NS) & pads))

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

    def _unreceived(self, now_ns: int) -> str | None:
        """Return a board that nothing keeps silent: the daemon itself must bring it back."""
        for board in self._world.layout.boards:
            taxels = board.taxel_index[board.taxel_index >= 0]
            quiet_ns = now_ns - int(self._felt_ns[taxels].max())
            if quiet_ns < STALE_PERIODS * board.settings.period_ms * 1_000_000:
                continue
            if not self.accusations.may_be_silent(board.name):
                return (
                    f"board {board.name} was last received {quiet_ns / NS:.1f} s ago, and nothing "
                    "keeps it silent"
                )
        return None

    def _now_ns(self) -> int:
        return self._world.clock.monotonic_ns()


def _after(life: Life, look: Callable[..., None], do: Callable[..., None]) -> Callable[..., None]:
    """Do something, then look at it."""

    def both(*args: Any) -> None:
        if not life.dead:
            look(*args)
        do(*args)

    return both
