"""Commands that talk to a daemon that runs: `skin command`, `skin status`."""

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from msgspec.structs import replace

from emulator.probes.scene import Place, Probe
from skin_host.cli import main
from skin_host.config.settings import Bus, Mqtt, load
from skin_host.layout import build_layout
from skin_host.mqtt.info import node_info
from skin_host.mqtt.publisher import Publisher
from tests.support.broker import Mosquitto
from tests.support.live import CONFIG, Live, living
from tests.support.waiting import until


@pytest_asyncio.fixture
async def live(mosquitto: Mosquitto, tmp_path: Path) -> AsyncIterator[Live]:
    """A robot that lives and is calibrated."""
    bus = Bus(interface="virtual", channel=tmp_path.name)
    async with living(bus, tmp_path, port=mosquitto.port) as found:
        yield found


@pytest.fixture
def url(live: Live, mosquitto: Mosquitto) -> str:
    """The broker of such a robot."""
    return f"mqtt://{mosquitto.host}:{mosquitto.port}"


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
    assert "  margin_units: 3\n" in capsys.readouterr().out
    words = ["command", "thresholds", "--set", "margin_unit=3"]
    assert await skin(*words, "--broker", url) == 2
    assert "--set: unknown key `margin_unit`; meant `margin_units`?" in capsys.readouterr().err
    assert await skin("command", "thresholds", "--reset", "--json", "--broker", url) == 0
    assert json.loads(capsys.readouterr().out)


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


async def test_where_no_daemon_runs_a_node_is_not_called_a_wrong_name(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["command", "status", "--robot", "demo", "--node", "main"]
    assert await skin(*words, "--broker", f"mqtt://{mosquitto.host}:{mosquitto.port}") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith('no node of robot "demo" is known; is `skin run` running?')


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["calibrate", "--node", "mian"], 'no node "mian" of robot "demo"; there are: main'),
        (
            ["disable", "--part", "tail"],
            'no part "tail" of robot "demo"; there are: left_forearm, left_hand',
        ),
        (
            ["disable", "--part", "left_hnad", "--node", "main"],
            'no part "left_hnad" of node "main"; there are: left_forearm, left_hand',
        ),
        (
            ["calibrate", "--board", "foot"],
            'no board "foot" of robot "demo"; there are: forearm_inner, forearm_outer, hand',
        ),
        (["thresholds", "--set", "votes_of_3=4"], "--set: votes_of_3: "),
        (["thresholds", "--set", "margin_units=-1"], "--set: margin_units: "),
    ],
)
async def test_a_name_or_number_that_cannot_be_is_a_wrong_request(
    live: Live, url: str, capsys: pytest.CaptureFixture[str], words: list[str], line: str
) -> None:
    taken = live.daemon.publisher.counters.commands_taken
    assert await skin("command", *words, "--broker", url) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith(f"skin command: {line}")
    assert shown.err.count("\n") == 1
    assert live.daemon.publisher.counters.commands_taken == taken


@pytest.mark.parametrize(
    ("words", "status", "line"),
    [
        (["calibrate", "--seconds", "1e6"], 2, "the request: seconds: "),
        (["record", "--file", "../x"], 2, 'file: "../x": wanted a plain name'),
        (["record", "--file", "x.blf"], 2, 'x.blf: wanted a name that ends in ".log"'),
        (["thresholds", "--set", "margin_units=255"], 2, "margin_units = 255, "),
        (["stop_recording"], 1, "nothing is being recorded"),
    ],
)
async def test_what_the_daemon_finds_wrong_ends_as_what_the_command_line_finds_wrong(
    url: str, capsys: pytest.CaptureFixture[str], words: list[str], status: int, line: str
) -> None:
    assert await skin("command", *words, "--broker", url) == status
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith(f"skin command: {line}")
    assert shown.err.count("\n") == 1


