"""A fleet: many robots over three brokers, of which one is killed and brought back, one frozen.

`skin bench fleet` needs mosquitto on the PATH; its three know nothing of each other. The robots are
publishers as the daemon has them, with touches, contacts and health recorded from the demo's left
hand; with `--full` nine of ten are `fleet_sockets.PlainRobot`, for more messages than publishers in
Python can send on a computer that also has the brokers and the subscribers. At each broker a
subscriber receives all robots, and orders their messages by number as `SkinClient` does. What is
counted: events that a broker acknowledged and that were not passed on, or twice, or out of order;
and states that differ from all that the robot has sent within 5 s. UNKNOWN is no such state; how
long states were UNKNOWN while the robots ran is counted, too.
"""

import asyncio
import json
import logging
import multiprocessing
import os
import random
import resource
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection as Pipe
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from skin_host.client.heard import is_online
from skin_host.client.intake import HOLD_S
from skin_host.client.links import BrokerLink
from skin_host.client.order import EventOrder, Newest
from skin_host.client.presence import STALE_S, Presence
from skin_host.config.settings import Mqtt
from skin_host.errors import RequestError
from skin_host.evaluation.fleet_sockets import Heard, PlainEar, PlainRobot
from skin_host.evaluation.machine import machine
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Connection, Message
from skin_host.mqtt.messages import decode_contact, decode_touch
from skin_host.mqtt.order import run_of, stamp_of
from skin_host.mqtt.publisher import Publisher
from skin_host.processes import beside
from skin_host.processing.events import Touch
from skin_host.tasks import cancel

TRAFFIC = Path(__file__).parent / "fleet_traffic.jsonl"
BASE = "skin"
PART = "left_hand"
NODE = "main"
#: A client's state may lag by this much.
ALLOWED_S = 5.0
DRAIN_S = 30.0
WORKERS = 2
#: With plain robots, so many connections at each broker receive them.
EARS = 4
#: With `--full`, one robot in so many is a publisher as the daemon has it.
PLAIN_SHARE = 10


class Brokers(Protocol):
    """Three brokers that can be stopped and frozen."""

    name: str
    addresses: list[str]
    username: str | None
    password: str | None

    def kill(self, number: int) -> None:
        """End a broker at once."""

    def start(self, number: int) -> None:
        """Start it again."""

    def freeze(self, number: int) -> None:
        """Freeze it."""

    def resume(self, number: int) -> None:
        """Let it continue."""

    def cpu_s(self) -> float:
        """Return the CPU time of the running brokers."""


@dataclass(frozen=True)
class FleetPlan:
    """How long and how much.

    Attributes:
        robots: how many.
        pace: of the recording; 1 is as fast as it was.
        health_s: between two records of a robot's health.
        phase_s: of each of: quiet, one killed, it is back, another frozen, it is back.
        plain: whether most robots are plain ones.
    """

    robots: int = 1000
    pace: float = 0.15
    health_s: float = 2.0
    phase_s: float = 12.0
    plain: bool = False


#: 7 messages a second and robot: health of two parts, and touches.
FULL = FleetPlan(pace=2.0, health_s=0.5, plain=True)
PHASES = ("quiet", "one killed", "it is back", "another frozen", "it goes on")


class RobotSent(NamedTuple):
    """What a robot has sent: number of events, number of dropped ones, and its contact states."""

    events: int
    dropped: int
    waiting: int
    connections: int
    contacts: list[tuple[float, str]]


def run(*, quick: bool = False, full: bool = False, robots: int | None = None) -> dict[str, Any]:
    """Measure with mosquittos and return the document."""
    plan = FULL if full else FleetPlan()
    if quick:
        plan = replace(plan, robots=60, pace=1.0, health_s=1.0, phase_s=6.0)
    if robots is not None:
        plan = replace(plan, robots=robots)
    with mosquittos() as brokers:
        return measure(brokers, plan)


