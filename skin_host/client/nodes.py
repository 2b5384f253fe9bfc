"""What the robot's nodes publish of themselves: their statuses, and which parts they have. Pure:
takes times.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from skin_host.client.heard import Described
from skin_host.client.presence import Presence
from skin_host.config.sizes import too_large
from skin_host.mqtt.info import NodeInfo, PartInfo, decode_info, join_pieces
from skin_host.mqtt.order import Stamp
from skin_host.mqtt.payload import MessageError

#: No robot has so many parts, nor so many nodes; messages of more than these are passed over.
MAX_NAMES = 256
#: Of the infos of all its nodes; an iCub's has 0.4 MB.
MAX_INFO_BYTES = 32 * 1024 * 1024


@dataclass
class Node:
    """A daemon of the robot. `online` is None while that is not known.

    So it is until its status was received; without a broker; while the messages of all its parts
    that are followed come too late or not at all; and, with several brokers, after its connection
    ended without a word: it may have another one by then.
    """

    online: bool | None = None
    info: NodeInfo | None = None
    #: Whether the broker has its status.
    has_status: bool = field(default=False, repr=False)
    #: Pieces of its info, by number.
    pieces: dict[int, NodeInfo] = field(default_factory=dict, repr=False)
    #: Their lengths as messages, in bytes.
    sizes: dict[int, int] = field(default_factory=dict, repr=False)


class Nodes:
    """The nodes of a robot, by name, and the parts that they describe.

    Args:
        presence: learns who is online, and who has which part.

    Attributes:
        known: those of which anything is retained.
        named_s: when one of them named its parts last; -inf: none has.
    """

    def __init__(self, presence: Presence) -> None:
        self.known: dict[str, Node] = {}
        self.named_s = -math.inf
        self._presence = presence
        #: The parts as they were described last, see `changes`.
        self._described: dict[str, Described] = {}
        self._info_bytes = 0

    def take_status(
        self,
        name: str,
        online: bool | None,
        now_s: float,
        broker: int,
        *,
        again: bool,
        parts: Iterable[str],
        deleted: bool,
    ) -> None:
        """Take the newest status of a node, see `Presence.take_node`.

        Args:
            name: of the node.
            online: whether it is; None: its connection ended, or the status was deleted.
            now_s: the time.
            broker: from which it came.
            again: it came from another broker before.
            parts: of which it publishes, as far as the status names them.
            deleted: the broker has no status of it any more.
        """
        self._presence.take_node(name, online, now_s, broker, again=again, parts=parts)
        self.named_s = now_s
        self.known.setdefault(name, Node()).has_status = not deleted
        self._forget_if_deleted(name, now_s)

    def take_info(
        self, name: str, piece: int, payload: bytes, stamp: Stamp | None, now_s: float
    ) -> None:
        """Take a piece of the info of a node; an empty one was deleted.

        Raises:
            MessageError: it cannot be read, describes a part that no robot has, or the infos of
                all nodes are too long.
        """
        node = self.known.setdefault(name, Node())
        self._info_bytes -= node.sizes.pop(piece, 0)
        node.pieces.pop(piece, None)
        if payload:
            if self._info_bytes + len(payload) > MAX_INFO_BYTES:
                raise MessageError(f"info: more than {MAX_INFO_BYTES} bytes of one robot")
            info = decode_info(payload)
            for part, described in info.parts.items():
                _check_size(part, described)
            node.pieces[piece] = info
            node.sizes[piece] = len(payload)
            self._info_bytes += len(payload)
        node.info = join_pieces(node.pieces)
        if node.info is not None:
            named = [*node.info.parts, *node.info.fingertips]
            self._presence.take_info(name, named, now_s, stamp)
            self.named_s = now_s
        elif not node.pieces:
            self._presence.forget_info(name, now_s)
            self._forget_if_deleted(name, now_s)

    def _forget_if_deleted(self, name: str, now_s: float) -> None:
        """Forget a node of which nothing is retained any more: neither its status nor its info."""
        if not self.known[name].pieces and not self.known[name].has_status:
            del self.known[name]
            self._presence.forget_node(name, now_s)

    def watch(self, now_s: float) -> None:
        """Note who is still online."""
        for name, node in self.known.items():
            node.online = self._presence.online(name, now_s)

    @property
    def are_described(self) -> bool:
        """Whether there are nodes, and all that are online have described their parts."""
        nodes = self.known.values()
        # Infos come before the statuses, which show whose parts they are.
        return (
            all(node.has_status for node in nodes)
            and all(node.info or not node.online for node in nodes)
            and any(node.info for node in nodes)
        )

    def parts(self) -> dict[str, Described]:
        """Return the parts and fingertips by name, as the node describes them that has them now."""
        found = {}
        for part, node in self._presence.holders.items():
            info = self.known[node].info if node in self.known else None
            if info is not None:
                described = info.parts.get(part) or info.fingertips.get(part)
                found[part] = Described(part, node, described)
        return found

    def described(self) -> Iterable[Described]:
        """Return the descriptions that `changes` yielded last."""
        return self._described.values()

    def changes(self) -> Iterator[Described]:
        """Yield what has changed since it was asked for last; `info` is None of a part that no node
        names any more.
        """
        now = self.parts()
        gone = self._described.keys() - self._presence.holders.keys()
        changed = [one for part, one in now.items() if self._described.get(part) != one]
        for described in [*(Described(part, "", None) for part in gone), *changed]:
            if described.info is None:
                del self._described[described.part]
            elif described.part in self._described or len(self._described) < MAX_NAMES:
                self._described[described.part] = described
            else:
                continue
            yield described


def _check_size(name: str, part: PartInfo) -> None:
    """Refuse a part of a size that none of a robot has.

    Raises:
        MessageError: it is too wide, too far from its origin, or one of its pads is too large.
    """
    places = chain(part.position_m, *(triangle.outline_m for triangle in part.triangles))
    axes = list(zip(*places, strict=True))
    why = too_large(map(min, axes), map(max, axes), max(part.radius_mm, default=0.0))
    if why:
        raise MessageError(f"info: parts.{name}: {why}")