async def test_what_a_daemon_answers_is_printed_for_people(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async def lines(*words: str) -> list[str]:
        assert await skin("command", *words, "--broker", url) == 0
        shown = capsys.readouterr()
        assert shown.err == ""
        return shown.out.splitlines()

    path = tmp_path / "recordings/run.log"
    assert await lines("record", "--file", "run.log", "--seconds", "60") == [
        f"file: {path}",
        "seconds: 60",
    ]
    file, _, lost, ended = await lines("stop_recording")
    assert (file, lost, ended) == (f"file: {path}", "lost: 0", "ended: stopped")
    assert await lines("configure") == ["boards: hand, forearm_outer, forearm_inner"]
    assert await lines("disable", "--part", "left_hand") == ["disabled: left_hand", "kept: yes"]
    assert await lines("enable", "--part", "left_hand") == ["disabled: none", "kept: yes"]
    assert await lines("raw", "--seconds", "0.5") == ["seconds: 0.5"]
    disabled, kept, *thresholds = await lines("thresholds", "--set", "margin_units=3")
    assert (disabled, kept) == ("disabled: none", "kept: yes")
    assert thresholds[:2] == ["touch:", "  margin_units: 3"]
    assert "decides_kpa:" in thresholds
    head, *rows, known = await lines("calibrate", "--board", "hand", "--seconds", "0.5")
    assert head.split() == ["part", "board", "triangles", "verdict"]
    assert {tuple(row.split()[:2]) for row in rows} == {("left_hand", "hand")}
    assert known.startswith("calibration ")


@pytest.mark.parametrize(("options", "status"), [((), 0), (("--strict", "--json"), 1)])
async def test_a_running_daemon_that_calibrates_touched_skin_names_the_taxels(
    live: Live, url: str, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], status: int
) -> None:
    part = live.daemon.layout.part("left_hand")
    weight = Probe(part="left_hand", at=Place(taxel=3), diameter_mm=4, force_n=[(0, 1)])
    live.robot.touch(weight).press(2.0)
    await live.wait(lambda: bool(live.daemon.engine.zeros._touched[part.start + 3]))
    words = ["command", "calibrate", "--seconds", "0.5", "--broker", url]
    assert await skin(*words, *options) == status
    shown = capsys.readouterr()
    (warning,) = shown.err.splitlines()
    assert "taxel 3 of left_hand" in warning
    assert "repeat" in warning
    if options:
        assert json.loads(shown.out)["touched"] == {"left_hand": [3]}
    else:
        assert any(line.endswith("touched: 3") for line in shown.out.splitlines())
    # Those of another board are of the calibration before.
    assert await skin(*words, "--board", "forearm_outer", "--strict") == 0
    assert capsys.readouterr().err == ""


async def test_a_running_daemon_that_zeroes_fingertips_names_them(
    mosquitto: Mosquitto, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = Bus(interface="virtual", channel=tmp_path.name)
    config = CONFIG.with_name("fingertips.toml")
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    words = ["command", "calibrate", "--seconds", "0.5", "--broker", url]
    async with living(bus, tmp_path, port=mosquitto.port, config=config) as live:
        assert await skin(*words) == 0
        out = capsys.readouterr().out
        assert "\nindex: zero taken\nthumb: zero taken\n" in out
        weight = Probe(part="index", force_n=[(0.0, 0.0)])
        live.robot.touch(weight).press(2.0)
        tips = live.daemon.engine.fingertips
        assert tips is not None
        await live.wait(lambda: tips.tips["index"].tip.touched)
        assert await skin(*words, "--strict") == 1
        shown = capsys.readouterr()
        assert "\nindex: zero taken while it was touched\n" in shown.out
        assert "while it was calibrated: index; take away" in shown.err
        # Of one board no fingertip is zeroed.
        assert await skin(*words, "--board", live.daemon.layout.boards[0].name) == 0
        assert "zero taken" not in capsys.readouterr().out


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


async def test_status_is_of_the_parts_that_the_nodes_list(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    """A broker may keep the health of a part that an earlier configuration had."""
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x")
    words = ["status", "--json", "--broker", f"mqtt://{mosquitto.host}:{mosquitto.port}"]
    async with Publisher(Mqtt(host=mosquitto.host, port=mosquitto.port), "demo") as publisher:
        for part in ("arm_of_last_year", *info.parts):
            publisher.put_health(part, {"state": "ok"})
        publisher.put_info(info)
        await until(lambda: publisher.counters.retained_sent >= 5)
        asked = asyncio.create_task(skin(*words))
        while not asked.done():  # as a node does, each second
            for part in info.parts:
                publisher.put_health(part, {"state": "ok"})
            await asyncio.wait([asked], timeout=0.1)
        assert await asked == 0
        assert set(json.loads(capsys.readouterr().out)) == set(info.parts)
        # Nothing is not "all is well".
        publisher.put_info(replace(info, parts={}))
        await until(lambda: not publisher._outbox.pending)
        assert await skin(*words) == 1
        assert json.loads(capsys.readouterr().out) == {}


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
        # Right, but not now: as where the daemon is found by its lock, without a broker.
        assert await skin(*words) == 1
        assert "skin command calibrate" in capsys.readouterr().err.splitlines()[-1]
    assert await skin(*words) == 1
    assert "no board sent a sweep" in capsys.readouterr().err
