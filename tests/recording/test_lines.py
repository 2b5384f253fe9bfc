"""A line of a replay is what would have been published, and its type."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import json

from skin_host.mqtt.messages import encode_event
from skin_host.processing.core import Output, Step
from skin_host.processing.frame import PressureFrame
from skin_host.recording.lines import BLOCK_FRAMES, EventLines, LineWriter, frame_lines
from tests.support.said import make_event, make_frame


def test_a_line_of_a_frame_holds_every_taxel() -> None:
    frame = make_frame([0.12345, -0.0001], valid=np.array([True, False]))
    (line,) = frame_lines([frame])
    assert line == (
        b'{"type":"frame","part":"palm","seq":7,"t_ns":1763700000123456789,"raw":[0,1],'
        b'"pressure_kpa":[0.123,0.0],"touched":[false,false],"valid":[true,false]}\n'
    )


def test_a_line_names_the_taxels_beyond_range_where_there_are_any() -> None:
    frame = make_frame([0.5, 90.0])
    (line,) = frame_lines([replace(frame, beyond_range=np.array([False, True]))])
    assert json.decode(line)["beyond_range"] == [False, True]
    assert line.endswith(b'"valid":[true,true],"beyond_range":[false,true]}\n')


def _plainly(frame: PressureFrame) -> bytes:
    """The line of a frame, number by number."""
    kpa = [round(float(one) * 1000) / 1000 + 0.0 for one in frame.pressure_kpa]
    return (
        json.encode(
            {
                "type": "frame",
                "part": frame.part,
                "seq": frame.seq,
                "t_ns": frame.t_ns,
                "raw": frame.raw.tolist(),
                "pressure_kpa": kpa,
                "touched": frame.touched.tolist(),
                "valid": frame.valid.tolist(),
            }
        )
        + b"\n"
    )


def test_every_thousandth_of_a_kpa_up_to_a_thousand_is_written_as_its_shortest_text() -> None:
    frame = make_frame((np.arange(1_001_000) / 1000).tolist())
    assert frame_lines([frame]) == [_plainly(frame)]
    frame = make_frame((np.arange(999_999) / 1000).tolist())
    assert frame_lines([frame]) == [_plainly(frame)]


@given(
    st.lists(
        st.lists(
            st.one_of(
                st.floats(0.0, 30.0, width=32),
                st.floats(-1.0, 2.0**20, width=32),
                st.sampled_from([-0.0, 999.9994, 999.9996, 0.0005]),
            ),
            min_size=1,
            max_size=30,
        ),
        min_size=1,
        max_size=4,
    )
)
def test_frames_of_any_sizes_and_pressures_are_written_together_as_alone(
    pressures: list[list[float]],
) -> None:
    frames = [make_frame(one) for one in pressures]
    assert frame_lines(frames) == [_plainly(frame) for frame in frames]


@pytest.mark.parametrize("odd", [np.nan, np.inf])
def test_a_number_that_json_has_not_is_null(odd: float) -> None:
    line = json.decode(frame_lines([make_frame([odd, 1.5])])[0])
    assert line["pressure_kpa"] == [None, 1.5]


def test_a_line_of_a_touch_is_the_payload_and_its_type() -> None:
    lines = EventLines()
    for count in (1, 2):
        line = json.decode(lines.line(make_event()))
        assert line == {"type": "touch"} | json.decode(encode_event(make_event(), count))


def test_events_follow_their_frame_whatever_the_number_of_frames() -> None:
    written = BytesIO()
    writer = LineWriter(written)
    wanted = []
    for number in range(2 * BLOCK_FRAMES + 1):
        events = [make_event()] * (number % 3)
        grasps = [make_event()] * (number % 5 == 0)
        writer.write(Output([], [Step(0, make_frame([number]), events)], [], list(grasps), []))
        wanted += [("frame", float(number)), *[("touch", None)] * len(events + grasps)]
    writer.flush()
    lines = [json.decode(line) for line in written.getvalue().splitlines()]
    assert [(one["type"], *one.get("pressure_kpa", [None])) for one in lines] == wanted
    counts = [one["count"] for one in lines if one["type"] == "touch"]
    assert counts == list(range(1, len(counts) + 1))
