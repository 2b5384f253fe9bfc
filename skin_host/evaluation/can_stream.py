"""A stream of skin frames, sent at an exact pace by a separate process.

Boards of sixteen triangles send their bursts one after the other, evenly over the period, at the
spacing of a full 1 Mbit/s bus (8000 frames a second), or closer for higher rates.
"""

import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

import msgspec
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.interfaces import NETWORKS, can_interfaces
from skin_host.bus.wire import TRIANGLES, encode_sweep
from skin_host.config.settings import Bus, Settings
from skin_host.evaluation.stand_in import HOST, INTERFACE, StandInBus, register

BUS = "can0"
FULL_BUS_FRAMES_PER_S = 8000
FRAMES_PER_SWEEP = 2 * TRIANGLES
#: With this period seven boards fill a bus (about the fastest an AD7147 can be read).
_PERIOD_S = 0.028
_MOST_BOARDS = 14
CAN_FRAME = struct.Struct("=IB3x8s")


@dataclass(frozen=True, slots=True)
class FrameStream:
    """The sent stream. `frames_per_s` 0 means as fast as the sender can.

    Attributes:
        boards: how many, at addresses 1, 2, ...
        period_ms: of each board.
    """

    frames_per_s: int
    boards: int
    period_ms: int

    @classmethod
    def of(cls, frames_per_s: int) -> "FrameStream":
        """The fewest boards that make this rate at a period of 28 ms or more, at most 14."""
        if frames_per_s == 0:
            return cls(0, _MOST_BOARDS, 10)
        wanted = -(-frames_per_s * _PERIOD_S // FRAMES_PER_SWEEP)
        boards = min(_MOST_BOARDS, int(wanted))
        return cls(frames_per_s, boards, round(1e3 * boards * FRAMES_PER_SWEEP / frames_per_s))

    def settings(self, bus: Bus) -> Settings:
        """A configuration with these boards on this bus, each one part."""
        names = [f"board{number + 1}" for number in range(self.boards)]
        document = {
            "robot": "bench",
            "buses": {BUS: bus},
            "boards": {
                name: {"bus": BUS, "address": number + 1, "period_ms": self.period_ms}
                for number, name in enumerate(names)
            },
            "parts": {
                name: {"patches": [{"board": name, "triangles": f"0-{TRIANGLES - 1}"}]}
                for name in names
            },
        }
        return msgspec.convert(msgspec.to_builtins(document), Settings)

    def period(self, raw: NDArray[np.uint8]) -> list[tuple[float, bytes]]:
        """One period's frames as (time from its start in s, struct can_frame), in order.

        Args:
            raw: uint8[boards, 16, 12], the values to send.
        """
        spacing_s = 1.0 / max(self.frames_per_s, FULL_BUS_FRAMES_PER_S)
        frames = []
        for board in range(self.boards):
            ids, data = encode_sweep(
                board + 1, np.arange(TRIANGLES), raw[board], np.zeros(TRIANGLES, np.uint16)
            )
            start_s = board * self.period_ms * 1e-3 / self.boards
            frames += [
                (start_s + i * spacing_s, CAN_FRAME.pack(identifier, 8, row.tobytes()))
                for i, (identifier, row) in enumerate(zip(ids.tolist(), data, strict=True))
            ]
        return sorted(frames, key=lambda frame: frame[0])


@dataclass(frozen=True, slots=True)
class StreamWire:
    """Where the stream runs: a vcan interface, or a stand-in of datagram sockets.

    Attributes:
        vcan: name of the interface, None for the stand-in.
        ports: of the stand-in's receiver and sender.
    """

    vcan: str | None
    ports: tuple[int, int] = (0, 0)

    @classmethod
    def here(cls) -> "StreamWire":
        """The first vcan interface that is up, else a new stand-in."""
        for name in can_interfaces():
            flags = NETWORKS / name / "flags"
            if name.startswith("vcan") and int(flags.read_text(), 16) & 1:
                return cls(name)
        with StandInBus() as one, StandInBus() as other:
            return cls(None, (one.port, other.port))

    @property
    def transport(self) -> str:
        """As the benchmarks name it."""
        return "vcan" if self.vcan else "stand-in"

    def bus(self) -> Bus:
        """Bus of a configuration that receives from this wire; to be called in each process."""
        if self.vcan:
            return Bus(channel=self.vcan)
        register()
        receiver, sender = self.ports
        return Bus(interface=INTERFACE, channel=f"{receiver}-{sender}")

    def sender(self) -> Callable[[bytes], object]:
        """Opens a socket; returns what sends a `struct can_frame` over it."""
        if self.vcan:
            can_socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            can_socket.bind((self.vcan,))
            return can_socket.send
        receiver, sender = self.ports
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((HOST, sender))
        # Not connected: as on a bus, a missing receiver is not an error.
        return lambda frame: sock.sendto(frame, (HOST, receiver))


def send(
    parent: Connection,
    wire: StreamWire,
    stream: FrameStream,
    seconds: float,
    scenes: list[NDArray[np.uint8]],
) -> None:
    """Process: send for `seconds`; report to the parent the begin and the number of frames.

    Args:
        parent: gets None at the begin, the number of frames at the end. A number from it
            chooses another scene.
        wire: the medium.
        stream: pace and boards.
        seconds: for how long, rounded up to whole periods.
        scenes: each uint8[k, boards, 16, 12]; each period takes the next of the k, round and
            round. The first scene is the one to begin with.
    """
    push = wire.sender()
    periods = [[stream.period(raw) for raw in scene] for scene in scenes]
    scene = periods[0]
    now = time.perf_counter
    parent.send(None)
    sent = number = 0
    elapsed_s = 0.0
    start_s = now()
    while elapsed_s < seconds:
        if parent.poll():
            scene = periods[parent.recv()]
        period = scene[number % len(scene)]
        if stream.frames_per_s:
            # A sleep would be late; the sender has its own core and spins.
            period_at_s = start_s + elapsed_s
            for offset_s, frame in period:
                while now() < period_at_s + offset_s:
                    pass
                push(frame)
            elapsed_s += stream.period_ms * 1e-3
        else:
            for _, frame in period:
                push(frame)
            elapsed_s = now() - start_s
        sent += len(period)
        number += 1
    parent.send(sent)
