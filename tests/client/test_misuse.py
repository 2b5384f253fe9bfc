"""What a program asks for wrongly is refused to it alone, in a line that names the reason."""

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

import skin_host.client
from skin_host.client import (
    BrokerError,
    CommandError,
    RequestError,
    SkinCallbacks,
    SkinClient,
    SkinError,
    WrongCommandError,
)
from skin_host.client.streams import ENDED, UNENTERED
from tests.client.test_client import hearing, publishing, take, touch
from tests.support.broker import Mosquitto
from tests.support.waiting import PATIENCE_S, until

#: They would be filters of other topics, no topics at all, or topics that no part has.
IMPOSSIBLE = ("palm#", "#", "+", "arm/palm", "", "palm\n", "\udc80", "x" * 65)


@pytest.mark.parametrize("part", IMPOSSIBLE)
async def test_a_name_that_no_part_can_have_is_refused_and_ends_no_connection(
    mosquitto: Mosquitto, part: str
) -> None:
    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        touches = skin.touches("palm")
        asks: list[Callable[[str], Any]] = [
            *(skin.touches, skin.slips, skin.overs, skin.events, skin.frames, skin.contacts),
            *(skin.health, skin.present),
        ]
        for ask in asks:
            with pytest.raises(RequestError, match="wanted the name of a part") as refused:
                ask(part)
            assert str(refused.value).isprintable()
        await skin.ready()
        publisher.put_touch(touch(1))
        assert [one.count for one in await take(touches, 1)] == [1]
        assert skin.connections == 1


async def test_a_callback_of_a_part_that_cannot_be_is_refused_and_the_others_are_called(
    mosquitto: Mosquitto,
) -> None:
    def use() -> list[int]:
        counts: list[int] = []
        with SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot") as skin:
            skin.on_touch(lambda touch: counts.append(touch.count), part="palm")
            with pytest.raises(RequestError, match="wanted the name of a part"):
                skin.on_touch(print, part="palm#")
            skin.ready()
            asyncio.run_coroutine_threadsafe(put(), loop).result()
            while not counts:
                skin.ready()
        return counts

    async def put() -> None:
        publisher.put_touch(touch(1))

    loop = asyncio.get_running_loop()
    async with publishing(mosquitto) as publisher:
        assert await asyncio.to_thread(use) == [1]


async def test_a_client_is_used_in_the_event_loop_in_which_it_was_entered(
    mosquitto: Mosquitto,
) -> None:
    def refusal(use: Callable[[], Any]) -> str:
        async def elsewhere() -> None:
            await use()

        with pytest.raises(RequestError) as refused:
            asyncio.run(elsewhere())
        return str(refused.value)

    async with publishing(mosquitto) as publisher, hearing(mosquitto) as skin:
        touches = skin.touches()
        uses: list[Callable[[], Any]] = [
            touches.__anext__,
            skin.touches,
            skin.present,
            skin.ready,
            skin.info,
            partial(skin.command, "status", node="main"),
            partial(skin.__aexit__, None, None, None),
        ]
        refusals = {await asyncio.to_thread(refusal, use) for use in uses}
        (line,) = refusals
        assert line.startswith("this client was entered in another event loop: use it there, or")
        await skin.ready()
        publisher.put_touch(touch(1))
        assert [one.count for one in await take(touches, 1)] == [1]


async def test_a_client_is_used_while_it_is_entered(mosquitto: Mosquitto) -> None:
    """Nothing is waited for in vain, and what was true last is not returned as if it were now."""
    skin = SkinClient(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot")

    async def refusals(*more: Callable[[], Any]) -> set[str]:
        found = set()
        asked = partial(skin.command, "status")
        for use in (skin.ready, skin.info, asked, skin.present, *more):
            with pytest.raises(RequestError) as refused:
                await asyncio.wait_for(use(), PATIENCE_S)
            found.add(str(refused.value))
        return found

    contacts = skin.contacts()
    before = await refusals(contacts.__anext__)
    assert before == {UNENTERED}
    async with publishing(mosquitto) as publisher, skin:
        publisher.put_contact("palm", "OFF")
        assert (await take(contacts, 1))[0].state == "OFF"
        await until(lambda: skin.nodes["main"].online)
    after = await refusals(skin.contacts, skin.touches)
    assert after == {ENDED}
    assert skin.nodes["main"].online is None


async def test_a_client_is_entered_once(mosquitto: Mosquitto) -> None:
    async with hearing(mosquitto) as skin:
        with pytest.raises(RequestError, match="entered before: make another one"):
            await skin.__aenter__()
        assert skin.connected
    with pytest.raises(RequestError, match="entered before: make another one"):
        await skin.__aenter__()


def test_callbacks_are_used_while_they_are_entered(mosquitto: Mosquitto) -> None:
    skin = SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot")
    uses: list[Callable[[], Any]] = [
        *(skin.ready, skin.info, skin.present),
        *(partial(skin.command, "status"), partial(skin.on_touch, print)),
    ]

    def refusals() -> set[str]:
        found = set()
        for use in uses:
            with pytest.raises(RequestError) as refused:
                use()
            found.add(str(refused.value))
        return found

    assert refusals() == {"these callbacks were not entered: use them in their `with` block"}
    with skin:
        skin.ready()
    assert refusals() == {ENDED}
    with pytest.raises(RequestError, match="entered before: make other ones"):
        skin.__enter__()


def test_who_asks_while_callbacks_end_is_refused_and_does_not_wait_for_ever(
    mosquitto: Mosquitto,
) -> None:
    for _ in range(3):
        refused: list[str] = []
        skin = SkinCallbacks(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="robot")

        def ask(use: Callable[[], Any], refused: list[str] = refused) -> None:
            with pytest.raises(RequestError) as error:
                while True:
                    use()
            refused.append(str(error.value))

        uses = (skin.present, skin.parts, partial(skin.on_touch, print))
        with skin:
            threads = [threading.Thread(target=ask, args=(use,), daemon=True) for use in uses]
            for thread in threads:
                thread.start()
            skin.ready()
        for thread in threads:
            thread.join(PATIENCE_S)
        assert refused == [ENDED] * len(uses)


def test_all_that_the_client_raises_can_be_caught_by_what_it_exports() -> None:
    for error in (BrokerError, RequestError, CommandError, WrongCommandError):
        assert issubclass(error, SkinError)
        assert error.__name__ in skin_host.client.__all__
    with pytest.raises(SkinError):
        SkinClient("mqtt://localhost", robot="a#")
