"""Touches of one part with the typed client. `python examples/client.py [URL]`."""

import asyncio
import sys

from skin_host.client import SkinClient
from skin_host.errors import SkinError


async def main(url: str) -> None:
    """Print every touch that begins, and how many events were missed before it."""
    async with SkinClient(url) as skin:
        async for touch in skin.touches():
            if touch.event == "begin":
                print(touch.part, touch.centroid_m, f"{touch.force_n:.2f} N", touch.missed)


try:
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "mqtt://localhost"))
except SkinError as error:  # no broker, or no robot there
    sys.exit(str(error))
except KeyboardInterrupt:
    pass
