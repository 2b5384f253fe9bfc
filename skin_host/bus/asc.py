"""ASC recordings, with python-can, but with the time of day of their frames.

The format has the date of its begin, in local time and to the millisecond, and from there the
seconds of each frame. python-can counts from a time with microseconds, writes the milliseconds
without leading zeros, which it reads as tenths, and does not read the date unless asked.

A date in local time is read wrong elsewhere, and is two times in the hour that is repeated when
summer time ends. So the begin is written as a comment too, in seconds since 1970 (UTC).
"""

import logging
import re
from collections.abc import Generator, Iterator
from datetime import UTC, datetime
from typing import TextIO, cast

import can

log = logging.getLogger(__name__)

#: Milliseconds as python-can writes them; other programs write three digits.
_SHORT_MS = re.compile(r"(?<=:\d\d)\.(\d{1,2})(?!\d)")
#: The begin in UTC; it stands before the line with the date.
_BEGAN = re.compile(r"//\s*began (\d{1,11}\.\d{3}) s after 1970-01-01 UTC\s*\Z")


class _Noted:
    """The lines of a file, each of which the reader sees first."""

    def __init__(self, reader: "DatedAscReader", file: TextIO) -> None:
        self._reader, self._file = reader, file

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = next(self._file)
        if line.startswith("//"):
            self._reader.note_comment(line)
        return line

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class DatedAscReader(can.ASCReader):
    """Yields messages, with times since the epoch; since the begin if its date cannot be read,
    such as one with the names of months in another language.

    The date of a file of another program is taken for one in this computer's zone.

    Raises:
        ValueError: times count from the line before, of which python-can passes over many.
    """

    def __init__(self, file: TextIO) -> None:
        super().__init__(file, relative_timestamp=False)
        self.file = cast(TextIO, _Noted(self, file))
        self._began_s: float | None = None
        #: What is in doubt of the date that was read last.
        self._doubt = ""

    def __iter__(self) -> Generator[can.Message, None, None]:
        for message in super().__iter__():
            if self._doubt:
                log.warning("%s", self._doubt)
                self._doubt = ""
            yield message

    def note_comment(self, line: str) -> None:
        """Take the begin from a comment that has it."""
        found = _BEGAN.match(line)
        if found is not None:
            self._began_s = float(found[1])

    def _extract_header(self) -> None:
        super()._extract_header()
        if self.timestamps_format == "relative":
            raise ValueError("its header has `timestamps relative`; wanted `timestamps absolute`")

    def _datetime_to_timestamp(  # type: ignore[override]  # it is called as a method
        self, datetime_string: str
    ) -> float:
        self._doubt = ""
        if self._began_s is not None:
            began_s, self._began_s = self._began_s, None
            return began_s
        padded = _SHORT_MS.sub(lambda found: f".{found[1]:0>3}", datetime_string)
        try:
            began_s = max(0.0, can.ASCReader._datetime_to_timestamp(padded))
            local = datetime.fromtimestamp(began_s)
            other_s = local.replace(fold=1 - local.fold).timestamp()
            utc = datetime.fromtimestamp(began_s, UTC)
        except (ValueError, OverflowError, OSError):
            return 0.0
        if other_s != began_s:
            self._doubt = (
                f"its date, {datetime_string}, is without its zone, and in the hour that is "
                f"repeated when summer time ends: taken for {utc:%Y-%m-%d %H:%M:%S} UTC, it may be "
                "an hour later"
            )
        return began_s


class DatedAscWriter(can.ASCWriter):
    """Writes messages whose times are exact to the microsecond."""

    def on_message_received(self, msg: can.Message) -> None:
        if not self.header_written:
            self._begin(msg.timestamp)
        super().on_message_received(msg)

    def _begin(self, first_s: float) -> None:
        """Write the date from which times count: of whole milliseconds."""
        self.started = self.last_timestamp = round(first_s * 1e6) // 1000 / 1000
        date = self._format_header_datetime(datetime.fromtimestamp(self.started))
        self.file.write(f"// began {self.started:.3f} s after 1970-01-01 UTC\n")
        self.file.write(f"Begin Triggerblock {date}\n")
        self.header_written = True
        self.log_event("Start of measurement", self.started)

    def _format_header_datetime(self, dt: datetime) -> str:
        return f"{dt:%a %b %d %H:%M:%S}.{dt.microsecond // 1000:03d} {dt:%Y}"
