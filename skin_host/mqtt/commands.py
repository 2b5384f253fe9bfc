"""Requests to a node and their answers. Requests are not trusted and are bounded.

A request is a JSON object of at most `MAX_REQUEST_BYTES` (an empty payload counts as `{}`). Its
key `id`, if it has one, comes back in the answer. The answer is a JSON object:
`{"schema":"skin.result/1","command":..,"id":..,"ok":true,"result":{..}}`, or with
`"ok":false`, `"error"`, one line with the reason, and `"cause"`, one of `Cause`.
"""

import asyncio
import json
import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType
from msgspec.structs import replace

from skin_host.errors import RequestError, SkinError, StateError, visible
from skin_host.mqtt.payload import MessageError, decode
from skin_host.tasks import cancel
from skin_host.untrusted import from_json

RESULT_SCHEMA = "skin.result/1"
MAX_REQUEST_BYTES = 64 * 1024
#: At most this many commands run at a time, and one more of each name of which none does: a disk
#: that does not answer holds up the commands that write, and nobody could ask for the status.
MAX_RUNNING = 8
#: This many requests are taken at once, and this many a second in the long run.
BURST = 20
PER_SECOND = 10.0

#: Of what others wrote, so many characters are logged, and so many retained requests are named.
LOGGED = 200
MAX_NAMED = 16

#: Why a command was not carried out: the request is wrong, and is refused until it is mended; it is
#: right, but came at a wrong moment, and nothing was done; or it failed, and a part may be done.
Cause = Literal["request", "state", "failure"]
#: Answers a command: takes its name and its request, a JSON object as bytes. The return value
#: becomes `result`; a `SkinError` becomes `error` and `cause`.
Handler = Callable[[str, bytes], Awaitable[Mapping[str, Any]]]
#: Sends the payload of an answer.
Answer = Callable[[bytes], None]

#: Key of a result from which others were left out, because the broker takes no larger packets.
LEFT_OUT = "left_out"
#: Why a daemon that ends refuses what it is asked for.
ENDING = "the daemon is ending"

_log = logging.getLogger(__name__)
_NAME = re.compile(r"[a-z0-9_-]{1,32}")


class Result(Struct, omit_defaults=True):
    """The answer to a request.

    `cause` is a `Cause`, or what a later version has more; an earlier one sends none.
    """

    schema: Annotated[str, Meta(max_length=32)]
    command: Annotated[str, Meta(max_length=64)]
    ok: bool
    id: str | int | UnsetType = UNSET
    result: dict[str, Any] | UnsetType = UNSET
    error: str | UnsetType = UNSET
    cause: Annotated[str, Meta(max_length=32)] | UnsetType = UNSET


class _Identified(Struct):
    id: Annotated[str, Meta(max_length=64)] | int | UnsetType = UNSET


_result_decoder = msgspec.json.Decoder(Result)


def encode_request(arguments: Mapping[str, Any]) -> bytes:
    """Write the request of a command.

    Raises:
        ValueError: a number is not finite; JSON has no such number.
    """
    return json.dumps(dict(arguments), allow_nan=False).encode()


def decode_result(payload: bytes) -> Result:
    """Read the answer to a request.

    Raises:
        MessageError: it is not one.
    """
    result = decode(_result_decoder, payload, "result")
    if result.schema != RESULT_SCHEMA:
        raise MessageError(f'result: schema "{result.schema}"; wanted {RESULT_SCHEMA}')
    return result


