"""JSON that anybody may have written ends in one kind of error, however it is made."""

from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.writer import Writer

from skin_host.cli import main
from skin_host.errors import LogError
from skin_host.recording.mcap import Recorder, read_messages_of
from skin_host.untrusted import from_json

CONFIG = Path(__file__).parents[1] / "config" / "demo.toml"
NESTED = [b"[" * 4000, b'{"a":' * 4000, b'{"a":' + b"[" * 4000, b'{"state":' + b"[" * 100_000]
NO_TEXT = [b'"\xff"', b'{"\xff":1}', b"\xff"]
TOPICS = {
    "health": "skin/demo/palm/health",
    "info": "skin/demo/nodes/main/info",
    "piece": "skin/demo/nodes/main/3/info",
    "frame": "skin/demo/palm/frame",
    "touch": "skin/demo/palm/touch",
}


class Text(msgspec.Struct):
    text: str


@pytest.mark.parametrize("kind", [dict[str, Any], Text, object])
@pytest.mark.parametrize("data", [*NESTED, *NO_TEXT, b"", b"1e999999", b"9" * 5000 + b"."])
def test_whatever_it_is_the_error_is_the_same(data: bytes, kind: Any) -> None:
    with pytest.raises(msgspec.DecodeError) as caught:
        from_json(data, kind)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("topic", TOPICS.values(), ids=TOPICS)
@pytest.mark.parametrize("payload", NESTED, ids=range(len(NESTED)))
def test_a_nested_message_is_counted_and_the_recording_goes_on(
    topic: str, payload: bytes, tmp_path: Path
) -> None:
    """What is retained at a broker comes again after each connection: nothing was ever recorded."""
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.say(topic, 1, payload)
        recorder.say("skin/demo/palm/contact", 2, b"ON")
        assert recorder.unreadable == 1
    assert [message.payload for message in read_messages_of(path)] == [b"ON"]


@pytest.mark.parametrize("payload", NESTED, ids=range(len(NESTED)))
@pytest.mark.parametrize("topic", ["skin/demo/palm/contact", "can/can0"])
def test_a_nested_message_of_a_recording_is_an_error_of_one_line(
    payload: bytes, topic: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(topic, "json", 0)
        writer.add_message(channel, 1, payload, 1)
        writer.finish()
    if topic.startswith("can/"):
        assert main(["replay", str(path), "--config", str(CONFIG)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{path}: can/can0: " in line
        return
    with pytest.raises(LogError, match=f"a.mcap: {topic}: "):
        list(read_messages_of(path))


def test_a_running_configuration_that_is_nested_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "running.json"
    path.write_bytes(b'{"a":' * 4000)
    assert main(["check", str(CONFIG), "--running", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{path}: damaged: " in line
