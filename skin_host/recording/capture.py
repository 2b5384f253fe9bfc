"""Records outside the daemon: messages of a broker, and frames of the buses.

Both may go into one MCAP file; CAN frames alone also into the formats of python-can
(candump .log, Vector .asc and .blf, .trc, .csv), chosen by the file's suffix.
"""

import asyncio
import logging
import os
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import can

from skin_host.bus.opening import open_port
from skin_host.bus.port import EXTENDED_FLAG, REMOTE_FLAG, Port
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Settings
from skin_host.errors import RequestError, SkinError
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import Retry, connect, explain, first_error
from skin_host.mqtt.payload import MAX_PACKET_BYTES
from skin_host.recording.mcap import SUFFIX, Recorder, recorded_topics

#: Takes a batch of a channel.
CanSink = Callable[[str, FrameBatch], None]
CAN_SUFFIXES = (".log", ".asc", ".blf", ".trc", ".csv")
POLL_S = 0.02
MAX_INCOMING = 100_000
_ID = 0x1FFFFFFF

_log = logging.getLogger(__name__)


class CanLog:
    """CAN frames in a format of python-can; the file gets its name when it is closed.

    Attributes:
        frames: recorded so far.

    Raises:
        RequestError: the suffix is not one of `CAN_SUFFIXES`.
        SkinError: the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        if path.suffix not in CAN_SUFFIXES:
            known = ", ".join([*CAN_SUFFIXES, SUFFIX])
            raise RequestError(f'{path}: suffix "{path.suffix}"; wanted one of {known}')
        self.frames = 0
        self._path = path
        self._growing = path.with_name(f".{path.stem}.growing{path.suffix}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._logger = can.Logger(self._growing)
        except OSError as error:
            raise SkinError(f"{path}: cannot be recorded to: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not self.frames:
            self._logger.stop()
            self._growing.unlink()
        else:
            self.close()

    def put(self, channel: str, batch: FrameBatch) -> None:
        """Record frames of a channel.

        Raises:
            SkinError: the disk is full or gone.
        """
        try:
            for row in range(len(batch)):
                flags = int(batch.id[row])
                dlc = int(batch.dlc[row])
                self._logger.on_message_received(
                    can.Message(
                        timestamp=int(batch.t_ns[row]) * 1e-9,
                        arbitration_id=flags & _ID,
                        is_extended_id=bool(flags & EXTENDED_FLAG),
                        is_remote_frame=bool(flags & REMOTE_FLAG),
                        dlc=dlc,
                        data=batch.data[row, :dlc].tobytes(),
                        channel=channel,
                    )
                )
                self.frames += 1
        except OSError as error:
            raise SkinError(f"{self._path}: cannot be recorded to: {error.strerror}") from None

    def close(self) -> None:
        """End the recording and give it its name."""
        self._logger.stop()
        os.replace(self._growing, self._path)


async def capture_buses(settings: Settings, sink: CanSink, stop: asyncio.Event) -> int:
    """Pass frames of the configured buses to `sink` until `stop` is set; return how many were lost.

    Other programs, such as the daemon, may read a bus at the same time (SocketCAN).

    Raises:
        BusError: a bus cannot be opened.
        SkinError: the sink failed.
    """
    ports: list[Port] = []
    try:
        for name, bus in settings.buses.items():
            ports.append(open_port(name, bus, settings.receive))
        while not stop.is_set():
            for port in ports:
                while len(batch := port.read()):
                    sink(port.channel, batch)
            await asyncio.sleep(POLL_S)
        return sum(port.counters.dropped for port in ports)
    finally:
        for port in ports:
            port.close()


async def capture_broker(
    recorder: Recorder, broker: Broker, base: str, robot: str, stop: asyncio.Event
) -> int:
    """Record a robot's messages until `stop` is set; return how often the broker was lost.

    Raises:
        SkinError: the recording cannot be written.
    """
    stopping = asyncio.create_task(stop.wait())
    listening = asyncio.create_task(_listen(recorder, broker, recorded_topics(base, robot)))
    try:
        await asyncio.wait([stopping, listening], return_when=asyncio.FIRST_COMPLETED)
        if listening.done():
            listening.result()
    finally:
        for task in (stopping, listening):
            task.cancel()
        await asyncio.gather(stopping, listening, return_exceptions=True)
    return recorder.gaps


async def _listen(recorder: Recorder, broker: Broker, topics: list[str]) -> None:
    retry = Retry()
    identifier = f"skin-record-{secrets.token_hex(4)}"
    while True:
        try:
            async with connect(
                broker,
                identifier=identifier,
                max_incoming=MAX_INCOMING,
                max_packet=MAX_PACKET_BYTES,
            ) as connection:
                for topic in topics:
                    await connection.subscribe(topic, qos=0 if topic.endswith("/frame") else 1)
                async for message in connection.messages:
                    if isinstance(message.payload, bytes):
                        recorder.say(message.topic.value, time.time_ns(), message.payload)
        except* SkinError as group:
            raise first_error(group) from None
        except* Exception as group:
            recorder.gaps += 1
            _log.warning("broker %s: %s; trying again", broker, explain(first_error(group)))
        await asyncio.sleep(retry.delay_s())
