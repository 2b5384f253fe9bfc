"""One node in several processes: buses are shared out, and it is one service and one robot."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import aiomqtt
import pytest

from skin_host.config.settings import Settings, load
from skin_host.daemon import workers
from skin_host.daemon.workers import Merged, share_name, share_of, share_out
from skin_host.layout import build_layout, parts_of
from tests.support.broker import Mosquitto, free_port
from tests.support.moments import at_import
from tests.support.waiting import PATIENCE_S, until

ROBOT = """
robot = "body"
[mqtt]
host = "127.0.0.1"
port = {port}
[service]
state_directory = "{state}"
"""


def body(
    path: Path,
    places: list[tuple[str, list[int]]],
    port: int = 1883,
    tips: dict[int, int] | None = None,
    arrays: dict[int, str] | None = None,
) -> Path:
    """A robot: of each part its name and the buses of its boards, of 16 triangles each.

    Args:
        path: of its configuration.
        places: its parts.
        port: of the broker.
        tips: how many fingertips there are, by their bus.
        arrays: which part covers the fingertips of a bus.
    """
    lines = [ROBOT.format(port=port, state=path.parent)]
    tips = tips or {}
    buses = sorted({bus for _, boards in places for bus in boards} | tips.keys())
    lines += [
        f'[buses.can{bus}]\ninterface = "virtual"\nchannel = "workers-{bus}"' for bus in buses
    ]
    address = dict.fromkeys(buses, 0)
    for part, boards in places:
        for number, bus in enumerate(boards):
            address[bus] += 1
            lines.append(f'[boards.{part}{number}]\nbus = "can{bus}"\naddress = {address[bus]}')
            lines.append(f'[[parts.{part}.patches]]\nboard = "{part}{number}"\ntriangles = "0-15"')
    for bus, n in tips.items():
        for number in range(1, n + 1):
            lines.append(f'[fingertips.tip{bus}-{number}]\nbus = "can{bus}"\naddress = {number}')
            lines.append('shape = "sphere"\nradius_mm = 10.0')
            lines += [f'array = "{arrays[bus]}"'] if arrays and bus in arrays else []
    path.write_text("\n".join(lines))
    return path


def settings(tmp_path: Path, places: list[tuple[str, list[int]]]) -> Settings:
    return load(body(tmp_path / "body.toml", places))


def test_buses_of_one_part_stay_together_and_shares_are_even(tmp_path: Path) -> None:
    places = [("a", [0, 1]), ("b", [1]), ("c", [2]), ("d", [3]), ("e", [4])]
    shares = share_out(settings(tmp_path, places), "main", 2)
    assert [sorted(buses) for buses in shares] == [["can0", "can1"], ["can2", "can3", "can4"]]
    assert len(share_out(settings(tmp_path, places), "main", 9)) == 4
    assert share_out(settings(tmp_path, places), "other", 2) == []


def test_shares_are_nodes_that_have_every_part_once(tmp_path: Path) -> None:
    whole = settings(tmp_path, [("a", [0]), ("b", [1]), ("c", [2]), ("d", [1])])
    owners = [
        (name, part.node)
        for number in (1, 2, 3)
        for name, part in share_of(whole, "main", number, 3).parts.items()
        if part.node == f"main-{number}"
    ]
    assert sorted(name for name, _ in owners) == ["a", "b", "c", "d"]
    assert dict(owners)["b"] == dict(owners)["d"]
    assert len({node for _, node in owners}) == 3


def nodes_of_tips(whole: Settings, n: int) -> list[str]:
    """The share of each fingertip, after a look whether every share has parts."""
    shares = range(1, len(share_out(whole, "main", n)) + 1)
    found = []
    for number in shares:
        share = share_of(whole, "main", number, n)
        node = share_name("main", number)
        assert parts_of(build_layout(share, Path()), node)
        found += [tip.node for tip in share.fingertips.values() if tip.node == node]
    return found


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_a_bus_of_fingertips_alone_is_no_share_of_its_own(tmp_path: Path, n: int) -> None:
    """No daemon can run without a part."""
    config = body(tmp_path / "body.toml", [("a", [0]), ("b", [1])], tips={2: 1})
    assert len(nodes_of_tips(load(config), n)) == 1


def test_fingertips_alone_are_shared_with_the_fewest_triangles(tmp_path: Path) -> None:
    """However many they are: here more than the triangles of either part."""
    config = body(tmp_path / "body.toml", [("a", [0, 0]), ("b", [1])], tips={2: 14, 3: 14})
    config.write_text(config.read_text().replace('"0-15"', '"0-3"'))
    whole = load(config)
    shares = share_out(whole, "main", 2)
    assert [sorted(buses) for buses in shares] == [["can0", "can3"], ["can1", "can2"]]
    assert sorted(nodes_of_tips(whole, 2)) == ["main-1"] * 14 + ["main-2"] * 14


def test_a_fingertip_stays_with_the_part_that_covers_it(tmp_path: Path) -> None:
    """Also if they lie on different buses: both contribute to one estimate."""
    places = [("a", [0, 0]), ("b", [1])]
    whole = load(body(tmp_path / "body.toml", places, tips={2: 1}, arrays={2: "a"}))
    assert [sorted(buses) for buses in share_out(whole, "main", 2)] == [["can0", "can2"], ["can1"]]
    assert nodes_of_tips(whole, 2) == ["main-1"]


def test_the_service_is_ready_with_the_last_and_fed_by_all() -> None:
    merged = Merged(["main-1", "main-2"])
    assert merged.take("main-1", "READY=1") == []
    assert merged.take("main-2", "READY=1") == ["READY=1"]
    assert merged.take("main-1", "WATCHDOG=1") == []
    assert merged.take("main-1", "WATCHDOG=1") == []
    assert merged.take("main-2", "WATCHDOG=1") == ["WATCHDOG=1"]
    assert merged.take("main-2", "WATCHDOG=1") == []
    assert merged.take("main-2", "STATUS=12 frames/s") == [
        "STATUS=main-1: starting; main-2: 12 frames/s"
    ]
    reloading = "RELOADING=1\nMONOTONIC_USEC=5"
    assert merged.take("main-1", reloading) == [reloading]
    assert merged.take("main-2", reloading) == []
    assert merged.take("main-2", "READY=1") == []
    assert merged.take("main-1", "READY=1") == ["READY=1"]
    assert merged.take("main-2", "STOPPING=1") == ["STOPPING=1"]
    assert merged.take("main-1", "STOPPING=1") == []


def test_a_reload_ends_with_the_last_also_where_one_is_done_before_another_has_begun() -> None:
    names = ["main-1", "main-2"]
    merged = Merged(names)
    assert [merged.take(name, "READY=1") for name in names] == [[], ["READY=1"]]
    reloading = "RELOADING=1\nMONOTONIC_USEC=5"
    assert merged.reload(reloading, names) == [reloading]
    assert merged.take("main-1", reloading) == []
    assert merged.take("main-1", "READY=1") == []
    assert merged.take("main-2", reloading) == []
    assert merged.take("main-2", "READY=1") == ["READY=1"]


class Ends:
    """A daemon that ends in good order when it is asked to, and otherwise only when killed."""

    def __init__(self) -> None:
        self.signals: list[int] = []
        self.returncode: int | None = None
        self._ended = asyncio.Event()

    def send_signal(self, number: int) -> None:
        self.signals.append(number)
        self._ended.set()

    async def wait(self) -> int:
        await self._ended.wait()
        self.returncode = 0 if signal.SIGKILL not in self.signals else -signal.SIGKILL
        return self.returncode


class Hangs(Ends):
    """A daemon that ends only when it is killed."""

    def send_signal(self, number: int) -> None:
        self.signals.append(number)
        if number == signal.SIGKILL:
            self._ended.set()


class Started:
    """Takes the place of the processes that workers run in, and of the signals to their parent.

    Args:
        monkeypatch: ends that.
        kind: of the processes.
        on_start: called after each start with the descriptors that were passed to it.

    Attributes:
        daemons: that were started.
        on_signal: what a signal to the parent does.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        kind: Callable[[], Ends] = Ends,
        on_start: Callable[[list[int]], object] = lambda _: None,
    ) -> None:
        self.daemons: list[Ends] = []
        self.on_signal: dict[int, Callable[[], object]] = {}
        self._kind, self._on_start = kind, on_start
        monkeypatch.setattr(asyncio.get_running_loop(), "add_signal_handler", self._take)
        monkeypatch.setattr(asyncio, "create_subprocess_exec", self._start)

    async def two(self) -> asyncio.Task[int]:
        """Run two workers; return once both are started."""
        running = asyncio.create_task(workers.run({"main-1": ["run"], "main-2": ["run"]}))
        await until(lambda: len(self.daemons) == 2)
        return running

    def _take(self, number: int, handler: Callable[..., object], *args: object) -> None:
        self.on_signal[number] = lambda: handler(*args)

    async def _start(self, *_: object, pass_fds: list[int], **__: object) -> Ends:
        self.daemons.append(self._kind())
        self._on_start(pass_fds)
        return self.daemons[-1]


