"""The rim of the emulator: its side of a python-can bus."""

import logging
from collections.abc import Iterator

import can

from skin_host.bus.protocol import FrameBatch, MessageClass

log = logging.getLogger(__name__)

#: Boards act on commands only; the frames of other boards are not for them.
_COMMANDS: list[can.typechecking.CanFilter] = [
    {"can_id": message_class << 8, "can_mask": 0x7F0, "extended": False}
    for message_class in (MessageClass.ANALOG_COMMAND, MessageClass.MANAGEMENT)
]
#: Frames kept for a controller that does not take them now.
WAITING_FRAMES = 2000


class Link:
    """Sends what boards send, and gives what a host commands.

    Attributes:
        sent, lost: frames that the bus took, and that it did not (too slow, down, bus-off).
    """

    def __init__(self, name: str, bus: can.BusABC) -> None:
        self._name = name
        self._bus = bus
        self._bus.set_filters(_COMMANDS)
        self._waiting: list[can.Message] = []
        self._failing = False
        self.sent = 0
        self.lost = 0

    def received(self) -> Iterator[tuple[int, bytes]]:
        """Commands that have come since the last call: identifier and data."""
        while True:
            try:
                message = self._bus.recv(timeout=0)
            except can.CanOperationError as error:
                self._complain(error)
                return
            if message is None:
                return
            if not (message.is_extended_id or message.is_remote_frame or message.is_error_frame):
                yield message.arbitration_id, bytes(message.data)

    def send(self, batch: FrameBatch) -> None:
        """Send frames in their order; what the controller does not take waits, or is lost."""
        messages = self._waiting + [
            can.Message(
                arbitration_id=can_id, data=data[:dlc].tobytes(), dlc=dlc, is_extended_id=False
            )
            for can_id, dlc, data in zip(
                batch.id.tolist(), batch.dlc.tolist(), batch.data, strict=True
            )
        ]
        self._waiting = []
        for number, message in enumerate(messages):
            try:
                self._bus.send(message)
            except can.CanOperationError as error:
                self._complain(error)
                rest = messages[number:]
                self._waiting = rest[:WAITING_FRAMES]
                self.lost += len(rest) - len(self._waiting)
                return
            self.sent += 1
        self._failing = False

    def _complain(self, error: can.CanError) -> None:
        if not self._failing:
            log.warning("bus %s: %s; frames wait or are lost until it works", self._name, error)
        self._failing = True
