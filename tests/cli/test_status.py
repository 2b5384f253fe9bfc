"""`skin status` and `skin listen` where the broker has what a robot published that is gone now."""

import asyncio
import fcntl
import json
import os
import struct
import subprocess
import sys
import termios
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
from msgspec.structs import replace

from skin_host.cli import main, watch
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.mqtt.info import encode_info, node_info
from tests.support.broker import Mosquitto
from tests.support.waiting import until

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
WELL = {"state": "ok", "taxels": 104, "valid_taxels": 104, "rate_hz": 20.0}
INFO = node_info(build_layout(load(CONFIG), CONFIG.parent), "main", version="1", configuration="x")


async def left(broker: Mosquitto) -> None:
    """Leave at a broker what it has stored of a robot over a power cut."""
    async with aiomqtt.Client(broker.host, broker.port) as stranger:

        async def keep(topic: str, payload: bytes) -> None:
            await stranger.publish(f"skin/demo/{topic}", payload, qos=1, retain=True)

        await keep("nodes/main/status", b"online")
        await keep("nodes/main/info", encode_info(INFO))
        for part in INFO.parts:
            await keep(f"{part}/contact", b"OFF")
            await keep(f"{part}/health", json.dumps({"schema": "skin.health/1"} | WELL).encode())


def status(broker: Mosquitto) -> "asyncio.Task[int]":
    words = ["status", "--json", "--broker", f"mqtt://{broker.host}:{broker.port}"]
    return asyncio.create_task(asyncio.to_thread(main, words))


async def test_a_robot_that_is_switched_off_is_not_well(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(watch, "LIVE_S", 0.3)
    await left(mosquitto)
    assert await status(mosquitto) == 1
    records: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert {part: one["state"] for part, one in records.items()} == dict.fromkeys(
        INFO.parts, "not received"
    )
    assert records["left_hand"]["sentences"] == [
        "nothing came of it for 0.3 s: is `skin run` running at node main?"
    ]
    assert (records["left_hand"]["taxels"], records["left_hand"]["valid_taxels"]) == (104, 0)


async def test_a_part_that_has_moved_is_well_where_it_is_now(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the broker keeps of nodes that had it before."""
    monkeypatch.setattr(watch, "LIVE_S", 60.0)
    async with aiomqtt.Client(mosquitto.host, mosquitto.port) as stranger:
        for node, at in (("aa", b"offline"), ("main", b"online"), ("zz", b"offline")):
            info = encode_info(replace(INFO, node=node))
            nodes = f"skin/demo/nodes/{node}"
            await stranger.publish(f"{nodes}/status", at, qos=1, retain=True)
            await stranger.publish(f"{nodes}/info", info, qos=1, retain=True)
        asked = status(mosquitto)
        while not asked.done():
            for part in INFO.parts:
                health = json.dumps({"schema": "skin.health/1"} | WELL).encode()
                await stranger.publish(f"skin/demo/{part}/health", health, qos=1)
            await asyncio.sleep(0.1)
    assert await asked == 0
    records: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert {one["state"] for one in records.values()} == {"ok"}


async def test_who_listens_to_a_robot_that_is_switched_off_learns_it(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    await left(mosquitto)
    monkeypatch.setattr(watch, "SETTLED_S", 0.3)
    words = ["listen", "--count", "1", "--broker", f"mqtt://{mosquitto.host}:{mosquitto.port}"]
    listening = asyncio.create_task(asyncio.to_thread(main, words))
    said = ""

    def told() -> bool:
        nonlocal said
        said += capsys.readouterr().err
        return "waiting" in said

    await until(told)
    assert said == 'warning: nothing comes from robot "demo": is `skin run` running?; waiting\n'
    topic = "skin/demo/left_hand/over"
    event = {"schema": "skin.over/1", "event": "begin", "id": 1, "t_ns": 1, "count": 1}
    event |= {"part": "left_hand", "force_n": 10.0}
    async with aiomqtt.Client(mosquitto.host, mosquitto.port) as stranger:
        await stranger.publish(topic, json.dumps(event).encode(), qos=1)
    assert await listening == 0


#: A sentence that no terminal of 60 columns shows in one line.
LONG = (
    "triangle 3 of board hand_2 is missing: look at its flat cable, then calibrate the part again"
)


async def test_sentences_are_folded_between_words_on_a_terminal_and_not_in_a_pipe(
    mosquitto: Mosquitto,
) -> None:
    """A terminal breaks a longer line within a word, at the left edge; grep reads lines."""
    await left(mosquitto)
    health = {"schema": "skin.health/1"} | WELL | {"state": "degraded", "sentences": [LONG]}
    command = [sys.executable, "-m", "skin_host", "status"]
    command += ["--broker", f"mqtt://{mosquitto.host}:{mosquitto.port}"]
    variables = {name: value for name, value in os.environ.items() if name != "COLUMNS"}

    def shown(columns: int | None) -> list[str]:
        if columns is None:
            done = subprocess.run(command, env=variables, stdout=subprocess.PIPE, check=False)
            return done.stdout.decode().splitlines()
        screen, terminal = os.openpty()
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        subprocess.run(command, env=variables, stdout=terminal, check=False)
        os.close(terminal)
        text = os.read(screen, 100_000).decode()
        os.close(screen)
        return text.splitlines()

    async def publish() -> None:
        async with aiomqtt.Client(mosquitto.host, mosquitto.port) as robot:
            while True:
                for part in INFO.parts:
                    await robot.publish(f"skin/demo/{part}/health", json.dumps(health))
                await asyncio.sleep(0.1)

    publishing = asyncio.create_task(publish())
    narrow, wide, piped = [await asyncio.to_thread(shown, columns) for columns in (60, 200, None)]
    publishing.cancel()
    assert narrow[2:4] == [
        "    triangle 3 of board hand_2 is missing: look at its flat",
        "    cable, then calibrate the part again",
    ]
    assert wide[2] == piped[2] == f"    {LONG}"
