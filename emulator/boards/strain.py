"""The firmware of a force/torque board (STRAIN2), as the bus sees it.

It answers the same commands as a real one and streams force and torque of the load that
is laid on it. It makes its own bytes: host and board share no encoder.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.bus.wire import (
    BROADCAST_ADDRESS,
    HOST_ADDRESS,
    FrameBatch,
    MessageClass,
    identifier,
)

Floats = NDArray[np.float64]
Frame = tuple[int, bytes]

NS_PER_MS = 1_000_000
_SET_MODE, _SET_PERIOD, _GET_FULL_SCALE = 0x07, 0x08, 0x18
_STOP = 1
#: Command FF of class 7, "who is there?", and the answer: FF, type of board STRAIN2, firmware.
_DISCOVER = 0xFF
_IDENTITY = bytes([_DISCOVER, 12, 2, 0, 9])
#: Frames of each mode: pairs of types (force, torque), and whether they are calibrated.
_STREAMS: dict[int, list[tuple[int, int, bool]]] = {
    0: [(0xA, 0xB, True)],
    1: [],
    3: [(0x8, 0x9, False)],
    4: [(0xA, 0xB, True), (0x8, 0x9, False)],
}


class StrainBoard:
    """One board.

    Args:
        address: 1..14.
        load: gives force (N) and torque (N m) float64[6] on the sensor at a time in ns.
        rng: draws the noise.
        full_scale: N and N m of each of the six channels; whole numbers are reported.
        noise_share: standard deviation of a channel, as a share of its full scale.
        torque_first: sends torque before force; the order is not promised.
    """

    def __init__(
        self,
        address: int,
        load: Callable[[int], ArrayLike],
        rng: np.random.Generator,
        *,
        full_scale: tuple[float, ...] = (2000, 2000, 2000, 40, 40, 40),
        noise_share: float = 5e-5,
        torque_first: bool = False,
    ) -> None:
        self.address = address
        self.period_ms = 10
        self.next_ns: int | None = None
        self._load = load
        self._rng = rng
        self._full_scale = np.array(full_scale, np.float64)
        self._noise_share = noise_share
        self._torque_first = torque_first
        self._mode = _STOP
        self._mixing = np.eye(6) + 0.1 * rng.normal(size=(6, 6))

    def handle(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Take a frame from the bus; give what the board sends back."""
        asked = [
            identifier(MessageClass.MANAGEMENT, HOST_ADDRESS, to)
            for to in (self.address, BROADCAST_ADDRESS)
        ]
        if can_id in asked and data[:1] == _IDENTITY[:1]:
            answer = identifier(MessageClass.MANAGEMENT, self.address, HOST_ADDRESS)
            return [(answer, _IDENTITY)]
        mine = identifier(MessageClass.ANALOG_COMMAND, HOST_ADDRESS, self.address)
        if can_id != mine or len(data) < 2:
            return []
        command, argument = data[0], data[1]
        if command == _SET_MODE and argument in _STREAMS:
            self._mode = argument
            self.next_ns = None if argument == _STOP else t_ns + self.period_ms * NS_PER_MS
        elif command == _SET_PERIOD and argument > 0:
            self.period_ms = argument
        elif command == _GET_FULL_SCALE and argument < 6:
            high, low = divmod(round(self._full_scale[argument]), 256)
            answer = identifier(MessageClass.ANALOG_COMMAND, self.address, HOST_ADDRESS)
            return [(answer, bytes([_GET_FULL_SCALE, argument, high, low]))]
        return []

    def step(self, t_ns: int) -> FrameBatch:
        """Bring the board to `t_ns` and give the frames that it sends by then."""
        frames: list[tuple[int, bytes, int]] = []
        while self.next_ns is not None and self.next_ns <= t_ns:
            frames += self._sample(self.next_ns)
            self.next_ns += self.period_ms * NS_PER_MS
        return FrameBatch.of(frames)

    def _sample(self, t_ns: int) -> list[tuple[int, bytes, int]]:
        share = np.asarray(self._load(t_ns), np.float64) / self._full_scale
        share = share + self._noise_share * self._rng.normal(size=6)
        frames = []
        for force_type, torque_type, calibrated in _STREAMS[self._mode]:
            counts = np.round((share if calibrated else self._mixing @ share) * 0x8000) + 0x8000
            over = (counts < 0) | (counts > 0xFFFF)
            words = np.clip(counts, 0, 0xFFFF).astype(int)
            pair = [
                (force_type, words[:3], over[:3]),
                (torque_type, words[3:], over[3:]),
            ]
            for delay, (kind, three, flags) in enumerate(
                reversed(pair) if self._torque_first else pair
            ):
                data = b"".join(int(word).to_bytes(2, "little") for word in three)
                if flags.any():
                    data += bytes([sum(1 << i for i in np.flatnonzero(flags).tolist())])
                frames.append(
                    (
                        identifier(MessageClass.ANALOG_STREAM, self.address, kind),
                        data,
                        t_ns + 130_000 * delay,  # a frame of 6 bytes lasts this long at 1 Mbit/s
                    )
                )
        return frames
