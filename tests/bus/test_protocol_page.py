"""docs/protocol.md shows what passes between `skin run` and a board from its start to its end."""

import re
from pathlib import Path

import can

from skin_host.bus.wire import BROADCAST_ADDRESS, MessageClass
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from tests.support.live import living
from tests.support.stack import ROOT
from tests.support.stepped import stepped

HAND = 14
#: An answer whose bytes differ each time: its uptime.
UPTIME = "7E0#0E"


def same(frame: str) -> str:
    return UPTIME if frame.startswith(UPTIME) else frame


@stepped
async def test_the_page_shows_what_passes_between_host_and_board(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    page = (ROOT / "docs" / "protocol.md").read_text()
    block = page.partition("## Bring-up")[2].split("```")[1]
    shown = re.findall(r"^([0-9A-F]{3}#[0-9A-F]+)", block, re.MULTILINE)
    sent = []
    with can.Bus(interface="virtual", channel=can_bus_settings.channel) as spy:
        async with living(can_bus_settings, tmp_path, clock=clock):
            pass
        while (frame := spy.recv(0)) is not None:
            number = frame.arbitration_id
            commands = number >> 8 in {MessageClass.ANALOG_COMMAND, MessageClass.MANAGEMENT}
            if commands and (
                number & 0xF in {HAND, BROADCAST_ADDRESS} or number >> 4 & 0xF == HAND
            ):
                sent.append(f"{number:03X}#{bytes(frame.data).hex().upper()}")
    assert [same(frame) for frame in shown] == [same(frame) for frame in sent]
