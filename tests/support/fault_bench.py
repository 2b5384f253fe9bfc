"""A robot, an engine and its health in simulated time: faults happen, and what is told of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from emulator.probes.scene import Fault, Scene
from emulator.robot import Robot
from skin_host.bus.assembler import Sweep
from skin_host.config.settings import changed, load
from skin_host.health import HealthWatch, Record
from skin_host.layout import build_layout
from skin_host.processing.core import Engine, Output

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
TICK_S = 0.05
LOOK_EVERY = 2
#: Simulated time begins at a plausible time of day.
EPOCH_NS = 1_700_000_000_000_000_000


class FaultBench:
    """A calibrated robot; `run` lets time pass and remembers what is told and when."""

    def __init__(
        self,
        calibrate_s: float = 5.0,
        scene: Scene | None = None,
        *,
        config: Path = CONFIG,
        fidelity: str = "signal",
        settle_s: float = 6.0,
    ) -> None:
        settings = load(config)
        self.layout = build_layout(settings, config.parent)
        self.robot = Robot(settings, self.layout, scene or Scene(quiet=True), fidelity=fidelity)
        self.robot.converters.by_bus = True
        self.robot.bring_up()
        self.engine = Engine(settings, self.layout, list(range(len(self.layout.parts))))
        self.health = HealthWatch(self.engine)
        self.t_s = 0.0
        self.told: dict[tuple[str, str], float] = {}
        self.first_told: dict[tuple[str, str], float] = {}
        self.valid: dict[str, np.ndarray] = {}
        self.touched: dict[str, np.ndarray] = {}
        self.sweeps: dict[str, Sweep] = {}
        self.records: dict[str, Record] = {}
        self.calibrate(calibrate_s)
        self.run(settle_s)
        self.first_told.clear()

    @property
    def now_ns(self) -> int:
        return EPOCH_NS + round(self.t_s * 1e9)

    def calibrate(self, seconds: float) -> None:
        self.engine.begin_calibration(seconds)
        self.run(seconds + 0.3)
        self.engine.use(self.engine.end_calibration("2026-01-01T00:00:00+00:00"))

    def reload(self, values: dict[str, Any]) -> None:
        """Go on with other settings, as a daemon does that reads its configuration again."""
        settings = changed(self.engine.settings, values)
        self.layout = build_layout(settings, CONFIG.parent)
        self.engine = Engine(settings, self.layout, self.engine.parts, after=self.engine)
        self.health.use(self.engine)

    def inject(self, name: str, **arguments: Any) -> Callable[[], None]:
        """Make a fault happen now; what was told before is forgotten. The answer mends it."""
        mend = self.robot.inject(Fault(name=name, **arguments))
        self.first_told.clear()
        self.since_s = self.t_s
        return mend

    def status(self, board: str) -> np.ndarray:
        """Status words of a board's last sweep."""
        return self.sweeps[board].status

    def run(self, seconds: float, *, look_every: int = LOOK_EVERY) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.t_s += TICK_S
            for bus, batch in self.robot.step(TICK_S).items():
                if len(batch):
                    batch.t_ns[:] += EPOCH_NS - self.robot.t_ns + round(self.t_s * 1e9)
                    self._note(self.engine.feed(bus, batch))
            self._note(self.engine.expire(self.now_ns))
            if round(self.t_s / TICK_S) % look_every == 0:
                self._look()

    def touched_meanwhile(self, part: str, seconds: float) -> list[int]:
        """Let time pass; return how many taxels of a part were touched after each step of it."""
        found = []
        for _ in range(round(seconds / TICK_S)):
            self.run(TICK_S)
            found.append(int(np.count_nonzero(self.touched[part])))
        return found

    def _note(self, output: Output) -> None:
        self.health.note(output)
        for sweep in output.sweeps:
            self.sweeps[self.layout.boards[sweep.board].name] = sweep
        for frame in output.frames:
            self.valid[frame.part] = frame.valid
            self.touched[frame.part] = frame.touched

    def _look(self) -> None:
        self.health.tick(self.now_ns, {}, {})
        self.told = {}
        for part in self.engine.parts:
            record = self.health.record(part, self.now_ns, {}, {})
            for fault in record["faults"]:
                key = (fault["code"], fault["where"])
                self.told[key] = self.t_s
                self.first_told.setdefault(key, self.t_s)
            self.records[record["part"]] = record
