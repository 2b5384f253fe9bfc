"""A disk or a resolver that does not answer holds up nobody else."""

import asyncio
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Bus, Mqtt
from skin_host.mqtt.publisher import Publisher
from skin_host.recording.capture import FrameRecorder
from tests.support.live import living
from tests.support.waiting import until

#: Nothing waits for so long but a test that fails.
FOREVER_S = 120.0


class Gate:
    """Something that does not answer until it is opened, and knows who waited to the end."""

    def __init__(self) -> None:
        self.reached = threading.Event()
        self._open = threading.Event()
        self.outwaited = False

    def __call__(self, *_: Any, **__: Any) -> Any:
        self.reached.set()
        self.outwaited |= not self._open.wait(FOREVER_S)
        raise OSError("the gate was closed")

    def open(self) -> None:
        self._open.set()


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.open()


@pytest.mark.parametrize(
    ("name", "payload"),
    [
        ("thresholds", b'{"set":{"margin_units":5}}'),
        ("disable", b'{"part":"left_hand"}'),
        ("enable", b'{"part":"left_hand"}'),
        ("calibrate", b'{"seconds":0.2}'),
    ],
)
async def test_sweeps_go_on_while_the_disk_does_not_answer(
    can_bus_settings: Bus,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    gate: Gate,
    name: str,
    payload: bytes,
) -> None:
    async with living(can_bus_settings, tmp_path) as live:
        monkeypatch.setattr(os, "fsync", gate)
        asked = asyncio.create_task(live.daemon.control.handle(name, payload))
        await until(gate.reached.is_set)
        before = live.daemon.status()["left_forearm"]["frames"]
        await live.wait(lambda: live.daemon.status()["left_forearm"]["frames"] > before + 5)
        assert not asked.done()
        gate.open()
        answer = await asked
        assert answer["kept"] is False if name != "calibrate" else answer["id"]
    assert not gate.outwaited


async def test_a_recording_that_the_disk_does_not_take_ends_without_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gate: Gate
) -> None:
    recorder = FrameRecorder(tmp_path / "x.log", 60.0, 10_000)
    monkeypatch.setattr(recorder, "_append", gate)
    recorder.put("can0", FrameBatch.of([(0x4E0, bytes(8), 1)]))
    await until(gate.reached.is_set)
    recorder.finish()
    await recorder.finished(0.1)
    assert recorder.ended == "the disk did not take what waited"
    assert not gate.outwaited


def test_a_resolver_that_hangs_does_not_hold_up_the_end(
    monkeypatch: pytest.MonkeyPatch, gate: Gate
) -> None:
    monkeypatch.setattr(socket, "getaddrinfo", gate)

    async def run() -> None:
        async with Publisher(Mqtt(host="broker.invalid"), "robot", drain_s=0.1):
            await until(gate.reached.is_set)

    asyncio.run(run())
    assert not gate.outwaited
