"""What a page records keeps its name, and what was recorded, when the disk fails."""

import os
import resource
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from skin_host.errors import StateError
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import connect
from skin_host.recording import capture
from skin_host.recording.capture import LEAST_BYTES, RESERVE_BYTES, PageRecording
from tests.support.broker import Mosquitto
from tests.support.waiting import until


@pytest.fixture
def full_disk() -> Iterator[None]:
    """A disk that takes 1.5 MB of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


async def test_a_recording_that_filled_the_disk_names_what_there_is_of_it(
    mosquitto: Mosquitto, tmp_path: Path, full_disk: None
) -> None:
    broker = Broker(mosquitto.host, mosquitto.port)
    folder = tmp_path / "recordings"
    recording = PageRecording(folder)
    recording.start(broker, "skin", "demo")
    async with connect(broker, identifier="health") as connection:
        for n in range(100):
            # So that it is there whenever the recording begins to listen.
            health = msgspec.json.encode(
                {"schema": "skin.health/1", "state": os.urandom(30_000).hex()}
            )
            await connection.publish(f"skin/demo/p{n}/health", health, qos=1, retain=True)
        await until(lambda: recording.state is not None and "ended" in recording.state)
    assert recording.state is not None
    (left,) = folder.iterdir()
    assert recording.state["ended"].endswith(f"File too large; a part of it is {left}")
    assert left.stat().st_size > 1_000_000


async def test_a_recording_leaves_room_for_what_a_daemon_keeps(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its disk may be the robot's: a full one would not take what is touched."""
    disk = os.statvfs(tmp_path)
    free = [RESERVE_BYTES + LEAST_BYTES]

    def seen(_: Path | int) -> os.statvfs_result:
        values = list(disk)
        values[1], values[4] = 1, free[0]
        return os.statvfs_result(values)

    monkeypatch.setattr(capture.os, "statvfs", seen)
    broker = Broker(mosquitto.host, mosquitto.port)
    recording = PageRecording(tmp_path / "recordings")
    path = Path(recording.start(broker, "skin", "demo")["file"])
    free[0] = RESERVE_BYTES - 1
    await until(lambda: recording.state is not None and "ended" in recording.state)
    assert recording.state is not None
    assert "less than 16 MiB of its disk are left" in recording.state["ended"]
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(StateError, match="move recordings away"):
        recording.start(broker, "skin", "demo")
    assert list(path.parent.iterdir()) == [path]
