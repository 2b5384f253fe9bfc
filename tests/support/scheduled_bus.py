"""A python-can interface that plays frames of the emulator at their times, for ever.

A robot that costs nothing while it plays: the emulator has worked out the frames before. Like
a kernel's socket the bus keeps what is not read, stamped with the time it came. It is found
as the interface `scheduled`; its channel is a file that `record` has written.

    python -m tests.support.scheduled_bus run CONFIG

runs a `skin` command that knows this interface.
"""

import sys
import time
from pathlib import Path
from typing import Any, ClassVar

import can
import numpy as np
from can.interfaces import BACKENDS

from emulator.probes.scene import Scene
from emulator.robot import Robot
from skin_host.config.settings import Settings, load
from skin_host.layout import Layout, build_layout

INTERFACE = "scheduled"
_TICK_S = 0.02
_AT_ONCE_NS = 100_000


def record(
    settings: Settings, layout: Layout, scene: Scene, seconds: float, loop_s: float, folder: Path
) -> dict[str, Path]:
    """Work out what the boards send; return a file for each bus.

    Args:
        settings, layout, scene: of the robot.
        seconds: how much.
        loop_s: so much at the end is repeated; whole periods of all boards.
        folder: where the files go.
    """
    robot = Robot(settings, layout, scene)
    robot.bring_up()
    began_ns = robot.t_ns
    batches: dict[str, list[Any]] = {bus: [] for bus in settings.buses}
    while robot.t_ns - began_ns < seconds * 1e9:
        for bus, batch in robot.step(_TICK_S).items():
            batches[bus].append(
                [part.copy() for part in (batch.id, batch.dlc, batch.data, batch.t_ns)]
            )
    files = {}
    for bus, parts in batches.items():
        ids, dlc, data, t_ns = (np.concatenate(column) for column in zip(*parts, strict=True))
        files[bus] = folder / f"{bus}.npz"
        loop_ns = round(loop_s * 1e9)
        within = t_ns - began_ns < seconds * 1e9
        np.savez(
            files[bus],
            id=ids[within],
            dlc=dlc[within],
            data=data[within],
            t_ns=t_ns[within] - began_ns,
            loop_ns=np.int64(loop_ns),
            length_ns=np.int64(seconds * 1e9),
        )
    return files


def on_scheduled_buses(config: Path, scene: Scene, folder: Path) -> Path:
    """Rewrite a configuration's buses, of which only the channel is given, to play this scene."""
    settings = load(config)
    layout = build_layout(settings, config.parent)
    files = record(settings, layout, scene, 6.0, 4.0, folder)
    text = config.read_text()
    for bus, file in files.items():
        keys = f'interface = "{INTERFACE}"\nchannel = "{file}"'
        text = text.replace(f'[buses.{bus}]\nchannel = "{bus}"', f"[buses.{bus}]\n{keys}")
    config.write_text(text + "\n")
    return config


class ScheduledBus(can.BusABC):
    """See the module.

    Attributes:
        open_now: the buses that are open, by channel.
        removed: adapters that are not there, by channel.
        unplugged: nothing comes; what would have come is lost, as on a cable that is cut.
        given: frames that were read.
        longest_wait_s: of a frame, until it was read.
    """

    open_now: ClassVar[dict[str, "ScheduledBus"]] = {}
    removed: ClassVar[set[str]] = set()

    def __init__(self, channel: str, **_: Any) -> None:
        self.channel = channel
        self._is_shutdown = True  # nothing to complain of, if it is not there
        self._is_there(can.CanInitializationError)
        super().__init__(channel)
        self._is_shutdown = False
        with np.load(channel) as file:
            self._t_ns = file["t_ns"].tolist()
            self._loop_ns = int(file["loop_ns"])
            self._again = int(np.searchsorted(file["t_ns"], int(file["length_ns"]) - self._loop_ns))
            self._messages = [
                (int(identifier), row[:dlc].tobytes())
                for identifier, dlc, row in zip(file["id"], file["dlc"], file["data"], strict=True)
            ]
        self._origin_ns = time.monotonic_ns()
        self._offset_ns = 0
        self._next = 0
        self.unplugged = False
        self.given = 0
        self.longest_wait_s = 0.0
        self.open_now[channel] = self

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._is_there(can.CanOperationError)
        now_ns = time.monotonic_ns()
        while (due_ns := self._origin_ns + self._t_ns[self._next]) <= now_ns:
            identifier, data = self._messages[self._next]
            self._next += 1
            if self._next == len(self._messages):
                self._next = self._again
                self._origin_ns += self._loop_ns
            if self.unplugged:
                continue
            self.given += 1
            self.longest_wait_s = max(self.longest_wait_s, (now_ns - due_ns) * 1e-9)
            message = can.Message(
                timestamp=(due_ns + self._day_ns()) * 1e-9,
                arbitration_id=identifier,
                data=data,
                is_extended_id=False,
            )
            return message, False
        return None, False

    def _day_ns(self) -> int:
        """The clock of the day less our own. It may be set; the boards know nothing of it."""
        before_ns = time.monotonic_ns()
        day_ns = time.time_ns()
        # Whoever lost his turn between the two would see a step where there is none.
        if time.monotonic_ns() - before_ns < _AT_ONCE_NS or not self._offset_ns:
            self._offset_ns = day_ns - before_ns
        return self._offset_ns

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Boards that only play do not listen."""

    def _is_there(self, error: type[can.CanError]) -> None:
        if self.channel in self.removed:
            raise error("the adapter is gone")

    def shutdown(self) -> None:
        """Forget the bus."""
        self.open_now.pop(self.channel, None)
        super().shutdown()


def register() -> None:
    """Make the interface known to python-can."""
    BACKENDS[INTERFACE] = (__name__, ScheduledBus.__name__)
    can.VALID_INTERFACES = frozenset({*can.VALID_INTERFACES, INTERFACE})


def main() -> int:
    from skin_host.cli import main as skin

    register()
    return skin(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
