"""Lists the CAN interfaces of this machine.

Read from the kernel's files: `socket.if_nameindex` opens a netlink socket, which the sandboxed
service is not permitted to do.
"""

import contextlib
from pathlib import Path

NETWORKS = Path("/sys/class/net")
#: Content of `type` for a CAN interface (ARPHRD_CAN, linux/if_arp.h).
CAN_TYPE = "280"


def can_interfaces() -> list[str]:
    """Return the names of the CAN interfaces, up or down, in alphabetical order."""
    found = []
    for network in sorted(NETWORKS.glob("*")):
        with contextlib.suppress(OSError):
            if (network / "type").read_text().strip() == CAN_TYPE:
                found.append(network.name)
    return found
