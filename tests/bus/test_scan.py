"""A scan lists boards that answer, that are in their bootloader, and that only stream."""

import asyncio
from dataclasses import asdict

import can
import numpy as np

from skin_host.bus.answers import Discovered, DiscoveredBootloader, answer_frame
from skin_host.bus.commands import BoardType, Discover, command_frame
from skin_host.bus.scan import scan, scan_table
from skin_host.bus.wire import BROADCAST_ADDRESS, encode_sweep
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from tests.support.stepped import stepped

ANSWERS = [
    (14, Discovered(BoardType.MTB4, 1, 2, 3)),
    (9, DiscoveredBootloader(BoardType.SKIN, 4, 5)),
    (10, Discovered(77, 6, 7, 8)),
    # Another one at the same address, and an answer that came twice.
    (10, Discovered(BoardType.MTB4, 6, 7, 8)),
    (10, Discovered(BoardType.MTB4, 6, 7, 8)),
]
STREAMING, TRIANGLES = 5, np.array([0, 3])


async def boards(bus: can.BusABC, clock: SteppedClock) -> None:
    """Stream from one board, and answer a discovery."""
    values, status = np.zeros((len(TRIANGLES), 12), np.uint8), np.zeros(len(TRIANGLES), np.uint16)
    ids, data = encode_sweep(STREAMING, TRIANGLES, values, status)
    frames = list(zip(ids.tolist(), map(bytes, data), strict=True))
    asked = command_frame(Discover(), BROADCAST_ADDRESS)
    while True:
        sent = list(frames)
        while (heard := bus.recv(0)) is not None:
            if (heard.arbitration_id, bytes(heard.data)) == asked:
                sent += [answer_frame(answer, address) for address, answer in ANSWERS]
        sent.append((0x7FF, b"not of a skin"[:8]))
        # Joints that a MAIS measures: the first of them rests at what begins a frame of skin.
        sent += [(0x36C, b"\x40" + bytes(7)), (0x36D, b"\xc0" + bytes(7))]
        for identifier, payload in sent:
            bus.send(can.Message(arbitration_id=identifier, data=payload, is_extended_id=False))
        await clock.sleep(0.02)


@stepped
async def test_boards_are_listed_by_address_with_what_they_run_and_send(
    clock: SteppedClock, can_bus_settings: Bus
) -> None:
    with can.Bus(interface="virtual", channel=can_bus_settings.channel) as bus:
        answering = asyncio.create_task(boards(bus, clock))
        found = await scan(can_bus_settings)
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
    assert [asdict(one) for one in found] == [
        {
            "address": address,
            "board_type": board_type,
            "firmware": firmware,
            "in_bootloader": firmware is None and address == 9,
            "triangles": triangles,
        }
        for address, board_type, firmware, triangles in [
            (STREAMING, "unknown", None, TRIANGLES.tolist()),
            (9, "skin", None, []),
            (10, "type 77", "6.7.8", []),
            (10, "mtb4", "6.7.8", []),
            (14, "mtb4", "1.2.3", []),
        ]
    ]
    *rows, last = scan_table(found, "can0").splitlines()
    assert last == "2 boards answer at address 10: give each one of its own"
    assert [row.split() for row in rows[1:]] == [
        ["5", "unknown", "-", "0,3"],
        ["9", "skin", "bootloader", "-"],
        ["10", "type", "77", "6.7.8", "-"],
        ["10", "mtb4", "6.7.8", "-"],
        ["14", "mtb4", "1.2.3", "-"],
    ]


@stepped
async def test_on_an_empty_bus_the_scan_asks_for_power_and_termination(
    clock: SteppedClock, can_bus_settings: Bus
) -> None:
    found = await scan(can_bus_settings)
    assert found == []
    assert "powered" in scan_table(found, "can0")
