"""What faults come from at once, as one value that is cheap to take and to compare.

Ten times a second it shows whether anything has changed; only then, and once a second, the records
are made, which cost a hundred times as much. Measures that change slowly (temperature, periods,
baselines) are left to the records of each second.
"""

import numpy as np

from skin_host.bus.boards import Boards
from skin_host.bus.port import Port
from skin_host.health.describe import ABSENT_SWEEPS
from skin_host.health.watch import Watch
from skin_host.processing.core import Engine

#: What a bus gains in a second through faults.
_LOSSES = ("wrong", "halves", "spikes", "dropped", "error_frames")


def pulse(
    engine: Engine, watch: Watch, ports: dict[str, Port], boards: dict[str, Boards]
) -> tuple[object, ...]:
    """Return a value that differs when a fault may have begun or ended.

    Args:
        engine, watch: what is watched.
        ports, boards: by name of the bus.
    """
    return (
        engine.calibration,
        tuple(engine.disabled),
        *_boards(engine),
        *(None if part.valid is None else part.valid.tobytes() for part in watch.parts.values()),
        *((bus.silent, *map(bus.gained.get, _LOSSES)) for bus in watch.buses.values()),
        *(port.state for port in ports.values()),
        *(dict(manager.strangers) for manager in boards.values()),
        *(
            (known.board_type, known.in_bootloader)
            for manager in boards.values()
            for known in manager.records.values()
        ),
    )


def _boards(engine: Engine) -> tuple[object, ...]:
    ledger, liveness = engine.ledger, engine.intake.liveness
    events = (ledger.resets, ledger.lost_set_ups, ledger.tx_overflows, ledger.rezeros)
    found: tuple[object, ...] = (
        ledger.silent.tobytes(),
        (ledger.sweeps > 0).tobytes(),
        np.minimum(ledger.absent, ABSENT_SWEEPS).tobytes(),
        engine.doubts(),
        *(counts.tobytes() for counts in events),
    )
    if any(ledger.flagged):
        found += ledger.error.tobytes(), ledger.far.tobytes()
    if liveness.doubted is not None:
        found += liveness.doubted.tobytes(), liveness.frozen.tobytes()
    return found
