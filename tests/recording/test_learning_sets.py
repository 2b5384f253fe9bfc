"""Data sets for learning pass LeRobot's check of times, whatever the times of the recording."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.errors import RequestError
from skin_host.recording.export import PartSeries, Series, export

pytest.importorskip("pyarrow")

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
#: LeRobot's default.
TOLERANCE_S = 1e-4


def part(name: str, times_ms: Sequence[float]) -> PartSeries:
    """A part of two taxels; its first one has the number of the frame, plus one, in kPa."""
    n = len(times_ms)
    t_ns = START_NS + np.round(np.array(times_ms) * MS).astype(np.int64)
    kpa = np.stack([np.arange(1.0, n + 1.0), np.ones(n)], axis=1).astype(np.float32)
    return PartSeries(name, np.arange(n), t_ns, kpa, np.zeros((n, 2), np.bool_), None)


def data_set(folder: Path, *parts: PartSeries) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Export parts; return the data set's info, and the columns of each episode as arrays."""
    from pyarrow import parquet

    export(Series({one.name: one for one in parts}, [], {}), folder, lerobot=True)
    info = json.loads((folder / "meta/info.json").read_text())
    episodes = []
    for n in range(info["total_episodes"]):
        path = info["data_path"].format(episode_chunk=n // info["chunks_size"], episode_index=n)
        table = parquet.read_table(folder / path)
        assert set(table.column_names) == set(info["features"])
        episodes.append({key: np.array(table[key].to_pylist()) for key in table.column_names})
        episodes[-1]["timestamp"] = table["timestamp"].to_numpy()
    return info, episodes


def check(info: dict[str, Any], episodes: list[dict[str, Any]]) -> None:
    """LeRobot's own check: huggingface/lerobot v0.3.3, datasets/utils.py, check_timestamps_sync."""
    for episode in episodes:
        assert episode["timestamp"].dtype == np.float32
        steps_s = np.diff(episode["timestamp"])
        assert (np.abs(steps_s - 1.0 / info["fps"]) <= TOLERANCE_S).all()
        n = len(episode["timestamp"])
        assert episode["frame_index"].tolist() == list(range(n))
    index = np.concatenate([episode["index"] for episode in episodes])
    assert index.tolist() == list(range(info["total_frames"]))


def kpa(episode: dict[str, Any], name: str) -> list[float]:
    """The first taxel of a part, step by step; -1 where it is not valid."""
    valid = episode[f"observation.skin.{name}.valid"][:, 0]
    values = episode[f"observation.skin.{name}"][:, 0]
    assert not values[~valid].any()
    found: list[float] = np.where(valid, values, -1.0).tolist()
    return found


def test_a_period_that_is_no_whole_rate_is_put_on_a_whole_one(tmp_path: Path) -> None:
    info, episodes = data_set(tmp_path, part("arm", np.arange(500) * 30.0))
    check(info, episodes)
    assert info["fps"] == 33
    (episode,) = episodes
    assert (np.diff(kpa(episode, "arm")) >= 1).all()  # none is there twice, one of 100 left out
    assert abs(info["total_frames"] - 500) <= 6


def test_times_that_jitter_lose_no_frame(tmp_path: Path) -> None:
    jitter_ms = np.random.default_rng(1).uniform(-20, 20, 300)
    jitter_ms[0] = 0.0
    info, episodes = data_set(tmp_path, part("arm", np.arange(300) * 50.0 + jitter_ms))
    check(info, episodes)
    assert kpa(episodes[0], "arm") == list(range(1, 301))


def test_a_lost_frame_is_bridged_and_nothing_is_valid_in_a_longer_gap(tmp_path: Path) -> None:
    times_ms = np.delete(np.arange(20) * 50.0, [4, 10, 11, 12])
    info, episodes = data_set(tmp_path, part("arm", times_ms))
    check(info, episodes)
    assert kpa(episodes[0], "arm") == (
        [1, 2, 3, 4, 4, 5, 6, 7, 8, 9, 9, -1, -1, 10, 11, 12, 13, 14, 15, 16]
    )


def test_a_slower_part_is_held_between_its_frames_but_not_after_its_last(tmp_path: Path) -> None:
    fast, slow = part("arm", np.arange(40) * 10.0), part("hand", [10.0, 60.0, 110.0, 160.0])
    info, episodes = data_set(tmp_path, fast, slow)
    check(info, episodes)
    hand = kpa(episodes[0], "hand")
    assert hand[:17] == [-1, *[1] * 5, *[2] * 5, *[3] * 5, 4]
    assert hand[-1] == -1
    assert kpa(episodes[0], "arm") == list(range(1, 41))


def test_what_a_part_has_before_or_after_the_fastest_one_is_there_too(tmp_path: Path) -> None:
    fast, slow = part("arm", 1000 + np.arange(100) * 10.0), part("hand", np.arange(30) * 100.0)
    info, episodes = data_set(tmp_path, fast, slow)
    check(info, episodes)
    assert set(kpa(episodes[0], "hand")) == set(range(1, 31))
    assert set(kpa(episodes[0], "arm")) == {-1, *range(1, 101)}


def test_each_step_has_the_time_at_which_it_was_measured(tmp_path: Path) -> None:
    arm = part("arm", [0.0, 31.0, 59.0, 92.0, 120.0])
    _, (episode,) = data_set(tmp_path, arm, part("hand", [95.0]))
    assert set(episode["skin.arm.t_ns"]) == set(arm.t_ns)
    assert episode["skin.hand.t_ns"].tolist()[0] == 0  # nothing of it yet
    assert episode["skin.hand.t_ns"].tolist()[-1] == START_NS + 95 * MS


def test_a_long_recording_is_several_episodes_as_long_as_float32_has_the_time(
    tmp_path: Path,
) -> None:
    info, episodes = data_set(tmp_path, part("arm", np.arange(25_000) * 100.0))
    check(info, episodes)
    assert [len(episode["index"]) for episode in episodes] == [10_000, 10_000, 5000]
    lines = (tmp_path / "meta/episodes.jsonl").read_text().splitlines()
    assert [json.loads(line)["length"] for line in lines] == [10_000, 10_000, 5000]
    assert len((tmp_path / "meta/episodes_stats.jsonl").read_text().splitlines()) == 3
    assert np.concatenate([kpa(episode, "arm") for episode in episodes]).tolist() == list(
        range(1, 25_001)
    )


@given(
    steps_ms=st.lists(st.floats(5.0, 900.0), min_size=2, max_size=20),
    others_ms=st.sets(st.integers(0, 400), min_size=1, max_size=10),
)
def test_any_times_pass_the_check_and_no_value_is_of_another_time(
    tmp_path_factory: pytest.TempPathFactory, steps_ms: list[float], others_ms: set[int]
) -> None:
    parts = part("arm", np.cumsum(steps_ms)), part("hand", [5.0 * t for t in sorted(others_ms)])
    info, episodes = data_set(tmp_path_factory.mktemp("set"), *parts)
    check(info, episodes)
    start_ns = min(int(one.t_ns[0]) for one in parts)
    for one in parts:
        for episode in episodes:
            t_ns = episode[f"skin.{one.name}.t_ns"]
            at_ns = start_ns + episode["index"] * 1e9 / info["fps"]
            found = np.array(kpa(episode, one.name))
            valid = found >= 0
            rows = found[valid].astype(int) - 1
            assert (one.t_ns[rows] == t_ns[valid]).all()
            assert (t_ns[valid] - at_ns[valid] <= 0.5e9 / info["fps"] + 1e3).all()


def test_a_recording_that_is_nearly_all_gap_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"arm: .*100 steps a second for .* s; wanted at most"):
        data_set(tmp_path / "set", part("arm", [0.0, 10.0, 20.0, 1e10]))
    assert not (tmp_path / "set").exists()


