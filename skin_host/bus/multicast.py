"""python-can's bus of UDP datagrams to a multicast group, for datagrams from anybody."""

from typing import Annotated

import can
import msgspec
from can.interfaces.udp_multicast import UdpMulticastBus

#: A frame of CAN FD has so many bytes at most.
LONGEST = 64


class _Datagram(msgspec.Struct):
    """What python-can sends as one frame; of what else is in a datagram, nothing is made."""

    arbitration_id: int
    is_extended_id: bool
    is_remote_frame: bool
    is_error_frame: bool
    dlc: Annotated[int, msgspec.Meta(ge=0, le=LONGEST)]
    data: Annotated[bytes, msgspec.Meta(max_length=LONGEST)]
    is_fd: bool = False


_DECODER = msgspec.msgpack.Decoder(_Datagram)


class MulticastBus(UdpMulticastBus):
    """The same on the wire, but types and sizes are checked before anything is made of them.

    python-can makes a `bytearray` of whatever a datagram calls its data: of a number, one of so
    many bytes.
    """

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        received = self._multicast.recv(timeout)
        if not received:
            return None, False
        datagram, _, timestamp_s = received
        try:
            frame = _DECODER.decode(datagram)
        except (msgspec.MsgspecError, RecursionError) as error:
            raise can.CanOperationError("a datagram that is no frame") from error
        return (
            can.Message(
                timestamp=timestamp_s,
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
