"""All fingertips of one node: takes CAN frames and the skin's contacts, returns events. Pure."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from skin_host.bus.ledger import STALE_INTERVALS_NS, Allowance, is_period, regular_ns
from skin_host.bus.strain import (
    CHANNELS,
    LOADS,
    ZERO_WORD,
    StrainFrames,
    StrainType,
    Wrench,
    WrenchAssembler,
    parse_full_scale,
    parse_strain,
)
from skin_host.bus.wire import FrameBatch, MessageClass
from skin_host.config.fingertips import Fingertip
from skin_host.config.settings import Settings
from skin_host.fingertip.agreement import Agreement
from skin_host.fingertip.events import FingertipEvent
from skin_host.fingertip.frozen import Frozen
from skin_host.fingertip.tip import Tip
from skin_host.layout import Layout
from skin_host.processing.calibration import Zero
from skin_host.processing.events import Touch
from skin_host.processing.masks import Mask

Floats = NDArray[np.float64]

_COMMAND = int(MessageClass.ANALOG_COMMAND)

#: A board's period is known by so many intervals. Of one that loses a third of its frames, 16 in a
#: row look regular and twice as long every 2000th time, and 48 do once in weeks.
PERIOD_INTERVALS = 48
#: A zero is the mean of at least this many samples.
FEWEST_SAMPLES = 10
#: A sample is compared with the median of so many, itself in the middle: a load lasts for longer.
AROUND = 5
#: It was damaged if a channel is off by so many times what half of the samples are off.
DAMAGED_TIMES = 12.0
#: If more of the samples are off, that is noise.
MOST_DAMAGED = 0.2


@dataclass(slots=True)
class TipState:
    """One fingertip with its board.

    Attributes:
        number: among the fingertips of the configuration.
        answered_scale: float64[6], its last answers to what its full scales are; 0 where it has
            not answered.
        reported_scale: float64[6], those on which two answers in a row agreed: a damaged one has
            no checksum, and would be a wrong unit of everything.
        last_ns, sampled_ns: time of its last whole sample, and the same by the ledger's clock,
            which does not jump. A contact is as old as that, whatever else the board sends.
        received_ns: by that clock, when its last frame was received.
        half_ns: the same of each type of frame of its samples.
        wrong_ns: the same of frames of a wrong length.
        begun_ns: the same of when it began to send what can be sampled.
        touched_since_ns: the same of its touch, if there is one.
        assembler: of its samples; None until the full scales are known.
        zero_scale: float64[6], full scales of the board that its zero was taken of, if they are
            known.
        agreement: of its samples, which only together are a load.
        frozen: whether they are measured.
        saturated_ns: when its load was last saturated, 0 if never.
        silenced: how often the board has timed out: has sent nothing, or no whole sample.
        alive: it sends.
        incomplete: it sends, and for too long no whole sample.
        intervals_ns: between its last samples, by their time stamps.
        came, sampled: a frame of it, and a whole sample, was read since boards were last looked at.
        awaited: the board is being set up and has not had the time to send yet.
        allowance: how many of its samples are processed.
        zeroing, touching: samples of which a zero is taken, and whether it was touched in each.
    """

    name: str
    number: int
    settings: Fingertip
    tip: Tip
    answered_scale: Floats = field(default_factory=lambda: np.zeros(CHANNELS))
    reported_scale: Floats = field(default_factory=lambda: np.zeros(CHANNELS))
    assembler: WrenchAssembler | None = None
    zero_scale: Floats | None = None
    agreement: Agreement = field(default_factory=Agreement)
    frozen: Frozen = field(default_factory=Frozen)
    last_ns: int = 0
    sampled_ns: int = 0
    received_ns: int = 0
    half_ns: dict[int, int] = field(default_factory=dict)
    wrong_ns: int | None = None
    begun_ns: int = 0
    touched_since_ns: int | None = None
    frames: int = 0
    saturated_ns: int = 0
    silenced: int = 0
    alive: bool = False
    incomplete: bool = False
    intervals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=PERIOD_INTERVALS))
    came: bool = False
    sampled: bool = False
    awaited: bool = False
    zeroing: list[Floats] = field(default_factory=list)
    touching: list[bool] = field(default_factory=list)
    allowance: Allowance = field(init=False)

    def __post_init__(self) -> None:
        self.allowance = Allowance(self.settings.period_ms * 1_000_000)

    @property
    def samples(self) -> int:
        """How many whole samples it has sent."""
        return 0 if self.assembler is None else self.assembler.counters.samples

    @property
    def sent_period_ns(self) -> float | None:
        """Return in which period it sends; None where that is irregular, or not known yet.

        By few intervals, one that loses half of its samples might seem regular.
        """
        if len(self.intervals_ns) < PERIOD_INTERVALS:
            return None
        return regular_ns(list(self.intervals_ns))

    @property
    def keeps_period(self) -> bool | None:
        """Return whether it sends in its configured period; None as `sent_period_ns`."""
        return is_period(self.sent_period_ns, 1e6 * self.settings.period_ms)

    @property
    def twice(self) -> bool:
        """Whether a second board sends at its address, so that each sample is of one or the other.
        One that is only faster than configured is none.
        """
        many = self.assembler is not None and self.assembler.twice
        return many and self.keeps_period is not False

    @property
    def trusted(self) -> bool:
        """Whether its samples change, and are of one board."""
        return self.frozen.trusted and not self.twice

    def lately(self, at_ns: int | None) -> bool:
        """Whether what came at a time, by the ledger's clock, is of what the board sends now."""
        return at_ns is not None and self.received_ns - at_ns < self.tip.lost_ns

    @property
    def reports_all(self) -> bool:
        """Whether the full scales of all channels are known. One below 0.5 is reported as 0."""
        return bool((self.reported_scale > 0.0).all())

    @property
    def scale_before(self) -> Floats | None:
        """Return the full scales that are used, or belong to the zero, if the board reported other
        ones.
        """
        for scale in (
            None if self.assembler is None else self.assembler.full_scale,
            self.zero_scale,
        ):
            if scale is not None:
                known = self.reported_scale > 0.0
                # A board reports whole numbers.
                if (np.abs(self.reported_scale - scale)[known] > 0.5).any():
                    return scale
        return None

    @property
    def exchanged(self) -> bool:
        """Whether it is another board than that whose full scales are used, or whose zero: not if
        they are given.

        What it measures may be a fraction of what presses it, until it has a zero of its own.
        """
        return self.settings.full_scale is None and self.scale_before is not None


