"""Health goes out at once when something changes, and once a second when only numbers do."""

from itertools import pairwise
from pathlib import Path
from typing import Any

from emulator.probes.scene import Fault
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from skin_host.daemon.daemon import HEALTH_S
from tests.support.live import living
from tests.support.stepped import stepped


@stepped
async def test_a_sentence_with_another_number_in_it_is_no_change(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    said: list[tuple[float, Any, list[str]]] = []
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        put = live.daemon.publisher.put_health

        def put_health(part: str, record: Any) -> None:
            if part == "left_hand":
                faults = {(fault["code"], fault["where"]) for fault in record["faults"]}
                said.append((clock.monotonic_s(), (record["state"], faults), record["sentences"]))
            put(part, record)

        live.daemon.publisher.put_health = put_health  # type: ignore[method-assign]
        live.robot.inject(Fault(name="jittered_period", board="hand", value=9.0))
        await live.until("board_jitter")
        await clock.sleep(3.5)
    assert any(before[2] != after[2] for before, after in pairwise(said))
    changes = [before[1] != after[1] for before, after in pairwise(said)]
    pauses_s = [after[0] - before[0] for before, after in pairwise(said)]
    quiet = [pause for pause, changed in zip(pauses_s, changes, strict=True) if not changed]
    assert quiet
    # A look that comes late makes the next one seem early.
    assert min(quiet) > 0.5 * HEALTH_S
