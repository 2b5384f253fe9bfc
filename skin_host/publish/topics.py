"""Where things are said: the topics of one robot below its base, `skin/<robot>`.

The topics of a part do not show which node (daemon) the part belongs to; what is said
by and to a node lies below `nodes/<node>`. `docs/mqtt.md` is the contract.
"""

from typing import Literal, NamedTuple

from skin_host.errors import ConfigurationError

PartTopic = Literal["frame", "touch", "slip", "over", "contact", "health"]
NodeTopic = Literal["status", "info"]

ONLINE = b"online"
OFFLINE = b"offline"


class Place(NamedTuple):
    """What a topic is about: a part's frames, a node's status, ..."""

    kind: PartTopic | NodeTopic | Literal["answer"]
    #: The part; for `status`, `info` and the answer to a command the node.
    name: str


class Topics:
    """The topics of one robot.

    Raises:
        ConfigurationError: `base` or `robot` cannot stand in a topic.
    """

    def __init__(self, base: str, robot: str) -> None:
        for what, text in (("mqtt.base", base), ("robot", robot)):
            if (
                not text
                or set(text) & set("+#\0")
                or text.startswith(("/", "$"))
                or text[-1] == "/"
            ):
                raise ConfigurationError(
                    f'{what}: "{text}" cannot start a topic; wanted words such as skin or '
                    "lab/skin, without +, # and a slash at either end"
                )
        self.base = f"{base}/{robot}"

    def part(self, kind: PartTopic, part: str) -> str:
        """Topic of a part; `+` for all parts."""
        return f"{self.base}/{part}/{kind}"

    def node(self, kind: NodeTopic, node: str) -> str:
        """Topic of a node; `+` for all nodes."""
        return f"{self.base}/nodes/{node}/{kind}"

    def command(self, node: str, name: str) -> str:
        """Where a node takes the command `name`; `+` for all commands."""
        return f"{self.base}/nodes/{node}/cmd/{name}"

    def result(self, node: str, name: str) -> str:
        """Where a command is answered if the request named no other topic."""
        return f"{self.base}/nodes/{node}/cmd/{name}/result"

    def reply(self, node: str, client: str) -> str:
        """Where `client` may ask to be answered: `nodes/<node>/replies/<client>`."""
        return f"{self.base}/nodes/{node}/replies/{client}"

    def may_reply_to(self, node: str, topic: str) -> bool:
        """Whether an answer may go to `topic`, which a stranger chose.

        Below our own base only `nodes/<node>/replies/` is free, else a request could make
        the daemon write into its own touches. Elsewhere the broker's access rules decide.
        """
        if not topic or len(topic) > 256 or set(topic) & set("+#\0") or topic[0] == "$":
            return False
        return not topic.startswith(f"{self.base}/") or topic.startswith(self.reply(node, ""))

    def parse(self, topic: str) -> Place | None:
        """Say what a received topic is about; None if it is none of ours."""
        if not topic.startswith(f"{self.base}/"):
            return None
        match topic[len(self.base) + 1 :].split("/"):
            case [
                part,
                ("frame" | "touch" | "slip" | "over" | "contact" | "health") as part_kind,
            ]:
                return Place(part_kind, part)
            case ["nodes", node, ("status" | "info") as node_kind]:
                return Place(node_kind, node)
            case ["nodes", node, "cmd", _, "result"] | ["nodes", node, "replies", _]:
                return Place("answer", node)
        return None
