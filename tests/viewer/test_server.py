"""The page's server: files and a WebSocket, for its own page only."""

import asyncio
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from socket import AF_INET6, create_server, gethostname
from typing import Any

import aiomqtt
import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from msgspec.structs import replace
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin

from skin_host.client.links import RETAINED_S
from skin_host.config.settings import Mqtt, load
from skin_host.errors import RequestError, SkinError
from skin_host.layout import Layout, build_layout
from skin_host.mqtt.commands import Handler
from skin_host.mqtt.info import node_info
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.recording import capture
from skin_host.recording.mcap import read_messages_of
from skin_host.viewer import server
from skin_host.viewer.server import Viewer
from tests.support.broker import Mosquitto, free_port
from tests.support.said import touch_event
from tests.support.waiting import PATIENCE_S, until

PAGE = Path(server.__file__).parent / "page"
CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"


def has_ipv6() -> bool:
    """Whether this machine has an address of IPv6: some containers have none."""
    with suppress(OSError), create_server(("::1", 0), family=AF_INET6):
        return True
    return False


def nowhere() -> str:
    """A URL of a broker that is not there."""
    return f"mqtt://127.0.0.1:{free_port()}"


async def fetch(url: str, **headers: str) -> tuple[int, Mapping[str, str], bytes]:
    def get() -> tuple[int, Mapping[str, str], bytes]:
        try:
            with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
                return answer.status, dict(answer.headers), answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, dict(error.headers), error.read()

    return await asyncio.to_thread(get)


@asynccontextmanager
async def page(url: str, **keys: Any) -> AsyncIterator[ClientConnection]:
    """A page's own connection to its server."""
    keys = {"origin": url.rstrip("/")} | keys
    async with connect(url.replace("http", "ws") + "live", max_size=None, **keys) as socket:
        yield socket


async def heard(
    socket: ClientConnection, wanted: Callable[[Any], bool], patience_s: float = PATIENCE_S
) -> Any:
    """The first message that is wanted: bytes as they come, text decoded."""
    async with asyncio.timeout(patience_s):
        async for data in socket:
            message = data if isinstance(data, bytes) else msgspec.json.decode(data)
            if wanted(message):
                return message
    raise AssertionError("the server closed the connection")


def of_type(kind: str) -> Callable[[Any], bool]:
    return lambda message: isinstance(message, dict) and message["type"] == kind


def skin() -> Layout:
    return build_layout(load(CONFIG), CONFIG.parent)


async def answer(name: str, payload: bytes) -> Mapping[str, Any]:
    if name == "calibrate":
        return {"id": "abc", "verdicts": {"left_hand": {"ok": 104}}}
    raise RequestError(f"no {name} here")


@asynccontextmanager
async def node(
    broker: Mosquitto, layout: Layout, handler: Handler = answer
) -> AsyncIterator[Publisher]:
    settings = Mqtt(host=broker.host, port=broker.port)
    async with Publisher(settings, layout.robot, handler=handler) as publisher:
        publisher.put_info(node_info(layout, "main", version="1", configuration="x"))
        yield publisher


def pressed(layout: Layout, seq: int) -> PressureFrame:
    n = layout.part("left_hand").n_taxels
    kpa = np.zeros(n, np.float32)
    kpa[5] = 12.5
    yes, no = np.ones(n, np.bool_), np.zeros(n, np.bool_)
    return PressureFrame("left_hand", seq, seq, np.zeros(n, np.uint8), kpa, no, yes, no)


async def test_every_file_that_the_page_names_is_served() -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        status, headers, body = await fetch(url)
        assert status == 200
        assert headers["Content-Type"] == "text/html; charset=utf-8"
        for name, kind in (
            ("main.js", "text/javascript"),
            ("page.css", "text/css"),
            ("icon.svg", "image/svg+xml"),
            ("vendor/uPlot.iife.min.js", "text/javascript"),
            ("vendor/uPlot.min.css", "text/css"),
        ):
            assert name.encode() in body
            status, headers, file = await fetch(url + name)
            assert status == 200
            assert headers["Content-Type"].startswith(kind)
            assert "default-src 'none'" in headers["Content-Security-Policy"]
            for line in file.decode().splitlines():
                if ' from "./' in line:
                    module = line.split('"./')[1].split('"')[0]
                    assert (await fetch(url + module))[0] == 200


