"""A bus of this machine on which a board sends, for commands that record it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can

from tests.support.candump import write_config


def live(folder: Path, group: str) -> Path:
    """Write the configuration of a board on the bus of a multicast group."""
    path = write_config(folder / "skin.toml")
    bus = f'channel = "{group}"\ninterface = "udp_multicast"'
    path.write_text(path.read_text().replace('channel = "can0"', bus))
    return path


@contextmanager
def talking(group: str) -> Iterator[None]:
    """A board sends on that bus, frames 4E4 of one byte."""
    ended = threading.Event()

    def send() -> None:
        with can.Bus(interface="udp_multicast", channel=group) as bus:
            while not ended.wait(0.01):
                bus.send(can.Message(arbitration_id=0x4E4, data=b"@", is_extended_id=False))

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        ended.set()
        sender.join()
