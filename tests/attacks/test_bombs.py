"""Small messages and files that unfold into hours or gigabytes are refused at once."""

import struct
import zlib
from pathlib import Path

import can
import cbor2
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

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
    pack = zlib.compressobj(9)
    return b"".join([*(pack.compress(bytes(10_000_000)) for _ in range(40)), pack.flush()])


def blf_objects(length: int) -> bytes:
    one = struct.pack("<4sHHLL", b"LOBJ", 32, 1, length, 86) + bytes(100)
    return zlib.compress(one * 100)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("content", "claims", "length"),
    [
        (blf_bomb(), 400_000_000, None),
        (blf_bomb(), 100, None),
        (blf_objects(0), 20_000, None),
        (blf_objects(31), 20_000, None),
        (b"", 100, 0),
        (b"", 100, 0xFFFFFFFF),
    ],
    ids=["bomb", "bomb that claims little", "no length", "short", "container 0", "container 4 GB"],
)
def test_a_blf_recording_that_unfolds_or_never_ends_is_refused(
    tmp_path: Path, content: bytes, claims: int, length: int | None
) -> None:
    path = blf(tmp_path, content, claims, length)
    settings = load(Path(__file__).parents[2] / "config" / "demo.toml")
    with pytest.raises(LogError) as refused:
        list(read_buses(path, settings))
    assert len(str(refused.value).splitlines()) == 1
    assert (
        "MiB" in str(refused.value)
        or "object of" in str(refused.value)
        or "short" in str(refused.value)
    )
