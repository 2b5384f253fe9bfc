"""Which CAN interfaces this machine has.

Asked of the kernel's files: `socket.if_nameindex` opens a netlink socket, which a service that is
shut in as ours is may not do.
"""

import contextlib
from pathlib import Path

NETWORKS = Path("/sys/class/net")
#: What `type` says of a CAN interface (ARPHRD_CAN, linux/if_arp.h).
CAN_TYPE = "280"


def can_interfaces() -> list[str]:
    """Names of the CAN interfaces, up or down, in alphabetical order."""
    found = []
    for network in sorted(NETWORKS.glob("*")):
        with contextlib.suppress(OSError):
            if (network / "type").read_text().strip() == CAN_TYPE:
                found.append(network.name)
    return found
