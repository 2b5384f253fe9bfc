"""A whole robot below its PC: boards, chips, foam and scene from the host's own settings.

`step` moves the robot on in time and returns the frames that its boards sent; `receive` takes
commands. Nothing here knows the time of day; only `run` communicates with the outside.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from heapq import heappop, heappush
from pathlib import Path

import can
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from emulator import faults, state
from emulator.boards.arithmetic import TAXELS
from emulator.boards.board import join
from emulator.boards.contents import Bursts, load_recordings
from emulator.boards.fingertips import Fingertips
from emulator.boards.mtb import Mtb, make_board, set_up
from emulator.chips.converters import Converters, fidelities
from emulator.clock import EmulatedTime, RealClock
from emulator.link import BoardLink
from emulator.probes.contacts import ContactSource
from emulator.probes.scene import Fault, Probe, Scene, check, check_values
from emulator.probes.skin import NEVER_NS, Skin
from emulator.state import StateError
from emulator.wire import NOTHING, Wire
from skin_host.bus.commands import Message, SetTxMode, TxMode, command_frame
from skin_host.bus.wire import FrameBatch
from skin_host.config.explain import LARGEST
from skin_host.config.settings import Settings
from skin_host.errors import ConfigurationError, RequestError
from skin_host.files import write_atomic
from skin_host.layout import Layout

NS = 1_000_000_000
log = logging.getLogger(__name__)

#: Boards that are due within the same millisecond are computed together.
TICK_NS = 1_000_000
#: How often `run` looks at buses and boards.
POLL_NS = 2_000_000
#: Boards do not stall with a computer: a process that was held up catches up. One that was stopped
#: for longer than this first leaves out whole periods of its boards.
LONGEST_CATCH_UP_NS = 5_000_000_000
#: A longer time is lived in parts, between which other tasks run: one of them may end the robot.
LONGEST_PART_NS = 500_000_000
#: After a longer pause, in the host's time, it has found boards silent, on a bus that does not show
#: it a pause.
STALL_NS = 150_000_000
#: Pauses are reported this often, in the host's time.
REPORT_NS = 10_000_000_000
#: Before time is left out, sweeps in progress get so long to end; a full bus is never idle.
LONGEST_SWEEP_NS = 100_000_000

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


class Robot:
    """An emulated robot.

    Args:
        settings, layout: as the host reads them from one configuration file.
        scene: what happens to it; nothing, if not given.
        fidelity: "signal" or "chip", for all boards or by the board's name.
        seed: replaces the scene's.
        recordings: logs by the board's name: these boards send what was recorded from a board
            of their address.
        source: contacts that press besides the scene's probes, as of a simulation of bodies.

    Attributes:
        t_ns: time since it was switched on.
        boards: the boards by name.
        skin: foam and pads under the scene, with the truth that tests compare with.
        fingertips: force/torque boards and what lies on them.
        converters: the chips.
        wires: the buses by name.
        active: what faults do now.
        hung, late_ns, jitter_ns: faults of boards, by their index in the layout.

    Raises:
        ConfigurationError: the scene, the fidelities or the recordings name something that the
            layout does not have.
        LogError: a recording cannot be read.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        scene: Scene | None = None,
        *,
        fidelity: str | Mapping[str, str] = "signal",
        seed: int | None = None,
        recordings: Mapping[str, Path] | None = None,
        source: ContactSource | None = None,
    ) -> None:
        scene = scene or Scene()
        if seed is not None:
            scene = structs.replace(scene, seed=seed)
        check(scene)
        self.settings = settings
        self.layout = layout
        self.t_ns = 0
        self.skin = Skin(layout, scene, settings.fingertips, source)
        self.fingertips = Fingertips(settings, layout, scene, self._skin_force_n)
        of_board = fidelities(layout, fidelity)
        self.converters = Converters(
            layout, self.skin.noise, self.skin.noise_ff, scene.seed, fidelity=of_board
        )
        held = ~np.isnan(self.skin.held_ff).reshape(-1, TAXELS)
        for chip in np.flatnonzero(held.any(axis=1)).tolist():
            self.converters.hold_results(chip, held[chip])
        self._skin_due_ns = 0
        self._felt_taxels = np.zeros(0, np.intp)
        self._gather(self._felt_taxels)
        chips = np.arange(len(layout.triangles))
        self.converters.set_capacitance_ff(chips, self.skin.capacitance_ff.reshape(-1, TAXELS))
        rng = np.random.default_rng([scene.seed, 3])
        self._boards: list[Mtb] = [
            make_board(
                board.settings.model, board.settings.address, self.converters.of_board(number), rng
            )
            for number, board in enumerate(layout.boards)
        ]
        self.boards = {
            board.name: mtb for board, mtb in zip(layout.boards, self._boards, strict=True)
        }
        self._bus_of = [board.settings.bus for board in layout.boards]
        self.wires = {
            name: Wire(
                bus.bitrate, self._stack_sizes(name), np.random.default_rng([scene.seed, 4, number])
            )
            for number, (name, bus) in enumerate(settings.buses.items())
        }
        self._recordings = load_recordings(layout, recordings or {})
        self._in_bus_order = sorted(range(len(self._boards)), key=self._bus_of.__getitem__)
        self._bursts = Bursts(self._boards, self._bus_of, self.converters)
        self._rng = np.random.default_rng([scene.seed, 5])
        self.active = faults.Active()
        #: Faults that began, and how they end; those that are over stay until another one begins.
        self._begun: list[tuple[Fault, faults.Mend]] = []
        self.hung: set[int] = set()
        self.late_ns: dict[int, int] = {}
        self.jitter_ns: dict[int, float] = {}
        self._planned = 0
        self._agenda: list[tuple[int, int, Callable[[], object]]] = []
        for number, fault in enumerate(scene.fault):
            try:
                faults.check_targets(self, fault)
            except ConfigurationError as error:
                raise ConfigurationError(f"fault[{number}].{error}") from None
            self._plan(fault.at_s, partial(self._happen, number, fault))
        self._look_ahead()

    # ------------------------------------------------------------------ time

    def step(self, dt_s: float) -> dict[str, FrameBatch]:
        """Let `dt_s` pass.

        Returns:
            By bus, the frames whose transmission ended meanwhile, `t_ns` that moment.

        Raises:
            RequestError: time does not go back, nor for ever.
        """
        if not 0.0 <= dt_s < math.inf:
            raise RequestError(f"dt_s: seen {dt_s}, wanted a time of 0 s or more")
        end_ns = self.t_ns + round(dt_s * NS)
        wires = self.wires
        if (
            end_ns < self._boards_due_ns
            and end_ns < self._skin_due_ns
            and end_ns < self._tips_due_ns
            and not (self._agenda and self._agenda[0][0] <= end_ns)
            and all(wire.silent for wire in wires.values())
        ):
            # Nothing happens until then: a host looks more often than boards send.
            self.t_ns = self.converters.t_ns = end_ns
            return dict.fromkeys(wires, NOTHING)
        passed: list[dict[str, FrameBatch]] = []
        while True:
            next_ns = min(end_ns, self._skin_due_ns, self._boards_due_ns, self._tips_due_ns)
            if self._agenda and self._agenda[0][0] < next_ns:
                next_ns = self._agenda[0][0]
            self._move_to(max(self.t_ns, next_ns))
            if self._agenda and self._agenda[0][0] <= self.t_ns:
                # A fault of a bus that begins or ends now is none of what has passed by now.
                passed.append({name: wire.until(self.t_ns) for name, wire in wires.items()})
            while self._agenda and self._agenda[0][0] <= self.t_ns:
                heappop(self._agenda)[2]()
                self._look_ahead()
            if self._boards_due_ns <= self.t_ns:
                self._sample()
            if self._tips_due_ns <= self.t_ns:
                for bus, batch in self.fingertips.step(self.t_ns):
                    self.wires[bus].put(batch)
                self._look_ahead_at_tips()
            if self.t_ns >= end_ns:
                break
        passed.append({name: wire.until(self.t_ns) for name, wire in wires.items()})
        if len(passed) == 1:
            return passed[0]
        return {name: join([frames[name] for frames in passed]) for name in wires}

    def _look_ahead(self) -> None:
        """Find out when the next board is due; after anything that may have changed it."""
        self._due_ns = [self._due_of(number) for number in range(len(self._boards))]
        self._boards_due_ns = min(self._due_ns, default=NEVER_NS)
        self._look_ahead_at_tips()

    def _look_ahead_at_tips(self) -> None:
        self._tips_due_ns = self.fingertips.due_ns

    def _due_of(self, number: int) -> int:
        """When a board is due."""
        due_ns = self._boards[number].due_ns
        if due_ns is None or number in self.hung:
            return NEVER_NS
        return -(-due_ns // TICK_NS) * TICK_NS

    def _move_to(self, t_ns: int) -> None:
        """Time up to `t_ns`; where mechanics is due, its outcome goes to the chips."""
        self.t_ns = self.converters.t_ns = t_ns
        if t_ns < self._skin_due_ns:
            return
        taxels = self.skin.step(t_ns)
        # The mechanics has a grid of its own: the caller's steps do not change what happens.
        self._skin_due_ns = self.skin.due_ns
        if taxels is not self._felt_taxels:
            self._felt_taxels = taxels
            chips = np.unique(self.layout.triangle_of[taxels]).astype(np.intp)
            if not np.array_equal(chips, self._felt_chips):
                self._gather(chips)
        elif self.skin.is_still:
            return
        if len(taxels):
            self._pass_on()

    def _gather(self, chips: Ints) -> None:
        """Get ready to set what the pads of chips measure."""
        self._felt_chips = chips
        self._held_ff = self.skin.held_ff.reshape(-1, TAXELS)[chips]
        self._is_held = ~np.isnan(self._held_ff)

    def _pass_on(self) -> None:
        """Set what the pads of chips measure."""
        values = self.skin.capacitance_ff.reshape(-1, TAXELS)[self._felt_chips]
        np.copyto(values, self._held_ff, where=self._is_held)
        self.converters.set_capacitance_ff(self._felt_chips, values)

    def _sample(self) -> None:
        """Let every board that is due read its chips and send."""
        together: dict[object, list[int]] = {}
        for number in self._in_bus_order:
            if self._due_ns[number] > self.t_ns:
                continue
            board = self._boards[number]
            bus = self._bus_of[number]
            if board.advance(self.t_ns):
                if board.next_ns is not None and number in self.late_ns:
                    next_ns = board.next_ns + self.late_ns[number]
                    board.next_ns = max(next_ns, self.t_ns + TICK_NS)
                alone = board.alone or number in self.jitter_ns or number in self._recordings
                if not alone and self.converters.read_at_once(number):
                    together.setdefault(type(board).arithmetic, []).append(number)
                else:
                    self.wires[bus].put(self._sample_alone(number, board))
            self._answer(bus, board.answers())
            self._due_ns[number] = self._due_of(number)
        self._boards_due_ns = min(self._due_ns)
        for numbers in together.values():
            for bus, batch in self._bursts.frames(numbers, self.t_ns):
                self.wires[bus].put(batch, self.t_ns)

    def _sample_alone(self, number: int, board: Mtb) -> FrameBatch:
        jitter_ns = self.jitter_ns.get(number, 0.0)
        delay_ns = round(abs(self._rng.normal(0.0, jitter_ns))) if jitter_ns else 0
        recording = self._recordings.get(number)
        if recording is not None:
            return recording.frames(board.address, self.t_ns + delay_ns)
        return board.sample(self.t_ns + delay_ns)

    # ------------------------------------------------------------------ the host's side

    def receive(self, bus: str, can_id: int, data: bytes) -> None:
        """A frame from the host; the boards' answers come with the next step."""
        if not self.wires[bus].passes:
            return
        for number, board in enumerate(self._boards):
            if self._bus_of[number] == bus and number not in self.hung:
                self._answer(bus, board.handle(can_id, data, self.t_ns))
        self._answer(bus, self.fingertips.handle(bus, can_id, data, self.t_ns))
        self._look_ahead()

    def _answer(self, bus: str, answers: list[tuple[int, bytes]]) -> None:
        if answers:
            frames = [(can_id, data, self.t_ns) for can_id, data in answers]
            self.wires[bus].put(FrameBatch.of(frames), self.t_ns)

    def bring_up(self) -> None:
        """Configure and start all boards as a careful host does, for use without one.

        A second or two pass, of which frames are dropped.
        """
        set_up(self.layout, self._command, self.step)
        self.fingertips.start(self.t_ns)
        for number in range(len(self._boards)):
            self._command(number, SetTxMode(TxMode.START))

    def _command(self, number: int, message: Message) -> None:
        self.receive(self._bus_of[number], *command_frame(message, self._boards[number].address))

    async def run(self, buses: Mapping[str, can.BusABC], clock: EmulatedTime | None = None) -> None:
        """Live on real or virtual buses until cancelled.

        Args:
            buses: an open python-can bus for each bus of the settings, by name.
            clock: time to live in; the machine's own, if not given.
        """
        if self.skin.noise is None and self._boards:
            log.warning(
                "the scene has noise = false: values of untouched skin never change, so a daemon "
                "takes the chips for stopped and calibrates none of their pads"
            )
        clock = clock or RealClock()
        links = {name: BoardLink(name, bus) for name, bus in buses.items()}
        # The clock also counts the time before this and what is left out.
        ahead_ns = clock.now_ns() - self.t_ns
        looked_ns = clock.now_ns()
        reported_ns: int | None = None
        while True:
            commands = [
                (name, can_id, data)
                for name, link in links.items()
                for can_id, data in link.received()
            ]
            now_ns = clock.now_ns()
            late_ns = _host_between_ns(clock, looked_ns + POLL_NS, now_ns)
            if late_ns > STALL_NS and (
                reported_ns is None or _host_between_ns(clock, reported_ns, now_ns) > REPORT_NS
            ):
                reported_ns = now_ns
                for name in [name for name, link in links.items() if not link.shows_pauses]:
                    log.warning(
                        "bus %s: this computer held the emulator up for %.0f ms; a host took the "
                        "boards for silent, and what followed for late",
                        name,
                        _host_between_ns(clock, looked_ns, now_ns) / 1e6,
                    )
            looked_ns = now_ns
            if now_ns - ahead_ns - self.t_ns > LONGEST_CATCH_UP_NS:
                self._send(links, self._finish_sweeps(), clock, ahead_ns)
                left_out_ns = self._to_leave_out_ns(now_ns - ahead_ns - self.t_ns)
                ahead_ns += left_out_ns
                for board in self._boards:
                    board.start_ns -= left_out_ns
            # Whole periods that were left out may end a little later than now.
            passed_ns = max(0, now_ns - ahead_ns - self.t_ns)
            # Commands came one after the other in this time: boards whose computer was busy
            # must not get them all at once, chips convert between them.
            steps: list[dict[str, FrameBatch]] = []
            for command in [*commands, None]:
                steps += await self._live(passed_ns / (len(commands) + 1))
                if command is not None:
                    self.receive(*command)
            self._send(links, steps, clock, ahead_ns)
            await clock.sleep_until_ns(now_ns + POLL_NS)

    async def _live(self, passed_ns: float) -> list[dict[str, FrameBatch]]:
        """Let a time pass, in equal parts if it is long."""
        n = max(1, math.ceil(passed_ns / LONGEST_PART_NS))
        steps = [self.step(passed_ns / n / NS)]
        for _ in range(n - 1):
            await asyncio.sleep(0)
            steps.append(self.step(passed_ns / n / NS))
        return steps

    def _send(
        self,
        links: Mapping[str, BoardLink],
        steps: Sequence[Mapping[str, FrameBatch]],
        clock: EmulatedTime,
        ahead_ns: int,
    ) -> None:
        """Send what the boards sent in some steps, of each bus at once.

        A host that finds only the first frames of a sweep that is late takes the others for lost.
        """
        for name, link in links.items():
            batch = join([step[name] for step in steps])
            times_ns = clock.host_ns(np.append(batch.t_ns, self.t_ns) + ahead_ns)
            link.send(batch, times_ns[:-1], int(times_ns[-1]))

    def _finish_sweeps(self) -> list[dict[str, FrameBatch]]:
        """Live until all buses are idle."""
        end_ns = self.t_ns + LONGEST_SWEEP_NS
        steps = [self.step(0.0)]
        while not all(wire.idle for wire in self.wires.values()) and self.t_ns < end_ns:
            steps.append(self.step(TICK_NS / NS))
        return steps

    def _to_leave_out_ns(self, passed_ns: int) -> int:
        """Whole periods of all boards, so that none changes its phase, if they are short enough."""
        together_ns = math.lcm(*(board.period_ns or 1 for board in self._boards))
        over_ns = max(0, passed_ns - LONGEST_CATCH_UP_NS)
        return -(-over_ns // together_ns) * together_ns if together_ns < passed_ns else over_ns

    # ------------------------------------------------------------------ by hand

    def touch(self, probe: Probe) -> "LiveProbe":
        """A probe that is moved by a program, not by the scene; its keyframes are not used.

        Raises:
            ConfigurationError: there is no such part, triangle or taxel, or another value is none
                that a scene may have.
        """
        check_values(probe)
        bare = probe.part in self.fingertips.boards
        live = LiveProbe(self, None if bare else self.skin.add_live(probe))
        self.fingertips.touch(probe, self.layout, live.pressing_n, live.pulling_n)
        return live

    def inject(self, fault: Fault) -> Callable[[], None]:
        """Let a fault begin now; it ends by itself after `until_s - at_s`, or by the answer.

        Raises:
            ConfigurationError: no such fault, or not a thing of this robot.
        """
        mend = faults.begin(self, fault)
        self._begun = [one for one in self._begun if one[1].is_on] + [(fault, mend)]
        self._look_ahead()
        if fault.until_s is not None:
            self._plan(self.t_ns / NS + fault.until_s - fault.at_s, mend)

        def end() -> None:
            mend()
            self._look_ahead()

        return end

    @property
    def faults_on(self) -> list[Fault]:
        """The faults that are on and can be ended, of the scene too, the newest last."""
        return [fault for fault, mend in self._begun if mend.is_on]

    def mend(self, fault: Fault) -> bool:
        """End what is on of the same faults, whenever they would end; whether there were any."""
        mends = [mend for one, mend in self._begun if mend.is_on and faults.is_same(one, fault)]
        for mend in mends:
            mend()
        self._look_ahead()
        return bool(mends)

    def _happen(self, number: int, fault: Fault) -> None:
        """Let a fault of the scene begin, unless another one has unplugged what it is of."""
        try:
            self.inject(fault)
        except ConfigurationError as error:
            log.warning("fault[%d] %s does not happen: %s", number, fault.name, error)

    def _plan(self, at_s: float, action: Callable[[], object]) -> None:
        self._planned += 1
        heappush(self._agenda, (round(at_s * NS), self._planned, action))

    def rewire(self, board: int, chip_of_slot: Ints) -> None:
        """Plug other chips into the slots of a board, intp[20]."""
        self.converters.rewire(board, chip_of_slot)
        self._boards[board].version += 1

    def pass_on(self, taxels: slice) -> None:
        """Set what the chips of some taxels measure, at once."""
        self._gather(np.unique(self.layout.triangle_of[taxels]).astype(np.intp))
        self._pass_on()
        # What is held now may be felt too.
        self._felt_taxels = np.zeros(0, np.intp)
        self._gather(self._felt_taxels)

    def work_out_now(self) -> None:
        """Something changed that the mechanics must take up at once."""
        self._skin_due_ns = self.t_ns

    # ------------------------------------------------------------------ save and restore

    def save(self) -> bytes:
        """The whole robot as it is now: two robots restored from it do the same from here on."""
        return state.save(self, (self.settings, self.layout))

    @staticmethod
    def restore(data: bytes, settings: Settings, layout: Layout) -> "Robot":
        """The robot that was saved, with the settings and layout that it had.

        Raises:
            StateError: not a saved robot, or one of another configuration or version.
        """
        robot = state.restore(data, (settings, layout))
        if not isinstance(robot, Robot):
            raise StateError("the state is not of a robot; save it again")
        return robot

    def write(self, path: Path) -> None:
        """Save the robot to a file, whole or not at all.

        Raises:
            OSError: the file cannot be written.
        """
        write_atomic(path, self.save())

    @staticmethod
    def read(path: Path, settings: Settings, layout: Layout) -> "Robot":
        """The robot that was written to a file.

        Raises:
            StateError: as `restore`; the message names the file.
        """
        try:
            return Robot.restore(state.read(path), settings, layout)
        except StateError as error:
            raise StateError(f"{path}: {error}") from None

    # ------------------------------------------------------------------ truth

    def true_pressure_kpa(self, part: str) -> Floats:
        """True pressure on each taxel of a part now, float64[n], mean over the pad (kPa)."""
        found = self.layout.part(part)
        return self.skin.true_pressure_kpa()[found.start : found.stop]

    def _skin_force_n(self) -> dict[int, float]:
        """Force (N) of each of the scene's probes on the skin, by its number in the scene."""
        numbers = self.skin.numbers
        forces = self.skin.contact_force_n()
        return {numbers[i]: force_n for i, force_n in forces.items() if i < len(numbers)}

    def _stack_sizes(self, bus: str) -> "_StackSizes":
        return _StackSizes(
            [board for number, board in enumerate(self._boards) if self._bus_of[number] == bus]
        )


class LiveProbe:
    """A probe in a program's hand, see `Robot.touch`.

    Args:
        robot: that it touches.
        number: among the probes on its skin; None on a fingertip without skin.
    """

    def __init__(self, robot: Robot, number: int | None) -> None:
        self._robot = robot
        self._number = number
        self._drive_n = 0.0
        self._pull_n: float | None = None

    def press(self, drive: float, x_mm: float = 0.0, y_mm: float = 0.0) -> None:
        """Press from now on with a force (N), or to a depth (mm) if it is driven by depth; on skin
        also off its place. Below 0 it does not touch. No probe goes deeper than the foam lets it,
        `foam.MOST_STRAIN`.

        Raises:
            RequestError: one of them is no number that a scene may have.
        """
        _check_numbers(drive=drive, x_mm=x_mm, y_mm=y_mm)
        if self._number is None:
            self._drive_n = max(drive, 0.0)
            return
        self._robot.skin.set_live(self._number, drive, x_mm, y_mm)
        self._robot.work_out_now()

    def pull(self, force_n: float) -> None:
        """Pull an object that hangs on it along the surface from now on, until it is lifted; only a
        force/torque board feels that.

        Raises:
            RequestError: it is no number that a scene may have.
        """
        _check_numbers(force_n=force_n)
        self._pull_n = force_n

    def lift(self) -> None:
        """Take it off the skin."""
        self._pull_n = None
        self.press(0.0)

    @property
    def force_n(self) -> float:
        """Force on it at the last step of the mechanics; 0 off the skin."""
        return self.pressing_n()

    def pressing_n(self) -> float:
        """Return `force_n`."""
        if self._number is None:
            return self._drive_n
        return self._robot.skin.contact_force_n().get(self._number, 0.0)

    def pulling_n(self) -> float | None:
        """Return the pull; None if nothing hangs on it."""
        return self._pull_n


def _check_numbers(**numbers: float) -> None:
    """Refuse what a scene may not have either."""
    for name, seen in numbers.items():
        if not abs(seen) <= LARGEST:
            raise RequestError(
                f"{name}: seen {seen:g}, wanted a number between -{LARGEST:g} and {LARGEST:g}"
            )


class _StackSizes:
    """For each sender on a bus whether its transmit queue is a stack."""

    def __init__(self, boards: list[Mtb]) -> None:
        self._boards = boards

    def __call__(self, address: int) -> int | None:
        for board in self._boards:
            if board.address == address:
                return board.stack_size
        return None


def _host_between_ns(clock: EmulatedTime, begin_ns: int, end_ns: int) -> int:
    """Return the host's time between two emulated times: a host measures silence in its own."""
    begin, end = clock.host_ns(np.array([begin_ns, end_ns])).tolist()
    return int(end - begin)