def test_frames_that_share_the_times_of_their_recorder_have_no_rate(tmp_path: Path) -> None:
    """Of equal times in a recording those of its frames are a nanosecond apart."""
    times_ms = [100.0 * (n // 4) + 1e-6 * (n % 4) for n in range(400)]
    with pytest.raises(RequestError, match="arm: its time stands still; it has no rate"):
        data_set(tmp_path / "set", part("arm", times_ms))
    assert not (tmp_path / "set").exists()


def test_episodes_of_another_data_set_are_neither_mixed_in_nor_replaced(tmp_path: Path) -> None:
    long, short = (part("arm", np.arange(n) * 1000.0) for n in (1500, 20))
    data_set(tmp_path, long)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(RequestError, match=r"holds data/chunk-000/episode_000001\.parquet"):
        data_set(tmp_path, short)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    data_set(tmp_path, long)


def test_a_data_set_is_replaced_by_its_own_recording_alone(tmp_path: Path) -> None:
    palm = part("palm", range(0, 1000, 50))
    data_set(tmp_path, palm)
    first = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    for other in (part("palm", range(50, 1050, 50)), part("hand", range(0, 1000, 50))):
        with pytest.raises(RequestError, match="not known to be of this recording"):
            data_set(tmp_path, other)
    assert first == {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    data_set(tmp_path, palm)
    for content in ("{}", "[]", '{"skin": 1}', ""):
        (tmp_path / "meta/info.json").write_text(content)
        with pytest.raises(RequestError, match="not known to be of this recording"):
            data_set(tmp_path, palm)
