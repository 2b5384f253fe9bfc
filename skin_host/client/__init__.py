"""Receives what a robot's skin publishes, for other programs.

    async with SkinClient("mqtt://localhost", robot="demo") as skin:
        async for touch in skin.touches(part="left_hand"):
            print(touch.event, touch.id, touch.peak_kpa, "kPa")

The client reconnects by itself. The field `missed` of the next touch or frame reports what was
lost meanwhile. `SkinCallbacks` is the same without asyncio. All that they raise on purpose is a
`SkinError`: a `BrokerError`, a `RequestError` for what was asked wrongly, or a `CommandError`. A
`WrongCommandError`, for a request that a node found wrong, is of both these kinds.
"""

from skin_host.client.callbacks import SkinCallbacks
from skin_host.client.heard import Described, Health
from skin_host.client.nodes import Node
from skin_host.client.presence import Contact
from skin_host.client.requests import CommandError, WrongCommandError
from skin_host.client.session import SkinClient
from skin_host.client.streams import Stream
from skin_host.errors import BrokerError, RequestError, SkinError
from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.address import Broker
from skin_host.mqtt.info import FingertipInfo, NodeInfo, PartInfo
from skin_host.mqtt.messages import Frame
from skin_host.processing.events import Touch

__all__ = [
    "Broker",
    "BrokerError",
    "CommandError",
    "Contact",
    "Described",
    "FingertipInfo",
    "Frame",
    "Health",
    "Node",
    "NodeInfo",
    "Over",
    "PartInfo",
    "RequestError",
    "SkinCallbacks",
    "SkinClient",
    "SkinError",
    "Slip",
    "Stream",
    "Touch",
    "WrongCommandError",
]
