"""Whether a daemon publishes a skin now."""

import asyncio
import logging
from collections.abc import Set
from pathlib import Path

from skin_host.client.session import SkinClient
from skin_host.config.settings import Settings
from skin_host.errors import BrokerError, ConfigurationError
from skin_host.mqtt.address import Broker

#: How long to wait for a broker.
PATIENCE_S = 1.0
#: Health comes once a second.
ALIVE_S = 2.5

log = logging.getLogger(__name__)


async def served_by_daemon(settings: Settings, folder: Path, parts: Set[str]) -> str | None:
    """Return one of these parts whose health comes now; None: none, or no broker.

    Args:
        settings: of the robot and its broker.
        folder: of its configuration, where relative names of files start.
        parts: names of some of its parts.
    """
    try:
        brokers = Broker.all_from_settings(settings.mqtt, folder)
        skin = SkinClient(
            brokers, robot=settings.robot, base=settings.mqtt.base, patience_s=PATIENCE_S
        )
        async with skin, asyncio.timeout(ALIVE_S):
            async for health in skin.health():
                if health.part in parts and not health.stored:
                    return health.part
    except TimeoutError:
        pass
    except BrokerError as error:
        log.info("%s; whether a daemon runs is not known", error)
    except ConfigurationError as error:
        log.warning("%s; whether a daemon runs is not known", error)
    return None
