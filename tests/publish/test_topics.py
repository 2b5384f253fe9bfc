"""Topics: where things are said, and where an answer may go."""

import pytest

from skin_host.errors import ConfigurationError
from skin_host.publish.topics import Place, Topics

TOPICS = Topics("lab/skin", "icub")


def test_topics_of_parts_and_nodes_are_those_of_the_contract() -> None:
    assert TOPICS.part("frame", "left_hand") == "lab/skin/icub/left_hand/frame"
    assert TOPICS.node("status", "main") == "lab/skin/icub/nodes/main/status"
    assert TOPICS.command("main", "calibrate") == "lab/skin/icub/nodes/main/cmd/calibrate"
    assert TOPICS.result("main", "scan") == "lab/skin/icub/nodes/main/cmd/scan/result"


def test_a_topic_says_what_it_is_about() -> None:
    assert TOPICS.parse(TOPICS.part("touch", "palm")) == Place("touch", "palm")
    assert TOPICS.parse(TOPICS.node("info", "arm")) == Place("info", "arm")


@pytest.mark.parametrize(
    "topic",
    [
        "lab/skin/nao/palm/touch",
        "lab/skin/icub/palm",
        "lab/skin/icub/a/b/touch",
        "",
        "lab/skin/icub",
    ],
)
def test_a_strange_topic_is_about_nothing(topic: str) -> None:
    assert TOPICS.parse(topic) is None


@pytest.mark.parametrize("base", ["", "/skin", "skin/", "a+b", "a/#", "$SYS", "a\0b"])
def test_a_base_that_cannot_start_a_topic_is_refused(base: str) -> None:
    with pytest.raises(ConfigurationError, match=r"mqtt\.base"):
        Topics(base, "icub")


def test_an_answer_goes_to_the_replies_of_its_node_or_outside_the_skin() -> None:
    assert TOPICS.may_reply_to("main", TOPICS.reply("main", "panel-1"))
    assert TOPICS.may_reply_to("main", "operators/7/answers")


@pytest.mark.parametrize(
    "topic",
    [
        "",
        "lab/skin/icub/palm/touch",
        "lab/skin/icub/nodes/main/status",
        "lab/skin/icub/nodes/other/replies/x",
        "$SYS/broker",
        "a/+",
        "a/#",
        "a" * 257,
    ],
)
def test_an_answer_cannot_be_passed_off_as_something_else(topic: str) -> None:
    assert not TOPICS.may_reply_to("main", topic)