def measure(brokers: Brokers, plan: FleetPlan) -> dict[str, Any]:
    """Let the fleet run through all phases."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 65536)), hard))
    context = multiprocessing.get_context("spawn")
    pipes: list[Pipe] = []
    ends: list[Pipe] = []
    workers: list[BaseProcess] = []
    everyone = [f"robot{i}" for i in range(plan.robots)]
    shares = [(everyone[number::WORKERS], False) for number in range(WORKERS)]
    if plan.plain:
        publishers = everyone[::PLAIN_SHARE]
        shares = [(publishers, False), (sorted(set(everyone) - set(publishers)), True)]
    for names, plain in shares:
        mine, theirs = context.Pipe()
        keys = {"username": brokers.username, "brokers": brokers.addresses}
        worker = context.Process(
            target=_work, args=(theirs, names, keys, brokers.password, plan, plain), daemon=True
        )
        pipes.append(mine)
        ends.append(theirs)
        workers.append(worker)

    async def conduct() -> dict[str, Any]:
        # They end before the loop does, which waits for threads that wait for an answer of these.
        with beside(workers, *ends):
            return await _conduct(brokers, plan, pipes)

    return asyncio.run(conduct())


async def _conduct(brokers: Brokers, plan: FleetPlan, pipes: list[Pipe]) -> dict[str, Any]:
    logging.getLogger("skin_host.client").setLevel(logging.ERROR)
    ear = _Receiver(plan)
    links: list[_FullEar | _Ear] = []
    for number, address in enumerate(brokers.addresses):
        broker, name = _broker(address, brokers), f"ear-{os.getpid()}-{number}"
        if plan.plain:
            # Some brokers have one message on its way to a subscriber at a time. All of a robot
            # comes over one connection, as to a client of one robot: in order.
            names = [f"robot{i}" for i in range(plan.robots)]
            links += [
                _Ear(number, broker, f"{name}-{share}", ear, names[share::EARS])
                for share in range(min(EARS, plan.robots))
            ]
        else:
            links.append(_FullEar(number, broker, name, ear))
    tasks = [asyncio.create_task(link.run()) for link in links]
    tasks.append(asyncio.create_task(ear.watch()))
    while not all(link.connected for link in links):  # noqa: ASYNC110
        await asyncio.sleep(0.05)
    for pipe in pipes:
        pipe.send("start")
    for pipe in pipes:
        assert await asyncio.to_thread(pipe.recv) == "connected"
    rows = []
    deeds = [
        lambda: None,
        lambda: brokers.kill(0),
        lambda: brokers.start(0),
        lambda: brokers.freeze(1),
        lambda: brokers.resume(1),
    ]
    for phase, deed in zip(PHASES, deeds, strict=True):
        await asyncio.to_thread(deed)
        ear.begin_phase()
        began_s, cpu_s = time.monotonic(), brokers.cpu_s()
        await asyncio.sleep(plan.phase_s)
        took_s = time.monotonic() - began_s
        rows.append(
            ear.end_phase(phase, took_s)
            | {"brokers_cpu": round(max(0.0, brokers.cpu_s() - cpu_s) / took_s, 3)}
        )
    ended_s = time.time()
    for pipe in pipes:
        pipe.send("end")
    told: dict[str, RobotSent] = {}
    for pipe in pipes:
        told |= await asyncio.to_thread(pipe.recv)
    await ear.settled({name: said.events for name, said in told.items()})
    await cancel(*tasks)
    verdict = ear.judge(told, ended_s)
    return {
        "engine": brokers.name,
        "machine": machine(),
        "robots": plan.robots,
        "publishers": len(range(0, plan.robots, PLAIN_SHARE)) if plan.plain else plan.robots,
        "pace": plan.pace,
        "phases": rows,
    } | verdict


def _broker(address: str, brokers: Brokers) -> Broker:
    host, _, port = address.rpartition(":")
    return Broker(host, int(port), username=brokers.username, password=brokers.password)


_STATUSES = {True: "online", False: "offline", None: "UNKNOWN"}


@dataclass
class _Received:
    """One robot, as assembled from its messages."""

    order: EventOrder = field(default_factory=lambda: EventOrder(HOLD_S))
    newest: Newest = field(default_factory=Newest)
    presence: Presence = field(default_factory=lambda: Presence(STALE_S))
    counts: list[int] = field(default_factory=list)
    #: The numbers of all events that arrived, passed on or not.
    arrived: set[int] = field(default_factory=set)
    contacts: list[tuple[float, str]] = field(default_factory=list)
    status: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.presence.take_info(NODE, [PART], time.monotonic())

    def note(self) -> None:
        """Store what a client would show."""
        now_s = time.monotonic()
        for contact in self.presence.changes(now_s):
            self.contacts.append((time.time(), contact.state))
        status = _STATUSES[self.presence.online(NODE, now_s)]
        if not self.status or self.status[-1][1] != status:
            self.status.append((time.time(), status))


class _FullEar(BrokerLink):
    """A link as the client has it."""

    @property
    def connected(self) -> bool:
        """Whether there is a broker."""
        return self.connection is not None


class _Ear(PlainEar):
    """One that costs little, of some robots."""

    def __init__(
        self, number: int, broker: Broker, name: str, receiver: "_Receiver", robots: list[str]
    ) -> None:
        super().__init__(
            broker,
            name,
            [f"{BASE}/{robot}/#" for robot in robots],
            lambda heard: receiver.hear(number, heard),
            lambda: None if self.connected else receiver.lose(number, robots),
        )


class _Receiver:
    """Receives all robots from all brokers; a `links.Hearer`."""

    def __init__(self, plan: FleetPlan) -> None:
        self._robots = {f"robot{i}": _Received() for i in range(plan.robots)}
        self._received = 0
        self._delays_s: list[float] = []

    async def prepare(self, connection: Connection, broker: Broker) -> None:
        """Nothing must be known before subscribing."""

    def wanted(self) -> Sequence[str]:
        """Return all topics of all robots, except frames."""
        kinds = [f"+/{kind}" for kind in ("touch", "contact", "health")]
        return [f"{BASE}/+/{kind}" for kind in [*kinds, "nodes/+/status"]]

    def unfollow(self, topic: str) -> None:
        """Nothing is ever unfollowed."""

    def note(self, link: BrokerLink) -> None:
        """Links come and go."""
        if link.connection is None:
            self.lose(link.number, self._robots)

    def lose(self, number: int, robots: Iterable[str]) -> None:
        """The connection to a broker is lost, over which these robots were received."""
        for robot in [self._robots[name] for name in robots]:
            robot.presence.take_loss(number)
            robot.note()

    def take(self, link: BrokerLink, message: Message) -> None:
        """Process a message of the client's library."""
        if not isinstance(message.payload, bytes):
            return
        run, stamp = run_of(message.properties), stamp_of(message.properties)
        topic = message.topic.value
        self.hear(link.number, Heard(topic, message.payload, message.retain, run, stamp))

    def hear(self, number: int, heard: Heard) -> None:
        """Process a message from a broker."""
        words = heard.topic.split("/")
        robot = self._robots.get(words[1])
        if robot is None:
            return
        self._received += 1
        now_s = time.time()
        kind = words[-1]
        if kind == "touch":
            touch = decode_touch(heard.payload)
            robot.arrived.add(touch.count)
            self._pass_on(robot, robot.order.take(touch, heard.run, time.monotonic()), now_s)
            return
        newness = robot.newest.take(kind, words[2], heard.stamp)
        at_s = time.monotonic()
        sent_s = None if heard.retained or heard.stamp is None else heard.stamp.sent_s
        if kind == "contact" and newness is not False:
            state = decode_contact(heard.payload)
            again = newness is None
            stored = heard.retained
            robot.presence.take_state(
                PART, state, at_s, number, again=again, stored=stored, sent_s=sent_s
            )
        elif kind == "health" and newness and not heard.retained:
            robot.presence.take_sign(PART, at_s, sent_s)
        elif kind == "status" and newness is not False:
            online = is_online(heard.payload, heard.stamp, is_only_broker=False)
            robot.presence.take_node(NODE, online, at_s, number, again=newness is None)
        robot.note()

    def _pass_on(self, robot: _Received, events: Sequence[Any], now_s: float) -> None:
        for event in events:
            assert isinstance(event, Touch)
            robot.counts.append(event.count)
            self._delays_s.append(now_s - event.t_ns * 1e-9)
            robot.presence.take_touch(event, time.monotonic())
        robot.note()

    async def watch(self) -> None:
        """Release events whose predecessors never came."""
        while True:
            await asyncio.sleep(0.25)
            now_s = time.monotonic()
            for robot in self._robots.values():
                self._pass_on(robot, robot.order.expire(now_s), time.time())

    async def settled(self, events: dict[str, int]) -> None:
        """Wait until all events that were sent have arrived, or none has come for long."""
        arrived, until_s = 0, time.monotonic() + DRAIN_S
        while arrived < sum(events.values()) and time.monotonic() < until_s:
            await asyncio.sleep(0.1)
            now = sum(len(robot.arrived) for robot in self._robots.values())
            if now > arrived:
                arrived, until_s = now, time.monotonic() + DRAIN_S
        await asyncio.sleep(2 * HOLD_S)

    def begin_phase(self) -> None:
        """Start counting for a phase."""
        self._received = 0
        self._delays_s = []

    def end_phase(self, name: str, seconds: float) -> dict[str, Any]:
        """Return the results of the phase."""
        delays_ms = np.array(self._delays_s or [np.nan]) * 1e3
        return {
            "phase": name,
            "messages_s": round(self._received / seconds, 1),
            "events_s": round(len(self._delays_s) / seconds, 1),
            "p50_ms": round(float(np.percentile(delays_ms, 50)), 1),
            "p99_ms": round(float(np.percentile(delays_ms, 99)), 1),
            "worst_ms": round(float(np.max(delays_ms)), 1),
        }

    def judge(self, told: dict[str, RobotSent], ended_s: float) -> dict[str, Any]:
        """Compare with what the robots sent, which ended at a time."""
        lost = late = unseen = twice = disordered = wrong = offline = events = changes = 0
        contact_s = status_s = 0.0
        for name, said in told.items():
            heard = self._robots[name]
            events += said.events
            passed = Counter(heard.counts)
            missing = {count for count in range(1, said.events + 1) if count not in passed}
            lost += len(missing)
            late += len(missing & heard.arrived)
            unseen += sum(count > max(passed, default=0) for count in missing)
            twice += sum(n - 1 for n in passed.values())
            disordered += sum(b < a for a, b in zip(heard.counts, heard.counts[1:], strict=False))
            wrong += _wrong(said.contacts, heard.contacts)
            contact_s += _unknown_s(heard.contacts, ended_s)
            status_s += _unknown_s(heard.status, ended_s)
            changes += sum(at_s < ended_s for at_s, _ in heard.status[1:])
            offline += _wrong([(0.0, "online")], heard.status)
        return {
            "events": events,
            "dropped_by_robots": sum(one.dropped for one in told.values()),
            "not_acknowledged": sum(one.waiting for one in told.values()),
            "connections": sum(one.connections for one in told.values()),
            "lost": lost,
            "lost_for_coming_late": late,
            "lost_without_a_gap": unseen,
            "passed_on_twice": twice,
            "out_of_order": disordered,
            "unknown_s_a_robot": round(contact_s / len(told), 2),
            "status_unknown_s_a_robot": round(status_s / len(told), 2),
            "status_changes_a_robot": round(changes / len(told), 2),
            "robots_with_wrong_contact": wrong,
            "robots_falsely_offline": offline,
        }


