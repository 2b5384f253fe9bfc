"""The composition root: opens the buses, wires the rooms, owns the loop, nothing else."""

import asyncio
import logging
import time
from pathlib import Path

import msgspec

from skin_host import __version__, metrics, service
from skin_host.bus.protocol import FrameBatch
from skin_host.calibrate import calibration_path, collect
from skin_host.control import Control
from skin_host.engine import Engine, Step
from skin_host.errors import ConfigurationError, RequestError, SkinError
from skin_host.fingertip.desk import FingertipDesk
from skin_host.fingertip.health import FingertipRecord
from skin_host.health import Health, Record
from skin_host.health.telling import Teller
from skin_host.layout import Layout, build_layout, parts_of
from skin_host.link import Link
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration import Calibration
from skin_host.publish.info import CalibrationInfo, NodeInfo, node_info
from skin_host.publish.mqtt import Publisher
from skin_host.settings import Settings, load, skin_hash
from skin_host.state import State, Thresholds, load_state, save_state

log = logging.getLogger(__name__)

#: Health is looked at this often, and published at once when something changes ...
LOOK_S = 0.1
#: ... else this often.
HEALTH_S = 1.0
#: What is no news while a calibration is being taken.
_UNTIL_CALIBRATED = {"part_not_calibrated", "fingertip_not_calibrated"}
#: Readiness is told after the first sweeps, or after so long without.
PATIENCE_S = 3.0


