"""Topics of one robot below its base, `skin/<robot>`.

The topics of a part do not show which node (daemon) the part belongs to; the topics of a node are
below `nodes/<node>`. `docs/mqtt.md` is the contract.
"""

import re
from typing import Literal, NamedTuple

from skin_host.errors import ConfigurationError, visible

PartTopic = Literal["frame", "touch", "slip", "over", "contact", "health"]
NodeTopic = Literal["status", "info"]

#: What may follow `nodes/<node>/replies/`: one to four levels of up to 64 characters.
_REPLY = re.compile(r"[A-Za-z0-9_.:@-]{1,64}(/[A-Za-z0-9_.:@-]{1,64}){0,3}")

_PIECE = re.compile(r"[1-9][0-9]{0,4}")

#: Of what all topics begin with.
MAX_BASE_BYTES = 256
MAX_BASE_LEVELS = 32
#: Of the name of a part, in characters.
MAX_PART = 64
#: Names of parts and nodes, as a configuration gives them.
NAME = re.compile(rf"[a-z0-9_-]{{1,{MAX_PART}}}")
WRONG_NAME = (
    f"parts, nodes and commands have names of up to {MAX_PART} of the characters a-z 0-9 _ -"
)

ONLINE = b"online"
OFFLINE = b"offline"


def wrong_topic(text: str) -> str | None:
    """Return what is wrong with the first words of topics; None if nothing is."""
    is_split = text.startswith(("/", "$")) or text.endswith("/")
    if text and text.isprintable() and not set(text) & set("+#") and not is_split:
        return None
    return (
        f'"{visible(text, 80)}" cannot start a topic; wanted words such as skin or lab/skin, '
        "without +, #, control characters and a slash at either end"
    )


def wrong_base(text: str) -> str | None:
    """Return what is wrong with what all topics begin with; None if nothing is."""
    size, levels = len(text.encode()), text.count("/") + 1
    if size > MAX_BASE_BYTES or levels > MAX_BASE_LEVELS:
        return (
            f"seen {size} bytes in {levels} levels, wanted at most {MAX_BASE_BYTES} in "
            f"{MAX_BASE_LEVELS}: brokers do not take longer topics"
        )
    return wrong_topic(text)


def wrong_part(text: str) -> str | None:
    """Return why no part can have this name: it cannot be one level of a topic; None if it can."""
    if 0 < len(text) <= MAX_PART and wrong_topic(text) is None and "/" not in text:
        return None
    return (
        f'"{visible(text, 80)}": wanted the name of a part, up to {MAX_PART} characters without '
        "+, #, / and control characters"
    )


class Subject(NamedTuple):
    """What a topic is about: a part's frames, a node's status, ..."""

    kind: PartTopic | NodeTopic | Literal["answer"]
    #: The part; for `status`, `info` and the answer to a command it is the node.
    name: str
    #: Of an `info` in several pieces.
    piece: int = 1


class Topics:
    """The topics of one robot.

    Raises:
        ConfigurationError: `base` or `robot` cannot stand in a topic.
    """

    def __init__(self, base: str, robot: str) -> None:
        for what, text in (("mqtt.base", base), ("robot", robot)):
            wrong = wrong_base(text)
            if wrong is not None:
                raise ConfigurationError(f"{what}: {wrong}")
        self.base = f"{base}/{robot}"

    def part(self, kind: PartTopic, part: str) -> str:
        """Topic of a part; `+` for all parts."""
        return f"{self.base}/{part}/{kind}"

    def node(self, kind: NodeTopic, node: str) -> str:
        """Topic of a node; `+` for all nodes."""
        return f"{self.base}/nodes/{node}/{kind}"

    def info(self, node: str, piece: int | Literal["+"] = 1) -> str:
        """Topic of a piece of a node's info; `+` for all nodes, all pieces but the first."""
        name = f"nodes/{node}/info" if piece == 1 else f"nodes/{node}/{piece}/info"
        return f"{self.base}/{name}"

    def command(self, node: str, name: str) -> str:
        """Topic at which a node takes the command `name`; `+` for all commands."""
        return f"{self.base}/nodes/{node}/cmd/{name}"

    def result(self, node: str, name: str) -> str:
        """Topic of the answer to a command if the request named no other topic."""
        return f"{self.base}/nodes/{node}/cmd/{name}/result"

    def reply(self, node: str, client: str) -> str:
        """Topic at which `client` may receive its answers: `nodes/<node>/replies/<client>`."""
        return f"{self.base}/nodes/{node}/replies/{client}"

    def may_reply_to(self, node: str, topic: str) -> bool:
        """Return whether an answer may go to `topic`, which comes with a request.

        Only topics that `docs/mqtt.md` names: a request must not make the daemon publish to its own
        touches, to another robot's, or to a topic over which a broker ends the connection.
        """
        prefix = self.reply(node, "")
        return topic.startswith(prefix) and _REPLY.fullmatch(topic, len(prefix)) is not None

    def parse(self, topic: str) -> Subject | None:
        """Return what a received topic is about; None if it is not one of ours."""
        if not topic.startswith(f"{self.base}/"):
            return None
        match topic[len(self.base) + 1 :].split("/"):
            case [
                part,
                ("frame" | "touch" | "slip" | "over" | "contact" | "health") as part_kind,
            ]:
                return Subject(part_kind, part)
            case ["nodes", node, ("status" | "info") as node_kind]:
                return Subject(node_kind, node)
            case ["nodes", node, piece, "info"] if _PIECE.fullmatch(piece):
                return Subject("info", node, int(piece))
            case ["nodes", node, "cmd", _, "result"] | ["nodes", node, "replies", _]:
                return Subject("answer", node)
        return None
