"""A line of a replay is what would have been published, and its type."""

import numpy as np
from msgspec import json

from skin_host.mqtt.messages import encode_event
from skin_host.recording.replay import EventLines, frame_line
from tests.support.said import make_event, make_frame


def test_a_line_of_a_frame_holds_every_taxel() -> None:
    frame = make_frame([0.12345, -0.0001], valid=np.array([True, False]))
    assert frame_line(frame) == (
        b'{"type":"frame","part":"palm","seq":7,"t_ns":1763700000123456789,"raw":[0,1],'
        b'"pressure_kpa":[0.123,0.0],"touched":[false,false],"valid":[true,false]}\n'
    )


def test_a_line_of_a_touch_is_the_payload_and_its_type() -> None:
    lines = EventLines()
    for count in (1, 2):
        line = json.decode(lines.line(make_event()))
        assert line == {"type": "touch"} | json.decode(encode_event(make_event(), count))
