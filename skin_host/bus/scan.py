"""`skin scan`: who is on a bus, for people; nothing is set up."""

import asyncio
from collections import Counter
from dataclasses import dataclass

from skin_host.bus.answers import Discovered, DiscoveredBootloader, parse_answer
from skin_host.bus.commands import BoardType, Discover, command_frame
from skin_host.bus.opening import open_port
from skin_host.bus.wire import BROADCAST_ADDRESS, find_skin_frames
from skin_host.config.settings import Bus, Receive, format_triangles

#: A scan listens for so long before it asks, and again after.
SCAN_S = 0.5


@dataclass(slots=True)
class FoundBoard:
    """A board that answered or streams."""

    address: int
    board_type: str
    firmware: str | None
    in_bootloader: bool
    triangles: list[int]


async def scan(bus: Bus) -> list[FoundBoard]:
    """Broadcast a discovery and listen for answers and streams.

    Raises:
        BusError: the interface cannot be opened or does not take frames.
    """
    port = open_port("scan", bus, Receive())
    #: By type and firmware: more than one for an address, if boards of different ones share it.
    found: dict[int, dict[tuple[str, str | None], FoundBoard]] = {}
    #: Of each board, which halves of which triangles came: a lone one may be no frame of skin.
    halves: dict[int, set[tuple[int, int]]] = {}
    try:
        # Listen before asking: an MTB3 that streams stops sending when it is asked.
        for asked in (False, True):
            if asked:
                await port.send([command_frame(Discover(), BROADCAST_ADDRESS)])
            for _ in range(10):
                await asyncio.sleep(SCAN_S / 10)
                batch = port.read()
                skin = find_skin_frames(batch)
                for board, triangle, half in zip(
                    skin.board.tolist(), skin.triangle.tolist(), skin.half.tolist(), strict=True
                ):
                    halves.setdefault(board, set()).add((triangle, half))
                for row in range(len(batch)):
                    payload = batch.data[row, : int(batch.dlc[row])].tobytes()
                    parsed = parse_answer(int(batch.id[row]), payload)
                    if parsed is None:
                        continue
                    address, answer = parsed
                    if isinstance(answer, Discovered):
                        version = (
                            f"{answer.firmware_major}.{answer.firmware_minor}."
                            f"{answer.firmware_build}"
                        )
                    elif isinstance(answer, DiscoveredBootloader):
                        version = None
                    else:
                        continue
                    kind = _type_name(answer.board_type)
                    one = FoundBoard(address, kind, version, version is None, [])
                    found.setdefault(address, {}).setdefault((kind, version), one)
    finally:
        port.close()
    for address, seen in halves.items():
        triangles = sorted(triangle for triangle, half in seen if half and (triangle, 0) in seen)
        if triangles:
            streaming = FoundBoard(address, "unknown", None, False, [])
            for record in found.setdefault(address, {("", None): streaming}).values():
                record.triangles = triangles
    return [record for address in sorted(found) for record in found[address].values()]


def scan_table(found: list[FoundBoard], channel: str) -> str:
    """Return a line for each board, or what to look at where nobody answered."""
    if not found:
        return (
            f"{channel}: nobody answered. Are the boards powered, is the bitrate 1 Mbit/s, is the "
            "bus terminated?"
        )
    lines = ["address  type      firmware  streaming triangles"]
    for one in found:
        firmware = "bootloader" if one.in_bootloader else one.firmware or "-"
        streaming = format_triangles(one.triangles) or "-"
        lines.append(f"{one.address:>7}  {one.board_type:<8}  {firmware:<8}  {streaming}")
    times = Counter(one.address for one in found)
    lines += [
        f"{n} boards answer at address {address}: give each one of its own"
        for address, n in times.items()
        if n > 1
    ]
    return "\n".join(lines)


def _type_name(number: int) -> str:
    try:
        return BoardType(number).name.lower()
    except ValueError:
        return f"type {number}"
