"""Commands to a running daemon: validated, carried out, answered.

Requests come from the network. Each has a type; whatever does not fit it is refused with a
line that says why. `docs/operations.md` lists the commands.
"""

import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct

from skin_host import service
from skin_host.errors import BusError, RequestError, SkinError
from skin_host.processing import calibration as calibrations
from skin_host.recorder import Recorder
from skin_host.state import State, Thresholds

if TYPE_CHECKING:
    from skin_host.daemon import Daemon

log = logging.getLogger(__name__)

#: Only letters that cannot leave the folder of recordings.
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


class Control:
    """Carries out commands on a daemon."""

    def __init__(self, daemon: "Daemon") -> None:
        self._daemon = daemon
        self.recorder: Recorder | None = None
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
        """Do what a request asks for and return its result.

        Raises:
            SkinError: it is refused, or failed; one line says why.
        """
        command = self._commands.get(name)
        if command is None:
            raise RequestError(f'no command "{name}"; there are: {", ".join(self._commands)}')
        return await command(payload)

    def close(self) -> None:
        """End what still goes on."""
        if self.recorder is not None:
            self.recorder.stop()

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
        found = await daemon.calibrate(seconds, boards)
        return {
            "id": found.id,
            "time": found.time,
            "verdicts": calibrations.summary(found, layout),
        }

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
        return self._keep()

    async def _enable(self, payload: bytes) -> Answer:
        name = _decode(payload, _Parts).part
        self._daemon.engine.disabled.discard(self._part(name))
        return self._keep()

    async def _set_thresholds(self, payload: bytes) -> Answer:
        request = _decode(payload, _Thresholds)
        daemon = self._daemon
        if request.reset:
            daemon.set_thresholds(Thresholds())
        elif request.set is not None:
            known = msgspec.structs.asdict(daemon.thresholds)
            changes = msgspec.structs.asdict(request.set)
            wanted = known | {key: value for key, value in changes.items() if value is not None}
            daemon.set_thresholds(Thresholds(**wanted))
        answer = dict(self._keep()) if request.reset or request.set is not None else {}
        return answer | {"touch": msgspec.to_builtins(daemon.settings.processing.touch)}

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
        await self._daemon.reload()
        return {"configuration": self._daemon.engine.configuration}

    async def _record(self, payload: bytes) -> Answer:
        request = _decode(payload, _Record)
        if self.recorder is not None and self.recorder.ended is None:
            raise RequestError(f"{self.recorder.path.name} is being recorded already; stop it")
        name = request.file
        if name is None:
            name = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ.log")
        if not _FILE.fullmatch(name):
            raise RequestError(
                f'file: "{name[:64]}": wanted a plain name of letters, digits, ".", "_" and "-"'
            )
        folder = service.state_directory(self._daemon.settings.service.state_directory)
        if "." not in name:
            name += ".log"
        self.recorder = Recorder(folder / "recordings" / name, request.seconds, request.max_bytes)
        log.info("recording to %s for %g s", self.recorder.path, request.seconds)
        return {"file": str(self.recorder.path), "seconds": request.seconds}

    async def _stop_recording(self, payload: bytes) -> Answer:
        _decode(payload, _Request)
        recorder = self.recorder
        if recorder is None:
            raise RequestError("nothing is being recorded")
        recorder.stop()
        return {
            "file": str(recorder.path),
            "frames": recorder.frames,
            "lost": recorder.lost,
            "ended": recorder.ended,
        }

    def _keep(self) -> Answer:
        """Keep what operators changed; say so if that failed."""
        daemon = self._daemon
        state = State(
            disabled=[daemon.layout.parts[part].name for part in sorted(daemon.engine.disabled)],
            thresholds=daemon.thresholds,
        )
        answer: dict[str, Any] = {"disabled": state.disabled, "kept": True}
        try:
            daemon.keep(state)
        except OSError as error:
            log.error("state not kept: %s", error.strerror)
            answer["kept"] = False
        return answer

    def _part(self, name: str) -> int:
        names = {self._daemon.layout.parts[i].name: i for i in self._daemon.engine.parts}
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
        return msgspec.json.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(f"the request: {error}") from None
