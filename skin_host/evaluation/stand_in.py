"""Datagram sockets in place of SocketCAN, where the kernel has none.

They carry the same 16 bytes a frame, with the same time stamps, drop counter and one-shot
errors, so that both our reader and python-can's own SocketCAN code run on them unchanged.
What a frame costs on the way through the kernel is that of UDP, not that of CAN.
"""

import socket
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus
from can.typechecking import CanFilters

HOST = "127.0.0.1"
#: python-can's name for it, once `register` was called.
INTERFACE = "stand-in"
#: SO_TIMESTAMPNS, as python-can sets it on its sockets (asm-generic/socket.h).
_SO_TIMESTAMPNS = 35


class StandInBus(SocketcanBus):
    """python-can's SocketCAN bus on a datagram socket of the local host.

    Args:
        channel: "RECEIVE-SEND", the two ports of this end; 0 is a free one, and no peer.
    """

    def __init__(self, channel: str = "0-0", **_options: Any) -> None:
        receive, _, peer = channel.partition("-")
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            self.socket.bind((HOST, int(receive)))
        except OSError:
            self.socket.close()
            raise
        self.port: int = self.socket.getsockname()[1]
        self.channel = channel
        self.channel_info = f"stand-in channel '{channel}'"
        self._bcm_sockets: dict[str, socket.socket] = {}
        self._is_filtered = False
        can.BusABC.__init__(self, channel=channel)
        if int(peer):
            self.connect(int(peer))

    def connect(self, port: int) -> None:
        """Send to this port from now on, and receive from it alone."""
        self.socket.connect((HOST, port))

    def _apply_filters(self, filters: CanFilters | None) -> None:
        """A datagram socket has no identifiers to filter by."""


def pair() -> tuple[StandInBus, StandInBus]:
    """Two connected ends of one bus."""
    ours, theirs = StandInBus(), StandInBus()
    ours.connect(theirs.port)
    theirs.connect(ours.port)
    return ours, theirs


def register() -> None:
    """Make `can.Bus(interface="stand-in", ...)` known in this process."""
    can.interfaces.BACKENDS[INTERFACE] = (__name__, StandInBus.__name__)
    can.VALID_INTERFACES = frozenset(can.interfaces.BACKENDS)
