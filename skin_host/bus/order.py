"""The order in which a board usually sends the frames of a sweep: how it is learnt, and the values
of a sweep that came in it.

A sweep of known order is recognised by one comparison of bytes, and its values are gathered by one
call of numpy, whatever the order and wherever the frames lie in memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from skin_host.bus.wire import (
    ALL_TRIANGLES,
    HEAD_BYTES,
    NO_STATUS,
    TAXELS,
    TRIANGLES,
    VALUES_A,
)

_T = TypeVar("_T", bound=np.generic)

#: Fewer frames than this are taken one by one: that costs no more.
SHORTEST_RUN = 5
#: Where a frame's head has its length.
_DLC_AT = 4
#: Up to here heads identify a frame; then follows what is not read, and the header.
_PAD_AT = 5
#: After so many sweeps in another order than the known one, which lost frames cause too, the order
#: is learnt again, after a pause of so many sweeps.
_MOST_STRAY_SWEEPS = 4
_LEARN_AFTER_SWEEPS = 64


class Order(NamedTuple):
    """The order in which a board sends the frames of its sweeps.

    Attributes:
        heads: of all frames, `HEAD_BYTES` each.
        places: of each frame, its place among the board's values.
        first: the half of the first frame.
        missing: masks of the halves that are missing before each frame, and after the last.
        n: how many frames.
        keys: what of the heads identifies the frames: identifier, DLC, and the data's header.
        values: where `gathers` have the values: after the keys, before the status words.
        no_status: the status words of a sweep without any.
        triangles: those that it sends, in rising order; None for all.
        gathers: by the size of a record and the place of its head, the places of the keys of all
            frames, and of the values and then the status words of all triangles, among the octets
            of a sweep.
    """

    heads: bytes
    places: list[int]
    first: int
    missing: list[int]
    n: int
    keys: bytes
    values: slice
    no_status: bytes
    triangles: NDArray[np.intp] | None
    gathers: dict[tuple[int, int], NDArray[np.intp]]

    @classmethod
    def of(cls, came: Sequence[tuple[bytes, int, int]]) -> "Order":
        """Return that of a sweep, from (head, place, missing before it) of its frames."""
        heads, places, missing = zip(*came, strict=True)
        triangles = np.array(sorted({place // 2 for place in places}), np.intp)
        n = len(places)
        keys = b"".join(head[:_PAD_AT] + head[-1:] for head in heads)
        return cls(
            b"".join(heads),
            list(places),
            1 << places[0] // 2 + places[0] % 2 * TRIANGLES,
            [*missing, 0],
            n,
            keys,
            slice(len(keys), len(keys) + n // 2 * TAXELS),
            bytes(n),
            None if len(triangles) == TRIANGLES else triangles,
            {},
        )

    def values_of(
        self, frames: NDArray[np.uint8], size: int, head: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]] | None:
        """Return the values and status words of a sweep, as `Sweep` has them; None if its frames
        came in another order.

        Args:
            frames: their records, one after the other.
            size: of a record.
            head: where in each its head begins.
        """
        gather = self.gathers.get((size, head))
        if gather is None:
            gather = self.gathers[size, head] = self._gather(size, head)
        # One call of numpy for all that is needed of the frames.
        got = frames[gather]
        line = got.tobytes()
        if not line.startswith(self.keys):
            return None
        raw = got[self.values].reshape(-1, TAXELS)
        status = NO_STATUS
        if not line.endswith(self.no_status):
            status = got[self.values.stop :].view(">u2").astype(np.uint16)
        if self.triangles is not None:
            raw = _spread(raw, self.triangles)
            if status is not NO_STATUS:
                status = _spread(status, self.triangles)
        return raw, status

    def _gather(self, size: int, head: int) -> NDArray[np.intp]:
        """Return the one of `gathers` for records of this form."""
        data = head + HEAD_BYTES
        begins = {place: number * size for number, place in enumerate(self.places)}
        triangles = sorted({place // 2 for place in self.places})
        places: list[int] = []
        for number in range(self.n):
            begin = number * size + head
            places += [*range(begin, begin + _PAD_AT), begin + HEAD_BYTES - 1]
        for triangle in triangles:
            for half, count in enumerate((VALUES_A, TAXELS - VALUES_A)):
                begin = begins[2 * triangle + half] + data
                places += range(begin, begin + count)
        for triangle in triangles:
            begin = begins[2 * triangle + 1] + data + TAXELS - VALUES_A
            places += begin, begin + 1
        return np.array(places, np.intp)


@dataclass(slots=True)
class BoardOrder:
    """What is known of the order of one board.

    Attributes:
        known: the order, once it is learnt.
        stray: sweeps in succession with frames in another order.
        learn_after: so many sweeps pass before the order is learnt.
        rises: whether the order that was known last is that of the places, wherever it begins.
    """

    known: Order | None = None
    stray: int = 0
    learn_after: int = 1
    rises: bool = False

    def begin_sweep(self) -> bool:
        """Note that a sweep begins while no order is known; return whether it may show it."""
        if self.learn_after:
            self.learn_after -= 1
            return False
        return True

    def learn(self, came: Sequence[tuple[bytes, int, int]]) -> Order | None:
        """Return the order of a complete sweep, known from now on, if its frames are of full
        length.

        Args:
            came: (head, place, missing before it) of each of its frames.
        """
        if len(came) < SHORTEST_RUN or any(head[_DLC_AT] < 8 for head, _, _ in came):
            self.learn_after = _LEARN_AFTER_SWEEPS
        else:
            self.known = Order.of(came)
            places = self.known.places
            falls = [a > b for a, b in zip(places, [*places[1:], places[0]], strict=True)]
            self.rises = sum(falls) == 1
        return self.known

    def ends(self, bit: int, sent: int) -> bool:
        """Return whether a half is one of the end of a sweep of which some others came.

        That can be known of boards that send triangle after triangle in rising order. Any other
        order may have been learnt from the end of one sweep and the beginning of the next, which
        show nothing of where it begins.

        Args:
            bit: of the half.
            sent: mask of the others.
        """
        last = max(_place(sent & ALL_TRIANGLES), _place(sent & ~ALL_TRIANGLES))
        return self.rises and _place(bit) > last

    def note_stray(self) -> None:
        """Note that a sweep did not come in the known order; too many in succession end that."""
        self.stray += 1
        if self.stray == _MOST_STRAY_SWEEPS:
            self.known, self.stray, self.learn_after = None, 0, _LEARN_AFTER_SWEEPS


def _place(halves: int) -> int:
    """Return the place among a board's values of the last of some A halves, or B halves; -1 without
    any.
    """
    if halves <= ALL_TRIANGLES:
        return 2 * halves.bit_length() - 2 if halves else -1
    return 2 * (halves.bit_length() - TRIANGLES) - 1


def _spread(array: NDArray[_T], triangles: NDArray[np.intp]) -> NDArray[_T]:
    """Return the rows of some triangles [m, ...] among those of all, [16, ...]; others are 0."""
    spread = np.zeros((TRIANGLES, *array.shape[1:]), array.dtype)
    spread[triangles] = array
    return spread
