"""Live servers for the viewers of robotics: Foxglove's WebSocket, and Rerun's own viewer.

They are subscribers like the page, and show the items of `scene`.
"""

import asyncio
import contextlib
import os
import secrets
import signal
import sys
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np

from skin_host.client import Described, Frame, SkinClient
from skin_host.clock import SYSTEM, Clock
from skin_host.errors import SkinError, required
from skin_host.mqtt.broker import free_port
from skin_host.mqtt.info import FingertipInfo, PartInfo
from skin_host.processing.events import LATEST_NS, Touch
from skin_host.recording.export.scene import (
    Item,
    RerunStream,
    SkinScene,
    event_line,
    foxglove_message,
    transforms,
)
from skin_host.recording.export.series import health_line
from skin_host.tasks import until

FOXGLOVE_PORT = 8765
RERUN_PORT = 9090
#: The transforms are sent again this often, for viewers that came later.
TRANSFORMS_S = 1.0
#: Rerun's server answers within this time.
STARTING_S = 30.0

#: Takes the scene when it is known, and each that follows it; returns what shows its items.
Show = Callable[[SkinScene], Callable[[Item], None]]
#: A viewer's server while it runs: its URL, and how it shows.
Serving = AbstractAsyncContextManager[tuple[str, Show]]


async def run(
    broker: str,
    robot: str | None,
    stop: asyncio.Event,
    serving: Serving,
    show_url: Callable[[str], None],
    clock: Clock = SYSTEM,
) -> None:
    """Show a robot's skin in a viewer until `stop`.

    The viewer is `foxglove` or `rerun`; `show_url` receives its URL.

    Raises:
        SkinError: no broker, no robot, a port that is taken, or a package that is not installed.
    """

    async def show() -> None:
        async with SkinClient(broker, robot=robot) as skin:
            await skin.info()
            async with serving as (url, begin):
                view = _View(begin, clock)
                view.lay_out(skin.parts(), [])
                show_url(url)
                await _follow(skin, view, clock)

    await until(stop, show())


class _View:
    """What is shown of a robot's parts, as they are described now.

    Attributes:
        shapes: where the taxels of each part of skin are.
        scene: makes the items.
        show: shows an item.
    """

    def __init__(self, begin: Show, clock: Clock) -> None:
        self._begin = begin
        self._clock = clock
        self._infos: dict[str, PartInfo | FingertipInfo] | None = None
        #: By part: the time in its last message that has one, and when that came by our clock.
        self._last: dict[str, tuple[int, int]] = {}
        self.shapes: dict[str, PartInfo] = {}

    def lay_out(self, parts: Mapping[str, Described], touches: Iterable[Touch]) -> None:
        """Begin again with these parts, if they are others, and what touches them."""
        infos = {name: one.info for name, one in parts.items() if one.info is not None}
        if infos == self._infos:
            return
        for name in (self._infos or {}).keys() - infos.keys():
            self.show_unknown(name)
        self._infos = infos
        self.shapes = {name: one for name, one in infos.items() if isinstance(one, PartInfo)}
        tips = {name: one for name, one in infos.items() if isinstance(one, FingertipInfo)}
        self.scene = SkinScene(self.shapes, fingertips=tips)
        self.show = self._begin(self.scene)
        for touch in touches:
            self.show_touch(touch)

    def show_frame(self, frame: Frame) -> None:
        """Show the pressures of a part that is described as the frame has it."""
        shape = self.shapes.get(frame.part)
        if shape is not None and len(frame.valid) == len(shape.pads):
            self._note_time(frame)
            kpa = np.where(frame.valid, frame.pressure_kpa, np.nan)
            self.show(self.scene.points(frame.part, frame.t_ns, kpa, frame.beyond_range))

    def show_touch(self, touch: Touch) -> None:
        if touch.part in self.scene.origins_m:
            self._note_time(touch)
            self.show(self.scene.arrows(touch.part, touch.t_ns, [touch]))

    def show_untouched(self, part: str) -> None:
        now_ns = self._now_ns(part)
        if now_ns is not None and part in self.scene.origins_m:
            self.show(self.scene.untouched(part, now_ns))

    def show_unknown(self, part: str) -> None:
        """Show that nothing is known of a part: it must not go on looking as it was last."""
        now_ns = self._now_ns(part)
        if now_ns is None:
            return
        if part in self.shapes:
            self.show(self.scene.unknown(part, now_ns))
        if part in self.scene.origins_m:
            self.show(self.scene.untouched(part, now_ns, is_known=False))

    def _note_time(self, item: Frame | Touch) -> None:
        self._last[item.part] = item.t_ns, self._clock.monotonic_ns()

    def _now_ns(self, part: str) -> int | None:
        """Return the time by the robot's clock, as far as a part shows it; None: nothing was shown
        of it.
        """
        if part not in self._last:
            return None
        t_ns, came_ns = self._last[part]
        return min(t_ns + max(1, self._clock.monotonic_ns() - came_ns), LATEST_NS)


