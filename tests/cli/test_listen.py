"""`skin listen` prints what skin and fingertips say, as lines for people or programs."""

import asyncio
import json
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from skin_host.cli import main
from skin_host.cli.lines import event_line, missed_line
from skin_host.client import session
from skin_host.config.settings import Mqtt, load
from skin_host.fingertip.events import Over, Slip
from skin_host.layout import build_layout
from skin_host.mqtt.info import NodeInfo, node_info
from skin_host.mqtt.publisher import Publisher
from tests.support.broker import Mosquitto, free_port
from tests.support.said import touch_event
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "config" / "fingertips.toml"
BEGUN = touch_event(
    "begin", 4, 1, 5, "index", [], [0.001, 0.002, 0.013], [0, 0, 1.0], None, None, None, 2.0
)
SLIP = Slip(
    event="begin",
    id=4,
    t_ns=6,
    part="index",
    cause="fall",
    force_n=2.01,
    shear_n=1.14,
    shear_rate_n_s=-4.8,
)
SLIP_END = replace(SLIP, event="end", t_ns=7, force_n=2.0, shear_n=0.6, shear_rate_n_s=0.0)
OVER = Over(event="begin", id=4, t_ns=8, part="index", force_n=10.4)
ENDED = BEGUN.ended(9, 9)
LINES = """\
index          begin #4    (   1.0,   2.0) mm               2.00 N
index          slip  #4    begins, by the fall of the tangential force: 2.01 N normal, \
1.14 N tangential, -4.8 N/s
index          slip  #4    ends
index          over  #4    begins: 10.40 N normal
index          end   #4    (   1.0,   2.0) mm
""".splitlines()


def test_a_line_shows_what_is_not_known_of_a_touch() -> None:
    bound = replace(BEGUN, taxels=[3], peak_kpa=12.0, partial=True)
    assert "12.0 kPa  ≥2.00 N" in event_line(bound)
    assert "≥" not in event_line(replace(bound, partial=False))
    assert event_line(BEGUN.ended(9, 9, "lost")).endswith("lost: it may still last")
    assert event_line(BEGUN.ended(9, 9)).endswith(" mm")


def info() -> NodeInfo:
    settings = load(CONFIG)
    return node_info(
        build_layout(settings, CONFIG.parent),
        "main",
        version="1",
        configuration="x",
        fingertips=settings.fingertips,
    )


async def listened(broker: Mosquitto, *options: str) -> list[str]:
    """What the command prints of a grasp in which something slips, ten lines of it."""
    command = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "skin_host", "listen", "--count", "10", *options),
        *("--robot", "fingertips", "--broker", f"mqtt://{broker.host}:{broker.port}"),
        cwd=ROOT,
        stdout=asyncio.subprocess.PIPE,
    )
    said = asyncio.create_task(command.communicate())
    settings = Mqtt(host=broker.host, port=broker.port)
    async with Publisher(settings, "fingertips", "main") as publisher:
        publisher.put_info(info())
        # Events are not retained: they are told again until the command listens.
        async with asyncio.timeout(PATIENCE_S):
            while not said.done():
                publisher.put_touch(BEGUN)
                for event in (SLIP, SLIP_END, OVER):
                    publisher.put_touch(event)
                publisher.put_touch(ENDED)
                await asyncio.wait([said], timeout=0.2)
    out, _ = await said
    assert command.returncode == 0
    return out.decode().splitlines()


async def test_a_slip_and_an_excess_stand_between_begin_and_end_of_their_touch(
    mosquitto: Mosquitto,
) -> None:
    seen = await listened(mosquitto, "--part", "index")
    begin = seen.index(LINES[0])
    assert seen[begin : begin + 5] == LINES


async def test_programs_get_each_event_as_a_document(mosquitto: Mosquitto) -> None:
    documents = [json.loads(line) for line in await listened(mosquitto, "--json")]
    kinds = {(one["schema"], one["event"]) for one in documents}
    assert kinds >= {("skin.slip/1", "begin"), ("skin.slip/1", "end"), ("skin.over/1", "begin")}
    slip = next(one for one in documents if one["schema"] == "skin.slip/1")
    assert (slip["cause"], slip["force_n"], slip["shear_n"]) == ("fall", 2.01, 1.14)
    assert slip["missed"] == 0


async def first_warning(*options: str) -> str:
    """What the command reports first on stderr, while no event comes."""
    command = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "skin_host", "listen", *options),
        cwd=ROOT,
        stderr=asyncio.subprocess.PIPE,
    )
    assert command.stderr is not None
    async with asyncio.timeout(PATIENCE_S):
        line = await command.stderr.readline()
    command.terminate()
    await command.communicate()
    return line.decode()


async def test_why_no_events_come_is_on_stderr(mosquitto: Mosquitto) -> None:
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    where = ("--broker", url, "--robot", "fingertips")
    gone = f"127.0.0.1:{free_port()}"
    missing = await first_warning("--broker", f"mqtt://{gone}")
    assert missing.startswith(f"warning: no broker at {gone}: Connection refused")
    nobody = 'warning: no node of robot "fingertips" is online; '
    assert await first_warning(*where) == f"{nobody}is `skin run` running?; waiting\n"
    async with Publisher(Mqtt(host=mosquitto.host, port=mosquitto.port), "demo", "main"):
        there = f"{nobody}there are the robots: demo; waiting\n"
        assert await first_warning(*where) == there


async def test_a_part_that_the_robot_does_not_have_ends_it(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "NAMED_S", 0.0)
    settings = Mqtt(host=mosquitto.host, port=mosquitto.port)
    words = ["listen", "--broker", f"mqtt://{mosquitto.host}:{mosquitto.port}", "--part", "indx"]
    async with Publisher(settings, "fingertips", "main") as publisher:
        publisher.put_info(info())
        assert await asyncio.to_thread(main, [*words, "--robot", "fingertips"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        'skin listen: robot "fingertips" has no part "indx"; there are: index, thumb, thumb_skin'
    )


def test_what_was_missed_is_said_by_kind_and_part() -> None:
    slip = replace(SLIP_END, part="thumb", missed=3)
    assert missed_line(slip, as_json=False) == "(3 slip events of thumb were missed)"
    assert json.loads(missed_line(slip, as_json=True)) == {
        "missed": 3,
        "part": "thumb",
        "kind": "slip",
    }
