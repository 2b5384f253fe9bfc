"""Requests that are held up leave room for others, and are bounded all the same."""

import asyncio
from collections.abc import Mapping
from typing import Any

from skin_host.clock import SteppedClock
from skin_host.mqtt.commands import MAX_RUNNING, CommandHandler, Result, decode_result
from tests.support.stepped import stepped


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
    assert received[1].error == (
        f"{MAX_RUNNING} commands are running already, and one of this name; try again later"
    )
    answers.set()
    await clock.sleep(1.0)
    assert [one.ok for one in received[4:]] == [True] * (MAX_RUNNING + 1)
    ask("disable")
    await clock.sleep(1.0)
    assert received[-1].ok