@pytest.mark.parametrize("asked", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("started", [1, 2, 3])
async def test_a_stop_while_daemons_are_started_reaches_each_of_them(
    started: int, asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also the one that is being started, and no other is started after it."""
    fakes = Started(
        monkeypatch,
        on_start=lambda _: fakes.on_signal[asked]() if len(fakes.daemons) == started else None,
    )
    async with asyncio.timeout(PATIENCE_S):
        assert await workers.run({f"main-{number}": ["run"] for number in (1, 2, 3)}) == 0
    assert [daemon.signals for daemon in fakes.daemons] == [[asked]] * started


async def test_a_second_stop_ends_every_daemon_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A share takes no second request itself: a service sends it two of the same."""

    class Hangs(Ends):
        def send_signal(self, number: int) -> None:
            self.signals.append(number)
            if number == signal.SIGKILL:
                self._ended.set()

    fakes = Started(monkeypatch, Hangs)
    running = await fakes.two()
    fakes.on_signal[signal.SIGHUP]()
    fakes.on_signal[signal.SIGINT]()
    fakes.on_signal[signal.SIGTERM]()
    assert await asyncio.wait_for(running, PATIENCE_S) == 1
    wanted = [signal.SIGHUP, signal.SIGINT, signal.SIGKILL]
    assert [daemon.signals for daemon in fakes.daemons] == [wanted] * 2


async def test_the_watchdog_ends_the_worker_that_hangs_where_it_hangs_and_the_others_in_good_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """systemd sends SIGABRT to their parent alone, whose own stack shows nothing."""
    notified: list[int] = []
    fakes = Started(monkeypatch, on_start=lambda fds: notified.extend(map(os.dup, fds)))
    running = await fakes.two()
    os.write(notified[0], b"WATCHDOG=1")
    await asyncio.sleep(0.05)
    fakes.on_signal[signal.SIGABRT]()
    await asyncio.wait_for(running, PATIENCE_S)
    for descriptor in notified:
        os.close(descriptor)
    assert [daemon.signals[0] for daemon in fakes.daemons] == [signal.SIGTERM, signal.SIGABRT]


@pytest.mark.parametrize("number", ["SIGTERM", "SIGINT"])
@pytest.mark.parametrize(
    "module", ["skin_host.__main__", "skin_host.cli", "skin_host.daemon.daemon", "can"]
)
async def test_a_stop_before_a_daemon_has_begun_is_a_clean_end(
    tmp_path: Path, module: str, number: str
) -> None:
    config = body(tmp_path / "body.toml", [("a", [0]), ("b", [1])], free_port())
    act = f"""
            os.kill(os.getppid(), signal.{number})
            while signal.{number} not in signal.sigpending():
                time.sleep(0.01)
    """
    process = await asyncio.create_subprocess_exec(
        *("env", "--default-signal=INT", sys.executable, "-m", "skin_host"),
        *("run", config, "--workers", "2"),
        env=at_import(tmp_path, module, "1/2", act),
        stderr=asyncio.subprocess.PIPE,
    )
    _, told = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode == 0, told
    assert b"Traceback" not in told


async def test_a_worker_that_does_not_end_in_time_is_named_and_killed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fakes = Started(monkeypatch, Hangs)
    monkeypatch.setattr(workers, "STOP_S", 0.05)
    running = await fakes.two()
    fakes.daemons[0]._ended.set()
    assert await asyncio.wait_for(running, PATIENCE_S) == 1
    assert fakes.daemons[1].signals == [signal.SIGTERM, signal.SIGKILL]
    assert [one.getMessage() for one in caplog.records] == [
        "main-2: not ended within 0.05 s; killed"
    ]


async def test_workers_that_all_hang_are_killed_after_one_request_to_end(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Nobody sends a second one where no service runs them."""
    fakes = Started(monkeypatch, Hangs)
    monkeypatch.setattr(workers, "STOP_S", 0.05)
    running = await fakes.two()
    fakes.on_signal[signal.SIGTERM]()
    assert await asyncio.wait_for(running, PATIENCE_S) == 1
    wanted = [signal.SIGTERM, signal.SIGKILL]
    assert [daemon.signals for daemon in fakes.daemons] == [wanted] * 2
    assert [one.getMessage() for one in caplog.records] == [
        "main-1, main-2: not ended within 0.05 s; killed"
    ]


async def test_a_worker_that_is_killed_is_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Where memory is short the kernel kills it, and the service ends for no other reason."""
    fakes = Started(monkeypatch)
    running = await fakes.two()
    fakes.daemons[1].send_signal(signal.SIGKILL)
    assert await asyncio.wait_for(running, PATIENCE_S) == 1
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("main-2: ended by signal 9 (Killed); all workers end with it")
    assert "memory" in line


async def test_a_folder_of_the_same_name_in_the_working_directory_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "skin_host"
    other.mkdir()
    (other / "__init__.py").touch()
    (other / "__main__.py").write_text("open('run', 'w').close()")
    monkeypatch.chdir(tmp_path)
    assert await workers.run({"main-1": ["--version"]}) == 0
    assert not (tmp_path / "run").exists()


async def states(broker: Mosquitto) -> dict[str, bytes]:
    """What is retained of the robot, once both nodes have said how their parts are."""
    found: dict[str, bytes] = {}
    wanted = {f"skin/body/nodes/main-{number}/status" for number in (1, 2)}
    wanted |= {"skin/body/a/health", "skin/body/b/health"}
    async with asyncio.timeout(PATIENCE_S), aiomqtt.Client(broker.host, broker.port) as client:
        await client.subscribe("skin/#")
        async for message in client.messages:
            found[str(message.topic)] = bytes(message.payload)  # type: ignore[arg-type]
            if wanted <= found.keys():
                return found
    raise AssertionError


async def test_a_service_of_two_workers_is_one_robot(mosquitto: Mosquitto, tmp_path: Path) -> None:
    """Also where the names of temporary files are longer than that of a socket may be."""
    temporary = tmp_path / ("x" * 100)
    temporary.mkdir()
    config = body(tmp_path / "body.toml", [("a", [0]), ("b", [1])], mosquitto.port)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(PATIENCE_S)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "skin_host", "run", config, "--workers", "2"),
            env=os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify"), "TMPDIR": str(temporary)},
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            found = await states(mosquitto)
            assert found["skin/body/nodes/main-1/status"] == b"online"
            assert list(json.loads(found["skin/body/nodes/main-1/info"])["parts"]) == ["a"]
            while (await asyncio.to_thread(systemd.recv, 4096)) != b"READY=1":
                pass
            process.send_signal(signal.SIGTERM)
            _, log = await asyncio.wait_for(process.communicate(), PATIENCE_S)
            assert process.returncode == 0
            named = [line.split()[1] for line in log.decode().splitlines() if line.split()[1:]]
            assert {"main-1:", "main-2:"} <= set(named)
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()


def children_of(pid: int) -> list[int]:
    return list(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


async def two_workers(mosquitto: Mosquitto, tmp_path: Path) -> asyncio.subprocess.Process:
    """Start a robot of two workers, and wait until both have published their states."""
    config = body(tmp_path / "body.toml", [("a", [0]), ("b", [1])], mosquitto.port)
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "skin_host", "run", config, "--workers", "2"),
        stderr=asyncio.subprocess.DEVNULL,
    )
    await states(mosquitto)
    return process


async def test_workers_end_when_their_parent_is_killed(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """They would go on commanding the boards beside those of the next start."""
    process = await two_workers(mosquitto, tmp_path)
    children = children_of(process.pid)
    assert len(children) == 2
    process.kill()
    await process.wait()
    await until(lambda: not any(map(is_running, children)))


def written(path: Path) -> str:
    """What a file holds; nothing while it is not there."""
    return path.read_text() if path.exists() else ""


@pytest.mark.parametrize("module", ["skin_host.__main__", "skin_host.daemon.daemon"])
async def test_a_worker_ends_whose_parent_is_killed_while_it_starts(
    tmp_path: Path, module: str
) -> None:
    """Nobody reports that to it."""
    config = body(tmp_path / "body.toml", [("a", [0]), ("b", [1])], free_port())
    act = f"""
            os.kill(os.getppid(), signal.SIGKILL)
            while os.getppid() == int(sys.orig_argv[sys.orig_argv.index("--parent") + 1]):
                time.sleep(0.01)
            open({str(tmp_path / "pid")!r}, "w").write(str(os.getpid()))
    """
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "skin_host", "run", config, "--workers", "2"),
        env=at_import(tmp_path, module, "1/2", act),
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert await asyncio.wait_for(process.wait(), PATIENCE_S) == -signal.SIGKILL
    await until(lambda: bool(written(tmp_path / "pid")))
    worker = int(written(tmp_path / "pid"))
    try:
        await until(lambda: not is_running(worker))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)


