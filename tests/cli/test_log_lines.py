"""What is logged does not steer the terminal or the journal that shows it."""

import logging
import sys

import pytest

from skin_host.daemon.service import JournalFormatter, LogFormatter


def record(message: str, *arguments: object, failed: bool = False) -> logging.LogRecord:
    info = sys.exc_info() if failed else None
    return logging.LogRecord("x", logging.WARNING, "", 0, message, arguments, info)


@pytest.mark.parametrize(("formatter", "start"), [(LogFormatter, ""), (JournalFormatter, "<4>")])
def test_control_characters_are_visible(formatter: type[LogFormatter], start: str) -> None:
    written = formatter("%(message)s").format(record("broker %s", "a\x1b[31m\rb\x9b\u202ec\0"))
    assert written == start + r"broker a\x1b[31m\rb\x9b\u202ec\x00"


def test_a_traceback_keeps_its_lines_and_a_long_line_its_end() -> None:
    try:
        raise ValueError("\x1b[2J" + "é" * 2000)
    except ValueError:
        written = LogFormatter("%(levelname)s %(message)s").format(record("failed", failed=True))
    first, *lines, last = written.split("\n")
    assert first == "WARNING failed"
    assert lines[0] == "Traceback (most recent call last):"
    assert any("raise ValueError" in line for line in lines)
    assert last == r"ValueError: \x1b[2J" + "é" * 2000
