"""Three nodes of ejabberd as a cluster on this machine, without systemd, epmd or root.

`python -m tests.support.ejabberd [--robots N]` runs the fleet of `skin bench fleet` over it. It
needs Debian's package ejabberd (MQTT 5 and 3.1.1). Its behaviour is the stock one: what is retained
is found only at the node where it was published.
"""

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from skin_host.evaluation import bench_fleet
from tests.support.broker import free_port

_START_S = 240.0
_LIBRARIES = "/usr/lib/x86_64-linux-gnu"
_CONFIGURATION = """\
hosts: [fleet]
loglevel: error
net_ticktime: {tick_s} seconds
auth_method: [anonymous]
anonymous_protocol: login_anon
allow_multiple_connections: true
listen:
  - {{ip: "127.0.0.1", port: {port}, module: mod_mqtt, backlog: 1024}}
modules:
  mod_mqtt:
    access_publish: {{"#": [allow: all]}}
    access_subscribe: {{"#": [allow: all]}}
    max_queue: 100000
    session_expiry: 10 minutes
    match_retained_limit: 10000
"""
#: The time after which the nodes give up one that does not answer, plus or minus a quarter.
_STOCK_TICK_S = 60


class Ejabberds:
    """A cluster whose nodes can be hurt.

    Args:
        folder: for the nodes' files.
        tick_s: their `net_ticktime`.
        in_memory: what is retained is kept in memory, not in a file of each node.
    """

    name = "three nodes of ejabberd as a cluster"
    username: str | None = "robot"
    password: str | None = "any"

    def __init__(self, folder: Path, tick_s: int, *, in_memory: bool) -> None:
        self._in_memory = in_memory
        self._folder = folder
        self._tick_s = tick_s
        self._distribution = free_port()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._ports = [free_port() for _ in range(3)]
        self.addresses = [f"127.0.0.1:{port}" for port in self._ports]
        cookie = folder / ".erlang.cookie"
        cookie.write_text(os.urandom(12).hex())
        cookie.chmod(0o400)
        for number, port in enumerate(self._ports):
            (folder / str(number)).mkdir()
            configuration = _CONFIGURATION.format(port=port, tick_s=tick_s)
            (folder / str(number) / "ejabberd.yml").write_text(configuration)

    def form(self) -> None:
        """Start the nodes and join them."""
        self._processes = [self._run(number) for number in range(3)]
        for number in range(3):
            self._wait(number)
        for number in (1, 2):
            self._join(number)
            self._wait(number)
        if self._in_memory:
            for number in range(3):
                self._keep_retained_in_memory(number)

    def _keep_retained_in_memory(self, number: int) -> None:
        """What the web admin does for a table: Nodes, the node, Database, "RAM copy"."""
        node = f"'{self._node(number)}'"
        change = f"mnesia, change_table_copy_type, [mqtt_pub, {node}, ram_copies]"
        call = f"{{atomic, ok}} = rpc:call({node}, {change}), halt()."
        self._ask("-eval", call)

    def _join(self, number: int) -> None:
        """Join the first node, which takes no other while it starts, though its port is open."""
        until_s = time.monotonic() + _START_S
        while True:
            try:
                self._control(number, "join_cluster", self._node(0))
                return
            except subprocess.CalledProcessError:
                if time.monotonic() > until_s:
                    raise
            time.sleep(1.0)

    def _node(self, number: int) -> str:
        return f"n{number}@127.0.0.{number + 1}"

    def _environment(self) -> dict[str, str]:
        more = {"HOME": str(self._folder), "ERL_LIBS": _LIBRARIES, "ERL_MAX_PORTS": "32000"}
        return os.environ | more | {"ERL_CRASH_DUMP_BYTES": "0"}

    def _erl(self, name: str, *more: str) -> list[str]:
        common = (
            f"-kernel logger_level error -erl_epmd_port {self._distribution} -start_epmd false "
            # A change of the ticking time takes effect after a minute; this one holds at once.
            f"-kernel net_ticktime {self._tick_s}"
        )
        return ["erl", "-name", name, *common.split(), "-noinput", *more]

    def _run(self, number: int) -> "subprocess.Popen[bytes]":
        home = self._folder / str(number)
        environment = self._environment() | {
            "EJABBERD_CONFIG_PATH": str(home / "ejabberd.yml"),
            "EJABBERD_LOG_PATH": str(home / "ejabberd.log"),
            "EJABBERD_PID_PATH": str(home / "pid"),
        }
        command = self._erl(
            self._node(number),
            *("-kernel", "inet_dist_use_interface", f"{{127,0,0,{number + 1}}}"),
            # Three of them share this machine: none spins while it waits.
            *("+sbwt", "none", "+sbwtdcpu", "none", "+sbwtdio", "none"),
            *("+P", "250000", "-mnesia", "dir", f'"{home}/spool"', "-s", "ejabberd"),
        )
        with (home / "out").open("ab") as log:
            return subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=home,
                env=environment,
                start_new_session=True,
            )

    def _control(self, number: int, *command: str) -> None:
        self._ask("-s", "ejabberd_ctl", "-extra", self._node(number), *command)

    def _ask(self, *arguments: str) -> None:
        name = f"control{os.getpid()}-{time.monotonic_ns()}@127.0.0.1"
        subprocess.run(
            self._erl(name, "-hidden", "-dist_listen", "false", *arguments),
            cwd=self._folder,
            env=self._environment(),
            check=True,
            timeout=_START_S,
            stdout=subprocess.DEVNULL,
        )

    def _wait(self, number: int) -> None:
        until_s = time.monotonic() + _START_S
        while time.monotonic() < until_s:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self._ports[number]), 1):
                return
            time.sleep(0.1)
        raise RuntimeError(f"ejabberd {number} did not start; see {self._folder}/{number}")

    def _signal(self, number: int, what: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._processes[number].pid, what)

    def kill(self, number: int) -> None:
        self._signal(number, signal.SIGKILL)
        self._processes[number].wait()

    def start(self, number: int) -> None:
        self._processes[number] = self._run(number)
        self._wait(number)

    def freeze(self, number: int) -> None:
        self._signal(number, signal.SIGSTOP)

    def resume(self, number: int) -> None:
        self._signal(number, signal.SIGCONT)

    def cpu_s(self) -> float:
        running = [one.pid for one in self._processes if one.poll() is None]
        return sum(bench_fleet.cpu_of_s(pid) for pid in running)


