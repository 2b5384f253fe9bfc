"""Whoever reaches the port of the live page, and is no browser, stops nothing."""

import asyncio
import base64
import resource
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from skin_host.client import Frame
from skin_host.layout import Layout
from skin_host.mqtt.publisher import Publisher
from skin_host.viewer.picture import Cursor, Picture
from skin_host.viewer.server import MAX_CONNECTIONS, MAX_PIECES, Viewer
from tests.support.broker import Mosquitto
from tests.support.waiting import until
from tests.viewer import test_picture as pictures
from tests.viewer.test_server import fetch, heard, node, nowhere, of_type, page, pressed, skin

_TEXT, _MORE, _PING = 0x01, 0x00, 0x89


def piece(kind: int, data: bytes = b"") -> bytes:
    """A masked frame of a message that goes on."""
    return bytes([kind, 0x80 | len(data), 0, 0, 0, 0]) + data


def place(url: str) -> tuple[str, int]:
    host, _, port = url.removeprefix("http://").strip("/").partition(":")
    return host, int(port)


async def answer(url: str, request: str) -> bytes:
    """Send a request as it is; return what came until the server closed."""
    reader, writer = await asyncio.open_connection(*place(url))
    writer.write(request.encode())
    try:
        return await reader.read()
    finally:
        writer.close()


async def open_page(url: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A page's WebSocket without a library that keeps to the rules."""
    reader, writer = await asyncio.open_connection(*place(url), limit=256)
    key = base64.b64encode(bytes(16)).decode()
    writer.write(
        f"GET /live HTTP/1.1\r\nHost: localhost:1\r\nOrigin: http://localhost:1\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: {key}\r\n\r\n".encode()
    )
    await reader.readuntil(b"\r\n\r\n")
    return reader, writer


async def test_a_message_in_endless_empty_pieces_ends_its_connection() -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        reader, writer = await open_page(url)
        writer.write(piece(_TEXT, b"{") + piece(_MORE) * 10 * MAX_PIECES)
        async with asyncio.timeout(30):
            said = await reader.read()
        writer.close()
        assert b"\x88\x02\x03\xf1" in said  # closed: 1009, message too big
        assert (await fetch(url))[0] == 200


async def test_who_sends_pings_and_reads_no_answer_is_not_read_either() -> None:
    """The answers would wait in memory, as many as there are pings."""
    many = piece(_PING, bytes(125)) * 2000
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        _, writer = await open_page(url)
        with pytest.raises(TimeoutError):
            for _ in range(400):  # 100 MB: far more than waits between two programs
                writer.write(many)
                async with asyncio.timeout(1.0):
                    await writer.drain()
        writer.transport.abort()
        assert (await fetch(url))[0] == 200


async def test_who_reads_slowly_is_read_again_when_it_has() -> None:
    many = 4000
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        reader, writer = await open_page(url)
        writer.write(piece(_PING, bytes(125)) * many)
        answer = bytes([0x8A, 125]) + bytes(125)
        async with asyncio.timeout(30):
            for _ in range(many):
                await reader.readuntil(answer)
        writer.close()


async def test_more_connections_than_files_may_be_open_are_survived_in_silence(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 4096:
        pytest.skip("this machine allows too few open files")
    # Both ends are in this process.
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 4096), hard))
    try:
        async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
            crowd = [
                await asyncio.open_connection(*place(url)) for _ in range(MAX_CONNECTIONS + 50)
            ]
            refused = 0
            for reader, _ in crowd:
                try:
                    async with asyncio.timeout(0.05):
                        refused += await reader.read() == b""
                except TimeoutError:
                    pass
                except ConnectionError:
                    refused += 1
            assert refused >= 50
            # The others are as many as there may be, and none of them asks for anything.
            assert (await fetch(url))[0] == 200
            for _, writer in crowd:
                writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert not [one for one in caplog.records if one.name in ("asyncio", "websockets.server")]


