"""What strangers can send us, one function an entry: bytes in, nothing but our own errors out."""

import asyncio
import contextlib
import tempfile
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from skin_host.bus.boards import Boards
from skin_host.bus.wire import FrameBatch
from skin_host.clock import SYSTEM
from skin_host.config.settings import Settings, changed, load, skin_hash
from skin_host.daemon.control import Control
from skin_host.daemon.state import NodeState, load_kept
from skin_host.errors import NewerFileError, RequestError, SkinError
from skin_host.health import HealthWatch
from skin_host.layout import Layout, build_layout
from skin_host.mqtt.commands import CommandHandler, decode_result
from skin_host.processing.calibration.file import load_calibration
from skin_host.processing.core import Engine

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
#: A frame of the fuzzer: identifier (4), dlc (1), data (8), pause before it (1).
FRAME_BYTES = 14
PAUSE_NS = 1_000_000
COMMANDS = (
    "calibrate",
    "configure",
    "disable",
    "enable",
    "raw",
    "record",
    "reload",
    "status",
    "stop_recording",
    "thresholds",
    "no-such",
)


@cache
def skin() -> tuple[Settings, Layout]:
    settings = load(CONFIG)
    return settings, build_layout(settings, CONFIG.parent)


@cache
def folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="skin-fuzz-"))


class _Port:
    async def send(self, frames: Any, gap_s: float = 0.0) -> None:
        for _ in frames:
            await asyncio.sleep(0)


class Buses:
    """Everything between CAN and health, fed with whatever comes."""

    def __init__(self) -> None:
        settings, layout = skin()
        self.engine = Engine(settings, layout, list(range(len(layout.parts))))
        self.engine.begin_calibration(0.5)
        self.health = HealthWatch(self.engine)
        boards = [(i, layout.boards[i]) for i in self.engine.boards]
        self.boards = Boards("can0", _Port(), boards, layout.triangles, self.engine.ledger)
        self.t_ns = 1_700_000_000_000_000_000
        self.frames = 0

    def feed(self, data: bytes) -> None:
        n = len(data) // FRAME_BYTES
        if not n:
            return
        rows = np.frombuffer(data[: n * FRAME_BYTES], np.uint8).reshape(n, FRAME_BYTES)
        t_ns = self.t_ns + np.cumsum(rows[:, 13].astype(np.int64) * PAUSE_NS)
        self.t_ns = int(t_ns[-1])
        batch = FrameBatch(
            rows[:, :4].copy().view("<u4").ravel(), rows[:, 4], rows[:, 5:13].copy(), t_ns
        )
        for output in (self.engine.feed("can0", batch), self.engine.expire(self.t_ns)):
            self.boards.note_answers(output.answers)
            self.health.note(output)
            for frame in output.frames:
                assert np.isfinite(frame.pressure_kpa).all()
                assert not frame.touched[~frame.valid].any()
        if self.engine.calibrating and self.engine.calibration_progress() >= 1.0:
            self.engine.use(self.engine.end_calibration("2026-01-01T00:00:00+00:00"))
        self.frames += n
        assert self.engine.assemblers["can0"].counters.frames == self.frames

    def look(self) -> None:
        self.health.tick(self.t_ns, {}, {"can0": self.boards})
        for part in self.engine.parts:
            self.health.record(part, self.t_ns, {}, {"can0": self.boards})


def configuration(data: bytes) -> None:
    path = folder() / "fuzz.toml"
    path.write_bytes(data)
    with contextlib.suppress(RequestError):
        build_layout(load(path), folder())


def calibration_file(data: bytes) -> None:
    path = folder() / "fuzz.json"
    path.write_bytes(data)
    settings, layout = skin()
    with contextlib.suppress(RequestError):
        load_calibration(path, layout, skin_hash(settings))


def state_file(data: bytes) -> None:
    path = folder() / "state.json"
    path.write_bytes(data)
    with contextlib.suppress(NewerFileError):
        load_kept(path, NodeState)


class Commands:
    """The handler and the control of a daemon that does nothing."""

    def __init__(self) -> None:
        settings, layout = skin()
        settings = changed(settings, {"service.state_directory": str(folder())})
        engine = Engine(settings, layout, list(range(len(layout.parts))))

        async def calibrate(*_: Any) -> Any:
            raise SkinError("not here")

        async def nothing(*_: Any) -> list[str]:
            return []

        daemon: Any = SimpleNamespace(
            clock=SYSTEM,
            settings=settings,
            layout=layout,
            engine=engine,
            calibrate=calibrate,
            configure=nothing,
            reload=nothing,
            is_reloading=False,
            disable=engine.disabled.add,
            enable=engine.disabled.discard,
            thresholds=load_kept(folder() / "none", NodeState).thresholds,
            set_thresholds=lambda new: setattr(daemon, "thresholds", new),
            keeper=SimpleNamespace(keep_state=nothing),
            status=dict,
            publisher=SimpleNamespace(show_raw=lambda _: None),
        )
        self.control = Control(daemon)
        self.answered = 0

    async def take(self, name: str, payload: bytes) -> None:
        """Give one request to a handler that has time for it; it must be answered."""
        answers: list[bytes] = []
        handler = CommandHandler(self.control.handle)
        handler.take(name, payload, answers.append)
        running = list(handler._running)
        if running:
            await asyncio.wait(running)
        (answer,) = answers
        result = decode_result(answer)
        assert result.ok or (result.error and "see the log" not in result.error), result
        self.answered += 1
        if self.control.recorder is not None:
            await self.control.close()
            self.control.recorder.path.unlink(missing_ok=True)
            self.control.recorder = None
