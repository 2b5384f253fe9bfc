"""A daemon in a process of its own under the frames of a whole body, measured from inside.

`skin bench daemon` and `skin bench scale` run it beside mosquitto, a subscriber of all frames, one
of all touches, and senders.

Which room of the program takes the CPU: while the event loop is awake, a timer interrupts it once a
millisecond, at first after a random part of one; each time the innermost function of this project,
or of its MQTT libraries, names the room. A sample counts as much as the thread had a core since the
one before. It costs some 15 us and nothing between two, unlike a profiler that is called at each
function. (The kernel looks at timers on CPU time only with its own tick: that would be a hundred
samples in the time of a row.) The selector of the loop reports when it sleeps, and counts
what wakes it. All this takes a tenth of the daemon's CPU, so the CPU of the daemon is measured
before, without it.
"""

import asyncio
import gc
import logging
import multiprocessing
import random
import resource
import selectors
import signal
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS, TRIANGLES
from skin_host.config.settings import changed
from skin_host.daemon.daemon import Daemon
from skin_host.daemon.workers import share_name, share_of
from skin_host.errors import BrokerError, SkinError
from skin_host.evaluation.body_stream import Body, send_body
from skin_host.evaluation.stand_in import register
from skin_host.evaluation.touch_listener import listen
from skin_host.layout import build_layout
from skin_host.mqtt.broker import find_mosquitto, mosquitto_broker
from skin_host.processes import beside

#: Rooms by the beginning of a module's name; the first that fits counts.
ROOMS = {
    "skin_host.bus.assembler": "assembler",
    "skin_host.bus.classes": "assembler",
    "skin_host.bus.order": "assembler",
    "skin_host.bus.periods": "assembler",
    "skin_host.bus": "bus",
    "skin_host.daemon.link": "bus",
    "skin_host.clock": "bus",
    "skin_host.processing.intake": "intake",
    "skin_host.processing.liveness": "liveness",
    "skin_host.processing.stuck": "liveness",
    "skin_host.processing.contacts": "contacts",
    "skin_host.processing.localization": "contacts",
    "skin_host.processing.core": "daemon",
    "skin_host.processing": "pipeline",
    "skin_host.mqtt.frames": "encoding",
    "skin_host.mqtt": "mqtt",
    "aiomqtt": "mqtt",
    "paho": "mqtt",
    "skin_host.health": "health",
    "skin_host.evaluation": "",
    "skin_host": "daemon",
}
#: The event loop itself, and everything that runs outside of these rooms.
LOOP = "loop"
#: Falling asleep and waking up, in the kernel, and what other threads take.
SLEEP = "sleep"
#: Causes by the beginning of the module whose function is called; the first that fits counts.
_CAUSES = {
    "skin_host.bus": "plan",
    "skin_host.clock": "plan",
    "skin_host.mqtt": "mqtt",
    "aiomqtt": "mqtt",
    "asyncio": "thread",
}
#: A timer of the loop itself.
TIMER = "timer"
_INTERVAL_S = 0.001


TOUCHED = ("untouched", "hand", "all")
#: A hand of an iCub has about so many triangles.
HAND_TRIANGLES = 9
_CALIBRATION_S = 1.0
_PERIODS = 20


class RoomClock:
    """Samples the rooms in which the main thread of this process is while it is awake.

    Attributes:
        samples: what fell into each room since `begin`.
    """

    def __init__(self) -> None:
        self.samples: defaultdict[str, float] = defaultdict(float)
        self._rooms: dict[str, str] = {}
        self._counting = False
        self._began_s = 0.0
        self._woke_s = 0.0
        #: CPU time of the thread, and the time, at the last sample.
        self._sampled_s = 0.0, 0.0
        self._awake_s = 0.0

    def begin(self) -> None:
        """Count from now on."""
        self.samples.clear()
        signal.signal(signal.SIGALRM, self._sample)
        self._counting = True
        self._began_s = time.process_time()
        self._awake_s = 0.0
        self.wake()

    def end(self) -> dict[str, float]:
        """Stop counting; return the CPU time of each room, s, the largest first."""
        self.sleep()
        self._counting = False
        total = sum(self.samples.values()) or 1.0
        rooms = {room: self._awake_s * n / total for room, n in self.samples.items()}
        rooms[SLEEP] = time.process_time() - self._began_s - self._awake_s
        return dict(sorted(rooms.items(), key=lambda room: -room[1]))

    def wake(self) -> None:
        """The thread goes on."""
        if self._counting:
            self._woke_s = time.thread_time()
            self._sampled_s = self._woke_s, time.monotonic()
            # Turns are shorter than the interval: from their begin, none would reach their end.
            signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-6, _INTERVAL_S), _INTERVAL_S)

    def sleep(self) -> None:
        """The thread is about to wait."""
        if self._counting:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            self._awake_s += time.thread_time() - self._woke_s

    def _sample(self, _number: int, frame: FrameType | None) -> None:
        before_s, self._sampled_s = self._sampled_s, (time.thread_time(), time.monotonic())
        had_s, passed_s = (now - then for now, then in zip(self._sampled_s, before_s, strict=True))
        weight = min(1.0, had_s / max(passed_s, 1e-9))
        while frame is not None:
            module = frame.f_globals.get("__name__", "")
            room = self._rooms.get(module)
            if room is None:
                room = self._rooms[module] = room_of(module)
            if room:
                self.samples[room] += weight
                return
            frame = frame.f_back
        self.samples[LOOP] += weight