async def test_the_page_asks_nothing_of_the_net() -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        for name in ("", *(file.name for file in PAGE.glob("*.*") if file.suffix != ".svg")):
            status, _, body = await fetch(url + name)
            assert status == 200
            assert b"http://" not in body
            assert b"https://" not in body


@pytest.mark.parametrize(
    "path",
    ["nothing", "../settings.py", "%2e%2e/server.py", "live/x", "vendor/", "npm/package.json"],
)
async def test_nothing_else_is_served(path: str) -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        assert (await fetch(url + path))[0] == 404


async def test_who_connects_and_says_nothing_is_not_talked_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        host, _, port = url.removeprefix("http://").strip("/").partition(":")
        _, idle = await asyncio.open_connection(host, int(port))
        idle.close()
        await idle.wait_closed()
        _, strange = await asyncio.open_connection(host, int(port))
        strange.write(b"what is this?\r\n\r\n")
        strange.close()
        assert (await fetch(url))[0] == 200
    assert not [record for record in caplog.records if record.name.startswith("websockets")]


async def test_a_page_from_elsewhere_is_refused() -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        for origin in ("http://evil.example", None):
            with pytest.raises(InvalidStatus, match="403"):
                async with page(url, origin=origin):
                    pass


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
async def test_a_name_that_was_made_to_point_at_this_machine_is_refused(host: str) -> None:
    """Its page would be that of the same origin: it could calibrate."""
    async with Viewer(nowhere(), robot="demo").serving(host, port=0) as url:
        for name in ("evil.example:8080", "evil.example", "localhost.evil.example:80", "", "["):
            status, _, text = await fetch(url, Host=name)
            assert status == 403
            assert b"--name" in text
        port = int(url.rstrip("/").rpartition(":")[2])
        elsewhere = f"http://evil.example:{port}"
        with pytest.raises(InvalidStatus, match="403"):
            async with page(f"{elsewhere}/", host="127.0.0.1", port=port):
                pass


async def test_the_page_is_served_under_addresses_and_the_names_of_this_machine() -> None:
    viewer = Viewer(nowhere(), robot="demo", names=["Skin.Example"])
    own = gethostname()
    async with viewer.serving(port=0) as url:
        for name in ("127.0.0.1", "[::1]", "192.168.7.2", "localhost", "LOCALHOST", own):
            for port in ("", ":80", ":8080"):
                assert (await fetch(url, Host=name + port))[0] == 200, name + port
        assert (await fetch(url, Host=f"{own.partition('.')[0]}.local:8080"))[0] == 200
        assert (await fetch(url, Host="skin.example"))[0] == 200
        assert (await fetch(url, Host="other.example"))[0] == 403


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "::1", "127.0.0.1"])
async def test_the_address_that_is_shown_is_one_on_which_the_page_is_served(host: str) -> None:
    if ":" in host and not has_ipv6():
        pytest.skip("no IPv6 here")
    async with Viewer(nowhere(), robot="demo").serving(host, port=0) as url:
        assert (await fetch(url))[0] == 200


async def test_a_port_that_is_taken_is_told_in_one_line() -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url:
        port = int(url.rstrip("/").rpartition(":")[2])
        with pytest.raises(SkinError, match=f"cannot be served on 127.0.0.1:{port}"):
            async with Viewer(nowhere(), robot="demo").serving(port=port):
                pass


@pytest.mark.parametrize(
    ("host", "port", "why"),
    [
        ("192.0.2.1", 8080, "no address of this machine; choose one with --host"),
        ("fe80::1%nowhere", 8080, "; choose an address of this machine with --host"),
        ("a..b", 8080, "; choose an address of this machine with --host"),
        ("127.0.0.1", 70_000, "; choose another port"),
    ],
)
async def test_an_address_that_cannot_be_served_is_told_with_what_mends_it(
    host: str, port: int, why: str
) -> None:
    with pytest.raises(SkinError) as refusal:
        async with Viewer(nowhere(), robot="demo").serving(host, port):
            pass
    told = str(refusal.value)
    assert told.startswith(f"the page cannot be served on {host}:{port}: ")
    assert why in told
    assert ("--host" in told) != ("another port" in told)


