"""The firmware model as a board of its own, on chips that another process shows as devices."""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import can

from skin_host.bus.answers import Discovered, parse_answer
from skin_host.bus.commands import (
    Discover,
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.bus.wire import BROADCAST_ADDRESS
from skin_host.config.settings import Bus

ROOT = Path(__file__).parents[3]
FIRST = 20
ADDRESS = 14


def emulate(config: Path, channel: str, *options: str) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "skin_host", "emulate", str(config), "--board", "hand"]
    return subprocess.Popen([*command, "--channel", channel, *options], cwd=ROOT)


def test_a_computer_with_chips_on_its_i2c_is_a_board_to_any_host(
    new_can_bus: Callable[[], Bus], tmp_path: Path
):
    chips_bus, board_bus = new_can_bus(), new_can_bus()
    config = ROOT / "config/demo.toml"
    interface = ("--interface", "socketcan")
    quiet = tmp_path / "quiet.toml"
    quiet.write_text("quiet = true\n")
    chips = ("--scene", str(quiet), "--i2c-dev", str(FIRST))
    robot = emulate(config, chips_bus.channel, *interface, *chips)
    devices = [Path(f"/dev/i2c-{FIRST + line}") for line in range(4)]
    board = None
    try:
        deadline = time.monotonic() + 60
        while not all(device.exists() for device in devices):
            assert time.monotonic() < deadline
            assert robot.poll() is None
            time.sleep(0.1)
        lines = ",".join(map(str, devices))
        board = emulate(config, board_bus.channel, *interface, "--i2c", lines)
        with can.Bus(interface="socketcan", channel=board_bus.channel) as bus:
            seen = stream(bus)
    finally:
        for process in (board, robot):
            if process is not None:
                process.terminate()
                process.wait(60)
    # Fingers and palm answer, untouched; triangles without a chip say so.
    assert set(seen) == {*range(5), 5, *range(8, 12)}
    for triangle in (0, 4, 8, 11):
        values, status = seen[triangle]
        assert all(abs(value - 240) <= 8 for value in values)
        assert status == 0
    assert seen[5][1] & 3


def stream(bus: can.BusABC) -> dict[int, tuple[list[int], int]]:
    """Find the board and set it up as a host does, and take one whole sweep of it, late enough."""
    find(bus)
    halves: dict[tuple[int, int], bytes] = {}
    started = configured = 0.0
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        now = time.monotonic()
        if now - configured > 10 and not halves:
            configured = now
            for command in (
                SetBoardConfig(1, 100, 240),
                SetTriangleConfig(0, 5),
                SetTriangleConfig(8, 11),
            ):
                send(bus, command_frame(command, ADDRESS))
            time.sleep(1.0)
            send(bus, command_frame(SetTriangleConfig(8, 11), ADDRESS))
            time.sleep(1.0)
            send(bus, command_frame(SetTxMode(TxMode.START), ADDRESS))
        frame = bus.recv(1.0)
        if frame is None or frame.arbitration_id >> 4 != 0x40 | ADDRESS:
            continue
        started = started or now
        halves[frame.arbitration_id & 0xF, frame.data[0]] = bytes(frame.data)
        if now - started > 3:
            break
    result = {}
    for triangle in {number for number, _ in halves}:
        a, b = halves[triangle, 0x40], halves[triangle, 0xC0]
        result[triangle] = [*a[1:], *b[1:6]], b[6] << 8 | b[7]
    return result


def find(bus: can.BusABC) -> None:
    """Ask who is there until the board answers: its program needs some time to start."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        send(bus, command_frame(Discover(), BROADCAST_ADDRESS))
        frame = bus.recv(1.0)
        answer = None if frame is None else parse_answer(frame.arbitration_id, bytes(frame.data))
        if answer is not None and answer[0] == ADDRESS and isinstance(answer[1], Discovered):
            return
    raise AssertionError("the board does not answer")


def send(bus: can.BusABC, frame: tuple[int, bytes]) -> None:
    bus.send(can.Message(arbitration_id=frame[0], data=frame[1], is_extended_id=False))
