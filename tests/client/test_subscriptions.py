"""Which topics are subscribed to for the streams that exist."""

from itertools import combinations
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from paho.mqtt.client import topic_matches_sub

from skin_host.client.streams import HELD, Stream
from skin_host.client.subscriptions import Subscriptions, needed
from skin_host.mqtt.topics import Topics

TOPICS = Topics("skin", "robot")
REPLIES = TOPICS.reply("+", "client")
STREAMS = st.lists(
    st.builds(
        lambda part, kinds: Stream(part, *sorted(kinds)),
        st.sampled_from([None, "palm", "arm", "hand"]),
        st.sets(st.sampled_from(list(HELD)), min_size=1),
    ),
    max_size=6,
)


def wanted(streams: list[Stream[Any]]) -> list[str]:
    return list(Subscriptions(TOPICS, REPLIES, streams).wanted())


@given(STREAMS)
def test_no_message_comes_by_two_subscriptions(streams: list[Stream[Any]]) -> None:
    for one, other in combinations(wanted(streams), 2):
        assert not topic_matches_sub(one, other.replace("+", "any"))
        assert not topic_matches_sub(other, one.replace("+", "any"))


@given(STREAMS)
def test_a_stream_receives_all_that_it_needs(streams: list[Stream[Any]]) -> None:
    topics = wanted(streams)
    for stream in streams:
        for kind in (one for asked in stream.kinds for one in needed(asked)):
            topic = TOPICS.part(kind, stream.part or "any")
            assert any(topic_matches_sub(one, topic) for one in topics)


@given(STREAMS)
def test_nodes_come_first_and_states_before_signs_of_life(streams: list[Stream[Any]]) -> None:
    topics = wanted(streams)
    assert topics[:4] == [
        "skin/robot/nodes/+/status",
        "skin/robot/nodes/+/info",
        "skin/robot/nodes/+/+/info",
        "skin/robot/nodes/+/replies/client",
    ]
    are_states = [topic.endswith("/contact") for topic in topics[4:]]
    assert are_states == sorted(are_states, reverse=True)
