"""A bus between two processes of one machine: a pair of sockets that carries whole batches.

The demo's emulator lives at one end, the daemon at the other; there is no CAN in the kernel. A
message holds records of `FRAME`, so that neither side handles single frames.

Boards on a real bus do not wait for a processor. The emulator does, so it marks up to when its
boards have lived: only so far has the bus been read, and what its boards could not send yet is
neither late nor lost.
"""

import socket
from collections import deque
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from skin_host.bus.port import LinkState, Port
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM, Clock
from skin_host.config.settings import Bus
from skin_host.errors import ConfigurationError

#: Name of the interface; its channels are those that `hand_over` returns.
PAIR = "socketpair"
#: Ends that wait for their port in this process, by channel.
_handed_over: dict[str, socket.socket] = {}
#: Time of day (ns), identifier, length, data.
FRAME = np.dtype([("t_ns", "<i8"), ("id", "<u4"), ("dlc", "u1"), ("data", "u1", (8,))])
#: Identifier of a record that is no frame: everything up to its time has been sent.
MARK = 0xFFFF_FFFF
#: Marks without frames come this often.
MARK_EVERY_NS = 10_000_000
#: An emulator that is farther behind than this counts as one that stands still.
LONGEST_LAG_NS = 60_000_000_000
#: Frames of one message, and of messages that wait for the other side.
MOST_FRAMES = 1024
MOST_WAITING = 20_000


def pair() -> tuple[socket.socket, socket.socket]:
    """The two ends of a bus."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def hand_over(end: socket.socket) -> str:
    """Return the channel by which a port of this process gets an end, once.

    Any number of an open socket would do, also of one that is not ours to read.
    """
    channel = str(end.fileno())
    _handed_over[channel] = end
    return channel


class PairBus(can.BusABC):
    """One end, as a bus of python-can.

    Attributes:
        gone: the other end was closed.
    """

    def __init__(self, end: socket.socket) -> None:
        super().__init__(channel=end.fileno())
        end.setblocking(False)
        self._end = end
        self._read: deque[can.Message] = deque()
        self._waiting: deque[bytes] = deque()
        self._marked_ns = 0
        self.gone = False

    def fileno(self) -> int:
        return self._end.fileno()

    def receive(self) -> NDArray[np.void] | None:
        """The records of one message that waits; None if there is none."""
        try:
            data = self._end.recv(MOST_FRAMES * FRAME.itemsize)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self.gone = True
            return None
        return np.frombuffer(data, FRAME)

    def send_batch(
        self, batch: FrameBatch, host_ns: NDArray[np.int64], until_ns: int | None = None
    ) -> int:
        """Send frames.

        Args:
            batch: the frames.
            host_ns: their times of day, int64[n].
            until_ns: all frames up to this time of day have now been sent.

        Returns:
            How many frames were lost, because the other side is behind.
        """
        n = len(batch)
        records = np.zeros(n, FRAME)
        records["t_ns"], records["id"] = host_ns, batch.id
        records["dlc"], records["data"] = batch.dlc, batch.data
        if until_ns is not None and (n or abs(until_ns - self._marked_ns) >= MARK_EVERY_NS):
            self._marked_ns = until_ns
            mark = np.array([(until_ns, MARK, 0, 0)], FRAME)
            records = np.concatenate([records, mark])
        for first in range(0, len(records), MOST_FRAMES):
            self._waiting.append(records[first : first + MOST_FRAMES].tobytes())
        self._flush()
        lost = 0
        while sum(map(len, self._waiting)) > MOST_WAITING * FRAME.itemsize:
            lost += len(self._waiting.popleft()) // FRAME.itemsize
        return lost

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        record = np.zeros(1, FRAME)
        record["id"], record["dlc"] = msg.arbitration_id, msg.dlc
        record["data"][0, : len(msg.data)] = list(msg.data)
        self._waiting.append(record.tobytes())
        self._flush()

    def _flush(self) -> None:
        while self._waiting:
            try:
                self._end.send(self._waiting[0])
            except BlockingIOError:
                return
            except OSError:
                self.gone = True
                self._waiting.clear()
                return
            self._waiting.popleft()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._read:
            records = self.receive()
            for record in records if records is not None else ():
                self._read.append(_message(record))
        return (self._read.popleft() if self._read else None), False

    def shutdown(self) -> None:
        super().shutdown()
        self._end.close()


def _message(record: Any) -> can.Message:
    return can.Message(
        timestamp=int(record["t_ns"]) * 1e-9,
        arbitration_id=int(record["id"]),
        data=record["data"][: record["dlc"]].tobytes(),
        is_extended_id=False,
    )


class PairPort(Port):
    """The daemon's end: batches come as they were sent.

    Raises:
        ConfigurationError: no end was handed over for this channel.
    """

    #: Whole messages are read: one more may be added below it.
    capacity = 2 * MOST_FRAMES

    def __init__(self, name: str, settings: Bus, clock: Clock = SYSTEM) -> None:
        end = _handed_over.pop(settings.channel, None)
        if end is None:
            raise ConfigurationError(
                f'bus "{name}": interface "{PAIR}" is of `skin demo` alone, which makes its own '
                "channels; wanted another, such as socketcan or udp_multicast"
            )
        self._pair = PairBus(end)
        self._marked_ns: int | None = None
        super().__init__(name, settings, self._pair, clock)

    def read(self) -> FrameBatch:
        messages = []
        n = 0
        while n < self.capacity:
            records = self._pair.receive()
            if records is None:
                break
            if records["id"][-1] == MARK:
                self._marked_ns = int(records["t_ns"][-1])
                records = records[:-1]
            messages.append(records)
            n += len(records)
        if self._pair.gone and self.state is LinkState.UP:
            super().close()
            self._enter(LinkState.GONE, "the other end was closed")
            self._log_state()
        self.counters.frames += n
        records = np.concatenate([np.zeros(0, FRAME), *messages])
        return FrameBatch(
            records["id"].astype(np.uint32),
            records["dlc"].copy(),
            records["data"].copy(),
            records["t_ns"].astype(np.int64),
        )

    def read_until_ns(self, now_ns: int) -> int:
        if self._marked_ns is None or self.state is not LinkState.UP:
            return now_ns
        return max(now_ns - LONGEST_LAG_NS, min(now_ns, self._marked_ns))
