"""PEAK's recordings (.trc), with python-can, which passes over lines that are damaged."""

import can

from skin_host.errors import visible

#: So many characters of a damaged line are shown.
_SHOWN = 60


class StrictTrcReader(can.TRCReader):
    """Yields messages.

    Raises:
        ValueError: a line has fewer columns than a message.
    """

    def _parse_line(self, line: str) -> can.Message | None:
        if not line or line.startswith(";"):  # of a recording without a message
            return None
        try:
            return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))
        except IndexError:
            raise ValueError(f'seen "{visible(line, _SHOWN)}", wanted a message') from None
