"""The grasp of the paper's section VII: fingers close on a fragile cup, with or without feedback.

Everything between skin and hand is real: the emulated hand sends its frames on CAN, a daemon
calibrates, decides and publishes over MQTT, and the hand subscribes to touches. Each finger closes
at a steady speed until a taxel of its tip is touched. The cup's wall yields like a spring and
buckles above a force; without feedback the fingers close as far as the paper's did.
"""

import asyncio
import contextlib
import tempfile
from dataclasses import dataclass, field

import can
import numpy as np

from emulator.probes.scene import Place, Probe, Scene
from emulator.robot import LiveProbe, Robot
from skin_host.client import SkinClient
from skin_host.config.settings import Settings, changed
from skin_host.daemon.daemon import Daemon
from skin_host.layout import TAXELS_PER_TRIANGLE, Layout
from skin_host.mqtt.broker import local_broker

HAND = "left_hand"
#: Triangles of the part: index, middle, thumb.
FINGERS = (0, 1, 4)
CALIBRATION_S = 2.0
CONTROL_S = 0.01
CLOSING_MM_PER_S = 10.0
#: The wall of a plastic cup: its spring, and the force of one finger at which it buckles.
CUP_MM_PER_N = 0.5
BUCKLES_N = 4.0
FINGERTIP_MM = 9.0
#: Without feedback, the fingers close this far beyond the wall.
BLIND_MM = 6.0
#: The paper's threshold is about 2.6 units, 6 kPa.
FELT_KPA = 6.0
PERIOD_S = 0.05
HOLD_S = 0.4
REST_S = 0.5


@dataclass(slots=True)
class Grasp:
    """One grasp.

    Attributes:
        feedback: whether touches stopped the fingers.
        peak_n: strongest force of each finger on the cup.
        late_s: by finger, how long it went on after the true pressure had passed 6 kPa.
        late_frames: by finger, how many frames of the part came in that time.
        activation_kpa: mean of what the host published for its touched taxels, at the end.
        intact: no finger made the cup buckle.
    """

    feedback: bool
    peak_n: list[float]
    late_s: list[float]
    late_frames: list[int]
    activation_kpa: float

    @property
    def intact(self) -> bool:
        """Return whether the cup is intact."""
        return max(self.peak_n) < BUCKLES_N


@dataclass(slots=True)
class _Felt:
    """Contacts received from the skin that have not ended, by their id."""

    contacts: dict[int, set[int]] = field(default_factory=dict)
    free: asyncio.Event = field(default_factory=asyncio.Event)
    frames: int = 0
    activation_kpa: float = 0.0

    def touches(self, triangle: int) -> bool:
        """Whether a finger is touched."""
        return any(triangle in triangles for triangles in self.contacts.values())


async def run(settings: Settings, layout: Layout, grasps: int) -> list[Grasp]:
    """Grasp cups, the first one without feedback, the others with it.

    Args:
        settings: a robot with a part `left_hand` whose triangles 0 to 4 are fingertips; its
            bus, broker and state are replaced by private ones.
        layout: of the same.
        grasps: how many with feedback.

    Raises:
        SkinError: no broker, or the daemon fails.
    """
    (name,) = settings.buses
    settings = changed(
        settings,
        {
            f"buses.{name}.interface": "virtual",
            f"buses.{name}.channel": "cup-grasp",
            "processing.calibration.seconds": CALIBRATION_S,
        },
    )
    robot = Robot(settings, layout, Scene(quiet=True))
    stop = asyncio.Event()
    async with contextlib.AsyncExitStack() as stack:
        state = stack.enter_context(tempfile.TemporaryDirectory())
        broker = await stack.enter_async_context(local_broker())
        settings = changed(settings, {"service.state_directory": state} | broker.settings)
        bus = stack.enter_context(can.Bus(interface="virtual", channel="cup-grasp"))
        living = asyncio.create_task(robot.run({name: bus}))
        daemon = Daemon(settings, layout)
        working = asyncio.create_task(daemon.run(stop, calibrate=True))
        url = f"mqtt://{broker.host}:{broker.port}"
        skin = await stack.enter_async_context(
            SkinClient(url, robot=settings.robot, protocol=broker.protocol)
        )
        felt = _Felt()
        listening = [
            asyncio.create_task(_hear_touches(skin, felt)),
            asyncio.create_task(_hear_frames(skin, felt)),
        ]
        try:
            while daemon.engine.calibration is None:
                await asyncio.sleep(0.1)
                if working.done():
                    working.result()
            hand = _Hand(robot, layout)
            rng = np.random.default_rng(7)
            return [
                await hand.grasp(felt, rng, feedback=number > 0) for number in range(grasps + 1)
            ]
        finally:
            stop.set()
            for task in (*listening, living):
                task.cancel()
            await asyncio.gather(working, living, *listening, return_exceptions=True)