class CommandHandler:
    """Takes requests, runs the handler in separate tasks, and sends its answers.

    Attributes:
        taken: requests that were given to the handler.
        refused: requests that were not: too large, too many, retained, not JSON, delivered twice.
    """

    def __init__(self, handler: Handler) -> None:
        self._handler = handler
        #: With the names of the commands, and their requests.
        self._running: dict[asyncio.Task[None], tuple[str, bytes]] = {}
        self._tokens = float(BURST)
        self._filled_s: float | None = None
        self._flooded = False
        #: Topics of retained requests that were named.
        self._named: set[str] = set()
        self._ending = False
        self.taken = 0
        self.refused = 0

    def take(self, name: str, payload: bytes, answer: Answer) -> None:
        """Start a request. Above the rate a request is counted and not answered.

        An answer to each of a flood of requests would make the flood twice as large. The same holds
        for one that comes again with its `id` while it runs: the broker has delivered it twice, and
        who asks would take a refusal of the second one for the answer.
        """
        if not self._token():
            if not self._flooded:
                _log.warning("requests come faster than %g a second: not all are taken", PER_SECOND)
            self._flooded = True
            self.refused += 1
            return
        identity: str | int | UnsetType = UNSET
        try:
            identity = _identity(name, payload)
            if identity is not UNSET and (name, payload) in self._running.values():
                self.refused += 1
                return
            self._check_moment(name)
        except SkinError as error:
            self.refused += 1
            _log.info("command %s refused: %s", visible(name, 32), visible(str(error), LOGGED))
            answer(_failure(name, identity, error))
            return
        self.taken += 1
        task = asyncio.get_running_loop().create_task(self._run(name, payload, identity, answer))
        self._running[task] = name, payload
        task.add_done_callback(self._running.pop)

    def ignore_retained(self, topic: str) -> None:
        """Count a request that was published as retained: it may be from any time."""
        if topic not in self._named and len(self._named) < MAX_NAMED:
            self._named.add(topic)
            _log.warning(
                "a retained request on %s is ignored; clear it with: mosquitto_pub -r -n -t %s",
                *[visible(topic, LOGGED)] * 2,
            )
        self.refused += 1

    async def end(self) -> None:
        """Cancel what is running, and refuse what comes from now on; both are answered."""
        self._ending = True
        await cancel(*self._running)

    async def _run(
        self, name: str, payload: bytes, identity: str | int | UnsetType, answer: Answer
    ) -> None:
        try:
            result = dict(await self._handler(name, payload))
            reply = Result(RESULT_SCHEMA, name, ok=True, id=identity, result=result)
            encoded = msgspec.json.encode(reply)
        except SkinError as error:
            _log.info("command %s refused: %s", name, visible(str(error), LOGGED))
            answer(_failure(name, identity, error))
        except asyncio.CancelledError:
            ended = SkinError(f"{ENDING}; this may not have been done")
            answer(_failure(name, identity, ended))
            raise
        except Exception as error:
            # An error in one command must neither stop the service nor remain without an answer.
            _log.exception("command %s failed", name)
            failed = SkinError(f"failed: {type(error).__name__}; see the log")
            answer(_failure(name, identity, failed))
        else:
            _log.info("command %s done", name)
            answer(encoded)

    def _check_moment(self, name: str) -> None:
        if self._ending:
            raise StateError(ENDING)
        running = [one for one, _ in self._running.values()]
        if len(running) >= MAX_RUNNING and name in running:
            raise StateError(
                f"{MAX_RUNNING} commands are running already, and one of this name; try again later"
            )

    def _token(self) -> bool:
        now_s = asyncio.get_running_loop().time()
        if self._filled_s is not None:
            earned = (now_s - self._filled_s) * PER_SECOND
            self._tokens = min(self._tokens + earned, float(BURST))
        self._filled_s = now_s
        self._flooded = self._flooded and self._tokens < BURST
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


def shortened(answer: bytes) -> bytes | None:
    """Return a shorter answer in place of one that the broker does not take; None: there is none.

    Of a result the largest key is left out, and `LEFT_OUT` names it: the command was carried out.
    """
    reply = from_json(answer, Result)
    known = {} if reply.result is UNSET else reply.result
    left = {key: value for key, value in known.items() if key != LEFT_OUT}
    if not reply.ok:
        shorter = msgspec.json.encode(
            replace(reply, error="the reason is longer than the broker takes")
        )
    elif left:
        largest = max(left, key=lambda key: len(msgspec.json.encode(left[key])))
        del left[largest]
        result = left | {LEFT_OUT: [*known.get(LEFT_OUT, ()), largest]}
        shorter = msgspec.json.encode(replace(reply, result=result))
    else:
        return None
    return shorter if len(shorter) < len(answer) else None


def _identity(name: str, payload: bytes) -> str | int | UnsetType:
    """Return the `id` of a request.

    Raises:
        RequestError: it is none that any command takes.
    """
    if not _NAME.fullmatch(name):
        raise RequestError("a command's name has up to 32 of a-z, 0-9, _ and -")
    if len(payload) > MAX_REQUEST_BYTES:
        raise RequestError(
            f"the request has {len(payload)} bytes; wanted at most {MAX_REQUEST_BYTES}"
        )
    try:
        return from_json(payload or b"{}", _Identified).id
    except msgspec.DecodeError as error:
        raise RequestError(f"the request is not a JSON object as it should be: {error}") from None


def _failure(name: str, identity: str | int | UnsetType, error: SkinError) -> bytes:
    command = name if _NAME.fullmatch(name) else "?"
    why = str(error)
    return msgspec.json.encode(
        Result(
            RESULT_SCHEMA,
            command,
            ok=False,
            id=identity,
            error=visible(why, len(why)),  # one line, whatever the request has brought into it
            cause=_cause(error),
        )
    )


def _cause(error: SkinError) -> Cause:
    if isinstance(error, RequestError):
        return "request"
    return "state" if isinstance(error, StateError) else "failure"
