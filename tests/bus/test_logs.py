"""Recordings: exact times, every format, and one clear line for what cannot be read."""

import gc
import gzip
import io
import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import can
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.bus import logs
from skin_host.bus.logs import WINDOW_NS, read_channels
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Settings
from skin_host.errors import LogError
from skin_host.recording.replay import read_buses

GRASP = Path(__file__).parents[2].parent / "shared/data/icub_grasp.log"
MS = 1_000_000


def candump(path: Path, lines: list[str]) -> Path:
    path.write_text("".join(line + "\n" for line in lines))
    return path


def read(path: Path, window_ns: int = WINDOW_NS) -> Iterator[FrameBatch]:
    return (batch for _, batch in read_channels(path, window_ns))


def test_candumps_microseconds_are_exact(tmp_path):
    stamps = [f"{1700000000 + i}.{(i * 7919) % 1_000_000:06d}" for i in range(500)]
    path = candump(tmp_path / "a.log", [f"({stamp}) can0 4E4#40F4" for stamp in stamps])
    times = [int(t) for batch in read(path) for t in batch.t_ns]
    assert times == [int(stamp.replace(".", "")) * 1000 for stamp in stamps]


def test_identifiers_data_and_flags_are_those_of_the_bus(tmp_path):
    path = candump(
        tmp_path / "a.log",
        ["(1.0) can0 4E4#40F4F4", "(1.001) can0 1F334455#00", "(1.002) can0 123#R"],
    )
    (batch,) = read(path)
    assert batch.id.tolist() == [0x4E4, 0x80000000 | 0x1F334455, 0x40000123]
    assert batch.dlc.tolist() == [3, 1, 0]
    assert batch.data[0, :3].tolist() == [0x40, 0xF4, 0xF4]


def test_batches_span_no_more_than_the_window(tmp_path):
    lines = [f"({10 + i * 0.001:.6f}) can0 4E0#40" for i in range(100)]
    batches = list(read(candump(tmp_path / "a.log", lines), window_ns=4 * MS))
    assert sum(len(batch) for batch in batches) == 100
    assert all(int(batch.t_ns[-1] - batch.t_ns[0]) < 4 * MS for batch in batches)
    assert len(batches) == 25


@pytest.mark.parametrize(
    ("of_clock", "of_row"),
    [(-3600, range(50, 100)), (-0.05, range(50, 100)), (3600, range(50, 51)), (-3600, [50, 70])],
    ids=["set back", "set back a little", "one time ahead", "two times back"],
)
def test_batches_span_no_more_than_the_window_when_time_goes_back(tmp_path, of_clock, of_row):
    """A window that waited for a later time would take in one channel's seconds, then the other's,
    and a sensor whose halves or boards lie on both would have no whole sweep.
    """
    lines = [
        f"({10_000 + row * 0.001 + of_clock * (row in of_row):.6f}) can{row % 2} {0x400 + row:X}#40"
        for row in range(100)
    ]
    path = candump(tmp_path / "a.log", lines)
    batches = list(read(path, window_ns=4 * MS))
    assert all(int(np.ptp(batch.t_ns)) < 4 * MS for batch in batches)
    rows = np.concatenate([batch.id for batch in batches]) - 0x400
    assert np.abs(rows - np.arange(100)).max() < 4


def test_a_flood_within_a_window_is_cut(tmp_path):
    path = candump(tmp_path / "a.log", ["(10.0) can0 4E0#40"] * 5000)
    sizes = [len(batch) for batch in read(path)]
    assert sum(sizes) == 5000
    assert max(sizes) <= 1024


def test_channels_are_kept_apart(tmp_path):
    path = candump(
        tmp_path / "a.log",
        ["(1.0) can0 4E0#40", "(1.0005) can1 4E1#40", "(1.001) can0 4E2#40"],
    )
    assert [(name, batch.id.tolist()) for name, batch in read_channels(path)] == [
        ("can0", [0x4E0, 0x4E2]),
        ("can1", [0x4E1]),
    ]


