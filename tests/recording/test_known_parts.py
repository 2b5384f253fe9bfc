"""Exports of messages end what a daemon that was killed, or a lost broker, has not ended."""

from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from skin_host.errors import RequestError
from skin_host.layout import load_skin
from skin_host.mqtt.frames import encode_frame
from skin_host.mqtt.info import encode_info, node_info
from skin_host.mqtt.messages import encode_event
from skin_host.recording import plots
from skin_host.recording.export import Series, read_messages
from skin_host.recording.export.known import Known
from skin_host.recording.export.scene import Arrows, Points, RecordedScene
from skin_host.recording.mcap import Recorder
from tests.support.said import make_event, make_frame

CONFIG = Path(__file__).parents[2] / "config" / "icub_hand.toml"
PART, M = "left_hand", 108
START_NS = 1_763_700_000_000_000_000
S = 1_000_000_000
TOPIC = f"skin/icub/{PART}"
NODE = "skin/icub/nodes/main"

#: Says what a node publishes within a second, its touch 7 included, at a time in s.
Live = Callable[[float], None]
#: What is done between two seconds of a node, at a time in s.
Between = Callable[[Recorder, float], None]


def record(path: Path, ahead_s: float = 0.0) -> Iterator[tuple[Recorder, Live]]:
    """A recording in progress; the node's clock is ahead of the recorder's."""
    _, layout = load_skin(CONFIG)
    numbers = count(1)
    with Recorder(path) as recorder:

        def say(topic: str, payload: bytes, at_s: float) -> None:
            recorder.say(topic, START_NS + round(at_s * S), payload)

        def live(at_s: float) -> None:
            t_ns = START_NS + round((at_s + ahead_s) * S)
            say(f"{TOPIC}/frame", encode_frame(make_frame([5.0] * M, part=PART, t_ns=t_ns)), at_s)
            say(f"{TOPIC}/health", b'{"schema": "skin.health/1", "state": "ok"}', at_s)
            event = make_event(event="move", id=7, part=PART, t_ns=t_ns)
            say(f"{TOPIC}/touch", encode_event(event, next(numbers)), at_s)

        say(f"{NODE}/status", b"online", 0.0)
        info = node_info(layout, "main", version="1", configuration="x")
        say(f"{NODE}/info", encode_info(info), 0.0)
        say(f"{TOPIC}/contact", b"ON", 0.0)
        for at_s in (1.0, 2.0):
            live(at_s)
        yield recorder, live
        assert not recorder.unreadable


def recorded(path: Path, end: Callable[[Recorder, Live], None], ahead_s: float = 0.0) -> Series:
    for recorder, live in record(path, ahead_s):
        end(recorder, live)
    return read_messages(path)


def at_the_end(series: Series) -> tuple[list[int], bool]:
    """The contacts that arrows show at last, and whether any taxel is valid then."""
    items = list(RecordedScene(series).items())
    assert [item.t_ns for item in items] == sorted(item.t_ns for item in items)
    arrows = [item for item in items if isinstance(item, Arrows)]
    points = [item for item in items if isinstance(item, Points)]
    return [one.id for one in arrows[-1].arrows], bool(np.any(points[-1].points["valid"]))


def states(series: Series) -> list[tuple[str, float]]:
    return [(one.state, (one.t_ns - START_NS) / S) for one in series.contacts]


def test_a_frame_after_a_silence_makes_no_untouched_state_of_before_known_again() -> None:
    """A node sends it before the state that changes with it."""
    known = Known(3.0)
    known.status("main", b"online", 0)
    known.info("main", [PART], 0)
    known.state(PART, "OFF", 0, stored=False)
    known.frame(PART, 5 * S, 5 * S)
    assert [line.state for line in known.contacts] == ["OFF", "UNKNOWN"]
    known.state(PART, "ON", 5 * S + 1, stored=False)
    known.health(PART, 6 * S)
    assert [line.state for line in known.contacts] == ["OFF", "UNKNOWN", "ON"]


