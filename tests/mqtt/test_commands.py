"""Requests that are held up leave room for others, and are bounded all the same."""

import asyncio
from collections.abc import Mapping
from typing import Any

import msgspec
import pytest
from msgspec import UNSET

from skin_host.clock import SteppedClock
from skin_host.errors import (
    BusError,
    BusyFileError,
    ConfigurationError,
    RequestError,
    SkinError,
    StateError,
)
from skin_host.mqtt.commands import (
    MAX_NAMED,
    MAX_REQUEST_BYTES,
    MAX_RUNNING,
    RESULT_SCHEMA,
    CommandHandler,
    Result,
    decode_result,
)
from skin_host.mqtt.payload import MessageError
from tests.support.stepped import stepped


async def refused(
    error: BaseException | None, name: str = "scan", payload: bytes = b"{}"
) -> Result:
    """The answer to a request that fails so."""
    received: list[Result] = []

    async def handle(name: str, payload: bytes) -> Mapping[str, Any]:
        assert error is not None, "the handler is not to be asked"
        raise error

    handler = CommandHandler(handle)
    handler.take(name, payload, lambda answer: received.append(decode_result(answer)))
    await asyncio.wait([asyncio.create_task(asyncio.sleep(0)), *handler._running])
    (answer,) = received
    assert not answer.ok
    return answer


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (RequestError("seconds: seen 1e6"), "request"),
        (ConfigurationError("demo.toml: wrong"), "request"),
        (StateError("something else is being done"), "state"),
        (BusyFileError("calibration.json: another program is writing it"), "state"),
        (BusError("can0 is down"), "failure"),
        (SkinError("no board sent a sweep"), "failure"),
        (ZeroDivisionError("secret detail"), "failure"),
    ],
)
async def test_an_answer_distinguishes_a_wrong_request_a_wrong_moment_and_a_failure(
    error: Exception, cause: str
) -> None:
    assert (await refused(error)).cause == cause


async def test_a_reason_is_one_line_whatever_the_request_was() -> None:
    answer = await refused(RequestError("unknown key `x\nERROR forged\u2028\x1b[2J`"))
    assert answer.error == "unknown key `x\\nERROR forged\\u2028\\x1b[2J`"


@pytest.mark.parametrize(
    ("name", "payload"),
    [
        ("Scan it", b"{}"),
        ("scan", b"{"),
        ("scan", b"[]"),
        ("scan", b'{"id":1.5}'),
        ("scan", b" " * (MAX_REQUEST_BYTES + 1)),
    ],
)
async def test_what_is_no_request_is_a_wrong_one(name: str, payload: bytes) -> None:
    assert (await refused(None, name, payload)).cause == "request"


@stepped
async def test_what_an_ending_handler_refuses_or_ends_was_no_wrong_request(
    clock: SteppedClock,
) -> None:
    received: list[Result] = []

    async def handle(name: str, payload: bytes) -> Mapping[str, Any]:
        await asyncio.Event().wait()
        raise AssertionError

    def ask() -> None:
        handler.take("scan", b"{}", lambda answer: received.append(decode_result(answer)))

    handler = CommandHandler(handle)
    ask()
    await clock.sleep(1.0)
    await handler.end()
    ask()
    # What ran may have been done in part; what came later was not begun.
    assert [answer.cause for answer in received] == ["failure", "state"]


@stepped
async def test_who_asks_at_a_wrong_moment_recognises_the_answer(clock: SteppedClock) -> None:
    """Without its `id` the client waited for an answer until it gave up."""
    received: list[Result] = []

    async def handle(name: str, payload: bytes) -> Mapping[str, Any]:
        await asyncio.Event().wait()
        raise AssertionError

    def ask(identity: str) -> None:
        payload = msgspec.json.encode({"id": identity})
        handler.take("scan", payload, lambda answer: received.append(decode_result(answer)))

    handler = CommandHandler(handle)
    for number in range(MAX_RUNNING):
        ask(f"running {number}")
    ask("one too many")
    assert [(answer.id, answer.cause) for answer in received] == [("one too many", "state")]
    await clock.sleep(1.0)
    await handler.end()
    ask("late")
    assert (received[-1].id, received[-1].cause) == ("late", "state")


