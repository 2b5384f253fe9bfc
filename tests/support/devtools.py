"""A real browser without a window, steered through its own DevTools protocol."""

import asyncio
import base64
import itertools
import json
import re
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

from tests.support import programs
from tests.support.browser import QUIET

PATIENCE_S = 60.0


class Page:
    """One page of the browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self.complaints: list[str] = []

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One method of the protocol; what the page complains of meanwhile is kept."""
        number = next(self._numbers)
        await self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        async with asyncio.timeout(PATIENCE_S):
            while True:
                message = json.loads(await self._socket.recv())
                if message.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                    complaint = json.dumps(message["params"])
                    # The driver speaks of its speed, when a test reads what it has drawn.
                    if "GL Driver Message" not in complaint:
                        self.complaints.append(complaint)
                if message.get("id") == number:
                    assert "error" not in message, message
                    result: dict[str, Any] = message["result"]
                    return result

    async def open(self, url: str, width: int = 1280, height: int = 800) -> None:
        """Open a URL in a window of this size."""
        for domain in ("Runtime", "Log", "Page"):
            await self.call(f"{domain}.enable")
        await self.resize(width, height)
        await self.call("Page.navigate", url=url)
        await self.until('location.href !== "about:blank" && document.readyState === "complete"')

    async def resize(self, width: int, height: int) -> None:
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )

    async def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        answer = await self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    async def click_on(self, element: str) -> None:
        """Click an element, an expression in the page, as soon as a person could."""
        await self.until(f"(one => one && !one.disabled && (one.click(), true))({element})")

    async def until(self, script: str) -> Any:
        """Wait until an expression in the page is true, and return its value."""
        try:
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    if value := await self.run(script):
                        return value
                    await asyncio.sleep(0.1)
        except TimeoutError:
            text = await self.run("document.body.innerText")
            raise AssertionError(f"waited {PATIENCE_S:g} s for {script}; seen:\n{text}") from None

    async def press(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            typed = "\r" if key == "Enter" else key
            text = {"text": typed} if len(typed) == 1 and kind == "keyDown" else {}
            await self.call("Input.dispatchKeyEvent", type=kind, key=key, **text)

    async def click(self, x: float, y: float) -> None:
        """Click with the left button."""
        for kind in ("mousePressed", "mouseReleased"):
            await self.call(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1
            )

    async def drag(self, *points: tuple[float, float]) -> None:
        """Press the left button at the first point, move over the others, release at the last."""
        kinds = ["mousePressed", *["mouseMoved"] * (len(points) - 1), "mouseReleased"]
        for kind, (x, y) in zip(kinds, (*points, points[-1]), strict=True):
            await self.call(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1
            )

    async def touch(self, *points: tuple[float, float]) -> None:
        """Put a finger on the first point, move it over the others, and lift it."""
        for kind, point in zip(
            ["touchStart", *["touchMove"] * (len(points) - 1)], points, strict=True
        ):
            at = [{"x": point[0], "y": point[1]}]
            await self.call("Input.dispatchTouchEvent", type=kind, touchPoints=at)
        await self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    async def box(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element, scrolled into the window."""
        left, top, width, height = await self.run(
            f"""(() => {{
                const element = document.querySelector({json.dumps(selector)});
                element.scrollIntoView({{ block: "center" }});
                const box = element.getBoundingClientRect();
                return [box.left, box.top, box.width, box.height];
            }})()"""
        )
        return left, top, width, height

    async def picture(self) -> bytes:
        """What the page looks like, as PNG."""
        answer = await self.call("Page.captureScreenshot", format="png")
        return base64.b64decode(answer["data"])


@asynccontextmanager
async def browser(profile: Path) -> AsyncIterator[Page]:
    """A browser with one empty page."""
    process = await asyncio.create_subprocess_exec(
        programs.require("chromium"),
        "--headless=new",
        "--no-sandbox",  # root has no sandbox of its own
        "--disable-gpu",
        "--enable-unsafe-swiftshader",  # three.js draws without a graphics card
        "--disable-dev-shm-usage",
        *QUIET,
        "--remote-debugging-port=0",
        f"--user-data-dir={profile}",
        "about:blank",
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(PATIENCE_S):
            port = await _port(process)
            tabs = await asyncio.to_thread(_get, f"http://127.0.0.1:{port}/json")
        (address,) = [tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page"]
        async with connect(address, max_size=None) as socket:
            yield Page(socket)
    finally:
        process.terminate()
        await process.communicate()


async def _port(process: asyncio.subprocess.Process) -> int:
    """The port that the browser chose; it says so among its complaints."""
    assert process.stderr is not None
    async for line in process.stderr:
        if match := re.search(rb"DevTools listening on ws://127.0.0.1:(\d+)/", line):
            return int(match[1])
    raise AssertionError("the browser ended by itself")


def _get(url: str) -> Any:
    with urllib.request.urlopen(url) as answer:
        return json.load(answer)