@pytest.mark.parametrize("ahead_s", [0.0, 3600.0, -3600.0])
def test_a_node_that_is_killed_leaves_no_contact(tmp_path: Path, ahead_s: float) -> None:
    def end(recorder: Recorder, _: Live) -> None:
        recorder.say(f"{NODE}/status", START_NS + 2 * S + S // 2, b"offline")

    series = recorded(tmp_path / "a.mcap", end, ahead_s)
    assert at_the_end(series) == ([], False)
    assert states(series) == [("ON", 0.0), ("UNKNOWN", 2.5)]


@pytest.mark.parametrize("status", [b"offline", b"online"])
def test_what_the_broker_had_stored_of_a_robot_that_is_off_is_not_known(
    tmp_path: Path, status: bytes
) -> None:
    """In the order in which they come; `online` stays after a power cut of broker and robot."""
    _, layout = load_skin(CONFIG)
    info = encode_info(node_info(layout, "main", version="1", configuration="x"))
    ok = b'{"schema": "skin.health/1", "state": "ok"}'
    said = {
        f"{TOPIC}/contact": b"OFF",
        f"{TOPIC}/health": ok,
        f"{NODE}/status": status,
        f"{NODE}/info": info,
    }
    with Recorder(tmp_path / "a.mcap") as recorder:
        for topic, payload in said.items():
            recorder.say(topic, START_NS, payload, stored=True)
        recorder.say("skin/icub/other/health", START_NS + 10 * S, ok)
        assert not recorder.unreadable
    series = read_messages(tmp_path / "a.mcap")
    assert [one.state for one in series.contacts] == ["UNKNOWN"]
    assert [one.part for one in series.health] == ["other"]


def test_what_the_broker_had_stored_is_known_as_soon_as_its_part_lives(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.say(f"{TOPIC}/contact", START_NS, b"ON", stored=True)
        for at_s in (1, 2, 3):
            frame = encode_frame(make_frame([5.0] * M, part=PART, t_ns=START_NS + at_s * S))
            recorder.say(f"{TOPIC}/frame", START_NS + at_s * S, frame)
    assert states(read_messages(tmp_path / "a.mcap")) == [("ON", 1.0)]


def test_a_node_that_starts_again_begins_without_the_contacts_before(tmp_path: Path) -> None:
    def end(recorder: Recorder, live: Live) -> None:
        for at_s, payload in ((2.5, b"offline"), (9.0, b"online")):
            recorder.say(f"{NODE}/status", START_NS + round(at_s * S), payload)
        recorder.say(f"{TOPIC}/contact", START_NS + 10 * S, b"OFF")
        frame = make_frame([0.0] * M, part=PART, t_ns=START_NS + 10 * S)
        recorder.say(f"{TOPIC}/frame", START_NS + 10 * S, encode_frame(frame))

    series = recorded(tmp_path / "a.mcap", end)
    assert at_the_end(series) == ([], True)
    assert states(series) == [("ON", 0.0), ("UNKNOWN", 2.5), ("OFF", 10.0)]


def test_what_goes_on_after_a_lost_broker_is_known_again(tmp_path: Path) -> None:
    def end(_: Recorder, live: Live) -> None:
        live(20.0)
        live(21.0)

    series = recorded(tmp_path / "a.mcap", end)
    assert len(series.gone) == 1
    assert at_the_end(series) == ([7], True)
    assert states(series) == [("ON", 0.0), ("UNKNOWN", 20.0), ("ON", 20.0)]


def test_a_part_that_is_received_all_the_time_is_known_all_the_time(tmp_path: Path) -> None:
    def end(_: Recorder, live: Live) -> None:
        for at_s in range(3, 60):
            live(float(at_s))

    series = recorded(tmp_path / "a.mcap", end)
    assert series.gone == []
    assert states(series) == [("ON", 0.0)]
    assert at_the_end(series) == ([7], True)


def test_a_picture_draws_neither_lines_nor_contacts_where_nothing_was_known(tmp_path: Path) -> None:
    """A contact of a run that was killed lasted until one of its number ended, an hour later."""

    def end(recorder: Recorder, live: Live) -> None:
        for at_s, payload in ((2.5, b"offline"), (9.0, b"online")):
            recorder.say(f"{NODE}/status", START_NS + round(at_s * S), payload)
        live(10.0)
        live(11.0)

    series = recorded(tmp_path / "a.mcap", end)
    part = series.parts[PART]
    t_s, kpa = plots._broken(series, part, [3, 40])
    assert kpa.shape == (5, 2)
    assert t_s.tolist() == pytest.approx([0.0, 1.0, 1.0, 9.0, 10.0])
    assert np.isnan(kpa).all(axis=1).tolist() == [False, False, True, False, False]
    spans = [one for span in plots._contacts(series, part) for one in span]
    assert spans == pytest.approx([0.0, 1.5, 9.0, 10.0])
    output = tmp_path / "map.png"
    with pytest.raises(RequestError, match=r"nothing is known at 5 s; .* at 1\.00 and 9\.00 s"):
        plots.plot_map(series, output, PART, 5.0)
    assert not output.exists()
    plots.plot_map(series, output, PART, 9.0)
    assert output.exists()


def test_lines_are_not_broken_where_frames_are_seldom(tmp_path: Path) -> None:
    """`mqtt.frame_hz` may thin them to one in many seconds."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        for n in range(4):
            t_ns = START_NS + n * 20 * S
            frame = make_frame([5.0] * M, part=PART, t_ns=t_ns)
            recorder.say(f"{TOPIC}/frame", t_ns, encode_frame(frame))
    series = read_messages(tmp_path / "a.mcap")
    _, kpa = plots._broken(series, series.parts[PART], [3])
    assert kpa.tolist() == [[5.0]] * 4


def test_contact_states_alone_are_known_from_one_to_the_next(tmp_path: Path) -> None:
    """As `mcap filter` leaves them: they are published every 2 to 3 s, and it takes a moment."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        for at_s in (0.0, 3.1, 6.2, 9.4, 18.0):
            state = b"OFF" if at_s == 6.2 else b"ON"
            recorder.say(f"{TOPIC}/contact", START_NS + round(at_s * S), state)
            recorder.say("skin/icub/other/contact", START_NS + round((at_s + 1.0) * S), b"OFF")
    found = read_messages(tmp_path / "a.mcap")
    seen = [(one.state, (one.t_ns - START_NS) / S) for one in found.contacts if one.part == PART]
    assert seen[:3] == [("ON", 0.0), ("OFF", 6.2), ("ON", 9.4)]
    # Nothing of any part shows the time before.
    assert seen[3:] == [("UNKNOWN", 18.0), ("ON", 18.0)]
