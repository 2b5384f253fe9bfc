"""A bus of a server of buses (socketcand), which goes on behind a line that is damaged."""

from contextlib import suppress

import can
from can.interfaces.socketcand import SocketCanDaemonBus
from can.interfaces.socketcand.socketcand import convert_ascii_message_to_can_message

#: What python-can's client has received and not read yet, and has read.
_HELD = "_SocketCanDaemonBus__receive_buffer"
_READ = "_SocketCanDaemonBus__message_buffer"


class ServedBus(SocketCanDaemonBus):
    """python-can's client, which keeps the line that it failed over, and those before and behind
    it, and would begin with them again at each line that comes: frames before it would be received
    again and again, and none that comes later.
    """

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            found: tuple[can.Message | None, bool] = super()._recv_internal(timeout)  # type: ignore[no-untyped-call]
        except can.CanError as error:
            if not isinstance(error.__cause__, OSError):
                self._read_past_damage()
            raise
        return found

    def _read_past_damage(self) -> None:
        # python-can gives no other access to it. Where a version has none, it stays as it is.
        state = vars(self)
        if not {_HELD, _READ} <= state.keys():
            return
        *lines, begun = state[_HELD].split(">")
        state[_HELD] = begun
        state[_READ].clear()
        for line in lines:
            with suppress(ValueError, IndexError):
                message = convert_ascii_message_to_can_message(line[line.find("<") :] + ">")
                if message is not None:
                    message.channel = self.channel
                    state[_READ].append(message)
