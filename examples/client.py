"""Touches with the typed client. `python examples/client.py [URL]`."""

import asyncio
import sys

from skin_host.client import SkinClient, SkinError


async def main(url: str) -> None:
    """Print every touch that begins, and what is not known of those that end."""
    async with SkinClient(url) as skin:
        async for touch in skin.touches():
            if touch.missed:
                print(touch.part, touch.missed, "events were lost")
            if touch.event == "begin":
                print(touch.part, touch.centroid_m, f"{touch.force_n:.2f} N")
            elif touch.event == "end" and touch.reason != "released":
                print(touch.part, "may still be touched:", touch.reason)


try:
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "mqtt://localhost"))
except SkinError as error:  # no broker, or no robot there
    sys.exit(str(error))
except KeyboardInterrupt:
    pass
