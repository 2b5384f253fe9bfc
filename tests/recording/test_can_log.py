"""Recordings of CAN frames in every format: times, kinds and channels are kept, or it is stated."""

import json
import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from skin_host.bus.logs import read_channels
from skin_host.bus.port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from skin_host.bus.wire import FrameBatch
from skin_host.cli import main
from skin_host.config.settings import Settings, changed, load
from skin_host.errors import LogError, RequestError, SkinError
from skin_host.files import Disk, on_disk
from skin_host.recording.capture import CanLog
from skin_host.recording.mcap import Recorder, read_messages_of
from skin_host.recording.replay import read_buses
from tests.support.candump import write_config, write_log
from tests.support.live import CONFIG

START_NS = 1_700_000_000 * 10**9
MS = 1_000_000
TOPIC = "skin/demo/palm"


def at(*times_ms: int, identifier: int = 0x4E0) -> FrameBatch:
    return FrameBatch.of([(identifier, b"ab", START_NS + ms * MS) for ms in times_ms])


def times_of(path: Path) -> list[tuple[str, int]]:
    """Channel and ms since the start of each frame."""
    found = [
        (channel, t_ns) for channel, batch in read_channels(path) for t_ns in batch.t_ns.tolist()
    ]
    return [(channel, round((t_ns - START_NS) / MS)) for channel, t_ns in found]


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc", ".csv"])
def test_buses_that_are_read_in_turn_keep_their_times(tmp_path: Path, suffix: str) -> None:
    """Formats of python-can move a time that is before the last one to that, or by decades."""
    path = tmp_path / f"a{suffix}"
    with CanLog(path) as log:
        log.put("can0", at(100, 110))
        log.put("can1", at(95, 105))
        log.put("can0", at(120))
        log.put("can1", at(115))
    ms = sorted(t for _, t in times_of(path))
    assert [t - ms[0] for t in ms] == [0, 5, 10, 15, 20, 25]
    channels = {".log": {"can0", "can1"}, ".trc": {"1", "2"}, ".csv": {""}}
    assert {channel for channel, _ in times_of(path)} == channels.get(suffix, {"0", "1"})
    assert (log.frames, log.moved) == (6, 0)


