"""What the live page shows of a calibration, in a real browser: it passes over nothing that was
wrong, of none of the nodes, and what did not come counts as not known.
"""

import asyncio
import json
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

from skin_host.config.settings import Mqtt, changed, load
from skin_host.errors import SkinError
from skin_host.layout import build_layout
from skin_host.mqtt.info import node_info
from skin_host.mqtt.publisher import Publisher
from tests.support.broker import Mosquitto
from tests.support.devtools import Page
from tests.support.viewing import viewing
from tests.viewer.test_server import CONFIG

BANNER = 'document.getElementById("banner").textContent'
MAY_CALIBRATE = "!document.getElementById('calibrate').disabled"
WELL = {
    "id": "abc",
    "verdicts": {"left_hand": {"ok": 104}},
    "touched": {},
    "fingertips": {},
    "kept": True,
}
PACKET = "more than the broker takes in one packet"
ALL = "verdicts, pads that were touched, fingertips"
HEALTH = "Health names what was touched."
UNKEPT = (
    "Calibrated, but it could not be written and is lost when the daemon restarts; "
    "health gives the reason."
)
AGAIN = "Take away what touches the skin and calibrate again."

Answer = Mapping[str, Any] | str


class Robot:
    """Nodes that answer to `calibrate` what they are to: a result, or why it failed."""

    def __init__(self) -> None:
        self.answers: dict[str, Answer] = {}
        self.released = asyncio.Event()
        self.released.set()

    async def answer(self, node: str) -> Mapping[str, Any]:
        if node == "arm":
            await self.released.wait()
        answer = self.answers[node]
        if isinstance(answer, str):
            raise SkinError(answer)
        return answer


@asynccontextmanager
async def calibrating(
    broker: Mosquitto, profile: Path, *nodes: str
) -> AsyncIterator[tuple[Robot, Page]]:
    """The page of a robot whose hand is on the first of these nodes, its forearm on the last."""
    values = {"parts.left_hand.node": nodes[0], "parts.left_forearm.node": nodes[-1]}
    layout = build_layout(changed(load(CONFIG), values), CONFIG.parent)
    robot = Robot()
    async with AsyncExitStack() as stack:
        for node in nodes:

            async def handle(name: str, payload: bytes, node: str = node) -> Mapping[str, Any]:
                return await robot.answer(node)

            settings = Mqtt(host=broker.host, port=broker.port)
            publisher = await stack.enter_async_context(
                Publisher(settings, layout.robot, node, handler=handle)
            )
            publisher.put_info(node_info(layout, node, version="1", configuration="x"))
        seen = await stack.enter_async_context(viewing(broker, layout.robot, profile))
        for part in ("left_hand", "left_forearm"):
            await seen.until(f"document.body.innerText.includes('{part}')")
        yield robot, seen


async def calibrate(seen: Page) -> None:
    await seen.until(MAY_CALIBRATE)
    await seen.click_on('document.getElementById("calibrate")')
    await seen.until('document.getElementById("confirm").open')
    await seen.click_on('document.querySelector("#confirm button.do")')


async def shows(seen: Page, wanted: str) -> None:
    """Wait until a calibration has ended so."""
    await seen.until(f"{MAY_CALIBRATE} && {BANNER} === {json.dumps(wanted)}")


async def test_what_did_not_come_or_was_touched_is_never_a_good_calibration(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    short = {key: value for key, value in WELL.items() if key == "id"}
    async with calibrating(mosquitto, tmp_path / "profile", "main") as (robot, seen):
        for answer, wanted in (
            (WELL, "Calibrated. left_hand: 104 ok"),
            (
                {**WELL, "verdicts": None, "left_out": ["triangles", "verdicts"]},
                f"Calibrated, but the answer came without verdicts: {PACKET}. {HEALTH}",
            ),
            (
                {**short, "left_out": ["verdicts", "touched", "fingertips"]},
                f"Calibrated, but the answer came without {ALL}: {PACKET}. {HEALTH}",
            ),
            (
                {**WELL, "touched": {"left_hand": [3]}, "fingertips": {"index": "touched"}},
                f"Touched while it was calibrated: 1 taxel of left_hand, index. {AGAIN}",
            ),
            (
                {**WELL, "kept": False},
                UNKEPT,
            ),
            ("no board sent a sweep", "no board sent a sweep"),
        ):
            robot.answers["main"] = answer
            await calibrate(seen)
            await shows(seen, wanted)


async def test_a_node_that_is_well_does_not_hide_what_another_one_found(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    touched = {**WELL, "touched": {"left_hand": [3, 4]}}
    arm = {**WELL, "verdicts": {"left_forearm": {"ok": 96}}}
    async with calibrating(mosquitto, tmp_path / "profile", "main", "arm") as (robot, seen):
        robot.answers = {"main": touched, "arm": arm}
        await calibrate(seen)
        await shows(seen, f"Touched while it was calibrated: 2 taxels of left_hand. {AGAIN}")
        # An error is shown at once; the end of the other node does not replace it.
        robot.answers = {"main": "a bus is down", "arm": arm}
        robot.released.clear()
        await calibrate(seen)
        await seen.until(f"{BANNER} === 'a bus is down' && !({MAY_CALIBRATE})")
        robot.released.set()
        await shows(seen, "a bus is down")
        robot.answers = {"main": WELL, "arm": arm}
        await calibrate(seen)
        await shows(seen, "Calibrated. left_forearm: 96 ok; left_hand: 104 ok")