class Daemon:
    """One node of one robot: its share of the buses, boards and parts.

    Args:
        settings: the configuration.
        layout: its skin.
        node: which parts are ours.
        calibration: to start with; None takes one as soon as the boards send.
        folder: where relative file names in the settings start.
        configuration: the file that `reload` reads again.

    Attributes:
        settings, layout: in use, with the changes that operators made.
        thresholds: these changes.

    Raises:
        ConfigurationError: no part belongs to this node.
        BusError: a bus cannot be opened.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        node: str = "main",
        calibration: Calibration | None = None,
        folder: Path = Path(),
        configuration: Path | None = None,
    ) -> None:
        self.settings = settings
        self.layout = layout
        self._node = node
        self._configuration = configuration
        state = load_state(self._state_path())
        self._configured_touch = settings.processing.touch
        self.thresholds = state.thresholds
        settings.processing.touch = state.thresholds.over(self._configured_touch)
        self.engine = Engine(settings, layout, parts_of(layout, node), calibration)
        self.engine.disabled = {
            i for i in self.engine.parts if layout.parts[i].name in state.disabled
        }
        self.engine.touch_only = {
            i for i in self.engine.parts if not settings.parts[layout.parts[i].name].frames
        }
        self.health = Health(self.engine)
        self.control = Control(self)
        self.publisher = Publisher(
            settings.mqtt, layout.robot, node, handler=self.control.handle, folder=folder
        )
        self.publisher.put_info(self._info())
        self.fingertips = FingertipDesk(self.engine.fingertips, self.publisher)
        self.link = Link(self.engine)
        self._calibration_lock = asyncio.Lock()
        self._feed_s = service.watchdog_interval_s()
        self._fed_s = 0.0
        self._status_s = 0.0
        self._teller = Teller()

    async def run(self, stop: asyncio.Event, *, calibrate: bool = False) -> None:
        """Work until `stop` is set; then end every touch, stop the boards, say goodbye.

        Args:
            stop: set it to end.
            calibrate: take a calibration at the start even if there is one.
        """
        try:
            async with self.publisher:
                await self._work(stop, calibrate)
        finally:
            self.control.close()
            self.link.close()

    async def _work(self, stop: asyncio.Event, calibrate: bool) -> None:
        tasks = [
            asyncio.create_task(self.link.read(self._deliver, self._record), name="read"),
            asyncio.create_task(self._start(calibrate), name="start"),
            asyncio.create_task(self._housekeep(), name="housekeeping"),
        ]
        if self.settings.service.metrics_port:
            serving = metrics.serve(self.settings.service.metrics_port, self.status)
            tasks.append(asyncio.create_task(serving, name="metrics"))
        stopping = asyncio.create_task(stop.wait(), name="stop")
        try:
            await _first_failure(tasks, stopping)
        finally:
            service.notify("STOPPING=1")
            for task in [*tasks, stopping]:
                task.cancel()
            await asyncio.gather(*tasks, stopping, return_exceptions=True)
            for part in self.engine.parts:
                self._end_contacts(part)
            self.fingertips.end(time.time_ns())
            await self.link.stop()

    async def calibrate(self, seconds: float, boards: list[int] | None = None) -> Calibration:
        """Take a calibration, use it from then on, and keep it.

        Args:
            seconds: how long to look at the untouched skin.
            boards: indices of those whose taxels are calibrated; all if not given.

        Raises:
            SkinError: another one is being taken, or no data came.
        """
        if self._calibration_lock.locked():
            raise SkinError("a calibration is being taken already; wait for it to end")
        async with self._calibration_lock:
            log.info("calibrating for %g s: keep the skin untouched", seconds)
            found = await collect(self.engine, seconds)
            known = self.engine.calibration
            if known is not None:
                chosen = self.engine.boards if boards is None else boards
                found = calibrations.merge(
                    known, found, self.engine.taxels_of(chosen), zeros=boards is None
                )
            path = calibration_path(self.settings, self._node)
            if known is None:
                found = calibrations.with_gains_of(found, path, self.layout)
            self.engine.use(found, boards)
            try:
                await asyncio.to_thread(calibrations.save, path, found, self.layout)
            except OSError as error:
                # The calibration is in use all the same; a restart will need a new one.
                log.error("calibration not kept: %s: %s", path, error.strerror)
            else:
                log.info("calibration %s kept in %s", found.id, path)
            self.publisher.put_info(self._info())
            return found

    def disable(self, part: int) -> None:
        """Publish nothing of a part from now on but its health."""
        self.engine.disabled.add(part)
        self._end_contacts(part)

    def set_thresholds(self, thresholds: Thresholds) -> None:
        """Decide touches by the configuration with these changes; baselines go on."""
        self.thresholds = thresholds
        self.settings.processing.touch = thresholds.over(self._configured_touch)
        self._renew_processing()

    async def configure(self, boards: list[int] | None = None) -> list[str]:
        """Send boards (indices; all if not given) their set-up again; return their names.

        Raises:
            BusError: a bus does not take frames.
        """
        chosen = self.engine.boards if boards is None else boards
        await self.link.set_up(chosen)
        return [self.layout.boards[board].name for board in chosen]

    async def reload(self) -> None:
        """Read the configuration file again and send it to the boards.

        What concerns processing and the set-up of boards takes effect; the calibration stays.

        Raises:
            RequestError: the file is wrong, or changes what only a restart can change; then
                everything goes on as before.
        """
        if self._configuration is None:
            raise RequestError("started without a configuration file: nothing to read again")
        settings = load(self._configuration)
        try:
            layout = build_layout(settings, self._configuration.parent)
        except ConfigurationError as error:
            raise ConfigurationError(f"{self._configuration}: {error}") from None
        for what, new, old in (
            (
                "robot, boards' addresses, parts or triangles",
                skin_hash(settings),
                self.engine.configuration,
            ),
            ("buses", settings.buses, self.settings.buses),
            ("fingertips", settings.fingertips, self.settings.fingertips),
            ("mqtt", settings.mqtt, self.settings.mqtt),
            ("service", settings.service, self.settings.service),
            ("receive", settings.receive, self.settings.receive),
            (
                "periods of boards",
                [board.settings.period_ms for board in layout.boards],
                [board.settings.period_ms for board in self.layout.boards],
            ),
        ):
            if new != old:
                raise RequestError(f"{self._configuration}: {what} changed; that needs a restart")
        self._configured_touch = settings.processing.touch
        self.settings.processing = settings.processing
        self.set_thresholds(self.thresholds)
        log.info("%s read again; the boards are set up anew", self._configuration)
        await self.configure()
        self.publisher.put_info(self._info())

    def keep(self, state: State) -> None:
        """Write what operators changed to the state directory.

        Raises:
            OSError: it cannot be written.
        """
        save_state(self._state_path(), state)

    def records(self) -> dict[str, Record]:
        """The health record of every part, as it is now."""
        return {self.layout.parts[part].name: self._record_of(part) for part in self.engine.parts}

    def status(self) -> dict[str, Record | FingertipRecord]:
        """The same with the fingertips on force/torque boards."""
        return {**self.records(), **self.fingertips.records(self.link.read_ns)}

    def _renew_processing(self) -> None:
        for part in self.engine.parts:
            self._end_contacts(part)
        self.engine.renew()

    def _end_contacts(self, part: int) -> None:
        for event in self.engine.end_part(part, time.time_ns()):
            self.publisher.put_touch(event)
        self.publisher.put_contact(self.layout.parts[part].name, touched=False)

    async def _start(self, calibrate: bool) -> None:
        """Bring the boards up, then calibrate if need be."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._say_ready())
            await self.link.bring_up()
        while calibrate or self.engine.calibration is None:
            try:
                await self.calibrate(self.settings.processing.calibration.seconds)
                break
            except SkinError as error:
                log.warning("%s", error)
        await asyncio.Event().wait()

    async def _say_ready(self) -> None:
        """Ready is: buses open, first sweeps or some patience. A dead bus is told by health."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.link.all_alive():
            if time.monotonic() > deadline_s:
                break
            await asyncio.sleep(0.05)
        service.notify("READY=1")

    def _deliver(self, steps: list[Step]) -> None:
        self.fingertips.deliver()
        self.health.note_sweeps(self.engine.sweeps)
        # Touches first: they leave before the frames are encoded.
        for step in steps:
            for event in step.events:
                self.publisher.put_touch(event)
        for step in steps:
            self.health.note_step(step)
            self.publisher.put_contact(step.frame.part, touched=bool(step.frame.touched.any()))
            if step.part not in self.engine.touch_only:
                self.publisher.put_frame(step.frame)
        # systemd's dog is fed here and nowhere else: after work that was done.
        now_s = time.monotonic()
        if self._feed_s is not None and now_s - self._fed_s > 0.5 * self._feed_s:
            self._fed_s = now_s
            service.notify("WATCHDOG=1")

    def _record(self, bus: str, batch: FrameBatch) -> None:
        if self.control.recorder is not None:
            self.control.recorder.put(self.settings.buses[bus].channel, batch)

    async def _housekeep(self) -> None:
        """Look after the boards, publish health, tell of faults, set the status line."""
        said: dict[int, tuple[object, ...]] = {}
        said_s = dict.fromkeys(self.engine.parts, 0.0)
        while True:
            await asyncio.sleep(LOOK_S)
            self.link.supervise()
            now_s = time.monotonic()
            self.health.tick(self.link.read_ns, self.link.ports, self.link.boards)
            told = self.fingertips.tell(self.link.read_ns)
            for part in self.engine.parts:
                await asyncio.sleep(0)  # the reader is not to wait for all parts
                record = self._record_of(part)
                told |= {
                    (fault["code"], fault["where"]): says
                    for fault, says in zip(record["faults"], record["sentences"], strict=True)
                }
                # Not the sentences: numbers in them change all the time.
                state = (record["state"], {(one["code"], one["where"]) for one in record["faults"]})
                if said.get(part) != state or now_s - said_s[part] >= HEALTH_S:
                    said[part], said_s[part] = state, now_s
                    self.publisher.put_health(self.layout.parts[part].name, record)
            if self.engine.calibrating:
                told = {key: says for key, says in told.items() if key[0] not in _UNTIL_CALIBRATED}
            self._teller.look(told, now_s)
            if now_s - self._status_s >= HEALTH_S:
                self._status_s = now_s
                service.notify("STATUS=" + self._status(len(told)))

    def _record_of(self, part: int) -> Record:
        link = self.link
        output = msgspec.to_builtins(self.publisher.counters)
        return self.health.record(part, link.read_ns, link.ports, link.boards, output)

    def _status(self, faults: int) -> str:
        rates = self.health.rates()
        dropped = sum(port.counters.dropped for port in self.link.ports.values())
        broker = "connected" if self.publisher.counters.connected else "away"
        return (
            f"{rates['frames_hz']:.0f} frames/s, {rates['sweeps_hz']:.1f} sweeps/s, "
            f"{dropped} dropped, {faults} faults, broker {broker}"
        )

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
            fingertips=self.settings.fingertips,
        )

    def _state_path(self) -> Path:
        directory = service.state_directory(self.settings.service.state_directory)
        return directory / f"{self.settings.robot}-{self._node}.state.json"


async def _first_failure(tasks: list[asyncio.Task[None]], stopping: "asyncio.Task[bool]") -> None:
    """Wait for the order to stop. A task that fails before it takes the daemon down with it."""
    done, _ = await asyncio.wait([*tasks, stopping], return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        if task is not stopping:
            task.result()
            raise SkinError(f"the task {task.get_name()} ended by itself")
