"""The web server of the live page: it receives from the broker and sends to the pages.

One port serves the page's few files and a WebSocket. Pages are not trusted: by default the server
listens on this machine only, and it takes requests from its own page only.
"""

import asyncio
import contextlib
import errno
import logging
import os
import socket
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from functools import partial
from http import HTTPStatus
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct
from websockets.asyncio.server import Server, ServerConnection
from websockets.datastructures import Headers, MultipleValuesError
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.server import ServerProtocol

from skin_host.acceptor import accept
from skin_host.client import SkinClient, Stream
from skin_host.errors import BrokerError, RequestError, SkinError
from skin_host.mqtt.address import Broker
from skin_host.mqtt.connection import first_error
from skin_host.recording.capture import MAX_AGO_S, PageRecording
from skin_host.tasks import cancel, leave_if_cancelled
from skin_host.untrusted import from_json, names_us
from skin_host.viewer.picture import Cursor, Picture

#: Pages get new messages this often; screens show no more.
TICK_S = 0.04
NODES_S = 0.25
#: A broker that cannot be reached is tried again after this time.
RETRY_S = 2.0
MAX_PAGES = 32
#: A page that has not taken its new messages after this time is closed, and connects again when it
#: can. A ping would not end it: it waits behind them.
TAKEN_S = 60.0
#: At the end a page has this long to answer that it is closed; one that sleeps does not.
CLOSE_S = 0.5
MAX_REQUEST_BYTES = 4096
#: A page sends each request as one; pieces without bytes could go on for ever.
MAX_PIECES = 16
#: Of any kind: a page takes two or three, and only for a moment more than one.
MAX_CONNECTIONS = 256
#: A page's requests that are carried out at a time.
MAX_WISHES = 8
#: The longest calibration that a page waits for, and the timeout of other commands.
COMMAND_S = 120.0
#: Raw values are requested again before this time ends.
RAW_LEASE_S = 30.0
TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "txt": "text/plain",
}
SECURITY = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' data:; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}

#: Errors of a request, and of what it asks for.
_REFUSED = (SkinError, OSError, msgspec.DecodeError)

T = TypeVar("T")
_log = logging.getLogger(__name__)


class _Wish(Struct, forbid_unknown_fields=True):
    """A request of a page.

    `node` carries out calibrate and raw, `part` limits a calibration. The server itself records;
    a mark has a text and is so many seconds old.
    """

    do: Literal["calibrate", "raw", "record", "mark", "stop"]
    node: str = ""
    part: str | None = None
    text: Annotated[str, Meta(max_length=200)] = ""
    ago_s: Annotated[float, Meta(ge=0.0, le=MAX_AGO_S)] = 0.0


class _Visit(ServerConnection):
    """A connection; of too many the oldest that has asked for nothing is closed, as browsers and
    others keep some that they do not use, and otherwise the last.

    While its peer does not read, nothing of it is read: the answers to its pings would wait in
    memory without end.
    """

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        visits = [one for one in self.server.handlers if not one.transport.is_closing()]
        if len(visits) > MAX_CONNECTIONS:
            next((one for one in visits if one.request is None), self).transport.abort()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.paused:
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        super().resume_writing()
        # Messages that wait to be handled hold the reading up, too.
        if not self.recv_messages.paused:
            self.transport.resume_reading()


class _Pages(Server):
    """The server as `websockets.serve` makes it up to version 16, but `accept` accepts its
    connections: that of asyncio below it never begins to.
    """

    def is_serving(self) -> bool:
        return self.close_task is None


