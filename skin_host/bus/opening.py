"""Opens buses with python-can: chooses the port for an interface."""

import logging

import can
from can.interfaces.socketcan import SocketcanBus

from skin_host.bus import adapters, socketcan
from skin_host.bus.pair import PAIR, PairPort
from skin_host.bus.port import Port
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError

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
        BusError: the interface is absent, down, not CAN, not permitted, or not supported, and
            `wait` is not set.
    """
    if bus.interface == PAIR:
        return PairPort(name, bus, clock)
    opened: can.BusABC | None
    try:
        opened = open_bus(name, bus)
    except BusError as error:
        if not wait:
            raise
        log.warning("%s; waiting for it", error)
        opened = None
    if bus.interface == "socketcan":
        return socketcan.SocketCanPort(
            name, bus, receive, opened, lambda: socketcan.open_present(name, bus), clock
        )
    if isinstance(opened, SocketcanBus):
        return socketcan.SocketCanPort(
            name, bus, receive, opened, lambda: adapters.open_bus(name, bus), clock
        )
    return adapters.AdapterPort(name, bus, opened, clock)


def open_bus(name: str, bus: Bus) -> can.BusABC:
    """Open a bus for callers that use python-can directly, such as the emulator.

    Raises:
        ConfigurationError: python-can has no such kind of interface.
        BusError: the interface is absent, down, not CAN, not permitted, or not supported.
    """
    if bus.interface == "socketcan":
        return socketcan.open_checked(name, bus)
    return adapters.open_bus(name, bus)