async def _follow(skin: SkinClient, view: _View, clock: Clock) -> None:
    """Show what comes, until cancelled."""

    async def infos() -> None:
        async for _ in skin.infos():
            view.lay_out(skin.parts(), skin.present())

    async def frames() -> None:
        async for frame in skin.frames():
            view.show_frame(frame)

    async def events() -> None:
        async for event in skin.events():
            if isinstance(event, Touch):
                view.show_touch(event)
            line = event_line(event)
            if line is not None:
                view.show(line)

    async def contacts() -> None:
        async for contact in skin.contacts():
            if contact.state == "OFF":
                view.show_untouched(contact.part)
            elif contact.why not in (None, "not_felt"):
                view.show_unknown(contact.part)

    async def health() -> None:
        latest: dict[str, str] = {}
        async for said in skin.health():
            if said.stored:
                continue  # it may be from any time, and shows nothing of now
            line = health_line(said.part, clock.now_ns(), said.record)
            if latest.get(said.part) != line.text:
                latest[said.part] = line.text
                view.show(line)

    async with asyncio.TaskGroup() as group:
        for follow in (infos, frames, events, contacts, health):
            group.create_task(follow())


@asynccontextmanager
async def foxglove(host: str, port: int | None) -> AsyncIterator[tuple[str, Show]]:
    """Serve Foxglove's WebSocket, which its app opens; port 0 is any free one.

    Raises:
        SkinError: the port is taken, or the extra `foxglove` is not installed.
    """
    sdk = required("foxglove", "views in Foxglove", "foxglove")
    required("foxglove_schemas_protobuf", "views in Foxglove", "foxglove")
    context = sdk.Context()
    wanted = FOXGLOVE_PORT if port is None else port
    try:
        server = sdk.start_server(name="skin-host", host=host, port=wanted, context=context)
    except (RuntimeError, OSError) as error:
        raise SkinError(f"{host}:{wanted}: {error}; choose another --host or --port") from None
    channels: dict[str, Any] = {}
    try:
        yield (
            f"ws://{host}:{server.port} in Foxglove",
            lambda scene: _Foxglove(sdk, context, channels, scene),
        )
    finally:
        server.stop()


class _Foxglove:
    """Sends items of a scene on channels of a context; a channel is made when its first message
    comes.
    """

    def __init__(self, sdk: Any, context: Any, channels: dict[str, Any], scene: SkinScene) -> None:
        self._sdk = sdk
        self._context = context
        self._scene = scene
        self._channels = channels
        self._sent_ns = 0

    def __call__(self, item: Item) -> None:
        if abs(item.t_ns - self._sent_ns) > TRANSFORMS_S * 1e9:
            self._sent_ns = item.t_ns
            self._send("/tf", item.t_ns, transforms(self._scene, item.t_ns))
        self._send(*foxglove_message(item))

    def _send(self, topic: str, t_ns: int, message: Any) -> None:
        from mcap_protobuf.schema import build_file_descriptor_set

        if topic not in self._channels:
            kind = type(message)
            schema = self._sdk.Schema(
                name=kind.DESCRIPTOR.full_name,
                encoding="protobuf",
                data=build_file_descriptor_set(kind).SerializeToString(),
            )
            self._channels[topic] = self._sdk.Channel(
                topic, schema=schema, message_encoding="protobuf", context=self._context
            )
        self._channels[topic].log(message.SerializeToString(), log_time=t_ns)


@asynccontextmanager
async def rerun(host: str, port: int | None) -> AsyncIterator[tuple[str, Show]]:
    """Serve Rerun's viewer to browsers.

    Its command line serves, bound to `host`, as the functions of its SDK that serve bind to all
    addresses. Its analytics are off; those of the viewer in the browser cannot be turned off.

    Raises:
        SkinError: its server does not start, or the extra `rerun` is not installed.
    """
    rr = required("rerun", "views in Rerun", "rerun")
    page, feed = RERUN_PORT if port is None else port or free_port(host), free_port(host)
    url = f"rerun+http://{host}:{feed}/proxy"
    program = await asyncio.create_subprocess_exec(
        *(str(Path(sys.executable).with_name("rerun")), "--serve-web", "--bind", host),
        *("--port", str(feed), "--web-viewer-port", str(page), "--hide-welcome-screen"),
        env=os.environ | {"RERUN_ANALYTICS": "0", "DO_NOT_TRACK": "1"},
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
        # Its script waits for the program proper and does not end it: signals go to both.
        start_new_session=True,
    )
    stream = rr.RecordingStream("skin-host", recording_id=secrets.token_hex(8))
    try:
        await _answers(program, host, (feed, page))
        stream.connect_grpc(url)
        yield f"http://{host}:{page}/?url={url}", lambda scene: RerunStream(stream, scene).show
    finally:
        stream.disconnect()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.pid, signal.SIGTERM)
        await program.wait()


async def _answers(program: asyncio.subprocess.Process, host: str, ports: tuple[int, ...]) -> None:
    try:
        async with asyncio.timeout(STARTING_S):
            for port in ports:
                while True:
                    if program.returncode is not None:
                        raise SkinError(
                            f"{host}:{port}: rerun ended with {program.returncode}; "
                            "choose another port with --port"
                        )
                    try:
                        _, writer = await asyncio.open_connection(host, port)
                    except OSError:
                        await asyncio.sleep(0.1)
                        continue
                    writer.close()
                    break
    except TimeoutError:
        raise SkinError(f"{host}:{port}: rerun does not answer; wanted its viewer there") from None