@contextmanager
def ejabberds(tick_s: int = _STOCK_TICK_S, *, in_memory: bool = True) -> Iterator[Ejabberds]:
    """Run a cluster for as long as the block lasts."""
    with tempfile.TemporaryDirectory() as folder:
        cluster = Ejabberds(Path(folder), tick_s, in_memory=in_memory)
        try:
            cluster.form()
            yield cluster
        finally:
            for number in range(len(cluster._processes)):
                cluster.kill(number)


def main() -> None:
    """Measure a fleet over the cluster."""
    parser = argparse.ArgumentParser(description=__doc__)
    plan = bench_fleet.FleetPlan()
    parser.add_argument("--robots", type=int, default=plan.robots)
    parser.add_argument("--pace", type=float, default=plan.pace)
    parser.add_argument("--health", type=float, default=plan.health_s, metavar="S")
    parser.add_argument("--phase", type=float, default=plan.phase_s, metavar="S")
    parser.add_argument("--plain", action="store_true", help="as `skin bench fleet --full`")
    parser.add_argument("--tick", type=int, default=_STOCK_TICK_S, metavar="S")
    parser.add_argument("--files", action="store_true", help="retained in files, as installed")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # and end the nodes
    plan = bench_fleet.FleetPlan(given.robots, given.pace, given.health, given.phase, given.plain)
    with ejabberds(given.tick, in_memory=not given.files) as cluster:
        document = bench_fleet.measure(cluster, plan)
    sys.stdout.write(bench_fleet.describe(document) + "\n")


if __name__ == "__main__":
    main()
