"""python-can's reader of recordings in a database (.db), for files from anybody."""

import sqlite3
from collections.abc import Generator
from pathlib import Path

import can

#: No row is longer.
MOST_ROW_BYTES = 1 << 16
#: As python-can's writer names it.
TABLE = "messages"


class BoundedSqliteReader(can.SqliteReader):
    """The same frames, of a plain table only.

    A view or a computed column makes rows without end, or gigabytes, of a file of some kilobytes;
    so do pages that are named twice. Of a number as data python-can makes so many bytes.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        files = path, path.with_name(f"{path.name}-wal")
        self._most_rows = sum(file.stat().st_size for file in files if file.exists())
        self._conn.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_ROW_BYTES)
        self._conn.execute("PRAGMA trusted_schema = OFF")

    def __iter__(self) -> Generator[can.Message, None, None]:
        """Yield the frames.

        Raises:
            ValueError: they are not in a table, or one has other data than bytes.
            sqlite3.Error: it is no database, or damaged.
        """
        self._refuse_computed()
        rows = self._conn.execute(f"SELECT * FROM {TABLE}")  # noqa: S608  # our own name
        for number, row in enumerate(rows, 1):
            if number > self._most_rows:
                raise ValueError(f"more rows than the file has bytes, {self._most_rows}")
            if len(row) != 7 or not isinstance(row[-1], bytes):
                raise ValueError(f"row {number}: no frame; wanted seven columns, the last of bytes")
            yield self._assemble_message(row)

    def _refuse_computed(self) -> None:
        there = "SELECT type, rootpage FROM sqlite_master WHERE lower(name) = ?"
        kind, page = self._conn.execute(there, (TABLE,)).fetchone() or ("not there", 0)
        columns = self._conn.execute(f"PRAGMA table_xinfo({TABLE})").fetchall()
        hidden = [column[1] for column in columns if column[-1]]
        if kind != "table" or not page or hidden:
            computed = f"has the computed column {hidden[0]}" if hidden else "is computed"
            seen = computed if kind == "table" else f"is {kind}"
            raise ValueError(f"`{TABLE}` {seen}; wanted a table of frames")