async def _hear_touches(skin: SkinClient, felt: _Felt) -> None:
    async for touch in skin.touches(HAND):
        if touch.event == "end":
            felt.contacts.pop(touch.id, None)
        else:
            felt.contacts[touch.id] = {taxel // TAXELS_PER_TRIANGLE for taxel in touch.taxels}
        if felt.contacts:
            felt.free.clear()
        else:
            felt.free.set()


async def _hear_frames(skin: SkinClient, felt: _Felt) -> None:
    async for frame in skin.frames(HAND):
        felt.frames += 1
        pressed = frame.pressure_kpa[frame.pressure_kpa > FELT_KPA]
        felt.activation_kpa = float(pressed.mean()) if len(pressed) else 0.0


class _Hand:
    """Three fingers of the emulated hand around a cup."""

    def __init__(self, robot: Robot, layout: Layout) -> None:
        self._robot = robot
        self._start = layout.part(HAND).start
        self._tips: list[LiveProbe] = [
            robot.touch(
                Probe(
                    part=HAND,
                    at=Place(triangle=finger),
                    diameter_mm=FINGERTIP_MM,
                    depth_mm=[(0.0, 0.0)],
                    compliance_mm_per_n=CUP_MM_PER_N,
                )
            )
            for finger in FINGERS
        ]

    async def grasp(self, felt: _Felt, rng: np.random.Generator, *, feedback: bool) -> Grasp:
        """Close the fingers, hold, release and rest."""
        # Each finger starts at a different distance from the wall.
        closed_mm = -rng.uniform(1.0, 4.0, len(FINGERS))
        n = len(FINGERS)
        result = Grasp(feedback, [0.0] * n, [0.0] * n, [0] * n, 0.0)
        moving = set(range(n))
        passed_at: dict[int, int] = {}
        loop = asyncio.get_running_loop()
        end_s = loop.time() + HOLD_S
        last_s = loop.time()
        while moving or loop.time() < end_s:
            await asyncio.sleep(CONTROL_S)
            # A controller that was held up does not jump.
            passed_s, last_s = min(loop.time() - last_s, 2 * CONTROL_S), loop.time()
            for finger in sorted(moving):
                closed_mm[finger] += CLOSING_MM_PER_S * passed_s
                if self._pressure_kpa(finger) > FELT_KPA:
                    result.late_s[finger] += passed_s
                    passed_at.setdefault(finger, felt.frames)
                    result.late_frames[finger] = felt.frames - passed_at[finger]
                if (feedback and felt.touches(FINGERS[finger])) or closed_mm[finger] >= BLIND_MM:
                    moving.discard(finger)
                    end_s = loop.time() + HOLD_S
                self._tips[finger].press(max(0.0, float(closed_mm[finger])))
            for finger, tip in enumerate(self._tips):
                result.peak_n[finger] = max(result.peak_n[finger], tip.force_n)
        result.activation_kpa = felt.activation_kpa
        for tip in self._tips:
            tip.lift()
        # The foam needs its time after a strong grasp; the next one begins untouched.
        await asyncio.sleep(REST_S)
        await felt.free.wait()
        return result

    def _pressure_kpa(self, finger: int) -> float:
        first = TAXELS_PER_TRIANGLE * FINGERS[finger]
        pressure = self._robot.true_pressure_kpa(HAND)
        return float(pressure[first : first + TAXELS_PER_TRIANGLE].max())
