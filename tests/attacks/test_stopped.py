"""The daemon's process is stopped for a while (SIGSTOP, a debugger, a swapping computer)."""

from pathlib import Path

import pytest

from emulator.probes.scene import Place, Probe, Scene
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from skin_host.mqtt.messages import ContactState
from skin_host.processing.events import Touch
from tests.support.live import living
from tests.support.stepped import stepped

#: Begins before the stop and ends in it.
PRESS = Probe(
    part="left_hand",
    at=Place(triangle=4),
    diameter_mm=10,
    pressure_kpa=[(0, 0), (0.1, 60), (3.0, 60), (3.1, 0)],
    start_s=6.0,
)


@stepped
@pytest.mark.parametrize("stopped_s", [5.0, 30.0, 120.0])
async def test_a_touch_that_ends_meanwhile_is_over_afterwards_and_nobody_is_accused(
    clock: SteppedClock, stopped_s: float, tmp_path: Path
) -> None:
    bus = Bus(interface="virtual", channel=f"stopped-{stopped_s:g}")
    async with living(bus, tmp_path, scene=Scene(quiet=True, probe=[PRESS]), clock=clock) as live:
        daemon = live.daemon
        publisher = daemon.publisher
        put_contact, put_touch = publisher.put_contact, publisher.put_touch
        touches: list[tuple[str, int]] = []
        contacts: dict[str, ContactState] = {}

        def note_touch(event: Touch) -> None:
            touches.append((event.event, event.id))
            put_touch(event)

        def note_contact(part: str, state: ContactState) -> None:
            contacts[part] = state
            put_contact(part, state)

        publisher.put_touch = note_touch  # type: ignore[method-assign]
        publisher.put_contact = note_contact  # type: ignore[method-assign]
        await live.wait(lambda: contacts.get("left_hand") == "ON")
        clock.advance(stopped_s)
        accused: set[str] = set()
        for _ in range(100):
            await clock.sleep(0.05)
            accused |= {code for code, _ in live.faults()}
        assert [event for event, _ in touches].count("begin") == 1
        assert touches[-1] == ("end", touches[0][1])
        assert contacts == {"left_hand": "OFF", "left_forearm": "OFF"}
        assert accused <= {"board_rezeroed", "broker_away", "bus_drops", "host_stalls"}
        assert not daemon.engine.ledger.silences.any()
        assembler, port = daemon.engine.assemblers["can0"], daemon.link.ports["can0"]
        assert assembler.counters.frames == port.counters.frames
        assert live.frames_sent["can0"] - port.counters.frames < 200