@pytest.mark.parametrize("suffix", [".LOG", ".BLF", ".ASC", ".TRC", ".CSV", ".MCAP"])
def test_a_name_in_capitals_is_of_the_same_format(
    tmp_path: Path, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other computers write such names."""
    config = write_config(tmp_path / "skin.toml")
    plain = write_log(tmp_path / "a.log", 120, lambda _: ())
    path = tmp_path / f"B{suffix}"
    with Recorder(path) if suffix == ".MCAP" else CanLog(path) as log:
        for channel, batch in read_channels(plain):
            (log.can if isinstance(log, Recorder) else log.put)(channel, batch)
    assert main(["replay", str(path), "--config", str(config)]) == 0
    assert '"type":"frame"' in capsys.readouterr().out


def test_messages_of_a_recording_named_in_capitals_need_no_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, other = tmp_path / "A.MCAP", tmp_path / "B.MCAP"
    with Recorder(path) as recorder:
        recorder.say(f"{TOPIC}/contact", START_NS, b"ON")
    for command in (["replay", str(path), "--onto", "broker"], ["record", str(other)]):
        assert main([*command, "--broker", "nowhere"]) == 2
        assert "wanted mqtt://" in capsys.readouterr().err
    main(["export", str(path), str(tmp_path / "a.npz")])
    assert "--config" not in capsys.readouterr().err


@pytest.fixture(params=["UTC", "Europe/Rome", "America/St_Johns"])
def zone(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", request.param)
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("zone")
@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc", ".csv"])
@pytest.mark.parametrize("start_us", [0, 7_125, 42_000, 42_999, 999_999])
def test_times_are_exact_to_the_microsecond_in_every_time_zone(
    tmp_path: Path, suffix: str, start_us: int
) -> None:
    path = tmp_path / f"a{suffix}"
    times_ns = [START_NS + (start_us + us) * 1000 for us in (0, 1, 125, 999, 1000, 3_600_000_007)]
    with CanLog(path) as log:
        log.put("can0", FrameBatch.of([(0x4E0, b"ab", t_ns) for t_ns in times_ns]))
    found = [int(t_ns) for _, batch in read_channels(path) for t_ns in batch.t_ns]
    assert [t_ns - START_NS for t_ns in found] == [t_ns - START_NS for t_ns in times_ns]


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc", ".csv"])
def test_a_clock_that_is_set_back_is_kept_or_counted(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with CanLog(path) as log:
        log.put("can0", at(3_600_000, 3_600_010))
        log.put("can0", at(3_600_500))
        log.put("can0", at(0, 10, 20))
    ms = [t for _, t in times_of(path)]
    if suffix in (".log", ".trc", ".csv"):
        assert ms == [3_600_000, 3_600_010, 3_600_500, 0, 10, 20]
        assert log.moved == 0
    else:
        assert [t - ms[0] for t in ms] == [0, 10, 500, 500, 500, 500]
        assert log.moved == 3


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc", ".csv"])
@pytest.mark.parametrize("step_ms", [3_600_000, 150, 30])
@pytest.mark.parametrize("is_one_batch", [False, True])
def test_frames_keep_their_order_when_the_clock_is_set_back(
    tmp_path: Path, suffix: str, step_ms: int, is_one_batch: bool
) -> None:
    """Those that are held back for the other buses, too: they were before the jump."""
    path = tmp_path / f"a{suffix}"
    times_ms = [step_ms + t - step_ms * (t >= 500) for t in range(0, 1000, 10)]
    frames = [(0x400 + n, b"ab", START_NS + t * MS) for n, t in enumerate(times_ms)]
    with CanLog(path) as log:
        for n in range(0, 100, 100 if is_one_batch else 5):
            log.put("can0", FrameBatch.of(frames[n : n + (100 if is_one_batch else 5)]))
    ids = [int(number) for _, batch in read_channels(path) for number in batch.id]
    assert ids == list(range(0x400, 0x464))
    assert (log.moved > 0) == (suffix in (".blf", ".asc"))


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_the_buses_of_a_clock_that_is_set_back_keep_their_orders(
    tmp_path: Path, suffix: str
) -> None:
    """The second bus is read after the jump, and gives frames from before it."""
    path = tmp_path / f"a{suffix}"
    hour_ms = 3_600_000
    with CanLog(path) as log:
        log.put("can0", at(hour_ms, hour_ms + 10, identifier=0x400))
        log.put("can1", at(hour_ms + 5, identifier=0x500))
        log.put("can0", at(0, 10, identifier=0x401))
        log.put("can1", at(hour_ms + 15, 5, identifier=0x501))
        log.put("can2", at(7, identifier=0x600))
        log.put("can0", at(200, identifier=0x402))
    ids: dict[str, list[int]] = {}
    for channel, batch in read_channels(path):
        ids.setdefault(channel, []).extend(batch.id.tolist())
    assert ids == {
        "0": [0x400] * 2 + [0x401] * 2 + [0x402],
        "1": [0x500, 0x501, 0x501],
        "2": [0x600],
    }


def test_times_that_stand_still_do_not_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skin_host.recording.capture.MAX_HELD", 100)
    path = tmp_path / "a.asc"
    with CanLog(path) as log:
        for _ in range(50):
            log.put("can0", at(*[0] * 100))
        assert path.parent.joinpath(log._draft.path).stat().st_size > 50_000
    assert len(times_of(path)) == log.frames == 5000


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc", ".csv"])
def test_what_a_format_cannot_hold_is_counted(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    kinds = [0x4E0, 0x123 | EXTENDED_FLAG, 0x123 | REMOTE_FLAG, 0x4 | ERROR_FLAG]
    with CanLog(path) as log:
        for n, kind in enumerate(kinds):
            log.put("can0", at(n, identifier=kind))
    assert len(times_of(path)) == log.frames
    assert log.frames + log.left_out == 4
    assert log.left_out == (2 if suffix == ".trc" else 0)


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc"])
def test_a_recording_of_two_buses_is_replayed_with_its_configuration(
    tmp_path: Path, suffix: str
) -> None:
    settings = load(two_buses(tmp_path, "can2", "can5"))
    path = tmp_path / f"a{suffix}"
    with CanLog(path, ["can2", "can5"]) as log:
        log.put("can5", at(0, identifier=0x4E5))
        log.put("can2", at(1, identifier=0x4E2))
    found = {name: batch.id.tolist() for name, batch in read_buses(path, settings)}
    assert found == {"left": [0x4E2], "right": [0x4E5]}


@pytest.mark.parametrize(
    ("suffix", "channels"),
    [
        (".csv", ("can0", "can1")),
        (".blf", ("can0", "vcan0")),
        (".asc", ("left", "right")),
        (".trc", ("can1", "vcan1")),
        (".log", ("0", "00")),
    ],
)
def test_channels_that_a_format_does_not_tell_apart_are_refused(
    tmp_path: Path, suffix: str, channels: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.raises(RequestError, match=r"a\.\w+: channels .* are the same"):
        CanLog(path, channels)
    config = two_buses(tmp_path, *channels)
    assert main(["record", str(path), "--config", str(config), "--seconds", "0.1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "wanted .mcap" in line
    assert not path.exists()


@pytest.mark.parametrize("channel", ["my bus", "007", " "])
def test_a_channel_whose_name_is_no_word_is_read_as_it_was_written(
    tmp_path: Path, channel: str
) -> None:
    settings = load(two_buses(tmp_path, channel, "can5"))
    path = tmp_path / "a.log"
    with CanLog(path, [channel, "can5"]) as log:
        log.put(channel, at(0, identifier=0x4E2))
    assert [(name, batch.id.tolist()) for name, batch in read_buses(path, settings)] == [
        ("left", [0x4E2])
    ]


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc", ".mcap"])
def test_the_other_bus_of_a_recording_is_none_of_a_configuration_with_one(
    tmp_path: Path, suffix: str
) -> None:
    path = recording_of(tmp_path / f"a{suffix}", "can5", "can2")
    for channel, identifier in (("can2", 0x4E2), ("can5", 0x4E5)):
        read = [*read_buses(path, one_bus(channel))]
        found = [(name, number) for name, batch in read for number in batch.id.tolist()]
        assert found == [("can0", identifier)] * 20


@pytest.mark.parametrize("suffix", [".log", ".asc", ".mcap"])
def test_a_recording_of_two_buses_that_are_others_names_them(tmp_path: Path, suffix: str) -> None:
    path = recording_of(tmp_path / f"a{suffix}", "can5", "can2")
    with pytest.raises(LogError, match=r"its channels are (can)?2, (can)?5; .* are can0$"):
        list(read_buses(path, one_bus("can0")))


@pytest.mark.parametrize("suffix", [".log", ".asc", ".csv", ".mcap"])
def test_the_only_bus_of_a_recording_is_that_of_the_configuration(
    tmp_path: Path, suffix: str
) -> None:
    path = recording_of(tmp_path / f"a{suffix}", "can2")
    found = [int(one) for _, batch in read_buses(path, one_bus("239.74.163.1")) for one in batch.id]
    assert found == [0x4E2] * 20


def recording_of(path: Path, *channels: str) -> Path:
    """A recording of frames 0x4E2 on can2 and so on, in turn."""
    with Recorder(path) if path.suffix == ".mcap" else CanLog(path, channels) as log:
        put = log.can if isinstance(log, Recorder) else log.put
        for ms in range(10):
            for channel in channels:
                put(channel, at(ms, ms, identifier=0x4E0 + int(channel[-1])))
    return path


def one_bus(channel: str) -> Settings:
    return changed(load(CONFIG), {"buses.can0.channel": channel})


def two_buses(folder: Path, left: str, right: str) -> Path:
    path = folder / "two.toml"
    path.write_text(
        f'robot = "two"\n[buses.left]\ninterface = "virtual"\nchannel = "{left}"\n'
        f'[buses.right]\ninterface = "virtual"\nchannel = "{right}"\n'
        '[boards.a]\nbus = "left"\naddress = 2\n[boards.b]\nbus = "right"\naddress = 5\n'
        '[[parts.a.patches]]\nboard = "a"\ntriangles = "0-15"\n'
        '[[parts.b.patches]]\nboard = "b"\ntriangles = "0-15"\n'
    )
    return path


@pytest.fixture
def full_disk() -> Iterator[None]:
    """A disk that takes 10 kB of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_whole_lines(tmp_path: Path, full_disk: None) -> None:
    path = tmp_path / "a.log"
    with pytest.raises(SkinError, match="cannot be written: File too large"), CanLog(path) as log:
        for n in range(1000):
            log.put("can0", at(n))
    assert len(times_of(path)) == log.frames > 100
    assert [file.name for file in tmp_path.iterdir()] == ["a.log"]


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".csv", ".mcap"])
def test_what_a_full_disk_took_of_a_file_is_named(
    tmp_path: Path, full_disk: None, suffix: str
) -> None:
    path = tmp_path / f"a{suffix}"

    def record() -> None:
        if suffix == ".mcap":
            with Recorder(path) as recorder:
                for n in range(100_000):
                    record = {"schema": "skin.health/1", "state": os.urandom(4).hex()}
                    recorder.say(f"{TOPIC}/health", n, json.dumps(record).encode())
            return
        with CanLog(path) as log:
            for n in range(10_000):
                log.put("can0", FrameBatch.of([(0x4E0, os.urandom(8), START_NS + n * MS)]))

    with pytest.raises(SkinError, match="cannot be written: File too large") as full:
        record()
    (left,) = tmp_path.iterdir()
    assert str(full.value).endswith(f"File too large; a part of it is {left}")
    assert 0 < left.stat().st_size <= 10_000


