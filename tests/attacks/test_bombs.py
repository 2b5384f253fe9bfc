"""Small messages and files that unfold into hours or gigabytes are refused at once."""

import contextlib
import sqlite3
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import can
import cbor2
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from skin_host.bus.sqlite import BoundedSqliteReader
from skin_host.config.settings import load
from skin_host.errors import LogError
from skin_host.mqtt.frames import decode_frame
from skin_host.mqtt.payload import MessageError
from skin_host.recording.mcap import read_messages_of
from skin_host.recording.replay import read_buses


def shared_key(depth: int) -> bytes:
    """A map whose key is a tuple that refers to one tuple twice, and so on: its hash takes 2^n."""
    inner = cbor2.dumps(cbor2.CBORTag(28, [0, 0]))
    for index in range(depth, 0, -1):
        inner = b"\xd8\x1c\x82" + inner + cbor2.dumps(cbor2.CBORTag(29, index))
    return b"\xa1" + inner + b"\x00"


CBOR_BOMBS = {
    "shared key": shared_key(60),
    "set": b"\xa1\x61a" + b"\xd9\x01\x02\x81" + shared_key(60)[1:-1],
    "nested arrays": b"\xa1\x61a" + b"\x81" * 1_000_000,
    "nested tags": b"\xa1\x61a" + b"\xc6" * 1_000_000,
    "endless bytes": b"\xa1\x61a\x5b\x7f" + b"\xff" * 7,
    "endless map": b"\xbb\x7f" + b"\xff" * 7,
    "large number": b"\xa1\x63seq\xc2\x5a" + struct.pack(">I", 3_000_000) + b"\xff" * 3_000_000,
    "mail": b"\xa1\x61a\xd8\x24\x7a" + struct.pack(">I", 1_000_000) + b"a:b\n" * 250_000,
    "pattern": b"\xa1\x61a\xd8\x23\x7a"
    + struct.pack(">I", 100_000)
    + b"(a|b)?" * 16_000
    + b"a" * 4000,
    "pieces without end": b"\xa1\x61a\x5f" + b"\x41a" * 1_000_000,
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", CBOR_BOMBS)
def test_a_frame_in_cbor_is_refused_before_it_unfolds(name: str) -> None:
    with pytest.raises(MessageError):
        decode_frame("palm", CBOR_BOMBS[name])


def test_keys_that_a_later_daemon_may_add_are_passed_over() -> None:
    values = np.array([1, 2, 3], "<i2").tobytes()
    known = {"schema": "skin.frame/1", "seq": 1, "t_ns": 2, "unit": "kPa", "scale": 0.01}
    more = {"new": {"list": [1, -2.5, None, True, "text", b"bytes", {"deep": []}]}}
    frame = {**known, "values": cbor2.CBORTag(77, values), "valid": "7", **more}
    assert decode_frame("palm", cbor2.dumps(frame)).pressure_kpa.tolist() == [0.01, 0.02, 0.03]


def recording(path: Path, compression: CompressionType) -> None:
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=1 << 40)
        writer.start()
        schema = writer.register_schema("skin.touch", "jsonschema", b"{}")
        channel = writer.register_channel("skin/demo/palm/touch", "json", schema)
        for number in range(20):
            writer.add_message(channel, number, b" " * 8_000_000, number)
        writer.finish()


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_recording_that_unfolds_is_refused_in_a_line(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "bomb.mcap"
    recording(path, compression)
    assert path.stat().st_size < 2_000_000
    with pytest.raises(LogError, match="decompresses to more than") as refused:
        list(read_messages_of(path))
    assert len(str(refused.value).splitlines()) == 1


def blf(tmp_path: Path, content: bytes, claims: int, length: int | None = None) -> Path:
    """A BLF file of one container."""
    path = tmp_path / "x.blf"
    with can.BLFWriter(path):
        pass
    body = struct.pack("<H6xL4x", 2, claims) + content
    length = 16 + len(body) if length is None else length
    container = struct.pack("<4sHHLL", b"LOBJ", 16, 1, length, 10) + body
    path.write_bytes(path.read_bytes()[:144] + container + bytes(len(body) % 4))
    return path


def blf_bomb() -> bytes:
    """What takes seconds to make is made in its test."""
    pack = zlib.compressobj(9)
    return b"".join([*(pack.compress(bytes(10_000_000)) for _ in range(40)), pack.flush()])


def blf_objects(length: int) -> bytes:
    one = struct.pack("<4sHHLL", b"LOBJ", 32, 1, length, 86) + bytes(100)
    return zlib.compress(one * 100)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("content", "claims", "length"),
    [
        (blf_bomb, 400_000_000, None),
        (blf_bomb, 100, None),
        (lambda: blf_objects(0), 20_000, None),
        (lambda: blf_objects(31), 20_000, None),
        (bytes, 100, 0),
        (bytes, 100, 0xFFFFFFFF),
    ],
    ids=["bomb", "bomb that claims little", "no length", "short", "container 0", "container 4 GB"],
)
def test_a_blf_recording_that_unfolds_or_never_ends_is_refused(
    tmp_path: Path, content: Callable[[], bytes], claims: int, length: int | None
) -> None:
    path = blf(tmp_path, content(), claims, length)
    settings = load(Path(__file__).parents[2] / "config" / "demo.toml")
    with pytest.raises(LogError) as refused:
        list(read_buses(path, settings))
    assert len(str(refused.value).splitlines()) == 1
    assert (
        "MiB" in str(refused.value)
        or "object of" in str(refused.value)
        or "short" in str(refused.value)
    )


