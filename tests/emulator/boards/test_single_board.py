"""The firmware on smbus2 buses that it was given, and a python-can bus."""

import asyncio
from contextlib import ExitStack

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from emulator import link
from emulator.chips.ad7147 import AD7147
from emulator.chips.i2c import build_lines
from emulator.clock import EmulatedTime, SteppedTime
from skin_host.bus.commands import (
    Discover,
    Message,
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.errors import RequestError


class ChipsInTime:
    """A stepped clock that carries chips along."""

    def __init__(self, chips: list[AD7147]) -> None:
        self._clock = SteppedTime(free=True)
        self._chips = chips

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def host_ns(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        return self._clock.host_ns(t_ns)

    async def sleep_until_ns(self, t_ns: int) -> None:
        before_ns = self.now_ns()
        await self._clock.sleep_until_ns(t_ns)
        for chip in self._chips:
            chip.advance((self.now_ns() - before_ns) * 1e-9)


async def listen(bus: can.BusABC, clock: EmulatedTime, seconds: float) -> list[can.Message]:
    """Messages that come within so much emulated time."""
    until_ns = clock.now_ns() + round(seconds * 1e9)
    messages: list[can.Message] = []
    while clock.now_ns() < until_ns:
        await asyncio.sleep(0)
        while (message := bus.recv(0)) is not None:
            messages.append(message)
    return messages


async def test_one_i2c_bus_and_a_can_interface_are_a_board_of_four_triangles() -> None:
    chips = [AD7147() for _ in range(3)]
    for chip in chips:
        chip.set_capacitances_ff([9000.0] * 12)
    lines = build_lines([*chips, *[None] * 13])[:1]
    clock = ChipsInTime(chips)
    with (
        can.Bus(interface="virtual", channel="single-board") as inside,
        can.Bus(interface="virtual", channel="single-board") as host,
    ):

        def say(command: Message) -> None:
            can_id, data = command_frame(command, 3)
            host.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

        life = asyncio.create_task(link.run_board("mtb4", 3, lines, inside, clock))
        say(Discover())
        (answer,) = await listen(host, clock, 0.1)
        assert (answer.arbitration_id, answer.data.hex()) == (0x730, "ff0b011900")
        say(SetBoardConfig(2, 50, 240))
        await listen(host, clock, 0.1)
        say(SetTriangleConfig(0, 3))
        await listen(host, clock, 0.1)
        say(SetTxMode(TxMode.START))
        frames = await listen(host, clock, 1.0)
        chips[1].set_capacitance_ff(4, 9000.0 + 0.36 * 100)
        await listen(host, clock, 0.1)
        pressed = (await listen(host, clock, 0.1))[-8:]
        life.cancel()
    assert len(frames) == pytest.approx(20 * 8, abs=8)
    assert [frame.arbitration_id for frame in frames[:8]] == [0x430 + i // 2 for i in range(8)]
    by_triangle = {
        frame.arbitration_id & 0xF: frame.data for frame in pressed if frame.data[0] == 0x40
    }
    assert by_triangle[1][5] == 240 - 25
    assert by_triangle[0][5] == 240
    # Nobody is at the fourth address.
    assert pressed[-1].data.hex() == "c0f0f0f0f0f00002"


async def test_an_unknown_model_is_refused() -> None:
    with can.Bus(interface="virtual", channel="single-board") as bus:
        with pytest.raises(ValueError, match="there are: mtb3"):
            await link.run_board("mtb9", 1, [], bus)


@pytest.mark.parametrize("devices", [",", " ", "/dev/i2c-1,", ",".join("123456")])
def test_devices_that_are_not_the_lines_of_a_board_are_refused(devices: str) -> None:
    with pytest.raises(RequestError, match="wanted 1 to 5 devices"), ExitStack() as opened:
        link.open_lines(devices, opened)


@pytest.mark.parametrize("device", ["/dev/null", "/dev/i2c-none", "/dev"])
def test_a_device_that_is_no_i2c_line_is_named(device: str) -> None:
    """That of a call to the driver alone would be unnamed."""
    with pytest.raises(OSError) as raised, ExitStack() as opened:
        link.open_lines(device, opened)
    assert raised.value.filename == device