def test_a_recording_is_made_where_a_link_shows(tmp_path: Path) -> None:
    """Also if nothing is there yet."""
    (tmp_path / "disk").mkdir()
    for suffix in (".log", ".mcap"):
        link, end = tmp_path / f"a{suffix}", tmp_path / "disk" / f"b{suffix}"
        link.symlink_to(end)
        if suffix == ".log":
            with CanLog(link) as log:
                log.put("can0", at(0))
        else:
            with Recorder(link) as recorder:
                recorder.say(f"{TOPIC}/contact", 1, b"ON")
        assert link.is_symlink()
        assert end.is_file()
    assert [message.payload for message in read_messages_of(tmp_path / "a.mcap")] == [b"ON"]


def test_a_recording_without_names_of_channels_is_not_that_of_two_buses(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with CanLog(path) as log:
        log.put("can0", at(0))
    with pytest.raises(LogError, match="its channels are unnamed"):
        list(read_buses(path, load(two_buses(tmp_path, "can0", "can1"))))


class Watched(Disk):
    """Notes what is forced to the disk, and whether the recording had its name by then."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.synced: list[tuple[str, bool]] = []

    def sync(self, path: Path) -> None:
        self.synced.append((path.suffix, self.path.exists()))
        super().sync(path)


@pytest.mark.parametrize("suffix", [".log", ".blf", ".mcap"])
def test_a_recording_is_on_the_disk_before_it_has_its_name(tmp_path: Path, suffix: str) -> None:
    """After a power failure it would be empty."""
    disk = Watched(tmp_path / f"a{suffix}")
    with on_disk(disk):
        if suffix == ".mcap":
            with Recorder(disk.path) as recorder:
                recorder.say(f"{TOPIC}/contact", 1, b"ON")
        else:
            with CanLog(disk.path) as log:
                log.put("can0", at(0))
    assert disk.synced == [(suffix, False)]
    assert disk.path.exists()
