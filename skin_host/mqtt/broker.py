"""A local broker for the demo: mosquitto if it is installed, otherwise one within Python.

Both listen on this machine only, on a free port, accept every client and store nothing.
"""

import asyncio
import logging
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from skin_host.errors import BrokerError
from skin_host.processes import kept_from_children
from skin_host.tasks import in_tasks

HOST = "127.0.0.1"
START_S = 10.0
#: Where Debian and others install mosquitto, which may not be on the PATH.
_MORE_PLACES = ("/usr/sbin", "/usr/local/sbin")


class LocalBroker(NamedTuple):
    """A running broker: its address and kind."""

    host: str
    port: int
    kind: Literal["mosquitto", "amqtt"]

    @property
    def protocol(self) -> Literal["5", "3.1.1"]:
        """The newest version of MQTT that it speaks."""
        return "5" if self.kind == "mosquitto" else "3.1.1"

    @property
    def url(self) -> str:
        return f"mqtt://{self.host}:{self.port}" + "?protocol=3.1.1" * (self.protocol != "5")

    @property
    def settings(self) -> dict[str, str | int]:
        """Return the values for `settings.changed`."""
        return {"mqtt.host": self.host, "mqtt.port": self.port, "mqtt.protocol": self.protocol}


@asynccontextmanager
async def local_broker() -> AsyncIterator[LocalBroker]:
    """Run a broker for as long as the block lasts.

    Raises:
        BrokerError: there is no mosquitto, and the embedded one is not installed.
    """
    program = find_mosquitto()
    if program is None:
        async with embedded_broker() as broker:
            yield broker
    else:
        async with mosquitto_broker(program) as broker:
            yield broker


def find_mosquitto() -> str | None:
    """Return the path of mosquitto, if it is installed."""
    return shutil.which(
        "mosquitto", path=os.pathsep.join([os.environ.get("PATH", ""), *_MORE_PLACES])
    )


@asynccontextmanager
async def mosquitto_broker(program: str) -> AsyncIterator[LocalBroker]:
    """Run mosquitto as a child process.

    Raises:
        BrokerError: it did not start.
    """
    with (
        reserved_port() as port,
        tempfile.TemporaryDirectory(prefix="skin-broker-") as folder,
    ):
        process = _start_mosquitto(program, port, Path(folder))
        try:
            if not await _answers(process, port):
                said = _last_line(Path(folder)) or "it does not answer"
                raise BrokerError(f"mosquitto did not start on port {port}: {said}")
            yield LocalBroker(HOST, port, "mosquitto")
        finally:
            process.kill()
            process.wait()


@asynccontextmanager
async def embedded_broker() -> AsyncIterator[LocalBroker]:
    """Run amqtt within this event loop. It speaks MQTT 3.1.1 only.

    Raises:
        BrokerError: it is not installed.
    """
    for noisy in ("amqtt", "transitions"):
        logging.getLogger(noisy).setLevel(logging.CRITICAL)
    try:
        from amqtt.broker import Broker
        from amqtt.contexts import BrokerConfig, ListenerConfig
        from amqtt.errors import BrokerError as AmqttError
    except ImportError:
        raise BrokerError(
            "no MQTT broker: neither mosquitto nor the package amqtt is installed; mend it with: "
            "apt install mosquitto, or pip install amqtt"
        ) from None

    class Steady(dict[str, Any]):
        """Iterates over what it held at the start: amqtt waits within its loops over these
        dictionaries while other clients subscribe, and would drop the client or the message.
        """

        def __iter__(self) -> Iterator[str]:
            return iter(list(super().__iter__()))

        def items(self) -> Any:
            return list(super().items())

    class TidyBroker(Broker):  # type: ignore[misc]
        """Ends a connection silently where amqtt lets asyncio report a cancelled task as a
        failure, and knows its subscriptions and messages as `Steady` ones.
        """

        def __init__(self, config: BrokerConfig) -> None:
            super().__init__(config)
            self._subscriptions = Steady()
            self._retained_messages = Steady()
            self._connected = in_tasks(partial(super().stream_connected, listener_name="default"))

        def stream_connected(
            self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, listener_name: str
        ) -> None:
            self._connected(reader, writer)

    everybody = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    with reserved_port() as port:
        listener = ListenerConfig(bind=f"{HOST}:{port}")
        broker = TidyBroker(BrokerConfig(listeners={"default": listener}, plugins=everybody))
        try:
            await broker.start()
        except AmqttError as error:
            raise BrokerError(f"amqtt did not start on port {port}: {error}") from None
    try:
        yield LocalBroker(HOST, port, "amqtt")
    finally:
        await broker.shutdown()


def _start_mosquitto(program: str, port: int, folder: Path) -> "subprocess.Popen[bytes]":
    configuration = folder / "mosquitto.conf"
    configuration.write_text(
        f"listener {port} {HOST}\nallow_anonymous true\npersistence false\n"
        "log_dest stderr\nlog_type error\nlog_type warning\n"
    )
    with (folder / "log").open("wb") as log, kept_from_children(signal.SIGINT):
        # It must not end before its clients disconnect, also when the terminal is closed.
        return subprocess.Popen(
            [program, "-c", configuration],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )


def _last_line(folder: Path) -> str:
    return (folder / "log").read_text(errors="replace").strip().rpartition("\n")[2]


async def _answers(process: "subprocess.Popen[bytes]", port: int) -> bool:
    """Wait until the broker takes connections."""
    deadline_s = time.monotonic() + START_S
    while process.poll() is None and time.monotonic() < deadline_s:
        try:
            _, writer = await asyncio.open_connection(HOST, port)
        except OSError:
            await asyncio.sleep(0.01)
        else:
            writer.close()
            return True
    return False


@contextmanager
def reserved_port(host: str = HOST) -> Iterator[int]:
    """Yield a port that no other program gets as a free one while the block lasts.

    A server can listen there nevertheless, as servers permit the reuse of addresses. Without that,
    another program could listen there first, and be taken for the broker.
    """
    with socket.socket() as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        holder.bind((host, 0))
        yield holder.getsockname()[1]


def free_port(host: str = HOST) -> int:
    """Return a port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind((host, 0))
        port: int = probe.getsockname()[1]
        return port
