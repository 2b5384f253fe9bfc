"""Robot and daemon in one process: what python-can's virtual bus needs.

    python -m tests.support.one_process emulate CONFIG [--scene SCENE] -- run CONFIG ...

Runs `skin emulate` and the second `skin` command side by side, each in its own thread's
loop, and ends with the status of the second one.
"""

import asyncio
import sys
import threading
from pathlib import Path

import can

from emulator.probes.scene import Scene
from emulator.probes.scene import load as load_scene
from emulator.robot import Robot
from skin_host.cli import main as skin
from skin_host.cli.common import load_skin


def emulate(arguments: list[str], stop: threading.Event) -> None:
    settings, layout = load_skin(Path(arguments[0]))
    scene = load_scene(Path(arguments[1])) if len(arguments) > 1 else Scene(quiet=True)
    robot = Robot(settings, layout, scene)

    async def work() -> None:
        buses = {
            name: can.Bus(interface=bus.interface, channel=bus.channel)
            for name, bus in settings.buses.items()
        }
        running = asyncio.create_task(robot.run(buses))
        await asyncio.to_thread(stop.wait)
        failed = running.done()
        running.cancel()
        (result,) = await asyncio.gather(running, return_exceptions=True)
        if failed:
            assert result is not None
            raise result
        for bus in buses.values():
            bus.shutdown()

    asyncio.run(work())


def main() -> int:
    split = sys.argv.index("--")
    stop = threading.Event()
    robot = threading.Thread(target=emulate, args=(sys.argv[1:split], stop))
    robot.start()
    try:
        return skin(sys.argv[split + 1 :])
    finally:
        stop.set()
        robot.join()


if __name__ == "__main__":
    sys.exit(main())