def test_an_answer_without_a_cause_or_with_a_later_one_is_read() -> None:
    """Of a daemon of another version."""
    answer = {"schema": RESULT_SCHEMA, "command": "scan", "ok": False, "error": "no"}
    assert decode_result(msgspec.json.encode(answer)).cause is UNSET
    assert decode_result(msgspec.json.encode({**answer, "cause": "later"})).cause == "later"
    for wrong in (1, None, [], "x" * 33):
        with pytest.raises(MessageError, match="cause"):
            decode_result(msgspec.json.encode({**answer, "cause": wrong}))


@stepped
async def test_commands_that_a_disk_holds_up_leave_room_for_every_other_command(
    clock: SteppedClock,
) -> None:
    answers = asyncio.Event()
    received: list[Result] = []

    async def handle(name: str, payload: bytes) -> Mapping[str, Any]:
        if name != "status":
            await answers.wait()
        return {}

    def ask(name: str) -> None:
        handler.take(name, b"{}", lambda answer: received.append(decode_result(answer)))

    handler = CommandHandler(handle)
    for _ in range(MAX_RUNNING):
        ask("disable")
    ask("status")
    ask("enable")
    await clock.sleep(1.0)
    assert [(one.command, one.ok) for one in received] == [("status", True)]
    # Of each kind only one more: what waits stays bounded.
    ask("disable")
    ask("enable")
    ask("status")
    await clock.sleep(1.0)
    assert [(one.command, one.ok) for one in received[1:]] == [
        ("disable", False),
        ("enable", False),
        ("status", True),
    ]
    assert received[1].cause == "state"
    assert received[1].error == (
        f"{MAX_RUNNING} commands are running already, and one of this name; try again later"
    )
    answers.set()
    await clock.sleep(1.0)
    assert [one.ok for one in received[4:]] == [True] * (MAX_RUNNING + 1)
    ask("disable")
    await clock.sleep(1.0)
    assert received[-1].ok


async def never(name: str, payload: bytes) -> Mapping[str, Any]:
    raise AssertionError("the handler is not to be asked")


@stepped
async def test_a_request_that_is_delivered_twice_is_carried_out_and_answered_once(
    clock: SteppedClock,
) -> None:
    """A refusal of the second one would be taken for the answer."""
    begun: list[bytes] = []

    async def handle(name: str, payload: bytes) -> Mapping[str, Any]:
        begun.append(payload)
        if len(begun) > 1:
            raise StateError("it is being done already")
        await clock.sleep(1.0)
        return {}

    handler, answers = CommandHandler(handle), list[bytes]()
    for _ in range(2):
        handler.take("calibrate", b'{"id":"me-1"}', answers.append)
        await clock.sleep(0.1)
    await clock.sleep(2.0)
    (answer,) = map(decode_result, answers)
    assert (answer.ok, answer.id) == (True, "me-1")
    assert (len(begun), handler.taken, handler.refused) == (1, 1, 1)
    handler.take("calibrate", b'{"id":"me-2"}', answers.append)
    await clock.sleep(0.1)
    assert decode_result(answers[1]).cause == "state"


def test_each_retained_request_is_named_with_what_clears_it_but_not_a_flood_of_them(
    caplog: pytest.LogCaptureFixture,
) -> None:
    handler = CommandHandler(never)
    topics = [f"skin/robot/nodes/main/cmd/{name}" for name in ("zero", "reload", "zero")]
    for topic in topics:
        handler.ignore_retained(topic)
    said = [record.getMessage() for record in caplog.records]
    assert [line.rpartition("mosquitto_pub -r -n -t ")[2] for line in said] == topics[:2]
    for number in range(1000):
        handler.ignore_retained(f"skin/robot/nodes/main/cmd/{number}")
    assert len(caplog.records) == MAX_NAMED
    assert handler.refused == 1003
