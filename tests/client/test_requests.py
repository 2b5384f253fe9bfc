"""Requests wait for their answers, and for nobody else's."""

import math
from typing import Any

import pytest
from msgspec import json

from skin_host.client import CommandError, RequestError, WrongCommandError
from skin_host.client.requests import Requests
from skin_host.mqtt.commands import Cause, Result


def answer(number: str, **keys: object) -> Result:
    return Result("skin.result/1", "status", id=number, **keys)  # type: ignore[arg-type]


def test_the_first_answer_to_a_request_is_its_result() -> None:
    requests = Requests("me")
    with requests.request("status", {"id": "of another", "a": 1}) as request:
        (number,) = requests.waiting
        assert json.decode(request.payload) == {"id": number, "a": 1}
        assert not requests.take(answer(number + "0", ok=True))
        assert request.answer is None
        assert requests.take(answer(number, ok=True, result={"n": 1}))
        assert requests.take(answer(number, ok=True, result={"n": 2}))
    assert request.result() == {"n": 1}
    assert not requests.take(answer(number, ok=True))


def test_two_requests_have_different_numbers() -> None:
    requests = Requests("me")
    with requests.request("status", {}) as one, requests.request("status", {}) as other:
        assert one.payload != other.payload
        assert len(requests.waiting) == 2
    assert not requests.waiting


@pytest.mark.parametrize(
    ("cause", "kind"), [("request", WrongCommandError), ("state", CommandError), ("", CommandError)]
)
def test_a_refusal_is_raised_with_its_cause(cause: Cause, kind: type[CommandError]) -> None:
    requests = Requests("me")
    with requests.request("status", {}) as request:
        requests.take(answer(next(iter(requests.waiting)), ok=False, error="no", cause=cause))
    with pytest.raises(kind, match="no") as raised:
        request.result()
    assert type(raised.value) is kind
    assert raised.value.cause == (cause or None)


def test_what_cannot_be_sent_is_refused_and_does_not_wait() -> None:
    requests = Requests("me")
    cases: list[tuple[str, dict[str, Any], str]] = [
        ("Status", {}, "names of up to"),
        ("", {}, "names of up to"),
        ("status", {"seconds": math.nan}, "status: seen nan or inf"),
        ("status", {"part": {1}}, "status: .*set.*; wanted what JSON has"),
        ("status", {"part": "a" * 70_000}, "status: the request has 70.* bytes; wanted at most"),
    ]
    for name, arguments, why in cases:
        with pytest.raises(RequestError, match=why), requests.request(name, arguments):
            pass
    assert not requests.waiting
