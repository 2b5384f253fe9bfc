"""Recordings in ASC, whose date is in local time, from the hours in which the clock is changed."""

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from skin_host.bus.logs import read_channels
from skin_host.bus.wire import FrameBatch
from skin_host.recording.capture import CanLog

#: 2026-10-25 02:30 in Rome, in summer time and an hour later, and an hour before and after these.
REPEATED_S = 1_792_888_200
TIMES_S = [REPEATED_S + hours * 3600 for hours in (-1, 0, 1, 2)]


@pytest.fixture
def zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Rome's time in this program."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Europe/Rome")
        time.tzset()
        yield
    time.tzset()


def recorded(folder: Path, t_s: int) -> Path:
    path = folder / f"{t_s}.asc"
    with CanLog(path, ["can0"]) as log:
        log.put("can0", FrameBatch.of([(0x110, bytes(8), t_s * 10**9 + 1_234_000)]))
    return path


def times_ns(path: Path) -> list[int]:
    return [t_ns for _, batch in read_channels(path) for t_ns in batch.t_ns.tolist()]


@pytest.mark.usefixtures("zone")
@pytest.mark.parametrize("t_s", TIMES_S)
def test_the_time_of_a_recording_is_exact_in_the_hours_around_a_change(
    t_s: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = recorded(tmp_path, t_s)
    # As if it had been begun then.
    lines = path.read_text().splitlines(keepends=True)
    lines[0] = f"date {time.strftime('%a %b %d %I:%M:%S.000 %p %Y', time.localtime(t_s))}\n"
    path.write_text("".join(lines))
    assert times_ns(path) == [t_s * 10**9 + 1_234_000]
    assert not caplog.records


def test_it_is_the_same_in_another_zone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recorded(tmp_path, TIMES_S[0])
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Asia/Tokyo")
        time.tzset()
        found = times_ns(path)
    time.tzset()
    assert found == [TIMES_S[0] * 10**9 + 1_234_000]


@pytest.mark.usefixtures("zone")
@pytest.mark.parametrize("t_s", TIMES_S)
def test_a_date_without_a_zone_that_is_two_times_is_read_with_a_warning(
    t_s: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As other programs write it."""
    path = recorded(tmp_path, t_s)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if not line.startswith("//")))
    with caplog.at_level(logging.WARNING):
        (found_ns,) = times_ns(path)
    is_repeated = t_s in (REPEATED_S, REPEATED_S + 3600)
    warned = [one.getMessage() for one in caplog.records if "repeated" in one.getMessage()]
    assert len(warned) == is_repeated
    # The earlier of the two.
    wanted_s = REPEATED_S if is_repeated else t_s
    assert found_ns == wanted_s * 10**9 + 1_234_000
