"""Recordings of one name, and of the longest names."""

from pathlib import Path

import pytest

from skin_host.bus.wire import FrameBatch
from skin_host.errors import SkinError
from skin_host.files import Draft, whole_file, write_atomic
from skin_host.recording.capture import CanLog
from skin_host.recording.mcap import Recorder

FRAME = FrameBatch.of([(0x110, bytes(8), 1_700_000_000 * 10**9)])


@pytest.mark.parametrize("name", ["a.log", "a.blf", "a.mcap"])
def test_of_two_recordings_of_one_name_the_second_to_end_replaces_nothing(
    name: str, tmp_path: Path
) -> None:
    path = tmp_path / name

    def begun() -> CanLog | Recorder:
        return Recorder(path) if path.suffix == ".mcap" else CanLog(path)

    def put(one: CanLog | Recorder) -> None:
        (one.can if isinstance(one, Recorder) else one.put)("can0", FRAME)

    first, second = begun(), begun()
    put(second)
    put(first)
    put(first)
    first.close()
    kept = path.read_bytes()
    with pytest.raises(SkinError, match="another file got this name meanwhile; this one is") as got:
        second.close()
    assert got.value.exit_status == 1
    assert path.read_bytes() == kept
    (draft,) = [one for one in tmp_path.iterdir() if one != path]
    assert str(draft) in str(got.value)
    assert draft.stat().st_size > 0


def test_a_draft_of_a_new_file_takes_a_name_that_is_free(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    draft = Draft(path, new=True)
    draft.begin()
    draft.path.write_text("whole")
    draft.finish()
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("stem", ["a" * 251, "\u00e4" * 125 + "a", "a" * 240])
def test_every_name_that_the_system_allows_can_be_written(stem: str, tmp_path: Path) -> None:
    path = tmp_path / f"{stem}.log"
    with CanLog(path) as log:
        log.put("can0", FRAME)
    assert path.stat().st_size > 0
    with whole_file(path) as growing:
        growing.write_text("whole")
    assert path.read_text() == "whole"
    write_atomic(path, b"again")
    assert path.read_text() == "again"
    assert list(tmp_path.iterdir()) == [path]
