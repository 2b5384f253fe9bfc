"""The live page as `skin view` serves it, in a real browser."""

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from tests.support.broker import Mosquitto
from tests.support.devtools import Page, browser
from tests.support.stack import ROOT

VENDOR = ROOT / "skin_host" / "viewer" / "page" / "vendor"
LIBRARIES = f"{VENDOR} has no libraries: run `pip install --editable .` where npm or PyPI answers"
LIVE = 'document.getElementById("status").dataset.level === "ok"'


@asynccontextmanager
async def viewing(
    broker: Mosquitto, robot: str, profile: Path, width: int = 1280, *, watch: str = ""
) -> AsyncIterator[Page]:
    """Open the page of a robot; nothing complains until the end.

    `watch` is a script that the page runs before its own.
    """
    assert (VENDOR / "lock.sha256").exists(), LIBRARIES
    view = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "skin_host", "view", "--robot", robot, "--port", "0"),
        *("--broker", f"mqtt://{broker.host}:{broker.port}"),
        *("--recordings", str(profile.parent / "recordings")),
        cwd=ROOT,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert view.stdout is not None
        url = (await view.stdout.readline()).decode().removeprefix("the page: ").strip()
        async with browser(profile) as opened:
            await opened.call("Page.enable")
            await opened.call("Page.addScriptToEvaluateOnNewDocument", source=watch)
            await opened.open(url, width)
            yield opened
            assert opened.complaints == []
    finally:
        view.terminate()
        await view.communicate()
