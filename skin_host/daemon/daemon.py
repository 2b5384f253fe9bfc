"""The composition root: opens the buses, connects the components, and owns the loop."""

import asyncio
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host import __version__
from skin_host.bus.opening import open_port
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Settings, load, needs_restart, skin_hash
from skin_host.daemon import metrics, service
from skin_host.daemon.calibrate import collect
from skin_host.daemon.control import Control
from skin_host.daemon.joining import NodeMemory
from skin_host.daemon.keeper import Keeper
from skin_host.daemon.link import Link, OpenPort
from skin_host.daemon.memory import remembered_with
from skin_host.daemon.state import Thresholds
from skin_host.daemon.zeros import go_on_from
from skin_host.errors import ConfigurationError, RequestError, SkinError, StateError
from skin_host.fingertip.health import FingertipRecord
from skin_host.fingertip.service import FingertipPublisher
from skin_host.health import FaultLog, HealthWatch, Record
from skin_host.health.diagnosis import named
from skin_host.layout import Layout, build_layout, parts_of
from skin_host.mqtt.commands import ENDING
from skin_host.mqtt.connection import connect
from skin_host.mqtt.contact import PartContact, use_measurements
from skin_host.mqtt.info import CalibrationInfo, NodeInfo, node_info
from skin_host.mqtt.publisher import Connect, Publisher
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration import Calibration, Verdict, by_part
from skin_host.processing.calibration.calibrator import going_on
from skin_host.processing.calibration.run import SHORTEST_S
from skin_host.processing.core import Engine, Output
from skin_host.tasks import cancel

log = logging.getLogger(__name__)

#: Health is computed this often, and published at once when something changes ...
LOOK_S = 0.1
#: ... otherwise this often.
HEALTH_S = 1.0
#: Faults that are expected while a calibration is being taken.
_UNTIL_CALIBRATED = {"part_not_calibrated", "fingertip_not_calibrated"}
#: Readiness is reported after the first sweeps, or after this time without them.
PATIENCE_S = 3.0


