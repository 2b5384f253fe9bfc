"""Commands to a running daemon: validates, carries out and answers requests.

Requests come from the network. Each has a type; a request that does not fit it is refused with a
line that gives the reason. `docs/operations.md` lists the commands.
"""

import asyncio
import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from typing import Annotated, Any, Protocol, TypeVar

import msgspec
from msgspec import Meta, Struct

from skin_host.clock import Clock
from skin_host.config.explain import explain
from skin_host.config.settings import Settings
from skin_host.daemon import service
from skin_host.daemon.calibrate import touched_meanwhile
from skin_host.daemon.keeper import Keeper
from skin_host.daemon.state import NodeState, Thresholds
from skin_host.errors import BusError, RequestError, SkinError, StateError
from skin_host.layout import Layout
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.calibration import Calibration
from skin_host.processing.calibration.outcome import Outcome, outcome
from skin_host.processing.core import Engine
from skin_host.recording.capture import FrameRecorder
from skin_host.untrusted import from_json

log = logging.getLogger(__name__)

#: Only characters that cannot leave the folder of recordings.
_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
MAX_RECORDING_BYTES = 4 * 1024**3

Seconds = Annotated[float, Meta(ge=0.1, le=600.0)]
Text = Annotated[str, Meta(max_length=64)]
Answer = Mapping[str, Any]


class _Request(Struct, forbid_unknown_fields=True, kw_only=True):
    id: Text | int | None = None


class _Calibrate(_Request):
    seconds: Seconds | None = None
    part: Text | None = None
    board: Text | None = None


class _Parts(_Request):
    part: Text


class _Raw(_Request):
    seconds: Annotated[float, Meta(ge=0.0, le=600.0)] = 0.0


class _Thresholds(_Request):
    set: Thresholds | None = None
    reset: bool = False


class _Configure(_Request):
    board: Text | None = None


class _Record(_Request):
    file: Text | None = None
    seconds: Annotated[float, Meta(ge=0.1, le=86_400.0)] = 60.0
    max_bytes: Annotated[int, Meta(ge=1000, le=MAX_RECORDING_BYTES)] = 1024**3


R = TypeVar("R", bound=_Request)
#: Commands that change nothing unless the request has keys.
_READING = frozenset({"status", "thresholds"})


class _Node(Protocol):
    """The interface that commands need; see `daemon.Daemon`."""

    clock: Clock
    settings: Settings
    layout: Layout
    engine: Engine
    publisher: Publisher
    thresholds: Thresholds
    keeper: Keeper

    @property
    def is_reloading(self) -> bool: ...
    async def calibrate(self, seconds: float, boards: list[int] | None = None) -> Calibration: ...
    async def configure(self, boards: list[int] | None = None) -> list[str]: ...
    async def reload(self) -> None: ...
    def disable(self, part: int) -> None: ...
    def enable(self, part: int) -> None: ...
    def set_thresholds(self, thresholds: Thresholds) -> None: ...
    def status(self) -> Mapping[str, Any]: ...