class Viewer:
    """The page of one robot.

    Pages may calibrate, ask for raw values and record if `commands` is true; what they record is
    kept in `recordings`. It is served under addresses, the names of this machine, and `names`.
    """

    def __init__(
        self,
        broker: str | Broker,
        *,
        robot: str | None = None,
        commands: bool = True,
        recordings: Path = Path("recordings"),
        names: Iterable[str] = (),
    ) -> None:
        self._broker = broker
        self._names = {"localhost", *_own_names(), *map(str.lower, names)}
        self._recording = PageRecording(recordings)
        self._new_client: Callable[[], SkinClient] = lambda: SkinClient(broker, robot=robot)
        self._commands = commands
        self._picture = Picture()
        self._client: SkinClient | None = None
        self._why = "connecting"
        self._pages = 0
        self._files = _page_files()
        self._take_status(connected=False)

    @contextlib.asynccontextmanager
    async def serving(self, host: str = "127.0.0.1", port: int = 8080) -> AsyncIterator[str]:
        """Serve for as long as the block lasts; yields the URL. Port 0 is any free one.

        Raises:
            SkinError: the address or the port is not available.
        """
        # It logs every file that it serves as a rejected connection ...
        logger = logging.getLogger("websockets.server")
        logger.setLevel(logging.WARNING)
        logger.addFilter(_is_no_idle_visit)
        server = _Pages(
            self._talk,
            process_request=lambda connection, request: self._answer(request),
            server_header=None,
        )

        def visit() -> _Visit:
            protocol = ServerProtocol(max_size=MAX_REQUEST_BYTES)
            return _Visit(protocol, server, close_timeout=CLOSE_S)

        loop = asyncio.get_running_loop()
        with contextlib.ExitStack() as ports:
            try:
                bound = await loop.create_server(visit, host, port, start_serving=False)
                ports.callback(bound.close)
                server.wrap(bound)
                listening = [ports.enter_context(one.dup()) for one in bound.sockets]
                for one in listening:
                    one.listen()
            except (OSError, OverflowError, UnicodeError) as error:
                raise SkinError(
                    f"the page cannot be served on {host}:{port}: {_why_not(error)}"
                ) from None
            take = partial(loop.connect_accepted_socket, visit)
            what = f"the page on {host}:{_port(server)}"
            async with server:
                works = [self._listen(), *(accept(one, take, what) for one in listening)]
                working = [asyncio.create_task(work, name="viewer") for work in works]
                try:
                    yield f"http://{_shown(host)}:{_port(server)}/"
                finally:
                    await cancel(*working)
                    ports.close()
                    await self._recording.close()

    async def run(
        self, stop: asyncio.Event, host: str, port: int, ready: Callable[[str], None]
    ) -> None:
        """Serve until `stop` is set; `ready` is called with the URL.

        Raises:
            SkinError: the address or the port is not available.
            RequestError: it is not clear which robot is meant.
        """
        async with self.serving(host, port) as url:
            ready(url)
            await stop.wait()

    def _answer(self, request: Request) -> Response | None:
        """Answer a request for a file; None lets a page's WebSocket through."""
        try:
            host = request.headers.get("Host", "")
            origin = request.headers.get("Origin")
        except MultipleValuesError:
            return _response(HTTPStatus.BAD_REQUEST, "text/plain", b"two hosts or origins\n")
        if not names_us(host, self._names):
            # A page from elsewhere, whose name was made to point at this machine.
            text = b"not served under this name; `skin view --name NAME` allows one\n"
            return _response(HTTPStatus.FORBIDDEN, "text/plain", text)
        path = request.path.partition("?")[0]
        if path == "/live" and origin not in (f"http://{host}", f"https://{host}"):
            return _response(HTTPStatus.FORBIDDEN, "text/plain", b"not from our own page\n")
        # The page too: a browser does not show why a WebSocket is refused.
        if path in ("/", "/live") and self._pages >= MAX_PAGES:
            why = f"{MAX_PAGES} pages are open already; close one, and load this one again\n"
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", why.encode())
        if path == "/live":
            return None
        file = self._files.get("index.html" if path == "/" else path.removeprefix("/"))
        if file is None:
            return _response(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")
        return _response(HTTPStatus.OK, *file)

    async def _talk(self, page: ServerConnection) -> None:
        """Send one page its new messages until it closes, and take its requests."""
        self._pages += 1
        telling = asyncio.create_task(self._tell(page))
        telling.add_done_callback(partial(_close_with, page))
        wishes: set[asyncio.Task[None]] = set()
        try:
            async for message in _messages(page):
                # A mark does not wait for a calibration.
                wishes.add(wish := asyncio.create_task(self._take_wish(page, message)))
                wish.add_done_callback(wishes.discard)
                if len(wishes) >= MAX_WISHES:
                    await asyncio.wait(wishes, return_when=asyncio.FIRST_COMPLETED)
        except ConnectionClosed:
            pass
        finally:
            self._pages -= 1
            await cancel(telling, *wishes)

    async def _tell(self, page: ServerConnection) -> None:
        cursor = Cursor()
        due_s = _now_s()
        while True:
            # Sending waits for a slow page; frames that arrive meanwhile are skipped.
            try:
                async with asyncio.timeout(TAKEN_S):
                    for message in self._picture.news(cursor, _now_s()):
                        await page.send(message)
            except TimeoutError:
                page.transport.abort()
                return
            due_s = max(due_s + TICK_S, _now_s())
            await asyncio.sleep(due_s - _now_s())

    async def _take_wish(self, page: ServerConnection, message: bytes) -> None:
        answer: dict[str, Any] = {"type": "answer"}
        try:
            wish = from_json(message, _Wish)
            answer |= {"do": wish.do, "node": wish.node}
            if not self._commands:
                raise RequestError("commands are switched off; start the page with them allowed")
            answer |= {"ok": True, "result": await self._carry_out(wish)}
        except _REFUSED as error:
            answer |= {"ok": False, "error": str(error)}
        with contextlib.suppress(ConnectionClosed):
            await page.send(msgspec.json.encode(answer).decode())

    async def _carry_out(self, wish: _Wish) -> Mapping[str, Any]:
        recording = self._recording
        match wish.do:
            case "mark":
                return recording.mark(wish.text, wish.ago_s)
            case "stop":
                return await recording.stop()
        client = self._client
        # A client would wait for the broker, and calibrate at a time that nobody expects.
        if client is None or not client.connected:
            raise BrokerError(self._why)
        if wish.do == "record":
            broker, base = self._broker, None
            if isinstance(broker, str):
                broker, base = Broker.from_url(broker)
            return recording.start(broker, base or "skin", client.robot)
        arguments: dict[str, Any] = {"seconds": RAW_LEASE_S} if wish.do == "raw" else {}
        if wish.part is not None:
            arguments["part"] = wish.part
        return await client.command(wish.do, node=wish.node, timeout_s=COMMAND_S, **arguments)

    async def _listen(self) -> None:
        """Receive from the robot; look for the broker again whenever it cannot be found."""
        while True:
            client = self._new_client()
            waiting = asyncio.create_task(self._await(client))
            try:
                async with client, asyncio.TaskGroup() as group:
                    self._client = client
                    await cancel(waiting)
                    picture = self._picture
                    works = (
                        _pass_on(client.frames(), _timed(picture.take_frame)),
                        _pass_on(client.contacts(), picture.take_contact),
                        _pass_on(client.health(), _timed(picture.take_health)),
                        self._follow(client),
                        self._watch(client),
                    )
                    # Here, not at the end of the block: see `leave_if_cancelled`.
                    await asyncio.wait([group.create_task(work) for work in works])
            except* SkinError as errors:
                said, self._why = self._why, str(errors.exceptions[0])
                if self._why != said:
                    _log.warning("%s; trying again", self._why)
            except* Exception as errors:
                # Pages would go on showing what was last true.
                said, self._why = self._why, "a message could not be shown; see the server's log"
                if self._why != said:
                    _log.error("the page begins again", exc_info=first_error(errors))
            finally:
                self._client = None
                await cancel(waiting)
            self._picture.lose()
            self._take_status(connected=False)
            leave_if_cancelled()
            await asyncio.sleep(RETRY_S)

    async def _await(self, client: SkinClient) -> None:
        """Show why the broker cannot be reached while the client still tries."""
        while True:
            if client.last_error:
                self._why = f"no broker at {client.where}: {client.last_error}"
                self._take_status(connected=False)
            await asyncio.sleep(NODES_S)

    async def _follow(self, client: SkinClient) -> None:
        """Follow what touches the skin. The client knows which contacts last."""
        while True:
            self._picture.take_touches(client.present())
            await asyncio.sleep(TICK_S)

    async def _watch(self, client: SkinClient) -> None:
        """Watch the nodes and the connection."""
        while True:
            nodes = {name: (node.online, node.info) for name, node in client.nodes.items()}
            holders = {part: described.node for part, described in client.parts().items()}
            self._picture.take_nodes(client.robot, nodes, holders)
            self._why = f"no broker at {client.where}: {client.last_error or 'trying again'}"
            self._take_status(connected=client.connected)
            await asyncio.sleep(NODES_S)

    def _take_status(self, *, connected: bool) -> None:
        client = self._client
        self._picture.take_status(
            {
                "connected": connected,
                "error": self._why if client is None or not connected else client.info_error,
                "commands": self._commands,
                "recording": self._recording.state,
            }
        )


def _own_names() -> set[str]:
    """The names of this machine, the one of multicast DNS included."""
    name = socket.gethostname().lower()
    short = name.partition(".")[0]
    return {name, short, f"{short}.local"}


def _why_not(error: Exception) -> str:
    """Return why an address cannot be served, and what mends it."""
    if isinstance(error, socket.gaierror | UnicodeError):
        why = error.strerror if isinstance(error, OSError) else "no name of a computer"
        return f"{why}; choose an address of this machine with --host"
    if not isinstance(error, OSError):
        return f"{error}; choose another port"
    # Python 3.13 leaves the number out.
    if error.errno is None or error.errno == errno.EADDRNOTAVAIL:
        return "no address of this machine; choose one with --host"
    return f"{os.strerror(error.errno)}; choose another port"


def _close_with(page: ServerConnection, telling: "asyncio.Task[None]") -> None:
    """Close a page that gets nothing new any more: it shows that, and connects again."""
    error = None if telling.cancelled() else telling.exception()
    if error is not None:
        if not isinstance(error, ConnectionClosed):
            _log.error("a page is closed", exc_info=error)
        page.transport.abort()


async def _messages(page: ServerConnection) -> AsyncIterator[bytes]:
    """What a page sends, until it closes or sends a message in too many pieces."""
    while True:
        pieces: list[bytes] = []
        async for piece in page.recv_streaming(decode=False):
            pieces.append(piece)
            if len(pieces) > MAX_PIECES:
                await page.close(CloseCode.MESSAGE_TOO_BIG)
                return
        yield b"".join(pieces)


async def _pass_on(stream: Stream[T], take: Callable[[T], None]) -> None:
    async for item in stream:
        take(item)


def _timed(take: Callable[[T, float], None]) -> Callable[[T], None]:
    """Return what takes an item as received now."""
    return lambda item: take(item, _now_s())


def _now_s() -> float:
    return asyncio.get_running_loop().time()


def _is_no_idle_visit(record: logging.LogRecord) -> bool:
    """... and each connection that a browser opens in advance and does not use as a failure."""
    return record.getMessage() != "opening handshake failed"


def _page_files() -> dict[str, tuple[str, bytes]]:
    """The page's files by name: their type and content; its libraries are in a folder `vendor`."""
    page = resources.files("skin_host.viewer").joinpath("page")
    files = {}
    for prefix, folder in (("", page), ("vendor/", page.joinpath("vendor"))):
        # Where neither npm nor PyPI was reached there are no libraries; the page shows that.
        for file in folder.iterdir() if folder.is_dir() else ():
            kind = TYPES.get(file.name.rpartition(".")[2])
            if kind is not None:
                files[prefix + file.name] = f"{kind}; charset=utf-8", file.read_bytes()
    return files


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers(SECURITY)
    headers["Content-Type"] = kind
    headers["Content-Length"] = str(len(body))
    return Response(status, status.phrase, headers, body)


def _shown(host: str) -> str:
    """Return the address of our host as a browser on this machine writes it."""
    if host in ("", "0.0.0.0"):  # noqa: S104  # shown, not bound
        return "localhost"
    if host == "::":
        host = "::1"  # "localhost" is the address of IPv4, too, on which nothing listens
    return f"[{host}]" if ":" in host else host


def _port(server: Server) -> int:
    port: int = next(iter(server.sockets)).getsockname()[1]
    return port