class FingertipOutput(NamedTuple):
    """Samples and events from a batch of frames.

    Attributes:
        samples: number of the fingertip and time of each force/torque sample.
        events: of the fingertips.
    """

    samples: list[tuple[int, int]]
    events: list[FingertipEvent]


class FingertipEngine:
    """Assemblers and contact sensing of a node's fingertips.

    Attributes:
        tips: by name.
        held_report_ns: a contact that lasts for longer is reported.
    """

    def __init__(self, settings: Settings, layout: Layout, parts: list[int]) -> None:
        nodes = {layout.parts[part].node for part in parts}
        self.tips: dict[str, TipState] = {}
        self.held_report_ns = int(settings.processing.drift.frozen_report_s * 1e9)
        self._of_address: dict[str, dict[int, TipState]] = {}
        self._of_part: dict[int, TipState] = {}
        self._zeroing = False
        self._now_ns = 0
        for number, (name, table) in enumerate(settings.fingertips.items()):
            if table.node not in nodes:
                continue
            period_ns = 0
            array = next((i for i in parts if layout.parts[i].name == table.array), None)
            if array is not None:
                boards = [layout.boards[i].settings for i in layout.parts[array].boards]
                period_ns = max(board.period_ms for board in boards) * 1_000_000
            tip = Tip(name, table, settings.processing.touch.move_hz, period_ns)
            state = self.tips[name] = TipState(name, number, table, tip)
            self._of_address.setdefault(table.bus, {})[table.address] = state
            if array is not None:
                self._of_part[array] = state
            if table.full_scale is not None:
                self._assemble(state, np.array(table.full_scale))

    def renew(self, settings: Settings) -> None:
        """Apply new settings that fingertips share with the skin's processing."""
        self.held_report_ns = int(settings.processing.drift.frozen_report_s * 1e9)
        for state in self.tips.values():
            state.tip.move_hz = settings.processing.touch.move_hz

    @property
    def buses(self) -> set[str]:
        """Names of the buses that the boards are on."""
        return set(self._of_address)

    def on_bus(self, bus: str) -> list[TipState]:
        """The fingertips whose boards are on a bus."""
        return list(self._of_address.get(bus, {}).values())

    def identifiers(self, bus: str) -> frozenset[int]:
        """Identifiers of the data frames that the configured boards of a bus send."""
        return frozenset(
            MessageClass.ANALOG_STREAM << 8 | address << 4 | kind
            for address in self._of_address.get(bus, {})
            for kind in StrainType
        )

    def feed(self, bus: str, batch: FrameBatch, now_ns: int) -> FingertipOutput:
        """Process a batch of frames of one bus; `now_ns` is the time of the ledger's clock."""
        self._now_ns = now_ns
        felt = FingertipOutput([], [])
        here = self._of_address.get(bus)
        if here is None:
            return felt
        for row in np.flatnonzero(batch.id >> 8 == _COMMAND).tolist():
            self._note_answer(here, int(batch.id[row]), batch.data[row, : batch.dlc[row]].tobytes())
        frames = parse_strain(batch)
        if not len(frames.row) and not len(frames.wrong_length):
            return felt
        for address, state in here.items():
            self._note_frames(state, frames, address)
            if state.assembler is not None:
                for wrench in state.assembler.take(frames, batch.t_ns):
                    self._note_sample(state, wrench)
                    if state.allowance.is_excess(wrench.t_ns):
                        state.assembler.counters.excess += 1
                        continue
                    felt.samples.append((state.number, wrench.t_ns))
                    felt.events.extend(self._step(state, wrench))
        return felt

    def _note_frames(self, state: TipState, frames: StrainFrames, address: int) -> None:
        """Note what a board sent, whether it can be sampled or not."""
        types = frames.type[(frames.board == address) & (frames.type >= LOADS)].tolist()
        wrong = int(np.count_nonzero(frames.wrong_length == address))
        if not types and not wrong:
            return
        if not state.alive:
            state.begun_ns = self._now_ns
        state.frames += len(types) + wrong
        state.half_ns.update(dict.fromkeys(types, self._now_ns))
        if wrong:
            state.wrong_ns = self._now_ns
        state.received_ns = self._now_ns
        state.came = state.alive = True

    def _note_sample(self, state: TipState, wrench: Wrench) -> None:
        if self._now_ns - state.sampled_ns >= state.tip.lost_ns:
            state.agreement.forget()
            state.frozen.doubt()
        interval_ns = wrench.t_ns - state.last_ns
        if 0 < interval_ns < STALE_INTERVALS_NS:
            state.intervals_ns.append(interval_ns)
        else:
            state.intervals_ns.clear()
        state.last_ns, state.sampled_ns = wrench.t_ns, self._now_ns
        state.sampled, state.incomplete = True, False

    def note_skin(self, part: int, events: Iterable[Touch], t_ns: int) -> None:
        """Take in the contacts of a processed frame of a part (index in the layout)."""
        state = self._of_part.get(part)
        if state is not None:
            state.tip.note_skin(events, t_ns)

    def expire(self, t_ns: int, now_ns: int) -> list[FingertipEvent]:
        """Find boards that have timed out, or send no whole samples any more.

        Args:
            t_ns: now, on the clock of the frames' time stamps, which may be set.
            now_ns: now, on the ledger's clock.
        """
        self._now_ns = now_ns
        events: list[FingertipEvent] = []
        for state in self.tips.values():
            # Until now: what waited in a pause of this computer is read at once.
            if state.came:
                state.came, state.received_ns = False, now_ns
            if state.sampled:
                state.sampled, state.sampled_ns = False, now_ns
            since_ns = max(state.sampled_ns, state.begun_ns)
            if state.alive and now_ns - state.received_ns > state.tip.silent_ns:
                state.silenced += not state.incomplete
                state.alive = state.incomplete = False
            elif state.alive and state.assembler is not None and not state.incomplete:
                state.incomplete = now_ns - since_ns >= state.tip.lost_ns
                state.silenced += state.incomplete
            events += state.tip.expire(t_ns, now_ns - state.sampled_ns)
            self._note_touch(state)
        return events

    def touched_for_ns(self, state: TipState) -> int:
        """How long the contact of a fingertip has lasted; 0 without one."""
        return 0 if state.touched_since_ns is None else self._now_ns - state.touched_since_ns

    def _note_touch(self, state: TipState) -> None:
        if not state.tip.touched:
            state.touched_since_ns = None
        elif state.touched_since_ns is None:
            state.touched_since_ns = self._now_ns

    def end_all(self, t_ns: int) -> list[FingertipEvent]:
        """End every contact, because the daemon stops."""
        return [event for state in self.tips.values() for event in state.tip.end_all(t_ns)]

    def begin_zero(self) -> None:
        """Start to collect samples of the unloaded fingertips.

        From now on those whose boards were exchanged are read by the full scales of the new ones.
        """
        self._zeroing = True
        for state in self.tips.values():
            if state.exchanged and state.reports_all and not state.tip.lasts:
                self._assemble(state, state.reported_scale.copy())
                state.tip.use(None)
                state.zero_scale = None
            state.zeroing.clear()
            state.touching.clear()

    def end_zero(self) -> dict[str, Zero]:
        """Return the zeros from the collected samples, for each fingertip with enough samples."""
        self._zeroing = False
        found = {}
        for name, state in self.tips.items():
            if len(state.zeroing) >= FEWEST_SAMPLES and state.trusted:
                assert state.assembler is not None
                samples = np.array(state.zeroing)
                whole = ~damaged(samples, state.assembler.full_scale / ZERO_WORD)
                touched = bool(np.array(state.touching)[whole].any())
                samples = samples[whole]
                found[name] = Zero(
                    samples.mean(axis=0),
                    samples.std(axis=0, ddof=1),
                    touched,
                    state.assembler.full_scale.copy(),
                )
            state.zeroing.clear()
            state.touching.clear()
        return found

    def use(self, zeros: dict[str, Zero]) -> list[FingertipEvent]:
        """Use these zeros from now on; a fingertip without a zero publishes nothing.

        Returns the events that end the present contacts.
        """
        events: list[FingertipEvent] = []
        for name, state in self.tips.items():
            events += state.tip.end_all(state.last_ns)
            zero = zeros.get(name)
            state.tip.use(zero)
            state.zero_scale = None if zero is None else zero.full_scale
            noise_words = np.zeros(CHANNELS)
            if zero is not None and zero.full_scale is not None:
                noise_words = zero.noise / (zero.full_scale / ZERO_WORD)
            state.frozen.judge(noise_words)
            self._note_touch(state)
        return events

    def assume_scales(self) -> None:
        """Use the full scales of the boards of which the zeros are, where no others are known: a
        recording may have begun after boards were queried.
        """
        for state in self.tips.values():
            if state.assembler is None and state.zero_scale is not None:
                self._assemble(state, state.zero_scale)

    def _step(self, state: TipState, wrench: Wrench) -> list[FingertipEvent]:
        events: list[FingertipEvent] = []
        load = state.agreement.take(wrench)
        state.frozen.take(wrench)
        trusted = state.trusted
        if not trusted or state.exchanged:
            events = state.tip.lose(wrench.t_ns)
            self._note_touch(state)
        elif load is not None:
            if load.saturated:
                state.saturated_ns = load.t_ns
            events = state.tip.step(load)
            self._note_touch(state)
        if self._zeroing and not wrench.saturated and trusted:
            state.zeroing.append(np.concatenate([wrench.force_n, wrench.torque_nm]))
            state.touching.append(state.tip.touched)
        return events

    def _note_answer(self, here: dict[int, TipState], can_id: int, payload: bytes) -> None:
        found = parse_full_scale(can_id, payload)
        if found is None:
            return
        address, answer = found
        state = here.get(address)
        if state is None:
            return
        if state.answered_scale[answer.channel] == answer.value:
            state.reported_scale[answer.channel] = answer.value
        state.answered_scale[answer.channel] = answer.value
        if state.assembler is None and state.reports_all:
            self._assemble(state, state.reported_scale.copy())

    def _assemble(self, state: TipState, full_scale: Floats) -> None:
        table = state.settings
        counters = None if state.assembler is None else state.assembler.counters
        state.assembler = WrenchAssembler(table.address, table.period_ms, full_scale, counters)
        state.tip.set_range(full_scale)
        state.begun_ns = self._now_ns


def damaged(samples: Floats, step: Floats) -> Mask:
    """Return which samples bool[n] are off alone, as damaged frames are, and loads are not.

    Noise and zero would be wrong by them: one wrong bit may be thousands of noises.

    Args:
        samples: float64[n, 6], in the order of their times.
        step: float64[6], the least difference of two values of a channel.
    """
    ends = AROUND // 2
    padded = np.pad(samples, ((ends, ends), (0, 0)), mode="edge")
    off = np.abs(samples - np.median(sliding_window_view(padded, AROUND, axis=0), axis=-1))
    usual = np.maximum(np.median(off, axis=0), step)
    found: Mask = (off > DAMAGED_TIMES * usual).any(axis=1)
    return found if found.mean() <= MOST_DAMAGED else np.zeros_like(found)