def _wrong(said: list[tuple[float, str]], heard: list[tuple[float, str]]) -> bool:
    """Return whether a state was shown for longer than allowed after its end, or never came.

    UNKNOWN is never wrong.
    """
    if not heard:
        return bool(said)
    end_s = max(said[-1][0], heard[-1][0])
    for (from_s, shown), (to_s, _) in zip(heard, [*heard[1:], (end_s, "")], strict=True):
        if shown == "UNKNOWN":
            continue
        # Shown until `to_s`: at that time it must have been true within the last seconds.
        ends = [*(at_s for at_s, _ in said[1:]), float("inf")]
        true_until_s = max(
            (
                end
                for (at_s, state), end in zip(said, ends, strict=True)
                if state == shown and at_s <= to_s
            ),
            default=0.0,
        )
        if to_s - max(true_until_s, from_s) > ALLOWED_S:
            return True
    known = [state for _, state in heard if state != "UNKNOWN"]
    return known[-1:] != [said[-1][1]]


def _unknown_s(heard: list[tuple[float, str]], end_s: float) -> float:
    """How long a state was UNKNOWN until `end_s`, after it was first known."""
    known = next((i for i, (_, state) in enumerate(heard) if state != "UNKNOWN"), len(heard))
    spans = zip(heard[known:], [*heard[known + 1 :], (end_s, "")], strict=False)
    return sum(
        max(0.0, min(to_s, end_s) - from_s)
        for (from_s, state), (to_s, _) in spans
        if state == "UNKNOWN"
    )


