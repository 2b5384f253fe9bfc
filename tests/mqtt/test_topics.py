"""Topics: where things are said, and where an answer may go."""

import pytest

from skin_host.errors import ConfigurationError
from skin_host.mqtt.topics import Subject, Topics

TOPICS = Topics("lab/skin", "icub")


def test_topics_of_parts_and_nodes_are_those_of_the_contract() -> None:
    assert TOPICS.part("frame", "left_hand") == "lab/skin/icub/left_hand/frame"
    assert TOPICS.node("status", "main") == "lab/skin/icub/nodes/main/status"
    assert TOPICS.command("main", "calibrate") == "lab/skin/icub/nodes/main/cmd/calibrate"
    assert TOPICS.result("main", "scan") == "lab/skin/icub/nodes/main/cmd/scan/result"


def test_a_topic_says_what_it_is_about() -> None:
    assert TOPICS.parse(TOPICS.part("touch", "palm")) == Subject("touch", "palm")
    assert TOPICS.parse(TOPICS.node("info", "arm")) == Subject("info", "arm")


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


@pytest.mark.parametrize("name", ["panel-1", "a/b/c/d", "mosquitto_rr.7:x@host", "a" * 64])
def test_an_answer_goes_to_the_replies_of_its_node(name: str) -> None:
    assert TOPICS.may_reply_to("main", TOPICS.reply("main", name))


@pytest.mark.parametrize(
    "topic",
    [
        "",
        "lab/skin/icub/palm/touch",
        "lab/skin/icub/nodes/main/status",
        "lab/skin/icub/nodes/other/replies/x",
        "lab/skin/nao/palm/contact",
        "operators/7/answers",
        "$SYS/broker",
        *(
            f"lab/skin/icub/nodes/main/replies/{name}"
            for name in ("", "+", "#", "a//b", "/a", "a/", "a\n", "a" * 65, "a/b/c/d/e", "/" * 201)
        ),
    ],
)
def test_an_answer_cannot_go_anywhere_else(topic: str) -> None:
    assert not TOPICS.may_reply_to("main", topic)
