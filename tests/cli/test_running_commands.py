"""Commands that talk to a daemon that runs: `skin command`, `skin status`."""

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from skin_host.cli import main
from skin_host.config.settings import Bus
from tests.support.broker import Mosquitto
from tests.support.live import CONFIG, living


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
    words = ["command", "thresholds", "--set", "margin_unit=3"]
    assert await skin(*words, "--broker", url) == 1
    assert "set: unknown key `margin_unit`; meant `margin_units`?" in capsys.readouterr().err
    assert await skin("command", "thresholds", "--reset", "--json", "--broker", url) == 0
    assert json.loads(capsys.readouterr().out)
    assert await skin("command", "disable", "--part", "tail", "--broker", url) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "tail" in said.err


async def test_every_command_can_be_given_to_a_running_daemon(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async def command(*words: str) -> Any:
        assert await skin("command", *words, "--json", "--broker", url) == 0
        return json.loads(capsys.readouterr().out)

    before = (await command("status"))["left_hand"]["calibration"]
    recorded = await command("record", "--file", "run.log", "--seconds", "60")
    assert recorded["file"] == str(tmp_path / "recordings/run.log")
    found = await command("calibrate", "--board", "hand", "--seconds", "0.5")
    assert found["verdicts"]["left_hand"]["ok"] > 50
    assert found["unchanged"] == found["damaged"] == {}
    assert found["id"] != before["id"]
    assert (await command("configure", "--board", "hand"))["boards"] == ["hand"]
    assert (await command("disable", "--part", "left_hand"))["disabled"] == ["left_hand"]
    assert (await command("status"))["left_hand"]["state"] == "disabled"
    assert (await command("enable", "--part", "left_hand"))["disabled"] == []
    assert (await command("raw", "--seconds", "1"))["seconds"] == 1.0
    ended = await command("stop_recording")
    assert ended["lost"] == 0
    assert ended["frames"] > 100
    assert await skin("command", "calibrate", "--board", "foot", "--broker", url) == 1
    assert "foot" in capsys.readouterr().err


async def test_a_daemon_that_has_gone_leaves_no_part_that_looks_well(
    mosquitto: Mosquitto, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with living(
        Bus(interface="virtual", channel=tmp_path.name), tmp_path, port=mosquitto.port
    ):
        assert await skin("status", "--json", "--broker", url) in (0, 1)
        before = json.loads(capsys.readouterr().out)
    assert await skin("status", "--json", "--broker", url) == 1
    after = json.loads(capsys.readouterr().out)
    for part in ("left_hand", "left_forearm"):
        assert before[part]["state"] != "offline"
        assert after[part]["state"] == "offline"
        assert after[part]["taxels"] == before[part]["taxels"]
        assert after[part]["valid_taxels"] == 0
        assert "rate_hz" not in after[part]
    assert await skin("status", "--broker", url) == 1
    assert "node main is offline" in capsys.readouterr().out


async def test_a_skin_that_a_daemon_serves_is_calibrated_by_that_daemon_only(
    mosquitto: Mosquitto, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another calibration would zero the boards under it, and be kept where it does not look."""
    bus = Bus(interface="virtual", channel=tmp_path.name)
    config = tmp_path / "robot.toml"
    text = CONFIG.read_text().replace("skin-demo", tmp_path.name)
    config.write_text(f'{text}\n[mqtt]\nhost = "{mosquitto.host}"\nport = {mosquitto.port}\n')
    words = ["calibrate", str(config), "--output", str(tmp_path / "other.json")]
    async with living(bus, tmp_path, port=mosquitto.port):
        assert await skin(*words) == 2
        assert "skin command calibrate" in capsys.readouterr().err.splitlines()[-1]
    assert await skin(*words) == 1
    assert "no board sent a sweep" in capsys.readouterr().err