async def test_the_page_is_told_what_the_broker_tells(mosquitto: Mosquitto) -> None:
    layout = skin()
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with (
        node(mosquitto, layout) as publisher,
        Viewer(broker, robot="demo").serving(port=0) as url,
        page(url) as socket,
    ):
        told = await heard(socket, of_type("layout"))
        assert [part["name"] for part in told["parts"]] == ["left_hand", "left_forearm"]
        assert told["nodes"]["main"]["commands"] is True
        for seq in range(1, 400):
            publisher.put_frame(pressed(layout, seq))
            await asyncio.sleep(0.02)
            try:
                message = await heard(socket, lambda m: isinstance(m, bytes), 0.05)
            except TimeoutError:
                continue
            break
        n = layout.part("left_hand").n_taxels
        assert np.frombuffer(message, "<f4", n, 36)[5] == 12.5
        publisher.put_health("left_hand", {"part": "left_hand", "state": "ok"})
        assert (await heard(socket, of_type("health")))["state"] == "ok"


async def test_the_page_may_calibrate(mosquitto: Mosquitto) -> None:
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with (
        node(mosquitto, skin()),
        Viewer(broker, robot="demo").serving(port=0) as url,
        page(url) as socket,
    ):
        await heard(socket, of_type("layout"))
        await until(lambda: mosquitto.subscriptions("skin/demo/nodes/main/cmd/+"))
        await socket.send('{"do":"calibrate","node":"main"}')
        told = await heard(socket, of_type("answer"))
        assert told["ok"]
        assert told["result"]["verdicts"] == {"left_hand": {"ok": 104}}
        await socket.send('{"do":"raw","node":"main"}')
        told = await heard(socket, of_type("answer"))
        assert not told["ok"]
        assert "no raw here" in told["error"]
        assert (told["do"], told["node"]) == ("raw", "main")


async def test_a_part_alone_is_calibrated(mosquitto: Mosquitto) -> None:
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    asked: list[bytes] = []

    async def note(name: str, payload: bytes) -> Mapping[str, Any]:
        asked.append(payload)
        return await answer(name, payload)

    async with (
        node(mosquitto, skin(), note),
        Viewer(broker, robot="demo").serving(port=0) as url,
        page(url) as socket,
    ):
        await heard(socket, of_type("layout"))
        await until(lambda: mosquitto.subscriptions("skin/demo/nodes/main/cmd/+"))
        await socket.send('{"do":"calibrate","node":"main","part":"left_hand"}')
        assert (await heard(socket, of_type("answer")))["ok"]
        assert msgspec.json.decode(asked[0])["part"] == "left_hand"


