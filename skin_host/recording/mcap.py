"""Recordings in MCAP: MQTT messages and CAN frames, with their schemas.

Foxglove and every MCAP reader open them. Messages keep their topic and, in JSON, their bytes;
frames in CBOR are stored as equivalent JSON. CAN frames are in channels `can/<channel>`, with some
milliseconds per message. A recording is written under a temporary name and renamed when it is
closed; an interrupted one can be repaired with `mcap recover`. What the broker had stored when it
was asked, which may be from any time, is in channels of their own, with `stored` in their metadata.
"""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, NamedTuple, Self, get_args

import msgspec
import numpy as np
from msgspec import Meta, Struct

from skin_host.bus.logs import open_recording
from skin_host.bus.wire import FrameBatch
from skin_host.errors import LogError, SkinError, required
from skin_host.files import Draft, refuse_removed, writing
from skin_host.fingertip.events import Over, Slip
from skin_host.health.record import Record
from skin_host.mqtt.frames import FRAME_SCHEMA, JsonFrame, decode_frame, encode_frame
from skin_host.mqtt.info import INFO_SCHEMA, NodeInfo, decode_info
from skin_host.mqtt.messages import (
    EVENT_DECODERS,
    HEALTH_SCHEMA,
    Frame,
    decode_contact,
    decode_health,
)
from skin_host.mqtt.topics import PartTopic, Topics, wrong_topic
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.untrusted import from_json

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, Message, Schema

CAN = "can/"
MARKS = "marks"
#: In the metadata of a channel: what is in it the broker had before it was asked.
STORED = "stored"
#: Nobody has as many parts; the format numbers topics in 16 bits.
MAX_TOPICS = 10_000
#: Nothing that is worth recording is longer.
MAX_PAYLOAD = 32 * 1024 * 1024
MAX_BATCH = 100_000
LONGEST_TOPIC = 1024
#: A chunk of a recording is no larger when decompressed; writers make chunks of some MB.
MAX_CHUNK_BYTES = 64_000_000
#: Nor is anything in the file that this program reads, nor what others may have attached to it.
MAX_RECORD_BYTES = 1 << 30

_log = logging.getLogger(__name__)


class RecordedMessage(NamedTuple):
    """One message of a recording: topic, time of reception, its bytes, and whether the broker had
    stored it, as far as the recording shows that.
    """

    topic: str
    t_ns: int
    payload: bytes
    stored: bool = False


class _Text(Struct):
    """State of a part's contact (ON, OFF, UNKNOWN), or of a node (online, offline)."""

    text: str


class _Mark(Struct, tag_field="schema", tag="skin.mark/1"):
    """A moment that somebody marked."""

    t_ns: int
    text: str


class _Health(Record):
    """Health of a part."""

    schema: str


_Time = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Identifier = Annotated[int, Meta(ge=0, le=2**32 - 1)]
_Count = Annotated[int, Meta(ge=0, le=2**53)]


class _CanFrames(Struct):
    """CAN frames of one channel: times, identifiers (flags as SocketCAN's), data in hex."""

    t_ns: list[_Time]
    id: list[_Identifier]
    data: list[str]
    dropped: _Count = 0


