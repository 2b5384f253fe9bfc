"""Opens buses with python-can: chooses the port for an interface."""

import logging
from concurrent.futures import Future

import can
from can.interfaces.socketcan import SocketcanBus

from skin_host.bus import adapters, socketcan
from skin_host.bus.pair import PAIR, PairPort
from skin_host.bus.port import Port
from skin_host.clock import SYSTEM, Clock, Executor
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError, SkinError

log = logging.getLogger(__name__)


def open_port(
    name: str, bus: Bus, receive: Receive, *, wait: bool = False, clock: Clock = SYSTEM
) -> Port:
    """Open a bus with python-can.

    Args:
        name: of the bus in the configuration, for messages.
        bus: interface and channel.
        receive: size of the buffer.
        wait: treat an interface that cannot be opened now like one that was unplugged: return a
            port that waits for it.
        clock: for waiting.

    Raises:
        ConfigurationError: python-can has no such kind of interface.
        BusError: the interface is absent, down, not CAN, not permitted, or not supported, or its
            package is not installed, and `wait` is not set.
    """
    if bus.interface == PAIR:
        return PairPort(name, bus, clock)
    opened: can.BusABC | None
    unopened: SkinError | None = None
    worker: Executor | None = None
    opening: Future[can.BusABC] | None = None
    try:
        if bus.interface == "socketcan":
            opened = socketcan.open_checked(name, bus)
        else:
            # In a thread: some libraries wait for ever for what does not answer.
            worker = clock.executor(f"adapter-{name}")
            opening = worker.submit(adapters.open_bus, name, bus)
            opened = _opened(name, bus, opening)
    except SkinError as error:
        if not wait or not isinstance(error, BusError):
            if worker is not None:
                worker.close()
            raise
        log.warning("%s; waiting for it", error)
        opened, unopened = None, error
    if bus.interface == "socketcan":
        return socketcan.SocketCanPort(
            name, bus, receive, opened, lambda: socketcan.open_present(name, bus), clock
        )
    if isinstance(opened, SocketcanBus):
        if worker is not None:
            worker.close()
        return socketcan.SocketCanPort(
            name, bus, receive, opened, lambda: adapters.open_bus(name, bus), clock
        )
    if opening is not None and opening.done():
        opening = None
    port = adapters.AdapterPort(name, bus, opened, clock, worker, opening)
    if unopened is not None:
        port.note_unopened(unopened)
    return port


def _opened(name: str, bus: Bus, opening: "Future[can.BusABC]") -> can.BusABC:
    try:
        return opening.result(adapters.OPEN_S)
    except TimeoutError:
        raise adapters.no_answer(name, bus) from None


def open_bus(name: str, bus: Bus) -> can.BusABC:
    """Open a bus for callers that use python-can directly, such as the emulator.

    Raises:
        ConfigurationError: python-can has no such kind of interface.
        BusError: the interface is absent, down, not CAN, not permitted, or not supported, its
            package is not installed, or it does not answer.
    """
    if bus.interface == "socketcan":
        return socketcan.open_checked(name, bus)
    # In a thread, as `open_port` does it.
    worker = SYSTEM.executor(f"adapter-{name}")
    try:
        return _opened(name, bus, worker.submit(adapters.open_bus, name, bus))
    finally:
        worker.close()