def room_of(module: str) -> str:
    for start, room in ROOMS.items():
        if module.startswith(start):
            return room
    return ""


class Wakeups(selectors.DefaultSelector):
    """A selector that counts how often its loop slept, by what ended the sleep.

    Attributes:
        counts: sleeps by cause. Turns of the loop between which it did not sleep are not counted.
        rooms: gets a call when the loop sleeps.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.rooms = RoomClock()

    def begin(self) -> None:
        """Count and sample from now on; before, this is a usual selector that costs no more."""
        self.counts.clear()
        vars(self)["select"] = self._counted_select
        self.rooms.begin()

    def end(self) -> dict[str, float]:
        """Stop counting; return the CPU time of each room, s, the largest first."""
        del vars(self)["select"]
        return self.rooms.end()

    def _counted_select(
        self, timeout: float | None = None
    ) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout == 0:
            return super().select(timeout)
        self.rooms.sleep()
        try:
            found = super().select(timeout)
        finally:
            self.rooms.wake()
        self.counts[_cause(found[0][0].data) if found else TIMER] += 1
        return found

    def runner(self) -> asyncio.Runner:
        """Runs coroutines in a loop with this selector."""
        return asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(self))


def _cause(handles: Any) -> str:
    callback = next(handle for handle in handles if handle is not None)._callback
    module = getattr(callback, "__module__", None) or type(callback).__module__
    return next((cause for start, cause in _CAUSES.items() if module.startswith(start)), module)


def scenes(body: Body) -> list[NDArray[np.uint8]]:
    """Untouched; a hand that rests on the first board; everything touched."""
    shape = (_PERIODS, body.boards, TRIANGLES, TAXELS)
    quiet = np.random.default_rng(0).integers(239, 242, shape)
    depth = 50.0 + 20.0 * np.sin(2 * np.pi * np.arange(_PERIODS) / _PERIODS)
    pressed = depth.astype(int)[:, None, None]
    hand, everything = quiet.copy(), quiet.copy()
    hand[:, 0, : min(HAND_TRIANGLES, body.triangles)] -= pressed
    everything -= pressed[..., None]
    return [scene.astype(np.uint8) for scene in (quiet, hand, everything)]


def run_daemon(
    parent: Connection,
    body: Body,
    broker_port: int,
    state: str,
    number: int = 1,
    shares: int = 1,
) -> None:
    """Process: `skin run`, measured on the parent's commands.

    Args:
        parent: sends `begin`, `end` (answered with figures of the time between), `sample`, `rooms`
            (answered with where the CPU of the time between went, and what woke the daemon) and
            `count` (answered with CAN frames read and dropped since the start).
        body: whose frames it reads.
        broker_port: of the broker on this machine.
        state: folder for what it keeps; the parent removes it, because this process is killed.
        number, shares: this is one of several workers, from 1.
    """
    register()
    logging.disable(logging.WARNING)  # no board of this stream answers commands
    settings = changed(
        body.settings(),
        {
            "mqtt.host": "127.0.0.1",
            "mqtt.port": broker_port,
            "processing.calibration.seconds": _CALIBRATION_S,
            "service.state_directory": state,
        },
    )
    node = "main"
    if shares > 1:
        settings, node = share_of(settings, node, number, shares), share_name(node, number)
    daemon = Daemon(settings, build_layout(settings, Path()), node)
    gc.freeze()  # as `skin run` does
    wakeups = Wakeups()
    with wakeups.runner() as runner:
        runner.run(_obey(parent, daemon, wakeups))


async def _obey(parent: Connection, daemon: Daemon, wakeups: Wakeups) -> None:
    began: list[tuple[float, ...]] = []

    def now() -> tuple[float, ...]:
        sleeps = resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw
        dropped = sum(port.counters.dropped for port in daemon.link.ports.values())
        counters = daemon.publisher.counters
        skipped = counters.frames_skipped
        return time.monotonic(), time.process_time(), _waited_s(), sleeps, dropped, skipped

    def figures() -> dict[str, float]:
        wall_s, cpu_s, waited_s, sleeps, dropped, skipped = (
            end - begin for end, begin in zip(now(), began[0], strict=True)
        )
        return {
            "cpu_percent": round(100 * cpu_s / wall_s, 2),
            "waited_percent": round(100 * waited_s / wall_s, 2),
            "wakeups_hz": round(sleeps / wall_s),
            "us_per_wakeup": round(1e6 * cpu_s / max(sleeps, 1)),
            "frames_dropped": dropped,
            "messages_skipped": skipped,
        }

    def rooms() -> dict[str, dict[str, float]]:
        by_room_s = wakeups.end()
        wall_s = time.monotonic() - began[0][0]
        total_s = sum(by_room_s.values())
        return {
            "by_room_share": {room: s / total_s for room, s in by_room_s.items()},
            "wakeups_by_cause_hz": {
                cause: round(n / wall_s, 1) for cause, n in wakeups.counts.most_common()
            },
        }

    def count() -> tuple[int, int]:
        counters = [port.counters for port in daemon.link.ports.values()]
        return sum(one.frames for one in counters), sum(one.dropped for one in counters)

    answers: dict[str, Callable[[], Any]] = {"end": figures, "rooms": rooms, "count": count}

    def order() -> None:
        wanted = parent.recv()
        if wanted in answers:
            parent.send(answers[wanted]())
            return
        began[:] = [now()]
        if wanted == "sample":
            wakeups.begin()

    asyncio.get_running_loop().add_reader(parent.fileno(), order)
    await daemon.run(asyncio.Event(), calibrate=True)


def _waited_s() -> float:
    """How long this thread was ready to run without a core."""
    return int(Path("/proc/self/schedstat").read_text().split()[1]) * 1e-9


@asynccontextmanager
async def broker_with_subscriber() -> AsyncIterator[int]:
    """Mosquitto with one subscriber on all frames; the port."""
    program = find_mosquitto()
    if program is None:
        raise BrokerError("mosquitto is not installed; `apt install mosquitto`")
    async with mosquitto_broker(program) as broker:
        command = ["mosquitto_sub", "-p", str(broker.port), "-t", "skin/bench/+/frame"]
        try:
            subscriber = await asyncio.create_subprocess_exec(
                *command, stdout=asyncio.subprocess.DEVNULL
            )
        except FileNotFoundError:
            raise BrokerError(
                "mosquitto_sub is not installed; `apt install mosquitto-clients`"
            ) from None
        try:
            yield broker.port
        finally:
            subscriber.terminate()
            await subscriber.wait()


class Running(NamedTuple):
    """What runs: the broker's port, and the parent's end to each process."""

    port: int
    listener: Connection
    daemons: list[Connection]
    senders: list[Connection]


@asynccontextmanager
async def running(
    body: Body, shown: int, *, daemons: int = 1, senders: int = 1, ready_s: float
) -> AsyncIterator[Running]:
    """Broker, subscribers, daemons and senders, each a process; calibrated, and sending.

    Args:
        body: whose frames are sent.
        shown: how many of `scenes` the senders know.
        daemons, senders: how many processes.
        ready_s: time for all of them to start and calibrate.

    Raises:
        BrokerError: mosquitto is not installed.
        SkinError: the daemons did not come up: this computer is too slow, or has no time.
    """
    context = multiprocessing.get_context("spawn")
    async with broker_with_subscriber() as port:
        listener, listener_child = context.Pipe()
        daemon_pipes = [context.Pipe() for _ in range(daemons)]
        sender_pipes = [context.Pipe() for _ in range(senders)]
        made = scenes(body)[:shown]
        states = tempfile.TemporaryDirectory(prefix="skin-bench-")
        processes = [context.Process(target=listen, args=(listener_child, port, daemons))]
        processes += [
            context.Process(
                target=run_daemon, args=(child, body, port, states.name, number + 1, daemons)
            )
            for number, (_, child) in enumerate(daemon_pipes)
        ]
        processes += [
            context.Process(target=send_body, args=(child, body, made, number, senders))
            for number, (_, child) in enumerate(sender_pipes)
        ]
        for process in processes:
            process.daemon = True
        ends = [listener_child, *(child for _, child in daemon_pipes + sender_pipes)]
        with states, beside(processes, *ends):
            if not await asyncio.to_thread(listener.poll, ready_s):
                raise SkinError(f"not calibrated within {ready_s:g} s (daemons: {daemons})")
            listener.recv()
            mine = [one for one, _ in sender_pipes]
            for sender in mine:
                await asyncio.to_thread(sender.recv)
            yield Running(port, listener, [one for one, _ in daemon_pipes], mine)
