"""Commands to nodes, and the answers to them. Pure: sends nothing and takes no times."""

import itertools
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from skin_host.errors import RequestError, SkinError
from skin_host.mqtt.commands import MAX_REQUEST_BYTES, Result, encode_request
from skin_host.mqtt.topics import NAME, WRONG_NAME

#: A node answers a command within this time, and that for which the command lasts.
ANSWER_S = 10.0


class CommandError(SkinError):
    """A node refused a command, failed, or did not answer; the message gives the reason.

    Attributes:
        cause: the node's: `request`, `state` or `failure`, see `mqtt.commands.Cause`; None if it
            did not answer, or named none as an earlier version does.
    """

    def __init__(self, message: str, cause: str | None = None) -> None:
        super().__init__(message)
        self.cause = cause


class WrongCommandError(CommandError, RequestError):
    """A node found a request wrong: a name, a key or a value of it (cause `request`)."""


@dataclass
class Request:
    """A request to a node. `answer` is None until it has come."""

    payload: bytes
    answer: Result | None = None

    def result(self) -> dict[str, Any]:
        """Return what the node answered.

        Raises:
            CommandError: it refused, or failed.
            WrongCommandError: it found the request wrong.
        """
        assert self.answer is not None
        if self.answer.ok:
            return self.answer.result or {}
        cause = self.answer.cause or None
        kind = WrongCommandError if cause == "request" else CommandError
        raise kind(self.answer.error or "refused without a reason", cause)


class Requests:
    """The requests of a client that wait for their answers.

    Args:
        identifier: the client's, by which its requests differ from those of others.
    """

    def __init__(self, identifier: str) -> None:
        self._identifier = identifier
        self._numbers = itertools.count(1)
        #: By `id`.
        self.waiting: dict[str, Request] = {}

    @contextmanager
    def request(self, name: str, arguments: Mapping[str, Any]) -> Iterator[Request]:
        """Make a request, which waits for its answer until the context ends.

        Raises:
            RequestError: the command can have no such name, or an argument cannot be sent.
        """
        refuse_wrong_name(name)
        number = f"{self._identifier}-{next(self._numbers)}"
        try:
            request = Request(encode_request({**arguments, "id": number}))
        except ValueError:
            raise RequestError(f"{name}: seen nan or inf, wanted numbers") from None
        except (TypeError, RecursionError) as error:
            raise RequestError(f"{name}: {error}; wanted what JSON has") from None
        size = len(request.payload)
        if size > MAX_REQUEST_BYTES:  # its node would read no `id` to answer
            raise RequestError(
                f"{name}: the request has {size} bytes; wanted at most {MAX_REQUEST_BYTES}"
            )
        self.waiting[number] = request
        try:
            yield request
        finally:
            del self.waiting[number]

    def take(self, result: Result) -> bool:
        """Take an answer, of which several may come, and return whether a request waits for it."""
        request = self.waiting.get(str(result.id))
        if request is None:
            return False
        request.answer = request.answer or result
        return True


def refuse_wrong_name(name: str) -> None:
    """Refuse a name that neither a command nor a node can have.

    Raises:
        RequestError: it is such a name.
    """
    if not NAME.fullmatch(name):
        raise RequestError(WRONG_NAME)


def answer_within_s(arguments: Mapping[str, Any]) -> float:
    """Return how long to wait for an answer, by how long the command lasts, as far as its
    arguments show it.
    """
    seconds = arguments.get("seconds")
    lasts = isinstance(seconds, int | float) and 0 < seconds < math.inf
    return ANSWER_S + (float(seconds) if lasts else 0.0)  # type: ignore[arg-type]