def n_files(pid: int) -> int:
    """How many files a program has open."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


async def test_a_program_that_may_open_no_more_files_writes_one_line_and_serves_later(
    tmp_path: Path,
) -> None:
    """asyncio's own server writes a hundred tracebacks at once, and more each second."""
    log = tmp_path / "log"
    command = [sys.executable, "-m", "skin_host", "view", "--robot", "demo", "--port", "0"]
    with log.open("wb") as stderr:
        view = await asyncio.create_subprocess_exec(
            *command, "--broker", nowhere(), stdout=asyncio.subprocess.PIPE, stderr=stderr
        )
    try:
        assert view.stdout is not None
        url = (await view.stdout.readline()).decode().removeprefix("the page: ").strip()
        assert (await fetch(url))[0] == 200
        before = resource.prlimit(view.pid, resource.RLIMIT_NOFILE)
        # The lowest number that is free is the first that may not be used.
        lowest = n_files(view.pid)
        resource.prlimit(view.pid, resource.RLIMIT_NOFILE, (lowest, before[1]))
        crowd = [await asyncio.open_connection(*place(url)) for _ in range(50)]
        await until(lambda: "Too many open files" in log.read_text())
        resource.prlimit(view.pid, resource.RLIMIT_NOFILE, before)
        assert (await fetch(url))[0] == 200
        for _, writer in crowd:
            writer.close()
    finally:
        view.terminate()
        await view.communicate()
    lines = log.read_text().splitlines()
    (refused,) = [line for line in lines if "no connection" in line]
    assert refused.startswith(f"WARNING the page on 127.0.0.1:{place(url)[1]}: ")
    assert refused.endswith("; trying again")
    assert len(lines) <= 3  # the broker is not there


@pytest.mark.parametrize("name", ["Host", "Origin"])
async def test_a_request_with_two_hosts_or_origins_is_refused(name: str) -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        said = await answer(
            url, f"GET / HTTP/1.1\r\nHost: localhost:1\r\n{name}: a\r\n{name}: b\r\n\r\n"
        )
        assert said.startswith(b"HTTP/1.1 400 ")


async def test_a_page_that_sends_a_request_in_a_few_pieces_is_answered() -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url, page(url) as socket:
        await socket.send(iter(["{", '"do":', "1}"]))
        async with asyncio.timeout(30):
            async for said in socket:
                if '"answer"' in str(said):
                    break


async def test_a_message_that_cannot_be_shown_leaves_no_page_as_it_was(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A page that gets nothing new shows what was true once."""
    take, monkeys = Picture.take_frame, [1]

    def fail_once(picture: Picture, frame: Frame, now_s: float) -> None:
        if monkeys:
            raise ZeroDivisionError(monkeys.pop())
        take(picture, frame, now_s)

    monkeypatch.setattr(Picture, "take_frame", fail_once)
    monkeypatch.setattr("skin_host.viewer.server.RETRY_S", 0.1)
    layout = skin()
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with node(mosquitto, layout) as publisher:
        async with Viewer(broker, robot="demo").serving(port=0) as url, page(url) as socket:
            await heard(socket, lambda told: of_type("status")(told) and told["connected"])
            publisher.put_frame(pressed(layout, 1))
            lost = await heard(socket, lambda told: of_type("status")(told) and told["error"])
            assert "see the server's log" in lost["error"]
            assert not lost["connected"]
            await heard(socket, lambda told: of_type("status")(told) and told["connected"])
            sending = asyncio.create_task(put_frames(publisher, layout))
            assert await heard(socket, lambda told: isinstance(told, bytes))
            sending.cancel()
            assert "the page begins again" in caplog.text

            def fail(*_: object) -> list[str]:
                raise ZeroDivisionError

            monkeypatch.setattr(Picture, "news", fail)
            async with asyncio.timeout(30):
                with suppress(ConnectionClosed):
                    while True:
                        await socket.recv()
            assert "a page is closed" in caplog.text


async def put_frames(publisher: Publisher, layout: Layout) -> None:
    for number in range(2, 10**6):
        publisher.put_frame(pressed(layout, number))
        await asyncio.sleep(0.05)


def test_more_parts_than_frames_can_name_are_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skin_host.viewer.picture.MAX_PARTS", 3)
    picture = Picture()
    info = pictures.info({f"p{n}": 1 for n in range(9)})
    picture.take_nodes("robot", {"main": (True, info)}, dict.fromkeys(info.parts, "main"))
    assert list(picture.parts) == ["p0", "p1", "p2"]
    picture.take_frame(pictures.frame("p5", [1.0]), pictures.NOW_S)
    assert picture.news(Cursor(), pictures.NOW_S)