FRAME = (
    "1700000000.0 AS ts, 1248 AS arbitration_id, 0 AS extended, 0 AS remote, 0 AS error, 8 AS dlc"
)
ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
COLUMNS = "ts REAL, arbitration_id INTEGER, extended, remote, error, dlc INTEGER"
ROW = "INSERT INTO messages VALUES (1700000000.0, 1248, 0, 0, 0, 8, {})"


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("statements", "why"),
    [
        (
            [f"CREATE VIEW messages AS {ENDLESS} SELECT {FRAME}, x'40' AS data FROM c"],
            "`messages` is view; wanted a table",
        ),
        (
            [f"CREATE VIEW Messages AS {ENDLESS} SELECT {FRAME}, x'40' AS data FROM c WHERE 0"],
            "`messages` is view; wanted a table",
        ),
        (
            [
                f"CREATE TABLE messages ({COLUMNS}, data AS (zeroblob(900000000)))",
                ROW.removesuffix(", {})") + ")",
            ],
            "`messages` has the computed column data",
        ),
        ([f"CREATE TABLE messages ({COLUMNS}, data)", ROW.format(2_000_000_000)], "no frame"),
        ([f"CREATE TABLE messages ({COLUMNS}, data)", ROW.format("'x'")], "no frame"),
        ([f"CREATE TABLE messages ({COLUMNS}, data)", ROW.format("zeroblob(9000000)")], "too big"),
        (["CREATE TABLE others (x)"], "`messages` is not there"),
        (["CREATE TABLE messages (x)", "INSERT INTO messages VALUES (1)"], "no frame"),
    ],
)
def test_a_database_that_unfolds_or_never_ends_is_refused(
    tmp_path: Path, statements: list[str], why: str
) -> None:
    path = tmp_path / "x.db"
    with contextlib.closing(sqlite3.connect(path)) as made, made:
        for statement in statements:
            made.execute(statement)
    settings = load(Path(__file__).parents[2] / "config" / "demo.toml")
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match=why) as refused:
            list(read_buses(path, settings))
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert len(str(refused.value).splitlines()) == 1


def test_a_database_of_python_can_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    sent = [
        can.Message(
            timestamp=1700000000.0 + i,
            arbitration_id=0x4E4,
            data=bytes(i % 9),
            is_extended_id=False,
        )
        for i in range(100)
    ]
    with can.SqliteWriter(path) as writer:
        for message in sent:
            writer(message)
    with BoundedSqliteReader(path) as reader:
        read = list(reader)
    assert [bytes(one.data) for one in read] == [bytes(one.data) for one in sent]
    with BoundedSqliteReader(path) as reader:
        reader._most_rows = 99  # as where pages are named twice
        with pytest.raises(ValueError, match="more rows than the file has bytes"):
            list(reader)