class Recorder:
    """A recording in progress.

    Attributes:
        messages: recorded so far, by kind.
        unreadable: messages whose payload did not fit their topic, or of too many topics; they are
            left out.
        gaps: times that the broker was lost.
        discarded: messages that came faster than they were recorded, or could not be read.

    Raises:
        SkinError: mcap is not installed, or the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        mcap_writer = _mcap("mcap.writer")
        self.messages: dict[str, int] = {}
        self.unreadable = 0
        self.gaps = 0
        self.discarded = 0
        self._path = path
        with writing(path):
            self._draft = Draft(path, new=True)
            self._draft.begin()
            self._file: IO[bytes] = self._draft.path.open("wb")
        self._writer = mcap_writer.Writer(self._file)
        self._writer.start(profile="", library="skin-host")
        self._schemas: dict[str, int] = {}
        #: By topic, and whether for what the broker had stored.
        self._channels: dict[tuple[str, bool], int] = {}
        self._numbers: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not self.messages:
            with contextlib.suppress(OSError):
                self._file.close()
            self._draft.remove()
        else:
            self.close()

    def say(self, topic: str, t_ns: int, payload: bytes, *, stored: bool = False) -> None:
        """Record a message received at `t_ns`; an unreadable one is counted.

        Args:
            topic: of the message.
            t_ns: when it was received.
            payload: of the message. Of a health or an info that was deleted there is none, and
                nothing to record.
            stored: the broker had it before it was asked.

        Raises:
            SkinError: the disk is full or gone.
        """
        kind = _kind(topic)
        if kind is None or (kind in ("health", "info") and not payload):
            return
        is_more = (topic, stored) not in self._channels and len(self._channels) >= MAX_TOPICS
        if is_more or len(payload) > MAX_PAYLOAD:
            self.unreadable += 1
            return
        try:
            data, sent_ns = _checked(topic, kind, payload, t_ns)
        except (SkinError, msgspec.DecodeError, UnicodeDecodeError):
            self.unreadable += 1
            return
        self._add(topic, kind, t_ns, sent_ns, data, stored=stored)

    def can(self, channel: str, batch: FrameBatch) -> None:
        """Record CAN frames of a channel.

        Raises:
            SkinError: the disk is full or gone.
        """
        if not len(batch):
            return
        frames = _CanFrames(
            batch.t_ns.tolist(),
            batch.id.tolist(),
            [
                row[:dlc].tobytes().hex()
                for row, dlc in zip(batch.data, batch.dlc.tolist(), strict=True)
            ],
            batch.dropped,
        )
        last_ns = int(batch.t_ns[-1])
        self._add(CAN + channel, "can", last_ns, last_ns, msgspec.json.encode(frames))

    @property
    def size_bytes(self) -> int:
        """How large the file is, without what waits to be compressed."""
        return self._file.tell()

    def mark(self, t_ns: int, text: str) -> None:
        """Record that somebody marked this moment.

        Raises:
            SkinError: the disk is full or gone.
        """
        self._add(MARKS, "mark", t_ns, t_ns, msgspec.json.encode(_Mark(t_ns, text)))

    def close(self) -> None:
        """End the recording and give it its name.

        Raises:
            SkinError: the disk is full or gone; what there is of it keeps its interim name.
        """
        if self._file.closed:
            return
        with writing(self._path), self._draft.keeping():
            with self._file:
                counts = {f"messages_{kind}": str(n) for kind, n in sorted(self.messages.items())}
                losses = ("unreadable", "gaps", "discarded")
                told = counts | {name: str(getattr(self, name)) for name in losses}
                self._writer.add_metadata("skin", told)
                self._writer.finish()
            self._draft.finish()

    def _add(
        self, topic: str, kind: str, t_ns: int, sent_ns: int, data: bytes, *, stored: bool = False
    ) -> None:
        which = topic, stored
        with writing(self._path):
            refuse_removed(self._draft.path)
            if which not in self._channels:
                if kind not in self._schemas:
                    name, content = _TYPES[kind]
                    encoded = msgspec.json.encode(_schema(name, content))
                    self._schemas[kind] = self._writer.register_schema(name, "jsonschema", encoded)
                self._channels[which] = self._writer.register_channel(
                    topic=topic,
                    message_encoding="json",
                    schema_id=self._schemas[kind],
                    metadata={STORED: "true"} if stored else {},
                )
            number = self._numbers[topic] = self._numbers.get(topic, 0) + 1
            self._writer.add_message(
                channel_id=self._channels[which],
                log_time=max(0, t_ns),
                publish_time=max(0, sent_ns),
                sequence=number % 2**32,
                data=data,
            )
        self.messages[kind] = self.messages.get(kind, 0) + 1


def read_messages_of(path: Path) -> Iterator[RecordedMessage]:
    """Yield the messages of a recording in the order of reception, see `read_records`.

    Raises:
        LogError: it cannot be read, or breaks off.
    """
    for channel, t_ns, data in _messages(path):
        topic, stored = channel.topic, channel.metadata.get(STORED) == "true"
        kind = _kind(topic)
        if kind in ("contact", "status"):
            payload = _decode(path, topic, data, _Text).text.encode()
            yield RecordedMessage(topic, t_ns, payload, stored)
        elif kind is not None:
            yield RecordedMessage(topic, t_ns, data, stored)


def read_can(path: Path) -> Iterator[tuple[str, FrameBatch]]:
    """The CAN frames of a recording: the name of their channel, and a batch as a bus gives.

    Raises:
        LogError: it cannot be read, breaks off, or holds no CAN frames.
    """
    found = False
    for channel, _, data in _messages(path):
        topic = channel.topic
        if not topic.startswith(CAN):
            continue
        found = True
        frames = _decode(path, topic, data, _CanFrames)
        n = len(frames.id)
        if n > MAX_BATCH or not n == len(frames.t_ns) == len(frames.data):
            raise LogError(f"{path}: {topic}: {n} identifiers, but another number of frames")
        try:
            rows = [
                (can_id, bytes.fromhex(text), t_ns)
                for can_id, text, t_ns in zip(frames.id, frames.data, frames.t_ns, strict=True)
            ]
        except ValueError as error:
            raise LogError(f"{path}: {topic}: {error}") from None
        longest = max((len(data) for _, data, _ in rows), default=0)
        if longest > 8:
            raise LogError(f"{path}: {topic}: a frame of {longest} bytes; wanted at most 8")
        batch = FrameBatch.of(rows)
        batch.dropped = frames.dropped
        yield topic.removeprefix(CAN), batch
    if not found:
        raise LogError(
            f"{path}: holds no CAN frames: it was recorded from a broker alone; play it to a "
            "broker, or record the buses too"
        )


def read_records(path: Path) -> "Iterator[tuple[Schema | None, Channel, Message]]":
    """Yield the messages of any MCAP file with their channels and schemas, in the order of the
    file, which is that of reception.

    Sorted by their times, what was recorded after a clock was set back would be mixed into what was
    recorded before. The file's index is not used: it may be wrong, or not be there.

    Raises:
        LogError: it cannot be read, or breaks off.
    """
    records, stream = _mcap("mcap.records"), _mcap("mcap.stream_reader")
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with open_recording(path) as file:
        try:
            reader = stream.StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES)
            for outer in reader.records:
                is_chunk = isinstance(outer, records.Chunk)
                if is_chunk:
                    _check_chunk(path, outer)
                for record in stream.breakup_chunk(outer) if is_chunk else (outer,):
                    if isinstance(record, records.Message):
                        if record.log_time >= 2**63:
                            raise ValueError(f"a time of {record.log_time / 1e9:g} s")
                        channel = channels.get(record.channel_id)
                        if channel is None:
                            raise ValueError(f"a message of no channel ({record.channel_id})")
                        yield schemas.get(channel.schema_id), channel, record
                    elif isinstance(record, records.Channel):
                        channels[record.id] = record
                    elif isinstance(record, records.Schema):
                        schemas[record.id] = record
            if file.read(1):
                raise LogError(
                    f"{path}: goes on after its end, as two recordings one after the other; wanted "
                    "one, or both joined by `mcap merge`"
                )
        except LogError:
            raise
        except Exception as error:  # whatever a damaged file makes of its readers
            what = (str(error) or type(error).__name__).splitlines()[0]
            raise LogError(
                f"{path}: no whole MCAP file: {what}; `mcap recover` may repair it"
            ) from None


def _messages(path: Path) -> "Iterator[tuple[Channel, int, bytes]]":
    """(channel, time, data) of every message in JSON, which are all of ours."""
    for _, channel, message in read_records(path):
        if channel.message_encoding == "json":
            yield channel, message.log_time, message.data


def _check_chunk(path: Path, record: "Chunk") -> None:
    """Refuse a chunk that decompresses to an unreasonable size: it is decompressed as a whole.

    Raises:
        LogError: it does.
    """
    size = record.uncompressed_size
    if record.compression == "zstd":
        zstandard = _mcap("zstandard")
        declared = zstandard.get_frame_parameters(record.data).content_size
        size = max(size, 0 if declared == zstandard.CONTENTSIZE_UNKNOWN else declared)
    elif record.compression == "lz4":
        decompressor = _mcap("lz4.frame").LZ4FrameDecompressor()
        size = max(size, len(decompressor.decompress(record.data, MAX_CHUNK_BYTES + 1)))
    if size > MAX_CHUNK_BYTES:
        raise LogError(
            f"{path}: a chunk of {len(record.data)} bytes decompresses to more than "
            f"{MAX_CHUNK_BYTES} bytes"
        )


def _kind(topic: str) -> str | None:
    """Return frame, touch, ... by the end of a topic; None for topics that are not recorded.

    A recording may be anybody's: what cannot be published, or is a command to a node, is none.
    """
    words = topic.split("/")
    if wrong_topic(topic) is not None or not all(words) or len(topic) > LONGEST_TOPIC:
        return None
    match words:
        case [_, _, *_, _, ("frame" | "touch" | "slip" | "over" | "contact" | "health") as kind]:
            return None if "cmd" in words[-2:-1] else kind
        case [_, _, *_, "nodes", _, ("status" | "info") as kind]:
            return kind
        case [_, _, *_, "nodes", _, piece, "info"] if piece.isdecimal():
            return "info"
    return None


def robot_at(words: list[str]) -> int:
    """Return where the name of the robot stands among the words of a topic, from the end."""
    # Before the end stand <robot>/<part>/<kind>, or <robot>/nodes/<node>/<kind>, or, of an info in
    # pieces, <robot>/nodes/<node>/<piece>/info.
    return -4 if words[-3] == "nodes" else -5 if words[-4:-3] == ["nodes"] else -3


def _checked(topic: str, kind: str, payload: bytes, t_ns: int) -> tuple[bytes, int]:
    """The data to record, and when it was sent."""
    if kind == "frame":
        part = topic.split("/")[-2]
        frame = decode_frame(part, payload)
        if payload[:1] >= b"\xa0":
            payload = _as_json(frame)
        return payload, frame.t_ns
    if kind in EVENT_DECODERS:
        return payload, EVENT_DECODERS[kind](payload).t_ns
    if kind in ("contact", "status"):
        if kind == "contact" and payload:
            decode_contact(payload)
        return msgspec.json.encode(_Text(payload.decode())), t_ns
    (decode_health if kind == "health" else decode_info)(payload)
    return payload, t_ns


def _as_json(frame: Frame) -> bytes:
    none = np.zeros(len(frame.valid), np.bool_)
    raw = frame.raw if frame.raw is not None else np.zeros(len(frame.valid), np.uint8)
    whole = PressureFrame(
        frame.part,
        frame.seq,
        frame.t_ns,
        raw,
        frame.pressure_kpa.astype(np.float32),
        none,
        frame.valid,
        frame.beyond_range,
    )
    return encode_frame(whole, raw=frame.raw is not None)


def _decode(path: Path, topic: str, data: bytes, kind: type[Any]) -> Any:
    try:
        return from_json(data, kind)
    except msgspec.DecodeError as error:
        raise LogError(f"{path}: {topic}: {error}") from None


def recorded_topics(base: str, robot: str) -> list[str]:
    """Return the topics to subscribe to for a whole recording of a robot."""
    topics = Topics(base, robot)
    return [
        *(topics.part(kind, "+") for kind in get_args(PartTopic)),
        topics.node("status", "+"),
        topics.info("+"),
        topics.info("+", "+"),
    ]


def _mcap(name: str) -> Any:
    return required(name, "MCAP recordings", "record")


#: By kind of message: the schema's name, and the type of the content.
_TYPES: dict[str, tuple[str, type]] = {
    "frame": (FRAME_SCHEMA, JsonFrame),
    "touch": ("skin.touch/1", Touch),
    "slip": ("skin.slip/1", Slip),
    "over": ("skin.over/1", Over),
    "mark": ("skin.mark/1", _Mark),
    "health": (HEALTH_SCHEMA, _Health),
    "info": (INFO_SCHEMA, NodeInfo),
    "contact": ("skin.contact", _Text),
    "status": ("skin.status", _Text),
    "can": ("skin.can/1", _CanFrames),
}
_ABOUT = {
    "t_ns": "ns since 1970",
    "scale": "one unit of the values, in `unit`",
    "valid": "hexadecimal mask, bit i is taxel i",
    "reason": "of an end: released, lost or stopped",
}


def _schema(name: str, kind: type) -> dict[str, Any]:
    """Return a type's JSON schema in the plain form that Foxglove's plots understand."""
    _, found = msgspec.json.schema_components([kind])
    keys = found[kind.__name__]["properties"]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": name,
        "description": (kind.__doc__ or "").partition("\n")[0],
        "type": "object",
        "properties": {
            key: _plain(schema) | ({"description": _ABOUT[key]} if key in _ABOUT else {})
            for key, schema in keys.items()
            if key != "missed"  # only of received events
        },
    }


def _plain(schema: dict[str, Any]) -> dict[str, Any]:
    """Reduce the schema of a key to its type, without references, alternatives and limits."""
    schema = next((one for one in schema.get("anyOf", ()) if one != {"type": "null"}), schema)
    kind = schema.get("type", "object" if "$ref" in schema else "string")
    if kind == "array":
        return {"type": kind, "items": _plain(schema.get("items") or schema["prefixItems"][0])}
    return {"type": kind} | {key: schema[key] for key in schema if key == "contentEncoding"}
