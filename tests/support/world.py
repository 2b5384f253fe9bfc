"""What a reader of the documentation has before them: a broker, a robot, a daemon, files.

The robot `demo` lives with its daemon on one bus, another one without on a second, for
commands that bring boards up themselves.
"""

import asyncio
import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can

from emulator.probes.scene import Place, Probe, Scene
from emulator.robot import Robot
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Bus, load
from skin_host.layout import build_layout
from skin_host.mqtt.frames import encode_frame
from skin_host.mqtt.info import encode_info, node_info
from skin_host.mqtt.messages import encode_event
from skin_host.processing.calibration.file import save_calibration
from skin_host.processing.core import Engine
from skin_host.recording.capture import CanLog
from skin_host.recording.mcap import Recorder
from skin_host.recording.replay import calibrate_from_log, read_buses
from tests.support.broker import Mosquitto
from tests.support.live import FINGER_N, Live, living
from tests.support.pages import ROOT
from tests.support.waiting import PATIENCE_S

SAMPLES = ROOT.parent / "shared" / "data"
CONFIG = ROOT / "config" / "demo.toml"
_numbers = itertools.count()


def pressed_from(start_s: float) -> Scene:
    """A finger presses the thumb, again and again."""
    press = Probe(
        part="left_hand",
        at=Place(triangle=4),
        diameter_mm=10,
        pressure_kpa=[(0, 0), (0.1, 60), (0.5, 60), (0.6, 0)],
        start_s=start_s,
        repeat_s=1,
    )
    return Scene(quiet=True, probe=[press])


async def _press(live: Live) -> None:
    """A finger presses again and again from now on, when the skin is calibrated."""
    finger = live.finger()
    while True:
        finger.press(FINGER_N)
        await asyncio.sleep(0.5)
        finger.lift()
        await asyncio.sleep(0.5)


class World:
    """Where it all is.

    Attributes:
        broker: URL of the broker of the living robot.
        robot: the configuration of the one that lives.
        bare: that of one without a daemon.
        empty: that of one that is not there: nobody is on its bus.
    """

    def __init__(self, folder: Path, state: Path, broker: Mosquitto) -> None:
        self.broker = f"mqtt://{broker.host}:{broker.port}"
        self.folder = folder
        self.state = state
        self.number = next(_numbers)
        self.robot = self._configuration("robot", broker.port)
        self.bare = self._configuration("bare", broker.port)
        self.empty = self._configuration("empty", broker.port)

    def channel(self, name: str) -> str:
        return f"world-{self.number}-{name}"

    def _configuration(self, name: str, port: int) -> Path:
        text = CONFIG.read_text().replace('"skin-demo"', f'"{self.channel(name)}"')
        # Half as many frames are as true, and leave the machine time for the rest.
        text = text.replace('bus = "can0"\naddress', 'bus = "can0"\nperiod_ms = 100\naddress')
        if name != "robot":  # the one that lives is `demo`
            text = text.replace('robot = "demo"', f'robot = "{name}"')
        text += f'\n[mqtt]\nhost = "127.0.0.1"\nport = {port}\n'
        text += f'\n[service]\nstate_directory = "{self.state}"\n'
        path = self.folder / f"{name}.toml"
        path.write_text(text)
        return path

    def write_recordings(self) -> None:
        """Some seconds of the robot as CAN frames and as what it says."""
        settings = load(self.robot)
        layout = build_layout(settings, self.folder)
        robot = Robot(settings, layout, pressed_from(8.0))
        robot.bring_up()
        since_ns = 1_763_700_000_000_000_000
        log, blf = self.folder / "grasp.log", self.folder / "grasp.blf"
        with CanLog(log) as frames, CanLog(blf) as same:
            for _ in range(90):
                batch = robot.step(0.1)["can0"]
                later = FrameBatch(batch.id, batch.dlc, batch.data, batch.t_ns + since_ns)
                for sink in (frames, same):
                    sink.put(self.channel("robot"), later)
        found = calibrate_from_log(log, settings, layout, 5.0)
        save_calibration(self.folder / "robot-main.calibration.json", found, layout)
        engine = Engine(settings, layout, [0, 1], found)
        info = node_info(layout, "main", version="1", configuration="x")
        with Recorder(self.folder / "grasp.mcap") as recorder:
            recorder.say("skin/demo/nodes/main/info", since_ns, encode_info(info))
            for bus, batch in read_buses(log, settings):
                recorder.can(self.channel("robot"), batch)
                for step in engine.feed(bus, batch).steps:
                    topic = f"skin/demo/{step.frame.part}"
                    payload = encode_frame(step.frame)
                    recorder.say(f"{topic}/frame", step.frame.t_ns, payload)
                    for i, event in enumerate(step.events):
                        payload = encode_event(event, i + 1)
                        recorder.say(f"{topic}/touch", event.t_ns, payload)

    def write_imports(self) -> None:
        """The sample files of an iCub under the names that the documentation uses."""
        spec = (SAMPLES / "icub_genova11_left_arm_skinSpec.xml").read_bytes()
        for name in ("left_arm-skinSpec.xml", "left_arm-eb24-j4_7-skin.xml"):
            (self.folder / name).write_bytes(spec)
        for name, sample in {
            "left_forearm.ini": "icub_left_forearm_V2_gui.ini",
            "left_forearm.txt": "icub_left_forearm_V2_positions.txt",
        }.items():
            (self.folder / name).write_bytes((SAMPLES / sample).read_bytes())
        for part, card, unit in (("hand", 14, "palmL 8"), ("arm", 11, "triangle_10pad 1")):
            (self.folder / f"left_{part}.ini").write_text(
                f"robotPart left_{part}\ncardid {card}\n[SENSORS]\n{unit} 0 0 0 1 0 0\n"
            )
        (self.folder / "skinManAll.ini").write_text("addThreshold 2\n")

    @contextmanager
    def alive(self) -> Iterator[None]:
        """Robots and daemon live in a thread of their own until the block is left."""
        ready = threading.Event()
        loop = asyncio.new_event_loop()
        end = asyncio.Event()
        thread = threading.Thread(target=lambda: loop.run_until_complete(self._live(ready, end)))
        thread.start()
        try:
            assert ready.wait(PATIENCE_S)
            yield
        finally:
            loop.call_soon_threadsafe(end.set)
            thread.join()
            loop.close()

    async def _live(self, ready: threading.Event, end: asyncio.Event) -> None:
        settings = load(self.bare)
        alone = Robot(settings, build_layout(settings, self.folder), Scene(quiet=True))
        with can.Bus(interface="virtual", channel=self.channel("bare")) as bus:
            body = asyncio.create_task(alone.run({"can0": bus}))
            async with living(
                Bus(interface="virtual", channel=self.channel("robot")),
                self.state,
                port=int(self.broker.rpartition(":")[2]),
                config=self.robot,
            ) as live:
                finger = asyncio.create_task(_press(live))
                ready.set()
                await end.wait()
            for task in (body, finger):
                task.cancel()
            await asyncio.gather(body, finger, return_exceptions=True)
