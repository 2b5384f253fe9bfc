"""The frames of a whole body on as many buses as it needs, sent by a separate process.

A bus carries no more than a real one of 1 Mbit/s. The buses are stand-ins, see `stand_in`. Unlike
`can_stream` the sender sleeps between its frames, a millisecond at a time: a body has too many
buses for a sender with its own core. The frames of a bus and a millisecond are made beforehand and
leave in one system call, which the kernel divides into datagrams (UDP_SEGMENT): a third of the CPU
of as many calls, which leaves it to the receivers.
"""

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import TAXELS, TRIANGLES, encode_sweep
from skin_host.config.settings import Settings
from skin_host.evaluation.can_stream import CAN_FRAME, FRAMES_PER_SWEEP, FULL_BUS_FRAMES_PER_S
from skin_host.evaluation.stand_in import HOST, INTERFACE, StandInBus

#: So many boards make one part of the body.
BOARDS_PER_PART = 4
_MOST_BOARDS = 14
_TICK_S = 1e-3
#: A sender that is later than this continues from now: it must not send a burst of old frames.
_LATEST_S = 0.1
#: Socket option and its level: a message becomes datagrams of this size (linux/udp.h).
_SOL_UDP, _UDP_SEGMENT = 17, 103
#: The frames of one bus and tick.
_Burst = tuple[int, bytes]


@dataclass(frozen=True, slots=True)
class Body:
    """Boards of 16 triangles, in parts of four boards; the last board may have fewer.

    Attributes:
        triangles: how many in all.
        period_ms: of each board.
        ports: of each bus, its receiver's and its sender's.
    """

    triangles: int
    period_ms: int
    ports: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, taxels: int, hz: int) -> "Body":
        """The fewest triangles that have so many taxels, on the fewest buses that carry them."""
        triangles = -(-taxels // TAXELS)
        boards = -(-triangles // TRIANGLES)
        buses = -(-boards // _boards_per_bus(hz))
        ends = [(StandInBus(), StandInBus()) for _ in range(buses)]
        ports = tuple((one.port, other.port) for one, other in ends)
        for end in ends:
            for bus in end:
                bus.shutdown()
        return cls(triangles, 1000 // hz, ports)

    @property
    def boards(self) -> int:
        """How many boards."""
        return -(-self.triangles // TRIANGLES)

    @property
    def taxels(self) -> int:
        """How many taxels."""
        return self.triangles * TAXELS

    @property
    def frames_per_s(self) -> float:
        """On all buses together."""
        return 2 * self.triangles * 1e3 / self.period_ms

    def settings(self) -> Settings:
        """A configuration for this body; `stand_in.register` makes its buses known."""
        boards = {}
        parts: dict[str, dict[str, list[object]]] = {}
        for number in range(self.boards):
            bus, place = divmod(number, _boards_per_bus(1000 // self.period_ms))
            name = f"b{number}"
            boards[name] = {"bus": f"can{bus}", "address": place + 1, "period_ms": self.period_ms}
            patch = {"board": name, "triangles": f"0-{self._on_board(number) - 1}"}
            part = parts.setdefault(f"part{number // BOARDS_PER_PART}", {"patches": []})
            part["patches"].append(patch)
        document = {
            "robot": "bench",
            "buses": {
                f"can{number}": {"interface": INTERFACE, "channel": f"{receiver}-{sender}"}
                for number, (receiver, sender) in enumerate(self.ports)
            },
            "boards": boards,
            "parts": parts,
        }
        return msgspec.convert(document, Settings)

    def _on_board(self, number: int) -> int:
        return min(TRIANGLES, self.triangles - number * TRIANGLES)

    def ticks(self, raw: NDArray[np.uint8]) -> list[list[_Burst]]:
        """What one period sends, by milliseconds: (bus, one struct can_frame after the other).

        Args:
            raw: uint8[boards, 16, 12], the values to send.
        """
        per_bus = _boards_per_bus(1000 // self.period_ms)
        ticks: list[dict[int, bytearray]] = [{} for _ in range(self.period_ms)]
        for board in range(self.boards):
            bus, place = divmod(board, per_bus)
            n = self._on_board(board)
            status = np.zeros(n, np.uint16)
            ids, data = encode_sweep(place + 1, np.arange(n), raw[board, :n], status)
            start_ms = place * self.period_ms / per_bus
            for i, (identifier, row) in enumerate(zip(ids.tolist(), data, strict=True)):
                tick = int(start_ms + i * 1e3 / FULL_BUS_FRAMES_PER_S) % self.period_ms
                frame = CAN_FRAME.pack(identifier, 8, row.tobytes())
                ticks[tick].setdefault(bus, bytearray()).extend(frame)
        return [[(bus, bytes(frames)) for bus, frames in tick.items()] for tick in ticks]


#: In place of a scene: send nothing.
PAUSE = -1


def send_body(
    parent: Connection,
    body: Body,
    scenes: list[NDArray[np.uint8]],
    number: int = 0,
    senders: int = 1,
) -> None:
    """Process: send until it is ended.

    Args:
        parent: gets None at the begin; a number from it chooses another scene or `PAUSE`, and is
            answered with how many frames were sent before.
        body: whose frames.
        scenes: each uint8[k, boards, 16, 12], one after the other, round and round. The first
            scene is the one to begin with.
        number, senders: this one sends the buses whose number leaves this rest.
    """
    outs: dict[int, tuple[Callable[[bytes, tuple[str, int]], int], tuple[str, int]]] = {}
    for bus in range(number, len(body.ports), senders):
        receiver, sender = body.ports[bus]
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setsockopt(_SOL_UDP, _UDP_SEGMENT, CAN_FRAME.size)
        sock.bind((HOST, sender))
        outs[bus] = (sock.sendto, (HOST, receiver))
    made = [
        [
            [burst for burst in tick if burst[0] % senders == number]
            for raw in scene
            for tick in body.ticks(raw)
        ]
        for scene in scenes
    ]
    made.append([[]])  # found at `PAUSE`
    ticks = made[0]
    parent.send(None)
    at = sent = 0
    due_s = time.monotonic()
    while True:
        for bus, frames in ticks[at % len(ticks)]:
            push, address = outs[bus]
            sent += push(frames, address) // CAN_FRAME.size
        at += 1
        if parent.poll():
            ticks = made[parent.recv()]
            parent.send(sent)
        due_s += _TICK_S
        now_s = time.monotonic()
        if due_s > now_s:
            time.sleep(due_s - now_s)
        elif now_s - due_s > _LATEST_S:
            due_s = now_s


def _boards_per_bus(hz: int) -> int:
    return min(_MOST_BOARDS, FULL_BUS_FRAMES_PER_S // (FRAMES_PER_SWEEP * hz))