class Control:
    """Carries out commands on a daemon."""

    def __init__(self, daemon: _Node) -> None:
        self._daemon = daemon
        self.recorder: FrameRecorder | None = None
        self._starting = asyncio.Lock()
        self._commands: dict[str, Callable[[bytes], Awaitable[Answer]]] = {
            "calibrate": self._calibrate,
            "configure": self._configure,
            "disable": self._disable,
            "enable": self._enable,
            "raw": self._raw,
            "record": self._record,
            "reload": self._reload,
            "status": self._status,
            "stop_recording": self._stop_recording,
            "thresholds": self._set_thresholds,
        }

    async def handle(self, name: str, payload: bytes) -> Answer:
        """Carry out a request and return its result.

        Raises:
            RequestError: it is wrong; one line gives the reason, as with the others.
            StateError: it came at a wrong moment; nothing was done.
            SkinError: it failed.
        """
        command = self._commands.get(name)
        if command is None:
            raise RequestError(f'no command "{name}"; there are: {", ".join(self._commands)}')
        if not payload and name not in _READING:
            raise RequestError(
                "an empty request is refused: it is also what clears a retained one; wanted {}"
            )
        return await command(payload or b"{}")

    async def calibrate(self, seconds: float, boards: list[int] | None = None) -> Outcome:
        """Let the daemon calibrate, see there; return what was found, and log what touched it."""
        daemon = self._daemon
        engine, layout = daemon.engine, daemon.layout
        parts, tips, before = engine.parts, engine.fingertips, engine.calibration
        found = await daemon.calibrate(seconds, boards)
        zeroed = () if tips is None or boards is not None else tuple(tips.tips)
        # A large skin takes a while, in which the boards' frames must be read.
        known = await daemon.clock.in_thread(outcome, found, layout, parts, boards, zeroed, before)
        touched = touched_meanwhile(known, "repeat with `skin command calibrate`")
        if touched is not None:
            log.warning("%s", touched)
        return known

    async def close(self) -> None:
        """End a recording in progress."""
        if self.recorder is not None:
            self.recorder.finish()
            await self.recorder.finished()

    async def _calibrate(self, payload: bytes) -> Answer:
        request = _decode(payload, _Calibrate)
        daemon = self._daemon
        layout = daemon.layout
        if request.part is not None and request.board is not None:
            raise RequestError("part and board: wanted one of them")
        boards = None
        if request.board is not None:
            boards = [self._board(request.board)]
        elif request.part is not None:
            boards = list(layout.parts[self._part(request.part)].boards)
        seconds = request.seconds or daemon.settings.processing.calibration.seconds
        answer = await self.calibrate(seconds, boards)
        return {**answer, "kept": "calibration" not in daemon.keeper.unkept}

    async def _status(self, payload: bytes) -> Answer:
        _decode(payload, _Request)
        return self._daemon.status()

    async def _raw(self, payload: bytes) -> Answer:
        seconds = _decode(payload, _Raw).seconds
        self._daemon.publisher.show_raw(seconds)
        return {"seconds": seconds}

    async def _disable(self, payload: bytes) -> Answer:
        name = _decode(payload, _Parts).part
        self._daemon.disable(self._part(name))
        return await self._keep()

    async def _enable(self, payload: bytes) -> Answer:
        name = _decode(payload, _Parts).part
        self._daemon.enable(self._part(name))
        return await self._keep()

    async def _set_thresholds(self, payload: bytes) -> Answer:
        request = _decode(payload, _Thresholds)
        daemon = self._daemon
        changes = {} if request.set is None else msgspec.structs.asdict(request.set)
        if request.reset or request.set is not None:
            known = {} if request.reset else msgspec.structs.asdict(daemon.thresholds)
            wanted = known | {key: value for key, value in changes.items() if value is not None}
            daemon.set_thresholds(Thresholds(**wanted))
        answer = dict(await self._keep()) if request.reset or request.set is not None else {}
        touch = msgspec.to_builtins(daemon.settings.processing.touch)
        pipeline = daemon.engine.pipeline
        decides = {
            name: None if pipeline is None else round(pipeline.decides_kpa(i), 1)
            for name, i in self._parts().items()
        }
        return answer | {"touch": touch, "decides_kpa": decides}

    async def _configure(self, payload: bytes) -> Answer:
        request = _decode(payload, _Configure)
        boards = None if request.board is None else [self._board(request.board)]
        try:
            sent = await self._daemon.configure(boards)
        except BusError as error:
            raise SkinError(f"not all boards were set up: {error}") from None
        return {"boards": sent}

    async def _reload(self, payload: bytes) -> Answer:
        _decode(payload, _Request)
        if self._daemon.is_reloading:  # commands that wait would leave no room for others
            raise StateError(
                "the configuration is being read again already; ask again when that has ended"
            )
        await self._daemon.reload()
        return {"configuration": self._daemon.engine.configuration}

    async def _record(self, payload: bytes) -> Answer:
        request = _decode(payload, _Record)
        name = request.file
        if name is None:
            name = self._daemon.clock.today().strftime("%Y%m%dT%H%M%SZ.log")
        if not _FILE.fullmatch(name):
            raise RequestError(
                f'file: "{name[:64]}": wanted a plain name of letters, digits, ".", "_" and "-"'
            )
        if "." not in name:
            name += ".log"
        folder = service.state_directory(self._daemon.settings.service.state_directory)
        clock = self._daemon.clock
        path = folder / "recordings" / name
        async with self._starting:
            if self.recorder is not None and self.recorder.ended is None:
                raise StateError(f"{self.recorder.path.name} is being recorded already; stop it")
            self.recorder = await clock.in_thread(
                FrameRecorder, path, request.seconds, request.max_bytes, clock
            )
        log.info("recording to %s for %g s", path, request.seconds)
        return {"file": str(path), "seconds": request.seconds}

    async def _stop_recording(self, payload: bytes) -> Answer:
        _decode(payload, _Request)
        recorder = self.recorder
        if recorder is None:
            raise StateError("nothing is being recorded")
        recorder.finish()
        await recorder.finished()
        return {
            "file": str(recorder.path),
            "frames": recorder.frames,
            "lost": recorder.lost,
            "ended": recorder.ended,
        }

    async def _keep(self) -> Answer:
        """Store what operators changed; report it if that failed. The disk may be slow."""
        daemon = self._daemon
        state = NodeState(
            disabled=[daemon.layout.parts[i].name for i in sorted(daemon.engine.disabled)],
            thresholds=daemon.thresholds,
        )
        kept = await daemon.keeper.keep_state(state)
        return {"disabled": state.disabled, "kept": kept}

    def _parts(self) -> dict[str, int]:
        """Return the indices of the node's parts by their names."""
        return {self._daemon.layout.parts[i].name: i for i in self._daemon.engine.parts}

    def _part(self, name: str) -> int:
        names = self._parts()
        if name not in names:
            raise RequestError(f'no part "{name}" here; there are: {", ".join(names)}')
        return names[name]

    def _board(self, name: str) -> int:
        names = {self._daemon.layout.boards[i].name: i for i in self._daemon.engine.boards}
        if name not in names:
            raise RequestError(f'no board "{name}" here; there are: {", ".join(names)}')
        return names[name]


def _decode(payload: bytes, kind: type[R]) -> R:
    try:
        return from_json(payload, kind)
    except msgspec.ValidationError as error:
        raise RequestError(f"the request: {_why(payload, error, kind)}") from None
    except msgspec.DecodeError as error:
        raise RequestError(f"the request: {error}") from None


def _why(payload: bytes, error: msgspec.ValidationError, kind: type[R]) -> str:
    """What is wrong with a request; other parts of it may be wrong in ways that are not JSON."""
    try:
        return explain(from_json(payload, object), error, kind, {})
    except msgspec.DecodeError:
        return str(error)