class Daemon:
    """One node of one robot: its share of the buses, boards and parts.

    Args:
        settings: the configuration.
        layout: its skin.
        node: which parts are ours.
        calibration: to start with; None takes one as soon as the boards send.
        folder: relative file names in the settings start from here.
        configuration: the file that `reload` reads again.
        clock: for time, waiting and threads.
        open_port: opens buses, see `bus.opening.open_port`.
        connect: connects to the broker, see `mqtt.connection.connect`.
        share: makes of a configuration that was read again the one of this daemon, see
            `workers.share_of`.
        log_lines_lost: how many lines of the log nobody could read so far.
        memory: what the node remembers, with its calibration in place of the other one; by default
            what its own files hold besides that.

    Attributes:
        settings, layout: in use, with the changes that operators made.
        thresholds: these changes.
        keeper: of its files.

    Raises:
        ConfigurationError: no part belongs to this node, or python-can does not know the kind
            of a bus.
        OtherRobotError, NewerFileError, BusyFileError: files of the state directory cannot be used,
            see `memory.remembered`.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        node: str = "main",
        calibration: Calibration | None = None,
        folder: Path = Path(),
        configuration: Path | None = None,
        clock: Clock = SYSTEM,
        open_port: OpenPort = open_port,
        connect: Connect = connect,
        share: Callable[[Settings], Settings] = lambda settings: settings,
        log_lines_lost: Callable[[], int] = lambda: 0,
        memory: NodeMemory | None = None,
    ) -> None:
        self.clock = clock
        self._log_lines_lost = log_lines_lost
        self._share = share
        self.settings = settings
        self.layout = layout
        self._node = node
        self._configuration = configuration
        memory = memory or remembered_with(settings, layout, node, calibration)
        calibration, state = memory.calibration, memory.state
        self._configured = settings
        self.thresholds = state.thresholds
        self.settings = settings = state.thresholds.over_settings(settings)
        self.engine = Engine(settings, layout, parts_of(layout, node), calibration)
        self.engine.disabled = {
            i for i in self.engine.parts if layout.parts[i].name in state.disabled
        }
        self.engine.touch_only = _touch_only(settings, layout, self.engine.parts)
        doubted = go_on_from(memory.zeros, self.engine)
        self.keeper = Keeper(self.engine, node, memory, clock)
        self.health = HealthWatch(self.engine)
        self.control = Control(self)
        self.publisher = Publisher(
            settings.mqtt,
            layout.robot,
            node,
            handler=self.control.handle,
            folder=folder,
            clock=clock,
            connect=connect,
        )
        self._put_info(self._info())
        self._contacts = {i: PartContact(layout, i) for i in self.engine.parts}
        use_measurements(self._contacts, self.engine)
        for i in self.engine.parts:
            # The state that the broker retained from an earlier start is no longer known.
            self.publisher.put_contact(layout.parts[i].name, "UNKNOWN")
        self._doubt_contacts(doubted, self.engine.parts)
        self.fingertips = FingertipPublisher(self.engine.fingertips, self.publisher)
        self.link = Link(self.engine, wait=True, open_port=open_port, clock=clock)
        self._calibration_lock = asyncio.Lock()
        self._reloading = asyncio.Lock()
        #: How many reloads have begun, and why the last one failed.
        self._reloads = 0
        self._not_reloaded: SkinError | None = None
        #: Why no calibration could be taken that nobody asked for.
        self._not_calibrated = ""
        self._is_ending = False
        self._feed_s = service.watchdog_interval_s()
        self._fed_s = 0.0
        self._status_s = 0.0
        self._fault_log = FaultLog()
        #: Which change of what is known of zeros the contacts know.
        self._zero_changes = self.engine.zeros.changes

    async def run(self, stop: asyncio.Event, *, calibrate: bool = False) -> None:
        """Run until `stop` is set and what was received by then is processed; then end every touch,
        stop the boards and disconnect.

        Args:
            stop: set it to end.
            calibrate: take a calibration at the start even if there is one.
        """
        self._log_thresholds()
        try:
            async with self.publisher:
                await self._work(stop, calibrate)
        finally:
            await self.control.close()
            self.link.close()

    async def _work(self, stop: asyncio.Event, calibrate: bool) -> None:
        tasks = [
            asyncio.create_task(
                self.link.read(self._deliver, self._record, self.publisher.together), name="read"
            ),
            asyncio.create_task(self._start(calibrate), name="start"),
            asyncio.create_task(self._housekeep(), name="housekeeping"),
            asyncio.create_task(self.keeper.keep_again(), name="keep again"),
        ]
        if self.settings.service.metrics_port:
            serving = metrics.serve(self.settings.service.metrics_port, self.status, self.clock)
            tasks.append(asyncio.create_task(serving, name="metrics"))
        stopping = asyncio.create_task(self._stopped(stop), name="stop")
        try:
            await _first_failure(tasks, stopping)
        finally:
            service.notify("STOPPING=1")
            self._is_ending = True
            # What a command changes now would not be kept, and no board stopped that it sets up.
            await self.publisher.end_commands()
            await cancel(*tasks, stopping)
            # Nothing is felt from now on, however long the disk takes.
            for part in self.engine.parts:
                self._end_contacts(part)
            self.fingertips.end(self.clock.now_ns())
            await self.keeper.end()
            await self.link.stop()

    async def _stopped(self, stop: asyncio.Event) -> None:
        """Wait for the stop request, and until what came before it was read and counted."""
        await stop.wait()
        await self.link.catch_up()

    async def calibrate(self, seconds: float, boards: list[int] | None = None) -> Calibration:
        """Take a calibration, use it from then on, and store it.

        Args:
            seconds: how long to observe the untouched skin at least.
            boards: indices of those whose taxels are calibrated; all by default.

        Raises:
            StateError: another one is being taken, or another program is writing the file.
            NewerFileError: a newer version has written it.
            OtherRobotError: it is another robot's.
            SkinError: no data came.
        """
        if self._calibration_lock.locked():
            raise StateError("a calibration is being taken already; wait for it to end")
        async with self._calibration_lock:
            # Gains and curves are the file's: another program may have fitted them meanwhile.
            before = await self.keeper.stored()
            log.info("calibrating for %g s: keep the skin untouched", max(seconds, SHORTEST_S))
            found = await collect(lambda: self.engine, seconds, clock=self.clock)
            known = self.engine.calibration
            if known is not None:
                chosen = self.engine.boards if boards is None else boards
                found = calibrations.merge(
                    known, found, self.engine.layout.taxels_of(chosen), zeros=boards is None
                )
            if before is not None:
                if known is None:
                    # What was known of boards that do not send goes on, as with `skin calibrate`.
                    found = going_on(found, self.keeper.known(before))
                    found = calibrations.with_zeros(found, before.zeros | found.zeros)
                found = calibrations.with_pressures_of(found, before)
            for name, taxels in calibrations.unchanged(found, self.layout).items():
                log.warning("%s of %s: not calibrated, received too rarely", named(taxels), name)
            for name, taxels in calibrations.damaged(found, self.layout).items():
                log.warning("%s of %s: calibrated without damaged bytes", named(taxels), name)
            doubted = self.engine.zeros.at_risk(touched=False)
            measured = self.layout.taxels_of(self.engine.boards if boards is None else boards)
            hidden = self.engine.zeros.pressed() & measured & (found.verdict == Verdict.TOUCHED)
            for name, taxels in by_part(hidden, self.layout).items():
                log.warning(
                    "%s of %s: touched when the board was zeroed, and nothing has shown that this "
                    "is over",
                    named(taxels),
                    name,
                )
            self.engine.use(found, boards)
            use_measurements(self._contacts, self.engine)
            for contact, stuck in self._contacts_of(self.engine.stuck() & measured):
                contact.stop_waiting(stuck)
            # The other boards keep their zeros.
            former = known if boards is not None else None
            await self.keeper.keep_calibration(measured, former, doubted)
            self._put_info(await self.clock.in_thread(self._info))
            return found

    def disable(self, part: int) -> None:
        """Publish only the health of a part from now on."""
        self.engine.disabled.add(part)
        self._end_contacts(part)

    def enable(self, part: int) -> None:
        """Publish everything of a part again."""
        self.engine.disabled.discard(part)
        # What pressed the part meanwhile may be in a board's new zero, or under a pad that failed.
        zeros = self.engine.zeros
        self._doubt_contacts(zeros.may_be_touched() | zeros.at_risk(touched=True), [part])

    def set_thresholds(self, thresholds: Thresholds) -> None:
        """Apply these changes to the configured touch thresholds; baselines are kept.

        Raises:
            RequestError: no reading of some taxels would be a touch any more.
        """
        touch = thresholds.over(self._configured.processing.touch)
        unreached = by_part(self.engine.unreached(touch), self.layout)
        if unreached:
            where = ", ".join(f"{named(taxels)} of {name}" for name, taxels in unreached.items())
            raise RequestError(
                f"margin_units = {touch.margin_units:g}, minimum_threshold_units = "
                f"{touch.minimum_threshold_units:g}: no press would be felt by {where}, whose "
                "readings end before; wanted smaller ones"
            )
        self.thresholds = thresholds
        self._swap(self._configured, self.layout)

    async def configure(self, boards: list[int] | None = None) -> list[str]:
        """Send boards (indices; all by default) their set-up again; return their names.

        Raises:
            BusError: a bus does not take frames.
            StateError: the daemon is ending: it would not stop them again.
        """
        if self._is_ending:
            raise StateError(ENDING)
        chosen = self.engine.boards if boards is None else boards
        await self.link.set_up(chosen)
        return [self.layout.boards[board].name for board in chosen]

    @property
    def is_reloading(self) -> bool:
        """Whether the configuration is being read again and used."""
        return self._reloading.locked()

    async def reload(self) -> None:
        """Read the configuration file again and use it.

        The boards are not set up again: what they are sent changes by a restart only, and would
        take what touches them for their zero. The calibration stays, too. Requests that come during
        a reload share the next one.

        Raises:
            RequestError: the file is wrong, or changes what only a restart can change; then nothing
                changes.
        """
        begun = self._reloads
        async with self._reloading:
            if self._reloads == begun:
                self._reloads += 1
                self._not_reloaded = None
                try:
                    await self._reload()
                except SkinError as error:
                    self._not_reloaded = error
                except Exception as error:
                    # A file that the checks have let pass; the engine in use goes on.
                    log.exception("reload failed")
                    self._not_reloaded = RequestError(
                        f"{self._configuration} cannot be used: {type(error).__name__}: {error}; "
                        "see the log"
                    )
            if self._not_reloaded is not None:
                raise self._not_reloaded

    async def _reload(self) -> None:
        if self._configuration is None:
            raise RequestError("started without a configuration file: nothing to read again")
        settings = self._share(await self.clock.in_thread(load, self._configuration))
        try:
            layout = await self.clock.in_thread(build_layout, settings, self._configuration.parent)
        except ConfigurationError as error:
            raise ConfigurationError(f"{self._configuration}: {error}") from None
        what = needs_restart(self._configured, settings)
        if what is not None:
            raise RequestError(f"{self._configuration}: {what} changed; that needs a restart")
        self._swap(settings, layout)
        self._configured = settings
        log.info("%s read again", self._configuration)
        self._log_thresholds()
        self._put_info(await self.clock.in_thread(self._info))

    def _log_thresholds(self) -> None:
        """Log which thresholds an operator has changed: those of the configuration do nothing."""
        configured = msgspec.structs.asdict(self._configured.processing.touch)
        changes = [
            f"{key} = {value:g}"
            for key, value in msgspec.structs.asdict(self.thresholds).items()
            if value not in (None, configured[key])
        ]
        if changes:
            log.info(
                "%s: set by an operator, in place of the configuration's; `skin command thresholds "
                "--reset` ends that",
                ", ".join(changes),
            )

    def records(self) -> dict[str, Record]:
        """The health record of every part, as it is now."""
        return {self.layout.parts[part].name: self._record_of(part) for part in self.engine.parts}

    def status(self) -> dict[str, Record | FingertipRecord]:
        """The same with the fingertips on force/torque boards."""
        return {**self.records(), **self.fingertips.records(self.link.read_ns)}

    def _swap(self, configured: Settings, layout: Layout) -> None:
        """Replace the engine by one with other settings, which continues its state."""
        settings = self.thresholds.over_settings(configured)
        engine = Engine(settings, layout, self.engine.parts, after=self.engine)
        engine.touch_only = _touch_only(settings, layout, engine.parts)
        self.settings, self.layout, self.engine = settings, layout, engine
        self.link.use(engine)
        self.health.use(engine)
        self.keeper.use(engine)
        use_measurements(self._contacts, self.engine)

    def _doubt_contacts(self, taxels: NDArray[np.bool_], parts: list[int]) -> None:
        """Something may touch these taxels of some parts, bool[n], whose zero is not known."""
        for contact, doubted in self._contacts_of(taxels, parts):
            contact.doubt(doubted)

    def _contacts_of(
        self, taxels: NDArray[np.bool_], parts: Sequence[int] | None = None
    ) -> Iterator[tuple[PartContact, NDArray[np.bool_]]]:
        """Yield the contacts of some parts, all by default, each with its own of taxels bool[n]."""
        for index in self._contacts if parts is None else parts:
            part = self.layout.parts[index]
            yield self._contacts[index], taxels[part.start : part.stop]

    def _note_unread(self) -> None:
        """Nothing was read for a while: no part is known to be untouched."""
        for part, contact in self._contacts.items():
            if part not in self.engine.disabled:
                self.publisher.put_contact(self.layout.parts[part].name, contact.unread())
        self.fingertips.deliver((), unread=True)

    def _end_contacts(self, part: int) -> None:
        events = self.engine.end_part(part, self.clock.now_ns())
        for event in events:
            self.publisher.put_touch(event)
        self.publisher.put_contact(self.layout.parts[part].name, self._contacts[part].stop(events))

    async def _start(self, calibrate: bool) -> None:
        """Bring the boards up, and calibrate what no calibration has measured; none waits for one
        that is away.
        """
        async with asyncio.TaskGroup() as group:
            ready = group.create_task(self._report_ready())
            group.create_task(self.link.bring_up())
            if calibrate or self.engine.calibration is None:
                await self.link.until_set_up()
                await ready
                while calibrate or self.engine.calibration is None:
                    if await self._try_to_calibrate():
                        break
                    await self._until_received()
            await self._calibrate_late()
        await asyncio.Event().wait()

    async def _until_received(self) -> None:
        """Wait until a board sends: before there is nothing to calibrate, nor to report again."""
        before = self.engine.ledger.sweeps.copy()
        while not (self.engine.ledger.sweeps > before).any():
            await self.clock.sleep(LOOK_S)

    async def _calibrate_late(self) -> None:
        """Calibrate boards that no calibration has measured once they send, unless somebody does.

        One that could not be calibrated then is tried again when it has been set up or away.
        """
        tried: set[tuple[int, int]] = set()
        while self._unmeasured():
            await self.clock.sleep(HEALTH_S)
            sending = {(one, n) for one in self._unmeasured() if (n := self.link.set_ups(one))}
            tried &= sending
            if sending - tried and not self._calibration_lock.locked():
                tried |= sending
                await self._try_to_calibrate(sorted(board for board, _ in sending))

    def _unmeasured(self) -> list[int]:
        """Return the boards of which the calibration in use has measured no taxel."""
        assert self.engine.calibration is not None
        measured = self.engine.calibration.verdict < Verdict.ABSENT
        boards, taxels_of = self.engine.boards, self.layout.taxels_of
        return [board for board in boards if not (measured & taxels_of([board])).any()]

    async def _try_to_calibrate(self, boards: list[int] | None = None) -> bool:
        """Calibrate all, or boards by their index, and return True; or log why not, unless that was
        logged last, and pause.
        """
        try:
            await self.control.calibrate(self.settings.processing.calibration.seconds, boards)
        except SkinError as error:
            said, self._not_calibrated = self._not_calibrated, str(error)
            if said != self._not_calibrated:
                log.warning("%s", error)
            await self.clock.sleep(HEALTH_S)
            return False
        return True

    async def _report_ready(self) -> None:
        """Report readiness: buses open, and first sweeps or a timeout. Health reports a dead
        bus.
        """
        deadline_s = self.clock.monotonic_s() + PATIENCE_S
        while not self.link.all_alive():
            if self.clock.monotonic_s() > deadline_s:
                break
            await self.clock.sleep(0.05)
        service.notify("READY=1")

    def _deliver(self, output: Output) -> None:
        behind = self.link.is_behind
        if self.engine.fingertips is not None:
            self.fingertips.deliver(output.grasps, unread=behind)
        if output.steps:
            if self._zero_changes != self.engine.zeros.changes:
                # Something may press a pad whose zero was not found, did before it was held, or
                # was zeroed away and has shown that when it lifted.
                self._zero_changes = self.engine.zeros.changes
                use_measurements(self._contacts, self.engine)
                self._doubt_contacts(self.engine.zeros.may_be_touched(), self.engine.parts)
            # Touches leave before the frames are encoded, and each with its part's contact: that is
            # ON in a touch only, also where several frames of a part were read together.
            for step in output.steps:
                for event in step.events:
                    self.publisher.put_touch(event)
                state = self._contacts[step.part].step(step.frame, step.events)
                if not behind:
                    self.publisher.put_contact(step.frame.part, state)
            self.health.note(output)
            for step in output.steps:
                if step.part not in self.engine.touch_only:
                    if behind:
                        self.publisher.skip_frame()  # its pressures would look like those of now
                    else:
                        self.publisher.put_frame(step.frame)
        if behind:
            self._note_unread()
        # Notify systemd's watchdog only here, after work that was done.
        if self._feed_s is not None:
            now_s = self.clock.monotonic_s()
            if now_s - self._fed_s > 0.5 * self._feed_s:
                self._fed_s = now_s
                service.notify("WATCHDOG=1")

    def _record(self, bus: str, batch: FrameBatch) -> None:
        if self.control.recorder is not None:
            self.control.recorder.put(self.settings.buses[bus].channel, batch)

    async def _housekeep(self) -> None:
        """Supervise the boards, publish health, log faults, set the status line."""
        said: dict[int, tuple[object, ...]] = {}
        said_s = dict.fromkeys(self.engine.parts, 0.0)
        of_parts: dict[tuple[str, str], str] = {}
        pulse: tuple[object, ...] = ()
        while True:
            await self.clock.sleep(LOOK_S)
            if self.link.is_behind or self.link.is_overdue():
                self._note_unread()  # health would be of before, too
                continue
            self.link.supervise()
            now_s = self.clock.monotonic_s()
            self.keeper.look(now_s)
            link = self.link
            self.health.tick(link.read_ns, link.ports, link.boards, link.longest_pause_ns())
            told = self.fingertips.publish_health(self.link.read_ns)
            before, pulse = pulse, self._pulse()
            if pulse != before or now_s - min(said_s.values()) >= HEALTH_S:
                of_parts.clear()
                for part in self.engine.parts:
                    await self.clock.sleep(0)  # the reader must not wait for all parts
                    record = self._record_of(part)
                    of_parts |= {
                        (fault["code"], fault["where"]): says
                        for fault, says in zip(record["faults"], record["sentences"], strict=True)
                    }
                    # Without the sentences, because numbers in them change all the time.
                    faults = {(one["code"], one["where"]) for one in record["faults"]}
                    state = (record["state"], faults)
                    if said.get(part) != state or now_s - said_s[part] >= HEALTH_S:
                        said[part], said_s[part] = state, now_s
                        self.publisher.put_health(self.layout.parts[part].name, record)
            told |= of_parts
            if self._calibration_lock.locked():
                told = {key: says for key, says in told.items() if key[0] not in _UNTIL_CALIBRATED}
            self._fault_log.note(told, now_s)
            if now_s - self._status_s >= HEALTH_S:
                self._status_s = now_s
                service.notify("STATUS=" + self._status(len(told)))

    def _pulse(self) -> tuple[object, ...]:
        """Return a value that differs from the last one when a fault may have begun or ended."""
        output = self.publisher.counters
        return (
            *self.health.pulse(self.link.ports, self.link.boards),
            (output.connected, output.last_error, output.touches_dropped, output.refused),
            (tuple(output.withheld), tuple(output.unsubscribed)),
            (output.name_taken, tuple(self.keeper.unkept)),
        )

    def _record_of(self, part: int) -> Record:
        link = self.link
        output = msgspec.to_builtins(self.publisher.counters)
        record = self.health.record(
            part, link.read_ns, link.ports, link.boards, output, self.keeper.unkept
        )
        record["log_lines_lost"] = self._log_lines_lost()
        return record

    def _status(self, faults: int) -> str:
        rates = self.health.rates()
        dropped = sum(port.counters.dropped for port in self.link.ports.values())
        broker = "connected" if self.publisher.counters.connected else "away"
        return (
            f"{rates['frames_hz']:.0f} frames/s, {rates['sweeps_hz']:.1f} sweeps/s, "
            f"{dropped} dropped, {faults} faults, broker {broker}"
        )

    def _put_info(self, info: NodeInfo) -> None:
        names = {*self.settings.parts, *self.settings.fingertips}
        self.publisher.put_info(info, names.difference(info.parts, info.fingertips))

    def _info(self) -> NodeInfo:
        found = self.engine.calibration
        info = None if found is None else CalibrationInfo(found.id, found.time)
        return node_info(
            self.layout,
            self._node,
            version=__version__,
            configuration=skin_hash(self.settings),
            encoding=self.settings.mqtt.encoding,
            frame_hz=self.settings.mqtt.frame_hz,
            calibration=info,
            commands=self.settings.mqtt.commands,
            parts=self.settings.parts,
            fingertips=self.settings.fingertips,
        )


def _touch_only(settings: Settings, layout: Layout, parts: list[int]) -> set[int]:
    """Return those of some parts whose frames are not published."""
    return {i for i in parts if not settings.parts[layout.parts[i].name].frames}


async def _first_failure(tasks: list[asyncio.Task[None]], stopping: asyncio.Task[None]) -> None:
    """Wait for the stop request. A task that fails before it ends the daemon."""
    done, _ = await asyncio.wait([*tasks, stopping], return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        if task is not stopping:
            task.result()
            raise SkinError(f"the task {task.get_name()} ended by itself")