def _work(
    pipe: Pipe,
    names: list[str],
    keys: dict[str, Any],
    password: str | None,
    plan: FleetPlan,
    plain: bool,
) -> None:
    """Run some of the robots in a separate process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.disable()  # each robot logs the loss of a broker
    pipe.recv()
    with tempfile.TemporaryDirectory() as folder:
        if password is not None:
            file = Path(folder) / "password"
            file.write_text(password)
            keys["password_file"] = str(file)
        asyncio.run(_be(pipe, names, Mqtt(**keys), plan, plain))


class _FullRobot(Publisher):
    """A publisher as the daemon has it."""

    @property
    def connected(self) -> bool:
        """Whether there is a broker."""
        return self.counters.connected

    @property
    def waiting(self) -> int:
        """How many events are not acknowledged."""
        return self.counters.touches_waiting

    def sent(self, contacts: list[tuple[float, str]]) -> RobotSent:
        """What it has sent."""
        known = self.counters
        count = self._outbox.counted(self.topics.part("touch", PART))
        return RobotSent(
            count, known.touches_dropped, known.touches_waiting, known.connections, contacts
        )


class _PlainRobot(PlainRobot):
    """One that costs little."""

    def sent(self, contacts: list[tuple[float, str]]) -> RobotSent:
        """What it has sent."""
        return RobotSent(self.count, 0, len(self.events), self.connections, contacts)


async def _be(pipe: Pipe, names: list[str], settings: Mqtt, plan: FleetPlan, plain: bool) -> None:
    traffic = [json.loads(line) for line in TRAFFIC.read_text().splitlines()]
    for item in traffic:
        if item["kind"] == "touch":
            item["said"] = _event(item["said"])
    stop = asyncio.Event()
    kind = _PlainRobot if plain else _FullRobot
    robots: dict[str, _FullRobot | _PlainRobot] = {name: kind(settings, name) for name in names}
    contacts: dict[str, list[tuple[float, str]]] = {name: [] for name in names}
    tasks = []
    for name, robot in robots.items():
        await robot.__aenter__()
        tasks.append(asyncio.create_task(_play(robot, contacts[name], traffic, plan, stop)))
        await asyncio.sleep(0.002)
    while not all(one.connected for one in robots.values()):  # noqa: ASYNC110
        await asyncio.sleep(0.05)
    pipe.send("connected")
    await asyncio.to_thread(pipe.recv)
    stop.set()
    until_s = time.monotonic() + DRAIN_S
    while time.monotonic() < until_s and any(  # noqa: ASYNC110
        one.waiting for one in robots.values()
    ):
        await asyncio.sleep(0.1)
    told = {name: robot.sent(contacts[name]) for name, robot in robots.items()}
    pipe.send(told)
    # The daemon's end would publish `offline`, which is not measured.
    await asyncio.sleep(3600)


async def _play(
    publisher: Publisher | PlainRobot,
    contacts: list[tuple[float, str]],
    traffic: list[dict[str, Any]],
    plan: FleetPlan,
    stop: asyncio.Event,
) -> None:
    """Publish the recording in a loop, from a random place in it, until `stop` is set.

    Health goes on: without it the robot's last states would never be known again.
    """
    health = traffic[0]["said"]
    said = traffic[1:]
    length_s = said[-1]["at_s"] + 1.0
    now_s = random.uniform(0.0, length_s)
    due = [one for one in said if one["at_s"] >= now_s] or list(said)
    health_due_s = time.monotonic() + random.uniform(0.0, plan.health_s)
    began_s = time.monotonic() - now_s / plan.pace
    while True:
        if not due:
            due, began_s = list(said), began_s + length_s / plan.pace
        at_s = began_s + due[0]["at_s"] / plan.pace
        ended = stop.is_set()
        wait_s = (health_due_s if ended else min(at_s, health_due_s)) - time.monotonic()
        if wait_s > 0:
            await asyncio.sleep(wait_s)
            continue
        if ended or health_due_s <= at_s:
            publisher.put_health(PART, health)
            health_due_s += plan.health_s
            continue
        item = due.pop(0)
        if item["kind"] == "touch":
            publisher.put_touch(msgspec.structs.replace(item["said"], t_ns=time.time_ns()))
        else:
            publisher.put_contact(PART, item["said"])
            if not contacts or contacts[-1][1] != item["said"]:
                contacts.append((time.time(), item["said"]))


def _event(said: dict[str, Any]) -> Touch:
    return decode_touch(msgspec.json.encode(said))


def describe(document: dict[str, Any]) -> str:
    """The document as a table and sentences."""
    where = document["machine"]
    lines = [
        f"{document['robots']} robots, {document['publishers']} with the daemon's own publisher, "
        + document["engine"],
        f"{where['cores']} cores, load {where['load']:g}",
        "phase            messages/s  events/s   p50 ms   p99 ms  worst ms  brokers, of a core",
    ]
    lines += [
        f"{row['phase']:<16}{row['messages_s']:>11.0f}{row['events_s']:>10.0f}"
        f"{row['p50_ms']:>9.1f}{row['p99_ms']:>9.1f}{row['worst_ms']:>10.0f}"
        f"{row['brokers_cpu']:>20.2f}"
        for row in document["phases"]
    ]
    lines.append(
        f"{document['events']} events, {document['dropped_by_robots']} dropped by robots, "
        f"{document['not_acknowledged']} not acknowledged; lost {document['lost']} "
        f"({document['lost_for_coming_late']} came too late to be in order, "
        f"{document['lost_without_a_gap']} after the last that came), "
        f"passed on twice {document['passed_on_twice']}, out of order {document['out_of_order']}"
    )
    lines.append(
        f"robots of which a state was wrong for more than {ALLOWED_S:g} s: contact "
        f"{document['robots_with_wrong_contact']} (UNKNOWN for "
        f"{document['unknown_s_a_robot']:g} s a robot), status "
        f"{document['robots_falsely_offline']} (UNKNOWN for "
        f"{document['status_unknown_s_a_robot']:g} s a robot, "
        f"{document['status_changes_a_robot']:g} changes)"
    )
    return "\n".join(lines)


class _Mosquittos:
    """Three independent ones."""

    name = "three independent mosquittos"
    username: str | None = None
    password: str | None = None

    def __init__(self, program: str, folder: Path) -> None:
        self._program = program
        self._files = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self.addresses: list[str] = []
        for number in range(3):
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                port = probe.getsockname()[1]
            file = folder / f"{number}.conf"
            file.write_text(
                f"listener {port} 127.0.0.1\nallow_anonymous true\nlog_dest none\n"
                "max_queued_messages 100000\n"
            )
            self._files.append(file)
            self.addresses.append(f"127.0.0.1:{port}")
        for number in range(3):
            self._processes.append(self._run(number))

    def _run(self, number: int) -> "subprocess.Popen[bytes]":
        return subprocess.Popen(
            [self._program, "-c", self._files[number]],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def kill(self, number: int) -> None:
        self._processes[number].kill()
        self._processes[number].wait()

    def start(self, number: int) -> None:
        self._processes[number] = self._run(number)

    def freeze(self, number: int) -> None:
        self._processes[number].send_signal(signal.SIGSTOP)

    def resume(self, number: int) -> None:
        self._processes[number].send_signal(signal.SIGCONT)

    def cpu_s(self) -> float:
        running = [one.pid for one in self._processes if one.poll() is None]
        return sum(cpu_of_s(pid) for pid in running)

    def end(self) -> None:
        """End all of them."""
        for process in self._processes:
            process.kill()
            process.wait()


def cpu_of_s(pid: int) -> float:
    """CPU time of another process with all its threads."""
    threads = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(one.read_text().split()[0]) for one in threads) * 1e-9


@contextmanager
def mosquittos() -> Iterator[Brokers]:
    """Run three mosquittos.

    Raises:
        RequestError: it is not installed.
    """
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
    if program is None:
        raise RequestError("bench fleet: no mosquitto on the PATH; install it")
    with tempfile.TemporaryDirectory() as folder:
        brokers = _Mosquittos(program, Path(folder))
        try:
            yield brokers
        finally:
            brokers.end()
