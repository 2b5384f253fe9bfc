"""python-can's bus of UDP datagrams to a multicast group, for datagrams from anybody."""

import math
from typing import Annotated

import can
import msgspec
from can.interfaces.udp_multicast import UdpMulticastBus

#: A frame of CAN FD has so many bytes at most.
LONGEST = 64
#: A sender's time stamp is believed if it is no longer ago than this: others are of another clock.
LATEST_S = 1.0


class _Datagram(msgspec.Struct):
    """What python-can sends as one frame; of what else is in a datagram, nothing is made."""

    arbitration_id: int
    is_extended_id: bool
    is_remote_frame: bool
    is_error_frame: bool
    dlc: Annotated[int, msgspec.Meta(ge=0, le=LONGEST)]
    data: Annotated[bytes, msgspec.Meta(max_length=LONGEST)]
    is_fd: bool = False
    timestamp: float | None = None


_DECODER = msgspec.msgpack.Decoder(_Datagram)


class MulticastBus(UdpMulticastBus):
    """The same on the wire, but types and sizes are checked before anything is made of them.

    python-can makes a `bytearray` of whatever a datagram calls its data: of a number, one of so
    many bytes.

    A frame has the time that its sender gave it, if that was just now, and else that of its
    arrival. Between two frames that follow each other a busy computer may stop their sender: each
    datagram wakes the process that receives it. Times never run backwards.
    """

    _last_s = -math.inf

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        received = self._multicast.recv(timeout)
        if not received:
            return None, False
        datagram, _, received_s = received
        try:
            frame = _DECODER.decode(datagram)
        except (msgspec.MsgspecError, RecursionError) as error:
            raise can.CanOperationError("a datagram that is no frame") from error
        return (
            can.Message(
                timestamp=self._time_s(frame.timestamp, received_s),
                arbitration_id=frame.arbitration_id,
                is_extended_id=frame.is_extended_id,
                is_remote_frame=frame.is_remote_frame,
                is_error_frame=frame.is_error_frame,
                dlc=frame.dlc,
                data=frame.data,
                is_fd=frame.is_fd,
            ),
            False,
        )

    def _time_s(self, sent_s: float | None, received_s: float) -> float:
        """Return the time of a frame, by what its sender and the kernel stamped it with."""
        if sent_s is None or not received_s - LATEST_S <= sent_s <= received_s:
            sent_s = received_s
        # By the arrival, because the clock may have been set back.
        self._last_s = min(max(sent_s, self._last_s), received_s)
        return self._last_s
