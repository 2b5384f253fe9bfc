"""Logs of candump are read in blocks: the same batches as line by line."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skin_host.bus import logs
from skin_host.bus.adapters import identifier, nanoseconds
from skin_host.bus.logs import CAPACITY, WINDOW_NS, read_channels
from skin_host.bus.wire import FrameBatch
from skin_host.errors import LogError

Read = list[tuple[str, list[tuple[int, bytes, int]]]]


def line_by_line(path: Path) -> Iterator[tuple[str, list[tuple[int, bytes, int]]]]:
    """The oracle: each message of python-can put where it belongs."""
    windows: dict[str, list[tuple[int, bytes, int]]] = {}
    low_ns = high_ns = 0
    with can.LogReader(path) as reader:
        for message in reader:
            if message.is_fd:
                continue
            channel = "" if message.channel is None else str(message.channel)
            t_ns = nanoseconds(message.timestamp)
            is_within = max(high_ns, t_ns) - min(low_ns, t_ns) < WINDOW_NS
            if windows and (not is_within or len(windows.get(channel, ())) == CAPACITY):
                yield from windows.items()
                windows = {}
            if not windows:
                low_ns = high_ns = t_ns
            low_ns, high_ns = min(low_ns, t_ns), max(high_ns, t_ns)
            frame = identifier(message), bytes(message.data), t_ns
            windows.setdefault(channel, []).append(frame)
    yield from windows.items()


def frames_of(batch: FrameBatch) -> list[tuple[int, bytes, int]]:
    walked = [
        (number, (bytes((first,)) + others)[:dlc], seconds * 1_000_000_000 + ns)
        for seconds, ns, number, dlc, first, others in batch.frames()
    ]
    columns = zip(batch.id.tolist(), batch.data, batch.dlc.tolist(), batch.t_ns, strict=True)
    assert walked == [(number, bytes(data[:dlc]), int(t_ns)) for number, data, dlc, t_ns in columns]
    return walked


def in_blocks(path: Path) -> Read:
    return [(channel, frames_of(batch)) for channel, batch in read_channels(path)]


HEX = st.sampled_from(["", "40", "40F4F4F3F4F4F3F4", "c0f3f3f4f4f40000", "0102030405"])
LINES = st.builds(
    "({}.{}) {} {}{}".format,
    st.sampled_from(["1700000000", "1700000001", "99", "0"]),
    st.sampled_from(["000000", "000125", "003999", "004000", "999999", "5", "1234567"]),
    st.sampled_from(["can0", "can1", "vcan0", "0", "007", "1"]),
    st.sampled_from(["4E4", "4e5", "FFF", "00000123", "1F334455"]),
    st.one_of(
        HEX.map("#{}".format),
        HEX.map("#{} R".format),
        st.sampled_from(["#R", "#R8", "##1" + "00" * 12, "##000"]),
    ),
)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.one_of(LINES, LINES, LINES, st.sampled_from(["", "  "])), min_size=1, max_size=40),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from([1, 100, 1 << 20]),
    st.booleans(),
)
def test_any_lines_make_the_same_batches(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lines: list[str],
    newline: str,
    block: int,
    is_ended: bool,
) -> None:
    monkeypatch.setattr(logs, "BLOCK_BYTES", block)
    path = tmp_path / "a.log"
    path.write_text(newline.join(lines) + newline * is_ended, newline="")
    expected: Read = []
    try:
        expected = list(line_by_line(path))
    except (ValueError, IndexError):
        if lines[-1].strip() and not is_ended:
            # The last line is unfinished, if the others are whole.
            path.write_text("".join(line + newline for line in lines[:-1]), newline="")
            with contextlib.suppress(ValueError, IndexError):
                expected = list(line_by_line(path))
        path.write_text(newline.join(lines) + newline * is_ended, newline="")
        if expected:
            assert in_blocks(path) == expected
            return
        with pytest.raises(LogError, match=r"damaged after frame|cannot be read"):
            in_blocks(path)
        return
    if not any(line.strip() for line in lines):
        with pytest.raises(LogError, match="no CAN frame"):
            in_blocks(path)
        return
    assert in_blocks(path) == expected


def test_what_is_alike_is_not_read_line_by_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.log"
    lines = [f"({10 + i // 9}.{i:06d}) can{i % 3} {0x400 + i % 16:X}#" for i in range(3000)]
    path.write_text("".join(f"{line}{'F4' * (i % 9)}\n" for i, line in enumerate(lines)))
    expected = list(line_by_line(path))
    monkeypatch.setattr(logs, "_decode_one", None)
    assert in_blocks(path) == expected


#: Characters that change what a line means, or only seem to.
ODD = st.sampled_from(
    [*"0a_+-. #R)(", "\t", "\r", "\x0b", "\x1c", "\x00", "\xa0", "٣", "\ufeff", ""]
)
ODD_LINES = st.builds(
    "({}.{}) {} {}#{}".format,
    st.sampled_from(
        ["0", "1700000000", "4294967296", "8589934591", "8589934592", "9223372036", "9700000000"]
    ),
    st.integers(0, 999_999).map("{:06d}".format),
    st.integers(0, 5).map("can{}".format),
    st.integers(0, 0xFFF).map("{:03X}".format),
    st.binary(max_size=9).map(bytes.hex),
)


@st.composite
def damaged_lines(draw: st.DrawFn) -> str:
    """A line in which up to three characters were replaced."""
    line = draw(ODD_LINES)
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(line) - 1))
        line = line[:at] + draw(ODD) + line[at + 1 :]
    return line


def outcome(path: Path) -> tuple[Read, str]:
    """The batches that a recording gives, and its error."""
    found: Read = []
    try:
        for channel, batch in read_channels(path):
            found.append((channel, frames_of(batch)))
    except LogError as error:
        return found, str(error)
    return found, ""


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.one_of(ODD_LINES, ODD_LINES, ODD_LINES, damaged_lines()), max_size=12),
    st.sampled_from([1, 100, 1 << 20]),
)
def test_lines_read_together_and_one_by_one_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: list[str], block: int
) -> None:
    monkeypatch.setattr(logs, "MOST_CHANNELS", 3)
    monkeypatch.setattr(logs, "BLOCK_BYTES", block)
    path = tmp_path / "a.log"
    path.write_text("\n".join(lines), newline="", encoding="utf-8")
    together = outcome(path)
    with monkeypatch.context() as one_by_one:
        one_by_one.setattr(logs, "_LONGEST_ALIKE", 0)
        assert outcome(path) == together
    assert "Error" not in together[1]


@pytest.mark.parametrize("suffix", [".log", ".asc"])
def test_one_channel_too_many_ends_a_recording_in_any_block(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "BLOCK_BYTES", 1 << 14)
    path = tmp_path / f"a{suffix}"
    last = logs.MOST_CHANNELS + logs._BLOCK
    with can.Logger(path) as logger:
        for n in range(last + logs._BLOCK):
            channel = max(0, n - last + logs.MOST_CHANNELS)
            message = can.Message(1.0 + n * 1e-5, 0x4E0, channel=channel, data=b"")
            logger.on_message_received(message)
    found, error = outcome(path)
    assert f"damaged after frame {last}: more than {logs.MOST_CHANNELS} channels" in error
    assert sum(len(frames) for _, frames in found) <= last


LINE = "(1700000000.000125) can0 4E4#40F4F4\n"


@pytest.mark.parametrize("cut", ["(17", "(1700000000.000225) can0 4E", "\0" * 300])
def test_a_log_that_ends_in_the_middle_of_a_line_ends_there(
    tmp_path: Path, cut: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.log"
    path.write_text(LINE * 3 + cut)
    assert len(in_blocks(path)[0][1]) == 3
    (warning,) = caplog.messages
    assert warning.startswith(f"{path}: ends in the middle of a line")
    path.write_text(LINE * 3 + cut + "\n" + LINE)
    with pytest.raises(LogError, match=r"damaged after frame 3: line 4: seen "):
        in_blocks(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("block", [1, 1 << 20])
def test_of_another_form_the_line_and_what_was_wanted_are_named(
    tmp_path: Path, encoding: str, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "BLOCK_BYTES", block)
    path = tmp_path / "a.log"
    path.write_text("\n  can0  4E4   [3]  40 F4 F4\n" * 2, encoding=encoding)
    line = 2 if encoding == "utf-8" else 1
    with pytest.raises(LogError, match=rf"line {line}: seen .* wanted .*`candump -L`, such as"):
        in_blocks(path)


@pytest.mark.parametrize("block", [1, 1 << 20])
def test_a_mark_of_the_byte_order_is_none_of_the_first_line(
    tmp_path: Path, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "BLOCK_BYTES", block)
    path = tmp_path / "a.log"
    path.write_text(LINE * 3, encoding="utf-8-sig")
    assert len(in_blocks(path)[0][1]) == 3