def test_the_channel_of_the_only_bus_keeps_its_order_beside_another(tmp_path):
    lines = [f"({1 + n * 0.0005:.4f}) can{n % 3 % 2} {0x4E0 + n:X}#40" for n in range(16)]
    path = candump(tmp_path / "a.log", lines)
    settings = msgspec.convert(
        {
            "robot": "one",
            "buses": {"left": {}},
            "boards": {"arm": {"bus": "left", "address": 14}},
            "parts": {"arm": {"patches": [{"board": "arm", "triangles": "0-15"}]}},
        },
        Settings,
    )
    for window_ns in (WINDOW_NS, 25 * MS):
        batches = [batch for _, batch in read_buses(path, settings, window_ns)]
        expected = [0x4E0 + n for n in range(16) if n % 3 != 1]
        assert np.concatenate([batch.id for batch in batches]).tolist() == expected


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".csv", ".trc", ".log.gz", ".asc.gz"])
def test_every_format_of_python_can_gives_the_same_frames(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    sent = [(0x4E0 + i, bytes(range(i, i + 8)), 1700000000.0 + i / 100) for i in range(10)]
    with can.Logger(path) as logger:
        for identifier, data, timestamp in sent:
            logger.on_message_received(
                can.Message(timestamp, identifier, is_extended_id=False, data=data, channel=1)
            )
    frames = [
        (identifier, data)
        for batch in read(path)
        for identifier, data in zip(batch.id.tolist(), batch.data, strict=True)
    ]
    assert [identifier for identifier, _ in frames] == [identifier for identifier, *_ in sent]
    assert [data.tobytes() for _, data in frames] == [data for _, data, _ in sent]
    times = np.concatenate([batch.t_ns.copy() for batch in read(path)])
    assert np.all(np.abs(times - 1_700_000_000_000 * MS - np.arange(10) * 10 * MS) <= MS)


def asc(path: Path, date: str, base: str = "hex  timestamps absolute") -> list[int]:
    """Times of the frames of an ASC recording, in ms."""
    path.write_text(
        f"date {date}\nbase {base}\ninternal events logged\nBegin Triggerblock {date}\n"
        "   0.000000 Start of measurement\n   0.500000 1  4E0             Rx   d 1 40\n"
        "   0.501000 1  4E1             Rx   d 1 40\nEnd TriggerBlock\n"
    )
    return [int(t_ns) // MS for batch in read(path) for t_ns in batch.t_ns]


@pytest.mark.parametrize(
    "date",
    [
        "Tue Nov 14 22:13:20.042 2023",
        "Die Nov 14 22:13:20.042 2023",
        "Tue Nov 14 10:13:20.042 pm 2023",
        "Tue Nov 14 22:13:20.42 2023",  # by python-can
    ],
)
def test_times_of_asc_count_from_its_date(tmp_path, date):
    """In local time, as every program writes it."""
    local = datetime(2023, 11, 14, 22, 13, 20, 42_000).timestamp()
    start_ms = round(local * 1000)
    assert asc(tmp_path / "a.asc", date) == [start_ms + 500, start_ms + 501]


@pytest.mark.parametrize(
    "date", ["mar. nov. 14 22:13:20.042 2023", "Thu Jan 01 00:00:00 1960", "x"]
)
def test_times_of_asc_count_from_the_begin_if_its_date_is_none(tmp_path, date):
    assert asc(tmp_path / "a.asc", date) == [500, 501]


def test_times_of_asc_that_count_from_the_line_before_are_refused(tmp_path):
    with pytest.raises(LogError, match="wanted `timestamps absolute`"):
        asc(tmp_path / "a.asc", "Tue Nov 14 22:13:20.042 2023", "hex  timestamps relative")


def test_a_trc_after_another_does_not_get_its_times(tmp_path):
    """Its times count from its own begin, which python-can reads from the first head alone."""
    data = b""
    for began_s in (1_700_000_000.0, 1_700_003_600.0):
        with can.Logger(tmp_path / "one.trc") as writer:
            for k in range(3):
                writer(can.Message(timestamp=began_s + k, arbitration_id=4, data=[k]))
        data += (tmp_path / "one.trc").read_bytes()
    (tmp_path / "both.trc").write_bytes(data)
    times_ns: list[int] = []
    with pytest.raises(
        LogError, match="after frame 3: it goes on after its end, as two recordings"
    ):
        for batch in read(tmp_path / "both.trc"):
            times_ns += batch.t_ns.tolist()
    assert times_ns == [1_700_000_000_000_000_000 + k * 1000 * MS for k in range(3)]


@pytest.mark.skipif(not GRASP.exists(), reason=f"the recording {GRASP.name} is not here")
def test_a_real_hands_recording_is_read_whole():
    batches = list(read(GRASP))
    text = GRASP.read_text().splitlines()
    assert sum(len(batch) for batch in batches) == len(text)
    first = text[0].split()[0].strip("()").replace(".", "")
    last = text[-1].split()[0].strip("()").replace(".", "")
    assert int(batches[0].t_ns[0]) == int(first) * 1000
    assert int(batches[-1].t_ns[-1]) == int(last) * 1000


def whole_blf(path: Path) -> bytes:
    with can.Logger(path) as logger:
        for i in range(2000):
            logger.on_message_received(can.Message(1.0 + i, 0x4E0, data=bytes(8)))
    return path.read_bytes()


def message_of(path: Path) -> str:
    with pytest.raises(LogError) as caught:
        for _ in read(path):
            pass
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text


# python-can leaves a file open if it does not like its header.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_what_cannot_be_read_is_one_line(tmp_path):
    assert "No such file" in message_of(tmp_path / "absent.log")
    assert "known are .asc, " in message_of(tmp_path / "a.wav")
    assert "known are .asc, " in message_of(tmp_path / "a")
    for name in ("a.log.xyz", "a.asc.xyz", "a.xyz.gz", "a.log.xyz.gz", "a.gz"):
        (tmp_path / name).touch()
        assert "unknown format of file name; known are .asc, " in message_of(tmp_path / name)
    directory = tmp_path / "folder.log"
    directory.mkdir()
    assert "directory" in message_of(directory)
    empty = tmp_path / "empty.log"
    empty.write_bytes(b"")
    assert "no CAN frame" in message_of(empty)
    noise = np.random.default_rng(0).bytes(4096)
    for suffix in (".log", ".asc", ".blf", ".csv", ".trc", ".log.gz", ".mf4", ".db"):
        garbage = tmp_path / f"garbage{suffix}"
        garbage.write_bytes(noise)
        message_of(garbage)
    gc.collect()


def test_what_comes_before_damage_is_handed_on(tmp_path):
    good = [f"({10 + i}.0) can0 4E0#40" for i in range(3)]
    path = candump(tmp_path / "cut.log", [*good, "(13.0) can0 4E"])
    frames = 0
    with pytest.raises(LogError, match="damaged after frame 3"):
        for batch in read(path):
            frames += len(batch)
    assert frames == 3


def test_frames_of_can_fd_are_passed_over(tmp_path):
    lines = ["(1.0) can0 4E0#40", "(1.001) can0 4E1##1" + "00" * 12, "(1.002) can0 4E2#41"]
    (batch,) = read(candump(tmp_path / "fd.log", lines))
    assert batch.id.tolist() == [0x4E0, 0x4E2]


@pytest.mark.parametrize(("written", "seen"), [("99999999999999.0", "1e+14"), ("9" * 400, "inf")])
def test_a_time_that_no_clock_shows_ends_a_recording(tmp_path, written: str, seen: str):
    far = candump(tmp_path / "far.log", ["(1.0) can0 4E0#40", f"({written}) can0 4E0#40"])
    assert f"damaged after frame 1: line 2: a time of {seen} s" in message_of(far)


@pytest.mark.parametrize(
    "damaged",
    [
        "00000) can0 4E0#40",
        "(1_7) can0 4E0#40",
        "(1e1) can0 4E0#40",
        "(inf) can0 4E0#40",
        "(nan) can0 4E0#40",
        "(2.0) can0 4_0#40",
        "(2.0) can0 4E0#+4",
        "(2.0) can0 4E0#4",
        "(2.0) can0 4E0#40\r(3.0) can0 4E0#40",
    ],
)
def test_what_candump_does_not_write_ends_a_recording(tmp_path, damaged: str):
    """A first line that was cut in its time counted as time 0."""
    path = candump(tmp_path / "odd.log", ["(1.0) can0 4E0#40", damaged])
    assert "damaged after frame 1: line 2: seen" in message_of(path)


def test_every_form_of_candump_is_read(tmp_path):
    lines = ["(1) 0 1#", "(1.) can0 4E0#R", "(1.5) can0 4E0#R8", "(2.0) can0 1234567#4041 R", "\t"]
    ids = [each for batch in read(candump(tmp_path / "forms.log", lines)) for each in batch.id]
    assert ids == [0x1, 0x400004E0, 0x400004E0, 0x81234567]


BLANK = st.lists(st.sampled_from([b"\n", b"\r\n"]), max_size=4).map(b"".join)


@given(blanks=st.lists(BLANK, min_size=1, max_size=6), size=st.integers(1, 90))
def test_blank_lines_change_neither_frames_nor_the_number_of_a_damaged_line(blanks, size):
    text, wanted = b"", []
    for i, blank in enumerate(blanks):
        text += blank + b"(%d.000000) can0 4E0#40\n" % i
        wanted.append(i * 10**9)
    number = text.count(b"\n") + 2
    text += b"\nnonsense\n"
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logs, "BLOCK_BYTES", size)
        for block in logs.read_blocks(io.BytesIO(text), lambda _: None):
            seen += block.batch.t_ns.tolist()
    assert seen == wanted
    assert str(block.damage).startswith(f"line {number}: ")


def test_blank_lines_make_no_rows(monkeypatch):
    """300 MB of them, which are little when they are compressed, took a minute."""
    sizes = []

    class Rows(logs._Rows):
        def __new__(cls, *columns):
            sizes.append(len(columns[0]))
            return super().__new__(cls, *columns)

    monkeypatch.setattr(logs, "_Rows", Rows)
    blank = b"\n" * 100_000 + b"\r\n" * 100_000
    text = blank + b"(1.000000) can0 4E0#40\n" + blank
    blocks = list(logs.read_blocks(io.BytesIO(text), lambda _: None))
    assert sum(len(block.batch) for block in blocks) == 1
    assert max(sizes) < 10


def test_cut_files_are_told(tmp_path):
    text = "".join(f"({10 + i}.0) can0 4E0#40\n" for i in range(5000)).encode()
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(gzip.compress(text)[:-200])
    assert "damaged after frame" in message_of(cut)
    blf = tmp_path / "whole.blf"
    cut = tmp_path / "cut.blf"
    cut.write_bytes(whole_blf(blf)[:-1000])
    assert "cut off" in message_of(cut)


def whole_text(path: Path) -> list[str]:
    """Write ten frames of eight bytes in the format of a name; return the lines, and their ends."""
    with can.Logger(path) as logger:
        for number in range(10):
            logger.on_message_received(
                can.Message(
                    timestamp=1700000000.0 + number,
                    arbitration_id=0x4E0,
                    data=bytes([0x40, *range(7)]),
                    is_extended_id=False,
                    channel="can0",
                )
            )
    return path.read_text().splitlines(keepends=True)


@pytest.mark.parametrize(("suffix", "lost"), [(".asc", 3), (".csv", 4), (".trc", 3)])
def test_a_line_that_was_cut_is_damage_and_no_shorter_frame(
    tmp_path: Path, suffix: str, lost: int
) -> None:
    """One without its last byte, the status, was taken for one of a board that sends none."""
    path = tmp_path / f"cut{suffix}"
    lines = whole_text(path)
    lines[-5] = f"{lines[-5].rstrip()[:-lost]}\n"
    path.write_text("".join(lines))
    assert re.search(r"damaged after frame \d: \d bytes of a frame of 8$", message_of(path))


@pytest.mark.parametrize("cut", ["100", "nonsense"])
def test_a_line_of_a_trc_that_is_no_message_is_damage(tmp_path: Path, cut: str) -> None:
    """It was passed over, uncounted."""
    path = tmp_path / "cut.trc"
    lines = whole_text(path)
    lines[-5] = f"{cut}\n"
    path.write_text("".join(lines))
    assert f'damaged after frame 5: seen "{cut}", wanted a message' in message_of(path)


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc"])
def test_a_text_that_ends_in_the_middle_of_a_line_is_read_as_far_as_it_is_whole(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, suffix: str
) -> None:
    path = tmp_path / f"cut{suffix}"
    lines = whole_text(path)
    if suffix == ".asc":
        del lines[-1]  # the end of the block
    path.write_text("".join(lines).rstrip()[:-3])
    assert sum(len(batch) for batch in read(path)) == 9
    assert "ends in the middle of a line" in caplog.text


def test_error_frames_of_candump_are_no_data_frames(tmp_path):
    """Played onto a bus, they would be sent."""
    lines = [
        "(1.0) can0 20000004#000C000000000000",
        "(1.0) can0 20000080#0000000000000000",
        "(1.0) can0 3FFFFFFF#00",
        "(1.0) can0 1FFFFFFF#00",
    ]
    (batch,) = read(candump(tmp_path / "a.log", lines))
    assert batch.id.tolist() == [0x20000004, 0x20000080, 0x3FFFFFFF, 0x9FFFFFFF]
    assert batch.data[0].tolist() == [0, 12, 0, 0, 0, 0, 0, 0]
