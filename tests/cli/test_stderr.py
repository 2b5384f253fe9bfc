"""Standard error of commands that run on: what is read, what is lost, and that nobody waits."""

import os
import re
import threading
from collections.abc import Iterator

import pytest

from skin_host.cli import stderr
from skin_host.cli.stderr import StandardError

LOST = re.compile(r"WARNING (\d+) lines? of the log w")


class Pipe:
    """A pipe with our stream at its end."""

    def __init__(self) -> None:
        self.reader, self.writer = os.pipe()
        self.stream = StandardError(self.writer)
        self.stream.write_in_thread()
        self.said = b""

    def read(self) -> list[str]:
        """Read all that was written; then the writer's end is closed."""

        def take() -> None:
            while some := os.read(self.reader, 65536):
                self.said += some

        reading = threading.Thread(target=take)
        reading.start()
        with self.stream._changed:
            self.stream._changed.wait_for(lambda: not self.stream._waiting)
        os.close(self.writer)
        reading.join()
        return self.said.decode().splitlines()


@pytest.fixture
def pipe(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pipe]:
    monkeypatch.setattr(stderr, "LIMIT_BYTES", 100_000)
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    made = Pipe()
    yield made
    os.close(made.reader)


def accounted(lines: list[str]) -> list[int]:
    """Numbers of lines, with those that are reported as lost in their places."""
    found: list[int] = []
    for line in lines:
        if (lost := LOST.match(line)) is not None:
            found += range(len(found), len(found) + int(lost[1]))
        else:
            found.append(int(line))
    return found


def test_every_line_is_read_or_counted_where_it_is_missing(pipe: Pipe) -> None:
    for number in range(100_000):
        pipe.stream.write(b"%d\n" % number)
    waiting = pipe.stream._bytes
    assert waiting <= 100_000
    lost = pipe.stream.lines_lost
    assert lost > 50_000
    lines = pipe.read()
    assert accounted(lines) == list(range(100_000))
    assert sum(int(found[1]) for line in lines if (found := LOST.match(line))) == lost


def test_a_reader_that_stops_again_and_again_gets_all_that_there_was_room_for(pipe: Pipe) -> None:
    for number in range(60_000):
        pipe.stream.write(b"%d\n" % number)
        if not number % 20_000:
            pipe.said += os.read(pipe.reader, 65536)
    assert accounted(pipe.read()) == list(range(60_000))


def test_a_terminal_that_another_program_set_not_to_wait_loses_nothing(pipe: Pipe) -> None:
    os.set_blocking(pipe.writer, False)
    for number in range(20_000):
        pipe.stream.write(b"%d\n" % number)
    lines = pipe.read()
    assert accounted(lines) == list(range(20_000))
    assert len(lines) > 10_000


def test_what_a_full_disk_does_not_take_is_counted() -> None:
    with open("/dev/full", "wb", buffering=0) as full:
        stream = StandardError(full.fileno())
        stream.write_in_thread()
        for _ in range(10):
            stream.write(b"line\n")
        stream.finish()
        assert stream.lines_lost == 10


def test_a_journal_knows_the_priority_of_what_is_lost(
    pipe: Pipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skin_host.daemon.service.to_journal", lambda: True)
    for number in range(60_000):
        pipe.stream.write(b"%d\n" % number)
    assert any(line.startswith("<4>") for line in pipe.read())
