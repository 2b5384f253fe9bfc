"""What the daemon's own recording holds: what it received, and what it sent."""

from pathlib import Path

import can
import numpy as np

from skin_host.bus.commands import ZEROING, parse_command
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from tests.support.live import living
from tests.support.stepped import stepped


@stepped
async def test_a_recording_of_the_daemon_has_the_set_up_of_a_board_where_it_happened(
    clock: SteppedClock, tmp_path: Path
) -> None:
    bus = Bus(interface="virtual", channel="recorded-commands")
    async with living(bus, tmp_path, clock=clock) as live:
        await clock.sleep(1.0)
        handle = live.daemon.control.handle
        answer = await handle("record", b'{"seconds":60}')
        await clock.sleep(0.5)
        began_ns = clock.now_ns()
        await handle("configure", b"{}")
        ended_ns = clock.now_ns()
        await clock.sleep(0.5)
        ended = await handle("stop_recording", b"{}")
    frames = list(can.LogReader(Path(answer["file"])))
    assert ended["lost"] == 0
    assert ended["frames"] == len(frames)
    assert (np.diff([frame.timestamp for frame in frames]) >= 0).all()
    zeroed_ns = [
        frame.timestamp * 1e9
        for frame in frames
        if (parsed := parse_command(frame.arbitration_id, bytes(frame.data))) is not None
        and isinstance(parsed[1], ZEROING)
    ]
    boards = len(live.daemon.engine.boards)
    assert len(zeroed_ns) >= boards
    assert began_ns - 1e6 <= min(zeroed_ns) <= max(zeroed_ns) <= ended_ns + 1e6
