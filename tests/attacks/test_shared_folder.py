"""Files in a folder that others may write to, as /tmp, or that two programs write at once."""

import errno
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from skin_host.bus.wire import FrameBatch
from skin_host.errors import SkinError
from skin_host.files import whole_file, write_atomic
from skin_host.recording.capture import CanLog
from skin_host.recording.mcap import Recorder

FRAMES = FrameBatch.of([(0x4E0, bytes(8), 1_700_000_000_000_000_000)])


def test_a_link_under_the_known_interim_name_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    for suffix in ("log", "mcap", "jsonl"):
        (tmp_path / f".x.growing.{suffix}").symlink_to(victim)
    with CanLog(tmp_path / "x.log") as log:
        log.put("can0", FRAMES)
    with Recorder(tmp_path / "x.mcap") as recorder:
        recorder.can("can0", FRAMES)
    with whole_file(tmp_path / "x.jsonl") as growing:
        growing.write_text("{}")
    assert victim.read_text() == "mine"
    for suffix in ("log", "mcap", "jsonl"):
        made = tmp_path / f"x.{suffix}"
        assert made.is_file()
        assert not made.is_symlink()


def test_of_two_that_write_a_file_at_once_the_last_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    with whole_file(path) as one, whole_file(path) as other:
        one.write_text("one\n" * 100)
        other.write_text("other\n")
    assert path.read_text() == "one\n" * 100
    assert [file.name for file in tmp_path.iterdir()] == ["x.txt"]


def test_of_two_recordings_of_a_name_the_first_to_end_is_whole_and_the_other_keeps_its_own(
    tmp_path: Path,
) -> None:
    path = tmp_path / "x.log"
    with pytest.raises(SkinError, match="another file got this name"), CanLog(path) as one:
        with CanLog(path) as other:
            for _ in range(100):
                one.put("can0", FRAMES)
            other.put("can1", FRAMES)
    kept = {file.name == "x.log": file.read_text().splitlines() for file in tmp_path.iterdir()}
    assert {is_named: len(lines) for is_named, lines in kept.items()} == {True: 1, False: 100}
    assert all(" can0 " in line for line in kept[False])


@pytest.fixture
def tiny(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 kB."""
    place = tmp_path / "tiny"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this user may not mount")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_disk_that_is_full_in_the_middle_of_a_file_leaves_the_old_one(tiny: Path) -> None:
    path = tiny / "kept.json"
    write_atomic(path, b"old" * 1000)
    with pytest.raises(OSError, match="No space left") as full:
        write_atomic(path, b"new" * 100_000)
    assert full.value.errno == errno.ENOSPC
    with (
        pytest.raises(SkinError, match=r"kept\.json: cannot be written: No space left"),
        whole_file(path) as growing,
    ):
        growing.write_bytes(bytes(200_000))
    assert path.read_bytes() == b"old" * 1000
    assert [file.name for file in tiny.iterdir()] == ["kept.json"]
