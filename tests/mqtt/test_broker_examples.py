"""The shipped access rules and bridge cover all topics that there are."""

from pathlib import Path
from typing import get_args

from skin_host.mqtt.topics import NodeTopic, PartTopic, Topics

EXAMPLES = Path(__file__).parents[2] / "systemd" / "mosquitto"
ROBOT = Topics("skin", "robot")
#: With the quality of service with which each is published.
PUBLISHED = {
    topic.replace("/robot/", "/+/"): qos
    for topic, qos in [
        *((ROBOT.part(kind, "+"), int(kind != "frame")) for kind in get_args(PartTopic)),
        *((ROBOT.node(kind, "+"), 1) for kind in get_args(NodeTopic)),
        (ROBOT.info("+", "+"), 1),
    ]
}


def lines(name: str, first: str) -> list[list[str]]:
    """The rest of each line that begins with these words."""
    text = (EXAMPLES / name).read_text()
    return [
        line.removeprefix(first).split() for line in text.splitlines() if line.startswith(first)
    ]


def test_who_may_log_in_reads_all_that_is_published() -> None:
    read = [topic for what, topic in lines("skin.acl", "pattern") if what == "read"]
    assert sorted(read) == sorted(PUBLISHED)


def test_the_bridge_passes_on_all_that_is_published() -> None:
    bridged = {topic: int(qos) for topic, _, qos in lines("bridge.conf", "topic ")}
    assert bridged == PUBLISHED