def recording_is(wanted: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda m: of_type("status")(m) and wanted(m["recording"])


async def test_a_page_records_marks_and_stops(mosquitto: Mosquitto, tmp_path: Path) -> None:
    layout = skin()
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with (
        node(mosquitto, layout) as publisher,
        Viewer(broker, robot="demo", recordings=tmp_path / "new").serving(port=0) as url,
        page(url) as socket,
    ):
        await heard(socket, of_type("layout"))

        async def wish(**words: Any) -> Any:
            await socket.send(msgspec.json.encode(words).decode())
            return await heard(socket, of_type("answer"))

        assert "nothing is being recorded" in (await wish(do="mark"))["error"]
        assert "nothing is being recorded" in (await wish(do="stop"))["error"]
        assert (await wish(do="record"))["ok"]
        assert "already" in (await wish(do="record"))["error"]
        began = await heard(socket, recording_is(lambda now: now is not None))
        assert began["recording"]["marks"] == 0
        before_ns = time.time_ns()
        assert (await wish(do="mark", text="a <b>knock</b>", ago_s=2.5))["result"] == {"marks": 1}
        await until(lambda: mosquitto.subscriptions("skin/demo/+/frame") >= 2)
        publisher.put_frame(pressed(layout, 1))
        publisher.put_health("left_hand", {"part": "left_hand", "state": "ok"})
        await heard(socket, of_type("health"))
        told = (await wish(do="stop"))["result"]
        await heard(socket, recording_is(lambda now: now is None))
    assert told["marks"] == 1
    file = Path(told["file"])
    assert file.parent == tmp_path / "new"
    assert [path.name for path in file.parent.iterdir()] == [file.name]
    topics = {message.topic for message in read_messages_of(file)}
    assert "skin/demo/nodes/main/info" in topics
    with file.open("rb") as stream:  # noqa: ASYNC230
        ((_, _, mark),) = make_reader(stream).iter_messages(topics=["marks"])
    assert msgspec.json.decode(mark.data)["text"] == "a <b>knock</b>"
    assert -2.6e9 < mark.log_time - before_ns < PATIENCE_S * 1e9


async def test_a_recording_that_becomes_too_long_ends_and_says_so(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "PAGE_MAX_S", 0.1)
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with (
        node(mosquitto, skin()),
        Viewer(broker, robot="demo", recordings=tmp_path).serving(port=0) as url,
        page(url) as socket,
    ):
        await heard(socket, of_type("layout"))
        await socket.send('{"do":"record"}')
        ended = await heard(socket, recording_is(lambda now: now is not None and "ended" in now))
        assert "min" in ended["recording"]["ended"]
        assert len(list(tmp_path.glob("*.mcap"))) == 1  # noqa: ASYNC240


async def test_a_full_folder_of_recordings_takes_no_more(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    for i in range(100):
        (tmp_path / f"{i}.mcap").touch()
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with (
        node(mosquitto, skin()),
        Viewer(broker, robot="demo", recordings=tmp_path).serving(port=0) as url,
        page(url) as socket,
    ):
        await heard(socket, of_type("layout"))
        await socket.send('{"do":"record"}')
        assert "move some away" in (await heard(socket, of_type("answer")))["error"]


async def test_without_a_broker_nothing_is_asked_of_a_robot_and_a_recording_is_still_ended(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """A calibration that waits for the broker would begin at a time that nobody expects."""
    asked: list[str] = []

    async def note(name: str, payload: bytes) -> Mapping[str, Any]:
        asked.append(name)
        return await answer(name, payload)

    viewer = Viewer(f"mqtt://{mosquitto.host}:{mosquitto.port}", robot="demo", recordings=tmp_path)
    async with (
        node(mosquitto, skin(), note) as publisher,
        viewer.serving(port=0) as url,
        page(url) as socket,
    ):

        async def wish(do: str) -> Any:
            await socket.send(msgspec.json.encode({"do": do, "node": "main"}).decode())
            return await heard(socket, of_type("answer"))

        await heard(socket, of_type("layout"))
        assert (await wish("record"))["ok"]
        mosquitto.kill()
        await heard(socket, lambda m: of_type("status")(m) and not m["connected"])
        for do in ("calibrate", "raw", "record"):
            assert "no broker at" in (await wish(do))["error"]
        assert (await wish("mark"))["result"] == {"marks": 1}
        viewer._client = None  # the client is being made again
        assert (await wish("mark"))["result"] == {"marks": 2}
        assert (await wish("stop"))["result"]["marks"] == 2
        mosquitto.start()
        await until(lambda: publisher.counters.connected)
        await heard(socket, lambda m: of_type("status")(m) and m["connected"])
    assert asked == []


async def test_a_page_without_leave_may_not(mosquitto: Mosquitto) -> None:
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with (
        node(mosquitto, skin()),
        Viewer(broker, robot="demo", commands=False).serving(port=0) as url,
        page(url) as socket,
    ):
        assert (await heard(socket, of_type("status")))["commands"] is False
        for do in ("calibrate", "record", "mark", "stop"):
            await socket.send('{"do":"' + do + '","node":"main"}')
            told = await heard(socket, of_type("answer"))
            assert "switched off" in told["error"]


@pytest.mark.parametrize(
    "wish",
    ["+", "#", "a/b", "", "\\u0000", "x" * 65, "\\ud800"],
)
async def test_a_wish_for_no_node_costs_neither_page_nor_broker(
    mosquitto: Mosquitto, wish: str
) -> None:
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    viewer = Viewer(broker, robot="demo")
    async with (
        node(mosquitto, skin()),
        viewer.serving(port=0) as url,
        page(url) as socket,
    ):
        await heard(socket, of_type("layout"))
        client = viewer._client
        assert client is not None
        await socket.send('{"do":"raw","node":"' + wish + '"}')
        assert not (await heard(socket, of_type("answer")))["ok"]
        assert client.connections == 1
        assert client.connected


@pytest.mark.parametrize(
    "nonsense",
    [
        "",
        "{}",
        '{"do":"reload","node":"main"}',
        '{"do":"mark","ago_s":1e9}',
        '{"do":"mark","text":"' + "x" * 201 + '"}',
        '{"do":"record","file":"/etc/passwd"}',
        "[1]",
        "\x00",
        b'{"do":"raw","node":"\xff"}',
        "[" * 4000,
    ],
)
async def test_nonsense_from_a_page_is_answered(nonsense: str | bytes) -> None:
    async with Viewer(nowhere(), robot="demo").serving(port=0) as url, page(url) as socket:
        await socket.send(nonsense)
        assert not (await heard(socket, of_type("answer")))["ok"]


async def test_a_page_that_takes_nothing_gives_its_place_to_another(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What the kernel takes for it is soon full: then no ping leaves either, which would end it."""
    info = node_info(skin(), "main", version="1", configuration="x")
    hand = info.parts["left_hand"]
    pads = 100_000
    large = replace(
        hand,
        pads=["pressure"] * pads,
        position_m=[(0.123456, 0.123456, 0.123456)] * pads,
        normal=[(0.0, 0.0, 1.0)] * pads,
        radius_mm=[2.0] * pads,
        area_mm2=[10.0] * pads,
    )
    viewer = Viewer(nowhere(), robot="demo")
    viewer._picture.take_nodes(
        "demo", {"main": (True, replace(info, parts={"left_hand": large}))}, {"left_hand": "main"}
    )
    monkeypatch.setattr(server, "MAX_PAGES", 1)
    monkeypatch.setattr(server, "TAKEN_S", 0.1)
    async with viewer.serving(port=0) as url, page(url, ping_interval=None) as socket:
        socket.transport.pause_reading()
        await until(lambda: viewer._pages == 0)
        socket.transport.abort()
        monkeypatch.undo()
        monkeypatch.setattr(server, "MAX_PAGES", 1)
        async with page(url) as other:
            await heard(other, of_type("layout"))
    assert not [one for one in caplog.messages if "page" in one]


async def test_a_page_too_many_names_what_to_close(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its WebSocket alone would be refused without a reason that a browser shows."""
    monkeypatch.setattr(server, "MAX_PAGES", 1)
    viewer = Viewer(nowhere(), robot="demo")
    async with viewer.serving(port=0) as url:
        async with page(url) as socket:
            await heard(socket, of_type("status"))
            status, _, text = await fetch(url)
            assert (status, text[:24]) == (503, b"1 pages are open already")
            with pytest.raises(InvalidStatus, match="503"):
                async with page(url):
                    pass
        await until(lambda: viewer._pages == 0)
        assert (await fetch(url))[0] == 200


async def test_pages_that_sleep_do_not_hold_up_the_end() -> None:
    viewer = Viewer(nowhere(), robot="demo")
    async with AsyncExitStack() as stack:
        url = await stack.enter_async_context(viewer.serving(port=0))
        asleep = await connect(url.replace("http", "ws") + "live", origin=Origin(url.rstrip("/")))
        await heard(asleep, of_type("status"))
        asleep.transport.pause_reading()
        async with asyncio.timeout(5.0):
            await stack.aclose()
        asleep.transport.abort()


async def test_a_broker_that_comes_late_is_found(mosquitto: Mosquitto) -> None:
    mosquitto.kill()
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with Viewer(broker, robot="demo").serving(port=0) as url, page(url) as socket:
        await asyncio.to_thread(mosquitto.start)
        await heard(socket, lambda m: isinstance(m, dict) and m.get("connected") is True)
        async with node(mosquitto, skin()):
            await heard(socket, of_type("layout"))


async def test_a_page_gets_why_a_node_is_not_described(mosquitto: Mosquitto) -> None:
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with (
        aiomqtt.Client(mosquitto.host, mosquitto.port) as later,
        Viewer(broker, robot="demo").serving(port=0) as url,
        page(url) as socket,
    ):
        await later.publish("skin/demo/nodes/main/info", b'{"schema":"skin.info/2"}', retain=True)
        told = await heard(socket, lambda m: of_type("status")(m) and "skin.info/2" in m["error"])
        assert told["connected"]
        async with node(mosquitto, skin()):
            await heard(socket, lambda m: of_type("status")(m) and not m["error"])


async def test_who_waits_for_a_robot_is_told_what_to_start_and_the_log_once(
    mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "RETRY_S", 0.01)
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with Viewer(broker).serving(port=0) as url, page(url) as socket:
        told = await heard(socket, lambda m: isinstance(m, dict) and "skin run" in str(m))
        assert "is `skin run` running?" in told["error"]
        await asyncio.sleep(3 * RETAINED_S)  # several attempts
        async with node(mosquitto, skin()):
            await heard(socket, of_type("layout"))
    assert caplog.text.count("is `skin run` running?") == 1


async def test_a_page_that_opens_late_gets_what_is_old_with_its_age(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = skin()
    later_s = [0.0]
    monkeypatch.setattr(server, "_now_s", lambda: asyncio.get_running_loop().time() + later_s[0])
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with Viewer(broker, robot="demo").serving(port=0) as url, page(url) as socket:
        async with node(mosquitto, layout) as publisher:
            await heard(socket, of_type("layout"))
            publisher.put_health("left_hand", {"part": "left_hand", "state": "ok"})
            assert (await heard(socket, of_type("health")))["age_s"] < 30.0
            publisher.put_frame(pressed(layout, 1))
            assert age_s(await heard(socket, lambda m: isinstance(m, bytes))) < 30.0
        later_s[0] = 30.0
        async with page(url) as late:
            assert age_s(await heard(late, lambda m: isinstance(m, bytes))) >= 30.0
        async with page(url) as late:
            assert (await heard(late, of_type("health")))["age_s"] >= 30.0


def age_s(frame: bytes) -> float:
    return float(np.frombuffer(frame, "<f4", 1, 32)[0])


def of_hand(wanted: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda m: of_type("contacts")(m) and m["part"] == "left_hand" and wanted(m)


def touched(number: int) -> Touch:
    return touch_event(
        "begin",
        *(number, 1, time.time_ns(), "left_hand", [5], [0.0, 0.0, 0.0], None, 20.0, 12.5, 12.5),
        *(0.25,),
    )


async def test_a_page_gets_why_a_part_is_not_known_and_no_contact_of_a_run_before(
    mosquitto: Mosquitto,
) -> None:
    layout = skin()
    broker = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    async with Viewer(broker, robot="demo").serving(port=0) as url, page(url) as socket:
        with suppress(ConnectionError):
            async with node(mosquitto, layout) as publisher:
                await heard(socket, of_type("layout"))
                publisher.put_contact("left_hand", "UNKNOWN")
                await heard(socket, of_hand(lambda m: m["why"] == "not_felt"))
                publisher.put_contact("left_hand", "ON")
                publisher.put_touch(touched(3))
                seen = await heard(socket, of_hand(lambda m: m["contacts"] and m["state"] == "ON"))
                assert [one["id"] for one in seen["contacts"]] == [3]
                assert publisher._connection is not None
                publisher._closing.set()  # it does not come back
                publisher._connection.cut()
                raise ConnectionError
        seen = await heard(socket, of_hand(lambda m: m["why"] == "offline"))
        assert (seen["state"], seen["contacts"]) == ("UNKNOWN", [])
        async with node(mosquitto, layout) as publisher:
            publisher.put_contact("left_hand", "ON")
            publisher.put_touch(touched(1))
            seen = await heard(socket, of_hand(lambda m: 1 in [one["id"] for one in m["contacts"]]))
            assert [one["id"] for one in seen["contacts"]] == [1]
