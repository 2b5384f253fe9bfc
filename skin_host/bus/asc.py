"""ASC recordings, with python-can, but with the time of day of their frames.

The format has the date of its begin, in local time and to the millisecond, and from there the
seconds of each frame. python-can counts from a time with microseconds, writes the milliseconds
without leading zeros, which it reads as tenths, and does not read the date unless asked.
"""

import re
from datetime import datetime
from typing import TextIO

import can

#: Milliseconds as python-can writes them; other programs write three digits.
_SHORT_MS = re.compile(r"(?<=:\d\d)\.(\d{1,2})(?!\d)")


class DatedAscReader(can.ASCReader):
    """Yields messages, with times since the epoch; since the begin if its date cannot be read,
    such as one with the names of months in another language.

    Raises:
        ValueError: times count from the line before, of which python-can passes over many.
    """

    def __init__(self, file: TextIO) -> None:
        super().__init__(file, relative_timestamp=False)

    def _extract_header(self) -> None:
        super()._extract_header()
        if self.timestamps_format == "relative":
            raise ValueError("its header has `timestamps relative`; wanted `timestamps absolute`")

    @staticmethod
    def _datetime_to_timestamp(datetime_string: str) -> float:
        padded = _SHORT_MS.sub(lambda found: f".{found[1]:0>3}", datetime_string)
        try:
            return max(0.0, can.ASCReader._datetime_to_timestamp(padded))
        except (ValueError, OverflowError, OSError):
            return 0.0


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
        self.file.write(f"Begin Triggerblock {date}\n")
        self.header_written = True
        self.log_event("Start of measurement", self.started)

    def _format_header_datetime(self, dt: datetime) -> str:
        return f"{dt:%a %b %d %H:%M:%S}.{dt.microsecond // 1000:03d} {dt:%Y}"
