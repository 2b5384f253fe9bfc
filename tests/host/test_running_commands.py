"""Commands that talk to a daemon that runs: `skin command`, `skin status`."""

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from skin_host.cli import main
from skin_host.settings import Bus
from tests.support.broker import Mosquitto
from tests.support.live import living


@pytest_asyncio.fixture
async def url(mosquitto: Mosquitto, tmp_path: Path) -> AsyncIterator[str]:
    """The broker of a robot that lives and is calibrated."""
    bus = Bus(interface="virtual", channel=tmp_path.name)
    async with living(bus, tmp_path, port=mosquitto.port):
        yield f"mqtt://{mosquitto.host}:{mosquitto.port}"


async def skin(*words: str) -> int:
    return await asyncio.to_thread(main, list(words))


async def test_a_running_daemon_answers_and_refuses_in_one_line(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["status"], ["command", "status"]):
        assert await skin(*words, "--broker", url) in (0, 1)  # not every part is well at once
        head, *lines = capsys.readouterr().out.splitlines()
        assert head.split() == ["part", "state", "Hz", "valid", "age"]
        parts = {line.split()[0] for line in lines if not line.startswith(" ")}
        assert parts == {"left_hand", "left_forearm"}
    assert await skin("command", "thresholds", "--set", "margin_units=3", "--broker", url) == 0
    assert '"margin_units": 3' in capsys.readouterr().out
    assert await skin("command", "thresholds", "--reset", "--json", "--broker", url) == 0
    assert json.loads(capsys.readouterr().out)
    assert await skin("command", "disable", "--part", "tail", "--broker", url) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "tail" in said.err