def takes(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler of a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def wait_until_ignored(pid: int, number: signal.Signals) -> None:
    """Wait no longer than that: a worker that has ended before its parent is asked to end counts as
    one that has ended by itself.
    """
    while takes(pid, number):
        time.sleep(0.0005)


async def test_a_service_that_ends_its_workers_itself_ends_them_in_good_order(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """systemd sends SIGTERM to all processes of a service, and their parent passes it on."""
    process = await two_workers(mosquitto, tmp_path)
    (first, _) = children_of(process.pid)
    os.kill(first, signal.SIGTERM)
    wait_until_ignored(first, signal.SIGTERM)
    process.send_signal(signal.SIGTERM)
    os.kill(first, signal.SIGTERM)
    assert await asyncio.wait_for(process.wait(), PATIENCE_S) == 0


@pytest.mark.parametrize("share", ["", "-", "0/1", "2/1", "1/x", "9" * 5000])
def test_a_share_that_is_none_is_refused_in_a_line(
    share: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from skin_host.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["run", "x.toml", f"--share={share}\x1b[2J"])
    assert ended.value.code == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.isprintable()


def test_workers_without_ports_for_their_metrics_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from skin_host.cli import main

    path = body(tmp_path / "body.toml", [("a", [0]), ("b", [1])])
    path.write_text(path.read_text().replace("[service]", "[service]\nmetrics_port = 65535"))
    assert main(["run", str(path), "--workers", "2"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "service.metrics_port: seen 65535, wanted at most 65534" in line


def test_workers_of_a_node_without_parts_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from skin_host.cli import main

    config = body(tmp_path / "body.toml", [("a", [0])])
    assert main(["run", str(config), "--workers", "2", "--node", "x"]) == 2
    assert 'node "x"' in capsys.readouterr().err
